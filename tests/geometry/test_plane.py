"""Planes and upright frames: they move with what they are made of."""

import dataclasses

import pytest
import torch

from tests.make import random_motion
from torchgrasp import ContactSpec, PointCloud, fit_shape, plan_grasps
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import (
    GRID,
    Plane,
    as_plane,
    move,
    read_plane,
    round_upright,
    upright_frame,
    upright_table,
)
from torchgrasp.shape.surface import Surface

F64 = torch.float64


def random_cloud(viewpoint: bool) -> PointCloud:
    points = 0.1 * torch.rand(50, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    return PointCloud(points, None, torch.tensor([0.5, 0.2, 0.4], dtype=F64) if viewpoint else None)


@pytest.mark.parametrize("seed", range(5))
def test_heights_do_not_depend_on_the_frame_and_surfaces_move(seed):
    plane = Plane.horizontal(0.3)
    pose = random_motion(seed)
    points = random_cloud(False).points
    torch.testing.assert_close(plane.moved(pose).height(apply(pose, points)), points[:, 2] - 0.3)
    pose = random_motion(2)
    points = random_cloud(False).points
    faces = torch.arange(48).view(-1, 3)
    surface = Surface(points, faces, unit(points), points[:, 0])
    there = move(surface, pose)
    torch.testing.assert_close(there.vertices, apply(pose, points))
    torch.testing.assert_close(there.normals, surface.normals @ pose[:3, :3].T)
    assert torch.equal(there.std_m, surface.std_m) and torch.equal(there.faces, faces)


@pytest.mark.parametrize("viewpoint", [True, False])
@pytest.mark.parametrize("table", [Plane.horizontal(-0.1), None])
def test_a_moved_cloud_is_the_same_to_the_last_bit_in_its_upright_frame(viewpoint, table):
    cloud = random_cloud(viewpoint)
    frame = upright_frame(cloud.points, cloud.viewpoint, table)
    upright = round_upright(cloud, frame)
    assert float((apply(frame, upright.points) - cloud.points).norm(dim=1).max()) <= 1.5 * GRID
    for seed in range(20):
        pose = random_motion(seed)
        there = move(cloud, pose)
        other = round_upright(
            there,
            upright_frame(
                there.points, there.viewpoint, None if table is None else table.moved(pose)
            ),
        )
        assert torch.equal(other.points, upright.points)
        assert viewpoint is False or torch.equal(other.viewpoint, upright.viewpoint)


def test_an_upright_frame_stands_on_the_table_and_looks_at_the_camera_or_the_farthest_point():
    cloud = random_cloud(True)
    pose = random_motion(3)
    table = Plane.horizontal(-0.1).moved(pose)
    moved = move(cloud, pose)
    frame = upright_frame(moved.points, moved.viewpoint, table)
    assert abs(float(table.height(frame[:3, 3]))) < 1e-12
    torch.testing.assert_close(frame[:3, 2], table.normal)
    eye = apply(inverse(frame), moved.viewpoint[None])[0]
    assert abs(float(eye[1])) < 1e-12 and float(eye[0]) > 0
    points = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0.2, 0.05]], dtype=F64)
    cloud = PointCloud(points, None, points.mean(0) + torch.tensor([0.0, 0, 0.5], dtype=F64))
    x = upright_frame(cloud.points, cloud.viewpoint, Plane.horizontal(0.0))[:3, 0]
    assert float(x[2]) == 0.0 and float(x @ (points[3] - points.mean(0))) > 0.14


@pytest.mark.parametrize("table", [float("nan"), float("inf")])
def test_a_table_is_finite_and_below_the_object_and_a_normal_has_unit_length(table):
    with pytest.raises(BadArgument, match="table"):
        as_plane(table)
    with pytest.raises(BadArgument, match="table"):
        ContactSpec(table=table)
    with pytest.raises(BadArgument, match="normal"):
        Plane(torch.tensor([0.0, 0, 2.0]), 0.0)
    cloud = random_cloud(viewpoint=True)
    above = 0.2 - cloud.points[:, 2].sort().values[24]
    with pytest.raises(
        BadArgument,
        match=rf"^table: expected .*got a plane {above:.3g} m above the middle of the cloud",
    ):
        fit_shape(cloud, table=0.2)
    # a table in millimetres, and a camera of a frame whose z axis points down
    for wrong, height, told in (
        (cloud, -50.0, "below the object's top"),
        (
            dataclasses.replace(cloud, viewpoint=-5 * cloud.viewpoint),
            -0.3,
            "the camera .* below it",
        ),
    ):
        for call in (
            fit_shape,
            lambda x, table: plan_grasps(x, "barrett", ContactSpec(table=table)),
        ):
            with pytest.raises(BadArgument, match=f"^table: expected .*{told}"):
                call(wrong, table=height)
    tilted = Plane(unit(torch.tensor([0.02, 0.0, 1.0], dtype=F64)), 0.003)
    assert upright_frame(cloud.points, cloud.viewpoint, tilted).isfinite().all()


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=F64)


def ending(seed: int) -> Plane:
    """A table with an edge in a general frame."""
    table = Plane.horizontal(0.1).ending(vector(0.3, -0.2, 7.0), vector(1.0, 0.4, 0.2))
    return table.moved(random_motion(seed))


