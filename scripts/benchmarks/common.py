"""What every benchmark needs: options, a registry, rows with a target, results as files, a clock
and random views.
"""

import dataclasses
import importlib
import json
import math
import os
import pkgutil
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchgrasp.evaluation.intervals import Share, contrast_over
from torchgrasp.files import write_file
from torchgrasp.geometry.linalg import unit

ROOT = Path(__file__).resolve().parents[2]
Result = TypeVar("Result")


def mean_over(values: Iterable[tuple[str, float]]) -> Share:
    """Return the mean, with its 95 % interval, of values given as pairs of unit name and value; NaN
    is left out.
    """
    sums: dict[str, tuple[float, int]] = {}
    for name, value in values:
        if not math.isnan(value):
            before = sums.get(name, (0.0, 0))
            sums[name] = before[0] + value, before[1] + 1
    return contrast_over([sums], [1.0])


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of all benches; a bench uses those that it needs.

    Args: only: benches of the subject; by default all. objects: folders with manifest.json and a
        folder for each object. Benches that need objects are left out without one. names: objects
        to keep; by default all. views: names of the views that are measured, as view0; by default
        all. hands: names of hands. conditions: of close/misplaced and close/sensors, or
        perturbations of close/perturb; by default all. laws: controllers of close/misplaced; by
        default all. grasps: grasps of each view, the best or spread over all ranks. starts: random
        starts of the contact planner. batches: numbers of clouds of gpu/clouds and gpu/launches.
        gpu_rate: clouds that one GPU plans in a second, for load/campaign; gpu/clouds measures it.
        By default unknown. scale: factor of the numbers of random samples, scenes, frames, plans
        and trials. draws: trials of each grasp of close/table-lift, with other displacements,
        pushes and noise. tries: largest number of grasps that a trial of close/table-lift tries; by
        default as the protocol says. planned: folder OBJECT/VIEW.safetensors with grasps for
        close/table-lift; by default they are planned and kept. simulator: of load/trials,
        load/campaign and close/table-lift. workers: processes that share the trials. threads: of
        torch. seed: of every random number. out: folder of the results as JSON, of kept plans and
        trials, and of the tables. publish: write the tables to docs/results instead.
    """

    only: tuple[str, ...] = ()
    objects: tuple[Path, ...] = ()
    names: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    hands: tuple[str, ...] = ("allegro", "barrett")
    conditions: tuple[str, ...] = ()
    laws: tuple[str, ...] = ()
    grasps: int = 1
    starts: int = 1000
    batches: tuple[int, ...] = (1, 4, 16)
    gpu_rate: float | None = None
    scale: float = 1.0
    draws: int = 5
    tries: int | None = None
    planned: Path | None = None
    simulator: Literal["sapien", "mujoco"] = "sapien"
    workers: int = 1
    threads: int = 1
    seed: int = 0
    out: Path = Path("out")
    publish: bool = False

    def times(self, number: int) -> int:
        """Return a number of samples times the scale, at least 1."""
        return max(1, round(number * self.scale))


@dataclasses.dataclass(frozen=True)
class Row:
    """One measured number beside its target; `met` is None without a target or a measurement."""

    what: str
    bar: str
    measured: str
    met: bool | None
    numbers: dict[str, Any]

    def __str__(self) -> str:
        verdict = {True: "met", False: "MISSED", None: "-"}[self.met]
        return f"{verdict:7} {self.what}\n        bar {self.bar}\n        is  {self.measured}"


class Bench(NamedTuple):
    """A function of options that returns rows, and whether it needs folders of objects."""

    run: Callable[[Options], list[Row]]
    objects: bool


BENCHES: dict[str, Bench] = {}
"""All benches by name, as "close/misplaced"."""


def bench(name: str, objects: bool = False) -> Callable[[Callable[[Options], list[Row]]], Callable]:
    """Register a function as a bench."""

    def register(run: Callable[[Options], list[Row]]) -> Callable:
        BENCHES[name] = Bench(run, objects)
        return run

    return register


def benches_of(subject: str) -> dict[str, Bench]:
    """Return the benches of a subject by their short names."""
    package = importlib.import_module(f"benchmarks.{subject}")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"benchmarks.{subject}.{module.name}")
    return {name.split("/")[1]: x for name, x in BENCHES.items() if name.startswith(f"{subject}/")}


def measure(subject: str, options: Options) -> list[Row]:
    """Run the benches that are asked for, print their rows, and write them as JSON and as Markdown."""
    known = benches_of(subject)
    if unknown := sorted(set(options.only) - set(known)):
        raise SystemExit(
            f"only: {unknown} unknown; the benches of {subject} are {', '.join(known)}"
        )
    torch.set_num_threads(options.threads)
    found: list[Row] = []
    for name in options.only or known:
        if known[name].objects and not options.objects:
            print(f"{subject}/{name} needs --objects")
            continue
        rows = known[name].run(options)
        print(*rows, sep="\n", flush=True)
        write_table(
            ROOT / "docs" / "results" if options.publish else options.out,
            f"{subject}-{name}",
            rows,
            options,
        )
        found += rows
    met, missed = (sum(row.met is verdict for row in found) for verdict in (True, False))
    print(f"{met} targets met, {missed} missed, {len(found) - met - missed} rows without a target")
    content = {
        "bench": subject,
        "settings": dataclasses.asdict(options),
        "rows": list(map(dataclasses.asdict, found)),
    }
    write_file(options.out / f"bench_{subject}.json", json.dumps(content, indent=1, default=str))
    return found


def write_table(folder: Path, name: str, rows: list[Row], options: Options) -> None:
    """Write rows as a Markdown table with commit, machine and command."""
    command = " ".join(["scripts/bench.py", *sys.argv[1:]])
    lines = [f"# {name}", "", f"`{command}`", "", describe_run(options.threads), ""]
    lines += ["| what | target | measured | met |", "| --- | --- | --- | --- |"]
    for row in rows:
        cells = row.what, row.bar, row.measured, {True: "yes", False: "no", None: "-"}[row.met]
        lines.append(f"| {' | '.join(x.replace('|', '/') for x in cells)} |")
    write_file(folder / f"{name}.md", "\n".join(lines) + "\n")


def describe_run(threads: int) -> str:
    """Return commit, processor, threads and version of torch in one line."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=False
        ).stdout.strip()

    commit = (git("rev-parse", "--short", "HEAD") or "unknown") + (
        " with changes" if git("status", "--short") else ""
    )
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    return f"Commit {commit}; {processor}, {os.cpu_count()} cores; {threads} threads; torch {torch.__version__}."


def least_seconds(action: Callable[[], object], repeats: int = 5, limit: float = 5.0) -> float:
    """Return the least time of an action [s], after one call that is not counted: more is the load
    of others.

    The time is the processor's on one thread, which waiting does not lengthen, and the wall's on
    several. The first call alone counts when it takes more than `limit` seconds.
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


def timed(action: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of an action, and the processor's time that it took [s]."""
    began = time.process_time()
    return action(), time.process_time() - began


def peak_mib() -> float | None:
    """Return the peak of this process's resident memory [MiB], where the system tells it."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


BODIES = ("ellipsoid", "box", "cylinder", "torus")


def random_view(
    n: int, generator: torch.Generator, body: str | None = None
) -> tuple[Tensor, Tensor]:
    """Return n points and outward normals of the side of a random body that faces a random camera.

    The points lie within the unit ball about the origin, the largest norm being 1, with a noise of
    0.002.

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
        points = torch.cat([points, more[facing]])[:n]
        normals = torch.cat([normals, outward[facing]])[:n]
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
    normals = (
        turn.cos()[:, None] * around + turn.sin()[:, None] * torch.eye(3, dtype=torch.float64)[2]
    )
    return around + 0.35 * axes[0] * normals, normals
