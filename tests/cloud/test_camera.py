import numpy as np
import pytest
import torch
import trimesh

from torchgrasp.cloud.camera import INTRINSICS, cast_mesh, look_at, partial_view, render_depth
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.sensor import add_noise
from torchgrasp.foundation.errors import BadArgument, MeshError
from torchgrasp.geometry.frames import inverse


@pytest.fixture(scope="module")
def box():
    return trimesh.creation.box([0.06, 0.08, 0.10])


def pixels(cloud, pose):
    """Return the depths [m] of a view's points, and the columns and rows of their pixels."""
    x, y, z = (cloud.points @ inverse(pose)[:3, :3].T + inverse(pose)[:3, 3]).unbind(-1)
    return z, 616 * x / z + 319.5, 616 * y / z + 239.5


def test_look_at_is_a_rigid_upright_camera():
    for azimuth, elevation in [(0.0, 0.0), (123.0, 40.0), (-77.0, -20.0)]:
        pose = look_at(azimuth, elevation, 0.7, torch.tensor([0.1, 0.2, 0.3]))
        torch.testing.assert_close(pose @ inverse(pose), torch.eye(4, dtype=torch.float64))
        assert abs(torch.linalg.det(pose[:3, :3]).item() - 1) < 1e-12
        target = pose[:3, 3] + 0.7 * pose[:3, 2]
        torch.testing.assert_close(
            target, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64), atol=1e-7, rtol=0
        )
        assert pose[2, 1] < 0  # down in the image is down in the world
        assert abs(pose[2, 0]) < 1e-12  # and the horizon is level


