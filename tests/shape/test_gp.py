"""The posterior against a naive solve, finite differences, and the theory of the kernel's domain."""

from functools import partial

import pytest
import torch
from torch import Tensor

from tests.make import covariance
from torchgrasp.errors import BadArgument, IndefiniteCovariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.conditioning import longest_distance
from torchgrasp.shape.fit import condition, fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.kernel import thin_plate
from torchgrasp.shape.surface import extract_surface
from torchgrasp.shape.values import Normalisation, Observations
from torchgrasp.values import PointCloud

NOISE = 0.01


def _observe(x: Tensor, distance: Tensor, normal: Tensor, has_normal: Tensor) -> Observations:
    return Observations(
        x, distance, normal, has_normal, torch.full_like(distance, NOISE), torch.full_like(distance, NOISE)
    )


def _ball_observations(n: int = 40) -> Observations:
    """Points of the unit sphere's right half with normals, mixed with points off it without."""
    rng = torch.Generator().manual_seed(3)
    on = unit(torch.randn(n, 3, dtype=torch.float64, generator=rng))
    on = torch.cat([on[:, :1].abs(), on[:, 1:]], 1)
    off = torch.cat([torch.zeros(1, 3, dtype=torch.float64), -1.2 * on[:10], 1.2 * on[:10]])
    x = torch.cat([off, on])
    order = torch.randperm(len(x), generator=rng)
    has = torch.arange(len(x)) >= len(off)
    distance = torch.linalg.vector_norm(x, dim=-1) - 1.0
    distance = torch.where(has, 0.0, distance)
    return _observe(x[order], distance[order], x[order], has[order])


@pytest.fixture(scope="module")
def half_ball() -> ShapeGP:
    """The unit sphere as a ball of 50 mm at an offset, seen from the right."""
    known = _ball_observations()
    center = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    return condition(
        known, Normalisation(center, 0.05), PointCloud(0.05 * known.x[known.has_normal] + center), std_factor=0.65
    )


def _queries(shape: ShapeGP, n: int) -> Tensor:
    rng = torch.Generator().manual_seed(7)
    x = unit(torch.randn(n, 3, dtype=torch.float64, generator=rng))
    return x * torch.rand(n, 1, dtype=torch.float64, generator=rng) * shape.domain_radius * 0.999


def test_eq1_estimate_has_a_distance_and_a_unit_normal_for_every_point(half_ball: ShapeGP):
    points = half_ball.metres(_queries(half_ball, 12)).reshape(3, 4, 3)
    found = half_ball.predict(points)
    assert found.distance.shape == (3, 4) and found.covariance.shape == (3, 4, 4, 4)
    torch.testing.assert_close(torch.linalg.vector_norm(found.normal, dim=-1), torch.ones(3, 4, dtype=torch.float64))
    flat = half_ball.predict(points.reshape(-1, 3))
    torch.testing.assert_close(flat.variance.reshape(3, 4), found.variance)


def test_eq7_and_eq8_equal_a_naive_solve(half_ball: ShapeGP):
    known = _ball_observations()
    x = _queries(half_ball, 20)
    profile, yes = partial(thin_plate, psi=half_ball.psi), torch.ones(1, dtype=torch.bool)
    has = known.has_normal
    y = torch.cat([known.distance, *known.normal[has].T])
    deviation = torch.cat([known.distance_noise, known.normal_noise[has].repeat(3)])  # distances, then x, y, z
    k = covariance(known.x, known.x, has, has, profile) + torch.diag(deviation**2)
    found = half_ball.predict(half_ball.metres(x))
    for i in range(len(x)):
        star = covariance(x[i : i + 1], known.x, yes, known.has_normal, profile)
        mean = star @ torch.linalg.solve(k, y)
        own = covariance(x[i : i + 1], x[i : i + 1], yes, yes, profile)
        spread = own - star @ torch.linalg.solve(k, star.T)
        torch.testing.assert_close(found.distance[i], mean[0], rtol=0, atol=1e-8)
        torch.testing.assert_close(found.normal[i], unit(mean[1:]), rtol=0, atol=1e-8)
        torch.testing.assert_close(found.covariance[i], spread, rtol=0, atol=1e-6)


