import math
import re

import pytest
import torch
import trimesh

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.check import remove_outliers, voxel_downsample
from torchgrasp.cloud.diagnose import diagnose_cloud, format_report
from torchgrasp.cloud.prepare import clean_cloud, merge_clouds
from torchgrasp.cloud.read import read_cloud, save_cloud
from torchgrasp.data.shipped import load_object
from torchgrasp.foundation.errors import BadArgument, CloudWarning, TooFewPoints
from torchgrasp.geometry.frames import apply, inverse, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values.planning import PointCloud

EYE = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def two_views():
    mesh = load_object("jug").mesh
    return [
        partial_view(mesh, look_at(azimuth, 35.0, target=mesh), n=600) for azimuth in (60.0, 240.0)
    ]


def in_own_frames(views, motion):
    """Move each view into the frame of its camera and return the poses that bring it back."""
    poses = [motion, inverse(motion) @ motion @ motion]
    moved = [
        PointCloud(apply(inverse(p), v.points), None, apply(inverse(p), v.viewpoint[None])[0])
        for v, p in zip(views, poses, strict=True)
    ]
    return moved, poses


def test_views_come_together_with_outward_normals_wherever_their_frames_were(two_views, motion):
    merged = merge_clouds(two_views, [EYE, EYE])
    moved, poses = in_own_frames(two_views, motion)
    again = merge_clouds(moved, torch.stack(poses))
    assert len(merged) == 1200 and [len(view) for view in merged.split_views()] == [600, 600]
    torch.testing.assert_close(again.viewpoint, merged.viewpoint, atol=1e-12, rtol=0)
    torch.testing.assert_close(again.points, merged.points, atol=1e-12, rtol=0)
    assert float(((again.normals * merged.normals).sum(-1) > 0.999).double().mean()) > 0.999
    _, _, face = trimesh.proximity.closest_point(load_object("jug").mesh, merged.points.numpy())
    outward = torch.from_numpy(load_object("jug").mesh.face_normals[face].copy())
    assert float(((merged.normals * outward).sum(-1) > 0).double().mean()) > 0.96


def test_the_hidden_side_of_two_views_is_completed_too():
    """Each camera has an outline of its own; a cloud that does not say who saw what has none."""
    mesh = load_object("cylinder").mesh
    merged = merge_clouds(
        [
            partial_view(mesh, look_at(azimuth, 35.0, target=mesh), n=600)
            for azimuth in (60.0, 180.0)
        ],
        [EYE, EYE],
    )
    points, face = trimesh.sample.sample_surface(mesh, 3000, seed=0)
    side = torch.from_numpy(points[mesh.face_normals[face][:, 2] > -0.5].copy())
    hidden = side[torch.cdist(side, merged.points).amin(1) > 0.006]

    def error(cloud):
        shape = fit_shape(cloud, table=0.0)
        return float((shape.scale * shape.predict(hidden).distance).abs().median())

    assert error(merged) < 0.5 * error(PointCloud(merged.points, merged.normals))


def test_the_cameras_of_a_merged_cloud_are_kept_in_files_and_by_every_filter(two_views, tmp_path):
    merged = merge_clouds(two_views, [EYE, EYE])
    back = read_cloud(save_cloud(merged, tmp_path / "merged.npz"))
    assert torch.equal(back.viewpoint, merged.viewpoint) and torch.equal(
        back.normals, merged.normals
    )
    with pytest.raises(BadArgument, match=r"\.npz, for a cloud of several views"):
        save_cloud(merged, tmp_path / "merged.ply")
    for cloud in (voxel_downsample(merged, 0.004), clean_cloud(merged), remove_outliers(merged)):
        eyes = [view.viewpoint for view in cloud.split_views()]
        assert all(torch.equal(a, b.viewpoint) for a, b in zip(eyes, two_views, strict=True))
    assert "0.1" in format_report(diagnose_cloud(merged))


