import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.neighbours import fit_planes
from torchgrasp.cloud.prepare import compare_normals, estimate_normals, guess_viewpoint, share_facing
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values import PointCloud


def surface(mesh, n, seed=0):
    points, face = trimesh.sample.sample_surface(mesh, n, seed=seed)
    return PointCloud(torch.from_numpy(np.asarray(points)), torch.from_numpy(mesh.face_normals[face].copy()))


def check_normals(cloud):
    return compare_normals(cloud.points, cloud.normals)


def estimate_viewpoint(cloud):
    return guess_viewpoint(cloud.points, fit_planes(cloud.points)[0])


def flip(cloud, share, seed=0):
    """Flip a share of the normals, and tell which."""
    flipped = torch.rand(len(cloud), generator=torch.Generator().manual_seed(seed), dtype=torch.float64) < share
    return PointCloud(
        cloud.points, torch.where(flipped[:, None], -cloud.normals, cloud.normals), cloud.viewpoint
    ), flipped


@pytest.mark.promise("I8")
@pytest.mark.parametrize("name", list_objects())
def test_flips_are_reported_and_good_normals_are_not(name):
    thing = load_object(name)
    for cloud in (surface(thing.mesh, 1000), estimate_normals(thing.view)):
        good = check_normals(cloud)
        assert good.oriented and good.scaled == 0 and good.opposed < 0.03
        assert float(good.flipped.double().mean()) < 0.04
        spoilt, flipped = flip(cloud, 0.1)
        found = check_normals(spoilt)
        assert found.oriented and 0.1 < found.opposed < 0.25
        assert float((found.flipped == flipped).double().mean()) > 0.95
        assert not check_normals(flip(cloud, 0.5)[0]).oriented


def test_a_thin_plate_and_a_coarse_ball_are_oriented():
    assert check_normals(surface(trimesh.creation.box((0.15, 0.2, 0.002)), 1000)).oriented
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    assert check_normals(PointCloud(0.05 * axes, axes)).oriented


def test_a_view_with_normals_of_random_signs_is_still_a_view():
    view = load_object("cylinder").view
    signs, _ = flip(estimate_normals(view), 0.5)
    probes = view.points[:20] * torch.tensor([-1.0, -1.0, 1.0]).double()
    found, wanted = fit_shape(signs, table=0.0).predict(probes), fit_shape(view, table=0.0).predict(probes)
    torch.testing.assert_close(found.distance, wanted.distance, atol=1e-6, rtol=0)


@pytest.fixture(scope="module")
def ball_view():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    return partial_view(ball, look_at(20.0, 30.0, target=ball), noise=False)


def test_the_guess_follows_a_rigid_motion_and_finds_the_camera(ball_view):
    for seed in range(3):
        turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
        moved = PointCloud(ball_view.points @ turn.T + 0.3)
        camera = ball_view.viewpoint @ turn.T
        guess = estimate_viewpoint(moved) - 0.3
        angle = torch.arccos(guess @ camera / torch.linalg.vector_norm(guess) / torch.linalg.vector_norm(camera))
        assert torch.rad2deg(angle) < 25


def test_a_cloud_in_the_frame_of_its_camera_was_seen_from_the_origin():
    thing = load_object("jug")
    pose = look_at(60.0, 35.0, target=thing.mesh)
    torch.testing.assert_close(pose[:3, 3], thing.view.viewpoint, atol=1e-6, rtol=0)
    assert estimate_viewpoint(PointCloud(apply(inverse(pose), thing.view.points))).tolist() == [0, 0, 0]


@pytest.mark.parametrize("name", list_objects())
def test_a_view_faces_its_camera_and_a_whole_surface_does_not(name):
    view = estimate_normals(load_object(name).view)
    assert share_facing(view.points, view.normals, view.viewpoint) > 0.9
    both = torch.cat([view.normals, -view.normals])
    assert share_facing(view.points.repeat(2, 1), both, view.viewpoint) == pytest.approx(0.5)
    each = view.viewpoint.expand(len(view), 3)
    assert share_facing(view.points, view.normals, each) == share_facing(view.points, view.normals, view.viewpoint)
