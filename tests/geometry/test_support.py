import math

import pytest
import torch
import trimesh

from tests.make import box, real
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.support_search import find_supports
from torchgrasp.scene.image import read_image

POSE = look_at(30.0, 40.0, 0.6)
UP = real([0.0, 0.0, 1.0])


THINGS = [
    box([0.1, 0.06, 0.12], [0.05, 0.05, 0.06]),
    trimesh.creation.icosphere(radius=0.04).apply_translation([-0.08, 0.0, 0.04]),
]


def fit_support(*view):
    return find_supports(*view)[0].plane


def look(meshes, table=0.0, pose=POSE):
    depth, _ = render_depth(meshes, pose, table=table)
    kept = torch.zeros_like(depth)
    kept[::3, ::3] = depth[::3, ::3]
    image = read_image(kept, INTRINSICS, pose)
    return image.points()[kept > 0], pose[:3, 3]


@pytest.fixture(scope="module")
def seen():
    return look(THINGS)


def test_a_noisy_table_is_found_in_place_and_moves_with_the_points(seen):
    points, viewpoint = seen
    for eye in (viewpoint, None):
        plane = fit_support(points, eye)
        assert math.degrees(math.acos(min(1.0, float(plane.normal[2])))) < 0.3
        assert abs(plane.offset) < 0.001
    plane = fit_support(points, viewpoint)
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        rotation = rotation_from_vector(
            2 * torch.randn(3, generator=generator, dtype=torch.float64)
        )
        motion = rigid(rotation, torch.randn(3, generator=generator, dtype=torch.float64))
        moved = fit_support(apply(motion, points), apply(motion, viewpoint[None])[0])
        expected = plane.moved(motion)
        assert (moved.normal - expected.normal).abs().max() < 1e-9
        assert abs(moved.offset - expected.offset) < 1e-9


def test_gravity_is_used_and_must_agree_and_bad_arguments_are_named(seen):
    assert fit_support(*seen, torch.tensor([0.0, 0.3, 2.0]).double()).normal[2] > 0.999
    with pytest.raises(NoSupport):
        fit_support(*seen, torch.tensor([1.0, 0.0, 0.0]).double())
    with pytest.raises(NoSupport, match="from above"):
        fit_support(*seen, -UP)
    with pytest.raises(BadArgument, match="points"):
        fit_support(seen[0] * torch.nan)
    with pytest.raises(BadArgument, match="viewpoint"):
        fit_support(seen[0], torch.full((3,), torch.inf))
    with pytest.raises(NoSupport, match="7 points"):
        fit_support(seen[0][:7])


def test_a_plane_through_which_things_are_seen_is_no_table_and_floating_ones_have_none():
    frame = [box([0.15, 0.6, 0.01], [x, 0.0, -0.005]) for x in (-0.225, 0.225)]
    frame += [box([0.6, 0.15, 0.01], [0.0, y, -0.005]) for y in (-0.225, 0.225)]
    below = box([0.4, 0.4, 0.1], [0.0, 0.0, -0.2])
    cup = box([0.05, 0.05, 0.05], [0.2, 0.0, 0.025])
    with pytest.raises(NoSupport):
        fit_support(*look([*frame, below, cup], table=None))
    with pytest.raises(NoSupport):
        fit_support(*look(THINGS, table=None))


@pytest.mark.parametrize("size", [[0.2, 0.15, 0.1], [0.16, 0.08, 0.008], [0.3, 0.3, 0.02]])
def test_a_flat_face_of_a_lone_thing_is_no_table(size):
    with pytest.raises(NoSupport):
        fit_support(*look([trimesh.creation.box(size)], table=None))


def test_a_table_before_a_wall_or_above_a_deep_floor_needs_no_gravity():
    seen = look([*THINGS, box([0.01, 2.0, 2.0], [-0.35, 0.0, 0.5])], pose=look_at(0.0, 35.0, 0.7))
    for up in (UP, None):
        assert fit_support(*seen, up).normal[2] > 0.9999
    floor = box([3.0, 3.0, 0.01], [0.0, 0.0, -0.7])
    assert abs(fit_support(*look([*THINGS, floor], pose=look_at(0.0, 35.0, 0.9))).offset) < 0.002


def test_the_table_comes_before_the_floor_that_carries_more_and_a_bins_floor_supports():
    top = box([0.5, 0.4, 0.02], [0.0, 0.0, -0.01])
    floor = box([4.0, 4.0, 0.01], [0.0, 0.0, -0.455])
    boxes = [box([0.2, 0.2, 0.2], [x, y, -0.35]) for x in (0.5, -0.6) for y in (-0.5, 0.5)]
    cup = box([0.06, 0.06, 0.08], [0.0, 0.0, 0.04])
    pose = look_at(0.0, 35.0, 1.0)
    first, second = find_supports(*look([top, floor, *boxes, cup], table=None, pose=pose))[:2]
    assert abs(first.plane.offset) < 0.003 and abs(second.plane.offset + 0.45) < 0.01
    assert bool(first.covers(torch.tensor([0.2, 0.1, 0.3]))) and not bool(
        first.covers(torch.tensor([0.3, 0.1, 0.3]))
    )
    walls = [box([0.02, 0.5, 0.25], [x, 0.0, 0.125]) for x in (-0.2, 0.2)]
    walls += [box([0.4, 0.02, 0.25], [0.0, y, 0.125]) for y in (-0.25, 0.25)]
    toy = box([0.05, 0.08, 0.04], [0.03, 0.05, 0.02])
    plane = fit_support(*look([*walls, toy], pose=look_at(20.0, 80.0, 0.7)))
    assert plane.normal[2] > 0.999 and abs(plane.offset) < 0.002


