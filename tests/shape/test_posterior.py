"""Joint posterior, samples, derivatives, other kernels and later observations, against dense
algebra and refits.
"""

import math
from functools import partial
from typing import Any

import pytest
import torch
from sklearn.gaussian_process.kernels import RBF, Matern

from tests.make import (
    covariance,
    dense_posterior,
    fit_half_sphere,
    half_sphere,
    near,
    queries,
    real,
)
from torchgrasp.foundation.errors import BadArgument, CloudWarning, IndefiniteCovariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.conditioning import append_observations, posterior_given
from torchgrasp.shape.estimate import Observations
from torchgrasp.shape.kernel import (
    Kernel,
    KernelName,
    cross_covariance,
    differentiate,
    kernel_by_name,
    matern52_kernel,
    rbf_kernel,
    thin_plate,
)
from torchgrasp.shape.posterior import symmetric_root

EVERY_KERNEL = pytest.mark.parametrize("name", ["thin_plate", "matern52", "rbf"])
HIDDEN = real([[-1.0, 0.0, 0.0]])


@EVERY_KERNEL
def test_eq7_and_eq8_joint_posterior_equals_a_dense_solve(name: KernelName):
    known = half_sphere()
    shape = fit_half_sphere(known, name)
    points = queries(shape, 5)
    joint = shape.joint(points)
    alone = shape.predict(points)
    mean, spread = dense_posterior(known, shape.kernel.profile, shape.normalise(points))
    near(joint.mean, mean.reshape(4, 5).T, 1e-8)
    blocks = joint.covariance.reshape(5, 4, 5, 4)
    near(blocks, spread.reshape(4, 5, 4, 5).permute(1, 0, 3, 2), 1e-6)
    near(alone.covariance, torch.stack([blocks[i, :, i] for i in range(5)]), 1e-8)
    torch.testing.assert_close(alone.distance, joint.mean[:, 0])
    torch.testing.assert_close(alone.normal, unit(joint.mean[:, 1:]))


def test_samples_have_the_joint_mean_and_covariance_and_repeat_with_their_seed():
    shape = fit_half_sphere(half_sphere())
    points = queries(shape, 3)
    joint = shape.joint(points)
    drawn = shape.sample(points, 40000, seed=1)
    assert drawn.shape == (40000, 3, 4)
    deviation = joint.covariance.diagonal().sqrt()
    off = (drawn.mean(0) - joint.mean).reshape(-1) / deviation
    assert off.abs().max() < 5 / math.sqrt(40000)
    correlation = torch.cov(drawn.reshape(-1, 12).T) - joint.covariance
    assert (correlation / deviation / deviation[:, None]).abs().max() < 0.04
    assert torch.equal(drawn, shape.sample(points, 40000, seed=1))
    assert not torch.equal(drawn[:5], shape.sample(points, 5, seed=2))
    twice = shape.sample(points[:1].expand(2, 3), 50)
    near(twice[:, 0], twice[:, 1], 1e-5)  # no jitter parts them
    with pytest.raises(IndefiniteCovariance, match="joint"):
        symmetric_root(-torch.eye(4, dtype=torch.float64), 1.0, "")


@EVERY_KERNEL
def test_derivatives_equal_finite_differences_of_predictions(name: KernelName):
    shape = fit_half_sphere(half_sphere(), name)
    step = 1e-6
    points = queries(shape, 30).reshape(5, 6, 3)
    found = shape.differentiate(points)
    assert found.normal.shape == (5, 6, 3, 3)
    for m, move in enumerate(step * torch.eye(3, dtype=torch.float64)):
        up = shape.predict(points + move)
        down = shape.predict(points - move)
        for field in ("distance", "normal", "variance"):
            wanted = (getattr(up, field) - getattr(down, field)) / (2 * step)
            atol = 1e-3 * float(wanted.abs().max()) + 1e-4
            torch.testing.assert_close(getattr(found, field)[..., m], wanted, rtol=1e-3, atol=atol)


@EVERY_KERNEL
def test_closed_forms_of_a_kernel_equal_autograd_of_its_profile(name: KernelName):
    kernel = kernel_by_name(name, 3.6)
    r = real([0.0, 1e-7, 0.01, 0.3, 1.0, 2.4])
    derived = differentiate(kernel.profile, r * r / 2, 4)
    for i, (a, b) in enumerate(zip(kernel.derivatives(r, 4), derived, strict=True)):
        start = 0 if i < 2 else 2  # the higher ones are multiplied by 0 at r = 0
        torch.testing.assert_close(a[start:], b[start:], rtol=1e-6, atol=1e-6)
    prior, curvature = kernel.derivatives(r[:1], 2)  # the thin plate's, whatever the kernel
    torch.testing.assert_close(prior, torch.full_like(prior, 3.6**3))
    torch.testing.assert_close(curvature, torch.full_like(curvature, -6 * 3.6))
    x = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y = torch.cat([x[:2], 0.5 * x])
    wanted = covariance(x, y, torch.ones(6, dtype=torch.bool), torch.arange(8) < 5, kernel.profile)
    near(cross_covariance(kernel, x, y, 5).flatten(0, 1), wanted, 1e-8)


