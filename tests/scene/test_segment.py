import math

import pytest
import torch
import trimesh

from tests.make import HALF, box, halved
from torchgrasp import Scene
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SupportPlane
from torchgrasp.scene.creases import cut_creases
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.merge import _Body, _one_body, find_touching, merge_pieces
from torchgrasp.scene.segment import rests_on, segment
from torchgrasp.scene.table_image import TableImage

TABLE = SupportPlane(Plane.horizontal(0.0))


def cup():
    outer = trimesh.creation.annulus(0.037, 0.04, 0.08)
    return trimesh.util.concatenate(
        [outer.apply_translation([0, 0, 0.04]), trimesh.creation.cylinder(0.037, 0.01)]
    )


def look(meshes, elevation=40.0, noise=True, half=True):
    """Return an image of meshes and the true labels, at half resolution or in full."""
    pose = look_at(0.0, elevation, 0.6)
    depth, labels = render_depth(meshes, pose, noise=noise)
    if half:
        return DepthImage(halved(depth), HALF, pose), halved(labels)
    return DepthImage(depth, INTRINSICS, pose), labels


@pytest.mark.parametrize("elevation", [30.0, 45.0, 60.0])
@pytest.mark.parametrize(
    "meshes",
    [
        [
            box([0.04, 0.1, 0.03], [0.06, 0, 0.015]),
            box([0.04, 0.1, 0.12], [-0.01, 0, 0.06]),
        ],  # one hides another's foot
        [cup()],  # its inside is seen over its rim
        [
            trimesh.util.concatenate(
                box([0.06, 0.06, 0.05], [0, 0, 0.025]), box([0.02, 0.12, 0.01], [0, 0.08, 0.045])
            )
        ],
        [box([0.15, 0.07, 0.008], [0, 0, 0.004])],
    ],
    ids=["behind", "cup", "overhang", "flat"],
)
def test_each_thing_has_one_label(meshes, elevation):
    image, labels = look(meshes, elevation, half=elevation < 50.0)  # a low plate needs its pixels
    found = segment(TableImage.of(image, TABLE))
    assert found.max() == len(meshes)
    for k in range(1, len(meshes) + 1):
        mine = (labels == k) & (image.depth > 0)
        label = int(found[mine].mode().values)
        assert ((found == label) & mine).sum() > 0.93 * mine.sum()
        assert ((found == label) & ~mine & (image.depth > 0)).sum() < 0.02 * mine.sum()


def test_an_empty_table_has_no_things():
    image, _ = look([box([0.01, 0.01, 0.01], [0.0, 0.0, -0.1])])
    assert not segment(TableImage.of(image, TABLE)).any()


def test_flying_pixels_belong_to_nothing():
    image, labels = look([box([0.06, 0.06, 0.1], [0, 0, 0.05])], noise=False, half=False)
    row = torch.nonzero(labels == 1)[:, 0].min()
    column = 320
    exact = rests_on(TableImage.of(image, TABLE))
    assert (exact & (labels == 1)).sum() > 0.96 * (labels == 1).sum()
    flying = image.depth.clone()
    away = 0.015 + 0.06 * torch.rand(
        2, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    flying[row - 2 : row, column - 20 : column + 20] = image.depth[row + 3, column] + away
    moved = DepthImage(flying, image.intrinsics, image.obj_from_camera)
    assert not rests_on(TableImage.of(moved, TABLE))[row - 2 : row, column - 20 : column + 20].any()
    assert segment(TableImage.of(moved, TABLE)).max() == 1


def test_the_floor_of_a_pan_belongs_to_it_and_the_table_in_a_ring_does_not():
    rim = trimesh.creation.annulus(0.09, 0.1, 0.04).apply_translation([0, 0, 0.02])
    floor = trimesh.creation.cylinder(0.095, 0.002).apply_translation([0, 0, 0.001])
    pan, labels = look([trimesh.util.concatenate([rim, floor])], 60.0)
    ring, _ = look([rim], 60.0)
    inside = (pan.points()[..., :2].norm(dim=-1) < 0.07) & (labels == 1)
    assert (
        segment(TableImage.of(pan, TABLE))[inside & (pan.depth > 0)] == 1
    ).double().mean() > 0.95
    assert (
        segment(TableImage.of(ring, TABLE))[inside & (ring.depth > 0)] == 0
    ).double().mean() > 0.95


def torus(major, minor, place, turn=0.0):
    mesh = trimesh.creation.torus(major, minor)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(torch.pi / 2, [1, 0, 0]))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    return mesh.apply_translation(place)


@pytest.mark.parametrize("elevation", [30.0, 55.0])
@pytest.mark.parametrize("turn", [0.5, 2.0, 3.5])
def test_a_mug_with_its_handle_and_a_standing_ring_are_one(elevation, turn):
    handle = torus(0.025, 0.005, [0.04, 0, 0.045]).slice_plane([0.037, 0, 0], [1, 0, 0])
    mug = trimesh.util.concatenate([cup(), handle])
    mug.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    for meshes in ([mug], [torus(0.05, 0.01, [0, 0, 0.06], turn)]):
        image, _ = look(meshes, elevation, half=elevation > 50.0)  # a low view hides more
        assert segment(TableImage.of(image, TABLE)).max() == 1


