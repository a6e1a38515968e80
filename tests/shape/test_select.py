"""Greedy selection against refitting the posterior for every pick."""

from functools import partial

import pytest
import torch
from torch import Tensor

from torchgrasp.errors import BadArgument, IndefiniteCovariance
from torchgrasp.linalg import unit
from torchgrasp.shape.kernel import covariance, thin_plate
from torchgrasp.shape.observe import Observations
from torchgrasp.shape.profiles import kernel_by_name
from torchgrasp.shape.select import Criterion, select_points

PSI = 3.6


def _scene(n: int) -> tuple[Tensor, Observations]:
    rng = torch.Generator().manual_seed(5)
    x = unit(torch.randn(n, 3, dtype=torch.float64, generator=rng)) * torch.tensor([1.0, 0.5, 0.8], dtype=torch.float64)
    outer = 1.2 * unit(torch.randn(20, 3, dtype=torch.float64, generator=rng))
    anchors = torch.cat([torch.zeros(1, 3, dtype=torch.float64), outer])
    some = torch.arange(21) < 3  # a few known normals, too
    sigma = torch.full((21,), 0.01, dtype=torch.float64)
    return x, Observations(anchors, sigma, anchors, some, sigma, 5 * sigma)


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
    picks = select_points(x, known, 25, PSI, 0.01, 0.05)
    assert picks.tolist() == _refit(x, known, 25)


def test_every_candidate_is_picked_once_when_there_are_few():
    x, known = _scene(6)
    assert sorted(select_points(x, known, 50, PSI, 0.01, 0.05).tolist()) == list(range(6))


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
    assert worst(select_points(x, known, 30, PSI, 0.01, 0.05)) < 0.5 * worst(random)


def test_a_psi_too_small_is_named():
    x, known = _scene(50)
    with pytest.raises(IndefiniteCovariance, match="psi_scale"):
        select_points(x, known, 20, 1.5, 0.01, 0.05)


@pytest.mark.parametrize("kernel", ["thin_plate", "matern52"])
@pytest.mark.parametrize("criterion", ["error", "both"])
def test_picks_by_error_are_those_of_refitting_every_time(criterion: Criterion, kernel: str):
    x, known = _scene(120)
    normals = unit(x / torch.tensor([1.0, 0.25, 0.64], dtype=torch.float64))
    profile = kernel_by_name(kernel, PSI).profile
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
    picks = select_points(x, known, 20, PSI, 0.01, 0.05, kernel=kernel, criterion=criterion, normals=normals)
    assert picks.tolist() == wanted


def test_picking_stops_when_every_point_is_as_certain_as_asked():
    x, known = _scene(300)
    picks = select_points(x, known, 300, PSI, 0.01, 0.05, stop=0.01)
    assert picks.tolist() == select_points(x, known, len(picks), PSI, 0.01, 0.05).tolist()
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


def test_a_criterion_that_cannot_be_judged_is_named():
    x, known = _scene(30)
    with pytest.raises(BadArgument, match="normals"):
        select_points(x, known, 5, PSI, 0.01, 0.05, criterion="both")
