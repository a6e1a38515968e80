"""What a reproduction has made so far: index.html, results.json without any time, and times.json."""

import base64
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape
from PIL import Image

from paper.whole.parts import EVERY, FIGURES, FULL, TRIALS, Figure, Sizes, Trials
from paper.whole.tables import HAND, TABLES, count_own
from torchgrasp import __version__
from torchgrasp.app.report.page import format_table, render
from torchgrasp.files import format_json, write_file

TIMES = ("filter_s", "shape_s", "milliseconds", "seconds", "plan_cpu_s")
"""Names of the numbers that are times: they differ from run to run."""
DIGITS = 6
"""Significant digits in results.json: another machine rounds the last bits otherwise."""
ORDER = ("table3", "fig4", "table4", "fig5", "fig6", "table5", "fig7", "fig8", "grasps", "table6", "table7", "ladder")
"""Of the parts on the page."""
QUALITY = 88
"""Of JPEG: text on the pictures stays sharp, and a page takes a few MB."""


def write_pages(out: Path, sizes: Sizes, asked: dict[str, dict[str, Any]]) -> None:
    """Write what the parts that are finished have made.

    Args:
        out: folder of the reproduction.
        sizes: how large its parts are.
        asked: of what each part is made; others are not on the page.
    """
    parts = {part.name: part for part in (*FIGURES, *TRIALS)}
    found = {name: read_part(out, parts[name], asked[name]) for name in ORDER if name in asked}
    kept = {name: content for name, content in found.items() if content is not None}
    results = {name: without_times(content) for name, content in kept.items()}
    times = {name: {"seconds": content["seconds"], **only_times(content["numbers"])} for name, content in kept.items()}
    about = {"torchgrasp": __version__, "sizes": dataclasses.asdict(sizes)}
    write_file(out / "results.json", format_json({**about, "parts": results}))
    write_file(out / "times.json", format_json(times))
    body = [f'<p class="source">torchgrasp {__version__}; {escape(describe(sizes))}</p>', f"<p>{NOTE}</p>"]
    body += [_section(out, parts[name], content) for name, content in found.items()]
    title = "Dexterous grasping under shape uncertainty, reproduced"
    write_file(out / "index.html", render("base.html", title=title, body=Markup("\n".join(body))))


NOTE = (
    "Of M. Li, K. Hang, D. Kragic, A. Billard, <em>Dexterous grasping under shape uncertainty</em>, Robotics and "
    "Autonomous Systems 75 (2016) 352-364. Lifts are simulated; the paper's are of a real hand, and so is Fig. 13, "
    "which is not here. Objects are like the paper's, not the same. Intervals are 95 %, over families of objects. "
    "Times are processor seconds of this machine."
)


def describe(sizes: Sizes) -> str:
    """Say how many trials were made, and of how many."""
    if sizes == FULL:
        return "every trial (--full)"
    pairs = zip(vars(sizes), _values(sizes), _values(FULL), strict=True)
    few = [f"{name} {x} of {'all' if y == EVERY else y}" for name, x, y in pairs if x < y]
    return f"fewer trials than --full: {', '.join(few)}"


def _values(sizes: Sizes) -> list[int]:
    return list(dataclasses.asdict(sizes).values())


def read_part(out: Path, part: Figure | Trials, asked: dict[str, Any]) -> dict[str, Any] | None:
    """Return what a finished part was asked, printed and wrote; None if it is not finished."""
    record = out / "parts" / f"{part.name}.json"
    content = json.loads(record.read_text("utf-8")) if record.is_file() else {"asked": None}
    if content["asked"] != asked:
        return None
    numbers = json.loads((out / f"{part.name}.json").read_text("utf-8")) if part.name in TABLES else {}
    return {"title": part.title, **content, "numbers": numbers}


def without_times(content: dict[str, Any]) -> dict[str, Any]:
    """Return what of a part is the same in every run: no times, and no more digits than are sure."""
    numbers = {key: x for key, x in content["numbers"].items() if key not in ("cells", "asked")}
    if "cells" in content["numbers"] and "rows" in numbers:
        numbers |= {HAND: count_own(content["numbers"])}
    said = {} if numbers else {"said": content["said"]}
    return {"title": content["title"], "asked": content["asked"], **said, "numbers": _round(numbers)}


def _round(value: Any) -> Any:
    """Drop times, and round every number."""
    if isinstance(value, dict):
        return {key: _round(x) for key, x in value.items() if key not in TIMES}
    if isinstance(value, list):
        return [_round(x) for x in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def only_times(value: Any, name: str = "") -> dict[str, Any]:
    """Return the times below a value by their place."""
    if isinstance(value, dict):
        items = ((f"{name}/{key}".lstrip("/"), key, x) for key, x in value.items() if key != "cells")
    elif isinstance(value, list):
        items = ((f"{name}/{k}", "", x) for k, x in enumerate(value))
    else:
        return {}
    found: dict[str, Any] = {}
    for place, key, x in items:
        found |= {place: x} if key in TIMES else only_times(x, place)
    return found


def _section(out: Path, part: Figure | Trials, content: dict[str, Any] | None) -> str:
    """Return the section of a part."""
    lines = [f"<h2>{escape(part.title)}</h2>", f"<p>{escape(part.about)}</p>"]
    if content is None:
        return "\n".join([*lines, "<p><strong>Not finished.</strong></p>"])
    if part.name in TABLES:
        table = TABLES[part.name](content["numbers"])
        lines.append(format_table(table.heads, table.rows, numbers=table.numbers))
    else:
        lines += [f"<pre>{escape(chr(10).join(content['said']))}</pre>"] * bool(content["said"])
    lines += [_picture(out / f"{name}.png", name) for name in getattr(part, "pictures", ())]
    options = ", ".join(f"{key} {value}" for key, value in content["asked"].items() if type(value) is int)
    command = f"scripts/reproduce.py {part.name}" + (f"; {options}" if options else "")
    return "\n".join([*lines, f'<p class="source"><code>{escape(command)}</code></p>'])


def _picture(path: Path, name: str) -> str:
    """Return a picture as part of the page."""
    packed = io.BytesIO()
    with Image.open(path) as picture:
        picture.convert("RGB").save(packed, format="JPEG", quality=QUALITY)
    data, title = base64.b64encode(packed.getvalue()).decode("ascii"), name.replace("fig", "Fig. ")
    return f'<figure><img alt="{title}" src="data:image/jpeg;base64,{data}"><figcaption>{title}</figcaption></figure>'
