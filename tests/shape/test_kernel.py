"""Covariance blocks against a closed form of the thin plate, other kernels, and the definition by
derivatives.
"""

from functools import partial

import numpy as np
import pytest
import torch
from sklearn.gaussian_process.kernels import RBF
from torch import Tensor

from tests.make import covariance, near, real
from torchgrasp.shape.kernel import Profile, differentiate, thin_plate

PSI = 3.6
PLATE = partial(thin_plate, psi=PSI)


def _points(n: int, seed: int = 0) -> Tensor:
    return (
        torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 0.5
    )


def _block(a: Tensor, b: Tensor, profile: Profile = PLATE) -> Tensor:
    yes = torch.ones(1, dtype=torch.bool)
    return covariance(a[None], b[None], yes, yes, profile)


def _closed_form(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The thin plate's 4x4 block by hand, NumPy, one pair."""
    d = a - b
    r = np.linalg.norm(d)
    block = np.empty((4, 4))
    block[0, 0] = (PSI - r) ** 2 * (PSI + 2 * r)
    block[1:, 0] = 6 * (r - PSI) * d
    block[0, 1:] = -6 * (r - PSI) * d
    block[1:, 1:] = 6 * (PSI - r) * np.eye(3) - (6 * np.outer(d, d) / r if r > 0 else 0)
    return block


def test_eq2_blocks_equal_the_closed_form_and_have_the_stated_order():
    x = _points(7)
    y = _points(5, seed=1)
    has = torch.arange(7) % 2 == 0
    other = torch.arange(5) < 2
    found = covariance(x, y, has, other, partial(thin_plate, psi=PSI))
    rows = [(i, 0) for i in range(7)] + [(i, m) for m in (1, 2, 3) for i in range(7) if has[i]]
    columns = [(j, 0) for j in range(5)] + [(j, m) for m in (1, 2, 3) for j in range(5) if other[j]]
    wanted = [[_closed_form(x[i].numpy(), y[j].numpy())[m, n] for j, n in columns] for i, m in rows]
    near(found, real(wanted), 1e-13)


@pytest.mark.promise("N3")
def test_eq3_to_eq5_covariances_are_the_kernel_and_its_derivatives_one_in_each_argument():
    a, b = _points(2)
    torch.testing.assert_close(_block(a, b)[0, 0], thin_plate(torch.linalg.vector_norm(a - b), PSI))
    a, b = (p.requires_grad_() for p in _points(2))
    k = thin_plate(torch.linalg.vector_norm(a - b), PSI)
    da, db = torch.autograd.grad(k, (a, b))
    block = _block(a.detach(), b.detach())
    torch.testing.assert_close(block[1:, 0], da)
    torch.testing.assert_close(block[0, 1:], db)
    a, b = _points(2)
    step = 1e-4
    fd = torch.empty(3, 3, dtype=torch.float64)
    for m in range(3):
        for n in range(3):
            em, en = torch.eye(3, dtype=torch.float64)[[m, n]] * step
            corners = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
            fd[m, n] = sum(
                w * thin_plate((a + s * em - b - t * en).norm(), PSI) for s, t, w in corners
            ) / (4 * step**2)
    near(_block(a, b)[1:, 1:], fd, 1e-5)


def test_eq5_matrix_is_symmetric_and_positive_and_eq6_thin_plate_vanishes_at_psi():
    x = _points(40) / 3  # within a ball of diameter 3/4 psi
    yes = torch.ones(40, dtype=torch.bool)
    matrix = covariance(x, x, yes, yes, partial(thin_plate, psi=PSI))
    torch.testing.assert_close(matrix, matrix.T)
    assert torch.linalg.eigvalsh(matrix).min() > -1e-10
    r = torch.linspace(0, PSI, 50, dtype=torch.float64)
    torch.testing.assert_close(thin_plate(r, PSI), 2 * r**3 - 3 * PSI * r**2 + PSI**3)
    k, first = differentiate(PLATE, r * r / 2, 2)
    assert k[-1].abs() < 1e-12 and first[-1].abs() < 1e-12
    torch.testing.assert_close(first, 6 * (r - PSI))


@pytest.mark.promise("N3")
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-8, 1e-5, 9.9e-6, 1.01e-5, 1e-3])
def test_blocks_are_right_at_and_near_coincident_points(gap: float):
    a = _points(1)[0]
    b = a + gap * real([0.6, 0.0, 0.8])
    wanted = torch.tensor(_closed_form(a.numpy(), b.numpy()))
    near(_block(a, b), wanted, 1e-10)


@pytest.mark.parametrize("gap", [0.0, 1e-8, 1e-4, 0.3])
def test_any_radial_profile_can_be_plugged_in(gap: float):
    """Squared exponential: distances against scikit-learn, normals against the textbook's form."""
    a = _points(1)[0]
    d = gap * real([0.6, 0.0, 0.8])
    found = _block(a, a + d, lambda r: torch.exp(-0.5 * r * r / 0.25))
    k = RBF(0.5)(a[None].numpy(), (a + d)[None].numpy()).item()
    wanted = k * (torch.eye(3, dtype=torch.float64) / 0.25 - torch.outer(d, d) / 0.25**2)
    assert found[0, 0].item() == pytest.approx(k, abs=1e-12)
    near(found[1:, 1:], wanted, 1e-8)


def test_derivatives_in_half_the_squared_distance_are_those_of_a_polynomial_or_zero():
    """k = u^3 + 2 u^2 - u with u = r^2 / 2, at distances from 0 on."""
    r = real([0.0, 1e-7, 1e-3, 0.3, 1.0, 2.0])
    u = r * r / 2
    found = differentiate(lambda r: (r * r / 2) ** 3 + 2 * (r * r / 2) ** 2 - r * r / 2, u, 4)
    wanted = (u**3 + 2 * u**2 - u, 3 * u**2 + 4 * u - 1, 6 * u + 4, torch.full_like(u, 6.0))
    for a, b, factor in zip(
        found, wanted, (1.0, 1.0, r**2, r**3), strict=True
    ):  # with which covariances take them
        near(a * factor, b * factor, 1e-8)
    r = torch.tensor([0.5, 1.0])
    torch.testing.assert_close(
        differentiate(lambda r: 1 - r, r * r / 2, 2)[1], torch.tensor([-2.0, -1.0])
    )
    assert not any(d.any() for d in differentiate(torch.ones_like, r * r / 2, 4)[1:])
