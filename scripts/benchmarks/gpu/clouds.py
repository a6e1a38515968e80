"""Plans of many clouds at once beside plans of each alone: the same grasps, and how many of them a second."""

import time
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench
from benchmarks.gpu.launches import views
from torchgrasp import ContactSpec, Grasps, Status, load_hand, plan_grasps
from torchgrasp.planner.many import plan_stack
from torchgrasp.planner.request import Request

Result = TypeVar("Result")
SAME = 1e-6
"""Largest difference of joints [rad] and poses [m, 1] of the same grasp."""


@bench("gpu/clouds")
def plan_clouds(o: Options) -> list[Row]:
    """Plan batches of clouds at once, on a GPU if there is one, and each cloud alone on one thread of the CPU."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    hand, spec, rows = load_hand(o.hands[0]), ContactSpec(friction=0.8, table=0.0), list[Row]()
    plan_stack([Request(cloud, hand, spec, 20) for cloud in views(2)], device)  # what a process keeps is made before
    for count in o.batches:
        clouds = views(count)
        requests = [Request(cloud.to(device), hand, spec, o.starts) for cloud in clouds]
        together, seconds = timed(lambda requests=requests: plan_stack(requests, device), device)
        alone, before = timed(
            lambda clouds=clouds: [plan_grasps(cloud, hand, spec, o.starts) for cloud in clouds], torch.device("cpu")
        )
        memory = torch.cuda.max_memory_allocated() / 2**30 if device.type == "cuda" else 0.0
        rows.append(
            compare(f"{count} clouds, {hand.name}, {o.starts} starts", alone, together, before, seconds, memory)
        )
    return rows


def timed(function: Callable[[], Result], device: torch.device) -> tuple[Result, float]:
    """Return the result of a function, and the wall time [s] that it took on a device."""
    began = time.perf_counter()
    result = function()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return result, time.perf_counter() - began


def compare(
    what: str, alone: list[Grasps], together: list[Grasps], before: float, seconds: float, memory: float
) -> Row:
    """Return the row of a batch: the rows with the same status and the same grasp, and executable grasps a second."""
    pairs = [(one, other.to("cpu")) for one, other in zip(alone, together, strict=True)]
    every = sum(len(one) for one, _ in pairs)
    status = sum(int((one.status == other.status).sum()) for one, other in pairs if len(one) == len(other))
    same = sum(
        int((torch.cdist(numbers(one), numbers(other), p=torch.inf).amin(1) < SAME).sum()) for one, other in pairs
    )
    counts = [sum(int((grasps.status == Status.OK).sum()) for grasps in found) for found in zip(*pairs, strict=True)]
    text = (
        f"status in {status} of {every} rows, joints and pose in {same}; {counts[1] / seconds:.0f} executable a second "
        f"at once, {counts[0] / before:.0f} on one thread of the CPU; {memory:.1f} GiB on the GPU"
    )
    return Row(
        what, "the same in all rows", text, status == every,
        {"rows": every, "status": status, "same": same, "executable": counts, "seconds": [before, seconds],
         "memory": memory},
    )  # fmt: skip


def numbers(grasps: Grasps) -> Tensor:
    """Return the status, joints and pose of each grasp in one vector."""
    return torch.cat([grasps.status[:, None], grasps.joints, grasps.obj_from_hand.flatten(1)], 1)
