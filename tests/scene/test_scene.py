import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from tests.make import HALF, box, halved
from torchgrasp import Scene, load_scene, plan_scene, read_scene, save_scene
from torchgrasp.cloud.camera import INTRINSICS, look_at
from torchgrasp.cloud.camera import render_depth as render_whole
from torchgrasp.cloud.rays import RAYS, tell_rays
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.creases import cut_creases
from torchgrasp.scene.image import read_image
from torchgrasp.values.planning import PointCloud

POSE = look_at(20.0, 45.0, 0.6)
K = HALF


def render_depth(*what, **options):
    """Depth [m] and labels of half the size, which most tests need not have whole."""
    depth, labels = render_whole(*what, **options)
    return halved(depth), halved(labels)


def things():
    places = ([0.1, 0.0, 0.04], [0.0, 0.12, 0.05], [-0.1, -0.05, 0.03])
    meshes = (
        trimesh.creation.box([0.06, 0.06, 0.08]),
        trimesh.creation.cylinder(0.03, 0.10),
        trimesh.creation.icosphere(radius=0.03),
    )
    return [mesh.apply_translation(place) for mesh, place in zip(meshes, places, strict=True)]


@pytest.fixture(scope="module")
def picture():
    return render_depth(things(), POSE)


@pytest.fixture(scope="module")
def scene(picture):
    return Scene.from_depth(picture[0], K, POSE)


@pytest.mark.parametrize("kind", [torch.clone, np.array])
def test_a_pose_that_moves_on_leaves_the_scenes_before_in_their_place(picture, kind):
    depth = picture[0]
    moving = kind(POSE)
    image = read_image(depth, K, moving)
    moving[:3, 3] += 0.5
    assert torch.equal(image.obj_from_camera, POSE)


def test_arrays_that_are_read_backwards_are_taken_as_they_are(picture, scene):
    # (row, column), as NumPy counts, reversed to a pixel
    place = np.array(middle(picture[1], 2)[::-1])
    assert scene.select(place[::-1]).target == scene.select(middle(picture[1], 2)).target


def middle(labels, k):
    """Return the pixel (u, v) in the middle of a thing."""
    row, column = torch.nonzero(labels == k).double().mean(0).tolist()
    return column, row


def agreement(scene, picture, k):
    """Return the share of a thing's measured pixels that the target has, and of the target's that
    are others'.
    """
    depth, labels = picture
    target = torch.zeros_like(labels, dtype=torch.bool)
    row, column = scene.pixels[scene.rows_of()].unbind(-1)
    target[row, column] = True
    true = (labels == k) & (depth > 0)
    return float((target & true).sum() / true.sum()), float((target & ~true).sum() / target.sum())


def test_a_clicked_thing_is_found_whole_and_alone(scene, picture):
    assert len(scene.things) == 3
    for k in (1, 2, 3):
        for clicked in (middle(picture[1], k), apply(POSE, torch.zeros(1, 3).double())):
            if isinstance(clicked, tuple):
                found = scene.select(clicked)
            else:  # the same by a point in space
                u, v = middle(picture[1], k)
                row = (scene.pixels.double() - torch.tensor([v, u])).norm(dim=-1).argmin()
                found = scene.select(scene.points[row].tolist())
            share, others = agreement(found, picture, k)
            assert share > 0.95 and others < 0.02


def test_labels_are_the_same_wherever_the_camera_stands(scene, picture):
    motion = rigid(
        rotation_from_vector(torch.tensor([1.0, 2.0, -0.5]).double()),
        torch.tensor([3.0, -1.0, 2.0]).double(),
    )
    moved = Scene.from_depth(picture[0], K, motion @ POSE)
    assert torch.equal(moved.labels, scene.labels)
    torch.testing.assert_close(moved.points, apply(motion, scene.points), atol=1e-9, rtol=0)
    expected = scene.table.moved(motion)
    torch.testing.assert_close(moved.table.normal, expected.normal, atol=1e-9, rtol=0)
    own = Scene.from_depth(picture[0], K)
    assert torch.equal(own.labels, scene.labels)
    assert not own.viewpoint.any()


def test_other_types_give_the_same_scene(scene, picture):
    millimetres = (1000 * picture[0]).round().numpy().astype(np.uint16)
    found = Scene.from_depth(
        millimetres, (308.0, 308.0, 159.75, 119.75), POSE.numpy(), point=middle(picture[1], 1)
    )
    assert agreement(found, picture, 1)[0] > 0.95
    missing = torch.where(picture[0] > 0, picture[0], torch.nan)
    assert torch.equal(Scene.from_depth(missing, K, POSE).labels, scene.labels)


