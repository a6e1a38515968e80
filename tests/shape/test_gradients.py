"""Derivatives of a shape against a plain Gaussian process, finite differences, and one transform
against another.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck
from torch.autograd.forward_ad import dual_level, make_dual, unpack_dual

from tests.make import cup_view, directions, near, real
from torchgrasp import PointCloud, ShapeGP, fit_shape
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.shape import (
    HollowShape,
    Kernel,
    Normalisation,
    Observations,
    condition,
    extract_surface,
    matern52_kernel,
    rbf_kernel,
    surface_field,
    thin_plate_kernel,
)
from torchgrasp.shape.kernel import thin_plate

KERNELS = {
    "thin_plate": thin_plate_kernel(4.0),
    "matern52": matern52_kernel(1.5, 10.0),
    "rbf": rbf_kernel(1.5, 10.0),
    "own": Kernel(lambda r: 4.0 / (1.0 + 0.3 * r * r)),
}
PLATE = thin_plate_kernel(4.0)
BY_AUTOGRAD = thin_plate_kernel(4.0, closed_form=False)
EVERY_KERNEL = pytest.mark.parametrize("kernel", KERNELS)
FRAME = Normalisation(real([0.1, 0.2, 0.3]), 0.05)
POINTS = 0.8 * directions(2, seed=3)
NOISE = torch.linspace(0.02, 0.05, 6, dtype=torch.float64)
SEEN = Observations(
    directions(6),
    0.1 * torch.cos(3 * directions(6)[:, 0]),
    directions(6),
    torch.arange(6) % 3 > 0,
    NOISE,
    2 * NOISE,
)
Outputs = tuple[Tensor, ...]


def shape_of(
    kernel: str | Kernel, seen: Observations = SEEN, frame: Normalisation = FRAME
) -> ShapeGP:
    kernel = KERNELS[kernel] if isinstance(kernel, str) else kernel
    return condition(seen, frame, PointCloud(0.05 * SEEN.x), kernel=kernel)


def predict(shape: ShapeGP, x: Tensor) -> Outputs:
    """Everything that `predict` returns, at normalised points."""
    found = shape.predict(shape.metres(x))
    return found.distance, found.normal, found.variance, found.covariance, 100 * found.std_m


def tensors(found: Any) -> Outputs:
    return (
        found
        if isinstance(found, tuple)
        else (found,)
        if isinstance(found, Tensor)
        else (*named_tensors(found).values(),)
    )


def total(function: Callable[[Tensor], Outputs]) -> Callable[[Tensor], Tensor]:
    return lambda x: torch.stack([(y * y).sum() for y in function(x)]).sum()


def check(function: Callable[[Tensor], Outputs], x: Tensor, tolerance: float = 1e-9) -> None:
    """Check first and second derivatives by finite differences, and that forward mode agrees with
    reverse mode.
    """
    tracked = x.clone().requires_grad_()
    attached = lambda x: tuple(y + 0.0 * x.sum() for y in function(x))  # noqa: E731
    close(function(tracked), function(x), tolerance)
    assert gradcheck(
        attached, tracked, fast_mode=True, atol=1e-4
    )  # which skips no output that does not depend on x
    assert gradgradcheck(attached, tracked, fast_mode=True, atol=1e-3)
    close(torch.func.jacrev(function)(x), torch.func.jacfwd(function)(x), tolerance)


def close(found: Outputs, wanted: Outputs, tolerance: float = 1e-9) -> None:
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


def plain_posterior(
    profile: Callable[[Tensor], Tensor], seen: Observations, x: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean (4,) and covariance (4, 4) of a Gaussian process at a point; covariances are derivatives
    of k(|a - b|).
    """

    def block(a: Tensor, b: Tensor) -> Tensor:
        k = lambda a, b: profile((a - b).square().sum().sqrt())  # noqa: E731
        by_a = torch.func.grad(k)
        by_b = torch.func.grad(k, 1)
        both = torch.func.jacrev(torch.func.grad(k), 1)
        top = torch.cat([k(a, b)[None], by_b(a, b)])
        return torch.cat([top[None], torch.cat([by_a(a, b)[:, None], both(a, b)], 1)])

    def matrix(a: Tensor, b: Tensor) -> Tensor:
        return torch.cat(
            [torch.cat([block(p, q + 1e-9) for q in b], 1) for p in a]
        )  # r > 0: sqrt has no slope at 0

    keep = torch.stack([torch.ones_like(seen.has_normal), *[seen.has_normal] * 3], 1).flatten()
    y = torch.cat([seen.distance[:, None], seen.normal], 1).flatten()[keep]
    noise = torch.stack([seen.distance_noise, *[seen.normal_noise] * 3], 1).flatten()[keep]
    cross = matrix(x[None], seen.x)[:, keep]
    own = matrix(seen.x, seen.x)[keep][:, keep]
    solved = torch.linalg.solve(own + torch.diag(noise**2), torch.cat([y[:, None], cross.T], 1))
    return cross @ solved[:, 0], matrix(x[None], x[None]) - cross @ solved[:, 1:]