def test_a_plane_that_objects_go_through_is_no_support():
    pose = look_at(20.0, 40.0, 0.8)
    blocks = [box((0.16, 0.2, 0.1), (0.0, y)) for y in (-0.14, 0.14)]
    tall = box((0.05, 0.05, 0.16))  # between the blocks, higher than their tops
    with pytest.raises(NoSupport):
        find_supports(*look([*blocks, tall], None, pose))
    for meshes, table, height in (
        ([*blocks, tall], 0.0, 0.0),
        ([*blocks, box((0.05, 0.05, 0.06), (0, 0.14, 0.13))], None, 0.1),
    ):
        plane = fit_support(*look(meshes, table, pose))
        assert abs(plane.offset - height) < 0.003 and float(plane.normal[2]) > 0.999


@pytest.mark.parametrize("azimuth", [0.0, 180.0])
def test_slats_support_though_thin_things_hang_between_them(azimuth):
    bars = [box([0.6, 0.03, 0.02], [0.0, 0.05 * k, -0.01]) for k in range(-5, 6)]
    pens = [
        trimesh.creation.cylinder(0.008, 0.12).apply_translation([x, y, 0.01])
        for x, y in ((0.12, -0.025), (-0.15, 0.075))
    ]
    balls = [
        trimesh.creation.icosphere(radius=0.03).apply_translation([x, y, 0.027])
        for x, y in ((0.1, 0.025), (-0.1, -0.075))
    ]
    can = trimesh.creation.cylinder(0.03, 0.1).apply_translation([0.0, 0.05, 0.05])
    floor = box([2.0, 2.0, 0.02], [0.0, 0.0, -0.36])
    pose = look_at(azimuth, 45.0, 0.8)
    plane = fit_support(*look([*bars, *pens, *balls, can, floor], None, pose))
    assert plane.normal[2] > 0.999 and abs(plane.offset) < 0.003


def test_of_a_floor_and_a_wall_that_are_alike_the_cameras_upward_side_tells_which_is_level():
    """The corner is its own mirror image, by which floor and wall change places."""
    corner = [box([0.8, 0.8, 0.02], [0.4, 0.0, -0.01]), box([0.02, 0.8, 0.8], [-0.01, 0.0, 0.4])]
    things = [
        box([0.06, 0.06, 0.05], [0.3, 0.12, 0.025]),
        box([0.05, 0.06, 0.06], [0.025, -0.12, 0.3]),
    ]
    pose = look_at(0.0, 45.0, 1.0)
    points, eye = look([*corner, *things], None, pose)
    assert len(find_supports(points, eye)) == 2
    image_up = -pose[:3, 1]
    for sign, normal in ((1.0, UP), (-1.0, real([1.0, 0.0, 0.0]))):
        support = find_supports(points, eye, image_up=sign * image_up)[0]
        assert float(support.plane.normal @ normal) > 0.999
    # a wall that is smaller than the floor is none
    lower = [corner[0], box([0.02, 0.8, 0.4], [-0.01, 0.0, 0.2])]
    found = find_supports(*look([*lower, *things], None, pose), image_up=image_up)
    assert len(found) == 1 and float(found[0].plane.normal @ UP) > 0.999


@pytest.mark.parametrize("radius", [0.14, 0.16])
def test_a_small_bowed_table_above_a_floor_supports(radius):
    """Its top is a cap of a ball, 20 mm high; a plane through it is within that."""
    sag = 0.02
    ball = (radius**2 + sag**2) / (2 * sag)
    top = trimesh.creation.icosphere(subdivisions=6, radius=ball).apply_translation([0, 0, -ball])
    top = trimesh.intersections.slice_mesh_plane(top, [0, 0, 1], [0, 0, -sag])
    things = [
        box([0.04, 0.04, 0.06], [0.03, 0.02, 0.028]),
        trimesh.creation.cylinder(0.02, 0.08).apply_translation([-0.04, -0.03, 0.038]),
    ]
    floor = box([2.0, 2.0, 0.02], [0.0, 0.0, -0.36])
    first = find_supports(*look([top, *things, floor], None, look_at(20.0, 50.0, 0.7)))[0]
    assert first.local and -sag < first.plane.offset < 0.0 and first.plane.normal[2] > 0.99