@pytest.mark.parametrize("seed", range(3))
def test_clearance_is_negative_inside_a_table_with_an_edge_and_bounds_the_distance_from_it(seed):
    """Against a dense sample of the table, a quarter of the space, which has no formula in common
    with it.
    """
    table = ending(seed)
    draw = torch.Generator().manual_seed(seed)
    assert table.edge is not None
    along = torch.linalg.cross(table.normal, table.edge.normal)
    axes = torch.stack([table.normal, table.edge.normal, along])
    corner = table.offset * table.normal + table.edge.offset * table.edge.normal
    depth = torch.linspace(0, 0.2, 41, dtype=F64)
    filled = torch.cartesian_prod(-depth, -depth, torch.linspace(-0.1, 0.1, 21, dtype=F64))
    sample = corner + filled @ axes
    local = 0.1 * (2 * torch.rand(200, 3, generator=draw, dtype=F64) - 1)
    local[:, 2] *= 0.1
    points = corner + local @ axes
    clearance = table.clearance(points)
    assert torch.equal(clearance < 0, (local[:, :2] < 0).all(1))
    nearest = torch.cdist(points, sample).amin(1)
    outside = clearance > 0
    assert bool((clearance[outside] <= nearest[outside]).all())
    straight = outside & ((local[:, :2] < 0).any(1))  # beside one of the two faces
    assert float((nearest - clearance)[straight].max()) < 0.005  # the pitch of the sample
    plain = dataclasses.replace(table, edge=None)
    assert torch.equal(plain.clearance(points), plain.height(points))


@pytest.mark.parametrize("seed", range(3))
def test_a_table_with_an_edge_moves_as_a_whole_and_its_text_is_read_back(seed):
    table = ending(seed)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    pose = random_motion(7)
    there = table.moved(pose)
    torch.testing.assert_close(there.clearance(apply(pose, points)), table.clearance(points))
    again = read_plane(table.describe())
    torch.testing.assert_close(again.clearance(points), table.clearance(points), rtol=0, atol=1e-7)
    assert again.describe() == table.describe()
    assert read_plane(Plane.horizontal(0.5).describe()).edge is None
    for wrong in ("; edge normal 1 0 0", "; edge", "; edge normal 0 0 1, offset 0"):
        with pytest.raises(BadArgument):
            read_plane(Plane.horizontal(0.1).describe() + wrong)
    with pytest.raises(BadArgument, match="table"):
        read_plane(table.describe() + "; edge normal 1 0 0, offset 0")
    for other in ("up 0 0 1, at 0.1", "normal 0 0 1, offset 0.1 m", "normal 0 0, offset 0.1", ""):
        with pytest.raises(BadArgument, match="normal X Y Z, offset D"):
            read_plane(other)


def test_an_edge_passes_through_its_point_and_is_vertical_on_the_table():
    table = Plane(unit(vector(0.1, -0.2, 1.0)), 0.3)
    point, outward = vector(0.4, 0.1, 0.9), vector(1.0, 1.0, -3.0)
    edge = table.ending(point, outward).edge
    assert edge is not None
    assert abs(float(edge.normal @ table.normal)) < 1e-12
    assert abs(float(edge.height(point))) < 1e-12
    level = outward - (outward @ table.normal) * table.normal
    torch.testing.assert_close(edge.normal, unit(level))
    for up in (table.normal, -2 * table.normal, vector(0.0, 0.0, 0.0)):
        with pytest.raises(BadArgument, match="outward"):
            table.ending(point, up)
    with pytest.raises(BadArgument, match=r"edge: .*a plane at 90 degrees.* got a plane at 45"):
        Plane(vector(0.0, 0.0, 1.0), 0.0, Plane(unit(vector(1.0, 0.0, 1.0)), 0.0))
    with pytest.raises(BadArgument, match=r"edge: .*got a plane with an edge"):
        dataclasses.replace(table, edge=table.ending(point, outward))


@pytest.mark.parametrize("seed", range(5))
def test_an_upright_table_ends_where_the_table_ends_and_is_bitwise_the_same_in_every_frame(seed):
    cloud = random_cloud(True)
    table = Plane.horizontal(-0.1).ending(vector(0.05, 0.0, 0.0), vector(1.0, 0.3, 0.0))
    first = None
    for pose in (torch.eye(4, dtype=F64), random_motion(seed)):
        here = move(cloud, pose)
        frame = upright_frame(here.points, here.viewpoint, table.moved(pose))
        found = upright_table(table.moved(pose), frame)
        assert isinstance(found, Plane) and found.edge is not None and found.offset == 0.0
        inside = apply(inverse(frame), here.points)
        room = found.clearance(inside)
        torch.testing.assert_close(room, table.clearance(cloud.points), rtol=0, atol=4 * GRID)
        first = first or found
        assert torch.equal(found.edge.normal, first.edge.normal)
        assert found.edge.offset == first.edge.offset and found.edge.normal[2] == 0
    assert upright_table(None, frame) is None
    assert upright_table(dataclasses.replace(table, edge=None), frame) == 0.0
