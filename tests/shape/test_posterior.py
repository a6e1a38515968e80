"""Joint posterior, samples, derivatives, other kernels and later observations, against dense algebra and refits."""

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.make import covariance
from torchgrasp.errors import BadArgument, IndefiniteCovariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.conditioning import append_observations, posterior_given
from torchgrasp.shape.fit import condition
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.kernel import (
    Kernel,
    cross_covariance,
    differentiate,
    kernel_by_name,
    matern52_kernel,
    rbf_kernel,
    thin_plate,
)
from torchgrasp.shape.posterior import symmetric_root
from torchgrasp.shape.values import Normalisation, Observations
from torchgrasp.values import PointCloud

SCALE = 0.05
CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
NAMES = ("thin_plate", "matern52", "rbf")


def _known(n: int = 40, extra: int = 0) -> Observations:
    """Points of the unit sphere's right half with normals, and points off it without; `extra` further ones on it."""
    rng = torch.Generator().manual_seed(3)
    on = unit(torch.randn(n + extra, 3, dtype=torch.float64, generator=rng))
    on = torch.cat([on[:, :1].abs(), on[:, 1:]], 1)
    off = torch.cat([torch.zeros(1, 3, dtype=torch.float64), 1.2 * on[:10], -1.2 * on[:10]])
    x = torch.cat([off, on])
    has = torch.arange(len(x)) >= len(off)
    distance = torch.where(has, 0.0, torch.linalg.vector_norm(x, dim=-1) - 1.0)
    sigma = torch.full_like(distance, 0.02)
    return Observations(x, distance, x, has, sigma, 2.5 * sigma)


def _fit(known: Observations, kernel: str | Kernel = "thin_plate") -> ShapeGP:
    return condition(known, Normalisation(CENTER, SCALE), PointCloud(SCALE * known.x + CENTER), kernel=kernel)


def _queries(shape: ShapeGP, n: int) -> Tensor:
    rng = torch.Generator().manual_seed(7)
    x = unit(torch.randn(n, 3, dtype=torch.float64, generator=rng))
    return shape.metres(x * torch.rand(n, 1, dtype=torch.float64, generator=rng) * shape.domain_radius * 0.99)


