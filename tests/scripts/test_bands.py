"""The factors of the bands: found for errors whose spread is known, and judged on other families."""

import numpy as np
import pytest
from train.bands import FACTORS, fit_factor, format_shares


def _views(spread: float, n: int = 12) -> list[np.ndarray]:
    """Errors of a normal distribution over deviations that are wrong by a factor."""
    generator = np.random.default_rng(0)
    return [spread * np.abs(generator.standard_normal(4000)) for _ in range(n)]


@pytest.mark.parametrize("spread", [0.4, 0.75, 1.1])
def test_the_factor_is_the_spread_of_normal_errors(spread: float):
    assert fit_factor(_views(spread)) == pytest.approx(spread, abs=0.03)


def test_views_count_alike_however_many_points_they_have():
    narrow, wide = _views(0.4, 6), _views(0.9, 6)
    assert fit_factor(narrow + wide) == fit_factor(narrow + [np.tile(v, 5) for v in wide])


def test_surface_outside_the_domain_is_missed_with_every_factor():
    ratio = np.concatenate([np.zeros(50), np.full(50, np.inf)])
    row = {"family": "tin", "kind": ("ball", True), "ratio": ratio, "factor": float(FACTORS[-1])}
    table = format_shares([row, row | {"family": "cup"}])
    assert "50.0 [50.0, 50.0]" in table and "0% of views" in table
