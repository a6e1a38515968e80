"""Memory, open files and threads over many plans and trials in one process; the memory of large
inputs.
"""

import gc
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench, peak_mib
from torchgrasp import (
    ContactSpec,
    PointCloud,
    TrialSpec,
    close_hand,
    fit_shape,
    list_objects,
    load_hand,
    load_object,
    plan_contacts,
    plan_grasps,
)
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.linalg import unit

SPEC = ContactSpec(table=0.0)
STARTS = 16
"""Of a plan that is repeated: one wave, since three take half as long again and hold the same
things.
"""
TRIAL = {
    "approach": 0.02,
    "lift_height": 0.05,
    "hold_time": 0.1,
    "timestep": 1 / 250,
    "control_rate": 50.0,
}
"""Of a trial that is repeated: the whole chain in a third of the usual ticks."""
WARM = 0.2
"""Share of the calls after which memory must no longer grow: pools and caches have filled."""
CHECKS = 0.01
"""Bar: share of a plan's time that the check of arguments takes."""
GROWTH = 0.05
"""Bar: growth of the resident memory from then to the end, by a line through all readings."""


@bench("load/plans")
def plans(o: Options) -> list[Row]:
    """Plan again and again in one process."""
    hand = o.hands[0]
    n = o.times(500)
    model = load_hand(hand)
    views = [load_object(name).view for name in list_objects()]
    return [
        _repeated(
            "plans", n, lambda k: plan_grasps(views[k % len(views)], model, SPEC, STARTS, seed=k)
        )
    ]


@bench("load/trials")
def trials(o: Options) -> list[Row]:
    """Close and lift again and again in one process."""
    hand = o.hands[0]
    n = o.times(2000)
    simulator = o.simulator
    model = load_hand(hand)
    jug = load_object("jug")
    grasps = plan_grasps(jug.view, model, SPEC, STARTS)
    grasps = grasps[grasps.status == Status.OK]
    spec = TrialSpec(simulator=simulator, **TRIAL)

    def once(k: int) -> object:
        return close_hand(grasps[k % len(grasps)], model, jug.mesh, spec, seed=k, parts=jug.parts)

    return [_repeated(f"trials in {simulator}", n, once)]


def _repeated(what: str, n: int, once: Callable[[int], object]) -> Row:
    """Call n times; read memory, open files and threads 50 times."""
    read: list[tuple[int, float, int, int]] = []
    began = time.process_time()
    for k in range(n):
        once(k)
        if (k + 1) % max(n // 50, 1) == 0:
            gc.collect()
            read.append((k + 1, resident_mib(), _count("fd"), _count("task")))
    warm = [row for row in read if row[0] >= WARM * n]
    calls = np.array([row[0] for row in warm])
    memory = np.array([row[1] for row in warm])
    slope = float(np.polyfit(calls, memory, 1)[0])
    growth = slope * (n - WARM * n) / memory[0]
    more = [warm[-1][i] - warm[0][i] for i in (2, 3)]
    seconds = (time.process_time() - began) / n
    measured = (
        f"{memory[0]:.0f} MiB after {WARM:.0%}, then {growth:+.1%} ({1024 * slope:+.1f} KiB a call),"
        f" {more[0]:+d} files, {more[1]:+d} threads; {seconds:.2f} s each"
    )
    numbers = {
        "read": read,
        "slope_kib": 1024 * slope,
        "growth": growth,
        "files": more[0],
        "threads": more[1],
    }
    sound = growth <= GROWTH and more == [0, 0]
    return Row(
        f"{n} {what} in one process",
        f"at most +{GROWTH:.0%}, no file, no thread",
        measured,
        sound,
        numbers,
    )


@bench("load/points")
def points(o: Options) -> list[Row]:
    """Plan on one cloud of many points, beside one of 1 % of them."""
    hand = o.hands[0]
    n = max(100_000, o.times(2_000_000))
    model = load_hand(hand)
    rows = []
    for count in (n // 100, n):
        cloud = _egg(count)
        rows.append(
            _peak(
                f"a cloud of {len(cloud):,} points",
                lambda: plan_grasps(cloud, model, SPEC, STARTS),  # noqa: B023
            )
        )
    return rows


@bench("load/starts")
def starts(o: Options) -> list[Row]:
    """Plan contacts from many starts at once, beside 1 % of them."""
    n = max(100, o.times(100_000))
    shape = fit_shape(load_object("jug").view, table=0.0)
    return [
        _peak(f"{count:,} starts", lambda: plan_contacts(shape, SPEC, starts=count))  # noqa: B023
        for count in (n // 100, n)
    ]


def _peak(what: str, action: Callable[[], object]) -> Row:
    """Call once; return time, and the memory that it took at most."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = resident_mib()
    began = time.process_time()
    action()
    seconds = time.process_time() - began
    most = (peak_mib() or 0.0) - before
    return Row(
        what, "-", f"{seconds:.1f} s, {most:.0f} MiB more", None, {"seconds": seconds, "mib": most}
    )


def _egg(n: int) -> PointCloud:
    """One side of an ellipsoid of 60 x 60 x 120 mm on the table, from a camera 0.5 m away, noise
    0.5 mm.
    """
    generator = torch.Generator().manual_seed(0)

    def draw() -> Tensor:
        return torch.randn(2 * n, 3, generator=generator, dtype=torch.float64)

    axes = torch.tensor([0.03, 0.03, 0.06]).double()
    eye = torch.tensor([0.5, 0.0, 0.3]).double()
    on = unit(draw())
    points = on * axes + torch.tensor([0.0, 0.0, 0.06]).double()
    seen = (on / axes * (eye - points)).sum(1) > 0
    return PointCloud((points + 5e-4 * draw())[seen], None, eye)


def resident_mib() -> float:
    """Return the resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _count(what: str) -> int:
    """Count open files ("fd") or threads ("task") of this process."""
    return len(os.listdir(f"/proc/self/{what}"))
