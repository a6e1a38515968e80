import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.orientation import estimate_viewpoint, share_facing
from torchgrasp.cloud.prepare import estimate_normals
from torchgrasp.frames import apply, inverse
from torchgrasp.objects import list_objects, load_object
from torchgrasp.values import PointCloud


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