@pytest.mark.parametrize(
    "meshes",
    [
        [box([0.06, 0.08, 0.12], [-0.031, 0, 0.06]), box([0.06, 0.1, 0.05], [0.03, 0.02, 0.025])],
        [
            trimesh.creation.cylinder(0.035, 0.1).apply_translation([0, 0, 0.05]),
            box([0.1, 0.06, 0.06], [0.02, 0.066, 0.03]),
        ],
    ],
    ids=["boxes", "can and box"],
)
def test_objects_that_touch_are_cut_at_the_crease_and_told(meshes):
    image, labels = look(meshes, 45.0, half=False)
    found = segment(TableImage.of(image, TABLE))
    assert found.max() == 2
    for k in (1, 2):
        mine = found[(labels == k) & (found > 0)]
        assert (mine == mine.mode().values).double().mean() > 0.95
    assert find_touching(image, image.points(), found) == [(1, 2)]


def test_objects_apart_do_not_touch_and_a_convex_surface_has_no_crease():
    image, _ = look(
        [box([0.05, 0.05, 0.06], [0, -0.05, 0.03]), box([0.05, 0.05, 0.06], [0, 0.05, 0.03])], 45.0
    )
    found = segment(TableImage.of(image, TABLE))
    assert found.max() == 2 and find_touching(image, image.points(), found) == []
    assert torch.equal(cut_creases(image, image.points(), found), found)


def test_a_thing_that_hides_another_between_two_ends_is_not_joined_to_it_but_a_handle_is():
    generator = torch.Generator().manual_seed(0)

    def body(low, high):
        low, high = (torch.tensor(x).double() for x in (low, high))
        points = low + (high - low) * torch.rand(500, 3, generator=generator, dtype=torch.float64)
        return _Body((0,), points, 500)

    front = body([0.0, 0.0, 0.0], [0.05, 0.05, 0.1])
    behind = body([0.06, -0.05, 0.0], [0.12, 0.1, 0.08])
    handle = body([0.06, 0.02, 0.055], [0.08, 0.03, 0.09])
    ends = 0.0  # the gap of two bodies that meet at two ends
    assert not _one_body(front, behind, ends) and not _one_body(behind, front, ends)
    assert _one_body(front, handle, ends) and _one_body(handle, front, ends)


STICKS = [box([0.02, 0.16, 0.02], [0, 0, 0.01]), box([0.14, 0.02, 0.02], [0.08, 0.08, 0.01])]


@pytest.mark.parametrize(
    ("meshes", "told"),
    [
        (STICKS, True),
        ([box([0.03, 0.22, 0.02], [0, 0, 0.01])], False),  # long, without gaps
        ([mesh.copy().apply_scale([0.5, 0.5, 1.0]) for mesh in STICKS], False),  # with gaps, short
    ],
    ids=["long", "whole", "short"],
)
def test_a_long_target_with_gaps_in_its_outline_may_be_several_which_is_told(meshes, told):
    pose = look_at(20.0, 50.0, 0.6)
    depth, labels = render_depth(meshes, pose)
    scene = Scene.from_depth(depth, INTRINSICS, pose, up=(0.0, 0.0, 1.0))
    assert scene.things == (1,)
    chosen = scene.select(1)
    said = [line for line in chosen.advice if "several objects" in line]
    assert len(said) == told
    given = Scene.from_depth(depth, INTRINSICS, pose, up=(0.0, 0.0, 1.0), mask=labels > 0)
    assert not any("several objects" in line for line in given.advice)


def test_an_uneven_place_of_the_table_is_no_object():
    image, _ = look([box([0.05, 0.05, 0.06], [0, 0.1, 0.03])], 45.0)
    place = image.points()[..., :2]
    rise = 0.0038 * torch.exp(-((place - torch.tensor([0.0, -0.05])) / 0.02).square().sum(-1))
    depth = torch.where(image.depth > 0, image.depth - rise / math.sin(math.radians(45.0)), 0.0)
    found = segment(
        TableImage.of(DepthImage(depth, image.intrinsics, image.obj_from_camera), TABLE)
    )
    assert found.max() == 1


def test_a_box_upon_a_box_is_an_object_and_a_knob_upon_a_box_is_a_part():
    base = box([0.16, 0.16, 0.05], [0, 0, 0.025])
    for top, count in (
        (box([0.07, 0.09, 0.06], [0, 0, 0.08]), 2),
        (box([0.02, 0.02, 0.02], [0, 0, 0.06]), 1),
    ):
        image, labels = look([base, top], 45.0)
        pieces = torch.where(image.depth > 0, labels, 0)
        assert len(merge_pieces(TableImage.of(image, TABLE), pieces)[1:].unique()) == count
