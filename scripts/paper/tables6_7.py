"""Tables 6 and 7 of the paper: riskier contacts hold less often, and the closing law holds more
often.
"""

import dataclasses
import math
import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from paper.rows import Cell, Row, TableSpec
from paper.trials import PAPER, run_cells
from torchgrasp.evaluation import Share
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.files import format_columns, format_json, write_file
from torchgrasp.values.specs import ClosingMode, HoldingMode

Asked = Annotated[TableSpec, tyro.conf.arg(name="")]
"""A spec whose fields are options of the command."""

THRESHOLDS = (0.03, 0.06, 0.10)
"""S_thresh of Table 6."""

PUBLISHED = {
    "0.03": "40 63 57",
    "0.06": "43 33 30",
    "0.10": "30 27 23",
    "paper, impedance": "40 63 57",
    "paper_position, position": "17 10 13",
}
"""Per cent of the paper's cylinder, spray and jug, of 30 trials each."""

HEADS = (
    *("row", "hand", "held of the lifts", "objects with a grasp", "pushed", "slip"),
    *("most certain first", "paper"),
)
"""Heads of the columns of both tables."""

FORCE: HoldingMode = "force"
"""The holding under which all closings are compared."""
OWN: dict[ClosingMode, HoldingMode] = {
    "uncertainty": FORCE,
    "fixed": FORCE,
    "paper": "impedance",
    "position": "position",
    "paper_position": "position",
}
"""The closings of Table 7, and how each holds where each holds in its own way."""


ROWS6 = tuple(Row(f"{t:.2f}", "paper", t, "uncertainty", "force") for t in THRESHOLDS)
"""Rows of Table 6.

The thresholds are variances of the paper's shape: on the completed one hardly any contact reaches
the first of them.
"""
ROWS7 = tuple(
    Row(f"{closing}, {holding}", "camera", THRESHOLDS[0], closing, holding)
    for closing, own in OWN.items()
    for holding in dict.fromkeys((FORCE, own))
)
"""Rows of Table 7, on the library's default shape."""


def table6(spec: Asked) -> None:
    """Print Table 6: how often grasps hold whose contacts are less and less certain, on the paper's
    shape.

    The riskiest grasps of each view are lifted under the library's closing.

    Args:
        spec: what the table is made of.
    """
    rows = gather(run_cells(spec, ROWS6))
    numbers = report(rows)
    fall = contrast_over([count_held(row) for row in rows], line_weights(THRESHOLDS))
    found = "excludes zero" if fall.low > 0 or fall.high < 0 else "does not exclude zero"
    print(f"fall of the line from first to last: {format_points(fall)}; the interval {found}")
    write(spec.out / "table6.json", spec, rows, {"rows": numbers, "fall": fall})


def table7(spec: Asked) -> None:
    """Print Table 7: how often the same grasps hold, closed in five ways. They are held alike, and
    as each closing does itself.

    The riskiest grasps below the first threshold are lifted.

    Args:
        spec: what the table is made of.
    """
    rows = gather(run_cells(spec, ROWS7))
    numbers = report(rows)
    held = {row[0].row: count_held(row) for row in rows}
    alike = [f"{closing}, {FORCE}" for closing in OWN]
    own = [f"{closing}, {holding}" for closing, holding in OWN.items()]
    pairs = [(names[0], name) for names in (alike, own) for name in names[1:]]
    # the paper's law over the baselines
    pairs += [(names[2], name) for names in (alike, own) for name in names[3:]]
    gains = {f"{a} over {b}": contrast_over([held[a], held[b]], [1.0, -1.0]) for a, b in pairs}
    for name, gain in gains.items():
        print(f"{name}: {format_points(gain)}")
    write(spec.out / "table7.json", spec, rows, {"rows": numbers, "gains": gains})


def gather(cells: Iterator[tuple[Cell, ...]]) -> list[list[Cell]]:
    """Print the lifts that held of each object and hand as they come, and return the cells by row.

    `cells` yields for each object and hand its cells in all rows.
    """
    rows: list[list[Cell]] = []
    for found in cells:
        if not rows:
            within = f"{1e3 * PAPER.noise.translation:.0f} mm"
            within += f" and {math.degrees(PAPER.noise.rotation):.0f} deg"
            print(f"the object stands within {within} of where it was seen; held of lifts:")
            print("; ".join(cell.row for cell in found))
            rows = [[] for _ in found]
        counts = " ".join(f"{x.held}/{len(x.lifts)}" if x.lifts else "none" for x in found)
        note = next((cell.note for cell in found if cell.note), "")
        print(f"{found[0].object:28}{found[0].hand:9}{counts} {note}".rstrip(), flush=True)
        for row, cell in zip(rows, found, strict=True):
            row.append(cell)
    if not rows:
        raise SystemExit("no object is finished")
    return rows


