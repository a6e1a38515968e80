"""Greedy selection against refitting the posterior for every pick."""

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from tests.make import covariance
from torchgrasp.base import join
from torchgrasp.errors import IndefiniteCovariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.conditioning import Criterion, Selection, posterior_given, select_points
from torchgrasp.shape.kernel import kernel_by_name, thin_plate
from torchgrasp.shape.values import Observations, on_surface

PSI = 3.6
PLATE = kernel_by_name("thin_plate", PSI)


def _scene(n: int) -> tuple[Tensor, Observations]:
    rng = torch.Generator().manual_seed(5)
    x = unit(torch.randn(n, 3, dtype=torch.float64, generator=rng)) * torch.tensor([1.0, 0.5, 0.8], dtype=torch.float64)
    outer = 1.2 * unit(torch.randn(20, 3, dtype=torch.float64, generator=rng))
    anchors = torch.cat([torch.zeros(1, 3, dtype=torch.float64), outer])
    some = torch.arange(21) < 3  # a few known normals, too
    sigma = torch.full((21,), 0.01, dtype=torch.float64)
    return x, Observations(anchors, sigma, anchors, some, sigma, 5 * sigma)


def _normals(x: Tensor) -> Tensor:
    return unit(x / torch.tensor([1.0, 0.25, 0.64], dtype=torch.float64))


def _on_surface(x: Tensor) -> Observations:
    return on_surface(x, _normals(x), torch.full_like(x[:, 0], 0.01), 0.05)


def _select(
    x: Tensor, known: Observations, budget: int, criterion: Criterion = "variance", stop: float = -math.inf
) -> Selection:
    return select_points(_on_surface(x), known, PLATE, budget, criterion, stop)


def _refit(x: Tensor, known: Observations, budget: int) -> list[int]:
    """Pick by a fresh dense solve each time."""
    profile, picks = partial(thin_plate, psi=PSI), []
    none = torch.zeros(len(x), dtype=torch.bool)
    for _ in range(budget):
        seen = torch.cat([known.x, x[picks]])
        has = torch.cat([known.has_normal, torch.ones(len(picks), dtype=torch.bool)])
        sigma = torch.cat([known.distance_noise, torch.full((len(picks),), 0.01, dtype=torch.float64)])
        tilt = torch.cat([known.normal_noise, torch.full((len(picks),), 0.05, dtype=torch.float64)])
        noise = torch.cat([sigma, tilt[has].repeat(3)]) ** 2
        k = covariance(seen, seen, has, has, profile) + torch.diag(noise)
        star = covariance(x, seen, none, has, profile)
        variance = PSI**3 - (star * torch.linalg.solve(k, star.T).T).sum(1)
        variance[picks] = -torch.inf
        picks.append(int(variance.argmax()))
    return picks


def test_picks_are_those_of_refitting_every_time():
    x, known = _scene(150)
    assert _select(x, known, 25).picks.tolist() == _refit(x, known, 25)


def test_every_candidate_is_picked_once_when_there_are_few():
    x, known = _scene(6)
    assert sorted(_select(x, known, 50).picks.tolist()) == list(range(6))


def test_informative_points_leave_less_variance_than_random_ones():
    x, known = _scene(300)
    profile, none = partial(thin_plate, psi=PSI), torch.zeros(300, dtype=torch.bool)

    def worst(rows: Tensor) -> float:
        yes = torch.ones(len(rows), dtype=torch.bool)
        k = covariance(x[rows], x[rows], yes, yes, profile)
        k = k + 1e-4 * torch.eye(len(k), dtype=torch.float64)
        star = covariance(x, x[rows], none, yes, profile)
        return float((PSI**3 - (star * torch.linalg.solve(k, star.T).T).sum(1)).max())

    random = torch.randperm(300, generator=torch.Generator().manual_seed(1))[:30]
    assert worst(_select(x, known, 30).picks) < 0.5 * worst(random)


def test_a_psi_too_small_is_named():
    x, known = _scene(50)
    with pytest.raises(IndefiniteCovariance, match="psi_scale"):
        select_points(_on_surface(x), known, kernel_by_name("thin_plate", 1.5), 20)


