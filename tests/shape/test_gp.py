"""The estimate of half a sphere against finite differences, closed forms, and the theory of the
kernel's domain.
"""

import dataclasses
import math
from functools import partial

import pytest
import torch
from torch import Tensor

from tests.make import covariance, fit_half_sphere, half_sphere, near, queries, real
from torchgrasp import PointCloud, ShapeGP, fit_shape
from torchgrasp.foundation.errors import BadArgument, IndefiniteCovariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape import Normalisation, Observations, condition, extract_surface
from torchgrasp.shape.conditioning import longest_distance
from torchgrasp.shape.kernel import thin_plate

EYE = torch.eye(3, dtype=torch.float64)


@pytest.fixture(scope="module")
def shape() -> ShapeGP:
    """The unit sphere as a ball of 50 mm at an offset, seen from the right."""
    return fit_half_sphere(half_sphere(), std_factor=0.65)


def test_eq1_estimate_has_the_shape_and_dtype_of_the_points_and_unit_normals(shape: ShapeGP):
    points = queries(shape, 12).reshape(3, 4, 3)
    found = shape.predict(points)
    flat = shape.predict(points.reshape(-1, 3))
    assert found.distance.shape == (3, 4) and found.covariance.shape == (3, 4, 4, 4)
    torch.testing.assert_close(found.normal.norm(dim=-1), torch.ones(3, 4, dtype=torch.float64))
    torch.testing.assert_close(flat.variance.reshape(3, 4), found.variance)
    single = shape.predict(points.float())
    double = shape.predict(points.float().double())
    assert (
        single.distance.dtype == torch.float32
        and shape.to(torch.float32).factor.dtype == torch.float64
    )
    torch.testing.assert_close(single.distance, double.distance.float())
    none = shape.predict(torch.zeros(2, 0, 3))
    assert none.covariance.shape == (2, 0, 4, 4) and none.std_m.shape == (2, 0)


@pytest.mark.promise("N4")
def test_eq8_variance_is_within_zero_and_the_prior_and_eq9_zero_level_is_the_sphere_where_seen(
    shape: ShapeGP,
):
    found = shape.predict(queries(shape, 3000))
    assert found.variance.min() > 0 and found.variance.max() < shape.psi**3
    assert torch.linalg.eigvalsh(found.covariance).min() > -1e-6
    assert (
        shape.predict(shape.metres(EYE[0])).variance
        < 0.01
        < shape.predict(shape.metres(-EYE[0])).variance
    )
    known = half_sphere()
    on = known.x[known.has_normal]
    found = shape.predict(shape.metres(on))
    assert found.distance.abs().max() < 0.02
    assert (found.normal * on).sum(-1).min() > 0.99


def test_std_m_is_the_calibrated_deviation_in_metres_over_the_slope(
    shape: ShapeGP, seen_cylinder: PointCloud
):
    points = queries(shape, 5)
    found = shape.predict(points)
    slope = shape.differentiate(points).distance.norm(dim=-1) * shape.scale
    torch.testing.assert_close(found.std_m, 0.65 * shape.scale * found.variance.sqrt() / slope)
    steep = fit_shape(seen_cylinder, support="paper")
    step = 1e-6
    surface = extract_surface(steep, 16)
    found = steep.predict(surface.vertices)
    up, down = (
        steep.predict(surface.vertices + k * step * surface.normals).distance for k in (1, -1)
    )
    slope = (up - down) / (2 * step)  # per metre
    assert float((slope * steep.scale).quantile(0.9)) > 1.2  # the paper's means are steep
    for std_m in (found.std_m, surface.std_m):
        torch.testing.assert_close(std_m, found.variance.sqrt() / slope, rtol=1e-4, atol=0)


def test_variances_equal_those_of_a_dense_solve(shape: ShapeGP):
    x = shape.normalise(queries(shape, 300))
    cross = shape.cross(x).transpose(0, 1)
    lines = shape.ordered(cross.flatten(0, 1).T)
    solved = torch.linalg.solve(shape.factor @ shape.factor.T, lines)
    explained = lines.T.view(-1, 4, len(lines)) @ solved.T.view(-1, 4, len(lines)).mT
    covariance = shape.estimate(x)[1]
    prior = float(shape.prior_block()[0, 0])
    near(covariance, shape.prior_block() - explained, 1e-9 * prior)
    near(shape.variance(x), covariance[:, 0, 0], 1e-12 * prior)
    assert shape.variance(x[:0]).shape == (0,)


