"""Open vessels are found by their two walls; what is closed, flat or looped is none."""

import pytest
import torch
import trimesh

from tests.make import CUP_HEIGHT as HEIGHT
from tests.make import CUP_RADIUS as RADIUS
from tests.make import cup, cup_view, near, real
from torchgrasp import PointCloud
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.prepare import prepare_cloud
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.shape.completion.vessel import Vessel, complete_walls, find_vessel


def _prepared(cloud: PointCloud) -> PointCloud:
    seen = prepare_cloud(cloud, torch.Generator().manual_seed(0))
    return PointCloud(seen.points, seen.normals, seen.viewpoint)


def _find(cloud: PointCloud) -> Vessel | None:
    seen = _prepared(cloud)
    assert seen.normals is not None
    return find_vessel(seen.points, seen.normals)


@pytest.mark.parametrize("wall", [0.002, 0.005])
@pytest.mark.parametrize("elevation", [20.0, 50.0])
def test_axis_wall_and_rim_of_a_noisy_cup(wall: float, elevation: float):
    found = _find(cup_view(wall, elevation))
    assert found is not None
    assert abs(found.thickness - wall) < 0.0025  # twice its standard deviation
    assert torch.linalg.vector_norm(found.center) < 0.002
    assert abs(found.rim - HEIGHT) < 0.002 and abs(found.radius - RADIUS) < 0.002


def test_inner_points_are_those_within_the_cup_and_a_frame_does_not_matter():
    seen = _prepared(cup_view(0.003))
    assert seen.normals is not None
    shift = real([0.3, -0.2, 0.4])
    one = find_vessel(seen.points, seen.normals)
    two = find_vessel(seen.points + shift, seen.normals)
    assert one is not None and two is not None and torch.equal(one.inner, two.inner)
    near(two.center, one.center + shift[:2], 1e-9)
    radius = torch.linalg.vector_norm(seen.points[:, :2], dim=1)
    below = seen.points[:, 2] < HEIGHT - 0.006
    assert bool(((radius < RADIUS - 0.0015) == one.inner)[below].double().mean() > 0.97)


def test_closed_bodies_are_no_vessels(seen_cylinder: PointCloud):
    assert _find(seen_cylinder) is None
    generator = torch.Generator().manual_seed(2)
    points = torch.rand(600, 3, dtype=torch.float64, generator=generator)
    points[:300, 0] = 1.0
    points[300:, 1] = 1.0
    normals = torch.zeros_like(points)
    normals[:300, 0] = 1.0
    normals[300:, 1] = 1.0
    assert find_vessel(0.08 * points, normals) is None


def test_a_lids_recess_is_no_cavity():
    """A can whose lid lies 4 mm below its rim."""
    plug = trimesh.creation.cylinder(RADIUS - 0.002, HEIGHT - 0.004)
    can = cup(0.002) + plug.apply_translation([0, 0, (HEIGHT - 0.004) / 2])
    assert _find(partial_view(can, look_at(20.0, 40.0, target=can), n=1000)) is None


def test_hidden_walls_lie_on_the_cup_and_where_nothing_was_seen():
    seen = _prepared(cup_view(0.003, noise=False))
    assert seen.normals is not None
    vessel = find_vessel(seen.points, seen.normals)
    assert vessel is not None
    outer, inner = complete_walls(seen, vessel, silhouettes(seen), table=0.0)
    for wall, radius, sign in ((outer, RADIUS, 1.0), (inner, RADIUS - 0.003, -1.0)):
        points = wall.hidden.points
        normals = wall.hidden.normals
        side = normals[:, 2].abs() < 0.3
        level = torch.linalg.vector_norm(points[side, :2], dim=1)
        assert (level - radius).abs().median() < 0.0008 and (level - radius).abs().max() < 0.003
        assert (sign * (points[side, :2] * normals[side, :2]).sum(1) > 0).all()
        assert torch.cdist(points, seen.points[wall.seen]).min() > 0.005
        assert int(side.sum()) > 15
    assert (torch.linalg.vector_norm(outer.hidden.shared, dim=1) > 0).all()
