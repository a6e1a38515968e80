"""Wrong inputs of a camera, each told in a sentence that names the repair; its right twin passes."""

import functools
import math
import re
import warnings

import numpy as np
import pytest
import torch
import trimesh

from tests.make import HALF, box, halved
from torchgrasp import Scene, read_scene, save_scene
from torchgrasp.cloud.camera import look_at, render_depth
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.pose import (
    read_camera_pose,
    read_pose,
    tell_furniture,
    tell_inverse,
    tell_large,
)
from torchgrasp.cloud.prepare import merge_clouds
from torchgrasp.foundation.errors import BadArgument, CloudWarning, MendedInput, NoSupport
from torchgrasp.foundation.rules import is_rigid
from torchgrasp.geometry.frames import inverse, rigid, rotation_from_vector
from torchgrasp.geometry.plane import Plane

GL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
OPTICAL = torch.tensor(
    [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
).double()  # link_from_optical
VIEWS = {"front": (20.0, 45.0), "low": (140.0, 28.0), "steep": (-70.0, 68.0)}


@functools.cache
def seen(view="front"):
    """Depth [m] of two boxes on a table, and the camera's pose."""
    pose = look_at(*VIEWS[view], 0.7)
    meshes = [box((0.06, 0.05, 0.1)), box((0.05, 0.05, 0.06), (0.05, 0.14))]
    return halved(render_depth(meshes, pose)[0]), pose


@functools.cache
def right(view="front"):
    """The scene of the right pose."""
    return Scene.from_depth(seen(view)[0], HALF, seen(view)[1])


@functools.cache
def rolled():
    """Depth [m] by a camera that is rolled by ten degrees, and its pose."""
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, math.radians(10.0)]).double())
    pose = seen()[1] @ rigid(turn, torch.zeros(3).double())
    meshes = [box((0.06, 0.05, 0.1)), box((0.05, 0.05, 0.06), (0.05, 0.14))]
    return halved(render_depth(meshes, pose)[0]), pose


def scaled(pose, factor):
    return rigid(pose[:3, :3], factor * pose[:3, 3])


POSES = {  # a wrong pose of a right one, what is said
    "OpenGL": (lambda p: p @ GL, r"diag\(1, -1, -1, 1\), if it is OpenGL's"),
    "inverse": (inverse, "inverse of camera_pose, if it is camera_from_world"),
    "OpenGL's view matrix": (lambda p: inverse(p @ GL), "OpenGL's view matrix"),
    "camera_link": (lambda p: p @ inverse(OPTICAL), "optical frame"),
    "transposed": (lambda p: p.T.contiguous(), "give its transpose"),
    "millimetres": (lambda p: scaled(p, 1000), "divide camera_pose.* by 1000"),
    "centimetres": (lambda p: scaled(p, 100), "divide camera_pose.* by 100$|by 100, got"),
    "scaled": (
        lambda p: torch.diag(torch.tensor([2.0, 2, 2, 1])).double() @ p,
        "a rotation times 2",
    ),
    "left-handed": (
        lambda p: p @ torch.diag(torch.tensor([-1.0, 1, 1, 1])).double(),
        "left-handed",
    ),
    "rounded": (lambda p: torch.round(p, decimals=1), "orthogonal"),
    "3 x 4": (lambda p: p[:3], "add the row 0 0 0 1"),
    "16 numbers": (lambda p: p.ravel(), "reshape"),
    "a quaternion": (lambda p: torch.tensor([0.1, 0.2, 0.3, 0, 0, 0, 1]).double(), "quaternion"),
}


@pytest.mark.parametrize(
    ("name", "view"), [(name, [*VIEWS][k % len(VIEWS)]) for k, name in enumerate(POSES)]
)
def test_a_wrong_pose_is_told_by_what_contradicts_it(name, view):
    depth, pose = seen(view)
    assert len(right(view).things) == 2
    with pytest.raises(BadArgument, match=f"camera_pose: .*({POSES[name][1]})"):
        Scene.from_depth(depth, HALF, POSES[name][0](pose))