@EVERY_KERNEL
def test_estimates_and_their_derivatives_are_those_of_a_plain_gaussian_process(kernel: str):
    shape = shape_of(kernel)
    x = POINTS[:1]
    wanted = plain_posterior(KERNELS[kernel].profile, SEEN, x[0])
    for found, exact in zip(shape.estimate(x), wanted, strict=True):
        near(found[0], exact, 1e-6)
    slopes = torch.func.jacrev(lambda p: plain_posterior(KERNELS[kernel].profile, SEEN, p)[0])(x[0])
    near(torch.func.jacrev(lambda p: shape.estimate(p)[0])(x)[0, :, 0], slopes, 1e-5)
    near(shape.mean_jet(x).hessian[0], slopes[1:], 1e-5)


@pytest.mark.parametrize(
    ("kernel", "name"),
    [(k, "predict") for k in KERNELS] + [("own", name) for name in ("jet", "joint_at", "sample")],
)
def test_estimates_are_twice_differentiable_in_the_points(kernel: str, name: str):
    shape = shape_of(kernel)
    functions: dict[str, Callable[[Tensor], Any]] = {
        "predict": partial(predict, shape),
        "sample": lambda x: shape.sample(shape.metres(x), 2, seed=1),
    }
    function = functions.get(name) or getattr(shape, name)
    check(lambda x: tensors(function(x)), POINTS, tolerance=1e-7)


@pytest.mark.parametrize("kernel", ["thin_plate", "matern52"])
def test_every_transform_gives_the_same_derivatives(kernel: str):
    shape = shape_of(kernel)
    names = (
        "mean",
        "mean_and_gradient",
        "mean_jet",
        "jet",
        "estimate",
        "cross",
        "distance_rows",
        "joint_at",
    )
    functions = [partial(predict, shape), lambda x: tensors(shape.differentiate(shape.metres(x)))]
    functions += [lambda x, name=name: tensors(getattr(shape, name)(x)) for name in names]
    for function in functions:
        alone = zip(*map(function, POINTS[:, None]), strict=True)
        close(torch.vmap(function)(POINTS[:, None]), tuple(map(torch.stack, alone)), 1e-7)
        close(torch.func.jacrev(function)(POINTS), torch.func.jacfwd(function)(POINTS), 1e-7)
        with dual_level():
            slopes = [
                unpack_dual(y).tangent for y in function(make_dual(POINTS, torch.ones_like(POINTS)))
            ]
        close(
            tuple(y for y in slopes if y is not None),
            torch.func.jvp(function, (POINTS,), (torch.ones_like(POINTS),))[1],
        )


