"""Every kernel of the chain on a GPU beside the CPU: times, memory, and by how much the results
differ.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench
from benchmarks.gpu.kernels import Kernel, kernels
from torchgrasp.foundation.base import Value, named_tensors


@dataclasses.dataclass(frozen=True)
class Timing:
    """Median seconds of one size on the CPU by its threads, and on the GPU with its peak of memory
    [MiB].
    """

    size: int
    cpu: dict[int, float]
    gpu: float
    peak_mib: float
    error: float


@bench("gpu/kernels")
def measure_kernels(o: Options) -> list[Row]:
    """Time every kernel on the GPU and on the CPU, medians after a warm-up; nothing without a GPU."""
    if not torch.cuda.is_available():
        print("no GPU here")
        return []

    device = torch.device("cuda", torch.cuda.current_device())
    return [bench_kernel(kernel, device, (1, 8)) for kernel in kernels(o.scale < 1)]


def bench_kernel(kernel: Kernel, device: torch.device, threads: Sequence[int]) -> Row:
    """Return the row of one kernel: met where the results of all sizes agree."""
    timings = [compare(kernel, size, device, threads) for size in kernel.sizes]
    faster = {count: overtakes(timings, count) for count in threads}
    lines = []
    for t in timings:
        times = ", ".join(f"{count} threads {1e3 * s:.3g} ms" for count, s in t.cpu.items())
        lines.append(
            f"{t.size}: {times}, GPU {1e3 * t.gpu:.3g} ms, {t.peak_mib:.0f} MiB, error {t.error:.1e}"
        )
    return Row(
        f"{kernel.name} by {kernel.what}; the GPU is faster from {', '.join(map(str, faster.values()))} on",
        f"results differ by at most {kernel.tolerance:g}",
        "; ".join(lines),
        all(timing.error <= kernel.tolerance for timing in timings),
        {"what": kernel.what, "timings": [vars(t) for t in timings], "faster_from": faster},
    )


def tensors_of(value: Any) -> Iterator[Tensor]:
    """Yield every tensor of a result."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Value):
        yield from named_tensors(value).values()
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for part in value:
            yield from tensors_of(part)


def relative_error(one: Any, other: Any) -> float:
    """Return the largest difference of two results over the largest entry of its tensor.

    It is infinite where they differ in shape, or in which entries are finite.
    """
    worst = 0.0
    for a, b in zip(tensors_of(one), tensors_of(other), strict=True):
        a = a.double().cpu()
        b = b.double().cpu()
        if a.shape != b.shape or not torch.equal(torch.isfinite(a), torch.isfinite(b)):
            return float("inf")
        finite = torch.isfinite(a)
        if bool(finite.any()):
            largest = a[finite].abs().max().clamp_min(torch.finfo(torch.float64).tiny)
            worst = max(worst, float((a - b)[finite].abs().max() / largest))
    return worst


def median_seconds(action: Callable[[], object], wait: Callable[[], None]) -> float:
    """Return the median wall time of an action [s], after one that is not counted; `wait` ends
    each.
    """
    times: list[float] = []
    count = 5
    while len(times) <= count:
        began = time.perf_counter()
        action()
        wait()
        times.append(time.perf_counter() - began)
        if len(times) == 1 and times[0] > 2.0:
            count = 1
    return statistics.median(times[1:])


def compare(kernel: Kernel, size: int, device: torch.device, threads: Sequence[int]) -> Timing:
    """Time a kernel of one size on the CPU and on the device, and compare its results."""
    action, arguments = kernel.prepare(size)
    there = tuple(x.to(device) if isinstance(x, Tensor | Value) else x for x in arguments)
    on_gpu = device.type == "cuda"
    wait = torch.cuda.synchronize if on_gpu else lambda: None
    cpu = {}
    for count in threads:
        torch.set_num_threads(count)
        cpu[count] = median_seconds(lambda: action(*arguments), lambda: None)
    expected = action(*arguments)
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    gpu = median_seconds(lambda: action(*there), wait)
    peak = torch.cuda.max_memory_allocated() / 2**20 if on_gpu else 0.0
    error = (kernel.agree or relative_error)(expected, action(*there))
    return Timing(size, cpu, gpu, peak, error)


def overtakes(timings: Sequence[Timing], threads: int) -> int | None:
    """Return the least size from which on the GPU is the faster one; None: at none that was
    measured.
    """
    least = None
    for timing in sorted(timings, key=lambda t: t.size, reverse=True):
        if timing.gpu >= timing.cpu[threads]:
            break
        least = timing.size
    return least
