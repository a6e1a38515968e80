"""Lifts of low bodies near a corner of their table. The hand may drag them to one of its two edges.

A body has grasps where it lies, and grasps at either edge. Those with the highest predicted success
are used. The corner is turned at random against body and camera.
"""

import dataclasses
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from paper.tables6_7 import format_points
from train.household import household

from benchmarks.close.table_lift import BASE
from benchmarks.common import Options, Row, bench, run_all
from benchmarks.headline.lifts import HIGHEST, LOW, LOW_BODIES
from torchgrasp import (
    ContactSpec,
    GraspTask,
    Hand,
    Plane,
    PointCloud,
    Status,
    fit_shape,
    load_hand,
    plan_grasps,
)
from torchgrasp.data.manifest import ObjectEntry, read_entries, read_object_mesh, read_view
from torchgrasp.evaluation.drag_trial import EdgeLift, lift_from_edge
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.evaluation.protocols import seed_of
from torchgrasp.planner.edge import EdgePlan, plan_edge_grasps
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import Simulator, TrialSpec

FIRST = 40_000
"""Number of the first body: nobody has seen these bodies when constants were chosen."""
GAP = 0.1
"""Distance [m] of the body from each edge of the corner."""
RAISED = 0.5
"""Share of the lift's height by which the object has risen: the criterion of "table-lift"."""
LIMIT = 600.0
"""Limit [s] of the CPU time of one body."""


class Outcome(NamedTuple):
    """What came of one low body near a corner of its table.

    `where` says whether the best plan drags it to an "edge" or grasps it on the "table". `tries` is
    the number of grasps until one raised it, 0 for none. `tries_there` is this number for grasps
    where it lies. `why` is the status of the last try.
    """

    where: str
    tries: int
    tries_there: int
    why: str


@bench("close/edge")
def edge(o: Options) -> list[Row]:
    """Lift authored bodies that are 8 to 16 mm high, 0.1 m from a corner of their table."""
    count = o.times(LOW_BODIES)
    folder = o.out / f"edge_{count}"
    if not (folder / "manifest.json").is_file():
        household(folder, count, FIRST, HIGHEST)
    return [_tried(o, folder, hand) for hand in o.hands]


def _tried(o: Options, folder: Path, hand: str) -> Row:
    """Return the row of one hand."""
    entries = {k: x for k, x in read_entries(folder).items() if isinstance(x, ObjectEntry)}
    tasks = [(folder, name, hand, o.seed, o.starts, o.simulator) for name in entries]
    outcomes = [Outcome(*x) for x in run_all(lift_body, tasks, o.workers, LIMIT)]
    found = dict(zip(entries, outcomes, strict=True))
    families = [entry.family for entry in entries.values()]
    raised = count_by(zip(families, (x.tries > 0 for x in outcomes), strict=True))
    at_once = count_by(zip(families, (x.tries == 1 for x in outcomes), strict=True))
    in_place = count_by(zip(families, (x.tries_there > 0 for x in outcomes), strict=True))
    gain = contrast_over([in_place, raised], (-1.0, 1.0))
    risen, first, there = map(share_over, (raised, at_once, in_place))
    dragged = sum(x.where == "edge" for x in found.values())
    lost = {k: x.why for k, x in found.items() if not x.tries}
    words = f"up to three grasps {format_share(risen)}; the first {format_share(first)}; "
    words += f"where they lie {format_share(there)}; gain {format_points(gain)}; "
    words += f"{dragged} of {len(found)} dragged to an edge"
    if lost:
        words += f"; lost {', '.join(f'{k} ({why})' for k, why in sorted(lost.items()))}"
    numbers = {"hand": hand, "risen": risen, "first": first, "there": there, "bodies": found}
    bar = LOW.get(hand, 0.0)
    what = f"{hand}, low bodies near a corner, {o.simulator}"
    row = Row(what, f">= {bar:.0%}", words, risen.value >= bar, numbers)
    print(row, flush=True)
    return row


