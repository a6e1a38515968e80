"""The worth of each part of the closing: the same grasps with the same errors, part by part."""

import functools
import time
from pathlib import Path

from benchmarks.common import Row
from torchgrasp import Status, TrialSpec, close_hand, fit_shape, load_hand, plan_grasps
from torchgrasp.datasets import list_views, read_family, read_object_mesh, read_view
from torchgrasp.evaluation import PROTOCOLS, count_by, draw_error, format_share, run_tasks, seed_of, share_over
from torchgrasp.evaluation.campaign import choose_rows
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec

PARTS = {
    "open-loop squeeze": (TrialSpec(closing="open_loop"), False),
    "position controller, stops at 0.5 N, then the squeeze": (TrialSpec(closing="position"), False),
    "fixed gains": (TrialSpec(closing="fixed"), False),
    "uncertainty-weighted": (TrialSpec(), False),
    "+ belief update": (TrialSpec(), True),
    "+ belief update + impedance hold": (TrialSpec(holding="impedance"), True),
    "uncertainty-weighted + impedance hold": (TrialSpec(holding="impedance"), False),
}
"""Trials and whether touches revise the shape; each row differs from one above it by one part."""

PAPER = PROTOCOLS["paper"]

LIMIT = 3600.0
"""Wall time [s] for one view and hand."""


def bench_ablation(objects: Path, tries: int, starts: int, seed: int, workers: int) -> list[Row]:
    """Close and lift `tries` grasps of every view with both hands in every way, the object beside its place."""
    tasks = [
        (objects, name, view, hand, tries, starts, seed)
        for hand in ("allegro", "barrett")
        for name, view in list_views(objects)
    ]
    cases = []
    for task, outcome in zip(tasks, run_tasks(_close_view, tasks, workers, LIMIT), strict=True):
        if isinstance(outcome, Status):
            raise SystemExit(f"{task[1]} {task[2]} {task[3]}: {outcome.sentence}")
        cases += [(task[3], *case, read_family(objects, task[1])) for case in outcome]
    return [_row(part, [case for case in cases if case[1] == part]) for part in PARTS]


def _row(part: str, cases: list[tuple[str, str, str, float, float, str]]) -> Row:
    """Return the share that held, of all and of each hand, how far the object moved, and the CPU time."""
    groups = {"all": cases} | {hand: [c for c in cases if c[0] == hand] for hand in ("allegro", "barrett")}
    shares = {name: share_over(count_by((c[5], c[2] == "OK") for c in group)) for name, group in groups.items()}
    moved = sorted(case[3] for case in cases if case[2] == "OK")
    middle = moved[len(moved) // 2] if moved else float("nan")
    lost = {status: sum(c[2] == status for c in cases) for status in sorted({c[2] for c in cases} - {"OK"})}
    words = "; ".join(f"{n} {format_share(s)}" for n, s in shares.items())
    seconds = sum(case[4] for case in cases) / max(len(cases), 1)
    measured = f"{words}; moved {1e3 * middle:.1f} mm (median of the held); {seconds:.2f} CPU s; lost {lost}"
    numbers = {"shares": shares, "moved_mm": 1e3 * middle, "lost": lost, "seconds": seconds}
    return Row(f"held, {part}", "-", measured, None, numbers)


def _close_view(
    objects: Path, name: str, view: str, hand_name: str, tries: int, starts: int, seed: int
) -> list[tuple[str, str, float, float]]:
    """Return part, status, motion in the hand [m] and CPU time [s] of every trial of one view and hand."""
    hand, cloud = load_hand(hand_name), read_view(objects, name, view)
    shape = fit_shape(cloud, seed=seed, table=0.0)
    grasps = plan_grasps(cloud, hand, ContactSpec(friction=PAPER.trial.friction, table=0.0), starts, seed, shape=shape)
    grasps = grasps[grasps.status == Status.OK]
    mesh = read_object_mesh(objects, name)
    close = functools.partial(close_hand, hand=hand, mesh=mesh, parts=convex_parts(mesh))
    cases = []
    for row in choose_rows(len(grasps), tries, "spread"):
        error = draw_error(PAPER, grasps[row], mesh, seed_of(seed, name, view, row, 0))
        for part, (spec, revises) in PARTS.items():
            belief = shape if revises else None
            began = time.process_time()
            result = close(grasps[row], spec=spec, seed=seed, error=error, belief=belief)
            cases.append((part, result.status.name, result.object_motion.distance, time.process_time() - began))
    return cases