@EVERY_KERNEL
def test_hessians_equal_finite_differences_of_gradients_at_observed_points_too(kernel: str):
    shape = shape_of(kernel)
    smooth = (
        kernel != "thin_plate"
    )  # the thin plate's normals have no second derivative at observed points
    for x in (POINTS[0], SEEN.x[0], SEEN.x[1])[: 3 if smooth else 1]:
        function = total(lambda x: predict(shape, x))
        # leaves the polynomial near r = 0
        slope = torch.func.grad(function)
        step = 3e-4
        wanted = torch.stack(
            [(slope(x + e) - slope(x - e)) / (2 * step) for e in step * torch.eye(3).double()]
        )
        found = torch.func.hessian(function)(x)
        assert (found - wanted).abs().max() < 3e-3 * wanted.abs().max()
    for x in (SEEN.x[:1], SEEN.x[1:2]):  # first derivatives exist everywhere
        assert gradcheck(
            lambda x: shape.mean_and_gradient(x), x.clone().requires_grad_(), eps=1e-8, atol=1e-4
        )


@EVERY_KERNEL
def test_derivatives_of_a_kernel_are_differentiable_by_the_distance(kernel: str):
    check(lambda r: KERNELS[kernel].derivatives(r, 4), real([0.3, 1.1]), tolerance=1e-7)
    r = real([0.0, 1.1])  # the thin plate's second derivative is infinite at 0 and counts as 0
    close(
        torch.vmap(lambda r: KERNELS[kernel].derivatives(r, 3))(r),
        KERNELS[kernel].derivatives(r, 3),
    )
    r = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(KERNELS[kernel].derivatives(r, 1)[0], r, create_graph=True)
    assert slope == 0  # k'(0) = 0, and k''(0) is the first derivative by r^2 / 2
    torch.testing.assert_close(
        torch.autograd.grad(slope, r)[0], KERNELS[kernel].derivatives(r, 2)[1]
    )


def test_the_thin_plate_by_autograd_of_its_profile_equals_the_closed_form_in_values_and_gradients():
    assert PLATE.closed_form and not dataclasses.replace(PLATE, closed_form=False).closed_form
    fast = shape_of(PLATE)
    slow = shape_of(BY_AUTOGRAD)
    x = 0.9 * directions(50, seed=5)
    for name in ("cross", "estimate", "mean_and_gradient", "mean_jet", "jet"):
        close(tensors(getattr(slow, name)(x)), tensors(getattr(fast, name)(x)), 1e-9)
    close(
        tensors(slow.differentiate(slow.metres(x))),
        tensors(fast.differentiate(fast.metres(x))),
        1e-9,
    )
    close((slow.weights, slow.factor), (fast.weights, fast.factor))
    r = x.norm(dim=1)
    close(BY_AUTOGRAD.derivatives(r, 4), PLATE.derivatives(r, 4))
    for tracked in (r.clone().requires_grad_(), r):
        assert BY_AUTOGRAD.derivatives(tracked, 4)[3].requires_grad is tracked.requires_grad


FIELDS = ("distance", "distance_noise", "normal_noise", "x", "normal")


def observed(kernel: str, rows: Tensor) -> Outputs:
    """Everything that `predict` returns, given the tensors of the observations beside each other:
    (6, 9).
    """
    tensors = dict(zip(FIELDS, [*rows[:, :3].unbind(1), rows[:, 3:6], rows[:, 6:]], strict=True))
    return predict(shape_of(kernel, dataclasses.replace(SEEN, **tensors)), POINTS)


def rows_of(seen: Observations) -> Tensor:
    return torch.cat([getattr(seen, field).reshape(6, -1) for field in FIELDS], 1)


@EVERY_KERNEL
def test_estimates_are_differentiable_in_all_tensors_of_the_observations(kernel: str):
    check(partial(observed, kernel), rows_of(SEEN), tolerance=1e-7)


def test_vmap_maps_over_all_tensors_of_the_observations_but_the_points():
    def by_values(values: Tensor) -> Outputs:
        tensors = dict(
            zip(
                ("distance", "distance_noise", "normal_noise"), values[:, :3].unbind(1), strict=True
            )
        )
        return predict(
            shape_of("matern52", dataclasses.replace(SEEN, **tensors, normal=values[:, 6:])), POINTS
        )

    rows = torch.stack([rows_of(SEEN), 1.1 * rows_of(SEEN)])
    alone = zip(*map(by_values, rows), strict=True)
    close(torch.vmap(by_values)(rows), tuple(map(torch.stack, alone)), 1e-8)
    with pytest.raises(BadArgument, match=r"observations\.x: .*vmap"):
        torch.vmap(partial(observed, "matern52"))(rows)


