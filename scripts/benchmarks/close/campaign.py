"""What campaigns of lifts share: objects, views, plans and kept files, so that a stopped campaign
goes on.
"""

import functools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import trimesh
from paper.trials import CELL_SECONDS, Subject, TableSpec

from benchmarks.common import Options
from benchmarks.perturb import Perturbation, household_mass, perturb_view
from torchgrasp import Grasps, ShapeGP, Status, fit_shape, load_grasps, load_hand, plan_grasps
from torchgrasp.data import list_views, read_entry, read_object_mesh, read_view
from torchgrasp.evaluation.protocols import seed_of
from torchgrasp.files import format_json, write_file
from torchgrasp.foundation.errors import GraspError
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.values.specs import ContactSpec

RIGHT = Perturbation()
"""No error of the camera or the table."""


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


def run_all(
    work: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], workers: int
) -> Iterator[Any]:
    """Yield the result of each task; a task that fails ends the campaign."""
    for task, found in zip(tasks, run_tasks(work, tasks, workers, CELL_SECONDS), strict=True):
        if isinstance(found, Status):
            raise SystemExit(f"{task[1].name} {task[2]}: {found.sentence}")
        yield found


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
    mass = household_mass(float(mesh.volume), read_entry(folder, name).mass)
    return Solid(mesh, convex_parts(mesh), mass, list_views(folder, only=[name])[0][1])


def folder_of(subject: Subject) -> Path:
    """Return the folder of an object that is not the library's own."""
    assert subject.folder is not None
    return subject.folder


def plan_view(
    spec: TableSpec, subject: Subject, hand: str, friction: float, seen: Perturbation = RIGHT
) -> list[Grasps]:
    """Return the executable grasps of the first view, kept or planned; none where planning is
    refused.
    """
    view = read_solid(subject).view
    path = spec.kept("plans", f"{hand}_{subject.label}_{view}", friction, seen).with_suffix(
        ".safetensors"
    )
    if not path.is_file():
        cloud = read_view(folder_of(subject), subject.name, view)
        seed = seed_of(spec.seed, subject.label, view)
        cloud, table = perturb_view(cloud, seen, seed)
        try:
            grasps = plan_grasps(
                cloud, load_hand(hand), ContactSpec(friction, table=table), spec.starts, spec.seed
            )
        except GraspError as error:
            print(f"{subject.name}, {hand}: {error}", flush=True)
            return []
        grasps[grasps.status == Status.OK].save(path)
    grasps = load_grasps(path)
    return [grasps[k] for k in range(len(grasps))]


@functools.lru_cache(maxsize=2)
def fit_view(
    spec: TableSpec, subject: Subject, seen: Perturbation = RIGHT
) -> tuple[ShapeGP, SignedDistanceField]:
    """Return the shape of the first view, and its surface, with which touches are compared."""
    view = read_solid(subject).view
    cloud = read_view(folder_of(subject), subject.name, view)
    cloud, table = perturb_view(cloud, seen, seed_of(spec.seed, subject.label, view))
    shape = fit_shape(cloud, table=table)
    return shape, surface_field(shape)
