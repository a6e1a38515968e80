"""The paper's Tables 6 and 7 in simulation: riskier contacts hold less often, and the closing law holds more often.

A cell has at least 30 trials, as in Sec. 6.5: of each noisy view the three executable grasps whose contacts have the
greatest summed variance below a threshold, all equally often. The paper repeats a grasp from the same start and lets
chance do the rest; a simulator has none, so that each trial draws where the object really stands on its table, of which
the hand knows nothing, and the noise of the fingertips.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from torchgrasp.base import Value
from torchgrasp.datasets import list_views, read_object_mesh, read_view
from torchgrasp.errors import Status
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.evaluation.pool import run_tasks
from torchgrasp.evaluation.pose_noise import draw_object_poses, error_from_object_pose
from torchgrasp.evaluation.protocols import PAPER
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

Support = Literal["camera", "paper"]
Row = tuple[str, Support, float, ClosingMode, HoldingMode]
"""A row of a table: its name, the shape's support, the threshold, and how the hand closes and holds."""

THRESHOLDS = (0.03, 0.06, 0.10)
"""S_thresh of Table 6."""

GRASPS, TRIALS = 3, 30
"""Grasps of each view, and trials of a cell, at least."""

MASS = 0.1
"""Of objects that come without one [kg]."""

CELL_SECONDS = 1800.0
"""Wall time [s] after which a cell is given up."""

RESAMPLES = 10_000
"""Draws of the objects behind an interval."""


@dataclasses.dataclass(frozen=True)
class Cell(Value):
    """The trials of one object with one hand.

    `row` is what the table compares: a threshold or a controller. `statuses` lists the trials, `draws` of each grasp,
    those of a grasp one after the other; it is empty where nothing was executable. `std_m` is the mean over the grasps
    of their least certain contact's standard deviation [m].
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


def threshold_cells(
    objects: Path | None,
    hands: Sequence[str] = ("allegro",),
    only: Sequence[str] = (),
    workers: int = 1,
    seed: int = 0,
    trials: int = TRIALS,
    starts: int = 1000,
) -> Iterator[tuple[Cell, ...]]:
    """Yield for each object and hand the cells of Table 6: the paper's shape, `THRESHOLDS`, the closing law.

    The thresholds are variances of the paper's shape (`support="paper"`): on the completed shape, the library's
    default, hardly any contact reaches the first of them.

    Args:
        objects: folder of objects with their noisy views, besides the library's own; None: only those.
        hands: by name.
        only: names of objects to keep; by default all.
        workers: processes; the cells do not depend on how many.
        seed: of every random draw.
        trials: of a cell, at least.
        starts: of the contact planner.

    Raises:
        BadArgument: no such objects, or an unknown hand.
    """
    rows: list[Row] = [(f"{t:.2f}", "paper", t, "uncertainty", "force") for t in THRESHOLDS]
    return _cells(objects, hands, only, workers, seed, (trials, starts), rows)


def controller_cells(
    objects: Path | None,
    hands: Sequence[str] = ("allegro", "barrett"),
    only: Sequence[str] = (),
    workers: int = 1,
    seed: int = 0,
    trials: int = TRIALS,
    starts: int = 1000,
) -> Iterator[tuple[Cell, ...]]:
    """Yield for each object and hand the cells of Table 7: the first row of Table 6 under two controllers.

    The shape is the library's default. All rows close the same grasps of the same wrongly placed objects. "position" is
    the paper's baseline: it stops at 0.5 N and lifts so. "position, squeeze" goes on as the closing law does, with
    balanced forces at the sensed contacts, so that the closing alone differs. See `threshold_cells` for the arguments.
    """
    certain = ("camera", THRESHOLDS[0])
    rows: list[Row] = [
        ("uncertainty", *certain, "uncertainty", "force"),
        ("position", *certain, "position", "position"),
        ("position, squeeze", *certain, "position", "force"),
    ]
    return _cells(objects, hands, only, workers, seed, (trials, starts), rows)


def riskiest(grasps: Grasps, most: int = GRASPS) -> Grasps:
    """Return the executable grasps whose contacts' variances have the greatest sum (Sec. 6.5)."""
    grasps = grasps[grasps.status == Status.OK]
    return grasps[torch.argsort(grasps.contacts.require_std().square().sum(1), descending=True, stable=True)[:most]]


def difference(first: Sequence[Cell], second: Sequence[Cell], seed: int = 0) -> tuple[float, float, float]:
    """Return by how much the held share of the first cells is above that of the second, and its 95 % interval.

    The cells are paired by object and hand. The interval resamples objects, not trials: the trials of one object are
    alike.

    >>> a = [Cell(o, "allegro", "a", (Status.OK, Status.OK), 1, 0.0) for o in "xyz"]
    >>> b = [Cell(o, "allegro", "b", (Status.OK, Status.DROPPED), 1, 0.0) for o in "xyz"]
    >>> difference(a, b)
    (0.5, 0.5, 0.5)
    """
    return _interval(
        {o: [_of(first, o), _of(second, o)] for o in {c.object for c in first}}, np.array([1.0, -1.0]), seed
    )


def trend(rows: Sequence[Sequence[Cell]], seed: int = 0) -> tuple[float, float, float]:
    """Return the fall of the held share from the first to the last of `THRESHOLDS`, and its 95 % interval over objects.

    It is the line of least squares through the rows' pooled shares; see `difference` for the interval.
    """
    return _interval({o: [_of(row, o) for row in rows] for o in {c.object for c in rows[0]}}, _line(), seed)


