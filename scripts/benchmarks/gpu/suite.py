"""Every kernel of the chain on a GPU beside the CPU: from which size on the GPU is faster, and what it needs."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from benchmarks.common import Row, measure
from benchmarks.gpu.compare import Kernel, Timing, compare, overtakes


def gpu(
    only: tuple[str, ...] = (),
    threads: tuple[int, ...] = (1, 8),
    quick: bool = False,
    out: Path = Path("out/bench_gpu.json"),
) -> None:
    """Time every kernel on the GPU and on the CPU, medians after a warm-up; without a GPU say so and stop.

    Args:
        only: kernels to measure, by name; all by default.
        threads: of the CPU; each number is a column.
        quick: the smallest two sizes of each kernel.
        out: JSON file of the numbers.
    """
    if not torch.cuda.is_available():
        print("no GPU here")
        return
    from benchmarks.gpu.kernels import kernels

    device, found = torch.device("cuda", torch.cuda.current_device()), kernels(quick)
    subjects = {kernel.name: partial(bench_kernel, kernel, device, threads) for kernel in found}
    settings = {"gpu": torch.cuda.get_device_name(device), "torch": torch.__version__, "threads": threads}
    measure("gpu", subjects, only or tuple(subjects), settings, out)


def bench_kernel(kernel: Kernel, device: torch.device, threads: Sequence[int]) -> list[Row]:
    """Return the row of one kernel: met where the results of all sizes agree."""
    timings = [compare(kernel, size, device, threads) for size in kernel.sizes]
    faster = {count: overtakes(timings, count) for count in threads}
    told = "; ".join(f"from {size} on" if size else "at no size" for size in faster.values())
    return [
        Row(
            f"{kernel.name}: the GPU is faster than {', '.join(f'{c} threads' for c in threads)}: {told}",
            f"results differ by at most {kernel.tolerance:g}",
            "\n            ".join(["", *table(kernel, timings, threads)]),
            all(timing.error <= kernel.tolerance for timing in timings),
            {"what": kernel.what, "timings": [vars(t) for t in timings], "faster_from": faster},
        )
    ]


def table(kernel: Kernel, timings: Sequence[Timing], threads: Sequence[int]) -> list[str]:
    """Return the lines of a Markdown table, times in milliseconds."""
    heads = [kernel.what, *(f"CPU, {c}" for c in threads), "GPU", "peak MiB", "error"]
    lines = [f"| {' | '.join(heads)} |"]
    for t in timings:
        times = [f"{1e3 * s:.3g}" for s in (*t.cpu.values(), t.gpu)]
        lines.append(f"| {' | '.join([str(t.size), *times, f'{t.peak_mib:.0f}', f'{t.error:.1e}'])} |")
    return lines
