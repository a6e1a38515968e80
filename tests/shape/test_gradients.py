"""Every tensor function of a shape passes right gradients, or refuses points that require one by name."""

import pytest
import torch
from torch import Tensor

from tests.make import cup_view, directions, real
from torchgrasp import PointCloud
from torchgrasp.errors import BadArgument
from torchgrasp.shape import HollowShape, Kernel, Normalisation, Observations, ShapeGP, condition, fit_shape

KERNELS: dict[str, str | Kernel] = {
    "thin_plate": "thin_plate",
    "matern52": "matern52",
    "rbf": "rbf",
    "own": Kernel(lambda r: 4.0 / (1.0 + 0.3 * r * r)),
}


@pytest.fixture(scope="module", params=[*KERNELS, "vessel"])
def shape(request: pytest.FixtureRequest) -> ShapeGP:
    if request.param == "vessel":
        vessel = fit_shape(cup_view(0.003), table=0.0)
        assert isinstance(vessel, HollowShape)
        return vessel
    x, noise = directions(20), torch.full((20,), 0.02).double()
    seen = Observations(x, 0 * noise, x, noise > 0, noise, noise)
    return condition(
        seen, Normalisation(real([0.1, 0.2, 0.3]), 0.05), PointCloud(0.05 * x), kernel=KERNELS[request.param]
    )


def normalised() -> Tensor:
    return (0.8 * directions(4, seed=3)).requires_grad_()


def estimate(shape: ShapeGP, points: Tensor) -> tuple[Tensor, ...]:
    found = shape.predict(points)
    return found.distance, found.normal, found.variance, 100 * found.std_m


def test_predict_is_differentiable_by_autograd_and_torch_func(shape: ShapeGP):
    points = shape.metres(normalised().detach()).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: estimate(shape, p), points, eps=1e-7, atol=1e-3)
    assert not shape.predict(points).covariance.requires_grad
    with torch.no_grad():
        assert not shape.predict(points).distance.requires_grad
    x = normalised()
    (wanted,) = torch.autograd.grad(shape.mean(x).sum(), x)
    torch.testing.assert_close(torch.func.grad(lambda x: shape.mean(x).sum())(x.detach()), wanted)
    points = shape.metres(x.detach())
    jacobian = torch.func.jacrev(lambda p: shape.predict(p).normal)(points[0])
    torch.testing.assert_close(jacobian, shape.differentiate(points[:1]).normal[0])


def test_mean_and_gradient_are_differentiable_once(shape: ShapeGP):
    assert torch.autograd.gradcheck(shape.mean, normalised(), atol=1e-4)
    assert torch.autograd.gradcheck(shape.mean_and_gradient, normalised(), atol=1e-4)
    x = normalised()
    (slope,) = torch.autograd.grad(shape.mean(x).sum(), x, create_graph=True)
    with pytest.raises(BadArgument, match="second derivative"):
        torch.autograd.grad((slope + x**2).sum(), x)


@pytest.mark.parametrize("name", ["estimate", "jet", "mean_jet", "cross", "distance_rows", "joint_at"])
def test_functions_without_gradients_refuse_normalised_points(shape: ShapeGP, name: str):
    with pytest.raises(BadArgument, match=r"x: .* gradient"):
        getattr(shape, name)(normalised())


@pytest.mark.parametrize("name", ["differentiate", "joint"])
def test_functions_without_gradients_refuse_points_and_distances(shape: ShapeGP, name: str):
    with pytest.raises(BadArgument, match=r"points: .* gradient"):
        getattr(shape, name)(shape.metres(normalised().detach()).requires_grad_())
    with pytest.raises(BadArgument, match=r"r: .* gradient"):
        shape.kernel.derivatives(torch.ones(3, dtype=torch.float64, requires_grad=True), 2)
