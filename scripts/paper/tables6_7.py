"""Tables 6 and 7 of the paper with the objects of torchgrasp and others: what became of the closed hands."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from paper.closing_trials import Cell, controller_cells, difference, threshold_cells, trend, trend_over_grasps
from torchgrasp.evaluation.protocols import PAPER
from torchgrasp.evaluation.score import share
from torchgrasp.files import format_json, write_file

PUBLISHED = {
    "0.03": "40 63 57",
    "0.06": "43 33 30",
    "0.10": "30 27 23",
    "uncertainty": "40 63 57",
    "position": "17 10 13",
}
"""Per cent of the paper's cylinder, spray and jug, of 30 trials each."""


def table6(
    out: Path,
    objects: Path | None = None,
    hands: tuple[str, ...] = ("allegro",),
    only: tuple[str, ...] = (),
    workers: int = 1,
    seed: int = 0,
) -> None:
    """Print Table 6: how often grasps hold whose contacts are less and less certain, on the paper's shape.

    Args:
        out: folder of table6.json; it is made where it does not exist.
        objects: folder of objects with their noisy views, besides torchgrasp's own.
        hands: by name.
        only: names of objects to keep; by default all.
        workers: processes.
        seed: of every random draw.
    """
    rows = gather(threshold_cells(objects, hands, only, workers, seed))
    fall, here = trend(rows, seed), trend_over_grasps(rows, seed)
    print(f"fall from the first row to the last: {in_points(fall)}; over grasps of these [{in_interval(here)}]")
    write(out / "table6.json", rows, {"fall": fall, "fall_over_grasps": here, "seed": seed})


def table7(
    out: Path,
    objects: Path | None = None,
    hands: tuple[str, ...] = ("allegro", "barrett"),
    only: tuple[str, ...] = (),
    workers: int = 1,
    seed: int = 0,
) -> None:
    """Print Table 7: how often the same grasps hold when they are closed under the law, and by the position baseline.

    Args:
        out: folder of table7.json; it is made where it does not exist.
        objects: folder of objects with their noisy views, besides torchgrasp's own.
        hands: by name.
        only: names of objects to keep; by default all.
        workers: processes.
        seed: of every random draw.
    """
    rows = gather(controller_cells(objects, hands, only, workers, seed))
    gains = {row[0].row: difference(rows[0], row, seed) for row in rows[1:]}
    for name, gain in gains.items():
        print(f"{rows[0][0].row} over {name}: {in_points(gain)}")
    write(out / "table7.json", rows, {"gains": gains, "seed": seed})


def gather(cells: Iterator[tuple[Cell, ...]]) -> list[list[Cell]]:
    """Print the cells of each object and hand as they are there, then the rows, and return them row by row."""
    rows: list[list[Cell]] = []
    for found in cells:
        if not rows:
            place = (
                f"{1e3 * PAPER.noise.translation:.0f} mm and {57.3 * PAPER.noise.rotation:.0f} deg of where it was seen"
            )
            print(f"the object stands within {place}; held of")
            print(f"{'object':16}{'hand':9}" + "".join(f"{cell.row:>24}" for cell in found))
            rows = [[] for _ in found]
        counts = "".join(f"{f'{c.held}/{len(c.statuses)} ({1e3 * c.std_m:.0f} mm)':>24}" for c in found)
        print(f"{found[0].object:16}{found[0].hand:9}{counts}", flush=True)
        for row, cell in zip(rows, found, strict=True):
            row.append(cell)
    print()
    for row in rows:
        value, low, high, total = pooled(row)
        reasons = Counter(s.name.lower() for cell in row for s in cell.statuses if s.name != "OK")
        told = f"{value:6.1%} [{low:.1%}, {high:.1%}] of {total}; the paper: {PUBLISHED.get(row[0].row, '-')} %"
        print(f"{row[0].row:24}{told}; {', '.join(f'{n} {name}' for name, n in reasons.most_common())}")
    return rows


def pooled(row: list[Cell]) -> tuple[float, float, float, int]:
    """Return the share of a row's trials that held, its 95 % Wilson interval, and their number."""
    return share(sum(cell.held for cell in row), sum(len(cell.statuses) for cell in row))


def in_points(value: tuple[float, float, float]) -> str:
    """Return a difference of shares and its interval as text."""
    return f"{100 * value[0]:.1f} points, 95 % interval over objects [{in_interval(value)}]"


def in_interval(value: tuple[float, float, float]) -> str:
    """Return the ends of an interval in points."""
    return f"{100 * value[1]:.1f}, {100 * value[2]:.1f}"


def write(path: Path, rows: list[list[Cell]], more: dict[str, Any]) -> None:
    """Write rows and what follows from them as JSON."""
    cells = [dataclasses.asdict(cell) for row in rows for cell in row]
    shares = {row[0].row: pooled(row) for row in rows}
    write_file(path, format_json({"shares": shares, **more, "cells": cells}))
    print(path)
