"""The measure of walls against cups, whose walls are known."""

import pytest
import torch
from benchmarks.shape.walls import estimated_thickness, measure_walls, true_wall

from tests.make import CUP_RADIUS as RADIUS
from tests.make import cup, cup_view
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values import PointCloud


@pytest.mark.parametrize("wall", [0.002, 0.005])
def test_true_walls_are_as_thick_as_the_cup_is_made(wall: float):
    points, normals, thickness = true_wall(cup(wall), 300, seed=0)
    assert len(points) > 150
    torch.testing.assert_close(thickness, torch.full_like(thickness, wall), rtol=0.02, atol=0)
    radius = torch.linalg.vector_norm(points[:, :2], dim=1)
    outside = (points[:, :2] * normals[:, :2]).sum(1) > 0
    assert torch.equal(outside, radius > RADIUS - wall / 2)


def test_a_ball_is_thick_and_empty_space_has_no_wall():
    """Along a radius 5 mm below the surface, 5 mm are material outward and all 15 mm inward."""
    out = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    ball = fit_shape(PointCloud(0.04 * out, out))
    found = estimated_thickness(ball, 0.035 * out[:50], out[:50])
    torch.testing.assert_close(found, torch.full_like(found, 0.020), rtol=0, atol=0.001)
    assert (estimated_thickness(ball, 0.056 * out[:50], out[:50]) == 0).all()


def test_two_walls_are_measured_and_below_a_seen_rim():
    cloud = cup_view(0.003)
    row = measure_walls(fit_shape(cloud, table=0.0), cup(0.003), cloud)
    assert abs(row["wall_mm"] - 3.0) < 0.1 and row["wall_off_mm"] < 1.5
    assert row["wall_holes"] < 0.03 and row["wall_within_2"] > 0.85
    assert 0.5 < row["wall_rim_seen"] <= 1
