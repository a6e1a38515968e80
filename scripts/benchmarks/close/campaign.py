"""What campaigns of lifts share: objects, views, plans and kept files, so that a stopped campaign
goes on.
"""

import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import trimesh
from paper.trials import Subject, TableSpec

from benchmarks.common import Options
from torchgrasp import fit_shape
from torchgrasp.data import list_views, read_entry, read_object_mesh, read_view
from torchgrasp.files import format_json, write_file
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import convex_parts

DENSITY = 500.0
LIGHTEST = 0.05
HEAVIEST = 1.2
"""Density [kg/m^3] of objects of unknown mass: half full, hollow, or of wood; bounds of it [kg]."""


class Solid(NamedTuple):
    """The true object: its mesh, convex parts and mass [kg], and the name of its first view."""

    mesh: trimesh.Trimesh
    parts: Sequence[trimesh.Trimesh]
    mass: float
    view: str


def table_spec(o: Options) -> TableSpec:
    """Return the campaign of lifts that some options ask for, of one object of each family."""
    return TableSpec(
        o.out,
        o.objects,
        hands=o.hands,
        only=o.names,
        own=False,
        representatives=True,
        grasps=o.grasps,
        starts=o.starts,
        workers=o.workers,
        seed=o.seed,
    )


def keep(path: Path, make: Callable[[], Any]) -> Any:
    """Return the content of a JSON file, which is made first where it does not exist."""
    if not path.is_file():
        write_file(path, format_json(make()))
    return json.loads(path.read_text("utf-8"))


@functools.lru_cache(maxsize=2)
def read_solid(subject: Subject) -> Solid:
    """Return the true object."""
    folder = folder_of(subject)
    name = subject.name
    mesh = read_object_mesh(folder, name)
    known = read_entry(folder, name).mass
    mass = min(max(DENSITY * float(mesh.volume), LIGHTEST), HEAVIEST) if known is None else known
    return Solid(mesh, convex_parts(mesh), mass, list_views(folder, only=[name])[0][1])


def folder_of(subject: Subject) -> Path:
    """Return the folder of an object that is not the library's own."""
    assert subject.folder is not None
    return subject.folder


@functools.lru_cache(maxsize=2)
def felt_surface(subject: Subject) -> SignedDistanceField:
    """Return the estimated surface of the first view, with which touches are compared."""
    cloud = read_view(folder_of(subject), subject.name, read_solid(subject).view)
    return surface_field(fit_shape(cloud, table=0.0))
