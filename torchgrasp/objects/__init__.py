"""Objects of torchgrasp's own: a mesh, its convex parts, and one noisy view of each."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchgrasp.cloud.io.read import read_cloud
from torchgrasp.errors import BadArgument
from torchgrasp.values import PointCloud

if TYPE_CHECKING:
    import trimesh

DATA = Path(__file__).parent / "data"
"""Folder of the objects: `<name>/mesh.ply`, `<name>/parts.npz` and `<name>/view.ply`."""

MASSES = {"cylinder": 0.15, "jug": 0.20, "rabbit": 0.10, "spray": 0.15}
"""Masses [kg], by name: a tin, a plastic jug, a plush rabbit, a bottle a third full."""


@dataclasses.dataclass(frozen=True)
class GraspObject:
    """An object to be grasped, in metres, z up, resting at z = 0.

    `mesh` is the true surface, closed; `parts` are the convex solids whose union stands for it in a simulation;
    `view` is what a noisy depth camera saw of it from one side, with its viewpoint; `mass` is in kg.
    """

    name: str
    mesh: "trimesh.Trimesh"
    parts: list["trimesh.Trimesh"]
    view: PointCloud
    mass: float


def list_objects() -> tuple[str, ...]:
    """Return the names that `load_object` knows.

    >>> list_objects()
    ('cylinder', 'jug', 'rabbit', 'spray')
    """
    return tuple(MASSES)


def load_object(name: str) -> GraspObject:
    """Return one of the library's objects.

    Raises:
        BadArgument: no object of this name.

    >>> jug = load_object("jug")
    >>> jug.mesh.is_watertight, len(jug.view)
    (True, 1000)
    """
    import trimesh

    if name not in MASSES:
        raise BadArgument("name", repr(name), f"one of {', '.join(MASSES)}")
    mesh = trimesh.load_mesh(DATA / name / "mesh.ply")
    with np.load(DATA / name / "parts.npz", allow_pickle=False) as file:
        corners = np.split(file["corners"].astype(np.float64), np.cumsum(file["counts"])[:-1])
    parts = [trimesh.convex.convex_hull(c) for c in corners]
    return GraspObject(name, mesh, parts, read_cloud(DATA / name / "view.ply"), MASSES[name])
