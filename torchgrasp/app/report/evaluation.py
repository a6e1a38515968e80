"""The page of an evaluation: shares with intervals, and failures."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchgrasp.app.report.document import Markup, escape, format_document, format_html_table
from torchgrasp.checks import checked
from torchgrasp.errors import Status
from torchgrasp.evaluation.intervals import Share, format_share
from torchgrasp.evaluation.score import ViewScore, summarise
from torchgrasp.files import write_file

WIDTH, HEIGHT = 180, 16
"""Size of a bar [pixels]."""

SHARE_NAMES = {
    "gsr": "grasps tried that pass",
    "top1": "best-ranked grasps that pass, of all views",
    "objects": "objects with a grasp that passes",
}
"""The shares of a summary in words."""


@checked
def write_evaluation(path: Path | str, title: str, asked: Mapping[str, object], scores: Sequence[ViewScore]) -> Path:
    """Write the page of an evaluation, atomically: the scores of `evaluate`, and its settings by name.

    Raises:
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp.evaluation import ProtocolResult
    >>> jug = ViewScore("jug", "view0", 40, 4.0, (ProtocolResult(0, 0, True, Status.OK, predicted=0.9),))
    >>> page = write_evaluation(Path(tempfile.mkdtemp(), "evaluation.html"), "Jugs", {"hand": "allegro"}, [jug])
    >>> "allegro" in page.read_text()
    True
    """
    return write_file(path, format_evaluation(title, asked, scores))


def format_evaluation(title: str, asked: Mapping[str, object], scores: Sequence[ViewScore]) -> str:
    """Return the page of an evaluation as text."""
    summary = summarise(scores)
    verdict = f"Passed: {format_share(summary['gsr'])}, with the 95 % interval over families."
    heads = ("what", "share", "with its 95 % interval, 0 to 100 %", "interval", "of")
    shares = [(name, *_share_cells(summary[key], 1)) for key, name in SHARE_NAMES.items()]
    for group, some in summary["by_group"].items():
        shares += [(f"{group}: {name}", *_share_cells(some[key], 1)) for key, name in SHARE_NAMES.items()]
    notes = [(score.object, score.view, score.note) for score in scores if score.note]
    body = [
        f'<p class="verdict{"" if summary["gsr"].value > 0 else " bad"}">{escape(verdict)}</p>',
        "<h2>Shares</h2>",
        format_html_table(heads, shares, numbers={1, 3, 4}),
        "<h2>By object and view</h2>",
        _objects(scores, summary["by_object"]),
        "<h2>What went wrong, by stage</h2>",
        _failures(summary["failures"]),
        *(["<h3>Refused</h3>", format_html_table(("object", "view", "why"), notes)] if notes else []),
        "<h2>Forces, overlap and time</h2>",
        format_html_table(("what", "value"), _figures(summary), numbers={1}),
        *_predictions(summary["success"]),
        "<h2>What was asked</h2>",
        format_html_table(("what", "value"), [(k.replace("_", " "), str(v)) for k, v in asked.items()], code={1}),
    ]
    return format_document(title, body)


def bar(share: Share) -> Markup:
    """Draw a share as a mark and its interval, if it has one, as a line.

    >>> bar(Share(0.5, 0.25, 0.75, 8, 4)).count("<line"), bar(Share(0.5, math.nan, math.nan, 8, 1)).count("<line")
    (2, 1)
    """
    value, low, high = (x * (WIDTH - 8) + 4 for x in share[:3])
    middle = HEIGHT / 2
    scale = f'<line x1="4" x2="{WIDTH - 4}" y1="{middle}" y2="{middle}" stroke="#e7e5de" stroke-width="8"/>'
    ends = f'<line x1="{low:.1f}" x2="{high:.1f}" y1="{middle}" y2="{middle}" stroke="#8fc8bb" stroke-width="8"/>'
    mark = f'<circle cx="{value:.1f}" cy="{middle}" r="4" fill="#23967f"/>'
    drawn = scale + ("" if math.isnan(low) else ends) + ("" if math.isnan(value) else mark)
    return Markup(f'<svg class="bar" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{drawn}</svg>')


def _share_cells(share: Share, digits: int) -> tuple[str, ...]:
    """Return a share in numbers and drawn."""
    value, low, high = ("-" if math.isnan(x) else f"{x:.{digits}%}" for x in share[:3])
    return value, bar(share), f"{low} to {high}" if share.units > 1 else "-", str(share.total)


def _objects(scores: Sequence[ViewScore], by_object: Mapping[str, Any]) -> str:
    """Return the table of objects, with a column for each view."""
    views = sorted({score.view for score in scores})
    outcome = {}
    for score in scores:
        passed = f"{sum(attempt.passed for attempt in score.attempts)} / {len(score.attempts)}"
        outcome[score.object, score.view] = passed if score.attempts else score.refusal.name.lower()
    rows = []
    for name, row in by_object.items():
        cells = [outcome.get((name, view), "") for view in views]
        rows.append(
            (
                name,
                *_share_cells(row["gsr"], 0),
                "-" if math.isnan(row["top1"].value) else f"{row['top1'].value:.0%}",
                *cells,
            )
        )
    heads = ("object", "pass", "with its 95 % interval", "interval", "of", "best-ranked", *views)
    return format_html_table(heads, rows, numbers={1, 3, 4, 5, *range(6, 6 + len(views))})


def _failures(failures: Mapping[str, Mapping[str, int]]) -> str:
    """Return the table of failures with meanings and bars."""
    most = max((n for reasons in failures.values() for n in reasons.values()), default=1)
    rows = []
    for stage, reasons in failures.items():
        for name, n in reasons.items():
            swatch = Markup(f'<span class="swatch" style="width:{160 * n / most:.0f}px"></span>')
            rows.append((stage, name.lower(), str(n), swatch, Status[name].sentence))
    return format_html_table(("stage", "reason", "count", "", "meaning"), rows, numbers={2})


def _predictions(found: Mapping[str, Any] | None) -> list[Markup | str]:
    """Return how true predicted success was, bin by bin; nothing without predictions."""
    if found is None:
        return []
    said = (
        f"Predicted {found['predicted']:.0%}, passed {found['passed']:.0%}; expected calibration error "
        f"{found['error']:.2f}, Brier skill {found['skill']:.2f}, area under the curve {found['auc']:.2f}."
    )
    rows = [(f"{x.low:.0%} to {x.high:.0%}", f"{x.predicted:.0%}", *_share_cells(x.passed, 0)) for x in found["bins"]]
    heads = ("predicted", "mean", "passed", "with its 95 % interval", "interval", "of")
    table = format_html_table(heads, rows, numbers={1, 2, 4, 5})
    return ["<h2>Predicted success, and what passed</h2>", f"<p>{escape(said)}</p>", table]


def _figures(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return forces, overlap and times in words."""
    names = {
        "force_n": ("mean normal force of a finger [N]", ".2f"),
        "overlap_mm": ("overlap of hand and object at the grasp, mean [mm]", ".1f"),
        "overlap_mm_max": ("overlap of hand and object at the grasp, most [mm]", ".1f"),
        "plan_cpu_s": ("CPU time to plan on a view [s]", ".1f"),
        "trial_cpu_s": ("CPU time of an attempt [s]", ".2f"),
        "cpu_s": ("CPU time in all [s]", ".0f"),
    }
    rows = [
        (text, "-" if summary[key] is None else format(summary[key], style)) for key, (text, style) in names.items()
    ]
    return [("views without a grasp", str(summary["refused"])), ("grasps offered", str(summary["executable"])), *rows]
