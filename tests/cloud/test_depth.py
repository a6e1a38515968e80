import pytest
import torch

from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.errors import BadArgument, SuspiciousScale, TooFewPoints
from torchgrasp.frames import rigid, rotation_from_vector

K = torch.tensor([[600.0, 0, 30], [0, 550.0, 20], [0, 0, 1]], dtype=torch.float64)


def tilted_depth():
    """Depth of the plane n.p = 0.5 for n = (0.1, -0.2, 1), in closed form."""
    v, u = torch.meshgrid(torch.arange(48.0).double(), torch.arange(64.0).double(), indexing="ij")
    return 0.5 / (1 + 0.1 * (u - 30) / 600 - 0.2 * (v - 20) / 550)


def test_points_lie_on_the_plane_that_the_depth_was_made_from():
    cloud = cloud_from_depth(tilted_depth(), K)
    assert len(cloud) == 48 * 64
    plane = cloud.points @ torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)
    torch.testing.assert_close(plane, torch.full_like(plane, 0.5))
    assert cloud.points[0, 0] < 0  # the left column lies to the left
    assert cloud.viewpoint.tolist() == [0, 0, 0]


def test_the_pose_moves_points_and_viewpoint_alike():
    pose = rigid(rotation_from_vector(torch.tensor([0.3, -1.0, 2.0]).double()), torch.tensor([0.1, 0.2, -0.3]).double())
    still, moved = cloud_from_depth(tilted_depth(), K), cloud_from_depth(tilted_depth(), K, camera_pose=pose)
    torch.testing.assert_close(moved.points, still.points @ pose[:3, :3].T + pose[:3, 3])
    torch.testing.assert_close(moved.viewpoint, pose[:3, 3])


def test_pixels_without_depth_or_outside_the_mask_are_left_out():
    depth, mask = tilted_depth(), torch.zeros(48, 64, dtype=torch.bool)
    depth[0, 0], depth[0, 1], depth[0, 2] = 0.0, float("nan"), float("inf")
    assert len(cloud_from_depth(depth, K)) == 48 * 64 - 3
    mask[10:20, 5:25] = True
    assert len(cloud_from_depth(depth, K, mask)) == 200
    assert cloud_from_depth(depth.float(), K.float(), mask).points.dtype == torch.float32


def test_refusals():
    depth, eye = tilted_depth(), torch.eye(4, dtype=torch.float64)
    with pytest.raises(SuspiciousScale, match="mm"):
        cloud_from_depth(depth * 1000, K)
    with pytest.raises(TooFewPoints, match="3 measured"):
        cloud_from_depth(depth, K, torch.arange(48 * 64).reshape(48, 64) < 3)
    with pytest.raises(BadArgument, match="depths >= 0"):
        cloud_from_depth(-depth, K)
    with pytest.raises((BadArgument, TypeError), match="depth"):  # TypeError: the annotations are checked in tests
        cloud_from_depth(depth.tolist(), K)
    with pytest.raises((BadArgument, TypeError), match="mask"):
        cloud_from_depth(depth, K, (depth > 0).tolist())
    with pytest.raises(BadArgument, match="intrinsics"):
        cloud_from_depth(depth, K.T)
    for spoilt in (2 * eye, torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])).double(), eye + torch.nan):
        with pytest.raises(BadArgument, match="camera_pose"):
            cloud_from_depth(depth, K, camera_pose=spoilt)
