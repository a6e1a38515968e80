"""Greedy selection against refitting the posterior for every pick."""

import math

import pytest
import torch
from torch import Tensor

from tests.make import covariance, dense_posterior, near, real
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import IndefiniteCovariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.conditioning import (
    Criterion,
    Selection,
    longest_distance,
    posterior_given,
    select_points,
)
from torchgrasp.shape.estimate import Observations, on_surface
from torchgrasp.shape.kernel import Kernel, KernelName, kernel_by_name

PSI = 3.6
PLATE = kernel_by_name("thin_plate", PSI)
AXES = real([1.0, 0.5, 0.8])


def _scene(n: int) -> tuple[Observations, Observations]:
    """Points of an ellipsoid, and what is known beside them: its centre and points outside, a few
    with normals.
    """
    rng = torch.Generator().manual_seed(5)
    x = unit(torch.randn(n, 3, dtype=torch.float64, generator=rng)) * AXES
    outer = 1.2 * unit(torch.randn(20, 3, dtype=torch.float64, generator=rng))
    anchors = torch.cat([torch.zeros(1, 3, dtype=torch.float64), outer])
    sigma = torch.full((21,), 0.01, dtype=torch.float64)
    known = Observations(anchors, sigma, anchors, torch.arange(21) < 3, sigma, 5 * sigma)
    return on_surface(x, unit(x / AXES**2), torch.full_like(x[:, 0], 0.01), 0.05), known


def _select(
    points: Observations,
    known: Observations,
    budget: int,
    criterion: Criterion = "variance",
    stop: float = -math.inf,
) -> Selection:
    return select_points(points, known, PLATE, budget, criterion, stop)


def _distances(seen: Observations, kernel: Kernel, x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of the distances at points by a dense solve."""
    mean, spread = dense_posterior(seen, kernel.profile, x, normals=False)
    return mean, spread.diagonal()


@pytest.mark.parametrize("kernel", ["thin_plate", "matern52"])
@pytest.mark.parametrize("criterion", ["variance", "error", "both"])
def test_picks_are_those_of_refitting_every_time(criterion: Criterion, kernel: KernelName):
    (points, known), chosen = _scene(120), kernel_by_name(kernel, PSI)
    wanted: list[int] = []
    for _ in range(20):
        mean, variance = _distances(join([known, points[wanted]]), chosen, points.x)
        score = {
            "variance": variance,
            "error": mean.abs(),
            "both": mean.abs() + 2.0 * variance.sqrt(),
        }[criterion]
        score[wanted] = -torch.inf
        wanted.append(int(score.argmax()))
    assert select_points(points, known, chosen, 20, criterion).picks.tolist() == wanted


def test_few_candidates_are_picked_once_certain_ones_never_and_a_psi_too_small_is_named():
    points, known = _scene(6)
    assert sorted(_select(points, known, 50).picks.tolist()) == list(range(6))
    found = _select(points, known, 5, stop=1e3)
    assert len(found.picks) == 0 and len(found.posterior.x) == len(known.x)
    with pytest.raises(IndefiniteCovariance, match="psi_scale"):
        select_points(*_scene(50), kernel_by_name("thin_plate", 1.5), 20)


def test_informative_points_leave_less_variance_and_picking_stops_when_all_is_certain():
    points, known = _scene(300)
    random = torch.randperm(300, generator=torch.Generator().manual_seed(1))[:30]
    picks = _select(points, known, 30).picks
    ours, theirs = (
        float(_distances(points[rows], PLATE, points.x)[1].max()) for rows in (picks, random)
    )
    assert ours < 0.5 * theirs
    picks = _select(points, known, 300, stop=0.01).picks
    assert torch.equal(picks, _select(points, known, len(picks)).picks)
    assert 10 < len(picks) < 100
    for rows, certain in ((picks, True), (picks[:-1], False)):
        worst = float(_distances(join([known, points[rows]]), PLATE, points.x)[1].max())
        assert (worst <= 0.01) == certain


@pytest.mark.parametrize("axes", [[1.0, 1.0, 1.0], [1.0, 0.3, 0.0], [0.0, 0.0, 0.0]])
def test_the_longest_distance_is_that_of_all_pairs(axes: list[float]):
    x = unit(torch.randn(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)))
    x = 5 + x * real(axes)
    every = (x[:, None] - x).square().sum(-1).sqrt()
    assert longest_distance(x) == pytest.approx(float(every.max()), rel=1e-15)


@pytest.mark.parametrize("criterion", ["variance", "both"])
def test_the_factor_of_the_selection_is_that_of_the_posterior(criterion: Criterion):
    points, known = _scene(120)
    found = _select(points, known, 20, criterion)
    every = join([known, points[found.picks]])
    grown = found.posterior
    fresh = posterior_given(every, PLATE)
    assert torch.equal(grown.x, fresh.x) and torch.equal(grown.has_normal, fresh.has_normal)
    near(grown.weights, fresh.weights, 1e-7)
    order = grown.order
    assert order is not None
    noise = every.with_normals_first().rows()[1]
    wanted = covariance(
        grown.x, grown.x, grown.has_normal, grown.has_normal, PLATE.profile
    ) + torch.diag(noise)
    assert torch.equal(grown.factor, grown.factor.tril())
    near(grown.factor @ grown.factor.T, wanted[order][:, order], 1e-10)
    for one, other in zip(grown.estimate(points.x), fresh.estimate(points.x), strict=True):
        near(one, other, 1e-9)
