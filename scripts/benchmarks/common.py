"""What every benchmark needs: a clock, rows with a bar, the peak of memory, and random views of simple bodies."""

import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchgrasp.files import write_file
from torchgrasp.geometry.linalg import unit


@dataclasses.dataclass(frozen=True)
class Row:
    """One measured number beside its bar; `met` is None where there is none to meet, or nothing was measured."""

    what: str
    bar: str
    measured: str
    met: bool | None
    numbers: dict[str, Any]

    def __str__(self) -> str:
        verdict = {True: "met", False: "MISSED", None: "-"}[self.met]
        return f"{verdict:7} {self.what}\n        bar {self.bar}\n        is  {self.measured}"


def least_seconds(action: Callable[[], object], repeats: int = 5, limit: float = 5.0) -> float:
    """Return the least time of an action [s], after one call that is not counted: more is the load of others.

    The time is the processor's on one thread, which waiting does not lengthen, and the wall's on several. The first
    call alone counts when it takes more than `limit` seconds.
    """
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    times: list[float] = []
    for _ in range(repeats + 1):
        began = clock()
        action()
        times.append(clock() - began)
        if len(times) == 1 and times[0] > limit:
            return times[0]
    return min(times[1:])


def peak_mib() -> float | None:
    """Return the peak of this process's resident memory [MiB], where the system tells it."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def measure(
    bench: str,
    subjects: Mapping[str, Callable[[], list[Row]]],
    only: Sequence[str],
    settings: dict[str, Any],
    out: Path,
) -> None:
    """Measure the subjects asked for, print their rows as they are there, and write all of them as JSON."""
    unknown = sorted(set(only) - set(subjects))
    if unknown:
        raise SystemExit(f"only: {unknown} are no subjects; {', '.join(subjects)} are")
    print(", ".join(f"{name} {value}" for name, value in settings.items()))
    rows: list[Row] = []
    for name, subject in subjects.items():
        if name in only:
            found = subject()
            print(*found, sep="\n", flush=True)
            rows += found
    met, missed = (sum(row.met is verdict for row in rows) for verdict in (True, False))
    print(f"{met} bars met, {missed} missed, {len(rows) - met - missed} rows without one")
    write_rows(out, bench, settings, rows)


def write_rows(out: Path, bench: str, settings: dict[str, Any], rows: Sequence[Row]) -> None:
    """Write rows and settings as JSON."""
    content = {"bench": bench, "settings": settings, "rows": [dataclasses.asdict(row) for row in rows]}
    write_file(out, json.dumps(content, indent=1, default=str))


BODIES = ("ellipsoid", "box", "cylinder", "torus")


def random_view(n: int, generator: torch.Generator, body: str | None = None) -> tuple[Tensor, Tensor]:
    """Return n points and outward normals of the side of a random body that faces a random camera.

    The points lie within the unit ball about the origin, the largest norm being 1, with a noise of 0.002.

    Args:
        n: number of points.
        generator: of every draw.
        body: one of `BODIES`; a random one by default.
    """
    if body is None:
        body = BODIES[int(torch.randint(len(BODIES), (1,), generator=generator))]
    axes = 0.2 + 0.8 * torch.rand(3, generator=generator, dtype=torch.float64)
    view = unit(torch.randn(3, generator=generator, dtype=torch.float64))
    points = normals = torch.empty(0, 3, dtype=torch.float64)
    while len(points) < n:
        more, outward = _surface(body, 4 * n, axes, generator)
        facing = outward @ view > 0.05
        points, normals = torch.cat([points, more[facing]])[:n], torch.cat([normals, outward[facing]])[:n]
    points = points + 0.002 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    points = points - (points.amin(0) + points.amax(0)) / 2
    return points / torch.linalg.vector_norm(points, dim=-1).max(), normals


def _surface(body: str, m: int, axes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return points and outward normals all over a body with the given half axes."""
    ball = unit(torch.randn(m, 3, generator=generator, dtype=torch.float64))
    if body == "ellipsoid":
        return ball * axes, unit(ball / axes)
    if body == "box":
        inside = (2 * torch.rand(m, 3, generator=generator, dtype=torch.float64) - 1) * axes
        area = axes.prod() / axes
        face = torch.multinomial(area, m, replacement=True, generator=generator)
        normals = torch.eye(3, dtype=torch.float64)[face]
        sign = torch.sign(ball[:, :1])
        return torch.where(normals > 0, sign * axes, inside), normals * sign
    angle = 2 * torch.pi * torch.rand(m, generator=generator, dtype=torch.float64)
    if body == "cylinder":
        around = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
        height = (2 * torch.rand(m, generator=generator, dtype=torch.float64) - 1) * axes[2]
        side = torch.stack([axes[0] * around[:, 0], axes[0] * around[:, 1], height], -1)
        share = 2 * axes[2] / (2 * axes[2] + axes[0])  # of the side in the whole surface
        radius = axes[0] * torch.rand(m, generator=generator, dtype=torch.float64).sqrt()
        up = torch.sign(ball[:, 2])
        cap = torch.stack([radius * around[:, 0], radius * around[:, 1], up * axes[2]], -1)
        lid = torch.stack([torch.zeros_like(up), torch.zeros_like(up), up], -1)
        on_side = (torch.rand(m, generator=generator, dtype=torch.float64) < share)[:, None]
        return torch.where(on_side, side, cap), torch.where(on_side, around, lid)
    around = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    turn = 2 * torch.pi * torch.rand(m, generator=generator, dtype=torch.float64)
    normals = turn.cos()[:, None] * around + turn.sin()[:, None] * torch.eye(3, dtype=torch.float64)[2]
    return around + 0.35 * axes[0] * normals, normals