@pytest.mark.promise("N4")
def test_eq8_variance_is_small_where_seen_and_within_zero_and_the_prior_everywhere(half_ball: ShapeGP):
    found = half_ball.predict(half_ball.metres(_queries(half_ball, 3000)))
    assert found.variance.min() > 0 and found.variance.max() < half_ball.psi**3
    assert torch.linalg.eigvalsh(found.covariance).min() > -1e-6
    seen, hidden = half_ball.metres(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]], dtype=torch.float64))
    assert half_ball.predict(seen).variance < 0.01 < half_ball.predict(hidden).variance


def test_eq9_zero_level_is_the_sphere_where_it_was_seen(half_ball: ShapeGP):
    x = _ball_observations().x
    on = x[torch.linalg.vector_norm(x, dim=-1).sub(1).abs() < 1e-9]
    found = half_ball.predict(half_ball.metres(on))
    assert found.distance.abs().max() < 0.02
    assert (found.normal * on).sum(-1).min() > 0.99


def test_std_m_is_the_calibrated_deviation_in_metres(half_ball: ShapeGP):
    found = half_ball.predict(half_ball.metres(_queries(half_ball, 5)))
    slope = half_ball.differentiate(half_ball.metres(_queries(half_ball, 5))).distance.norm(dim=-1) * 0.05
    torch.testing.assert_close(found.std_m, 0.65 * 0.05 * found.variance.sqrt() / slope)


def test_std_m_is_divided_by_the_slope_where_the_mean_is_steep(seen_cylinder):
    shape, step = fit_shape(seen_cylinder, support="paper"), 1e-6
    surface = extract_surface(shape, 16)
    found = shape.predict(surface.vertices)
    up, down = (shape.predict(surface.vertices + k * step * surface.normals).distance for k in (1, -1))
    slope = (up - down) / (2 * step)  # per metre
    assert float((slope * shape.scale).quantile(0.9)) > 1.2  # the paper's means are steep
    torch.testing.assert_close(found.std_m, found.variance.sqrt() / slope, rtol=1e-4, atol=0)
    torch.testing.assert_close(surface.std_m, found.std_m, rtol=1e-4, atol=0)


def test_jet_equals_predict_and_its_gradients_equal_finite_differences(half_ball: ShapeGP):
    x, step = _queries(half_ball, 600), 1e-5
    jet, found = half_ball.jet(x), half_ball.predict(half_ball.metres(x))
    torch.testing.assert_close(jet.distance, found.distance, rtol=0, atol=1e-9)
    torch.testing.assert_close(half_ball.mean(x), found.distance, rtol=0, atol=1e-9)
    torch.testing.assert_close(jet.variance, found.variance, rtol=0, atol=1e-6)
    torch.testing.assert_close(unit(jet.gradient), found.normal, rtol=0, atol=1e-8)
    for m in range(3):
        move = step * torch.eye(3, dtype=torch.float64)[m]
        up, down = half_ball.jet(x + move), half_ball.jet(x - move)
        torch.testing.assert_close(jet.gradient[:, m], (up.distance - down.distance) / (2 * step), rtol=0, atol=1e-5)
        torch.testing.assert_close(jet.hessian[:, m], (up.gradient - down.gradient) / (2 * step), rtol=1e-4, atol=1e-3)
        wider = half_ball.jet(x + 30 * move).variance - half_ball.jet(x - 30 * move).variance
        torch.testing.assert_close(jet.variance_gradient[:, m], wider / (60 * step), rtol=1e-3, atol=1e-3)


def test_normal_jacobian_equals_finite_differences(half_ball: ShapeGP):
    x, h = _queries(half_ball, 8), 1e-5
    steps = h * torch.eye(3, dtype=torch.float64)
    ends = [(half_ball.mean_jet(x + step).normals, half_ball.mean_jet(x - step).normals) for step in steps]
    numeric = torch.stack([(ahead - behind) / (2 * h) for ahead, behind in ends], -1)
    torch.testing.assert_close(half_ball.mean_jet(x).normal_jacobian, numeric, atol=1e-6, rtol=1e-5)


def test_jet_is_finite_at_the_observations_and_for_no_points(half_ball: ShapeGP):
    jet = half_ball.jet(half_ball.x)
    assert all(torch.isfinite(t).all() for t in (jet.distance, jet.gradient, jet.hessian, jet.variance_gradient))
    assert half_ball.jet(half_ball.x[:0]).hessian.shape == (0, 3, 3)