def report(rows: Sequence[Sequence[Cell]]) -> dict[str, Any]:
    """Print the results of each row of a table, of all hands and of each; return those of all.

    They are shares that held, medians of motions, and causes of losses, by the row's name.
    """
    numbers = {row[0].row: _numbers(row) for row in rows}
    lines: list[tuple[str, ...]] = [HEADS]
    for row in rows:
        name = row[0].row
        hands = dict.fromkeys(cell.hand for cell in row)
        parts = {hand: _numbers([c for c in row if c.hand == hand]) for hand in hands}
        if len(hands) > 1:
            parts = {"all": numbers[name]} | parts
        for hand, found in parts.items():
            held, certain = (format_share(found[key]) for key in ("held", "certain_first"))
            moved = (found["pushed_mm"], found["slip_mm"])
            told = ["-" if math.isnan(x) else f"{x:.1f} mm" for x in moved]
            graspable = f"{found['graspable']} of {found['objects']}"
            lines.append((name, hand, held, graspable, *told, certain, PUBLISHED.get(name, "-")))
    print(f"\n{format_columns(lines, left={0, 1, 2, 6})}")
    for name, found in numbers.items():
        lost = ", ".join(f"{n} {reason.lower()}" for reason, n in found["lost"].items())
        print(f"{name}: {lost or 'none lost'}")
    return numbers


def _numbers(row: Sequence[Cell]) -> dict[str, Any]:
    """Return the numbers of a row: shares with intervals over families, medians of the lifts that
    held.
    """
    lifts = [(cell.family, lift) for cell in row for lift in cell.lifts]
    objects = {cell.object: False for cell in row}
    objects |= {cell.object: True for cell in row if cell.lifts}
    first = [(family, x.certain) for family, x in lifts if x.certain is not None]
    return {
        "held": share_over(count_held(row)),
        "certain_first": share_over(count_by(first)),
        "pushed_mm": median(1e3 * x.pushed for _, x in lifts),
        "slip_mm": median(1e3 * x.slip for _, x in lifts if x.held),
        "objects": len(objects),
        "graspable": sum(objects.values()),
        "lost": dict(Counter(x.status.name for _, x in lifts if not x.held).most_common()),
    }


def count_held(row: Sequence[Cell]) -> dict[str, tuple[int, int]]:
    """Return (lifts that held, all lifts) in a row of a table, by family of objects."""
    return count_by((cell.family, lift.held) for cell in row for lift in cell.lifts)


def median(values: Iterator[float]) -> float:
    """Return the median of the values that are not NaN; NaN if there are none.

    >>> median(iter([3.0, float("nan"), 1.0]))
    2.0
    """
    known = [value for value in values if not math.isnan(value)]
    return statistics.median(known) if known else math.nan


def line_weights(places: Sequence[float]) -> list[float]:
    """Return the weights by which shares at some places give the fall of their regression line.

    The fall is from the first to the last place.

    >>> [round(w, 3) for w in line_weights([1.0, 2.0, 3.0])]
    [1.0, 0.0, -1.0]
    """
    centred = [place - sum(places) / len(places) for place in places]
    return [-c / sum(x * x for x in centred) * (places[-1] - places[0]) for c in centred]


def format_points(difference: Share) -> str:
    """Return a difference of shares as text, in percentage points with its interval.

    >>> format_points(Share(0.05, -0.01, 0.11, 80, 40))
    '+5.0 points [-1.0, +11.0] over 40 families'
    """
    if math.isnan(difference.low):
        return f"{100 * difference.value:+.1f} points, no interval: {difference.units} family"
    ends = f"[{100 * difference.low:+.1f}, {100 * difference.high:+.1f}]"
    return f"{100 * difference.value:+.1f} points {ends} over {difference.units} families"


def write(
    path: Path, spec: TableSpec, rows: Sequence[Sequence[Cell]], found: dict[str, Any]
) -> None:
    """Write a table's settings, results and lifts to a JSON file, and print its path."""
    asked = dataclasses.asdict(spec) | {"out": None, "objects": len(spec.objects)}
    cells = [dataclasses.asdict(cell) for row in rows for cell in row]
    print(write_file(path, format_json({"asked": asked, **found, "cells": cells})))
