"""Plans of many clouds at once beside plans of each alone: the same grasps, and how many a second."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench, timed
from benchmarks.gpu.launches import views
from torchgrasp import ContactSpec, Grasps, PointCloud, Status, load_hand, plan_grasps
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.jobs import pack, run_tasks, unpack
from torchgrasp.planner.many import estimate_shapes, plan_stacks
from torchgrasp.planner.objects import Objects
from torchgrasp.planner.request import Request

SAME = 1e-6
"""Largest difference of joints [rad] and poses [m, 1] of the same grasp."""
SPEC = ContactSpec(friction=0.8, table=0.0)
POINTS = 1000
"""Points of a cloud: as many as the planner takes of the target of a scene."""


@bench("gpu/clouds")
def plan_clouds(o: Options) -> list[Row]:
    """Plan batches of clouds at once, on a GPU if there is one. Plan the smallest batch also on the
    cores of the CPU.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    hand = load_hand(o.hands[0])
    workers = max(o.workers, 1)
    packed = run_tasks(see_view, [(k,) for k in range(max(o.batches))], workers, 600.0)
    seen: list[PointCloud] = [unpack(x) for x in packed]
    requests = [Request(cloud, hand, SPEC, o.starts) for cloud in seen]
    objects, shaped = timed(lambda: list(estimate_shapes(requests, workers)), time.perf_counter)
    what = f"shapes of {len(seen)} clouds, {workers} processes"
    rows = [Row(what, "-", f"{shaped:.1f} s", numbers={"s": shaped})]
    plan_at_once(requests[:2], objects[:2], device)  # what a process keeps is made before
    call = partial(plan_grasps, hand=hand, spec=SPEC, starts=o.starts, workers=workers)
    for count in sorted(o.batches):
        what = f"{count} clouds of {POINTS} points, {hand.name}, {o.starts} starts"
        there = [cloud.to(device) for cloud in seen[:count]]
        known = partial(plan_at_once, requests[:count], objects[:count], device)
        row, found = measure(f"{what}: at once, with known shapes", known)
        rows += [row, measure(f"{what}: a whole call", partial(call, there))[0]]
        if count == min(o.batches):
            row, alone = measure(f"{what}: a whole call on the CPU", partial(call, seen[:count]))
            rows += [row, compare(f"{what}: at once beside each alone on the CPU", alone, found)]
        print(*rows, sep="\n", flush=True)
    return rows


def see_view(k: int) -> Any:
    """Return view k of the shipped objects with few points (`POINTS`), packed for a process."""
    torch.set_num_threads(1)
    cloud = views(1, k)[0]
    mixed = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(k))
    return pack(cloud.select(mixed[:POINTS].sort().values))


@checked
def plan_at_once(
    requests: list[Request], objects: list[Objects | Grasps], device: torch.device
) -> list[Grasps]:
    """Plan grasps of several objects at once on a device, and return those of each request.

    `objects` holds for each request the estimated shapes, or grasps that say why there are none.
    """
    return list(plan_stacks(requests, iter(objects), device))


def measure(what: str, plan: Callable[[], list[Grasps]]) -> tuple[Row, list[Grasps]]:
    """Run a plan of many clouds, and return (row, grasps).

    The row `what` has the rate of executable grasps, the time and the memory on the GPU.
    """
    cuda = torch.cuda.is_available()
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    found, seconds = timed(plan, time.perf_counter)
    memory = torch.cuda.max_memory_allocated() / 2**30 if cuda else 0.0
    rate = sum(int((grasps.status == Status.OK).sum()) for grasps in found) / seconds
    text = f"{rate:.0f} executable a second; {seconds:.2f} s, {memory:.1f} GiB on the GPU"
    return Row(what, "-", text, None, {"seconds": seconds, "rate": rate, "memory": memory}), found


def compare(what: str, alone: list[Grasps], together: list[Grasps]) -> Row:
    """Return a row that compares grasps planned for each cloud alone with those planned together.

    It counts the grasps with the same status, and those with the same joints and pose.
    """
    pairs = [(one, other.to("cpu")) for one, other in zip(alone, together, strict=True)]
    every = sum(len(one) for one, _ in pairs)
    status = sum(
        int((one.status == other.status).sum()) for one, other in pairs if len(one) == len(other)
    )
    same = sum(
        int((torch.cdist(numbers(one), numbers(other), p=torch.inf).amin(1) < SAME).sum())
        for one, other in pairs
    )
    text = f"status in {status} of {every} rows, joints and pose in {same}"
    found = {"rows": every, "status": status, "same": same}
    return Row(what, "the same in all rows", text, status == every, found)


def numbers(grasps: Grasps) -> Tensor:
    """Return for each grasp a vector of status, joints [rad or m] and pose, (n, 1 + h + 16)."""
    return torch.cat([grasps.status[:, None], grasps.joints, grasps.obj_from_hand.flatten(1)], 1)