def test_kernels_are_those_of_scikit_learn_or_of_any_profile_and_unknown_ones_are_named():
    a = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for ours, theirs in (
        (matern52_kernel(0.7, 2.0), Matern(0.7, nu=2.5)),
        (rbf_kernel(0.7, 2.0), RBF(0.7)),
    ):
        torch.testing.assert_close(
            ours.profile(torch.cdist(a, a)), 2.0 * torch.as_tensor(theirs(a.numpy()))
        )
    known = half_sphere(12)
    shape = fit_half_sphere(known)
    own = fit_half_sphere(known, Kernel(partial(thin_plate, psi=shape.psi), shape.kernel.diameter))
    found = own.predict(queries(shape, 20))
    wanted = shape.predict(queries(shape, 20))
    near(found.distance, wanted.distance, 1e-8)
    near(found.covariance, wanted.covariance, 1e-6)
    with pytest.raises(BadArgument, match="kernel"):
        fit_half_sphere(known, "cubic")  # pyright: ignore[reportArgumentType]
    with pytest.raises(BadArgument, match="length"):
        rbf_kernel(0.0)


@EVERY_KERNEL
@pytest.mark.parametrize("with_normals", [True, False])
def test_updates_equal_a_refit(name: KernelName, with_normals: bool):
    known = half_sphere(50, extra=6)
    if not with_normals:
        has = torch.arange(len(known.x)) < len(known.x) - 6
        known = Observations(**{**vars(known), "has_normal": known.has_normal & has})
    first = known[slice(0, -6)]
    rest = known[slice(-6, None)]
    shape = fit_half_sphere(first, name)
    updated = shape
    refit = fit_half_sphere(known, shape.kernel)
    for rows in (slice(0, 1), slice(1, 3), slice(3, 6)):  # one after the other, and several at once
        new = rest[rows]
        normals = 3.0 * new.normal if with_normals else None  # of any length
        updated = updated.update(
            shape.metres(new.x), normals, noise=0.02 * shape.scale, normal_noise=0.05
        )
    near(updated.x, refit.x, 1e-12)
    assert torch.equal(updated.has_normal, refit.has_normal)
    points = queries(shape, 200)
    a = updated.predict(points)
    b = refit.predict(points)
    for field in ("distance", "normal", "variance", "covariance", "std_m"):
        near(getattr(a, field), getattr(b, field), 1e-9)
    a, b = (one.jet(shape.normalise(points)) for one in (updated, refit))
    for field, tolerance in (("hessian", 1e-7), ("variance", 1e-6), ("variance_gradient", 1e-5)):
        near(getattr(a, field), getattr(b, field), tolerance)
    near(updated.joint(points[:4]).covariance, refit.joint(points[:4]).covariance, 1e-9)


def test_errors_that_new_observations_share_equal_a_dense_solve():
    """Some of the new points have normals, and the errors of their distances two common causes."""
    known = half_sphere(30, extra=6)
    kernel = kernel_by_name("thin_plate", 3.6)
    known = Observations(
        **{**vars(known), "has_normal": known.has_normal & (torch.arange(len(known.x)) % 3 > 0)}
    )
    old = known[slice(0, -6)]
    new = known[slice(-6, None)]
    generator = torch.Generator().manual_seed(1)
    shared = 0.1 * torch.randn(6, 2, dtype=torch.float64, generator=generator)
    x = 0.9 * unit(torch.randn(20, 3, dtype=torch.float64, generator=generator))
    extra = torch.zeros(2 * (len(known.rows()[0]),), dtype=torch.float64)
    extra[len(old.x) : len(known.x), len(old.x) : len(known.x)] = shared @ shared.T
    wanted, covered = dense_posterior(known, kernel.profile, x, extra=extra)
    mean, spread = append_observations(posterior_given(old, kernel), new, shared).estimate(x)
    near(mean, wanted.reshape(4, 20).T, 1e-8)
    near(spread[:, 0, 0], covered.diagonal()[:20], 1e-8)
    alone = append_observations(posterior_given(old, kernel), new).estimate(x)[1]
    assert (spread[:, 0, 0] > alone[:, 0, 0] - 1e-12).all()


def test_a_touch_on_the_hidden_side_makes_it_certain():
    shape = fit_half_sphere(half_sphere())
    touch = shape.metres(HIDDEN)
    before = shape.predict(touch).variance.item()
    after = shape.update(touch).predict(touch)
    assert after.variance.item() < 0.02**2 < before and abs(after.distance.item()) < 0.03


def test_bad_updates_and_samples_are_named():
    shape = fit_half_sphere(half_sphere())
    on = shape.metres(HIDDEN)
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


def test_touched_normals_that_point_inward_are_told_and_noise_is_in_metres(recwarn):
    """The normals of a hand's fingertips point into the object: they would turn the surface."""
    shape = fit_half_sphere(half_sphere())
    touched = shape.metres(unit(real([[1.0, 0.2, 0.1], [0.9, -0.3, 0.2]])))
    outward = shape.predict(touched).normal
    shape.update(touched, outward)
    # the inner wall of a cup that was taken for a solid one
    shape.update(shape.metres(0.7 * shape.normalise(touched)), -outward)
    assert not recwarn.list
    with pytest.warns(CloudWarning, match="normals: they point into the shape"):
        shape.update(touched, -outward)
    with pytest.raises(BadArgument, match=r"^noise: expected a number in .*0\.1\], got 1"):
        shape.update(touched, noise=1.0)  # a millimetre