@functools.cache
def masked():
    """A mask of the objects' near pixels, and their cloud by the right pose."""
    near = (right().pixel_labels > 0) & (seen()[0] < 0.62)
    return near, cloud_from_depth(seen()[0], HALF, near, seen()[1])


@pytest.mark.parametrize("name", POSES)
def test_a_cloud_of_a_mask_is_told_the_same(name):
    depth, pose = seen()
    near, cloud = masked()
    assert len(cloud) == int(near.sum())
    with pytest.raises(BadArgument, match=f"camera_pose: .*({POSES[name][1]})"):
        cloud_from_depth(depth, HALF, near, POSES[name][0](pose))


@pytest.mark.parametrize("elevation", [75.0, 86.0])
def test_an_inverse_pose_is_told_by_a_table_a_few_degrees_from_level(elevation):
    pose = look_at(20.0, elevation, 0.7)
    depth = halved(
        render_depth([box((0.06, 0.05, 0.1)), box((0.05, 0.05, 0.06), (0.05, 0.14))], pose)[0]
    )
    assert len(Scene.from_depth(depth, HALF, pose).things) == 2
    for wrong, said in (POSES[name] for name in ("inverse", "OpenGL's view matrix")):
        with pytest.raises(BadArgument, match=said):
            Scene.from_depth(depth, HALF, wrong(pose))
    right_up = tuple(
        Scene.from_depth(depth, HALF, inverse(pose), table=None, up=_up(pose)).table.normal.tolist()
    )
    assert right_up[2] > 0.9  # whose user says so is believed


def _up(pose):
    """Return the table's normal under the inverse of a pose."""
    return tuple((pose[:3, :3].T @ pose[:3, :3].T[:, 2]).tolist())


INPUTS = {  # depth in metres and pose to the arguments; what is said
    "tenths of a millimetre": (lambda d, p: {"depth": np.uint16((1e4 * d).numpy())}, "depth_unit"),
    "tenths of a millimetre, posed": (
        lambda d, p: {"depth": np.uint16((1e4 * d).numpy()), "camera_pose": p},
        "depth_unit",
    ),
    "a quarter of a millimetre": (
        lambda d, p: {"depth": np.uint16((4e3 * d).numpy())},
        "depth_unit",
    ),
    "a quarter of a millimetre, posed": (
        lambda d, p: {"depth": np.uint16((4e3 * d).numpy()), "camera_pose": p},
        "depth_unit",
    ),
    "a quarter of a millimetre, near": (
        lambda d, p: {"depth": np.uint16((4e3 * 0.6 * d).numpy()), "camera_pose": scaled(p, 0.6)},
        "depth_unit",
    ),
    "mirrored by a camera that is rolled": (
        lambda d, p: {"depth": rolled()[0].flip(1), "camera_pose": rolled()[1]},
        r"depth\[:, ::-1\]",
    ),
    "floating millimetres": (lambda d, p: {"depth": 1e3 * d}, "depth_unit=0.001"),
    "centimetres": (lambda d, p: {"depth": 100 * d}, "depth_unit=0.01"),
    "counts of centimetres": (lambda d, p: {"depth": np.uint16((10 * d).numpy())}, "depth_unit"),
    "counts of metres": (lambda d, p: {"depth": torch.round(d).long()}, "depth_unit"),
    "a unit ten times too small": (
        lambda d, p: {"depth": 1e3 * d, "depth_unit": 5e-5},
        "depth_unit",
    ),
    "counts per metre": (lambda d, p: {"depth": 1e3 * d, "depth_unit": 1000.0}, "depth_unit"),
    "upside down": (lambda d, p: {"depth": d.flip(0), "camera_pose": p}, r"depth\[::-1\]"),
    "up against the table": (
        lambda d, p: {"depth": d, "camera_pose": p, "up": (0.0, 0.0, -1.0)},
        "up",
    ),
    "OpenGL with up": (
        lambda d, p: {"depth": d, "camera_pose": p @ GL, "up": (0.0, 0.0, 1.0)},
        "OpenGL",
    ),
    "OpenGL with a table": (
        lambda d, p: {"depth": d, "camera_pose": p @ GL, "table": 0.0},
        "table",
    ),
    "transposed image": (
        lambda d, p: {"depth": d.T.contiguous(), "camera_pose": p},
        "transposed image",
    ),
    "half the image": (lambda d, p: {"depth": d[::2, ::2].contiguous()}, "times 0.5"),
    "twice the image": (
        lambda d, p: {"depth": d.repeat_interleave(2, 0).repeat_interleave(2, 1)},
        "times 2",
    ),
}


