"""The pace of the present code beside that of another commit, by turns in one run."""

import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.common import ROOT, Options, Row
from benchmarks.ground_truth import read_views
from torchgrasp import PointCloud

SCRIPT = Path(__file__).with_name("timed.py")
FRICTIONS = (0.6, 0.8)
ROUNDS = 3
"""Cold processes of each tree; the median counts."""

Numbers = dict[str, float]


class Measure(NamedTuple):
    """A row of the comparison: one number of the timing jobs, summed up over all jobs.

    `name` is the number's name in the answers of jobs, and `text` says what it is. `statistic` is
    what is taken over jobs, such as "median". `bar` is the greatest ratio of this code to the
    other commit; for a rate, the least. None means no target.
    """

    name: str
    text: str
    statistic: str
    unit: str
    bar: float | None


MEASURES = (
    Measure("first", "first executable grasp, median", "median", "s", 0.5),
    Measure("first", "first executable grasp, worst decile", "worst decile", "s", 0.5),
    Measure("fifty", "fifty executable grasps, median", "median", "s", 0.5),
    Measure("all", "all of the starts, median", "median", "s", 0.5),
    Measure("grasps", "executable grasps for each CPU second", "rate", "/s", 2.0),
    Measure("grasps", "executable grasps of all plans", "sum", "", None),
    Measure("shape", "shape, median", "median", "s", None),
    Measure("predict", "first prediction of 10,000 points, all covariances", "median", "s", 0.25),
    Measure("deviation", "the same, the distance's variance alone", "median", "s", 0.25),
    Measure("surface", "surface, median", "median", "s", 0.5),
    Measure("field", "distance field with its surface, median", "median", "s", 0.5),
    Measure("calls", "torch calls of a plan on the jug", "median", "", 40_000 / 171_000),
    Measure("import", "cold import of torchgrasp", "median", "s", None),
    Measure("command", "cold torchgrasp grasp jug, without report", "median", "s", 0.6),
)


class Timer:
    """A process that runs timing jobs (timed.py) with the library of one source tree."""

    def __init__(self, process: "subprocess.Popen[str]", tree: Path) -> None:
        self.process = process
        found = self._answer()
        if Path(found).resolve() != tree.resolve():
            raise SystemExit(f"beside: torchgrasp is of {found}, not of {tree}")

    def run(self, job: str, **arguments: Any) -> Numbers:
        """Run a job of timed.py, such as "plan", in the process; return its numbers by name."""
        to: IO[str] = self.process.stdin  # pyright: ignore[reportAssignmentType]
        to.write(json.dumps([job, arguments]) + "\n")
        to.flush()
        return self._answer()

    def _answer(self) -> Any:
        line = self.process.stdout.readline()  # pyright: ignore[reportOptionalMemberAccess]
        if not line:
            raise SystemExit(f"beside: a process ended with {self.process.wait()}")
        return json.loads(line)


@contextlib.contextmanager
def other_tree(commit: str) -> Iterator[Path]:
    """Make a git worktree of a commit, yield its path, and remove it at the end."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(ROOT), "worktree"]
        made = subprocess.run(
            [*git, "add", "--detach", str(tree), commit], capture_output=True, text=True
        )
        if made.returncode:
            raise SystemExit(f"beside: {made.stderr.strip()}")
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


@contextlib.contextmanager
def timer(tree: Path, threads: int) -> Iterator[Timer]:
    """Start a process that times the library of a source tree, with the packages of this Python."""
    surroundings = os.environ | {
        "PYTHONPATH": str(tree),
        "OMP_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    with subprocess.Popen(
        [sys.executable, str(SCRIPT), str(threads)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=surroundings,
        cwd=tree,
    ) as process:
        yield Timer(process, tree)


def compare_with_commit(o: Options, commit: str) -> list[Row]:
    """Time the present code and that of a commit by turns; return a row for each number's ratio."""
    rows = list[Row]()
    with (
        other_tree(commit) as tree,
        timer(ROOT, o.threads) as here,
        timer(tree, o.threads) as there,
        tempfile.TemporaryDirectory() as folder,
    ):
        views = list[str]()
        for name, _, cloud, _ in read_views(o.objects[0], views=o.views):
            if not o.names or name in o.names:
                views.append(str(write_view(Path(folder) / f"{len(views)}.npz", cloud)))
        for hand in o.hands:
            found = take_turns((here, there), list_jobs(views, hand, o))
            rows += ratio_rows(f"{hand}, {len(views)} views", *found, commit)
    return rows


