"""How many controlled trials a minute one core makes, and how long a step of the controller takes."""

import functools
import gc
import os
import statistics
import time
from collections.abc import Callable
from unittest import mock

from benchmarks.common import Options, Row, bench, least_seconds
from torchgrasp import GraspController, TrialSpec, close_hand, fit_shape, load_hand, load_object
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.evaluation import GraspTrial, Truth
from torchgrasp.evaluation.trial import TrialDriver
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.shape.surface import surface_field

STEPS = 100_000
"""Steps of the controller that are timed."""


@bench("close/speed")
def speed(o: Options) -> list[Row]:
    """Time trials of the shipped grasps of the jug, and steps of the controller."""
    return [row for name in o.hands for row in (_trial_row(name), _step_row(name, o.times(STEPS)))]


def _trial_row(name: str) -> Row:
    """Return the rate of controlled trials of 5 seconds: hand and scene are made anew for each."""
    jug = load_object("jug")
    hand = load_hand(name)
    grasp = load_shipped_grasp("jug", name)
    closed = functools.partial(close_hand, grasp, hand, jug.mesh, parts=jug.parts)
    spent = least_seconds(closed, 3) * 5.0 / float(closed().time[-1])
    rate = 60 / spent
    measured = f"{60 / spent:.0f} a minute ({spent:.2f} s each)"
    return Row(
        f"trials of 5 s, {name}, one core", ">= 60 a minute", measured, rate >= 60, {"rate": rate}
    )


def _step_row(name: str, steps: int) -> Row:
    """Return the row of a step, timed in a process of its own: glibc reads its environment when a
    process starts.

    The setting is that of docs/closing.md: glibc else puts off the merging of freed blocks until
    some tick.
    """
    with mock.patch.dict(os.environ, {"GLIBC_TUNABLES": "glibc.malloc.mxfast=0"}):
        (found,) = run_tasks(time_steps, [(name, steps)], 1, 1200.0)
    if isinstance(found, Status):
        raise SystemExit(f"steps of the {name} hand: {found.sentence}")
    return found


def time_steps(name: str, steps: int) -> Row:
    """Return the time of one step of the controller, by the processor's clock: of a trial's ticks,
    again and again.

    A loop of plain arithmetic, as long as the median step, has a worst of its own on the same
    computer. The median of a tick over all trials tells whether that tick is slow each time.
    """
    jug = load_object("jug")
    surface = surface_field(
        fit_shape(jug.view, table=0.0)
    )  # so that some ticks search for the object
    trial = GraspTrial(
        load_hand(name),
        load_shipped_grasp("jug", name),
        Truth(jug.mesh, jug.parts),
        surface=surface,
    )
    driver = TrialDriver(trial, TrialSpec(approach=0.0, holding="grip"))
    run = driver.open()
    ticks = [run.observation for _ in run.close()]
    for _ in range(100):  # it holds for a second
        run.step()
        ticks.append(run.observation)
    collection = _seconds(gc.collect)
    # as docs/closing.md tells who drives a robot: else such a collection falls into some tick
    gc.freeze()
    trials = []
    while len(trials) * len(ticks) < steps:
        controller = GraspController(driver.reference, holding="grip")
        trials.append(
            [_seconds(functools.partial(controller.step, seen, 1 / 100)) for seen in ticks]
        )
    gc.unfreeze()
    spent = sorted(x for one in trials for x in one)
    median = spent[len(spent) // 2]
    late = spent[int(0.9999 * len(spent))]
    worst = spent[-1]
    slowest = max(statistics.median(tick) for tick in zip(*trials, strict=True))
    loop = _worst_of_a_loop(median, len(spent))
    numbers = {
        "median": median,
        "late": late,
        "worst": worst,
        "loop": loop,
        "slowest_tick": slowest,
    }
    numbers = {name: 1e3 * value for name, value in (numbers | {"collection": collection}).items()}
    measured = (
        "median {median:.2f} ms, 1 of 10^4 above {late:.2f} ms, worst {worst:.2f} ms (of a loop as long {loop:.2f} ms);"
        " the slowest tick's median {slowest_tick:.2f} ms; a collection of garbage {collection:.0f} ms"
    ).format_map(numbers)
    what = f"a step of closing and grip, {name}, {len(spent)} steps"
    return Row(
        what, "<= 1 ms median, 2 ms worst", measured, median <= 1e-3 and worst <= 2e-3, numbers
    )


def _seconds(call: Callable[[], object]) -> float:
    """Return how long a call took this thread [s]."""
    began = time.thread_time_ns()
    call()
    return 1e-9 * (time.thread_time_ns() - began)


def _worst_of_a_loop(median: float, times: int) -> float:
    """Return the longest time [s] of a loop that mostly takes a given one."""

    def count(rounds: int) -> int:
        return sum(i * i for i in range(rounds))

    typical = statistics.median(_seconds(lambda: count(10_000)) for _ in range(100))
    rounds = round(10_000 * median / typical)
    return max(_seconds(lambda: count(rounds)) for _ in range(times))
