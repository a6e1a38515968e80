"""The worth of each part of closing and holding: the same grasps with the same errors in every row."""

import dataclasses
import functools
import math
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from benchmarks.common import Row
from torchgrasp import Grasps, Status, TrialSpec, close_hand, fit_shape, load_hand, plan_grasps
from torchgrasp.closure import NO_OPTIONS, ClosingOptions
from torchgrasp.data import list_views, read_family, read_object_mesh, read_view
from torchgrasp.evaluation import (
    PROTOCOLS,
    count_by,
    difference_over,
    draw_error,
    format_share,
    most_certain_first,
    run_tasks,
    seed_of,
    share_over,
)
from torchgrasp.evaluation.intervals import RESAMPLES
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec

PAPER = PROTOCOLS["paper"]


class Part(NamedTuple):
    """A row: how the hand closes and holds, and whether the deviations are swapped.

    Swapped, the most certain finger has the largest deviation and the other way round: a control experiment.
    """

    spec: TrialSpec
    swapped: bool = False


DEFAULT = "uncertainty"
"""The row that the others are compared with."""

PARTS = {
    "paper": Part(TrialSpec(closing="paper")),
    "paper, deviations swapped": Part(TrialSpec(closing="paper"), swapped=True),
    DEFAULT: Part(TrialSpec()),
    "uncertainty, deviations swapped": Part(TrialSpec(), swapped=True),
    "uncertainty without wait": Part(TrialSpec(options=ClosingOptions(wait=False))),
    "uncertainty without place": Part(TrialSpec(options=dataclasses.replace(NO_OPTIONS, wait=True))),
    "uncertainty without palm": Part(TrialSpec(options=ClosingOptions(palm_reach=0.0, stops=0))),
    "uncertainty without all components": Part(TrialSpec(options=NO_OPTIONS)),
    "fixed": Part(TrialSpec(closing="fixed")),
    "position": Part(TrialSpec(closing="position")),
    "paper_position": Part(TrialSpec(closing="paper_position")),
    "open_loop": Part(TrialSpec(closing="open_loop")),
    "uncertainty, held by law": Part(TrialSpec(holding="law")),
    "uncertainty, held by position": Part(TrialSpec(holding="position")),
    "uncertainty, held by impedance": Part(TrialSpec(holding="impedance")),
}
"""Trials; where no holding is named it is `force`."""

LIMIT = 3600.0
"""Wall time [s] for one view and hand."""


class Case(NamedTuple):
    """The outcome of a trial: motions in mm, NaN where none could be measured, and CPU time [s]."""

    part: str
    hand: str
    family: str
    held: bool
    status: str
    first: bool
    pushed: float
    slip: float
    seconds: float


def bench_ablation(objects: Path, tries: int, starts: int, seed: int, workers: int) -> list[Row]:
    """Close and lift `tries` grasps of a view of each object with both hands in every row; the object is misplaced."""
    views = dict(reversed(list_views(objects)))
    tasks = [
        (objects, name, view, hand, tries, starts, seed)
        for hand in ("allegro", "barrett")
        for name, view in sorted(views.items())
    ]
    cases: list[Case] = []
    for task, outcome in zip(tasks, run_tasks(_close_view, tasks, workers, LIMIT), strict=True):
        if isinstance(outcome, Status):
            raise SystemExit(f"{task[1]} {task[2]} {task[3]}: {outcome.sentence}")
        cases += outcome
    return [_row(part, cases) for part in PARTS]


def median_over(values: Sequence[tuple[str, float]], seed: int = 0) -> tuple[float, float, float]:
    """Return the median of the families' medians and its 95 % interval over families; NaN values do not count.

    >>> median_over([("tin", 1.0), ("tin", 3.0), ("cup", 2.0), ("jug", math.nan)])
    (2.0, 2.0, 2.0)
    """
    known = [(family, value) for family, value in values if not math.isnan(value)]
    families = sorted({family for family, _ in known})
    if not families:
        return math.nan, math.nan, math.nan
    medians = torch.tensor([statistics.median(v for f, v in known if f == family) for family in families]).double()
    drawn = torch.randint(len(families), (RESAMPLES, len(families)), generator=torch.Generator().manual_seed(seed))
    low, high = medians[drawn].quantile(0.5, dim=1).quantile(torch.tensor([0.025, 0.975]).double()).tolist()
    return float(medians.quantile(0.5)), low, high