def _dense(known: Observations, kernel: Kernel, x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and covariance of (d, w) at points by one dense solve, component by component."""
    y, noise = known.rows()
    yes, has = torch.ones(len(x), dtype=torch.bool), known.has_normal
    k = covariance(known.x, known.x, has, has, kernel.profile) + torch.diag(noise)
    star = covariance(x, known.x, yes, has, kernel.profile)
    return star @ torch.linalg.solve(k, y), covariance(x, x, yes, yes, kernel.profile) - star @ torch.linalg.solve(
        k, star.T
    )


@pytest.mark.parametrize("name", NAMES)
def test_eq7_and_eq8_joint_posterior_equals_a_dense_solve(name: str):
    known = _known()
    shape = _fit(known, name)
    points = _queries(shape, 5)
    joint = shape.joint(points)
    mean, spread = _dense(known, shape.kernel, shape.normalise(points))
    torch.testing.assert_close(joint.mean, mean.reshape(4, 5).T, rtol=0, atol=1e-8)
    wanted = spread.reshape(4, 5, 4, 5).permute(1, 0, 3, 2)
    torch.testing.assert_close(joint.covariance.reshape(5, 4, 5, 4), wanted, rtol=0, atol=1e-6)
    alone = shape.predict(points)
    blocks = torch.stack([joint.covariance.reshape(5, 4, 5, 4)[i, :, i] for i in range(5)])
    torch.testing.assert_close(alone.covariance, blocks, rtol=0, atol=1e-8)
    torch.testing.assert_close(alone.distance, joint.mean[:, 0])


def test_samples_have_the_joint_mean_and_covariance_and_repeat_with_their_seed():
    shape = _fit(_known())
    points = _queries(shape, 3)
    joint, drawn = shape.joint(points), shape.sample(points, 40000, seed=1)
    assert drawn.shape == (40000, 3, 4)
    deviation = joint.covariance.diagonal().sqrt()
    off = (drawn.mean(0) - joint.mean).reshape(-1) / deviation
    assert off.abs().max() < 5 / math.sqrt(40000)
    correlation = torch.cov(drawn.reshape(-1, 12).T) - joint.covariance
    assert (correlation / deviation / deviation[:, None]).abs().max() < 0.04
    assert torch.equal(drawn, shape.sample(points, 40000, seed=1))
    assert not torch.equal(drawn[:5], shape.sample(points, 5, seed=2))


def test_a_point_sampled_twice_is_the_same_and_no_jitter_hides_it():
    shape = _fit(_known())
    point = _queries(shape, 1)
    drawn = shape.sample(point.expand(2, 3), 50)
    torch.testing.assert_close(drawn[:, 0], drawn[:, 1], rtol=0, atol=1e-5)
    with pytest.raises(IndefiniteCovariance, match="joint"):
        symmetric_root(-torch.eye(4, dtype=torch.float64), 1.0, "")


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_equal_finite_differences_of_predictions(name: str):
    shape = _fit(_known(), name)
    points, step = _queries(shape, 30).reshape(5, 6, 3), 1e-6
    found = shape.differentiate(points)
    assert found.normal.shape == (5, 6, 3, 3)
    for m in range(3):
        move = step * torch.eye(3, dtype=torch.float64)[m]
        up, down = shape.predict(points + move), shape.predict(points - move)
        for value, wanted in (
            (found.distance[..., m], (up.distance - down.distance) / (2 * step)),
            (found.normal[..., m], (up.normal - down.normal) / (2 * step)),
            (found.variance[..., m], (up.variance - down.variance) / (2 * step)),
        ):
            torch.testing.assert_close(value, wanted, rtol=1e-3, atol=1e-3 * float(wanted.abs().max()) + 1e-4)


def test_mean_and_gradient_without_variances_equal_the_jet():
    shape = _fit(_known())
    x = shape.normalise(_queries(shape, 700))
    distance, gradient = shape.mean_and_gradient(x)
    jet = shape.jet(x)
    torch.testing.assert_close(distance, jet.distance, rtol=0, atol=1e-9)
    torch.testing.assert_close(gradient, jet.gradient, rtol=0, atol=1e-9)
    torch.testing.assert_close(shape.mean_jet(x).hessian, jet.hessian, rtol=0, atol=1e-9)
    assert torch.isfinite(shape.mean_and_gradient(shape.x)[1]).all()


@pytest.mark.parametrize("name", NAMES)
def test_closed_forms_of_a_kernel_equal_autograd_of_its_profile(name: str):
    kernel = kernel_by_name(name, 3.6)
    r = torch.tensor([0.0, 1e-7, 0.01, 0.3, 1.0, 2.4], dtype=torch.float64)
    derived = differentiate(kernel.profile, r, 4)
    for i, (a, b) in enumerate(zip(kernel.derivatives(r, 4), derived, strict=True)):
        start = 0 if i < 2 else 2  # the higher ones are multiplied by 0 at r = 0
        torch.testing.assert_close(a[start:], b[start:], rtol=1e-6, atol=1e-6)
    x = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y = torch.cat([x[:2], 0.5 * x])
    yes, has = torch.ones(6, dtype=torch.bool), torch.arange(8) < 5
    wanted = covariance(x, y, yes, has, kernel.profile)
    torch.testing.assert_close(cross_covariance(kernel, x, y, 5).flatten(0, 1), wanted, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_kernels_have_the_thin_plates_prior_variances(name: str):
    k, curvature = kernel_by_name(name, 3.6).derivatives(torch.zeros(1, dtype=torch.float64), 2)
    torch.testing.assert_close(k, torch.full_like(k, 3.6**3))
    torch.testing.assert_close(curvature, torch.full_like(k, -6 * 3.6))


def test_matern_and_rbf_are_those_of_scikit_learn():
    from sklearn.gaussian_process.kernels import RBF, Matern

    a = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    r = torch.cdist(a, a)
    for ours, theirs in ((matern52_kernel(0.7, 2.0), Matern(0.7, nu=2.5)), (rbf_kernel(0.7, 2.0), RBF(0.7))):
        torch.testing.assert_close(ours.profile(r), 2.0 * torch.as_tensor(theirs(a.numpy())))


def test_any_profile_gives_the_posterior_of_the_same_kernel_by_name():
    known = _known(12)
    shape = _fit(known)
    own = _fit(known, Kernel(partial(thin_plate, psi=shape.psi), shape.kernel.diameter))
    points = _queries(shape, 20)
    a, b = shape.predict(points), own.predict(points)
    torch.testing.assert_close(a.distance, b.distance, rtol=0, atol=1e-8)
    torch.testing.assert_close(a.covariance, b.covariance, rtol=0, atol=1e-6)


def test_an_unknown_kernel_is_named():
    with pytest.raises(BadArgument, match="kernel"):
        _fit(_known(), "cubic")
    with pytest.raises(BadArgument, match="length"):
        rbf_kernel(0.0)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("with_normals", [True, False])
def test_updates_equal_a_refit(name: str, with_normals: bool):
    known = _known(50, extra=6)
    if not with_normals:
        has = torch.arange(len(known.x)) < len(known.x) - 6
        known = Observations(**{**vars(known), "has_normal": known.has_normal & has})
    first, rest = known[slice(0, -6)], known[slice(-6, None)]
    shape = _fit(first, name)
    refit = condition(known, Normalisation(CENTER, SCALE), shape.cloud, kernel=shape.kernel)
    updated = shape
    for rows in (slice(0, 1), slice(1, 3), slice(3, 6)):  # one after the other, and several at once
        new = rest[rows]
        normals = 3.0 * new.normal if with_normals else None  # of any length
        updated = updated.update(shape.metres(new.x), normals, noise=0.02 * SCALE, normal_noise=0.05)
    torch.testing.assert_close(updated.x, refit.x, rtol=0, atol=1e-12)
    assert torch.equal(updated.has_normal, refit.has_normal)
    points = _queries(shape, 200)
    a, b = updated.predict(points), refit.predict(points)
    for field in ("distance", "normal", "variance", "covariance", "std_m"):
        torch.testing.assert_close(getattr(a, field), getattr(b, field), rtol=0, atol=1e-9)
    x = shape.normalise(points)
    for field, tolerance in (("hessian", 1e-7), ("variance", 1e-6), ("variance_gradient", 1e-5)):
        torch.testing.assert_close(getattr(updated.jet(x), field), getattr(refit.jet(x), field), rtol=0, atol=tolerance)
    torch.testing.assert_close(
        updated.joint(points[:4]).covariance, refit.joint(points[:4]).covariance, atol=1e-9, rtol=0
    )


def test_errors_that_new_observations_share_equal_a_dense_solve():
    """Some of the new points have normals, and the errors of their distances two common causes."""
    known, kernel = _known(30, extra=6), kernel_by_name("thin_plate", 3.6)
    known = Observations(**{**vars(known), "has_normal": known.has_normal & (torch.arange(len(known.x)) % 3 > 0)})
    old, new = known[slice(0, -6)], known[slice(-6, None)]
    rng = torch.Generator().manual_seed(1)
    shared = 0.1 * torch.randn(6, 2, dtype=torch.float64, generator=rng)
    found = append_observations(posterior_given(old, kernel), new, shared)
    y, noise = known.rows()
    extra = torch.zeros(len(y), len(y), dtype=torch.float64)
    extra[len(old.x) : len(known.x), len(old.x) : len(known.x)] = shared @ shared.T
    x = 0.9 * unit(torch.randn(20, 3, dtype=torch.float64, generator=rng))
    yes = torch.ones(len(x), dtype=torch.bool)
    k = covariance(known.x, known.x, known.has_normal, known.has_normal, kernel.profile) + torch.diag(noise) + extra
    star = covariance(x, known.x, yes, known.has_normal, kernel.profile)
    mean, spread = found.estimate(x)
    torch.testing.assert_close(mean, (star @ torch.linalg.solve(k, y)).reshape(4, 20).T, rtol=0, atol=1e-8)
    left = kernel.profile(x.new_zeros(())) - (star[:20] * torch.linalg.solve(k, star[:20].T).T).sum(1)
    torch.testing.assert_close(spread[:, 0, 0], left, rtol=0, atol=1e-8)
    alone = append_observations(posterior_given(old, kernel), new).estimate(x)[1]
    assert (spread[:, 0, 0] > alone[:, 0, 0] - 1e-12).all()


def test_a_touch_on_the_hidden_side_makes_it_certain():
    shape = _fit(_known())
    touch = shape.metres(torch.tensor([[-1.0, 0.0, 0.0]], dtype=torch.float64))
    before = shape.predict(touch).variance.item()
    after = shape.update(touch).predict(touch)
    assert after.variance.item() < 0.02**2 < before and abs(after.distance.item()) < 0.03


def test_bad_updates_and_samples_are_named():
    shape = _fit(_known())
    on = shape.metres(torch.tensor([[-1.0, 0.0, 0.0]], dtype=torch.float64))
    bad: list[tuple[dict[str, Any], str]] = [
        ({"points": on + 1.0}, "points"),
        ({"points": on, "normals": torch.zeros(1, 3)}, "normals"),
        ({"points": on, "noise": 0.0}, "noise"),
        ({"points": on, "normal_noise": math.nan}, "normal_noise"),
    ]
    for arguments, name in bad:
        with pytest.raises(BadArgument, match=f"^{name}:"):
            shape.update(**arguments)
    with pytest.raises(BadArgument, match=r"n: expected .*got -1"):
        shape.sample(on, -1)
    with pytest.raises(BadArgument, match="1001 points"):
        shape.joint(on.expand(1001, 3))
    assert shape.joint(on[:0]).covariance.shape == (0, 0)
    assert shape.sample(on[:0], 2).shape == (2, 0, 4)