@pytest.mark.parametrize("name", INPUTS)
def test_a_wrong_unit_or_image_is_told(name):
    with pytest.raises(BadArgument, match=INPUTS[name][1]):
        Scene.from_depth(**{"intrinsics": HALF} | INPUTS[name][0](*seen()))


def test_a_stated_unit_and_a_mended_pose_are_used(tmp_path):
    depth, pose = seen()
    tenths = np.uint16(np.round(1e4 * depth.numpy()))
    for scene in (
        Scene.from_depth(tenths, HALF, pose, depth_unit=1e-4),
        Scene.from_depth(depth, HALF, (pose @ GL) @ GL),
        Scene.from_depth(depth, HALF, inverse(inverse(pose)), up=(0.0, 0.0, 1.0)),
        read_scene(save_scene(right(), tmp_path / "s.npz")),
    ):
        assert len(scene.things) == 2 and float(scene.table.normal[2]) > 0.999
    down = (
        torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double() @ pose
    )  # a robot that hangs from the ceiling
    with pytest.raises(BadArgument, match="up"):
        Scene.from_depth(depth, HALF, down)
    hanging = Scene.from_depth(depth, HALF, down, up=(0.0, 0.0, -1.0))
    assert len(read_scene(save_scene(hanging, tmp_path / "h.npz")).things) == 2


def test_right_poses_raise_no_alarm():
    rng = np.random.default_rng(0)
    depth, pose = seen()
    for _ in range(3):
        turn = rotation_from_vector(torch.tensor([0.0, 0.0, rng.uniform(-3, 3)]).double())
        placed = rigid(turn, torch.tensor(rng.uniform(-2, 2, 3))) @ pose
        assert len(Scene.from_depth(depth, HALF, placed).things) == 2
    for tilt in (0.3, math.pi / 4, 1.2):  # a base on a slope
        tilted = (
            rigid(
                rotation_from_vector(torch.tensor([tilt, 0.2, 0.0]).double()),
                torch.zeros(3).double(),
            )
            @ pose
        )
        found = Scene.from_depth(depth, HALF, tilted)
        assert len(found.things) == 2
        degrees = math.degrees(math.acos(float((tilted @ inverse(pose))[2, 2])))
        (note,) = found.notes
        assert abs(float(re.findall(r"tilted by (\d+) degrees", note)[0]) - degrees) < 1
        assert note.endswith("if z is not up, give `up`")
    assert not right().notes
    assert len(Scene.from_depth(depth, HALF).things) == 2  # the camera's own frame
    beside = rigid(
        rotation_from_vector(torch.tensor([0.02, 0.0, 0.01]).double()),
        torch.tensor([0.015, 0, 0]).double(),
    )
    assert len(Scene.from_depth(depth, HALF, beside).things) == 2  # the frame of the colour camera


def test_a_high_camera_is_noted_where_no_unit_is_given():
    depth, pose = seen()
    high = Scene.from_depth(2.2 * depth, HALF, scaled(pose, 2.2))  # objects of 11 to 22 cm
    assert (
        len(high.notes) == 1
        and "1.09 m above the table" in high.notes[0]
        and "depth_unit" in high.notes[0]
    )
    assert Scene.from_depth(2.2 * depth, HALF, scaled(pose, 2.2), depth_unit=1.0).notes == ()
    assert right().notes == ()