def _row(part: str, cases: list[Case]) -> Row:
    """Return what held, who touched first, how far the object was pushed and slipped, and the CPU time."""
    mine, default = ([case for case in cases if case.part == name] for name in (part, DEFAULT))
    held = {"both": share_over(_held(mine))}
    held |= {hand: share_over(_held([c for c in mine if c.hand == hand])) for hand in ("allegro", "barrett")}
    against = difference_over(_held(mine), _held(default))
    first = share_over(count_by((c.family, c.first) for c in mine))
    pushed = median_over([(c.family, c.pushed) for c in mine])
    slip = median_over([(c.family, c.slip) for c in mine if c.held])
    lost = {status: sum(c.status == status for c in mine) for status in sorted({c.status for c in mine} - {"OK"})}
    seconds = sum(case.seconds for case in mine) / max(len(mine), 1)
    words = [f"{name} {format_share(s)}" for name, s in held.items()]
    words += [
        f"{100 * against.value:+.1f} points [{100 * against.low:.1f}, {100 * against.high:.1f}] against {DEFAULT}",
        f"most certain finger first {format_share(first)}",
        "pushed {:.1f} mm [{:.1f}, {:.1f}]".format(*pushed),
        "slip of the held {:.1f} mm [{:.1f}, {:.1f}]".format(*slip),
        f"{seconds:.2f} CPU s; lost {lost}",
    ]
    numbers = {"held": held, "against": against, "first": first, "pushed_mm": pushed, "slip_mm": slip, "lost": lost}
    return Row(f"held, {part}", "-", "; ".join(words), None, numbers)


def _held(cases: list[Case]) -> dict[str, tuple[int, int]]:
    """Return the counts of held trials of each family."""
    return count_by((case.family, case.held) for case in cases)


def swap_deviations(grasp: Grasps) -> Grasps:
    """Return a grasp whose most certain finger is the least certain one: max + min - std_m."""
    std_m = grasp.contacts.require_std()
    swapped = std_m.amax(-1, keepdim=True) + std_m.amin(-1, keepdim=True) - std_m
    return dataclasses.replace(grasp, contacts=dataclasses.replace(grasp.contacts, std_m=swapped))


def _close_view(objects: Path, name: str, view: str, hand_name: str, tries: int, starts: int, seed: int) -> list[Case]:
    """Return the outcome of every trial of one view and hand."""
    hand, cloud = load_hand(hand_name), read_view(objects, name, view)
    shape = fit_shape(cloud, seed=seed, table=0.0)
    grasps = plan_grasps(cloud, hand, ContactSpec(friction=PAPER.trial.friction, table=0.0), starts, seed, shape=shape)
    grasps = grasps[grasps.status == Status.OK]
    mesh, family = read_object_mesh(objects, name), read_family(objects, name)
    close = functools.partial(close_hand, hand=hand, mesh=mesh, parts=convex_parts(mesh))
    cases = []
    for row in choose_rows(len(grasps), tries, "spread"):
        drawn = seed_of(seed, name, view, row, 0)
        error = draw_error(PAPER, grasps[row], mesh, drawn)
        for part, (spec, swapped) in PARTS.items():
            grasp = grasps[row]
            followed = swap_deviations(grasp) if swapped else grasp
            began = time.process_time()
            result = close(followed, spec=spec, seed=seed_of(drawn, "touch"), error=error)
            spent = time.process_time() - began
            first = most_certain_first(result.contact_order, grasp)
            moved = (1e3 * result.pushed.distance, 1e3 * result.slip.distance)
            cases.append(Case(part, hand_name, family, result.held, result.status.name, first, *moved, spent))
    return cases
