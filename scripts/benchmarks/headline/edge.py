"""Lifts of low bodies near a corner of their table: the hand may drag them to one of its two edges.

Of the grasps where a body lies, and of those at either edge, those with the highest predicted
success are used. The corner is turned at random against body and camera.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
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
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
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


@bench("headline/edge")
def edge(o: Options) -> list[Row]:
    """Lift authored bodies that are 8 to 16 mm high, 0.1 m from a corner of their table."""
    count = o.times(LOW_BODIES)
    folder = o.out / f"edge_{count}"
    if not (folder / "manifest.json").is_file():
        household(folder, count, FIRST, HIGHEST)
    return [_tried(o, folder, hand, bar) for hand, bar in LOW.items()]


def _tried(o: Options, folder: Path, hand: str, bar: float) -> Row:
    """Return the row of one hand."""
    entries = {k: x for k, x in read_entries(folder).items() if isinstance(x, ObjectEntry)}
    tasks = [(folder, name, hand, o.seed, o.starts, o.simulator) for name in entries]
    found = dict(zip(entries, run_all(lift_body, tasks, o.workers, LIMIT), strict=True))
    unit = {name: entry.family for name, entry in entries.items()}
    risen = share_over(count_by((unit[k], tries > 0) for k, (_, tries, _, _) in found.items()))
    first = share_over(count_by((unit[k], tries == 1) for k, (_, tries, _, _) in found.items()))
    dragged = sum(where == "edge" for where, _, _, _ in found.values())
    lost = {k: why for k, (_, tries, why, _) in found.items() if not tries}
    words = f"up to three grasps {format_share(risen)}; the first {format_share(first)}; "
    words += f"{dragged} of {len(found)} dragged to an edge"
    if lost:
        words += f"; lost {', '.join(f'{k} ({why})' for k, why in sorted(lost.items()))}"
    numbers = {"hand": hand, "risen": risen, "first": first, "bodies": found}
    what = f"{hand}, low bodies near a corner, {o.simulator}"
    row = Row(what, f">= {bar:.0%}", words, risen.value >= bar, numbers)
    print(row, flush=True)
    return row


def lift_body(
    folder: Path, name: str, hand_name: str, seed: int, starts: int, simulator: Simulator
) -> tuple[str, int, str, float]:
    """Return where a body is grasped ("edge" or "table"), the number of tries that raised it (0 for
    none), why it was lost, and the predicted success.
    """
    trial = dataclasses.replace(BASE.trial, simulator=simulator)
    hand = load_hand(hand_name)
    mesh = read_object_mesh(folder, name)
    (view,) = read_entries(folder, (name,))[name].views  # pyright: ignore[reportAttributeAccessIssue]
    cloud = read_view(folder, name, view)
    own = seed_of(seed, name)
    plans = [plan_here(cloud, hand, trial, starts, own)]
    plans += [
        plan_edge_grasps(
            cloud,
            hand,
            ContactSpec(Distribution.of(trial.friction).mean, table=table),
            starts,
            own,
            task=task_of(trial),
            table_friction=trial.table_friction or 0.0,
        )
        for table in corner(mesh.bounds, own)
    ]
    best = max(plans, key=lambda plan: plan.success)
    where = "table" if best.drag is None else "edge"
    if not best.grasps.status.eq(Status.OK).any():
        return where, 0, "no grasp", math.nan
    lift = lift_from_edge(best, hand, mesh, trial, own, tries=BASE.tries, parts=convex_parts(mesh))
    return where, tries_to_rise(lift, trial), why_lost(lift), best.success


def plan_here(cloud: PointCloud, hand: Hand, trial: TrialSpec, starts: int, seed: int) -> EdgePlan:
    """Return the grasps of a body where it lies, as a plan without a drag."""
    spec = ContactSpec(Distribution.of(trial.friction).mean, table=0.0)
    grasps = plan_grasps(cloud, hand, spec, starts, seed, task=task_of(trial))
    return EdgePlan(None, grasps, fit_shape(cloud, table=Plane.horizontal(0.0)), "it lies there")


def task_of(trial: TrialSpec) -> GraspTask:
    """Return the task: a lift of the trial's mass."""
    return GraspTask(Distribution.of(trial.mass).mean)


def corner(bounds: np.ndarray, seed: int) -> list[Plane]:
    """Return the table with either edge of its corner, which is turned at random.

    Both edges are at the same distance [m] from the body, whose axis-parallel `bounds` (2, 3) [m]
    are given.
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
    """Return the number of tries if the last one raised the object; else 0."""
    if not lift.tries or lift.tries[-1].result.rise < RAISED * trial.lift_height:
        return 0
    return len(lift.tries)


def why_lost(lift: EdgeLift) -> str:
    """Return the status of the last trial."""
    if lift.tries:
        return lift.tries[-1].result.status.name
    assert lift.drag is not None
    return f"drag: {lift.drag.status.name}"