def test_a_rigid_motion_and_a_scale_move_the_estimate_with_the_object(half_ball: ShapeGP, motion: Tensor):
    known, turn = _ball_observations(), motion[:3, :3]
    moved = _observe(known.x @ turn.T, known.distance, known.normal @ turn.T, known.has_normal)
    other = condition(moved, Normalisation(motion[:3, 3], 0.08), PointCloud(known.x))
    x = _queries(half_ball, 50)
    a, b = half_ball.predict(half_ball.metres(x)), other.predict(other.metres(x @ turn.T))
    torch.testing.assert_close(a.distance, b.distance, rtol=0, atol=1e-9)
    torch.testing.assert_close(a.normal @ turn.T, b.normal, rtol=0, atol=1e-8)
    torch.testing.assert_close(a.variance, b.variance, rtol=0, atol=1e-6)


def test_estimate_comes_in_the_dtype_of_the_points_and_is_solved_in_float64(half_ball: ShapeGP):
    points = half_ball.metres(_queries(half_ball, 30)).float()
    single, double = half_ball.predict(points), half_ball.predict(points.double())
    assert single.distance.dtype == torch.float32
    torch.testing.assert_close(single.distance, double.distance.float())
    assert half_ball.to(torch.float32).factor.dtype == torch.float64


def test_a_point_outside_the_domain_is_refused_by_name(half_ball: ShapeGP):
    center, edge = half_ball.center, half_ball.domain_radius * 0.05
    inside = center + torch.tensor([0.999 * edge, 0, 0], dtype=torch.float64)
    outside = center + torch.tensor([1.001 * edge, 0, 0], dtype=torch.float64)
    assert half_ball.contains(torch.stack([inside, outside])).tolist() == [True, False]
    half_ball.predict(inside)
    with pytest.raises(BadArgument, match="1 of 2 points outside the domain"):
        half_ball.predict(torch.stack([inside, outside]))


def test_no_points_have_an_empty_estimate(half_ball: ShapeGP):
    found = half_ball.predict(torch.zeros(2, 0, 3))
    assert found.covariance.shape == (2, 0, 4, 4) and found.std_m.shape == (2, 0)


def test_a_sum_of_an_estimate_and_other_terms_is_minimised_on_the_surface(half_ball: ShapeGP):
    points = half_ball.metres(0.8 * _queries(half_ball, 3)).float().requires_grad_()
    for _ in range(60):
        loss = (half_ball.predict(points).distance * half_ball.scale).square().sum() + 0.0 * points.sum()
        (slope,) = torch.autograd.grad(loss, points)
        points = (points - 0.3 * slope).detach().requires_grad_()
    assert points.dtype == torch.float32 and (half_ball.predict(points).distance.abs() < 1e-3).all()


def test_queries_that_are_not_finite_are_refused(half_ball: ShapeGP):
    with pytest.raises(BadArgument, match="points"):
        half_ball.predict(torch.full((2, 3), torch.nan))


@pytest.mark.promise("I11")
def test_three_points_make_the_papers_psi_indefinite_and_the_default_not():
    x = torch.tensor([[0, 0, 0.5], [0, 0, -0.5], [3**0.5 / 4, 0, 0.25]], dtype=torch.float64)
    has = torch.ones(3, dtype=torch.bool)
    matrix = covariance(x, x, has, has, partial(thin_plate, psi=longest_distance(x)))
    assert torch.linalg.eigvalsh(matrix).min().item() == pytest.approx(-0.2519, abs=1e-3)
    known = _observe(x, torch.zeros(3, dtype=torch.float64), unit(x), has)
    cloud, origin = PointCloud(torch.rand(5, 3)), torch.zeros(3, dtype=torch.float64)
    with pytest.raises(IndefiniteCovariance, match=r"eigenvalue -0\.2.*psi_scale of at least 1\.34"):
        condition(known, Normalisation(origin, 1.0), cloud, psi_scale=1.0)
    assert condition(known, Normalisation(origin, 1.0), cloud).domain_radius <= 1.5 * 3 / 8


def test_generous_noise_does_not_hide_an_indefinite_kernel():
    x = torch.tensor([[0, 0, 0.5], [0, 0, -0.5], [3**0.5 / 4, 0, 0.25]], dtype=torch.float64)
    has = torch.tensor([True, True, False])
    small, large = torch.full((3,), 0.01, dtype=torch.float64), torch.full((3,), 2.0, dtype=torch.float64)
    known = Observations(x, torch.zeros(3, dtype=torch.float64), unit(x), has, small, large)
    with pytest.raises(IndefiniteCovariance):
        condition(
            known, Normalisation(torch.zeros(3, dtype=torch.float64), 1.0), PointCloud(torch.rand(5, 3)), psi_scale=1.0
        )