def test_estimates_are_differentiable_in_parameters_of_a_kernel_and_in_the_frame():
    def by_psi(psi: Tensor) -> Outputs:
        return predict(shape_of(Kernel(partial(thin_plate, psi=psi))), POINTS)

    def by_length(length: Tensor) -> Outputs:
        return predict(shape_of(Kernel(lambda r: torch.exp(-0.5 * (r / length) ** 2))), POINTS)

    for function, value in ((by_psi, 4.0), (by_length, 1.5)):
        check(function, torch.tensor(value, dtype=torch.float64), tolerance=1e-7)
    assert (
        shape_of("rbf", frame=FRAME.to(torch.float32))
        .predict(FRAME.metres(POINTS).float())
        .distance.dtype
        == torch.float32
    )
    points = FRAME.metres(POINTS)
    touch = FRAME.metres(POINTS[:1])
    still = torch.eye(4)
    check(
        lambda c: tensors(shape_of("rbf", frame=Normalisation(c, 0.05)).predict(points).distance),
        FRAME.center,
    )
    later = lambda y: shape_of("rbf", dataclasses.replace(SEEN, distance=y)).update(touch)  # noqa: E731
    check(lambda y: tensors(later(y).predict(points).distance), SEEN.distance)
    turned = lambda y: shape_of("rbf", dataclasses.replace(SEEN, distance=y)).moved(still)  # noqa: E731
    check(lambda y: tensors(turned(y).predict(points).distance), SEEN.distance)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_single_precision_and_batches_of_any_shape_give_the_gradients_of_double_precision(
    batch: tuple[int, ...],
):
    shape = shape_of("thin_plate")
    x = 0.8 * directions(6, seed=4)
    points = shape.metres(x[: max(torch.Size(batch).numel(), 1)].reshape(*batch, 3)).float()
    for name in ("distance", "normal", "variance", "covariance", "std_m"):
        slope = torch.func.grad(lambda p, name=name: (getattr(shape.predict(p), name) ** 3).sum())
        single = slope(points)
        double = slope(points.double())
        assert single.dtype == torch.float32 and single.shape == (*batch, 3)
        torch.testing.assert_close(
            single.double(), double, rtol=1e-4, atol=1e-4 * float(double.abs().max())
        )
    slopes = torch.func.jacrev(lambda p: shape.predict(p).normal.reshape(-1, 3).sum(0))(
        points.double()
    )
    torch.testing.assert_close(shape.differentiate(points.double()).normal, slopes.movedim(0, -2))


@pytest.fixture(scope="module")
def vessel() -> HollowShape:
    vessel = fit_shape(cup_view(0.003), table=0.0)
    assert isinstance(vessel, HollowShape)
    return vessel


def test_a_vessel_is_differentiable_on_both_walls(vessel: HollowShape):
    x = vessel.normalise(vessel.cloud.points.double()[::600][:2] + 0.002)
    assert len(x) == 2
    slow = torch.func.jacrev(partial(predict, vessel))(x)
    step = 1e-6
    e = directions(2, seed=9)
    up = predict(vessel, x + step * e)
    down = predict(vessel, x - step * e)
    for jacobian, a, b in zip(slow, up, down, strict=True):
        wanted = (a - b) / (2 * step)
        near((jacobian * e).sum((-1, -2)), wanted, 1e-4 * float(1 + wanted.abs().max()))
    close(slow, torch.func.jacfwd(partial(predict, vessel))(x), 1e-7)
    close(
        torch.vmap(partial(predict, vessel))(x[:, None]),
        tuple(y[:, None] for y in predict(vessel, x)),
        1e-7,
    )
    for name in ("mean_and_gradient", "mean_jet", "jet", "joint_at"):
        close(
            tensors(getattr(vessel, name)(x.clone().requires_grad_())),
            tensors(getattr(vessel, name)(x)),
            1e-6,
        )