def lift_body(
    folder: Path, name: str, hand_name: str, seed: int, starts: int, simulator: Simulator
) -> tuple[str, int, int, str]:
    """Plan for a body near a corner, lift it by the best plan and where it lies; return the fields
    of its `Outcome`.
    """
    trial = dataclasses.replace(BASE.trial, simulator=simulator)
    hand = load_hand(hand_name)
    mesh = read_object_mesh(folder, name)
    parts = convex_parts(mesh)
    (view,) = read_entries(folder, (name,))[name].views  # pyright: ignore[reportAttributeAccessIssue]
    cloud = read_view(folder, name, view)
    own = seed_of(seed, name)
    spec = ContactSpec(Distribution.of(trial.friction).mean)
    given = {"task": task_of(trial), "table_friction": trial.table_friction or 0.0}
    plans = [
        plan_edge_grasps(cloud, hand, dataclasses.replace(spec, table=x), starts, own, **given)
        for x in corner(mesh.bounds, own)
    ]
    here = plan_here(cloud, hand, trial, starts, own)
    best = max([*plans, here], key=certain)

    def lift(plan: EdgePlan) -> tuple[int, str]:
        if not plan.grasps.status.eq(Status.OK).any():
            return 0, "no grasp"
        found = lift_from_edge(plan, hand, mesh, trial, own, tries=BASE.tries, parts=parts)
        return tries_to_rise(found, trial), why_lost(found)

    tries, why = lift(best)
    there = tries if best is here else lift(here)[0]
    return "table" if best.drag is None else "edge", tries, there, why


def certain(plan: EdgePlan) -> float:
    """Return the predicted success of a plan in [0, 1]; 0 if it is unknown."""
    return 0.0 if math.isnan(plan.success) else plan.success


def plan_here(cloud: PointCloud, hand: Hand, trial: TrialSpec, starts: int, seed: int) -> EdgePlan:
    """Return grasps of a body where it lies, as an `EdgePlan` without a drag."""
    spec = ContactSpec(Distribution.of(trial.friction).mean, table=0.0)
    grasps = plan_grasps(cloud, hand, spec, starts, seed, task=task_of(trial))
    return EdgePlan(None, grasps, fit_shape(cloud, table=Plane.horizontal(0.0)), "it lies there")


def task_of(trial: TrialSpec) -> GraspTask:
    """Return the planner's task that fits a trial: a lift of the trial's mean mass [kg]."""
    return GraspTask(Distribution.of(trial.mass).mean)


def corner(bounds: np.ndarray, seed: int) -> list[Plane]:
    """Return the table z = 0 twice, with one or the other of the two edges of its corner.

    `seed` draws the direction of the corner. Both edges are 0.1 m (`GAP`) from the body's bounding
    box. `bounds` (2, 3) [m] are the least and the greatest corner of this box.
    """
    turn = float(torch.rand(1, generator=torch.Generator().manual_seed(seed))) * 2 * math.pi
    tables = list[Plane]()
    for angle in (turn, turn + math.pi / 2):
        outward = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
        corners = torch.cartesian_prod(*torch.from_numpy(bounds.T.copy()))
        reach = float((corners @ outward).max())
        tables.append(Plane.horizontal(0.0).ending((reach + GAP) * outward, outward))
    return tables


def tries_to_rise(lift: EdgeLift, trial: TrialSpec) -> int:
    """Return the number of tries of a lift if the last one raised the object, else 0.

    It is raised if it rose by the share `RAISED` of the trial's height of the lift.
    """
    if not lift.tries or lift.tries[-1].result.rise < RAISED * trial.lift_height:
        return 0
    return len(lift.tries)


def why_lost(lift: EdgeLift) -> str:
    """Return the status of the last try of a lift; without a try, that of the drag."""
    if lift.tries:
        return lift.tries[-1].result.status.name
    assert lift.drag is not None
    return f"drag: {lift.drag.status.name}"