def test_masks_off_by_three_pixels_lose_table_and_neighbours():
    from scipy.ndimage import binary_dilation, binary_erosion

    picture = depth, labels = render_whole(things(), POSE)
    true = (labels == 2).numpy()
    for mask in (
        true,
        binary_dilation(true, iterations=3),
        binary_erosion(true, iterations=3).astype(np.uint8),
    ):
        scene = Scene.from_depth(depth, INTRINSICS, POSE, mask=mask)
        share, others = agreement(scene, picture, 2)
        assert scene.target == 1 and len(scene.things) == 3
        assert share > (0.95 if mask.sum() >= true.sum() else 0.7) and others < 0.02
        # no sliver of the target is a neighbour
        rows = scene.labels > 1
        row, column = scene.pixels[rows].unbind(-1)
        assert (labels[row, column] == 2).double().mean() < 0.005


def test_given_labels_and_tables_are_kept(picture):
    depth, labels = picture
    scene = Scene.from_depth(depth, K, POSE, labels=labels.numpy().astype(np.uint8), table=0.0)
    assert scene.things == (1, 2, 3) and scene.table.offset == 0.0
    assert agreement(scene.select(3), picture, 3)[0] > 0.95
    again = Scene.from_depth(depth, K, POSE, labels=_image(scene), table=Plane.horizontal(0.0))
    assert torch.equal(again.labels, scene.labels)


def _image(scene):
    labels = torch.zeros(scene.image.depth.shape, dtype=torch.int64)
    labels[scene.pixels[:, 0], scene.pixels[:, 1]] = scene.labels
    return labels


def _at_pixels(scene, image):
    return image[scene.pixels[:, 0], scene.pixels[:, 1]]


