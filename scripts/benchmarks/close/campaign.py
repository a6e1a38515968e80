"""What the benches of lifts and pulls share: objects with their true bodies and first views."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import trimesh
from paper.trials import Subject, TableSpec

from benchmarks.common import Options
from torchgrasp import PointCloud
from torchgrasp.data import list_views, read_entry, read_object_mesh, read_view
from torchgrasp.sim.convex_parts import convex_parts

DENSITY = 500.0
LIGHTEST = 0.05
HEAVIEST = 1.2
"""Density [kg/m^3] of objects of unknown mass: half full, hollow, or of wood; bounds of it [kg]."""


class Solid(NamedTuple):
    """The true object: its mesh, convex parts and mass [kg], and the noisy cloud of its first view."""

    mesh: trimesh.Trimesh
    parts: Sequence[trimesh.Trimesh]
    mass: float
    cloud: PointCloud


def table_spec(o: Options, representatives: bool = True) -> TableSpec:
    """Return the campaign that some options ask for, of one object of each family or of all."""
    return TableSpec(
        o.out,
        o.objects,
        only=o.names,
        own=False,
        representatives=representatives,
        starts=o.starts,
        seed=o.seed,
    )


@functools.lru_cache(maxsize=2)
def read_solid(subject: Subject) -> Solid:
    """Return the true object of a folder, and what is seen of it."""
    folder, name = subject.folder, subject.name
    assert folder is not None
    mesh = read_object_mesh(folder, name)
    known = read_entry(folder, name).mass
    mass = min(max(DENSITY * float(mesh.volume), LIGHTEST), HEAVIEST) if known is None else known
    cloud = read_view(folder, *list_views(folder, only=[name])[0])
    return Solid(mesh, convex_parts(mesh), mass, cloud)
