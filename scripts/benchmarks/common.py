"""What every bench of scripts/bench.py needs: options, a registry, rows with a target, results as
files, a clock.
"""

import dataclasses
import importlib
import json
import math
import os
import pkgutil
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import torch

from torchgrasp.evaluation.intervals import Share, contrast_over
from torchgrasp.files import format_json, write_file
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.fused import are_on
from torchgrasp.foundation.jobs import run_tasks

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
SPEED = RESULTS / "speed.md"
CHANGED = " with changes"
UNKNOWN = "unknown"
"""What stands behind a commit if the working tree differs from it. Then what stands for a commit
that git does not tell.
"""
Result = TypeVar("Result")


def mean_over(values: Iterable[tuple[str, float]]) -> Share:
    """Return the mean of values with its 95 % interval over units, such as families of objects.

    A value is given as a pair: name of its unit, value. NaN is left out.
    """
    return contrast_over([sum_by(values)], [1.0])


def sum_by(values: Iterable[tuple[str, float]]) -> dict[str, tuple[float, int]]:
    """Return the sum and the number of the values of each unit, by its name; NaN is left out."""
    sums: dict[str, tuple[float, int]] = {}
    for name, value in values:
        if not math.isnan(value):
            before = sums.get(name, (0.0, 0))
            sums[name] = before[0] + value, before[1] + 1
    return sums


def format_number(share: Share) -> str:
    """Return a mean or a difference with its interval as text: "value [low, high]", with signs."""
    return f"{share.value:+.3f} [{share.low:+.3f}, {share.high:+.3f}]"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of all benches; a bench uses those that it needs.

    Args:
        only: benches of the subject; by default all.
        objects: folders with manifest.json and a folder for each object. Benches that need objects
            are left out without one.
        names: objects to keep; by default all.
        views: names of the views that are measured, as view0; by default all.
        hands: names of hands.
        starts: random starts of the contact planner.
        batches: numbers of clouds of gpu/clouds and gpu/launches.
        scale: factor of the numbers of random samples, scenes, frames, plans and trials.
        clouds: folder of real clouds NAME_CAMERA.ply for headline/real, of one camera each.
        simulator: of headline/region and scene/target.
        workers: processes that share the trials.
        threads: of torch.
        beside: commit whose times plan/pace takes in the same run, for ratios; with publish they
            become a section of docs/results/speed.md.
        seed: of every random number.
        out: folder of the results as JSON, of kept plans and trials, and of the tables.
        publish: write the tables to docs/results instead.
    """

    only: tuple[str, ...] = ()
    objects: tuple[Path, ...] = ()
    names: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    hands: tuple[str, ...] = ("allegro", "barrett")
    starts: int = 1000
    batches: tuple[int, ...] = (1, 4, 16)
    scale: float = 1.0
    clouds: Path | None = None
    simulator: Literal["sapien", "mujoco"] = "sapien"
    workers: int = 1
    threads: int = 1
    beside: str | None = None
    seed: int = 0
    out: Path = Path("out")
    publish: bool = False

    def times(self, number: int) -> int:
        """Return a number of samples times the option `scale`, rounded, at least 1."""
        return max(1, round(number * self.scale))


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a bench's results: a measured number beside its target.

    `what` says what was measured; `bar` is the target and `measured` the result, as text. `met`
    tells whether the target is met; None without a target or a measurement. `numbers` are the
    results by name, for the JSON file.
    """

    what: str
    bar: str
    measured: str
    met: bool | None = None
    numbers: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        verdict = {True: "met", False: "MISSED", None: "-"}[self.met]
        return f"{verdict:7} {self.what}\n        bar {self.bar}\n        is  {self.measured}"


class Bench(NamedTuple):
    """A bench: a function of options that returns rows, and whether it needs folders of objects."""

    run: Callable[[Options], list[Row]]
    objects: bool


BENCHES: dict[str, Bench] = {}
"""All benches by name, as "scene/rooms"."""


def bench(name: str, objects: bool = False) -> Callable[[Callable[[Options], list[Row]]], Callable]:
    """Return a decorator that registers a function of options as the bench `name`.

    A name is "SUBJECT/BENCH". `objects` says whether the bench needs folders of objects.
    """

    def register(run: Callable[[Options], list[Row]]) -> Callable:
        BENCHES[name] = Bench(run, objects)
        return run

    return register


def benches_of(subject: str) -> dict[str, Bench]:
    """Return the benches of a subject by their names without the subject, such as "rooms"."""
    package = importlib.import_module(f"benchmarks.{subject}")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"benchmarks.{subject}.{module.name}")
    return {name.split("/")[1]: x for name, x in BENCHES.items() if name.startswith(f"{subject}/")}


def measure(subject: str, options: Options) -> list[Row]:
    """Run the benches of a subject that the options ask for, and return their rows.

    The rows are printed, and written as JSON and as a Markdown table.
    """
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
        rows = keep_rows(options, f"{subject}-{name}", lambda run=known[name].run: run(options))
        print(*rows, sep="\n", flush=True)
        if options.publish and options.beside is not None:
            write_section(SPEED, f"Beside commit {options.beside}", rows, options)
        else:
            folder = RESULTS if options.publish else options.out
            write_table(folder, f"{subject}-{name}", rows, options)
        found += rows
    met, missed = (sum(row.met is verdict for row in found) for verdict in (True, False))
    print(f"{met} targets met, {missed} missed, {len(found) - met - missed} rows without a target")
    return found


