"""The factors of the bands: found for errors whose spread is known, and judged on other families."""

import numpy as np
import pytest
import torch
from train.bands import FACTORS, fit_factor, format_shares
from train.normal_bands import fit_normals, ratios, report_normals


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


def test_factors_of_normals_are_those_of_the_errors():
    generator, true = torch.Generator().manual_seed(0), (0.8, 1.2, 0.003, 0.04)
    rows = []
    for i in range(24):
        size = torch.tensor([0.01, 0.01, 900.0], dtype=torch.float64)
        parts = torch.rand(400, 2, 3, generator=generator, dtype=torch.float64) ** 3 * size
        parts = torch.cat([parts, torch.ones(400, 2, 1, dtype=torch.float64)], -1)
        std = (parts @ torch.tensor(true, dtype=torch.float64).square()).sqrt()
        error = std * torch.randn(400, 2, generator=generator, dtype=torch.float64)
        place = torch.rand(2, 400, generator=generator) < 0.5
        rows.append({"family": f"tin {i}", "error": error, "parts": parts, "hidden": place[0], "edge": place[1]})
    fitted = fit_normals(rows, fit_factor)
    np.testing.assert_allclose(fitted, true, rtol=0.25)
    held = torch.cat([ratios(row, fitted) for row in rows])
    assert abs(float((held <= 1).double().mean()) - 0.683) < 0.03
    assert "seen, edge" in report_normals(rows, fit_factor)
