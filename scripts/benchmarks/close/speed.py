"""How many controlled trials a minute one core makes, and what a second process adds."""

import functools
import gc
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

from benchmarks.common import Options, Row, bench, least_seconds
from torchgrasp import ContactSpec, TrialSpec, close_hand, fit_shape, load_grasps, load_hand, load_object, plan_grasps
from torchgrasp.control import GraspController, Observation
from torchgrasp.data.shipped import GraspObject
from torchgrasp.errors import Status
from torchgrasp.evaluation import GraspTrial
from torchgrasp.evaluation.trial import TrialDriver
from torchgrasp.jobs import run_tasks
from torchgrasp.shape.surface import surface_field

SIMULATED = 5.0
"""Length of a trial [s]."""

STEPS, HELD_TICKS = 100_000, 100
"""Steps of the controller that are timed, and ticks of a trial after its closing."""

MEDIAN_STEP, WORST_STEP = 1e-3, 2e-3
"""The project's bars [s]."""

TASKS = 48
"""Trials that the processes share."""

ALLOCATOR = {"GLIBC_TUNABLES": "glibc.malloc.mxfast=0"}
"""What the environment of a robot's process has, as docs/closing.md tells: glibc else puts off the merging of freed
blocks until some tick asks for a large one, and that tick takes milliseconds longer."""

STEPPING = 1200.0
"""Longest time [s] in which steps are timed."""


@bench("close/speed")
def speed(o: Options) -> list[Row]:
    """Time trials on the jug of the library with both hands, steps of the controller, and two processes beside one."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in o.hands:
            path = Path(folder) / f"{name}.safetensors"
            plan_grasps(load_object("jug").view, load_hand(name), ContactSpec(table=0.0), 100)[0].save(path)
            rows += [_trial_row(name, path), _step_row(name, path, o.times(STEPS))]
        rows.append(_pool_row(o.hands[0], Path(folder) / f"{o.hands[0]}.safetensors", o.times(TASKS)))
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


def _step_row(name: str, path: Path, steps: int) -> Row:
    """Return the row of a step, timed in a process of its own: a process reads `ALLOCATOR` when it starts."""
    with mock.patch.dict(os.environ, ALLOCATOR):
        (found,) = run_tasks(time_steps, [(name, str(path), steps)], 1, STEPPING)
    if isinstance(found, Status):
        raise SystemExit(f"steps of the {name} hand: {found.sentence}")
    return found


def time_steps(name: str, path: str, steps: int) -> Row:
    """Return the time of one step of the controller, by the processor's clock: of a trial's ticks, again and again.

    A loop of plain arithmetic, as long as the median step, has a worst of its own on the same computer. The median of
    a tick over all trials tells whether that tick is slow each time.
    """
    jug = _jug()
    surface = surface_field(fit_shape(jug.view, table=0.0))  # so that some ticks search for the object
    trial = GraspTrial(load_hand(name), load_grasps(path), jug.mesh, parts=jug.parts, surface=surface)
    driver = TrialDriver(trial, TrialSpec(approach=0.0, holding="grip"))
    ticks = _ticks(driver)
    collection = _seconds(gc.collect)
    gc.freeze()  # as docs/closing.md tells who drives a robot: else such a collection falls into some tick
    trials = []
    while len(trials) * len(ticks) < steps:
        controller = GraspController(driver.reference, holding="grip")
        trials.append([_seconds(functools.partial(controller.step, seen, 1 / 100)) for seen in ticks])
    gc.unfreeze()
    spent = sorted(x for one in trials for x in one)
    median, late, worst = spent[len(spent) // 2], spent[int(0.9999 * len(spent))], spent[-1]
    slowest = max(statistics.median(tick) for tick in zip(*trials, strict=True))
    loop = _worst_of_a_loop(median, len(spent))
    measured = (
        f"median {1e3 * median:.2f} ms, 1 of 10^4 above {1e3 * late:.2f} ms, worst of {len(spent)} "
        f"{1e3 * worst:.2f} ms (of a loop as long {1e3 * loop:.2f} ms); "
        f"the slowest tick's median {1e3 * slowest:.2f} ms; a collection of garbage {1e3 * collection:.0f} ms"
    )
    met = median <= MEDIAN_STEP and worst <= WORST_STEP
    numbers = {"median": median, "late": late, "worst": worst, "steps": len(spent), "loop": loop}
    numbers |= {"slowest_tick": slowest, "collection": collection}
    return Row(f"a step of closing and grip, {name}", "<= 1 ms median, 2 ms worst", measured, met, numbers)


def _seconds(call: Callable[[], object]) -> float:
    """Return how long a call took this thread [s]."""
    began = time.thread_time_ns()
    call()
    return 1e-9 * (time.thread_time_ns() - began)


def _worst_of_a_loop(median: float, times: int) -> float:
    """Return the longest time [s] of a loop that mostly takes a given one."""
    tried = 10_000
    typical = statistics.median(_seconds(functools.partial(_count, tried)) for _ in range(100))
    count = functools.partial(_count, round(tried * median / typical))
    return max(_seconds(count) for _ in range(times))


def _count(rounds: int) -> int:
    """Add up some squares."""
    return sum(i * i for i in range(rounds))


def _ticks(driver: TrialDriver) -> list[Observation]:
    """Return what is observed while a hand closes and then holds for a while."""
    run = driver.open()
    seen = [run.observation for _ in run.close()]
    for _ in range(HELD_TICKS):
        run.step()
        seen.append(run.observation)
    return seen


def _pool_row(hand: str, path: Path, count: int) -> Row:
    """Return how much sooner two processes are done with the same trials, by the wall's clock."""
    walls = []
    for workers in (1, 2):
        began = time.perf_counter()
        tasks = [(hand, str(path), seed) for seed in range(count)]
        list(run_tasks(close_once, tasks, workers, 600.0))
        walls.append(time.perf_counter() - began)
    ratio = walls[0] / walls[1]
    measured = f"{ratio:.2f}x ({count} trials, start of the processes included)"
    return Row("two processes against one", ">= 1.7x on an idle machine", measured, ratio >= 1.7, {"ratio": ratio})