def keep(path: Path, make: Callable[[], Any]) -> Any:
    """Return the content of a JSON file; if there is none, it is written from what `make` gives."""
    if not path.is_file():
        write_file(path, format_json(make()))
    return json.loads(path.read_text("utf-8"))


def is_fixed(commit: str) -> bool:
    """Return whether a text of `describe_commit` names a commit, without changes of the working
    tree.
    """
    return CHANGED not in commit and UNKNOWN not in commit


CHOICES = ("only", "out", "publish", "workers")
"""Options that change no row."""


def keep_rows(options: Options, name: str, measure_rows: Callable[[], list[Row]]) -> list[Row]:
    """Return the rows of a bench: those that an earlier run of the same commit and options kept.

    If there are none, `measure_rows` returns them, and they are kept in a file in the folder `out`.
    Rows are measured again while the working tree has changes, or without git.
    """
    run = describe_run(options.threads)
    settings = {k: v for k, v in dataclasses.asdict(options).items() if k not in CHOICES}
    head = {"run": run, "settings": json.loads(json.dumps(settings, default=str))}
    path = options.out / "rows" / f"{name}.json"
    if path.is_file():
        content = json.loads(path.read_text("utf-8"))
        if content["head"] == head and is_fixed(run):
            return [Row(**row) for row in content["rows"]]
    rows = measure_rows()
    content = {"head": head, "rows": list(map(dataclasses.asdict, rows))}
    write_file(path, json.dumps(content, indent=1, default=str))
    return rows


def write_table(folder: Path, name: str, rows: list[Row], options: Options) -> None:
    """Write rows as a Markdown table to the file NAME.md of a folder, with commit, machine and
    command.
    """
    lines = [f"# {name}", "", *describe_rows(rows, options)]
    write_file(folder / f"{name}.md", "\n".join(lines) + "\n")


def write_section(page: Path, heading: str, rows: list[Row], options: Options) -> None:
    """Write rows as a Markdown table, with commit, machine and command, as the last section of a
    page.

    It takes the place of a section with the same heading.
    """
    text = page.read_text("utf-8")
    section = re.compile(rf"\n## {re.escape(heading)}\n.*?(?=\n## |\Z)", re.DOTALL)
    lines = ["", f"## {heading}", "", *describe_rows(rows, options)]
    write_file(page, section.sub("", text).rstrip("\n") + "\n" + "\n".join(lines) + "\n")


def describe_rows(rows: list[Row], options: Options) -> list[str]:
    """Return lines of Markdown: the command, then commit and machine, then a table of the rows."""
    return [f"`{command_line()}`", "", describe_run(options.threads), "", *format_rows(rows)]


def command_line() -> str:
    """Return the command line of this process, with DIR in place of absolute paths."""
    words = ["DIR" if Path(word).is_absolute() else word for word in sys.argv[1:]]
    return " ".join(["scripts/bench.py", *words])


def format_rows(rows: Iterable[Row]) -> list[str]:
    """Return the lines of a Markdown table of rows: what, target, measured, met."""
    lines = ["| what | target | measured | met |", "| --- | --- | --- | --- |"]
    for row in rows:
        cells = row.what, row.bar, row.measured, {True: "yes", False: "no", None: "-"}[row.met]
        lines.append(f"| {' | '.join(x.replace('|', '/') for x in cells)} |")
    return lines


def describe_commit() -> str:
    """Return the short hash of the present commit as text, and a word if the working tree has
    changes.
    """

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=False
        ).stdout.strip()

    commit = git("rev-parse", "--short", "HEAD") or UNKNOWN
    if git("status", "--short"):
        commit += CHANGED
    return commit


def describe_run(threads: int) -> str:
    """Return a line of text with commit, processor, threads, version of torch, and whether loops
    are compiled.
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    return (
        f"Commit {describe_commit()}; {processor}, {os.cpu_count()} cores; {threads} threads; "
        f"torch {torch.__version__}; compiled loops {'on' if are_on() else 'off'}."
    )


def timed(
    action: Callable[[], Result], clock: Callable[[], float] = time.process_time
) -> tuple[Result, float]:
    """Return (result, seconds) of an action; by default the seconds are processor time."""
    began = clock()
    return action(), clock() - began


def run_all(
    work: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], workers: int, limit: float
) -> Iterator[Any]:
    """Call `work` for each task in several processes, and yield the results in the order of tasks.

    A task holds the arguments of a call. A task that fails, or takes longer than `limit` [s], ends
    the bench.
    """
    for k, found in enumerate(run_tasks(work, tasks, workers, limit)):
        if isinstance(found, Status):
            raise SystemExit(f"{work.__name__}, task {k} of {len(tasks)}: {found.sentence}")
        yield found
