"""The HTML page of an evaluation: success rates with intervals, and failures."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchgrasp.app.report.page import TEMPLATES, render
from torchgrasp.evaluation.causes import CAUSES
from torchgrasp.evaluation.intervals import Share, format_share
from torchgrasp.evaluation.summary import ViewScore, summarise
from torchgrasp.evaluation.touch import TOUCH
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status

NAMES = json.loads((TEMPLATES / "evaluation.json").read_text("utf-8"))
SHARE_NAMES: dict[str, str] = NAMES["shares"]
"""Descriptions of the success rates of a summary."""
OBJECT_HEADS = ("object", "pass", "with its 95 % interval", "interval", "of", "best-ranked")
"""Titles of the columns of the table of objects; those of the views follow."""


@checked
def write_evaluation(
    path: Path | str, title: str, asked: Mapping[str, object], scores: Sequence[ViewScore]
) -> Path:
    """Write the HTML page of an evaluation, atomically; return the path.

    Args:
        path: the file to write.
        title: title of the page.
        asked: settings that the page lists, by name, such as {"hand": "allegro"}.
        scores: the `ViewScore` of each view, as `evaluate` yields them.

    Raises `OutputError` if the file cannot be written.

    >>> import tempfile
    >>> jug = ViewScore("jug", "view0", 0, 4.0, note="an open surface")
    >>> path = Path(tempfile.mkdtemp(), "page.html")
    >>> "allegro" in write_evaluation(path, "Jugs", {"hand": "allegro"}, [jug]).read_text()
    True
    """
    return write_file(path, format_evaluation(title, asked, scores))


def format_evaluation(title: str, asked: Mapping[str, object], scores: Sequence[ViewScore]) -> str:
    """Return the HTML page of an evaluation as text: success rates, failures and settings.

    `asked` are the settings that the page lists, by name. `scores` are the results of all views, as
    `evaluate` yields them.
    """
    summary = summarise(scores)
    groups = {"": summary} | {f"{group}: ": some for group, some in summary["by_group"].items()}
    shares = [
        (f"{group}{name}", *_share_cells(some[key], 1))
        for group, some in groups.items()
        for key, name in SHARE_NAMES.items()
    ]
    lost = [
        (stage, name, n)
        for stage, reasons in summary["failures"].items()
        for name, n in reasons.items()
    ]
    most = max((n for *_, n in lost), default=1)  # the longest bar
    views = sorted({score.view for score in scores})
    return render(
        "evaluation.html",
        title=title,
        summary=summary,
        verdict=f"Passed: {format_share(summary['gsr'])}, with the 95 % interval over families.",
        shares=shares,
        heads=[*OBJECT_HEADS, *views],
        objects=_object_rows(scores, views, summary["by_object"]),
        failures=[
            (stage, name.lower(), str(n), n / most, Status[name].sentence)
            for stage, name, n in lost
        ],
        causes=[(name, text, CAUSES[name][1]) for name, text in list_causes(summary)],
        notes=[(score.object, score.view, score.note) for score in scores if score.note],
        figures=list_figures(summary),
        success=_describe_prediction(summary["success"]),
        bins=_bin_rows(summary["success"]),
        asked=_setting_rows(asked),
    )


def _setting_rows(asked: Mapping[str, object], within: str = "") -> list[tuple[str, str]]:
    """Return a table row for each setting; those of a group begin with its name, `within`."""
    rows = []
    for name, value in asked.items():
        title = f"{within}{name.replace('_', ' ')}"
        if isinstance(value, Mapping):
            rows += _setting_rows(value, f"{title}: ")
        else:
            rows.append((title, "-" if value is None else str(value)))
    return rows


def _describe_prediction(success: Mapping[str, Any] | None) -> str | None:
    """Return a sentence on how well success was predicted; None without predictions."""
    if not success:
        return None
    return (
        f"Predicted {success['predicted']:.0%}, passed {success['passed']:.0%}; "
        f"expected calibration error {_number(success['error'], '.2f')}, "
        f"Brier skill {_number(success['skill'], '.2f')}, "
        f"area under the curve {_number(success['auc'], '.2f')}."
    )


def _number(value: int | float | None, style: str) -> str:
    """Return a number as text in a format `style`, and one that was not measured as "-"."""
    return "-" if value is None or math.isnan(value) else format(value, style)


def _bin_rows(success: Mapping[str, Any] | None) -> list[tuple[Any, ...]]:
    """Return a table row for each range of predicted success: how many passed."""
    rows = []
    for x in success["bins"] if success else ():
        cells = _share_cells(x.passed, 0)
        rows.append((f"{x.low:.0%} to {x.high:.0%}", f"{x.predicted:.0%}", *cells))
    return rows


def _share_cells(share: Share, digits: int) -> tuple[Any, ...]:
    """Return table cells for a success rate: value, the share itself, which is drawn, interval and
    number of trials.
    """
    value, low, high = ("-" if math.isnan(x) else f"{x:.{digits}%}" for x in share[:3])
    interval = f"{low} to {high}" if share.units > 1 else "-"
    return value, share, interval, str(share.total)


def _object_rows(
    scores: Sequence[ViewScore], views: Sequence[str], by_object: Mapping[str, Any]
) -> list[tuple[Any, ...]]:
    """Return a table row for each object: its success rates, and the outcome of each view."""
    outcome = {}
    for score in scores:
        passed = f"{sum(attempt.passed for attempt in score.attempts)} / {len(score.attempts)}"
        outcome[score.object, score.view] = passed if score.attempts else score.refusal.name.lower()
    rows = []
    for name, row in by_object.items():
        # an object of which nothing was tried has no success
        untried = math.isnan(row["gsr"].value) or math.isnan(row["top1"].value)
        best = "-" if untried else f"{row['top1'].value:.0%}"
        cells = [outcome.get((name, view), "") for view in views]
        rows.append((name, *_share_cells(row["gsr"], 0), best, *cells))
    return rows


def list_causes(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the name and a text for each cause for which objects were not held in an evaluation.

    The text holds how often this cause was found, in all and for each group of objects. It also
    holds the median of a number that measures the cause, with its unit. `summary` holds the
    statistics of the evaluation, by name.
    """
    rows = []
    for name, found in summary["causes"].items():
        groups = ", ".join(f"{n} {group}" for group, n in found["by_group"].items() if group)
        size = f"median {_number(found['median'], '.3g')} {CAUSES[name][0]}"
        rows.append((name, f"{found['count']}{groups and f' ({groups})'}, {size}"))
    return rows


def list_figures(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return label and text of each number of an evaluation, such as a mean force or a time.

    The labels hold the units. `summary` holds the statistics of the evaluation, by name. The text
    of a number that is unknown is "-".
    """
    rows = []
    for key, (text, style) in NAMES["figures"].items():
        value = summary[key]
        found = value if isinstance(value, tuple | list) else [value]
        texts = ["-" if x is None else _number(x, style) for x in found]
        rows.append((text, ", ".join(texts)))
    if summary["touch"]:
        texts = [f"{n} {name}" for name, n in summary["touch"].items()]
        limit = f"{1000 * TOUCH.limit:g} mm"
        rows.append((f"fingertips before any force, within {limit}", ", ".join(texts)))
    return rows