def trend_over_grasps(rows: Sequence[Sequence[Cell]], seed: int = 0) -> tuple[float, float, float]:
    """Return `trend` with the interval of these very objects: the grasps of each cell are resampled."""
    generator = np.random.default_rng(seed)
    shares = []
    for row in rows:
        held = np.zeros(RESAMPLES + 1)
        for cell in row:
            passed = np.array([status is Status.OK for status in cell.statuses]).reshape(-1, cell.draws).sum(1)
            drawn = generator.integers(max(len(passed), 1), size=(RESAMPLES, len(passed)))
            held += np.concatenate([passed[None], passed[drawn]]).sum(1)
        shares.append(held / max(sum(len(cell.statuses) for cell in row), 1))
    return _quantiles(np.stack(shares, -1) @ _line())


def _line() -> np.ndarray:
    """Return the weights of the rows' shares that make the fall of the line of least squares through them."""
    centred = np.array(THRESHOLDS) - np.mean(THRESHOLDS)
    return -centred / (centred @ centred) * (THRESHOLDS[-1] - THRESHOLDS[0])


def _of(cells: Sequence[Cell], name: str) -> tuple[int, int]:
    """Return how many trials of an object held, and of how many."""
    mine = [cell for cell in cells if cell.object == name]
    return sum(cell.held for cell in mine), sum(len(cell.statuses) for cell in mine)


def _interval(counts: dict[str, list[tuple[int, int]]], weights: np.ndarray, seed: int) -> tuple[float, float, float]:
    """Return a weighted sum of rows' pooled shares, with the 2.5 % and 97.5 % quantiles over resampled objects."""
    table = np.array([counts[name] for name in sorted(counts)], float)  # (objects, rows, 2)
    drawn = np.random.default_rng(seed).integers(len(table), size=(RESAMPLES, len(table)))
    sums = np.concatenate([table.sum(0)[None], table[drawn].sum(1)])
    value = (sums[..., 0] / np.maximum(sums[..., 1], 1)) @ weights
    return _quantiles(value)


def _quantiles(value: np.ndarray) -> tuple[float, float, float]:
    """Return the first of the values, and the 2.5 % and 97.5 % quantiles of the others."""
    low, high = np.quantile(value[1:], [0.025, 0.975])
    return float(value[0]), float(low), float(high)


# ------------------------------------------------------------------------------------------------- one object at a time


def _cells(
    objects: Path | None,
    hands: Sequence[str],
    only: Sequence[str],
    workers: int,
    seed: int,
    effort: tuple[int, int],
    rows: list[Row],
) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of each object and hand, a task of its own each."""
    folder = None if objects is None else str(objects)
    named = [(None, name) for name in list_objects() if not only or name in only]
    if objects is not None:
        named = [(folder, name) for name in dict.fromkeys(name for name, _ in list_views(objects, only=only))] + named
    tasks = [(place, name, hand, rows, seed, *effort) for hand in hands for place, name in named]
    for task, found in zip(tasks, run_tasks(_fill, tasks, workers, CELL_SECONDS), strict=True):
        if isinstance(found, Status):
            lost = (found,) * effort[0]
            found = tuple(Cell(task[1], task[2], row[0], lost, 1, math.nan) for row in rows)
        yield found


def _fill(
    folder: str | None,
    name: str,
    hand_name: str,
    rows: list[Row],
    seed: int,
    trials: int,
    starts: int,
) -> tuple[Cell, ...]:
    """Plan for one object and hand, and try what was found, row by row."""
    clouds, mesh, parts, mass = _read(folder, name)
    label = name if folder is not None else f"own {name}"
    pivot = torch.from_numpy(np.asarray(mesh.center_mass, float))
    hand, cells = load_hand(hand_name), []
    planned: dict[tuple[str, float], list[Grasps]] = {}
    for row, support, threshold, closing, holding in rows:
        if (support, threshold) not in planned:
            planned[support, threshold] = [_plan(cloud, hand, support, threshold, starts, seed) for cloud in clouds]
        grasps = [grasp for found in planned[support, threshold] for grasp in found]
        spec = dataclasses.replace(PAPER.trial, closing=closing, holding=holding, mass=mass)
        draws = math.ceil(trials / max(len(grasps), 1))
        places = draw_object_poses(PAPER.noise, pivot, draws * len(grasps), seed)
        results = []
        for k, place in enumerate(places):
            grasp = grasps[k // draws]
            error = error_from_object_pose(grasp.obj_from_hand[0].double(), place)
            results.append(close_hand(grasp, hand, mesh, spec, seed + k, parts=parts, error=error))
        stds = [float(grasp.contacts.require_std().amax()) for grasp in grasps]
        std_m = sum(stds) / len(stds) if stds else math.nan
        cells.append(Cell(label, hand_name, row, tuple(r.status for r in results), draws, std_m))
    return tuple(cells)


def _plan(cloud: PointCloud, hand: Hand, support: Support, threshold: float, starts: int, seed: int) -> Grasps:
    """Return the riskiest grasps of a view below a threshold."""
    shape = fit_shape(cloud, support=support, seed=seed, table=0.0)
    spec = ContactSpec(max_variance=threshold, table=0.0)
    return riskiest(plan_grasps(cloud, hand, spec, starts, seed, shape=shape))


def _read(
    folder: str | None, name: str
) -> "tuple[list[PointCloud], trimesh.Trimesh, Sequence[trimesh.Trimesh], float]":
    """Return the noisy views, the true mesh, its convex parts and the mass of an object."""
    if folder is None:
        own = load_object(name)
        return [own.view], own.mesh, own.parts, own.mass
    objects = Path(folder)
    mesh = read_object_mesh(objects, name)
    clouds = [read_view(objects, name, view) for _, view in list_views(objects, only=[name])]
    return clouds, mesh, convex_parts(mesh), MASS
