"""The objects that are shipped with the library: meshes, convex parts and noisy views."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchgrasp.cloud.read import read_cloud
from torchgrasp.data.shards import load_grasps
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.scene.file import read_scene
from torchgrasp.scene.scene import Scene
from torchgrasp.values.planning import Grasps, PointCloud

# `<name>/mesh.ply`, `<name>/parts.npz` and `<name>/view.ply`
DATA = Path(__file__).parent / "assets"
SCENE = DATA / "scene.npz"  # a depth image of the objects on a table, with labels, camera and table
# masses [kg] of the objects
MASSES = {"cylinder": 0.15, "jug": 0.20, "rabbit": 0.10, "spray": 0.15}
# objects and hands of the shipped grasps
GRASPED = {(name, hand) for name in ("cylinder", "jug") for hand in ("allegro", "barrett")}


@checked
@dataclasses.dataclass(frozen=True, eq=False)
class GraspObject:
    """An object to grasp, which stands on the plane z = 0 with z up; `load_object` makes it.

    Mesh, parts and view are in one frame.

    Attributes:
        name: name of the object.
        mesh: the true, closed surface [m].
        parts: convex meshes [m] whose union approximates the object, for simulators.
        view: a noisy point cloud [m] of one side, with its `viewpoint`.
        mass: mass [kg].

    >>> jug = load_object("jug")
    >>> jug.mass, [f"{1000 * side:.0f} mm" for side in jug.mesh.extents], len(jug.parts)
    (0.2, ['120 mm', '78 mm', '153 mm'], 43)
    """

    name: str
    mesh: "trimesh.Trimesh"
    parts: list["trimesh.Trimesh"]
    view: PointCloud
    mass: float


def list_objects() -> tuple[str, ...]:
    """Return the names of the shipped objects, which `load_object` takes.

    >>> list_objects()
    ('cylinder', 'jug', 'rabbit', 'spray')
    """
    return tuple(MASSES)


def find_view(path: Path, name: str = "cloud") -> Path:
    """Return the path of the file of a cloud, given this path or the name of a shipped object.

    The name gives the path of the object's noisy view; any other path is returned itself. Raises
    `BadArgument` for a word that is neither a file nor a shipped object. `name` is the name of the
    argument in this error.

    >>> find_view(Path("jug")).name, find_view(Path("mine.ply")).name
    ('view.ply', 'mine.ply')
    """
    if path.exists() or path.suffix or len(path.parts) != 1:
        return path
    if str(path) not in MASSES:
        allowed = f"a file, or one of the shipped objects {', '.join(MASSES)}"
        raise BadArgument(name, f"{str(path)!r}, which is no file", allowed)
    return DATA / path / "view.ply"


@checked
def load_object(name: str) -> GraspObject:
    """Return a shipped object: mesh, convex parts, mass and a noisy view.

    Args:
        name: name of the object, one of `list_objects()`.

    Raises `BadArgument` for an unknown name.

    >>> jug = load_object("jug")
    >>> jug.mesh.is_watertight, len(jug.view)
    (True, 1000)
    """
    if name not in MASSES:
        raise BadArgument("name", repr(name), f"one of {', '.join(MASSES)}")
    mesh = trimesh.load_mesh(DATA / name / "mesh.ply")
    parts = [part.copy() for part in _read_parts(name)]
    return GraspObject(name, mesh, parts, read_cloud(DATA / name / "view.ply"), MASSES[name])


def solid_of(
    given: "trimesh.Trimesh | Path | str | GraspObject", parts: "Sequence[trimesh.Trimesh] | None"
) -> "tuple[trimesh.Trimesh, Sequence[trimesh.Trimesh] | None]":
    """Return (mesh, parts): the closed mesh [m] of an object, and its convex parts [m].

    The convex parts are the argument `parts`. If it is None, they are those of the `GraspObject`
    that is `given`. For another mesh they are then None, unknown. Raises `MeshError` for a mesh
    that is missing, open or without volume.
    """
    if isinstance(given, GraspObject):
        return read_mesh(given.mesh), given.parts if parts is None else parts
    return read_mesh(given), parts


@functools.cache
def _read_parts(name: str) -> "tuple[trimesh.Trimesh, ...]":
    """Return the convex parts of a shipped object, made once: hulls take most of the time."""
    with np.load(DATA / name / "parts.npz", allow_pickle=False) as file:
        corners = np.split(file["corners"].astype(np.float64), np.cumsum(file["counts"])[:-1])
    return tuple(map(trimesh.convex.convex_hull, corners))


@checked
def load_shipped_grasp(name: str, hand: str) -> Grasps:
    """Return one planned grasp of a shipped object, without planning; for examples.

    Args:
        name: name of the object: "cylinder" or "jug".
        hand: name of the hand: "allegro" or "barrett".

    Raises `BadArgument` for another name.

    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> grasp.joints.shape, grasp.certificate.closed
    (torch.Size([1, 4]), tensor([True]))
    """
    if (name, hand) not in GRASPED:
        allowed = " or ".join(f"{' by '.join(known)}" for known in sorted(GRASPED))
        raise BadArgument("name and hand", f"{name} by {hand}", allowed)
    return load_grasps(DATA / name / f"{hand}.safetensors")


def load_scene() -> Scene:
    """Return a scene of the four shipped objects on a table: a rendered, noisy depth image with
    true labels.

    The scene is in metres, with z up.

    >>> load_scene().things
    (1, 2, 3, 4)
    """
    return read_scene(SCENE)
