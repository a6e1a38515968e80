"""Tables 6 and 7 of the paper: riskier contacts hold less often, and the closing law holds more often."""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from paper.closing_trials import PAPER, THRESHOLDS, Cell, TableSpec, closing_cells, threshold_cells
from torchgrasp.columns import format_line
from torchgrasp.errors import Status
from torchgrasp.evaluation import Share, share_over
from torchgrasp.files import format_json, write_file

PUBLISHED = {
    "0.03": "40 63 57",
    "0.06": "43 33 30",
    "0.10": "30 27 23",
    "uncertainty": "40 63 57",
    "position": "17 10 13",
}
"""Per cent of the paper's cylinder, spray and jug, of 30 trials each."""


RESAMPLES = 10_000
"""Draws behind an interval: its ends are then known to a tenth of a point."""


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
    rows = gather(threshold_cells(TableSpec(hands, objects, only, seed), workers))
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
    rows = gather(closing_cells(TableSpec(hands, objects, only, seed), workers))
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
        value, low, high, total, _ = pooled(row)
        reasons = Counter(s.name.lower() for cell in row for s in cell.statuses if s.name != "OK")
        told = f"{value:6.1%} [{low:.1%}, {high:.1%}] of {total}; the paper: {PUBLISHED.get(row[0].row, '-')} %"
        print(
            format_line(
                (row[0].row, f"{told}; {', '.join(f'{n} {name}' for name, n in reasons.most_common())}"), (-22, -1)
            )
        )
    return rows


def pooled(row: list[Cell]) -> Share:
    """Return the share of a row's trials that held, with its interval over objects."""
    return share_over({cell.object: _of(row, cell.object) for cell in row})


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


# -------------------------------------------------------------------------------------------------- intervals


def difference(first: Sequence[Cell], second: Sequence[Cell], seed: int = 0) -> tuple[float, float, float]:
    """Return by how much the held share of the first cells is above that of the second, and its 95 % interval.

    The cells are paired by object and hand. The interval resamples objects, not trials: the trials of one object are
    alike.

    >>> a = [Cell(o, "allegro", "a", (Status.OK, Status.OK), 1, 0.0) for o in "xyz"]
    >>> b = [Cell(o, "allegro", "b", (Status.OK, Status.DROPPED), 1, 0.0) for o in "xyz"]
    >>> difference(a, b)
    (0.5, 0.5, 0.5)
    """
    return _interval(
        {o: [_of(first, o), _of(second, o)] for o in {c.object for c in first}}, np.array([1.0, -1.0]), seed
    )


def trend(rows: Sequence[Sequence[Cell]], seed: int = 0) -> tuple[float, float, float]:
    """Return the fall of the held share from the first to the last of `THRESHOLDS`, and its 95 % interval over objects.

    It is the line of least squares through the rows' pooled shares; see `difference` for the interval.
    """
    return _interval({o: [_of(row, o) for row in rows] for o in {c.object for c in rows[0]}}, _line(), seed)


def trend_over_grasps(rows: Sequence[Sequence[Cell]], seed: int = 0) -> tuple[float, float, float]:
    """Return `trend` with the interval of these very objects: the grasps of each cell are resampled."""
    generator = np.random.default_rng(seed)
    shares = []
    for row in rows:
        held = np.zeros(RESAMPLES + 1)
        for cell in row:
            passed = np.array([status is Status.OK for status in cell.statuses]).reshape(-1, cell.draws).sum(1)
            drawn = generator.integers(max(len(passed), 1), size=(RESAMPLES, len(passed)))
            held += np.concatenate([passed[None], passed[drawn]]).sum(1)
        shares.append(held / max(sum(len(cell.statuses) for cell in row), 1))
    return _quantiles(np.stack(shares, -1) @ _line())


def _line() -> np.ndarray:
    """Return the weights of the rows' shares that make the fall of the line of least squares through them."""
    centred = np.array(THRESHOLDS) - np.mean(THRESHOLDS)
    return -centred / (centred @ centred) * (THRESHOLDS[-1] - THRESHOLDS[0])


def _of(cells: Sequence[Cell], name: str) -> tuple[int, int]:
    """Return how many trials of an object held, and of how many."""
    mine = [cell for cell in cells if cell.object == name]
    return sum(cell.held for cell in mine), sum(len(cell.statuses) for cell in mine)


def _interval(counts: dict[str, list[tuple[int, int]]], weights: np.ndarray, seed: int) -> tuple[float, float, float]:
    """Return a weighted sum of rows' pooled shares, with the 2.5 % and 97.5 % quantiles over resampled objects."""
    table = np.array([counts[name] for name in sorted(counts)], float)  # (objects, rows, 2)
    drawn = np.random.default_rng(seed).integers(len(table), size=(RESAMPLES, len(table)))
    sums = np.concatenate([table.sum(0)[None], table[drawn].sum(1)])
    value = (sums[..., 0] / np.maximum(sums[..., 1], 1)) @ weights
    return _quantiles(value)


def _quantiles(value: np.ndarray) -> tuple[float, float, float]:
    """Return the first of the values, and the 2.5 % and 97.5 % quantiles of the others."""
    low, high = np.quantile(value[1:], [0.025, 0.975])
    return float(value[0]), float(low), float(high)
