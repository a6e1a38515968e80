"""Run all parts of a reproduction; what is finished is kept, so that a killed run goes on where it was."""

import contextlib
import dataclasses
import io
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from tqdm import tqdm

from paper.rows import Cell, TableSpec
from paper.trials import run_cells, subjects
from paper.whole.page import write_pages
from paper.whole.parts import FIGURES, FULL, QUICK, TRIALS, Figure, Sizes, Trials
from torchgrasp.errors import GraspError, Status
from torchgrasp.evaluation import run_tasks
from torchgrasp.files import format_json, hold_folder, write_file

LIMIT = 3 * 3600.0
"""Wall time [s] after which a part is given up: ten times the longest, on a busy machine."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """What is reproduced. After a change of the code, take another folder.

    Args:
        out: folder of index.html, results.json, times.json and of all that is kept.
        objects: folders of objects with noisy views, beside the library's own four; docs/data.md says what is in them.
        parts: names of the parts to make, such as table3; by default all.
        full: every trial instead of what two cores do in some 20 minutes.
        workers: processes; the results do not depend on their number.
    """

    out: Path
    objects: tuple[Path, ...] = ()
    parts: tuple[str, ...] = ()
    full: bool = False
    workers: int = 2


def reproduce_all(spec: Annotated[Whole, tyro.conf.arg(name="")]) -> None:
    """Make Tables 3 to 7, Figs. 4 to 12 and the ladder, on one page with the paper's numbers beside ours.

    A run that was stopped goes on where it was. results.json has the same bytes as if nothing had happened; what was
    measured in seconds lies in times.json.

    Args:
        spec: what is reproduced.
    """
    reproduce(spec, FULL if spec.full else QUICK)


def reproduce(spec: Whole, sizes: Sizes) -> None:
    """Make the parts in given sizes, and write the pages as they come."""
    if unknown := sorted({*spec.parts} - {part.name for part in (*FIGURES, *TRIALS)}):
        raise SystemExit(f"parts: {unknown} are none; {', '.join(p.name for p in (*FIGURES, *TRIALS))} are")
    wanted = {*spec.parts} or {part.name for part in (*FIGURES, *TRIALS)}
    figures = [part for part in FIGURES if part.name in wanted]
    trials = [part for part in TRIALS if part.name in wanted]
    tables = [(part, part.spec(spec.out, spec.objects, sizes, spec.workers)) for part in trials]
    asked = {part.name: part.options(sizes) for part in figures}
    asked |= {part.name: _plain(table) for part, table in tables}
    missing = [part for part in figures if not finished(spec.out, part.name, asked[part.name])]
    left = [(part, table) for part, table in tables if not finished(spec.out, part.name, asked[part.name])]
    work = sum(p.seconds for p in missing) + sum(p.seconds * _lifts(p, table) for p, table in left)
    style = "{percentage:3.0f}% |{bar}| {elapsed}, {remaining} left{postfix}"
    with hold_folder(spec.out), tqdm(total=work, disable=None, bar_format=style, smoothing=0.05) as bar:
        lost: dict[str, str] = {}
        for part, found in zip(missing, make_figures(spec, missing, sizes), strict=True):
            if reason := found.sentence if isinstance(found, Status) else found:
                lost[part.name] = reason
            bar.write(f"{part.title}: {reason or 'done'}")
            bar.update(part.seconds)
        write_pages(spec.out, sizes, asked)
        for part, table in left:
            make_table(part, table, bar)
            write_pages(spec.out, sizes, asked)
            bar.write(f"{part.title}: done")
    write_pages(spec.out, sizes, asked)
    print(spec.out / "index.html")
    if lost:
        raise SystemExit(f"not made: {', '.join(lost)}")


def make_figures(spec: Whole, missing: list[Figure], sizes: Sizes) -> Iterator[str | Status]:
    """Make figures on worker processes, and yield what came of each in their order."""
    tasks = [(part.name, spec.out, sizes) for part in missing]
    return run_tasks(make_figure, tasks, spec.workers, LIMIT) if tasks else iter(())


def make_figure(name: str, out: Path, sizes: Sizes) -> str:
    """Make one figure and keep what it printed; return why it could not be made, or nothing."""
    torch.set_num_threads(1)
    part = next(part for part in FIGURES if part.name == name)
    began, said = time.process_time(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        try:
            part.make(out, **part.options(sizes))
        except GraspError as error:
            return str(error)
    finish(out, name, part.options(sizes), said.getvalue(), time.process_time() - began)
    return ""


def make_table(part: Trials, table: TableSpec, bar: "tqdm[Any]") -> None:
    """Make a table of lifts, and keep what it printed."""
    each = part.seconds * _lifts(part, table) / (len(subjects(table)) * len(table.hands))

    def watched() -> Iterator[tuple[Cell, ...]]:
        for cells in run_cells(table, part.rows):
            bar.set_postfix_str(f"{part.title}: {cells[0].object}, {cells[0].hand}")
            bar.update(each)
            yield cells

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        part.judge(table, watched())
    finish(table.out, part.name, _plain(table), said.getvalue(), None)


def finish(out: Path, name: str, asked: dict[str, Any], said: str, seconds: float | None) -> None:
    """Keep what a part was asked, what it printed and how long it took; it is finished then."""
    lines = [line for line in said.splitlines() if not line.startswith(str(out))]
    write_file(_record(out, name), format_json({"asked": asked, "said": lines, "seconds": seconds}))


def finished(out: Path, name: str, asked: dict[str, Any]) -> bool:
    """Tell whether a part is finished that was asked alike."""
    path = _record(out, name)
    return path.is_file() and json.loads(path.read_text("utf-8"))["asked"] == asked


def _record(out: Path, name: str) -> Path:
    return out / "parts" / f"{name}.json"


def _plain(table: TableSpec) -> dict[str, Any]:
    """Return what a table is made of, without what its numbers do not depend on."""
    left_out = {"out", "objects", "workers", "finished"}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in vars(table).items() if k not in left_out}


def _lifts(part: Trials, table: TableSpec) -> float:
    """Return by how much a table is larger than one object with one hand at quick sizes."""
    each = table.grasps * table.draws / (QUICK.grasps * QUICK.draws) if part.repeated else 1.0
    return each * len(subjects(table)) * len(table.hands)