def list_jobs(views: list[str], hand: str, o: Options) -> list[tuple[str, dict[str, Any]]]:
    """Return the jobs of timed.py for a hand: pairs of name and arguments.

    `views` are the paths of clouds. The first job is a small plan, which is not counted.
    """
    work = {"hand": hand, "starts": o.starts, "seed": o.seed}
    jobs: list[tuple[str, dict[str, Any]]] = [("shape", {"view": x, "seed": o.seed}) for x in views]
    jobs += [("plan", {"view": x, "friction": f, **work}) for x in views for f in FRICTIONS]
    warm = ("plan", {"view": "jug", "friction": FRICTIONS[0], **work, "starts": 20})
    return [warm, *jobs, ("calls", work), *[("cold", work)] * ROUNDS]


def take_turns(
    timers: tuple[Timer, Timer], jobs: list[tuple[str, dict[str, Any]]]
) -> tuple[list[Numbers], list[Numbers]]:
    """Run each job in both processes, and return the numbers of all jobs but the first, of each
    process.

    The process that begins alternates from job to job.
    """
    found: tuple[list[Numbers], list[Numbers]] = ([], [])
    for k, (job, arguments) in enumerate(tqdm(jobs, disable=None, leave=False)):
        for side in (0, 1) if k % 2 else (1, 0):
            found[side].append(timers[side].run(job, **arguments))
    return found[0][1:], found[1][1:]


def write_view(path: Path, cloud: PointCloud) -> Path:
    """Write the fields of a cloud to an .npz file for `timed.read_view`; return the file's path."""
    names = ("points", "normals", "viewpoint", "frustum")
    fields = {name: getattr(cloud, name) for name in names}
    np.savez(path, **{name: x.numpy() for name, x in fields.items() if x is not None})
    return path


def ratio_rows(what: str, here: list[Numbers], there: list[Numbers], commit: str) -> list[Row]:
    """Return a row for each of `MEASURES`: its values here and at another commit, and their ratio.

    `here` and `there` hold the numbers of all jobs, and `what` is the beginning of each row.
    """
    rows = list[Row]()
    for name, text, statistic, unit, bar in MEASURES:
        values = [summarise(numbers, name, statistic) for numbers in (here, there)]
        ratio = values[0] / values[1]
        least = statistic == "rate"
        met = None
        if bar is not None and not math.isnan(ratio):
            met = ratio >= bar if least else ratio <= bar
        limit = "-" if bar is None else f"{'>=' if least else '<='} {bar:.2f}x"
        now, before = (f"{x:.3g}" if x < 1000 else f"{x:.0f}" for x in values)
        rows.append(
            Row(
                f"{what}: {text}",
                limit,
                f"{ratio:.2f}x: {now} {unit} beside {before} {unit} at {commit}".replace("  ", " "),
                met,
                {"ratio": ratio, "here": values[0], "there": values[1]},
            )
        )
    return rows


def summarise(found: list[Numbers], name: str, statistic: str) -> float:
    """Return a statistic of the number `name` over the jobs that have it; NaN if none has.

    `statistic` is "median", "worst decile" (the 90 % quantile), "sum" or "rate". A rate is the sum
    over the seconds of all plans.
    """
    values = np.array([numbers[name] for numbers in found if name in numbers])
    values = values[~np.isnan(values)]
    if not len(values):
        return math.nan
    if statistic == "median":
        return float(np.median(values))
    if statistic == "worst decile":
        return float(np.quantile(values, 0.9))
    if statistic == "rate":
        values = values / sum(numbers["all"] for numbers in found if "all" in numbers)
    return float(values.sum())