@pytest.mark.parametrize("kernel", ["thin_plate", "matern52"])
@pytest.mark.parametrize("criterion", ["error", "both"])
def test_picks_by_error_are_those_of_refitting_every_time(criterion: Criterion, kernel: str):
    x, known = _scene(120)
    normals, chosen = _normals(x), kernel_by_name(kernel, PSI)
    profile = chosen.profile
    none, wanted = torch.zeros(len(x), dtype=torch.bool), []
    for _ in range(20):
        m = len(wanted)
        seen = Observations(
            torch.cat([known.x, x[wanted]]),
            torch.cat([known.distance, torch.zeros(m, dtype=torch.float64)]),
            torch.cat([known.normal, normals[wanted]]),
            torch.cat([known.has_normal, torch.ones(m, dtype=torch.bool)]),
            torch.cat([known.distance_noise, torch.full((m,), 0.01, dtype=torch.float64)]),
            torch.cat([known.normal_noise, torch.full((m,), 0.05, dtype=torch.float64)]),
        )
        y, noise = seen.rows()
        k = covariance(seen.x, seen.x, seen.has_normal, seen.has_normal, profile) + torch.diag(noise)
        star = covariance(x, seen.x, none, seen.has_normal, profile)
        score = (star @ torch.linalg.solve(k, y)).abs()
        if criterion == "both":
            score = score + 2.0 * (PSI**3 - (star * torch.linalg.solve(k, star.T).T).sum(1)).sqrt()
        score[wanted] = -torch.inf
        wanted.append(int(score.argmax()))
    found = select_points(_on_surface(x), known, chosen, 20, criterion)
    assert found.picks.tolist() == wanted


def test_picking_stops_when_every_point_is_as_certain_as_asked():
    x, known = _scene(300)
    picks = _select(x, known, 300, stop=0.01).picks
    assert torch.equal(picks, _select(x, known, len(picks)).picks)
    assert 10 < len(picks) < 100
    profile, none = partial(thin_plate, psi=PSI), torch.zeros(len(x), dtype=torch.bool)
    for rows, certain in ((picks, True), (picks[:-1], False)):
        has = torch.cat([known.has_normal, torch.ones(len(rows), dtype=torch.bool)])
        seen = torch.cat([known.x, x[rows]])
        noise = torch.cat([torch.full((len(seen),), 0.01), torch.full((int(has.sum()),), 0.05).repeat(3)]).double() ** 2
        k = covariance(seen, seen, has, has, profile) + torch.diag(noise)
        star = covariance(x, seen, none, has, profile)
        worst = (PSI**3 - (star * torch.linalg.solve(k, star.T).T).sum(1)).max().item()
        assert (worst <= 0.01) == certain


@pytest.mark.parametrize("criterion", ["variance", "both"])
def test_the_factor_of_the_selection_is_that_of_the_posterior(criterion: Criterion):
    x, known = _scene(120)
    found = _select(x, known, 20, criterion)
    every = join([known, _on_surface(x)[found.picks]])
    grown, fresh = found.posterior, posterior_given(every, PLATE)
    assert torch.equal(grown.x, fresh.x) and torch.equal(grown.has_normal, fresh.has_normal)
    torch.testing.assert_close(grown.weights, fresh.weights, rtol=0, atol=1e-7)
    order = grown.order
    assert order is not None
    noise = every.with_normals_first().rows()[1]
    wanted = covariance(grown.x, grown.x, grown.has_normal, grown.has_normal, PLATE.profile) + torch.diag(noise)
    assert torch.equal(grown.factor, grown.factor.tril())
    torch.testing.assert_close(grown.factor @ grown.factor.T, wanted[order][:, order], rtol=0, atol=1e-10)
    (mean, spread), (other_mean, other_spread) = grown.estimate(x), fresh.estimate(x)
    torch.testing.assert_close(mean, other_mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(spread, other_spread, rtol=0, atol=1e-9)


def test_nothing_is_picked_where_everything_is_certain():
    x, known = _scene(30)
    found = _select(x, known, 5, stop=1e3)
    assert len(found.picks) == 0 and len(found.posterior.x) == len(known.x)
