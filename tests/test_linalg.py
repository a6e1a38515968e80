"""Checked linear algebra."""

import pytest
import torch

from torchgrasp.errors import IndefiniteCovariance
from torchgrasp.linalg import cholesky, squared_mahalanobis, unit


def test_cholesky_raises_with_the_smallest_eigenvalue():
    matrix = torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=torch.float64)
    with pytest.raises(IndefiniteCovariance, match="buy a better matrix") as caught:
        cholesky(matrix, "K", "buy a better matrix")
    assert caught.value.smallest_eigenvalue == pytest.approx(-1.0)


def test_cholesky_refuses_nan():
    with pytest.raises(IndefiniteCovariance):
        cholesky(torch.full((2, 2), float("nan")), "K", "-")


def test_cholesky_adds_nothing(generator):
    a = torch.randn(5, 5, generator=generator, dtype=torch.float64)
    matrix = a @ a.T + torch.eye(5, dtype=torch.float64)
    factor = cholesky(matrix, "K", "-")
    torch.testing.assert_close(factor @ factor.T, matrix, rtol=1e-14, atol=1e-14)


def test_mahalanobis_against_the_inverse(generator):
    a = torch.randn(7, 4, 4, generator=generator, dtype=torch.float64)
    sigma = a @ a.transpose(1, 2) + torch.eye(4, dtype=torch.float64)
    x = torch.randn(7, 4, generator=generator, dtype=torch.float64)
    expected = torch.einsum("bi,bij,bj->b", x, torch.linalg.inv(sigma), x)
    torch.testing.assert_close(squared_mahalanobis(x, torch.linalg.cholesky(sigma)), expected)


def test_unit(generator):
    v = torch.randn(9, 3, generator=generator)
    torch.testing.assert_close(unit(v).norm(dim=-1), torch.ones(9))
    assert bool(torch.isnan(unit(torch.zeros(3))).all())