def test_a_merged_cloud_without_a_view_worth_the_name_is_refused(two_views):
    points = two_views[0].points
    each = points + 1.0  # a camera for each point
    with pytest.raises(BadArgument, match=r"expected at most 16.*600 different cameras"):
        fit_shape(PointCloud(points, viewpoint=each))
    few = two_views[0].viewpoint.expand(600, 3).clone()
    few[:5] += 0.1
    with pytest.raises(TooFewPoints, match="5 points of one view"):
        fit_shape(PointCloud(points, viewpoint=few))


def test_one_view_keeps_its_viewpoint_and_given_normals_turn_along(motion):
    points = 0.1 * torch.rand(
        50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    cloud = PointCloud(points, 2 * points + 1, points[0] + 1)
    alone = merge_clouds([cloud], [motion])
    torch.testing.assert_close(alone.viewpoint, apply(motion, cloud.viewpoint[None])[0])
    torch.testing.assert_close(alone.normals @ motion[:3, :3], unit(cloud.normals))
    assert merge_clouds([cloud.to(torch.float32)], [motion]).points.dtype == torch.float32


def test_merge_clouds_refuses_what_does_not_fit(two_views):
    first, second = two_views
    for clouds, poses, words in (
        ([], [], r"clouds: expected .*got none"),
        ([first, second], [EYE], r"poses: expected .*got 1 for 2"),
        ([first, second], [EYE, 2 * EYE], r"poses\[1\].*rigid"),
        ([first, second.to(torch.float32)], [EYE, EYE], "one dtype"),
    ):
        with pytest.raises(BadArgument, match=words):
            merge_clouds(clouds, poses)


def test_views_to_which_one_pose_was_given_are_told():
    mesh = load_object("cylinder").mesh
    poses = [look_at(azimuth, 35.0, target=mesh).double() for azimuth in (60.0, 120.0)]
    views = [partial_view(mesh, pose, 600) for pose in poses]
    first, second = (
        PointCloud(apply(inverse(pose), view.points), None, torch.zeros(3).double())
        for view, pose in zip(views, poses, strict=True)
    )
    assert len(merge_clouds([first, second], poses)) == 1200
    with pytest.warns(CloudWarning, match="clouds 0 and 1 were seen from one place"):
        merge_clouds([first, second], [poses[0], poses[0]])
    assert len(merge_clouds([first, first], [poses[0], poses[0]])) == 1200
    # cameras that are guessed tell nothing about a place
    nowhere = PointCloud(first.points)
    with pytest.warns(CloudWarning, match=r"clouds: the cameras of \[0, 1\] are guessed") as told:
        assert len(merge_clouds([nowhere, nowhere], [EYE, EYE])) == 1200
    assert len(told) == 1


def test_a_guessed_camera_is_told_where_it_counts_as_given(two_views):
    first, second = two_views
    unknown = PointCloud(second.points)
    with pytest.warns(CloudWarning, match=r"clouds: the cameras of \[1\] are guessed.*viewpoint"):
        merge_clouds([first, unknown], [EYE, EYE])
    # a surface whose normals are known needs no camera
    surface = clean_cloud(second)
    surface = PointCloud(surface.points, surface.normals)
    assert merge_clouds([first, surface], [EYE, EYE]).viewpoint is None


def test_two_views_that_were_given_each_other_s_pose_are_refused():
    mesh = load_object("jug").mesh
    poses = [look_at(azimuth, 40.0, 0.6, mesh).double() for azimuth in (0.0, 60.0)]
    views = [partial_view(mesh, pose, n=700) for pose in poses]
    camera = torch.zeros(3, dtype=torch.float64)
    own = [
        PointCloud(apply(inverse(pose), view.points), None, camera)
        for view, pose in zip(views, poses, strict=True)
    ]
    assert len(merge_clouds(own, poses)) == 1400
    with pytest.raises(BadArgument, match="expected views of one object that agree"):
        merge_clouds(own, poses[::-1])


def around(mesh, azimuths, noise="realsense"):
    return [
        partial_view(mesh, look_at(a, 40.0, 0.6, mesh), n=700, noise=noise, seed=k)
        for k, a in enumerate(azimuths)
    ]


def shift(*offset):
    pose = EYE.clone()
    pose[:3, 3] = torch.tensor(offset)
    return pose


def turn_about(point, degrees):
    """Return the turn about a horizontal axis through a point."""
    pose = EYE.clone()
    pose[:3, :3] = rotation_from_vector(torch.tensor([math.radians(degrees), 0.0, 0.0]).double())
    pose[:3, 3] = point - pose[:3, :3] @ point
    return pose


def stated_distances(error):
    """Return the residual and the limit [mm] that an error names."""
    return [float(x) for x in re.findall(r"([\d.]+) mm", str(error.value))][::-1]


def test_views_of_one_object_that_agree_pass_whatever_the_sensor():
    sensors = {"cylinder": ("realsense", "kinect_v1"), "spray": ("azure", "zivid")}
    for name, noises in sensors.items():
        mesh = load_object(name).mesh
        for noise in noises:
            views = around(mesh, (20.0, 95.0, 200.0), noise)
            assert len(merge_clouds(views, [EYE] * 3)) == 2100


@pytest.mark.parametrize("name", ["cylinder", "jug"])
def test_views_that_disagree_beyond_their_noise_are_refused_with_both_numbers(name):
    mesh = load_object(name).mesh
    middle = torch.tensor(mesh.centroid)
    first, second, third = around(mesh, (0.0, 70.0, 140.0))
    wrong = (
        shift(0.02, 0.0, 0.0),
        shift(0.0, 0.02, 0.0),
        shift(0.0, 0.0, 0.02),
        shift(0.08, 0.0, 0.0),
        shift(0.0, -0.5, 0.0),
        turn_about(middle, 25.0),
    )
    for pose in wrong:
        with pytest.raises(BadArgument, match="mm apart: check their poses") as error:
            merge_clouds([first, second], [EYE, pose])
        residual, limit = stated_distances(error)
        assert residual > limit > 5.0
        # any number of views, in any order: the wrong one is named
        with pytest.raises(BadArgument, match=r"views (0 and 1|1 and 2)"):
            merge_clouds([third, second, first], [EYE, pose, EYE])


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_views_of_several_scales_are_refused(factor):
    first, second = around(load_object("jug").mesh, (0.0, 70.0))
    scaled = PointCloud(factor * second.points, None, factor * second.viewpoint)
    with pytest.raises(BadArgument, match="check their poses"):
        merge_clouds([first, scaled], [EYE, EYE])


def test_the_distance_of_views_is_that_of_their_surfaces():
    """An upward shift is the distance of the two tops."""
    mesh = load_object("cylinder").mesh
    views = around(mesh, (0.0, 10.0), noise=False)
    for metres in (0.015, 0.03):
        with pytest.raises(BadArgument) as error:
            merge_clouds(views, [EYE, shift(0.0, 0.0, metres)])
        assert stated_distances(error)[0] == pytest.approx(1e3 * metres, rel=0.35)


@pytest.mark.filterwarnings("ignore:clouds. the cameras of")
def test_views_without_cameras_are_compared_where_they_overlap():
    mesh = load_object("jug").mesh
    views = [PointCloud(view.points) for view in around(mesh, (0.0, 70.0))]
    assert len(merge_clouds(views, [EYE, EYE])) == 1400
    with pytest.raises(BadArgument, match="check their poses"):
        merge_clouds(views, [EYE, shift(0.02, 0.0, 0.0)])


def test_merged_views_are_compared_one_by_one():
    first, second, third = around(load_object("jug").mesh, (0.0, 70.0, 140.0))
    pair = merge_clouds([first, third], [EYE, EYE])
    assert len(merge_clouds([pair, second], [EYE, EYE])) == 2100
    with pytest.raises(BadArgument, match="check their poses"):
        merge_clouds([pair, second], [EYE, shift(0.02, 0.0, 0.0)])