def test_a_mirrored_image_of_a_level_camera_is_a_right_image_of_another_scene():
    depth, pose = seen()
    mirrored = Scene.from_depth(depth.flip(1), HALF, pose)
    assert len(mirrored.things) == 2 and abs(mirrored.table.offset) < 0.001


def random_pose(seed):
    generator = torch.Generator().manual_seed(seed)
    turn = rotation_from_vector(3 * torch.randn(3, generator=generator, dtype=torch.float64))
    return rigid(turn, torch.tensor([0.3, -0.2, 0.7]).double())


@pytest.mark.parametrize("decimals", [3, 4])
def test_a_pose_of_few_decimals_is_mended_and_told(decimals, tmp_path):
    for seed in range(40):
        true = random_pose(seed)
        rounded = true.numpy().copy()
        rounded[:3, :3] = rounded[:3, :3].round(decimals)
        np.savetxt(tmp_path / "pose.txt", rounded, fmt=f"%.{decimals}f")
        file = tmp_path / "pose.txt"
        for read, given in ((read_camera_pose, (rounded,)), (read_pose, ("p", file))):
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                pose = read(*given)
            off = pose[:3, :3].T @ true[:3, :3]
            assert bool(is_rigid(pose)) and float((off - torch.eye(3).to(off)).norm()) < 2e-3
            assert decimals == 4 or told
            for message in told:
                assert message.category is MendedInput
                assert "rounded, 0.0" in str(message.message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what was rigid stays as it is
        assert torch.equal(read_camera_pose(random_pose(0)), random_pose(0))


def test_a_pose_beyond_the_angle_is_refused_with_it():
    pose = random_pose(1).clone()
    pose[0, 1] += math.radians(1.0)
    for check in (read_camera_pose, lambda p: merge_clouds([masked()[1]], [p])):
        with pytest.raises(BadArgument, match=r"0\.\d+ degrees from a rotation, of at most 0.1"):
            check(pose)
    with pytest.raises(BadArgument, match=r"0\.\d+ degrees from the nearest rotation"):
        Plane.horizontal(0.0).moved(pose)


def test_an_inverse_pose_is_told_where_no_table_is_seen():
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, math.pi]).double())
    overhead = look_at(20.0, 89.9, 0.7)
    hanging = seen()[1] @ rigid(turn, torch.zeros(3).double())
    for azimuth in (-150.0, -40.0, 20.0, 160.0):
        right = look_at(azimuth, 45.0, 0.7)
        assert tell_inverse(right) == ()
        (note,) = tell_inverse(inverse(right))
        assert "give its inverse, if it leads to the camera's frame" in note
    for right in (overhead, hanging, rolled()[1], torch.eye(4).double()):
        assert tell_inverse(right) == ()
    image = np.full((48, 64), 0.5)
    with pytest.warns(CloudWarning, match="rolled by .* degrees, and by the inverse"):
        cloud_from_depth(image, (600.0, 600.0, 31.5, 23.5), camera_pose=inverse(seen()[1]))


def test_views_are_merged_by_poses_of_few_decimals():
    cloud = masked()[1]
    poses = [random_pose(0), random_pose(0)]
    rounded = [torch.round(pose, decimals=3) for pose in poses]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        merged = merge_clouds([cloud, cloud], rounded)
    assert [str(x.message).partition(":")[0] for x in told] == ["poses[0]", "poses[1]"]
    right = merge_clouds([cloud, cloud], poses)
    assert float((merged.points - right.points).norm(dim=-1).max()) < 2e-3


def test_slats_before_a_wall_are_a_table_and_furniture_that_stands_on_a_plane_is_told():
    """A thing on slats with gaps, through which the floor is seen."""

    def block(size, place):
        return trimesh.creation.box(size).apply_translation(place)

    slats = [block((0.6, 0.028, 0.014), (0, -0.2 + 0.044 * k, -0.007)) for k in range(10)]
    wall = block((1.3, 0.02, 1.6), (0, 0.36, 0.1))
    floor = block((3, 3, 0.02), (0, -0.5, -0.5))
    thing = block((0.06, 0.05, 0.1), (0, 0, 0.05))
    pose = look_at(-90.0, 30.0, 0.65)
    depth = halved(render_depth([*slats, wall, floor, thing], pose, table=None)[0])
    scene = Scene.from_depth(depth, HALF)
    up = pose[:3, :3].double().T @ torch.tensor([0.0, 0.0, 1.0]).double()
    assert float(scene.table.normal @ up) > 0.999
    bench = torch.rand(500, 3, dtype=torch.float64)
    (note,) = tell_furniture(bench, torch.ones(500, dtype=torch.long))
    assert "as furniture or a wall" in note
    assert not Scene.from_depth(*seen()[:1], HALF).notes