def test_a_cloud_gives_the_scene_of_its_picture():
    picture = render_whole(things(), POSE)
    scene = Scene.from_depth(picture[0], INTRINSICS, POSE)
    shuffle = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(0))
    cloud = PointCloud(scene.points[shuffle], None, scene.viewpoint)
    inside = scene.select(middle(picture[1], 1)).cloud().points
    box = torch.stack([inside.amin(0) - 0.01, inside.amax(0) + 0.01])
    true = picture[1][scene.pixels[:, 0], scene.pixels[:, 1]][shuffle]
    for given in ({"point": inside[len(inside) // 2]}, {"box": box.numpy()}, {"mask": true == 1}):
        found = Scene.from_cloud(cloud, **given)
        mine = found.rows_of()
        assert (mine & (true == 1)).sum() / (true == 1).sum() > 0.93
        assert (mine & (true != 1)).sum() / mine.sum() < 0.02
        # its picture sees what the points are
        seen = _at_pixels(found, found.image.points())
        assert (seen - found.points).norm(dim=-1).median() < 0.002
        # a hidden point takes no pixel from the object before it
        assert bool((_at_pixels(found, found.pixel_labels)[mine] == found.target).all())
    for one in ({"box": box.numpy()}, {"mask": true == 1}):
        with pytest.raises(BadArgument, match="beside"):
            Scene.from_cloud(cloud, **one, point=inside[0])
    # probabilities of a network, some of which are exactly 1
    likely = torch.where(true == 1, 0.8, 0.1)
    likely[torch.nonzero(true == 1)[::3, 0]] = 1.0
    for wrong, told in (
        ({"mask": likely}, "mask: expected whole numbers"),
        ({"point": [1.0, 2.0]}, "point: .*a pixel of a cloud"),
    ):
        with pytest.raises(BadArgument, match=told):
            Scene.from_cloud(cloud, **wrong)


def test_a_target_cut_off_at_the_border_is_told(picture):
    depth, labels = picture
    assert Scene.from_depth(depth, K, POSE, mask=labels == 1).advice == ()
    row = int(torch.nonzero(labels == 1)[:, 0].double().mean())
    cut = depth[:row]
    k = K.clone()
    k[1, 2] = min(float(K[1, 2]), 0.6 * row)
    mask = (labels == 1)[:row]
    (sentence,) = Scene.from_depth(cut, k, mask=mask, table=None).advice
    assert "border" in sentence


def cylinder(x, height):
    return trimesh.creation.cylinder(0.03, height).apply_translation([x, 0.0, height / 2])


@pytest.mark.parametrize(
    ("x", "height", "covers"), [(0.1, 0.12, True), (0.1, 0.03, False), (-0.1, 0.12, False)]
)
def test_an_object_that_hides_much_of_the_target_is_told(x, height, covers):
    camera = look_at(0.0, 35.0, 0.7)
    bodies = [cylinder(0.0, 0.09), cylinder(x, height)]
    depth, labels = render_depth(bodies, camera)
    alone = render_depth(bodies[:1], camera)[1]
    hidden = 1 - float((labels == 1).sum() / (alone == 1).sum())
    assert (hidden > 0.2) == covers  # what the pixels of a picture without the other say
    seen = Scene.from_depth(depth, K, camera, labels=labels)
    told = [x for x in seen.select(1).advice if x.startswith("object 2 stands before")]
    assert len(told) == covers
    assert not any("stands before" in x for x in seen.advice)  # no target


def test_doubts_of_all_targets_are_those_of_each_and_the_image_is_searched_once(monkeypatch):
    scene = load_scene()
    alone = [dataclasses.replace(scene, target=k) for k in scene.things]
    expected = [(one.doubts, one.advice) for one in alone]
    assert any(doubts for doubts, _ in expected)
    calls = []

    def count(image, points, labels):
        calls.append(labels)
        return cut_creases(image, points, labels)

    monkeypatch.setattr("torchgrasp.scene.scene.cut_creases", count)
    planned = []

    def note(target, *_, **__):
        planned.append((target.doubts, target.advice))
        raise BadArgument("stop", "a scene", "none")

    monkeypatch.setattr("torchgrasp.planner.scene_plan.plan_grasps", note)
    plan_scene(scene, "barrett", starts=1)
    assert len(planned) == len(expected) > 2 and all(found in expected for found in planned)
    again = [scene.select(k).select(j).select(k) for k, j in zip((1, 2, 3), (2, 3, 1), strict=True)]
    assert [(one.doubts, one.advice) for one in again] == expected[:3]
    assert len(calls) == 1
    # other labels have other borders
    other = dataclasses.replace(again[0], labels=torch.where(scene.labels == 1, 0, scene.labels))
    assert other.select(2).doubts == dataclasses.replace(other, target=2).doubts
    assert len(calls) == 3


def test_a_target_of_two_parts_apart_in_depth_is_told_unless_its_mask_is_given():
    bodies = [cylinder(-0.06, 0.12), cylinder(0.04, 0.05)]
    depth, labels = render_depth(bodies, look_at(0.0, 35.0, 0.7))
    seen = Scene.from_depth(depth, K, look_at(0.0, 35.0, 0.7), labels=labels)
    both = dataclasses.replace(seen, labels=(seen.labels > 0).long(), target=1, given=())
    assert [x.startswith("the target has a jump in depth") for x in both.doubts] == [True]
    assert dataclasses.replace(both, given=(1,)).doubts == ()
    assert dataclasses.replace(seen, target=1, given=()).doubts == ()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mask": np.zeros((240, 320), bool)}, "mask: expected .*got no pixel inside"),
        ({"mask": np.ones((48, 64), bool)}, "mask: expected"),
        ({"mask": "table"}, "mask: expected .*this target is the table"),
        ({"point": (2.0, 235.0)}, "point: expected .*got pixel .* on the table"),
        ({"point": (2.0, 1.0)}, "point: expected .*got nothing measured"),
        ({"point": (0.0, 0.0, 1.0)}, "point: expected .*got nothing measured"),
        ({"point": (1.0,)}, "point: expected .*got"),
        ({"labels": np.zeros((240, 320), int)}, "labels: expected .*got none"),
        ({"labels": np.zeros((4, 6), int)}, "labels: expected .*got shape"),
        ({"table": 2.0}, "table: expected .*got the camera .* below it"),
        ({"up": (0.0, 0.0, -1.0)}, "camera_pose: expected .*another `up`.*180 degrees from up"),
        (
            {"intrinsics": (154.0, 154.0, 79.5, 59.5)},
            "intrinsics: expected .*got a principal point",
        ),
        ({"scale": 1000.0}, "depth: expected a median depth.*got 582.4 m"),
    ],
)
def test_bad_input_is_one_sentence(picture, given, message):
    depth, labels = picture
    given = dict(given)
    if isinstance(given.get("mask"), str):
        given["mask"] = (labels == 0) & (torch.arange(240)[:, None] > 200)
    with pytest.raises(BadArgument, match=message) as refused:
        Scene.from_depth(depth * given.pop("scale", 1.0), given.pop("intrinsics", K), POSE, **given)
    assert "\n" not in str(refused.value)


def test_no_table_and_no_camera_are_refused(picture):
    with pytest.raises(NoSupport):
        Scene.from_depth(render_depth(things(), POSE, table=None)[0], K, POSE)
    with pytest.raises(BadArgument, match="viewpoint"):
        Scene.from_cloud(PointCloud(torch.rand(100, 3)))


def test_other_supports_are_told_and_survive_a_file(tmp_path):
    top = box([0.5, 0.4, 0.02], [0.0, 0.0, -0.01])
    floor = box([4.0, 4.0, 0.01], [0.0, 0.0, -0.455])
    stools = [box([0.2, 0.2, 0.2], [x, y, -0.35]) for x in (0.5, -0.6) for y in (-0.5, 0.5)]
    cup = box([0.06, 0.06, 0.08], [0.0, 0.0, 0.04])
    pose = look_at(0.0, 35.0, 1.0)
    depth, _ = render_depth([top, floor, *stools, cup], pose, table=None)
    scene = Scene.from_depth(depth, K, pose)
    assert len(scene.supports) == 2 and len(scene.things) == 1
    assert "another plane" in scene.advice[0]
    again = read_scene(save_scene(scene, tmp_path / "scene.npz"))
    assert again.supports[1].offset == scene.supports[1].offset and again.advice == scene.advice
    on_floor = Scene.from_depth(depth, K, pose, table=scene.supports[1])
    assert (
        on_floor.supports == (scene.supports[1],) and len(on_floor.things) >= 3
    )  # the table, two stools


@pytest.mark.parametrize(("foot", "told"), [(0.0, False), (0.1, False), (0.3, True)])
def test_a_target_far_above_its_table_is_told(foot, told):
    thing = box([0.06, 0.06, 0.12])
    thing.apply_translation([0.0, 0.0, foot])
    camera = look_at(20.0, 45.0, 0.9, torch.tensor([0.0, 0.0, 0.1]).double())
    depth, labels = render_depth([thing], camera, noise=False)
    seen = Scene.from_depth(depth, K, camera, mask=labels == 1, table=0.0)
    notes = [x for x in seen.notes if "may be a floor or a wall" in x]
    assert len(notes) == told
    if told:
        height = float(notes[0].split()[3])
        assert height == pytest.approx(foot, abs=0.02)


@pytest.mark.parametrize("elevation", [35.0, 60.0])
def test_distances_along_rays_are_told(elevation):
    pose = look_at(20.0, elevation, 0.6)
    depth, _ = render_depth(things(), pose)
    row, column = torch.meshgrid(*map(torch.arange, depth.shape), indexing="ij")
    x = (column - K[0, 2]) / K[0, 0]
    y = (row - K[1, 2]) / K[1, 1]
    distance = depth * torch.sqrt(x * x + y * y + 1)
    for given in ({}, {"camera_pose": pose}):
        assert not any("ray" in note for note in Scene.from_depth(depth, K, **given).notes)
        try:
            told = Scene.from_depth(distance, K, **given).notes
        except NoSupport as error:
            told = (str(error),)
        assert any("distance along the ray of each pixel" in note for note in told)


@pytest.mark.parametrize("elevation", [35.0, 60.0])
def test_inverse_depths_are_told(elevation):
    pose = look_at(20.0, elevation, 0.6)
    depth, _ = render_depth(things(), pose)
    inverse = torch.where(depth > 0, 0.3 / depth.clamp_min(1e-6), 0.0)
    for given in ({}, {"camera_pose": pose}):
        try:
            told = Scene.from_depth(inverse, K, **given).notes
        except (BadArgument, NoSupport) as error:
            told = (str(error),)
        assert any("inverse depths, such as disparities" in note for note in told)


def test_few_pixels_tell_nothing_of_rays():
    pose = look_at(20.0, 35.0, 0.6)
    depth, _ = render_depth(things(), pose)
    few = torch.zeros_like(depth)
    few[::80, ::80] = depth[::80, ::80]
    assert 0 < int((few > 0).sum()) < 16 * RAYS.fewest
    assert tell_rays(few, K) == ()
