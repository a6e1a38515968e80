"""Trials of the paper's Tables 6 and 7 in simulation: risky contacts, and two ways to close.

A cell has at least 30 trials, as in Sec. 6.5. They use the executable grasps whose contacts have the greatest summed
variance below a threshold: three of each noisy view, all equally often. The paper repeats a grasp and lets chance vary
it. Here every trial draws the object's pose on its table, unknown to the hand, and the noise of the fingertips.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import torch

from torchgrasp.base import Value
from torchgrasp.datasets import list_views, read_object_mesh, read_view
from torchgrasp.errors import Status
from torchgrasp.evaluation import PROTOCOLS, close_hand, draw_object_poses, run_tasks
from torchgrasp.evaluation.protocols import error_from_object_pose
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.objects import list_objects, load_object
from torchgrasp.pipeline import plan_grasps
from torchgrasp.shape.fit import fit_shape
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ClosingMode, ContactSpec, HoldingMode
from torchgrasp.values import Grasps, PointCloud

if TYPE_CHECKING:
    import trimesh

PAPER = PROTOCOLS["paper"]

THRESHOLDS = (0.03, 0.06, 0.10)
"""S_thresh of Table 6."""

GRASPS, TRIALS = 3, 30
"""Grasps of each view, and the least number of trials of a cell (Sec. 6.5)."""

MASS = 0.1
"""Mass of objects that come without one [kg]: a light household object."""

CELL_SECONDS = 1800.0
"""Wall time [s] after which a cell is given up: ten times the usual."""


class Row(NamedTuple):
    """A row of a table: the shape's support, the threshold, and how the hand closes and holds."""

    name: str
    support: Literal["camera", "paper"]
    threshold: float
    closing: ClosingMode
    holding: HoldingMode


@dataclasses.dataclass(frozen=True)
class TableSpec(Value):
    """What a table is made of.

    Args:
        hands: by name.
        objects: folder of objects with noisy views, besides the library's own; None: only those.
        only: names of objects to keep; (): all.
        seed: of every random draw.
        trials: least number in a cell.
        starts: of the contact planner.
    """

    hands: tuple[str, ...]
    objects: Path | None = None
    only: tuple[str, ...] = ()
    seed: int = 0
    trials: int = TRIALS
    starts: int = 1000


@dataclasses.dataclass(frozen=True)
class Cell(Value):
    """The trials of one object with one hand.

    `row` is what the table compares. `statuses` lists the trials grasp by grasp, `draws` of each; it is empty where
    nothing was executable. `std_m` [m] is that of a grasp's least certain contact, a mean over the grasps.
    """

    object: str
    hand: str
    row: str
    statuses: tuple[Status, ...]
    draws: int
    std_m: float

    @property
    def held(self) -> int:
        """Count the trials that held."""
        return sum(status is Status.OK for status in self.statuses)


def threshold_cells(spec: TableSpec, workers: int = 1) -> Iterator[tuple[Cell, ...]]:
    """Yield for each object and hand the cells of Table 6: `THRESHOLDS` under the closing law.

    The thresholds are variances of the paper's shape (`support="paper"`): on the completed shape hardly any contact
    reaches the first of them. Any number of workers gives the same cells.

    Raises:
        BadArgument: no such objects, or an unknown hand.
    """
    rows = [Row(f"{t:.2f}", "paper", t, "uncertainty", "force") for t in THRESHOLDS]
    return _cells(spec, rows, workers)


def closing_cells(spec: TableSpec, workers: int = 1) -> Iterator[tuple[Cell, ...]]:
    """Yield for each object and hand the cells of Table 7: the same grasps under two controllers.

    The shape is the library's default. "position" is the paper's baseline: it stops at 0.5 N and lifts so. "position,
    squeeze" goes on as the closing law does, so that the closing alone differs. Raises as `threshold_cells`.
    """
    rows = [
        Row("uncertainty", "camera", THRESHOLDS[0], "uncertainty", "force"),
        Row("position", "camera", THRESHOLDS[0], "position", "position"),
        Row("position, squeeze", "camera", THRESHOLDS[0], "position", "force"),
    ]
    return _cells(spec, rows, workers)


