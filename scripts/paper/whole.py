"""All tables and figures of the paper in one resumable run, on one page with the paper's numbers
beside ours.
"""

import base64
import contextlib
import dataclasses
import io
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import tyro
from markupsafe import Markup, escape
from PIL import Image

from paper.fig4 import fig4
from paper.fig6 import fig6
from paper.fig9_to_12 import grasps
from paper.ladder import RUNGS, judge_ladder
from paper.rows import Cell, Row, TableSpec
from paper.table3 import table3
from paper.table4_fig5 import fig5, table4
from paper.table5_fig7_fig8 import fig7, fig8, table5
from paper.tables6_7 import ROWS6, ROWS7, judge_table6, judge_table7
from paper.trials import run_cells, subjects
from torchgrasp import __version__
from torchgrasp.app.report.page import render
from torchgrasp.files import format_json, hold_folder, write_file
from torchgrasp.foundation.errors import GraspError, Status
from torchgrasp.foundation.jobs import run_tasks

NOTE = (
    "Of M. Li, K. Hang, D. Kragic, A. Billard, <em>Dexterous grasping under shape uncertainty</em>, Robotics and "
    "Autonomous Systems 75 (2016) 352-364. Lifts are simulated; the paper's lifts are of a real hand, as is Fig. 13, "
    "which is not here. Objects are like the paper's, not the same. Intervals are 95 %, over families of objects. "
    "Times are processor seconds of this machine."
)
TIMES = ("filter_s", "shape_s", "milliseconds", "seconds", "plan_cpu_s")
"""Names of the numbers that are times: they differ from run to run."""
LIMIT = 3 * 3600.0
"""Wall time [s] after which a figure is given up."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """The sizes of the parts.

    Args:
        starts: of the contact planner in Table 4 and before every lift.
        drawn: starts behind Figs. 5 and 9 to 12.
        postures: held-out postures of Table 5, Figs. 7 and 8.
        fitted: postures of the criterion of Fig. 6.
        apart: postures of its cross-validation.
        folds: of its cross-validation.
        families: of objects from folders, one object each, beside the library's own four objects.
        grasps: lifted of each object and hand in Tables 6 and 7; of the ladder one.
        draws: lifts of each grasp in Tables 6 and 7.
    """

    starts: int = 1000
    drawn: int = 300
    postures: int = 100_000
    fitted: int = 40_000
    apart: int = 20_000
    folds: int = 10
    families: int = 1000
    grasps: int = 3
    draws: int = 10


FULL = Sizes()
"""Every trial: three grasps and ten lifts of each, as in the paper, of one object of every family.
"""
QUICK = dataclasses.replace(FULL, postures=20_000, folds=3, families=8, grasps=2, draws=1)
"""The default: fewer lifts, families, test postures and folds."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A table or pictures that one command makes; `sizes` are its options and the fields of `Sizes`
    for them.
    """

    name: str
    title: str
    make: Callable[..., None]
    sizes: dict[str, str] = dataclasses.field(default_factory=dict)
    pictures: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Trials:
    """A table of lifts; where `repeated`, several grasps are lifted several times."""

    name: str
    title: str
    rows: tuple[Row, ...]
    judge: Callable[[TableSpec, Iterator[tuple[Cell, ...]]], None]
    repeated: bool = True

    def spec(self, out: Path, objects: tuple[Path, ...], sizes: Sizes, workers: int) -> TableSpec:
        """Return the campaign of the table."""
        spec = TableSpec(out, objects, representatives=True, starts=sizes.starts, workers=workers)
        found = subjects(spec)
        few = [x.name for x in found if x.folder is None] + [x.name for x in found if x.folder][
            : sizes.families
        ]
        many = (
            {"grasps": sizes.grasps, "draws": sizes.draws}
            if self.repeated
            else {"grasps": 1, "draws": 1}
        )
        return dataclasses.replace(spec, only=tuple(few), **many)


PARTS = (
    Figure(
        "table3",
        "Table 3: points that the filter keeps of 1000, seconds of filter and shape",
        table3,
    ),
    Figure("fig4", "Fig. 4: whole and partial clouds, and their shapes", fig4, pictures=("fig4",)),
    Figure(
        "table4",
        "Table 4: certified contact triples, time, distance of centres",
        table4,
        {"starts": "starts"},
    ),
    Figure(
        "fig5",
        "Fig. 5: planned contacts, the paper's problem and ours",
        fig5,
        {"starts": "drawn"},
        ("fig5",),
    ),
    Figure(
        "fig6",
        "Fig. 6: the number of Gaussians by BIC and by cross-validation",
        fig6,
        {"n": "fitted", "apart": "apart", "folds": "folds"},
        ("fig6",),
    ),
    Figure(
        "table5",
        "Table 5: mean absolute error [rad] of the Barrett hand's joints",
        table5,
        {"n": "postures"},
    ),
    Figure(
        "fig7",
        "Fig. 7: the four cases of Table 5, true and predicted",
        fig7,
        {"n": "postures"},
        ("fig7",),
    ),
    Figure(
        "fig8",
        "Fig. 8: mean error [rad] of the Allegro hand's joints",
        fig8,
        {"n": "postures"},
        ("fig8",),
    ),
    Figure(
        "grasps",
        "Figs. 9 to 12: a contact triple by two postures and by two hands; grasps of both hands",
        grasps,
        {"starts": "drawn"},
        ("fig9", "fig10", "fig11", "fig12"),
    ),
    Trials("table6", "Table 6: how often ever riskier grasps hold", ROWS6, judge_table6),
    Trials(
        "table7", "Table 7: how often the same grasps hold under five closings", ROWS7, judge_table7
    ),
    Trials(
        "ladder",
        "From the paper's chain to the default, one stage at a time",
        RUNGS,
        judge_ladder,
        repeated=False,
    ),
)
"""All parts, in the order of the page."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """A reproduction. After a change of the code, take another folder.

    Args: out: folder of index.html, results.json, times.json and of all kept files. objects:
        folders of objects with noisy views, beside the library's own four; see docs/data.md. parts:
        names of the parts to make, as table3; by default all. full: every trial instead of fewer
        trials. workers: processes; the results do not depend on their number.
    """

    out: Path
    objects: tuple[Path, ...] = ()
    parts: tuple[str, ...] = ()
    full: bool = False
    workers: int = 2


def reproduce_all(spec: Annotated[Whole, tyro.conf.arg(name="")]) -> None:
    """Make Tables 3 to 7, Figs. 4 to 12 and the ladder, on one page with the paper's numbers beside
    ours.

    A run that was stopped continues, to a results.json of the same bytes. Times are in times.json.

    Args:
        spec: the reproduction.
    """
    reproduce(spec, FULL if spec.full else QUICK)


def reproduce(spec: Whole, sizes: Sizes) -> None:
    """Make the missing parts in given sizes, and write the page after each."""
    if unknown := sorted({*spec.parts} - {part.name for part in PARTS}):
        raise SystemExit(
            f"parts: {unknown} unknown; the parts are {', '.join(part.name for part in PARTS)}"
        )
    parts = [part for part in PARTS if not spec.parts or part.name in spec.parts]
    tables = {
        x.name: x.spec(spec.out, spec.objects, sizes, spec.workers)
        for x in parts
        if isinstance(x, Trials)
    }
    asked = {
        x.name: _plain(tables[x.name]) if isinstance(x, Trials) else options_of(x, sizes)
        for x in parts
    }
    left = [part for part in parts if _kept(spec.out, part.name, asked) is None]
    figures = [(part.name, spec.out, sizes) for part in left if isinstance(part, Figure)]
    lost = []
    with hold_folder(spec.out):
        for (name, *_), found in zip(
            figures, run_tasks(make_figure, figures, spec.workers, LIMIT), strict=True
        ):
            reason = found.sentence if isinstance(found, Status) else found
            lost += [name] if reason else []
            print(f"{name}: {reason or 'done'}", flush=True)
        write_pages(spec.out, sizes, parts, asked)
        for part in left:
            if isinstance(part, Trials):
                table = tables[part.name]
                began = time.process_time()
                said = io.StringIO()
                with contextlib.redirect_stdout(said):
                    part.judge(table, run_cells(table, part.rows))
                _finish(
                    spec.out,
                    part.name,
                    asked[part.name],
                    said.getvalue(),
                    time.process_time() - began,
                )
                write_pages(spec.out, sizes, parts, asked)
                print(f"{part.name}: done", flush=True)
    print(spec.out / "index.html")
    if lost:
        raise SystemExit(f"not made: {', '.join(lost)}")


def options_of(part: Figure, sizes: Sizes) -> dict[str, Any]:
    """Return the options of the command of a figure."""
    return {option: getattr(sizes, field) for option, field in part.sizes.items()}


def make_figure(name: str, out: Path, sizes: Sizes) -> str:
    """Make one figure and keep its output; return the reason of a failure, or nothing."""
    part = next(part for part in PARTS if part.name == name)
    assert isinstance(part, Figure)
    began = time.process_time()
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        try:
            part.make(out, **options_of(part, sizes))
        except GraspError as error:
            return str(error)
    _finish(out, name, options_of(part, sizes), said.getvalue(), time.process_time() - began)
    return ""


def _finish(out: Path, name: str, asked: dict[str, Any], said: str, seconds: float) -> None:
    """Keep options, output and time of a finished part."""
    lines = [line for line in said.splitlines() if not line.startswith(str(out))]
    content = {"asked": asked, "said": lines, "seconds": seconds}
    write_file(out / "parts" / f"{name}.json", format_json(content))


def _kept(out: Path, name: str, asked: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Return what is kept of a finished part with the same options, with its numbers; None if it is
    missing.
    """
    record = out / "parts" / f"{name}.json"
    numbers = out / f"{name}.json"
    content = json.loads(record.read_text("utf-8")) if record.is_file() else {"asked": None}
    if content["asked"] != asked[name]:
        return None
    return content | {
        "numbers": json.loads(numbers.read_text("utf-8")) if numbers.is_file() else {}
    }


