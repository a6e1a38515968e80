"""The measure of walls against cups, whose walls are known."""

import pytest
import torch
from benchmarks.shape.walls import estimated_thickness, measure_walls, true_wall

from tests.cups import HEIGHT, RADIUS, cup, cup_view, ring
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.hollow import HollowShape


@pytest.mark.parametrize("wall", [0.002, 0.005])
def test_true_walls_are_as_thick_as_the_cup_is_made(wall: float):
    points, normals, thickness = true_wall(cup(wall), 300, seed=0)
    assert len(points) > 150
    torch.testing.assert_close(thickness, torch.full_like(thickness, wall), rtol=0.02, atol=0)
    radius = torch.linalg.vector_norm(points[:, :2], dim=1)
    outside = (points[:, :2] * normals[:, :2]).sum(1) > 0
    assert torch.equal(outside, radius > RADIUS - wall / 2)


def test_a_filled_cup_has_no_thin_wall_and_empty_space_has_none():
    middle, out = ring(RADIUS - 0.001, 0.02, HEIGHT - 0.02)
    solid = fit_shape(cup_view(0.002))
    assert not isinstance(solid, HollowShape)
    assert estimated_thickness(solid, middle, out).median() > 0.008
    assert (estimated_thickness(solid, 2 * middle, out) == 0).all()


def test_two_walls_are_measured_and_below_a_seen_rim():
    cloud = cup_view(0.003)
    row = measure_walls(fit_shape(cloud, table=0.0), cup(0.003), cloud)
    assert abs(row["wall_mm"] - 3.0) < 0.1 and row["wall_off_mm"] < 1.5
    assert row["wall_holes"] < 0.03 and row["wall_within_2"] > 0.85
    assert 0.5 < row["wall_rim_seen"] <= 1
