import numpy as np
import pytest
import torch
import trimesh

from torchgrasp.cloud.camera import INTRINSICS, add_noise, cast_mesh, look_at, partial_view, render_depth
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.errors import BadArgument


@pytest.fixture(scope="module")
def boxes():
    near, far = trimesh.creation.box([0.06, 0.08, 0.10]), trimesh.creation.box([0.08, 0.08, 0.20])
    return [near.apply_translation([0.05, 0.0, 0.05]), far.apply_translation([-0.08, 0.0, 0.10])]


def test_exact_depths_lie_on_the_labelled_mesh_or_the_table(boxes):
    pose = look_at(10.0, 40.0, 0.7)
    depth, labels = render_depth(boxes, pose, noise=False)
    for k in (0, 1, 2):
        points = cloud_from_depth(torch.where(labels == k, depth, 0.0), INTRINSICS, camera_pose=pose).points
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
    np.testing.assert_array_equal(np.sort(cloud.points[:, 0].numpy()), np.sort(whole.points[:, 0].numpy()))
    assert torch.equal(labels, render_depth(boxes[:1], pose, table=None, noise=False)[1])


def test_refusals(boxes):
    with pytest.raises(BadArgument, match="camera_pose"):
        render_depth(boxes, 2 * look_at(0.0, 30.0))
