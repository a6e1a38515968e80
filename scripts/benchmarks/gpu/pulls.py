"""Six-way pulls in MuJoCo Warp beside MuJoCo on the CPU: trials a second, and how many verdicts are
the same.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from golden import OBJECTS, see

from benchmarks.common import Options, Row, bench
from benchmarks.gpu.warp_pulls import pull_drivers
from torchgrasp import ContactSpec, Status, load_hand, load_object, plan_grasps
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, PullResult, Truth, pull_grasp
from torchgrasp.evaluation.protocols import POSE_NOISE, draw_hand_errors, seed_of
from torchgrasp.evaluation.pull import DIRECTIONS, INTERVAL
from torchgrasp.evaluation.trial import TrialDriver
from torchgrasp.foundation.jobs import run_tasks

CASES = {
    f"{name}{', pose error' if error else ''}": (
        PROTOCOLS[name].with_trial(simulator="mujoco"),
        error,
    )
    for name in ("dexgraspbench", "dexgraspbench-hard")
    for error in (False, True)
}
"""The protocol of every fourth trial, and whether the hand's pose has a random error."""

PULL = PROTOCOLS["dexgraspbench"].pull  # of all cases
VIEWS = 32  # on which grasps are planned: each of the shipped objects from eight sides
LIMIT = 600.0  # longest time [s] of the trials of one view


class Tried(NamedTuple):
    """A trial, the name of its case, and its result in MuJoCo on the CPU."""

    trial: GraspTrial
    case: str
    result: PullResult


@bench("gpu/pulls")
def pull_all(o: Options) -> list[Row]:
    """Pull at 1000 grasps times the scale at once, on a GPU if there is one, and at each alone on
    the CPU's cores.
    """
    views = min(VIEWS, o.times(1000))
    tasks = [(k, o.hands[0], o.times(1000) // views, o.starts, o.seed) for k in range(views)]
    lists = run_tasks(try_view, tasks, o.workers, LIMIT)
    tried, spent = clocked(
        lambda: [x for found in lists if not isinstance(found, Status) for x in found]
    )
    print(f"{len(tried)} trials planned and tried on the CPU in {spent:.1f} s", flush=True)
    drivers, built = clocked(lambda: make_drivers(tried, o.hands[0]))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    short = dataclasses.replace(PULL, seconds=INTERVAL)
    _, first = clocked(lambda: pull_drivers(drivers, short, device))  # compiles the kernels
    print(f"closing plans {built:.1f} s, a first short run on {device} {first:.1f} s", flush=True)
    here, spent = clocked(lambda: pull_drivers(drivers, PULL, device))
    rates = {
        "device": len(here) / spent,
        "with closing plans": len(here) / (spent + built),
        "cpu": len(here) * max(1, o.workers) / sum(x.result.seconds for x in tried),
    }
    text = (
        f"{rates['device']:.0f} trials a second on {device}, {rates['with closing plans']:.0f} with the closing plans, "
        f"{rates['cpu']:.1f} in MuJoCo on {max(1, o.workers)} cores"
    )
    numbers = {"trials": len(here), "seconds": [first, spent, built], **rates}
    fast = rates["device"] >= 100 if device == "cuda" else None
    speed = Row(f"{len(here)} six-way pulls", ">= 100 a second", text, fast, numbers)
    return [speed, *(same_row(case, tried, here) for case in ("all", *CASES))]


def clocked(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a function, and the wall time [s] that it took."""
    began = time.perf_counter()
    return function(), time.perf_counter() - began


def make_drivers(tried: list[Tried], hand: str) -> list[TrialDriver]:
    """Return the drivers of the trials, which share one hand."""
    shared = load_hand(hand)
    return [
        TrialDriver(dataclasses.replace(x.trial, hand=shared), CASES[x.case][0].trial)
        for x in tried
    ]


def try_view(k: int, hand: str, count: int, starts: int, seed: int) -> list[Tried]:
    """Plan grasps on view k, and try some of them, spread over all ranks, in MuJoCo on the CPU."""
    loaded = load_hand(hand)
    name = OBJECTS[k % len(OBJECTS)]
    names = list(CASES)
    shipped = load_object(name)
    grasps = plan_grasps(
        see(name, k // len(OBJECTS)), loaded, ContactSpec(friction=0.8, table=0.0), starts
    )
    ranks = torch.nonzero(grasps.status == Status.OK)[:, 0].tolist()
    errors = draw_hand_errors(POSE_NOISE, count, seed_of(seed, "pulls", k))
    tried = list[Tried]()
    for j in range(count if ranks else 0):
        case = names[(j + k) % len(names)]
        rank = ranks[j * len(ranks) // count]
        protocol, erring = CASES[case]
        truth = Truth(shipped.mesh, shipped.parts, errors[j] if erring else None)
        trial = GraspTrial(loaded, grasps[rank : rank + 1], truth)
        tried.append(Tried(trial, case, pull_grasp(trial, protocol)))
    return tried


def same_row(case: str, tried: list[Tried], here: list[PullResult]) -> Row:
    """Return the row that compares the trials of a case: verdict, status and the end of single
    pulls.
    """
    pairs = [
        (x.result, found) for x, found in zip(tried, here, strict=True) if case in ("all", x.case)
    ]
    same, status = (
        sum(getattr(one, x) == getattr(two, x) for one, two in pairs) for x in ("passed", "status")
    )
    ends = [(held(one, d), held(two, d)) for one, two in pairs for d in range(len(DIRECTIONS))]
    ends = [pair for pair in ends if None not in pair]
    equal = sum(one == two for one, two in ends)
    passed = [sum(pair[k].passed for pair in pairs) for k in (0, 1)]
    text = (
        f"verdict of {same} of {len(pairs)}, status of {status}; the end of {equal} of {len(ends)} single pulls; "
        f"{passed[0]} pass on the CPU, {passed[1]} here"
    )
    numbers = {
        "trials": len(pairs),
        "same": same,
        "status": status,
        "pulls": [equal, len(ends)],
        "passed": passed,
    }
    bar, met = (
        (">= 97 % of the verdicts", same >= 0.97 * len(pairs)) if case == "all" else ("-", None)
    )
    return Row(f"the same as in MuJoCo on the CPU: {case}", bar, text, met, numbers)


def held(result: PullResult, direction: int) -> bool | None:
    """Return whether the object stayed in the hand in a direction; None if the direction was not
    tried.
    """
    if result.status in (Status.START_OVERLAP, Status.EJECTED) or direction >= result.directions:
        return None
    return result.passed or direction < result.directions - 1
