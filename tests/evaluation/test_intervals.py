"""Intervals over families: the quantiles of SciPy's bootstrap and of every resample, and what has
no interval.
"""

import math

import numpy as np
import pytest
from benchmarks.common import mean_over
from scipy import stats

from torchgrasp.evaluation.intervals import contrast_over, share_over

COUNTS = {
    "tin": (9, 10),
    "cup": (3, 12),
    "jug": (7, 7),
    "box": (1, 6),
    "egg": (5, 9),
    "rod": (20, 30),
    "can": (4, 4),
}
OTHERS = {
    "tin": (4, 10),
    "cup": (3, 11),
    "jug": (6, 7),
    "box": (3, 6),
    "egg": (0, 9),
    "rod": (10, 30),
    "can": (4, 4),
}


def exact(columns: list[dict[str, tuple[int, int]]], weights: list[float]) -> np.ndarray:
    """Return the quantiles over every one of the n^n resamples."""
    names = list(columns[0])
    table = np.array([[column[name] for column in columns] for name in names], float)
    every = np.stack([table[list(rows)].sum(0) for rows in np.ndindex(*[len(names)] * len(names))])
    return np.quantile((every[..., 0] / every[..., 1]) @ np.array(weights), [0.025, 0.975])


def test_a_share_has_the_interval_of_scipy_s_bootstrap_of_a_ratio_of_sums() -> None:
    found = share_over(COUNTS)
    table = np.array([*COUNTS.values()], float)
    assert found.value == pytest.approx(49 / 78) and found[3:] == (78, 7)

    def ratio(passed: np.ndarray, total: np.ndarray, axis: int = -1) -> np.ndarray:
        return passed.sum(axis) / total.sum(axis)

    theirs = stats.bootstrap(
        table.T,
        ratio,
        paired=True,
        vectorized=True,
        n_resamples=20_000,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    assert (found.low, found.high) == (
        pytest.approx(theirs.low, abs=0.012),
        pytest.approx(theirs.high, abs=0.012),
    )


def test_paired_differences_and_contrasts_have_the_quantiles_of_every_resample() -> None:
    some, other = ({name: column[name] for name in list(COUNTS)[:5]} for column in (COUNTS, OTHERS))
    found = contrast_over([some, other], [1.0, -1.0])
    assert found.value == pytest.approx(25 / 44 - 16 / 43)
    assert [found.low, found.high] == pytest.approx(exact([some, other], [1, -1]), abs=0.02)
    third = contrast_over([some, other, some], [0.5, -2.0, 0.25])
    assert [third.low, third.high] == pytest.approx(
        exact([some, other, some], [0.5, -2.0, 0.25]), abs=0.05
    )


def test_equal_columns_differ_by_nothing_one_unit_has_no_interval_and_means_of_zeros_and_ones_are_shares() -> (
    None
):
    assert contrast_over([COUNTS, COUNTS], [1.0, -1.0])[:3] == (0.0, 0.0, 0.0)
    assert share_over(dict(reversed(COUNTS.items()))) == share_over(COUNTS)
    assert share_over(COUNTS | {"none": (0, 0)}) == share_over(COUNTS)
    one = share_over({"tin": (3, 4)})
    assert one.value == 0.75 and math.isnan(one.low) and math.isnan(one.high) and one.units == 1
    assert all(math.isnan(x) for x in share_over({})[:3])
    lacking = contrast_over(
        [COUNTS, {"tin": (1, 2)}], [1.0, -1.0]
    )  # resamples without the tin say nothing of the second
    assert lacking.low < lacking.value < lacking.high
    values = [
        (name, float(k < passed)) for name, (passed, total) in COUNTS.items() for k in range(total)
    ]
    assert mean_over(values) == contrast_over([COUNTS], [1.0])
    assert mean_over([*values, ("tin", math.nan)]) == mean_over(values)
    assert math.isnan(mean_over([("tin", math.nan)]).value)


def test_what_ended_alike_everywhere_has_the_bound_of_as_many_trials_as_there_are_units() -> None:
    for n in (2, 8, 40):
        passed = share_over({str(k): (5, 5) for k in range(n)})
        # SciPy's exact one-sided interval of n of n
        low = stats.binomtest(n, n, alternative="greater").proportion_ci(0.95, "exact").low
        assert passed[:3] == (1.0, pytest.approx(low), 1.0)
        failed = share_over({str(k): (0, 5) for k in range(n)})
        assert failed[:3] == (0.0, 0.0, pytest.approx(1 - low))
