"""Fit the factors of `std_m`, and try them on families of objects left out.

The posterior's own deviations are too wide where much is known, and too narrow where a wrong plane
looks right. The factor of a kind makes 1, 2 and 3 `std_m` hold what they say, in the mean over
views.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from benchmarks.common import mean_over
from benchmarks.ground_truth import read_views, sample_hidden

from torchgrasp.data import read_entry
from torchgrasp.files import format_columns
from torchgrasp.shape.extra_observations import STD_FACTORS
from torchgrasp.shape.fit import fit_shape

NORMAL_SHARES = (0.683, 0.954, 0.997)
"""What a normal distribution holds within 1, 2 and 3 deviations."""
TOLERANCES = (0.05, 0.03, 0.015)
"""Misses of these shares that weigh the same."""
FACTORS = np.arange(0.2, 1.5, 0.01)
"""Factors that are tried."""
SAMPLES = 1500
"""Points on the true surface of a view."""

HEADS = (
    *("kind, group", "table", "views", "factor"),
    *("1 std_m %", "2 std_m %", "3 std_m %", "80 % in 2"),
)
"""Heads of the table."""

Row = dict[str, Any]
"""Family, group, the kind of hidden side with whether there was a table, errors over the
posterior's deviations.
"""


def bands(
    objects: tyro.conf.Positional[Path], beside: Path | None = None, views: tuple[str, ...] = ()
) -> None:
    """Print the factors for `torchgrasp/shape/extra_observations.py`, and what bands hold on
    families left out.

    Args:
        objects: a folder of objects as `torchgrasp.data` reads it.
        beside: a second folder, which chooses nothing and is only measured.
        views: names of the views of each object, such as view0; by default all.
    """
    rows = measure_ratios(objects, views)
    kinds = sorted({row["kind"] for row in rows}, key=str)
    factors = {
        kind: fit_factor([row["ratio"] for row in rows if row["kind"] == kind]) for kind in kinds
    }
    for row in rows:
        others = [
            r["ratio"] for r in rows if r["kind"] == row["kind"] and r["family"] != row["family"]
        ]
        row["factor"] = fit_factor(others) if others else STD_FACTORS[row["kind"]]
    print(f"STD_FACTORS = {factors}\nfamilies left out\n{format_shares(rows)}")
    if beside is not None:
        rows = measure_ratios(beside, views)
        for row in rows:
            row["factor"] = factors.get(row["kind"], STD_FACTORS[row["kind"]])
        print(f"{beside.name}, which chose nothing\n{format_shares(rows)}")


def fit_factor(ratios: list[np.ndarray]) -> float:
    """Return the factor of deviations with which errors are best described by a normal law.

    The shares of errors within 1, 2 and 3 deviations are then nearest to those of this law. They
    are means over views. `ratios` are errors over the posterior's own deviations, an array for each
    view.
    """
    misses = list[float]()
    for factor in FACTORS:
        # within 1, 2 and 3 deviations
        held = [np.mean([(ratio <= k * factor).mean() for ratio in ratios]) for k in (1, 2, 3)]
        off = np.abs(np.subtract(held, NORMAL_SHARES)) / TOLERANCES
        misses.append(float(off.sum()))
    return round(float(FACTORS[int(np.argmin(misses))]), 2)


def format_shares(rows: Sequence[Row]) -> str:
    """Return a table, as text, of the shares of hidden surface within 1, 2 and 3 deviations.

    Each row's deviations are scaled by its factor. The shares are by kind of shape and group of
    objects, with intervals over families.
    """
    table: list[tuple[str, ...]] = [HEADS]
    labels = [
        [row["kind"], (row["group"], row["kind"][1]), ("all", row["kind"][1])] for row in rows
    ]
    for name in (name for column in zip(*labels, strict=True) for name in sorted(set(column))):
        mine = [row for row, own in zip(rows, labels, strict=True) if name in own]
        cells = [name[0], "yes" if name[1] else "no", str(len(mine))]
        cells.append(f"{np.mean([row['factor'] for row in mine]):.2f}")
        for k in (1, 2, 3):
            shares = [float((row["ratio"] <= k * row["factor"]).mean()) for row in mine]
            families = [row["family"] for row in mine]
            found = mean_over(zip(families, (100 * share for share in shares), strict=True))
            cells.append(f"{found.value:.1f} [{found.low:.1f}, {found.high:.1f}]")
        most = np.mean([(row["ratio"] <= 2 * row["factor"]).mean() >= 0.8 for row in mine])
        table.append((*cells, f"{most:.0%} of views"))
    return format_columns(table, left=(0, 1))


def measure_ratios(objects: Path, views: Sequence[str] = ()) -> list[Row]:
    """Return for each view, with and without the table, its errors over the posterior's deviations.

    The errors are those of the estimated shape on hidden surface. `views` are the names of the
    views; empty means all.
    """
    rows = []
    for name, _, cloud, mesh in read_views(objects, views):
        hidden = sample_hidden(mesh, cloud, SAMPLES)
        entry = read_entry(objects, name)
        told = {"family": entry.family, "group": entry.group}
        for table in (0.0, None):
            if not len(hidden):
                continue
            shape = fit_shape(cloud, table=table)
            inside = shape.contains(hidden)
            estimate = shape.predict(hidden[inside])
            ratio = np.full(len(hidden), np.inf)
            ratio[inside.numpy()] = (estimate.distance.abs() / estimate.variance.sqrt()).numpy()
            rows.append(told | {"ratio": ratio, "kind": (shape.kind, table is not None)})
    return rows