def test_an_image_upside_down_is_told_in_the_camera_s_own_frame():
    depth, _ = seen()
    assert Scene.from_depth(depth, HALF).notes == ()
    (note,) = Scene.from_depth(depth.flip(0), HALF).notes
    assert "mirrored" in note and "depth[::-1]" in note
    table = right().table.moved(inverse(seen()[1]))
    hanging = Plane(table.normal * torch.tensor([1.0, -1.0, 1.0]).double(), table.offset)
    assert Scene.from_depth(depth.flip(0), HALF, table=hanging).notes == ()


def test_a_transposed_image_is_told_in_the_camera_s_own_frame():
    depth, _ = seen()
    fx, fy, cx, cy = HALF[0, 0], HALF[1, 1], HALF[0, 2], HALF[1, 2]
    (note,) = Scene.from_depth(depth.T, (float(fy), float(fx), float(cy), float(cx))).notes
    assert "on its side" in note and "depth.T" in note


@functools.cache
def wrong_images():
    """A wrong image of each kind, the camera, and what is said of it."""
    depth, pose = seen()
    near, _ = masked()
    fx, fy, cx, cy = (float(x) for x in (HALF[0, 0], HALF[1, 1], HALF[0, 2], HALF[1, 2]))
    row, column = torch.meshgrid(*map(torch.arange, depth.shape), indexing="ij")
    long = torch.sqrt(((column - cx) / fx) ** 2 + ((row - cy) / fy) ** 2 + 1)
    inverted = torch.where(depth > 0, 0.3 / depth.clamp_min(1e-6), 0.0)
    return {
        "right": (depth, near, (HALF, None), "^$"),
        "right, with its pose": (depth, near, (HALF, pose), "^$"),
        "along rays": (depth * long, near, (HALF, pose), "distance along the ray"),
        "inverse": (inverted, near, (HALF, None), "inverse depths, such as disparities"),
        "inverse, of the object alone": (torch.where(near, inverted, 0), near, (HALF, None), "^$"),
        "upside down": (depth.flip(0), near.flip(0), (HALF, None), r"depth\[::-1\]"),
        "transposed": (depth.T, near.T, ((fy, fx, cy, cx), None), r"depth\.T"),
        "of another lens": (depth, near, ((1.4 * fx, 1.4 * fy, cx, cy), pose), "focal length"),
    }


@pytest.mark.parametrize(
    "name",
    [
        *("right", "right, with its pose", "along rays", "inverse", "inverse, of the object alone"),
        *("upside down", "transposed", "of another lens"),
    ],
)
def test_the_cloud_of_a_mask_is_told_of_a_wrong_image_as_its_scene_is(name):
    image, mask, (camera, pose), said = wrong_images()[name]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cloud_from_depth(image, camera, mask, pose)
    assert re.search(said, " ".join(str(one.message) for one in caught))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("off", [-0.3, -0.02, 0.015, 0.05])
def test_a_given_table_beside_the_layer_of_the_points_is_told(view, off):
    depth, pose = seen(view)
    assert Scene.from_depth(depth, HALF, pose, table=0.0).notes == ()
    (note,) = Scene.from_depth(depth, HALF, pose, table=off).notes
    side = "below" if off < 0 else "above"
    assert f"the given table is {1e3 * abs(off):.0f} mm {side}" in note
    assert abs(float(re.findall(r"is it at (\S+) m", note)[0])) < 0.002


