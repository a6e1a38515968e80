"""The peak of a plan's resident memory, in a process of its own."""

from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.common import Row, peak_mib
from torchgrasp import ContactSpec, Status, load_hand, plan_grasps
from torchgrasp.data import read_view
from torchgrasp.jobs import run_tasks

MOST = 1.2 * 1024
"""Bar of the peak [MiB]."""


def peak_of_plan(objects: Path, name: str, view: str, hand: str, starts: int) -> tuple[float, int]:
    """Plan in this process; return its peak [MiB], that of the imports included, and the executable grasps."""
    torch.set_num_threads(1)
    grasps = plan_grasps(read_view(objects, name, view), load_hand(hand), ContactSpec(table=0.0), starts)
    peak = peak_mib()
    assert peak is not None, "memory is measured where /proc tells it"
    return peak, int((grasps.status == Status.OK).sum())


def bench_memory(objects: Path, views: list[tuple[str, str]], hand: str, counts: Sequence[int]) -> list[Row]:
    """Measure the peaks of plans of so many starts, the largest last, each in a fresh process."""
    peaks: dict[int, list[float]] = {}
    for count in counts:
        for name, view in views:
            (found,) = run_tasks(peak_of_plan, [(objects, name, view, hand, count)], workers=1, limit=3600.0)
            assert isinstance(found, tuple), f"{name}: {found!r}"
            peaks.setdefault(count, []).append(found[0])
    texts = [f"{count} starts {max(of) / 1024:.2f} GiB" for count, of in peaks.items()]
    return [
        Row(
            f"peak of resident memory, {len(views)} views",
            "<= 1.2 GiB",
            "; ".join(texts),
            max(map(max, peaks.values())) <= MOST,
            {str(count): of for count, of in peaks.items()},
        )
    ]