def _plain(table: TableSpec) -> dict[str, Any]:
    """Return the fields of a table on which its numbers depend."""
    left_out = {"out", "objects", "workers", "finished"}
    return {
        k: list(v) if isinstance(v, tuple) else v
        for k, v in vars(table).items()
        if k not in left_out
    }


def write_pages(
    out: Path, sizes: Sizes, parts: list[Figure | Trials], asked: dict[str, dict[str, Any]]
) -> None:
    """Write index.html, results.json without times, and times.json, of the finished parts."""
    kept = [(part, _kept(out, part.name, asked)) for part in parts]
    results = {}
    times = {}
    for part, content in kept:
        if content is not None:
            numbers = {k: x for k, x in content["numbers"].items() if k not in ("cells", "asked")}
            said = {} if numbers else {"said": content["said"]}
            results[part.name] = {
                "title": part.title,
                "asked": content["asked"],
                **said,
                "numbers": _round(numbers),
            }
            times[part.name] = {"seconds": content["seconds"], **only_times(numbers)}
    about = {"torchgrasp": __version__, "sizes": dataclasses.asdict(sizes)}
    write_file(out / "results.json", format_json({**about, "parts": results}))
    write_file(out / "times.json", format_json(times))
    few = [
        f"{k} {x} of {y}"
        for (k, x), y in zip(vars(sizes).items(), vars(FULL).values(), strict=True)
        if x < y
    ]
    trials = f"fewer trials than --full: {', '.join(few)}" if few else "every trial (--full)"
    body = [f'<p class="source">torchgrasp {__version__}; {escape(trials)}</p>', f"<p>{NOTE}</p>"]
    body += [_section(out, part, content) for part, content in kept]
    title = "Dexterous grasping under shape uncertainty, reproduced"
    write_file(out / "index.html", render("base.html", title=title, body=Markup("\n".join(body))))


