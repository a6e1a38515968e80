"""How many controlled trials a minute one core makes, and what a second process adds."""

import functools
import tempfile
import time
from pathlib import Path

from benchmarks.common import Row, least_seconds
from torchgrasp import ContactSpec, TrialSpec, close_hand, load_grasps, load_hand, load_object, plan_grasps
from torchgrasp.control import ClosingReference, GraspController, no_contact, observe
from torchgrasp.objects import GraspObject
from torchgrasp.pipeline.pool import run_tasks

SIMULATED = 5.0
"""Length of a trial [s]."""

TASKS = 48
"""Trials that the processes share."""


def bench_closing_speed() -> list[Row]:
    """Time trials on the jug of the library with both hands, a tick of the controller, and two processes beside one."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in ("allegro", "barrett"):
            path = Path(folder) / f"{name}.safetensors"
            plan_grasps(load_object("jug").view, load_hand(name), ContactSpec(table=0.0), 100)[0].save(path)
            rows += [_trial_row(name, path), _tick_row(name, path)]
        rows.append(_pool_row(Path(folder) / "allegro.safetensors"))
    return rows


@functools.cache
def _jug() -> GraspObject:
    """Return the object, read and checked once."""
    return load_object("jug")


def close_once(hand: str, path: str, seed: int) -> float:
    """Run one trial and return how long it was [s of the simulator]."""
    jug = _jug()
    return float(close_hand(load_grasps(path), load_hand(hand), jug.mesh, TrialSpec(), seed, parts=jug.parts).time[-1])


def _trial_row(name: str, path: Path) -> Row:
    """Return the rate of controlled trials of `SIMULATED` seconds: hand and scene are made anew for each."""
    length = close_once(name, str(path), 0)
    spent = least_seconds(functools.partial(close_once, name, str(path), 0), 3) * SIMULATED / length
    rate = 60 / spent
    measured = f"{rate:.0f} a minute ({spent:.2f} s each)"
    return Row(
        f"trials of {SIMULATED:g} s, {name}, one core",
        ">= 60 a minute",
        measured,
        rate >= 60,
        {"rate": rate},
    )


def _tick_row(name: str, path: Path) -> Row:
    """Return the time of one tick of the controller, without simulator and sensor."""
    hand, grasp = load_hand(name), load_grasps(path)
    controller = GraspController(ClosingReference.from_grasp(hand, grasp))
    seen = observe(hand, grasp.pregrasp[0], no_contact())

    def close() -> None:
        """Twenty ticks of closing."""
        for _ in range(20):
            controller.time = 0.0
            controller.step(seen, 1 / 250)

    spent = least_seconds(close) / 20
    measured = f"{1e6 * spent:.0f} us"
    return Row(f"a tick of the closing, {name}", "< 4 ms (250 Hz)", measured, spent < 4e-3, {"seconds": spent})


def _pool_row(path: Path) -> Row:
    """Return how much sooner two processes are done with the same trials, by the wall's clock."""
    walls = []
    for workers in (1, 2):
        began = time.perf_counter()
        tasks = [("allegro", str(path), seed) for seed in range(TASKS)]
        list(run_tasks(close_once, tasks, workers, 600.0))
        walls.append(time.perf_counter() - began)
    ratio = walls[0] / walls[1]
    measured = f"{ratio:.2f}x ({TASKS} trials, start of the processes included)"
    return Row("two processes against one", ">= 1.7x on an idle machine", measured, ratio >= 1.7, {"ratio": ratio})
