"""Bodies of revolution: the axis is found beside a handle, and a handle is not mirrored to where
the body hides it.
"""

import math
import statistics

import pytest
import torch
from torch import Tensor

from tests.make import real
from torchgrasp import PointCloud
from torchgrasp.shape.completion.axis import ROUND, _typical_radius, find_revolution
from torchgrasp.shape.completion.complete import complete_cloud

CAMERA = real([0.45, 0.0, 0.3])
ARM = 0.05


def _rod(azimuth: float) -> tuple[Tensor, Tensor]:
    """Points and normals of an upright rod of 6 mm radius beside a body at the origin, seen from
    +x.
    """
    generator = torch.Generator().manual_seed(1)
    draws = torch.rand(250, 2, dtype=torch.float64, generator=generator)
    angle = math.pi * (draws[:, 0] - 0.5)
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    center = real([ARM * math.cos(azimuth), ARM * math.sin(azimuth), 0.03])
    return center + 0.006 * normals + torch.stack(
        [0 * angle, 0 * angle, 0.06 * draws[:, 1]], 1
    ), normals


def _jug(cylinder: PointCloud, azimuth: float) -> PointCloud:
    """A cylinder with a rod as its handle."""
    points, normals = _rod(azimuth)
    assert cylinder.normals is not None
    return PointCloud(
        torch.cat([cylinder.points, points]), torch.cat([cylinder.normals, normals]), CAMERA
    )


@pytest.mark.parametrize("shift", [0.0, 0.7])
def test_axis_is_found_beside_a_handle_and_through_noise(seen_cylinder: PointCloud, shift: float):
    jug = _jug(seen_cylinder, 1.5)
    assert jug.normals is not None
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(2, len(jug), 3, dtype=torch.float64, generator=generator)
    move = real([shift, -2 * shift, 0.0])
    normals = torch.nn.functional.normalize(jug.normals + 0.05 * noise[0], dim=1)
    found = find_revolution(jug.points + 0.0005 * noise[1] + move, normals)
    assert found is not None
    assert torch.linalg.vector_norm(found.center - move[:2]) < 0.001
    handle = torch.arange(len(jug)) >= len(seen_cylinder)
    assert found.body[~handle].double().mean() > 0.95 and found.body[handle].double().mean() < 0.1


def test_boxes_and_walls_are_no_bodies_of_revolution():
    generator = torch.Generator().manual_seed(2)
    face = torch.rand(400, 3, dtype=torch.float64, generator=generator) - 0.5
    front = face.clone()
    side = face.clone()
    front[:, 0] = 0.5
    side[:, 1] = 0.5
    x, y, _ = torch.eye(3, dtype=torch.float64)
    assert find_revolution(0.08 * front, x.expand(400, 3)) is None
    both = torch.cat([x.expand(400, 3), y.expand(400, 3)])
    assert find_revolution(0.08 * torch.cat([front, side]), both) is None
    assert (
        find_revolution(0.08 * face, torch.tensor([0.0, 0.0, 1.0]).double().expand(400, 3)) is None
    )


def test_the_typical_radius_is_the_median_near_a_height():
    """Also where no normal near a height meets the axis, or none at all."""
    generator = torch.Generator().manual_seed(4)
    height, radius = 0.1 * torch.rand(2, 200, dtype=torch.float64, generator=generator)
    radius = (radius * 200).round() / 200  # some are equal
    none = torch.zeros(200, dtype=torch.bool)
    for meets in (height < 0.06, none):
        typical = _typical_radius(height, radius, meets).tolist()
        for own, found in zip(height, typical, strict=True):
            near = meets & ((height - own).abs() < ROUND.near)
            wanted = statistics.median_low(radius[near].tolist()) if near.any() else math.nan
            assert found == pytest.approx(wanted, rel=0, abs=0, nan_ok=True)


@pytest.mark.parametrize("azimuth", [1.1, 1.5, -1.9])
def test_a_handle_is_not_mirrored_to_where_the_body_hides_it(
    seen_cylinder: PointCloud, azimuth: float
):
    """Any plane through the axis explains the body; mirrored across most of them the handle lies
    hidden behind it.
    """
    jug = _jug(seen_cylinder, azimuth)
    found = complete_cloud(jug, table=0.0)
    level = found.points[found.points[:, 2] < 0.11, :2]
    center = ARM * real([math.cos(azimuth), math.sin(azimuth)])
    beside = torch.linalg.vector_norm(level - center, dim=1) < 0.02
    off = (torch.linalg.vector_norm(level, dim=1) - 0.03).abs()
    assert (off[~beside] < 0.004).all()
    assert (level[:, 0] < 0).double().mean() > 0.5 and (~beside).sum() > 20