def _section(out: Path, part: Figure | Trials, content: dict[str, Any] | None) -> str:
    """Return the section of a part: its output and its pictures."""
    lines = [f"<h2>{escape(part.title)}</h2>"]
    if content is None:
        return "\n".join([*lines, "<p><strong>Not finished.</strong></p>"])
    lines += [f"<pre>{escape(chr(10).join(content['said']))}</pre>"] * bool(content["said"])
    for name in part.pictures if isinstance(part, Figure) else ():
        packed = io.BytesIO()
        with Image.open(out / f"{name}.png") as picture:
            picture.convert("RGB").save(packed, format="JPEG", quality=88)
        data = base64.b64encode(packed.getvalue()).decode("ascii")
        lines.append(f'<figure><img alt="{name}" src="data:image/jpeg;base64,{data}"></figure>')
    options = "".join(
        f" --{key} {value}" for key, value in content["asked"].items() if type(value) is int
    )
    command = f"scripts/reproduce.py {part.name}{options}"
    return "\n".join([*lines, f'<p class="source"><code>{escape(command)}</code></p>'])


def _round(value: Any) -> Any:
    """Drop times, and round every number to six digits."""
    if isinstance(value, dict):
        return {key: _round(x) for key, x in value.items() if key not in TIMES}
    if isinstance(value, list):
        return [_round(x) for x in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def only_times(value: Any, name: str = "") -> dict[str, Any]:
    """Return the times below a value by their place."""
    pairs = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    found: dict[str, Any] = {}
    for key, x in pairs:
        place = f"{name}/{key}".lstrip("/")
        found |= {place: x} if key in TIMES else only_times(x, place)
    return found
