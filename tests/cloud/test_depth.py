import numpy as np
import pytest
import torch

from torchgrasp.cloud.depth import cloud_from_depth, read_depth
from torchgrasp.errors import BadArgument, SuspiciousScale, TooFewPoints
from torchgrasp.geometry.frames import rigid, rotation_from_vector

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


def test_the_frustum_goes_through_the_outermost_pixels():
    pose = rigid(rotation_from_vector(torch.tensor([0.3, -1.0, 2.0]).double()), torch.tensor([0.1, 0.2, -0.3]).double())
    cloud = cloud_from_depth(tilted_depth(), K, camera_pose=pose)
    height = ((cloud.points - cloud.viewpoint) @ cloud.frustum.T).reshape(48, 64, 4)
    assert float(height.min()) > -1e-12
    for border, side in ((height[:, 0], 0), (height[:, -1], 1), (height[0], 2), (height[-1], 3)):
        torch.testing.assert_close(border[:, side], torch.zeros(len(border)).double(), atol=1e-12, rtol=0)


def test_pixels_without_depth_or_outside_the_mask_are_left_out():
    depth, mask = tilted_depth(), torch.zeros(48, 64, dtype=torch.bool)
    depth[0, 0], depth[0, 1], depth[0, 2] = 0.0, float("nan"), float("inf")
    assert len(cloud_from_depth(depth, K)) == 48 * 64 - 3
    mask[10:20, 5:25] = True
    assert len(cloud_from_depth(depth, K, mask)) == 200
    assert cloud_from_depth(depth.float(), K.float(), mask).points.dtype == torch.float32


@pytest.mark.parametrize("make", [np.asarray, torch.from_numpy])
def test_arrays_and_tensors_of_any_kind_give_the_same_cloud(make):
    depth = tilted_depth().numpy()
    depth[3, 4] = 0.0
    mm = np.round(1000 * depth).astype(np.uint16)
    mask = np.arange(48 * 64).reshape(48, 64) % 3 == 0
    exact = cloud_from_depth(torch.from_numpy(mm / 1000.0), K, torch.from_numpy(mask))
    for kind in (bool, np.uint8):
        for k in (make(K.numpy()), (600.0, 550.0, 30.0, 20.0), np.float32([600, 550, 30, 20])):
            cloud = cloud_from_depth(make(mm), k, make(mask.astype(kind)), np.eye(4))
            assert torch.equal(cloud.points, exact.points)
    infinite = np.where(depth > 0, depth, np.inf).astype(np.float32)
    assert torch.equal(read_depth(make(infinite), K)[0] > 0, torch.from_numpy(depth > 0))
    assert float(read_depth(make(mm.astype(np.int32)), K)[0].max()) == mm.max() / 1000


REFUSED = {
    "depth in mm": (lambda d: ((1000 * d), K), "depth.*are these mm"),
    "negative depth": (lambda d: (-d, K), "depth.*depths >= 0"),
    "a colour image": (lambda d: (d.expand(3, -1, -1), K), "depth.*of shape"),
    "8 bit depth": (lambda d: ((200 * d).to(torch.uint8), K), "depth.*uint16"),
    "mask of another size": (lambda d: (d, K, torch.ones(24, 32, dtype=torch.bool)), r"mask.*\(48, 64\)"),
    "empty mask": (lambda d: (d, K, np.zeros((48, 64), dtype=np.uint8)), "mask.*no pixel"),
    "floating mask": (lambda d: (d, K, d), "mask.*bool or uint8"),
    "intrinsics of twice the size": (lambda d: (d, (1200.0, 1100.0, 64.0, 48.0)), r"intrinsics.*\(64.0, 48.0\) px"),
    "intrinsics of half the size": (lambda d: (d, (300.0, 275.0, 16.0, 12.0)), "intrinsics.*same resolution"),
    "intrinsics of 848 x 480 for 640 x 480": (lambda d: (d, (600.0, 600.0, 42.4, 24.0)), "intrinsics.*same resolution"),
    "transposed intrinsics": (lambda d: (d, K.T), "intrinsics.*fx, fy"),
    "three intrinsics": (lambda d: (d, (600.0, 30.0, 20.0)), "intrinsics.*fx, fy, cx, cy"),
    "intrinsics of words": (lambda d: (d, ["f", "f", "c", "c"]), "intrinsics"),
    "NaN intrinsics": (lambda d: (d, (600.0, float("nan"), 30.0, 20.0)), "intrinsics.*nan"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_image_is_refused_in_one_sentence(name):
    make, words = REFUSED[name]
    with pytest.raises((BadArgument, TypeError), match=words):  # TypeError: the annotations are checked in tests
        read_depth(*make(tilted_depth()))


def test_refusals():
    depth, eye = tilted_depth(), torch.eye(4, dtype=torch.float64)
    with pytest.raises(SuspiciousScale, match="scene"):
        cloud_from_depth(depth * 80, K)
    with pytest.raises(TooFewPoints, match="3 measured"):
        cloud_from_depth(depth, K, torch.arange(48 * 64).reshape(48, 64) < 3)
    for spoilt in (2 * eye, torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])).double(), eye + torch.nan):
        with pytest.raises(BadArgument, match="camera_pose"):
            cloud_from_depth(depth, K, camera_pose=spoilt)
