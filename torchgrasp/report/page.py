"""The report of one run as a single HTML page: no script, no link, pictures inside, every text escaped."""

import base64
import html
import math
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from torchgrasp.base import count_status
from torchgrasp.files import write_file
from torchgrasp.report.palette import FINGERS
from torchgrasp.report.pictures import (
    draw_cloud,
    draw_contacts,
    draw_grasp,
    draw_surface,
    draw_tick,
    facing,
    turned,
    view_of,
)
from torchgrasp.report.plots import plot_forces, plot_motion
from torchgrasp.report.run import Run, verdict
from torchgrasp.values import Grasps

ROWS = 10
"""How many grasps the table lists."""

POLICY = (
    '<meta http-equiv="Content-Security-Policy" '
    "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
)
"""A page opened from a file may load nothing from elsewhere, whatever a name in it says."""

STYLE = """
body { margin: 0; background: #f3f2ee; color: #22262b; font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif }
main { max-width: 1080px; margin: 0 auto; padding: 40px 28px 64px }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 6px; letter-spacing: -.01em }
h2 { font-size: 19px; margin: 40px 0 12px }
.source { color: #6a717b; margin: 0 0 20px; overflow-wrap: anywhere }
.verdict { font-size: 18px; padding: 14px 18px; margin: 0; background: #fff; border-left: 5px solid #23967f }
.verdict.bad { border-color: #c2452d }
.scroll { overflow-x: auto }
table { border-collapse: collapse; background: #fff; width: 100% }
th, td { padding: 7px 12px; text-align: left; border-bottom: 1px solid #e7e5de; vertical-align: top }
th { font-size: 13px; font-weight: 600; color: #6a717b; white-space: nowrap }
.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
.grid { display: grid; gap: 16px; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)) }
.pairs { grid-template-columns: repeat(auto-fit, minmax(440px, 1fr)) }
figure { margin: 0; background: #fcfcfa; border: 1px solid #e7e5de; border-radius: 6px; overflow: hidden }
figure img { display: block; width: 100% }
figcaption { padding: 10px 14px; font-size: 14px; color: #4b525b; border-top: 1px solid #e7e5de }
.dot { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin: 0 5px 0 10px }
code { font: 13px/1.5 ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere }
"""