def test_jet_equals_predict_and_its_gradients_equal_finite_differences(shape: ShapeGP):
    points = queries(shape, 300)
    step = 1e-5
    x = shape.normalise(points)
    jet = shape.jet(x)
    found = shape.predict(points)
    for distance in (found.distance, shape.mean(x), shape.mean_and_gradient(x)[0]):
        near(jet.distance, distance, 1e-9)
    near(shape.mean_and_gradient(x)[1], jet.gradient, 1e-9)
    near(shape.mean_jet(x).hessian, jet.hessian, 1e-9)
    near(jet.variance, found.variance, 1e-6)
    near(unit(jet.gradient), found.normal, 1e-8)
    for m, move in enumerate(step * EYE):
        up = shape.jet(x + move)
        down = shape.jet(x - move)
        near(jet.gradient[:, m], (up.distance - down.distance) / (2 * step), 1e-5)
        torch.testing.assert_close(
            jet.hessian[:, m], (up.gradient - down.gradient) / (2 * step), rtol=1e-4, atol=1e-3
        )
        normals = (shape.mean_jet(x + move).normals - shape.mean_jet(x - move).normals) / (2 * step)
        torch.testing.assert_close(
            shape.mean_jet(x).normal_jacobian[..., m], normals, rtol=1e-3, atol=1e-4
        )
        wider = shape.jet(x + 30 * move).variance - shape.jet(x - 30 * move).variance
        torch.testing.assert_close(
            jet.variance_gradient[:, m], wider / (60 * step), rtol=1e-3, atol=1e-3
        )
    there = shape.jet(shape.x)  # at the observations
    assert all(
        torch.isfinite(t).all()
        for t in (there.distance, there.gradient, there.hessian, there.variance_gradient)
    )
    assert torch.isfinite(shape.mean_and_gradient(shape.x)[1]).all()
    assert shape.jet(shape.x[:0]).hessian.shape == (0, 3, 3)


def test_a_rigid_motion_and_a_scale_move_the_estimate_with_the_object(
    shape: ShapeGP, motion: Tensor
):
    known = half_sphere()
    turn = motion[:3, :3]
    moved = Observations(**{**vars(known), "x": known.x @ turn.T, "normal": known.normal @ turn.T})
    other = condition(moved, Normalisation(motion[:3, 3], 0.08), PointCloud(known.x))
    points = queries(shape, 50)
    a = shape.predict(points)
    b = other.predict(other.metres(shape.normalise(points) @ turn.T))
    near(a.distance, b.distance, 1e-9)
    near(a.normal @ turn.T, b.normal, 1e-8)
    near(a.variance, b.variance, 1e-6)


def test_points_far_outside_the_domain_or_not_finite_are_refused_by_name(shape: ShapeGP):
    edge = shape.domain_radius * shape.scale * EYE[0]
    points, twice = (
        shape.center + k * torch.stack([0.999 * edge, 1.001 * edge]) for k in (1.0, 2.0)
    )
    assert shape.contains(points).tolist() == [True, False]
    shape.predict(torch.cat([points, twice[:1]]))
    with pytest.raises(BadArgument, match="1 of 2 points far outside the domain"):
        shape.predict(twice)
    for strict in (shape.differentiate, shape.joint, shape.update):
        with pytest.raises(BadArgument, match="1 of 2 points outside the domain"):
            strict(points)
    with pytest.raises(BadArgument, match="points"):
        shape.predict(torch.full((2, 3), torch.nan))


