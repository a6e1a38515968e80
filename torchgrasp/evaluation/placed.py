"""Scenes for trials in clutter: objects dropped on a table in the simulator, and the camera that looks at them."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_whole
from torchgrasp.checks import Pose, Range, Seed, checked
from torchgrasp.cloud.camera import FOCAL, HEIGHT, WIDTH, look_at
from torchgrasp.data import read_object_mesh
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_from_vector
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.sim.convex_parts import convex_parts, hull
from torchgrasp.sim.scene import Body
from torchgrasp.specs import TrialSpec

if TYPE_CHECKING:
    import trimesh

    from torchgrasp.sim.settle import SettlingTable

MASS = 0.1
"""Mass [kg] of every dropped object, as of `TrialSpec`."""
SPREAD, REGION = 0.13, 0.25
"""Radii [m] within which objects are dropped, and within which their centres must stay."""
TILT = math.radians(10)
"""Largest tilt of a dropped object."""
FALL = 0.005
"""Gap [m] between a dropped object and what is below it."""
DROP_TIME, REST_TIME = 1.0, 3.0
"""Longest times [s] until the next object is dropped, and until all must be still."""
WATCH_TIME, WATCH_SHIFT = 2.0, 0.004
"""Time [s] that a scene is watched, and the motion [m] of a vertex in it that shows an unsteady balance."""
DROPS, BEGINNINGS = 3, 50
"""Drops for each object, on average, before a scene begins again; beginnings before it is given up."""
ELEVATION, DISTANCE = (40.0, 60.0), (0.6, 0.75)
"""Of the camera [deg, m], uniform; the azimuth is any."""
CORNERS = 120
"""Most corners of a part. PhysX keeps 255 faces: of more it makes other bodies in other frames, and balls that rest on
a face in one roll in the next."""
BORDER = 8
"""Least distance of an object from the border of the image [px]."""
VIEWS = 20
"""Cameras drawn before a scene that fits into none begins again."""


@checked
@dataclasses.dataclass(frozen=True)
class PlacedScene:
    """Objects at rest on the table z = 0, and a camera that sees them.

    Args:
        names: of the objects.
        meshes: where they lie, in the world frame [m].
        parts: convex parts of each, there.
        camera_pose: world_from_camera.

    >>> from torchgrasp import load_object
    >>> jug = load_object("jug")
    >>> scene = PlacedScene(("jug",), (jug.mesh,), (tuple(jug.parts),), torch.eye(4).double())
    >>> len(scene), scene.centres().round(2)
    (1, array([[-0.  , -0.  ,  0.07]]))
    """

    names: tuple[str, ...]
    meshes: "tuple[trimesh.Trimesh, ...]"
    parts: "tuple[tuple[trimesh.Trimesh, ...], ...]"
    camera_pose: Pose

    def __len__(self) -> int:
        """Count the objects."""
        return len(self.names)

    def centres(self) -> np.ndarray:
        """Return the mass centres (n, 3) [m]."""
        return np.array([mesh.center_mass for mesh in self.meshes]).reshape(-1, 3)


def object_names(objects: Path | None) -> list[str]:
    """Return the names of a folder's objects, sorted; None: the library's own.

    Raises:
        BadArgument: no folder of a `mesh.ply` in it.
    """
    if objects is None:
        return list(list_objects())
    names = sorted(file.parent.name for file in Path(objects).glob("*/mesh.ply"))
    if not names:
        raise BadArgument("objects", str(objects), "a folder with NAME/mesh.ply in it")
    return names


@checked
def drop(
    objects: Path | None, count: tuple[Annotated[int, Range(1, 20)], Annotated[int, Range(1, 20)]], seed: Seed
) -> PlacedScene:
    """Drop objects on a table, one after another, and let them come to rest.

    Each falls upright, turned at random and tilted by at most 10 degrees, within 0.13 m of the middle, from just above
    what lies there. One that leaves the middle by more than 0.25 m is dropped again. All weigh 0.1 kg.

    Args:
        objects: folder of NAME/mesh.ply [m], times the "suggested_scale" of a manifest.json; None: the library's own.
        count: least and largest number of objects, drawn without repetition as far as there are enough.
        seed: of every draw; the same seed gives the same scene, to the last bit.

    Raises:
        BadArgument: no objects, or a count outside [1, 20].
        MeshError: a mesh is open.
        MissingExtra: SAPIEN is not installed.

    >>> scene = drop(None, (2, 2), seed=0)
    >>> len(scene.names), bool((scene.centres()[:, 2] > 0).all())
    (2, True)
    """
    low, high = count
    check_whole("count", high, low, 20)
    generator = torch.Generator().manual_seed(seed)
    known = object_names(objects)
    for _ in range(BEGINNINGS):
        n = int(torch.randint(low, high + 1, (1,), generator=generator))
        order = torch.cat([torch.randperm(len(known), generator=generator) for _ in range(-(-n // len(known)))])
        names = tuple(known[i] for i in order[:n])
        bodies = [_read_body(objects, name) for name in names]
        poses = _fall(bodies, generator)
        if poses is None:
            continue
        scene = aim(_moved(names, bodies, poses, torch.eye(4, dtype=torch.float64)), generator)
        if scene is not None and _steady(scene):
            return scene
    raise BadArgument("objects", f"{objects}: none of {BEGINNINGS} scenes came to rest in view", "smaller objects")


def settle(placed: PlacedScene, motion: Float[Tensor, "n 4 4"], keep: Sequence[int]) -> PlacedScene:
    """Return some objects of a scene after motions and coming to rest.

    Args:
        motion: of every object from where it lies, in the world frame.
        keep: indices of the objects that stay.
    """
    from torchgrasp.sim.settle import SettlingTable

    table = SettlingTable()
    for k in keep:
        table.add(Body(placed.meshes[k], placed.parts[k], MASS), motion[k].numpy())
    table.settle(REST_TIME)
    bodies = [Body(placed.meshes[k], placed.parts[k], MASS) for k in keep]
    return _moved(tuple(placed.names[k] for k in keep), bodies, table.poses(), placed.camera_pose)


def aim(placed: PlacedScene, generator: torch.Generator) -> PlacedScene | None:
    """Return the scene seen by a new camera with all objects in its image; None: none of some does."""
    vertices = torch.from_numpy(np.concatenate([mesh.vertices for mesh in placed.meshes]))
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    for _ in range(VIEWS):
        turn, rise, away = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        pose = look_at(360 * turn, _between(ELEVATION, rise), _between(DISTANCE, away), middle)
        x, y, z = apply(inverse(pose), vertices).unbind(-1)
        wide = float((x / z).abs().max()) * FOCAL < WIDTH / 2 - BORDER
        if wide and float((y / z).abs().max()) * FOCAL < HEIGHT / 2 - BORDER:
            return dataclasses.replace(placed, camera_pose=pose)
    return None


def _between(ends: tuple[float, float], share: float) -> float:
    """Return a number at a share of the way between two."""
    return ends[0] + share * (ends[1] - ends[0])


def _steady(placed: PlacedScene) -> bool:
    """Tell whether objects stay where they are in a trial: in another frame, with its timestep and no damping."""
    from torchgrasp.sim.settle import SettlingTable

    turn = rigid(rotation_from_vector(torch.tensor([0.0, 0.0, 1.0])).double(), torch.zeros(3).double()).numpy()
    bodies = [Body(mesh, parts, MASS) for mesh, parts in zip(placed.meshes, placed.parts, strict=True)]
    turned = _moved(placed.names, bodies, np.repeat(turn[None], len(bodies), 0), placed.camera_pose)
    table = SettlingTable(damping=0.0, timestep=TrialSpec().timestep)
    for mesh, parts in zip(turned.meshes, turned.parts, strict=True):
        table.add(Body(mesh, parts, MASS), np.eye(4))
    table.wait(WATCH_TIME)
    for mesh, pose in zip(turned.meshes, table.poses(), strict=True):
        moved = np.asarray(mesh.vertices) @ (pose[:3, :3] - np.eye(3)).T + pose[:3, 3]
        if np.abs(moved).max() > WATCH_SHIFT:
            return False
    return True


def _moved(
    names: tuple[str, ...], bodies: list[Body], poses: np.ndarray, camera_pose: Float[Tensor, "4 4"]
) -> PlacedScene:
    """Return bodies at their poses."""
    meshes = tuple(body.mesh.copy().apply_transform(pose) for body, pose in zip(bodies, poses, strict=True))
    parts = tuple(
        tuple(part.copy().apply_transform(pose) for part in body.parts)
        for body, pose in zip(bodies, poses, strict=True)
    )
    return PlacedScene(names, meshes, parts, camera_pose)


def _fall(bodies: list[Body], generator: torch.Generator) -> np.ndarray | None:
    """Drop bodies one after another; return their poses at rest, or None."""
    from torchgrasp.sim.settle import SettlingTable

    table, waiting, placed = SettlingTable(), list(range(len(bodies))), 0
    for _ in range(DROPS * len(bodies)):
        k = waiting.pop(0)
        pose = _above(bodies, table, k, placed, generator)
        if k == placed:
            table.add(bodies[k], pose)
            placed += 1
        else:
            table.move(k, pose)
        still = table.settle(DROP_TIME if waiting else REST_TIME)
        poses = table.poses()
        pairs = zip(bodies[:placed], poses, strict=True)
        centres = [pose[:3, :3] @ body.mesh.center_mass + pose[:3, 3] for body, pose in pairs]
        waiting += [i for i, c in enumerate(centres) if not math.hypot(c[0], c[1]) < REGION and i not in waiting]
        if not waiting:
            return poses if still else None
    return None


def _above(bodies: list[Body], table: "SettlingTable", k: int, placed: int, generator: torch.Generator) -> np.ndarray:
    """Draw a pose of a body above what lies there."""
    draws = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
    tilt, lean, turn, share, angle = (2 * math.pi * x if i in (1, 2, 4) else x for i, x in enumerate(draws))
    leaning = torch.tensor([math.cos(lean), math.sin(lean), 0.0], dtype=torch.float64) * (TILT * tilt)
    turning = torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    rotation = rotation_from_vector(leaning) @ rotation_from_vector(turning)
    corners = np.asarray(bodies[k].mesh.vertices) @ rotation.numpy().T
    middle = (corners.min(0) + corners.max(0)) / 2
    distance = SPREAD * math.sqrt(share)
    x, y = distance * math.cos(angle) - middle[0], distance * math.sin(angle) - middle[1]
    low, high = corners.min(0)[:2] + np.array([x, y]), corners.max(0)[:2] + np.array([x, y])
    top = 0.0
    for i, pose in enumerate(table.poses()):
        lying = np.asarray(bodies[i].mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        if i != k and bool((lying.min(0)[:2] < high).all() and (lying.max(0)[:2] > low).all()):
            top = max(top, float(lying[:, 2].max()))
    place = torch.tensor([x, y, top + FALL - corners[:, 2].min()], dtype=torch.float64)
    return rigid(rotation, place).numpy()


@functools.lru_cache(maxsize=128)
def _read_body(objects: Path | None, name: str) -> Body:
    """Return an object, kept for the next scene."""
    if objects is None:
        known = load_object(name)
        return Body(known.mesh, [_coarse(part) for part in known.parts], MASS)
    scaled = (Path(objects) / "manifest.json").is_file()
    mesh = read_object_mesh(objects, name) if scaled else read_mesh(Path(objects) / name / "mesh.ply")
    return Body(mesh, [_coarse(part) for part in convex_parts(mesh)], MASS)


def _coarse(part: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """Return a convex part of at most `CORNERS` corners, the farthest from each other."""
    if len(part.vertices) <= CORNERS:
        return part
    corners = torch.from_numpy(np.array(part.vertices, dtype=np.float64))
    return hull(corners[farthest_points(corners, CORNERS)].numpy())