def riskiest(grasps: Grasps, most: int = GRASPS) -> Grasps:
    """Return the executable grasps whose contacts' variances have the greatest sum (Sec. 6.5)."""
    grasps = grasps[grasps.status == Status.OK]
    return grasps[torch.argsort(grasps.contacts.std_m.square().sum(1), descending=True, stable=True)[:most]]


def _cells(spec: TableSpec, rows: list[Row], workers: int) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of each object and hand, a task of its own each."""
    named: list[tuple[Path | None, str]] = [
        (None, name) for name in list_objects() if not spec.only or name in spec.only
    ]
    if spec.objects is not None:
        views = list_views(spec.objects, only=spec.only)
        named = [(spec.objects, name) for name in dict.fromkeys(name for name, _ in views)] + named
    tasks = [(folder, name, hand, rows, spec) for hand in spec.hands for folder, name in named]
    for task, cells in zip(tasks, run_tasks(_fill, tasks, workers, CELL_SECONDS), strict=True):
        if isinstance(cells, Status):
            cells = tuple(Cell(task[1], task[2], row.name, (cells,) * spec.trials, 1, math.nan) for row in rows)
        yield cells


def _fill(folder: Path | None, name: str, hand_name: str, rows: list[Row], spec: TableSpec) -> tuple[Cell, ...]:
    """Plan for one object and hand, and try the grasps, row by row."""
    clouds, mesh, parts, mass = _read(folder, name)
    label = name if folder is not None else f"own {name}"
    pivot = torch.from_numpy(np.asarray(mesh.center_mass, float))
    hand, cells = load_hand(hand_name), []
    planned: dict[tuple[str, float], list[Grasps]] = {}
    for row in rows:
        key = (row.support, row.threshold)
        if key not in planned:
            planned[key] = [grasp for cloud in clouds for grasp in _plan(cloud, hand, row, spec)]
        grasps = planned[key]
        trial = dataclasses.replace(PAPER.trial, closing=row.closing, holding=row.holding, mass=mass)
        draws = math.ceil(spec.trials / max(len(grasps), 1))
        poses = draw_object_poses(PAPER.noise, pivot, draws * len(grasps), spec.seed)
        results = []
        for k, pose in enumerate(poses):
            grasp = grasps[k // draws]
            error = error_from_object_pose(grasp.obj_from_hand[0].double(), pose)
            results.append(close_hand(grasp, hand, mesh, trial, spec.seed + k, parts=parts, error=error))
        stds = [float(grasp.contacts.std_m.amax()) for grasp in grasps]
        std_m = sum(stds) / len(stds) if stds else math.nan
        cells.append(Cell(label, hand_name, row.name, tuple(r.status for r in results), draws, std_m))
    return tuple(cells)


def _plan(cloud: PointCloud, hand: Hand, row: Row, spec: TableSpec) -> Grasps:
    """Return the riskiest grasps of a view below a row's threshold."""
    shape = fit_shape(cloud, support=row.support, seed=spec.seed, table=0.0)
    contacts = ContactSpec(max_variance=row.threshold, table=0.0)
    return riskiest(plan_grasps(cloud, hand, contacts, spec.starts, spec.seed, shape=shape))


def _read(
    folder: Path | None, name: str
) -> "tuple[list[PointCloud], trimesh.Trimesh, Sequence[trimesh.Trimesh], float]":
    """Return the noisy views, the true mesh, its convex parts and the mass of an object."""
    if folder is None:
        own = load_object(name)
        return [own.view], own.mesh, own.parts, own.mass
    mesh = read_object_mesh(folder, name)
    return (
        [read_view(folder, name, view) for _, view in list_views(folder, only=[name])],
        mesh,
        convex_parts(mesh),
        MASS,
    )
