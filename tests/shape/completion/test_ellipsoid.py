"""Balls and fruit: the hidden side of an ellipsoid is found, and other bodies are none."""

import pytest
import torch
from torch import Tensor

from tests.make import real
from torchgrasp import PointCloud, fit_shape
from torchgrasp.geometry.linalg import fibonacci_sphere, unit
from torchgrasp.shape.completion.complete import complete_cloud
from torchgrasp.shape.completion.ellipsoid import Ellipsoid, find_ellipsoid
from torchgrasp.shape.completion.silhouette import silhouettes

CAMERA = real([0.35, 0.2, 0.4])


def _fruit(axes: tuple[float, float, float], noise: float = 0.0005) -> PointCloud:
    """The seen side of an ellipsoid that lies on z = 0."""
    axis = real(axes)
    center = real([0.01, -0.02, axes[2]])
    direction = fibonacci_sphere(3000)
    points = center + axis * direction
    normals = unit(direction / axis)
    generator = torch.Generator().manual_seed(5)
    seen = ((CAMERA - points) * normals).sum(1) > 0.15 * torch.linalg.vector_norm(
        CAMERA - points, dim=1
    )
    points = points + noise * torch.randn(points.shape, dtype=torch.float64, generator=generator)
    return PointCloud(points[seen], normals[seen], CAMERA)


def _find(cloud: PointCloud, table: float | None) -> Ellipsoid | None:
    assert cloud.normals is not None
    return find_ellipsoid(cloud.points, cloud.normals, silhouettes(cloud), table)


def _off(points: Tensor, axes: tuple[float, float, float]) -> Tensor:
    """Distance [m] from the true ellipsoid, to first order."""
    axis = real(axes)
    local = (points - real([0.01, -0.02, axes[2]])) / axis
    length = torch.linalg.vector_norm(local, dim=1)
    return (length - 1) * length / torch.linalg.vector_norm(local / axis, dim=1)


@pytest.mark.parametrize("table", [0.0, None])
@pytest.mark.parametrize("axes", [(0.03, 0.03, 0.03), (0.035, 0.03, 0.03), (0.025, 0.025, 0.023)])
def test_the_whole_ellipsoid_is_found_and_its_error_is_foreseen(
    axes: tuple[float, float, float], table: float | None
):
    found = _find(_fruit(axes), table)
    assert found is not None and found.misfit < 0.001
    off = _off(found.points, axes).abs()
    deviation = torch.linalg.vector_norm(found.deviations, dim=1)
    assert off.median() < 0.002 and deviation.max() < 0.006
    assert (off < 2 * deviation + 0.0005).double().mean() > 0.9


def test_the_hidden_side_is_completed_by_it_alone():
    found = complete_cloud(_fruit((0.03, 0.03, 0.03)), table=0.0)
    assert len(found.planes) == len(found.scores) == 0 and len(found.points) == 50
    assert _off(found.points, (0.03, 0.03, 0.03)).abs().max() < 0.002
    assert found.points[:, 2].min() < 0.005  # below, too, where no vertical plane mirrors to


@pytest.mark.parametrize("table", [0.0, None])
def test_a_shape_closes_where_the_ball_does(table: float | None):
    """Nearest distances to sparse points, taken for exact, would draw the surface inward."""
    radius = 0.03
    cloud = _fruit((radius,) * 3)
    shape = fit_shape(PointCloud(cloud.points, viewpoint=CAMERA), table=table)
    direction = fibonacci_sphere(400)
    hidden = direction @ unit(CAMERA) < -0.2
    points = real([0.01, -0.02, radius]) + radius * direction[hidden]
    error = shape.scale * shape.predict(points).distance
    assert error.abs().median() < 0.0015 and error.median().abs() < 0.0015


def test_cylinders_bowls_and_long_things_are_none(seen_cylinder: PointCloud):
    assert _find(seen_cylinder, 0.0) is None
    assert _find(_fruit((0.07, 0.03, 0.03)), 0.0) is None
    ball = _fruit((0.03, 0.03, 0.03))
    assert ball.normals is not None
    assert _find(PointCloud(ball.points, -ball.normals, CAMERA), 0.0) is None


def test_the_domain_holds_the_whole_ball_and_the_band_the_error():
    cloud = _fruit((0.03, 0.03, 0.03))
    shape = fit_shape(PointCloud(cloud.points, viewpoint=CAMERA), table=0.0)
    points = real([0.01, -0.02, 0.03]) + 0.03 * fibonacci_sphere(400)
    assert bool(shape.contains(points).all())
    estimate = shape.predict(points)
    assert (shape.scale * estimate.distance.abs() < 2 * estimate.std_m).double().mean() > 0.9
