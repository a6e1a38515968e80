"""Bodies of revolution whose axis is known in closed form, turned at random; and bodies that have
none.
"""

import math

import pytest
import torch
from torch import Tensor

from tests.make import near, random_motion, real
from torchgrasp import PointCloud, fit_shape
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.plane import move
from torchgrasp.shape.completion.axis import find_axis
from torchgrasp.shape.completion.complete import complete_cloud
from torchgrasp.shape.completion.symmetry import SymmetryScorer

CAMERA = real([0.4, 0.1, 0.25])
Z = real([0.0, 0.0, 1.0])


def _seen(points: Tensor, normals: Tensor, camera: Tensor = CAMERA) -> PointCloud:
    """What a camera sees of a nearly convex surface, 1000 points at most, with noise of 3 degrees
    and 0.4 mm.
    """
    facing = torch.nn.functional.normalize(camera - points, dim=1)
    rows = torch.nonzero((facing * normals).sum(1) > 0.15)[:, 0][:1000]
    noise = torch.randn(
        2, len(rows), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5)
    )
    normals = torch.nn.functional.normalize(normals[rows] + 0.05 * noise[0], dim=1)
    return PointCloud(points[rows] + 0.0004 * noise[1], normals, camera)


def _turned_profile(radius: float, slope: float, bend: float, height: float = 0.1) -> PointCloud:
    """A side of radius r + slope z + bend sin(2 pi z / h), with a flat top."""
    draws = torch.rand(6000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    angle = 2 * math.pi * draws[:4500, 0]
    z = height * draws[:4500, 1]
    wave = 2 * math.pi / height
    r = radius + slope * z + bend * torch.sin(wave * z)
    out = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    rise = slope + bend * wave * torch.cos(wave * z)
    side_normals = torch.nn.functional.normalize(out - rise[:, None] * Z, dim=1)
    turn = 2 * math.pi * draws[4500:, 0]
    share = draws[4500:, 1].sqrt() * (radius + slope * height)
    top = torch.stack([share * turn.cos(), share * turn.sin(), torch.full_like(turn, height)], 1)
    points = torch.cat([r[:, None] * out + z[:, None] * Z, top])
    normals = torch.cat([side_normals, Z.expand(1500, 3)])
    mixed = torch.randperm(6000, generator=torch.Generator().manual_seed(6))
    return _seen(points[mixed], normals[mixed])


BODIES = {
    "can": _turned_profile(0.03, 0.0, 0.0),
    "cone": _turned_profile(0.04, -0.25, 0.0),
    "vase": _turned_profile(0.03, 0.0, 0.006),
}


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("body", BODIES)
def test_axis_of_a_turned_body_is_found(body: str, seed: int):
    motion = random_motion(seed)
    found = find_axis(SymmetryScorer.of(move(BODIES[body], motion), None))
    assert found is not None
    axis_from_object = found[0] @ motion
    tilt = torch.rad2deg(torch.arccos(axis_from_object[2, 2].abs().clamp_max(1)))
    assert tilt < 2.0
    assert torch.linalg.vector_norm(apply(axis_from_object, 0.05 * Z[None])[0, :2]) < 0.001
    assert found[1].body.double().mean() > 0.9


def test_a_handle_is_no_part_of_the_body_and_half_a_cylinder_on_a_table_is_none():
    can = BODIES["can"]
    generator = torch.Generator().manual_seed(7)
    draws = torch.rand(150, 2, dtype=torch.float64, generator=generator)
    angle = math.pi * (draws[:, 0] - 0.5)
    normals = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    rod = 0.006 * normals + real([0.0, 0.055, 0.02]) + 0.06 * draws[:, 1:] * Z
    assert can.normals is not None
    jug = PointCloud(torch.cat([can.points, rod]), torch.cat([can.normals, normals]), CAMERA)
    found = find_axis(SymmetryScorer.of(move(jug, random_motion(3)), None))
    assert found is not None
    assert (
        found[1].body[: len(can)].double().mean() > 0.9
        and found[1].body[len(can) :].double().mean() < 0.1
    )
    draws = torch.rand(4000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(10))
    angle = math.pi * draws[:, 0]
    along = 0.12 * (draws[:, 1] - 0.5)
    normals = torch.stack([angle.cos(), 0 * angle, angle.sin()], 1)
    points = 0.04 * normals + torch.stack([0 * angle, along, 0 * angle], 1)
    loaf = _seen(points, normals, camera=real([0.02, 0.0, 0.6]))
    assert find_axis(SymmetryScorer.of(loaf, -0.04)) is not None
    assert find_axis(SymmetryScorer.of(loaf, 0.0)) is None


def _seen_box(half: tuple[float, float, float]) -> PointCloud:
    draws = (
        torch.rand(12000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(8)) * 2
        - 1
    )
    size = real(half)
    axis = torch.arange(12000) % 3
    normals = torch.zeros(12000, 3, dtype=torch.float64)
    normals[torch.arange(12000), axis] = torch.where(
        torch.arange(12000) % 2 == 0, 1.0, -1.0
    ).double()
    points = torch.where(normals != 0, normals, draws) * size
    return _seen(points + half[2] * Z, normals)


def _seen_half_torus() -> PointCloud:
    """Half of a ring of 12 mm thickness about an axis through its empty middle, as a bent pipe."""
    draws = torch.rand(12000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    around = math.pi * draws[:, 0]
    across = 2 * math.pi * draws[:, 1]
    ring = torch.stack([0 * around, around.cos(), around.sin()], 1)
    normals = (
        across.cos()[:, None] * ring
        + across.sin()[:, None] * torch.tensor([1.0, 0.0, 0.0]).double()
    )
    return _seen(0.05 * ring + 0.012 * normals, normals)


@pytest.mark.parametrize("half", [(0.03, 0.03, 0.03), (0.02, 0.04, 0.06), (0.01, 0.05, 0.02), None])
def test_boxes_and_a_bent_pipe_have_no_axis(half: tuple[float, float, float] | None):
    cloud = _seen_half_torus() if half is None else _seen_box(half)
    assert find_axis(SymmetryScorer.of(move(cloud, random_motion(4)), None)) is None


@pytest.mark.parametrize("body", BODIES)
def test_hidden_side_lies_on_the_body_without_a_table(body: str):
    motion = random_motion(5)
    found = complete_cloud(move(BODIES[body], motion))
    assert found.kind == "revolution"
    local = (found.points - motion[:3, 3]) @ motion[:3, :3]
    side = (local[:, 2] > 0.01) & (local[:, 2] < 0.09)
    z = local[side, 2]
    radius = torch.linalg.vector_norm(local[side, :2], dim=1)
    bend = 0.006 * torch.sin(2 * math.pi * z / 0.1) if body == "vase" else 0.0
    truth = 0.04 - 0.25 * z if body == "cone" else 0.03 + bend
    away = local[side] @ CAMERA < 0
    assert int(away.sum()) >= 5
    assert (radius - truth).abs().median() < 0.0025


def test_fit_without_a_table_moves_with_the_cloud():
    motion = random_motion(6)
    can = BODIES["can"]
    still = fit_shape(can)
    moved = fit_shape(move(can, motion))
    assert still.kind == moved.kind == "revolution"
    probes = 0.03 * torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=1
    )
    probes = probes.double() + 0.05 * Z
    a = still.predict(probes)
    b = moved.predict(apply(motion, probes))
    near(b.distance, a.distance, 1e-4)
    torch.testing.assert_close(b.std_m, a.std_m, atol=1e-5, rtol=1e-2)