def write_report(path: Path | str, run: Run) -> Path:
    """Draw the pictures of a run and write them with its tables as one HTML file, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    return write_file(path, format_page(run, draw_pictures(run)))


def draw_pictures(run: Run) -> dict[str, list[tuple[str, bytes]]]:
    """Draw every picture of a run: for each section its captions and PNGs."""
    view, table, best = view_of(run.cloud), run.spec.table, run.executable
    sections = {
        "Seen and unseen": [
            ("The cloud from the camera's side, coloured by height.", draw_cloud(run.cloud, table)),
            ("The estimated surface from the camera's side.", draw_surface(run.surface, view, table)),
            ("The same from behind, where nothing was seen.", draw_surface(run.surface, turned(view, 180.0), table)),
        ]
    }
    if len(best):
        front = facing(best)
        sections["The best grasp"] = [
            ("Contacts with outward normals.", draw_contacts(run.surface, best.contacts[0], front, table)),
            ("The hand on the estimated surface.", draw_grasp(run.surface, run.hand, best[0], front, table)),
            ("The same from another side.", draw_grasp(run.surface, run.hand, best[0], turned(front, 60.0), table)),
        ]
    if run.closure is not None and run.mesh is not None:
        side = turned(facing(best), 20.0) if len(best) else view
        sections["Closing on the true object"] = [
            ("Before closing.", draw_tick(run.mesh, run.hand, run.closure, 0, side)),
            ("At the end.", draw_tick(run.mesh, run.hand, run.closure, -1, side)),
            ("Normal force of each fingertip.", plot_forces(run.closure, run.hand.finger_names)),
            ("Motion of hand and object.", plot_motion(run.closure)),
        ]
    return sections


def format_page(run: Run, pictures: dict[str, list[tuple[str, bytes]]]) -> str:
    """Return the page of a run as text."""
    good = run.closure.held if run.closure is not None else len(run.executable) > 0
    title = f"Grasps of the {run.object_name} with the {run.hand.name} hand"
    stages = [(s.name, s.message, f"{s.seconds:.1f}") for s in run.stages]
    stages.append(("total", "", f"{sum(s.seconds for s in run.stages):.1f}"))
    body = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="source">from {_text(run.source)}, {len(run.cloud)} points</p>',
        f'<p class="verdict{"" if good else " bad"}">{_text(verdict(run))}</p>',
        *(_section(name, shots, run) for name, shots in pictures.items()),
        "<h2>Stages</h2>",
        _table(("stage", "result", "seconds"), stages, numbers={2}),
    ]
    if len(run.executable):
        body += [f"<h2>Best grasps ({min(ROWS, len(run.executable))} of {len(run.executable)})</h2>", _grasps(run)]
    if run.plan is not None:
        rows = [(str(n), s.name.lower(), s.sentence) for s, n in count_status(run.plan.status).items()]
        body += ["<h2>What became of every start</h2>", _table(("count", "status", "meaning"), rows, numbers={0})]
    if len(run.grasps):
        rows = [(str(n), s.name.lower(), s.sentence) for s, n in count_status(run.grasps.status).items()]
        body += ["<h2>What became of every posture</h2>", _table(("count", "status", "meaning"), rows, numbers={0})]
    facts = [(name.replace("_", " "), value) for name, value in sorted(run.grasps.meta.items())]
    body += ["<h2>Provenance</h2>", _table(("what", "value"), facts, code={1})]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{_text(title)}</title>'
    content = "\n".join(body)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>{POLICY}{head}<style>{STYLE}</style></head>\n'
        f"<body><main>\n{content}\n</main></body>\n</html>\n"
    )


def grasp_rows(grasps: Grasps, most: int = ROWS) -> list[tuple[str, ...]]:
    """Return the first rows of grasps as text, in the order of `GRASP_COLUMNS`."""
    rows = []
    for rank, grasp in enumerate(grasps[: min(most, len(grasps))], 1):
        rows.append(
            (
                str(rank),
                f"{float(grasp.score[0]):.3f}",
                f"{1e3 * float(grasp.tip_error[0].max()):.2f}",
                f"{1e3 * float(grasp.clearance[0]):.1f}",
                f"{math.degrees(float(grasp.normal_angle[0].max())):.0f}",
                f"{float(grasp.certificate.margin[0]):.4f}",
                f"{1e3 * float(grasp.contacts.std_m[0].max()):.1f}",
            )
        )
    return rows


GRASP_COLUMNS = ("rank", "score", "tip error mm", "clearance mm", "pad angle deg", "closure margin", "surface std mm")
"""Heads of `grasp_rows`; errors, angles and deviations are those of the worst finger."""


def _grasps(run: Run) -> str:
    """Return the table of the best grasps."""
    return _table(GRASP_COLUMNS, grasp_rows(run.executable), numbers=set(range(len(GRASP_COLUMNS))))


def _section(name: str, shots: Sequence[tuple[str, bytes]], run: Run) -> str:
    """Return a section of pictures, with the colours of the fingers where a hand or contacts are shown."""
    legend = "".join(
        f'<span class="dot" style="background:{color}"></span>{_text(finger)}'
        for finger, color in zip(run.hand.finger_names, FINGERS, strict=True)
    )
    figures = "\n".join(
        f'<figure><img alt="{_text(caption)}" src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}">'
        f"<figcaption>{_text(caption)}</figcaption></figure>"
        for caption, png in shots
    )
    fingers = f"<p>{legend}</p>" if name == "The best grasp" else ""
    pairs = " pairs" if len(shots) % 3 else ""
    return f'<h2>{_text(name)}</h2>\n{fingers}<div class="grid{pairs}">\n{figures}\n</div>'


def _table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Collection[int] = (), code: Collection[int] = ()
) -> str:
    """Return a table; columns in `numbers` are set flush right, those in `code` in a fixed width."""

    def cell(tag: str, column: int, value: str) -> str:
        inner = f"<code>{_text(value)}</code>" if column in code and tag == "td" else _text(value)
        align = ' class="n"' if column in numbers else ""
        return f"<{tag}{align}>{inner}</{tag}>"

    lines = ["".join(cell("th", i, head) for i, head in enumerate(heads))]
    lines += ["".join(cell("td", i, value) for i, value in enumerate(row)) for row in rows]
    return '<div class="scroll"><table>' + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def _text(value: object) -> str:
    """Return anything as text that HTML takes literally."""
    return html.escape(str(value), quote=True)