def test_the_top_of_an_object_that_was_cut_out_is_no_table():
    pose = look_at(20.0, 70.0, 0.5)
    depth, labels = map(halved, render_depth([box((0.12, 0.08, 0.06))], pose))
    inside = labels == 1
    cut = depth * inside
    assert Scene.from_depth(cut, HALF, pose, mask=inside, table=0.0).notes == ()


def test_a_tilt_by_a_wrong_focal_length_is_told():
    depth, pose = seen()
    wrong = HALF * torch.tensor([[1.4], [1.4], [1.0]]).double()
    wrong[:2, 2] = HALF[:2, 2]
    tilted, leaning = Scene.from_depth(depth, wrong, pose).notes
    assert "focal length" in tilted and "tilted by" in tilted
    assert "lean towards" in leaning and "1.4 times" in leaning


def test_counts_that_are_too_small_are_told():
    depth, pose = seen()
    small = np.uint16((256 * depth).numpy())  # counts of 1/256 m, as of driving
    for given in ({}, {"camera_pose": pose}):
        told = Scene.from_depth(small, HALF, **given).notes
        assert any("depth_unit" in note and "0.126 m above the table" in note for note in told)
        metres = Scene.from_depth(small, HALF, **given, depth_unit=1 / 256).notes
        assert not any("depth_unit" in note for note in metres)


def test_a_missing_table_of_a_far_view_names_the_unit():
    with pytest.raises(NoSupport, match=r"look at depth_unit"):
        Scene.from_depth(np.full((240, 320), 2500, dtype=np.uint16), HALF)
    with pytest.raises(NoSupport, match="a table that is given, got"):
        Scene.from_depth(np.full((240, 320), 2500, dtype=np.uint16), HALF, depth_unit=0.001)


def test_a_pose_in_the_frame_of_the_camera_s_start_is_no_wrong_unit():
    depth, pose = seen()
    depth = 2.0 * depth  # a camera 0.99 m high
    for above in (0.23, 0.27):
        start = scaled(pose, 2.1)
        start = rigid(start[:3, :3], start[:3, 3] * torch.tensor([1.0, 1.0, 0.0]).double())
        start[2, 3] = above
        scene = Scene.from_depth(2.1 / 2.0 * depth, HALF, start)
        assert len(scene.things) == 2 and "depth_unit" in scene.notes[0]


def test_a_camera_far_from_its_origin_is_told_where_no_table_is_seen():
    depth, pose = seen()
    near = torch.where(depth < 0.62, depth, 0.0)
    assert len(cloud_from_depth(near, HALF, camera_pose=pose)) > 100
    far = rigid(pose[:3, :3], torch.tensor([40.0, 0.0, 50.0]).double())
    with pytest.warns(CloudWarning, match="divide camera_pose.* by 100"):
        cloud_from_depth(near, HALF, camera_pose=far)


def test_counts_of_another_unit_are_told_for_the_cloud_of_a_mask():
    depth, _ = seen()
    # in the camera's frame, where no height of a table is expected
    mask = right().pixel_labels == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cloud_from_depth(depth, HALF, mask)
    counts = (depth / 0.00025).round().to(torch.int32)
    with pytest.warns(CloudWarning, match=r"a camera 1.98 m above its table: .* depth_unit"):
        large = cloud_from_depth(counts, HALF, mask)
    given = cloud_from_depth(counts, HALF, mask, depth_unit=0.00025)
    torch.testing.assert_close(large.points, 4 * given.points)


def test_a_large_object_is_told_under_a_far_camera_alone():
    draw = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).double()
    table = Plane.horizontal(0.0)
    for size, high, told in ((0.3, 2.0, 1), (0.3, 0.9, 0), (0.15, 2.0, 0)):
        pose = look_at(0.0, 89.0, high)
        assert len(tell_large(size * draw, pose, table)) == told
    # without a table in view the distance of the object counts
    assert "2 m away" in tell_large(0.3 * draw, look_at(0.0, 0.0, 2.15), None)[0]
    assert not tell_large(0.3 * draw, look_at(0.0, 0.0, 1.2), None)