@pytest.mark.parametrize("kernel", ["thin_plate", "rbf"])
def test_estimates_beside_the_domain_have_derivatives_too(kernel: str):
    shape = shape_of(kernel)
    radius = torch.tensor([[0.0], [0.8], [1.2], [1.9]]).double() * shape.domain_radius
    check(partial(predict, shape), radius * directions(4, seed=5))


def test_further_normals_of_another_length_are_refused_as_the_first_ones_are():
    """A normal is a slope of the distance: twice the length would stretch the shape."""
    shape = shape_of("rbf")
    for factor in (0.1, 3.0):
        wrong = dataclasses.replace(SEEN, normal=factor * SEEN.normal)
        with pytest.raises(BadArgument, match=r"observations\.normal: expected unit vectors"):
            shape_of("rbf", wrong)
        with pytest.raises(BadArgument, match=r"new\.normal: expected unit vectors"):
            shape.append(wrong)


def test_negative_noise_and_a_kernel_that_ties_no_points_are_refused():
    """The square hides a sign; a length in metres leaves the surface unknown between points."""
    for field in ("distance_noise", "normal_noise"):
        wrong = dataclasses.replace(SEEN, **{field: -getattr(SEEN, field)})
        with pytest.raises(BadArgument, match=rf"observations\.{field}: expected at least 0"):
            shape_of("rbf", wrong)
    cloud = PointCloud(0.05 * SEEN.x)
    for short in (rbf_kernel(0.03), matern52_kernel(0.02)):
        with pytest.raises(BadArgument, match=r"kernel: expected a longer one.*normalised"):
            condition(SEEN, FRAME, cloud, kernel=short)
    assert condition(SEEN, FRAME, cloud, kernel=rbf_kernel(1.0)).kind == "guess"


def test_what_is_not_differentiable_refuses_by_name():
    shape = shape_of("rbf")
    y = SEEN.distance.clone().requires_grad_()
    tracked = shape_of("rbf", dataclasses.replace(SEEN, distance=y))
    for function in (extract_surface, surface_field):
        with pytest.raises(BadArgument, match=r"shape\.weights: .* gradient"):
            function(tracked)
    points = shape.metres(POINTS)
    with pytest.raises(BadArgument, match=r"points: .* gradient"):
        shape.update(points.clone().requires_grad_())
    with pytest.raises(BadArgument, match=r"new\.distance: .* gradient"):
        shape.append(dataclasses.replace(SEEN, distance=y))
    length = torch.tensor(1.0, requires_grad=True)
    with pytest.raises(BadArgument, match=r"kernel: .* gradient"):
        fit_shape(PointCloud(SEEN.x), kernel=Kernel(lambda r: torch.exp(-r * r / length)))
    with pytest.raises(BadArgument, match=r"cloud\.points: .* gradient"):
        fit_shape(PointCloud(SEEN.x.clone().requires_grad_()))
    with pytest.raises(BadArgument, match="outside the domain"):
        torch.func.grad(lambda p: shape.predict(p).distance.sum())(points + 1.0)
    with pytest.raises(BadArgument, match="finite"):
        shape_of("rbf", dataclasses.replace(SEEN, distance=torch.nan * SEEN.distance))


def test_values_cached_without_a_graph_do_not_stop_later_gradients():
    y = SEEN.distance_noise.clone().requires_grad_()
    shape = shape_of("matern52", dataclasses.replace(SEEN, distance_noise=y))
    with torch.no_grad():
        assert not shape.predict(shape.metres(POINTS)).variance.requires_grad
        shape.jet(POINTS)
    for variance in (shape.jet(POINTS).variance, predict(shape, POINTS)[2]):
        (slope,) = torch.autograd.grad(variance.sum(), y, retain_graph=True)
        assert bool((slope > 0).any())