def test_depth_of_a_sphere_agrees_with_the_closed_form():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.05)
    z, u, v = pixels(
        partial_view(ball, look_at(30.0, 20.0, 0.5), n=10**6, noise=False), look_at(30.0, 20.0, 0.5)
    )
    k = INTRINSICS
    ray = torch.stack(
        [(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones(len(u)).double()], -1
    )
    # |z ray - (0, 0, d)| = r
    a = (ray**2).sum(-1)
    b = -2 * 0.5
    c = 0.5**2 - 0.05**2
    root = b**2 - 4 * a * c
    inner = root > 0.001
    exact = (-b - root.clamp_min(0).sqrt()) / (2 * a)
    assert inner.float().mean() > 0.9
    assert (z - exact)[inner].abs().max() < 1e-4
    # the disc of its image: the cone that touches the sphere
    radius = k[0, 0] * 0.05 / np.sqrt(0.5**2 - 0.05**2)
    assert abs(len(u) / (np.pi * radius**2) - 1) < 0.01


def test_an_exact_view_lies_on_the_mesh_and_faces_the_camera(box):
    cloud = partial_view(box, look_at(35.0, 25.0, target=box), noise=False)
    assert len(cloud) == 1000
    assert cloud.normals is None
    _, distance, face = trimesh.proximity.closest_point(box, cloud.points.numpy())
    assert distance.max() < 1e-9
    toward = ((cloud.viewpoint - cloud.points).numpy() * box.face_normals[face]).sum(-1)
    assert toward.min() > 0
    assert abs(torch.linalg.vector_norm(cloud.viewpoint).item() - 0.5) < 1e-9


@pytest.mark.parametrize("kept", ["read before the scaling", "given"])
def test_a_mesh_with_normals_of_another_shape_is_seen_where_its_faces_are(kept):
    """Faces of a ball that was stretched: trimesh before 5.2 keeps the ball's normals."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    old = ball.face_normals.copy()
    ball.apply_scale([1.0, 1.0, 3.0])
    fresh = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    if kept == "given":
        old[:20] = fresh.face_normals[:20]  # trimesh refuses normals if one of the first 20 is off
        ball.face_normals = old
        assert np.abs(ball.face_normals - fresh.face_normals).max() > 0.3
    cloud = partial_view(ball, look_at(35.0, 25.0, target=ball), noise=False)
    # (x / a)^2 + (y / a)^2 + (z / 3 a)^2 = 1, less what the triangles cut off
    radius = torch.linalg.vector_norm(cloud.points / torch.tensor([1.0, 1.0, 3.0]), dim=-1)
    assert radius.max() < 0.04 + 1e-9
    assert radius.min() > 0.039


def test_noise_has_the_documented_size_and_is_repeatable(box):
    cloud, again, other = (partial_view(box, look_at(35.0, 25.0), seed=s) for s in (0, 0, 1))
    assert torch.equal(cloud.points, again.points)
    assert not torch.equal(cloud.points, other.points)
    distance = 1e3 * trimesh.proximity.closest_point(box, cloud.points.numpy())[1]
    assert 0.2 < np.median(distance) < 1.0
    assert 0.6 < np.percentile(distance, 90) < 2.5
    # errors act along the rays: the direction from the camera stays that of a pixel that sees the
    # box
    pose = look_at(35.0, 25.0, 0.5)
    _, u, v = pixels(cloud, pose)
    assert (u - u.round()).abs().max() < 1e-6
    _, column, row = pixels(partial_view(box, pose, n=10**6, noise=False), pose)
    seen = torch.zeros(480, 640, dtype=torch.bool)
    seen[row.round().long(), column.round().long()] = True
    assert seen[v.round().long(), u.round().long()].all()


def test_grazing_surfaces_fade_out():
    plate = trimesh.creation.box([0.2, 0.2, 0.01])
    shares = []
    for elevation in (60.0, 10.0, 2.0):
        pose = look_at(0.0, elevation, target=plate)
        exact = partial_view(plate, pose, n=10**6, noise=False)
        noisy = partial_view(plate, pose, n=10**6)
        shares.append(len(noisy) / len(exact))
        if elevation == 2.0:  # only the rim of the plate, seen head on, is left
            assert (noisy.points[:, 0] > 0.05).float().mean() > 0.9
    assert shares[0] > 0.85
    assert shares[1] < 0.75 * shares[0]


def test_a_camera_within_the_mesh_is_refused(box):
    """The pose is in metres, and the mesh in millimetres: the view would be that of its inside."""
    pose = look_at(60.0, 35.0, target=box)
    large = box.copy().apply_scale(1000.0)
    with pytest.raises(
        BadArgument, match=r"camera_pose: expected a camera outside .*metres.*within"
    ):
        partial_view(large, pose)
    assert len(partial_view(box, look_at(45.0, 35.0, 0.3, box)))  # one that is near


def test_fewer_pixels_than_points_give_all_pixels(box):
    far = partial_view(box, look_at(0.0, 0.0, 8.0), noise=False)
    _, u, v = pixels(far, look_at(0.0, 0.0, 8.0))
    assert (
        len(far) == (u.max() - u.min() + 1).round() * (v.max() - v.min() + 1).round() < 1000
    )  # a full rectangle
    assert len(far) == pytest.approx(616**2 * 0.08 * 0.10 / 7.97**2, rel=0.3)


@pytest.fixture(scope="module")
def boxes():
    near = trimesh.creation.box([0.06, 0.08, 0.10])
    far = trimesh.creation.box([0.08, 0.08, 0.20])
    return [near.apply_translation([0.05, 0.0, 0.05]), far.apply_translation([-0.08, 0.0, 0.10])]


def test_render_depth_exact_depths_lie_on_the_labelled_mesh_or_the_table(boxes):
    pose = look_at(10.0, 40.0, 0.7)
    depth, labels = render_depth(boxes, pose, noise=False)
    for k in (0, 1, 2):
        points = cloud_from_depth(
            torch.where(labels == k, depth, 0.0), INTRINSICS, camera_pose=pose
        ).points
        if k == 0:
            assert points[:, 2].abs().max() < 1e-9
            assert 0.4 < points[:, :2].norm(dim=-1).max() < 0.6
        else:
            distance = trimesh.proximity.closest_point(boxes[k - 1], points[::20].numpy())[1]
            assert distance.max() < 1e-9
    assert not render_depth(boxes, pose, table=None, noise=False)[0][labels == 0].any()


def test_a_nearer_thing_hides_another(boxes):
    pose = look_at(0.0, 20.0, 0.6)
    both = render_depth(boxes, pose, noise=False)[1] == 2
    alone = render_depth(boxes[1:], pose, noise=False)[1] == 1
    assert both.sum() < 0.9 * alone.sum()
    assert not (both & ~alone).any()


def test_the_noise_is_that_of_a_partial_view(boxes):
    pose = look_at(25.0, 45.0, 0.6)
    depth, labels = render_depth(boxes[:1], pose, table=None, seed=5)
    exact = add_noise(*cast_mesh(boxes[0], pose), torch.Generator().manual_seed(5))
    assert torch.equal(depth, exact)
    cloud = partial_view(boxes[0], pose, n=10**6, seed=5)
    whole = cloud_from_depth(depth, INTRINSICS, camera_pose=pose)
    np.testing.assert_array_equal(
        np.sort(cloud.points[:, 0].numpy()), np.sort(whole.points[:, 0].numpy())
    )
    assert torch.equal(labels, render_depth(boxes[:1], pose, table=None, noise=False)[1])


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda box: look_at(0.0, 90.0), BadArgument, "elevation"),
        (lambda box: look_at(float("nan"), 0.0, 0.5), BadArgument, "azimuth"),
        (lambda box: look_at(0.0, 0.0, distance=-1.0), BadArgument, "distance"),
        (lambda box: look_at(0.0, 0.0, target=trimesh.Trimesh()), MeshError, "target"),
        (lambda box: partial_view(box, look_at(0.0, 0.0), n=3), BadArgument, "n: expected .*got 3"),
        (lambda box: partial_view(box, 2 * look_at(0.0, 0.0)), BadArgument, "camera_pose"),
        (lambda box: partial_view(trimesh.Trimesh(), look_at(0.0, 0.0, 0.5)), MeshError, "mesh"),
        (lambda box: render_depth([box], 2 * look_at(0.0, 30.0)), BadArgument, "camera_pose"),
    ],
)
def test_wrong_arguments_are_refused_by_name(box, call, error, words):
    with pytest.raises(error, match=words):
        call(box)
