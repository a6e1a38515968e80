"""Two cores: many clouds in one call on two processes, and one plan on two threads."""

import resource
import time
from statistics import median

import torch

from benchmarks.common import Row
from torchgrasp import ContactSpec, Hand, PointCloud, plan_grasps

FEW, LONG, CROWD = 1.7, 1.5, 100
"""Bars of few clouds and of a hundred or more."""


def _used() -> float:
    """Return the processor seconds of this process and of its ended workers."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def bench_many(clouds: list[PointCloud], hand: Hand, spec: ContactSpec, starts: int) -> list[Row]:
    """Measure one call of many clouds on two processes beside the loop, by the wall clock and by the processor's."""
    began, used = time.monotonic(), _used()
    alone = [plan_grasps(cloud, hand, spec, starts) for cloud in clouds]
    loop, alone_used = time.monotonic() - began, _used() - used
    began, used = time.monotonic(), _used()
    together = plan_grasps(clouds, hand, spec, starts, workers=2)
    call, workers_used = time.monotonic() - began, _used() - used
    least = FEW if len(clouds) < CROWD else LONG
    equal = all(torch.equal(a.joints, b.joints) for a, b in zip(alone, together, strict=True))
    return [
        Row(
            f"{len(clouds)} clouds in one call, two processes; wall clock of a machine with two free cores",
            f">= {least} times the loop, equal grasps",
            f"{loop / call:.2f} times ({loop:.1f} and {call:.1f} s), {'equal' if equal else 'OTHER'} grasps; "
            f"by the processor {2 * alone_used / workers_used:.2f} times ({alone_used:.1f} s, and twice half of "
            f"{workers_used:.1f} s with the start of both)",
            loop / call >= least and equal,
            {"loop": loop, "call": call, "loop_processor": alone_used, "workers_processor": workers_used},
        )
    ]


def bench_threads(clouds: list[PointCloud], hand: Hand, spec: ContactSpec, starts: int) -> list[Row]:
    """Measure one plan after the other on one thread and on two, by the wall clock."""

    def seconds(cloud: PointCloud, threads: int) -> float:
        torch.set_num_threads(threads)
        began = time.monotonic()
        plan_grasps(cloud, hand, spec, starts)
        return time.monotonic() - began

    ratios = [seconds(cloud, 1) / seconds(cloud, 2) for cloud in clouds]
    torch.set_num_threads(1)
    return [
        Row(
            f"one plan on two threads, {len(clouds)} clouds; wall clock of a machine with two free cores",
            "none: the batches are small",
            f"median {median(ratios):.2f} times as fast as on one",
            None,
            {"ratios": ratios},
        )
    ]
