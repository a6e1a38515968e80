"""Tables 6 and 7: which grasps, where the object stands, and what the intervals are worth."""

import numpy as np
import pytest
from paper import closing_trials
from paper.closing_trials import THRESHOLDS, Cell, TableSpec, threshold_cells
from paper.tables6_7 import difference, trend, trend_over_grasps

from torchgrasp.errors import Status


def cells(row: str, held: dict[str, int], of: int = 10) -> list[Cell]:
    """Return a cell for each object."""
    return [Cell(o, "allegro", row, (Status.OK,) * n + (Status.DROPPED,) * (of - n), 5, 0.01) for o, n in held.items()]


def test_a_difference_is_the_pooled_one_and_its_interval_that_of_resampled_objects() -> None:
    first = cells("a", {"x": 9, "y": 8, "z": 10, "w": 7})
    second = cells("b", {"x": 5, "y": 8, "z": 6, "w": 1})
    value, low, high = difference(first, second)
    assert value == pytest.approx((34 - 20) / 40)
    # all 4^4 resamples of four objects, exactly
    gains = np.array([4, 0, 4, 6]) / 10
    every = np.array([gains[list(i)].mean() for i in np.ndindex(4, 4, 4, 4)])
    exact = np.quantile(every, [0.025, 0.975])
    assert [low, high] == pytest.approx(list(exact), abs=0.03)


def test_a_trend_is_the_least_squares_line_through_the_shares() -> None:
    rows = [cells("0.03", {"x": 9, "y": 9}), cells("0.06", {"x": 7, "y": 7}), cells("0.10", {"x": 4, "y": 4})]
    value, low, high = trend(rows)
    slope = np.polyfit(THRESHOLDS, [0.9, 0.7, 0.4], 1)[0]
    assert value == pytest.approx(-slope * (THRESHOLDS[-1] - THRESHOLDS[0]))
    assert low == pytest.approx(value)
    assert high == pytest.approx(value)


def test_the_interval_over_grasps_is_that_of_resampled_grasps() -> None:
    """One object, two grasps in each row: one holds always, the other never; their share is 0, 1/2 or 1."""
    rows = [cells(row, {"x": 5}) for row in ("0.03", "0.06", "0.10")]
    value, low, high = trend_over_grasps(rows)
    weights = np.linalg.lstsq(np.stack([np.ones(3), THRESHOLDS], 1), np.eye(3), rcond=None)[0][1] * -0.07
    # the shares of the rows are independent, each 0, 1/2, 1 with odds 1 : 2 : 1
    shares = np.array(np.meshgrid(*[[0.0, 0.5, 0.5, 1.0]] * 3)).reshape(3, -1)
    exact = np.quantile(weights @ shares, [0.025, 0.975])
    assert value == pytest.approx(0.0, abs=1e-12)
    assert [low, high] == pytest.approx(list(exact), abs=0.1)


@pytest.mark.sim
def test_a_greater_threshold_admits_less_certain_contacts(monkeypatch) -> None:
    monkeypatch.setattr(closing_trials, "THRESHOLDS", (0.03, 0.10))
    (found,) = threshold_cells(TableSpec(("allegro",), only=("cylinder",), trials=2, starts=16), workers=0)
    assert [cell.row for cell in found] == ["0.03", "0.10"]
    assert all(len(cell.statuses) == 3 for cell in found)  # two trials at least, of three grasps equally many
    assert found[0].std_m < found[1].std_m