@pytest.mark.promise("N4")
def test_beside_the_domain_distance_grows_outward_from_its_edge_and_the_deviation_is_the_priors(
    shape: ShapeGP,
):
    out = unit(queries(shape, 40) - shape.center)
    radius = shape.domain_radius * shape.scale

    def at(share: float) -> Tensor:
        return shape.center + share * radius * out

    inside, edge, beyond = (shape.predict(at(share)) for share in (0.3, 1.0 - 1e-9, 1.0 + 1e-9))
    near(beyond.distance, edge.distance, 1e-7)
    for share in (1.1, 1.9):
        found = shape.predict(at(share))
        grown = (found.distance - edge.distance) * shape.scale / radius
        near(grown, torch.full_like(grown, share - 1.0), 1e-7)
        # The closed form of the thin plate's prior: the variances psi^3 of a distance, 6 psi of a
        # gradient's component.
        prior = torch.diag(real([shape.psi**3, *[6 * shape.psi] * 3]))
        near(found.covariance, prior.expand(40, 4, 4), 1e-9)
        near(found.std_m, torch.full_like(grown, 0.65 * shape.scale * shape.psi**1.5), 1e-9)
        assert (found.variance > edge.variance).all()
    points = torch.cat([at(1.3), at(0.3)]).requires_grad_()
    step = 1e-7
    mixed = shape.predict(points)
    near(mixed.distance[40:].detach(), inside.distance, 1e-12)  # neighbours outside change nothing
    (slope,) = torch.autograd.grad(mixed.distance.sum(), points)
    moved = [
        shape.predict(points.detach() + k * step * axis).distance for k in (1, -1) for axis in EYE
    ]
    near(slope, (torch.stack(moved[:3], 1) - torch.stack(moved[3:], 1)) / (2 * step), 1e-3)
    near(mixed.normal.detach(), unit(slope), 1e-9)


def test_a_sum_of_an_estimate_and_other_terms_is_minimised_on_the_surface(shape: ShapeGP):
    points = shape.metres(0.8 * shape.normalise(queries(shape, 3))).float().requires_grad_()
    for _ in range(60):
        loss = (shape.predict(points).distance * shape.scale).square().sum() + 0.0 * points.sum()
        (slope,) = torch.autograd.grad(loss, points)
        points = (points - 0.3 * slope).detach().requires_grad_()
    assert points.dtype == torch.float32 and (shape.predict(points).distance.abs() < 1e-3).all()


@pytest.mark.promise("I11")
def test_three_points_make_the_papers_psi_indefinite_and_the_default_not():
    x = real([[0, 0, 0.5], [0, 0, -0.5], [3**0.5 / 4, 0, 0.25]])
    has = torch.ones(3, dtype=torch.bool)
    zero = torch.zeros(3, dtype=torch.float64)
    matrix = covariance(x, x, has, has, partial(thin_plate, psi=longest_distance(x)))
    assert torch.linalg.eigvalsh(matrix).min().item() == pytest.approx(-0.2519, abs=1e-3)
    known = Observations(x, zero, unit(x), has, zero + 0.01, zero + 0.01)
    rest = Normalisation(zero, 1.0), PointCloud(torch.rand(5, 3))
    with pytest.raises(
        IndefiniteCovariance, match=r"eigenvalue -0\.2.*psi_scale of at least 1\.34"
    ):
        condition(known, *rest, psi_scale=1.0)
    assert condition(known, *rest).domain_radius <= 1.5 * 3 / 8
    noisy = Observations(x, zero, unit(x), torch.arange(3) < 2, zero + 0.01, zero + 2.0)
    with pytest.raises(IndefiniteCovariance):  # generous noise does not hide it
        condition(noisy, *rest, psi_scale=1.0)


@pytest.mark.parametrize("scale", [0.0, -0.05, math.nan])
def test_a_normalised_frame_has_a_positive_scale(scale):
    with pytest.raises(BadArgument, match=r"^scale: expected a positive number"):
        Normalisation(torch.zeros(3), scale)


def test_observed_normals_have_length_1_and_others_may_be_any_numbers():
    """Normals of a mesh's faces that are not normalised would stretch all distances."""
    known = half_sphere()
    frame = Normalisation(real([0.3, -0.2, 0.1]), 0.05)
    cloud = PointCloud(frame.metres(known.x[known.has_normal]))
    for factor in (0.0, 0.4, 5.0):
        longer = dataclasses.replace(known, normal=factor * known.normal)
        with pytest.raises(BadArgument, match=r"observations.normal: expected unit vectors"):
            condition(longer, frame, cloud)
    # rounded to two decimals, and without meaning where none was observed
    normal = torch.where(known.has_normal[:, None], known.normal.mul(1e2).round() / 1e2, 7.0)
    rounded = condition(dataclasses.replace(known, normal=normal), frame, cloud)
    points = queries(rounded, 20)
    exact = condition(known, frame, cloud)
    near(rounded.predict(points).distance, exact.predict(points).distance, 2e-2)
