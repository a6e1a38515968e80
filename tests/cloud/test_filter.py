import pytest
import torch

from torchgrasp.cloud.check import remove_outliers, voxel_downsample
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.errors import BadArgument, TooFewPoints
from torchgrasp.values import PointCloud


def test_one_measured_point_a_voxel_in_order_with_its_normal():
    generator = torch.Generator().manual_seed(0)
    points = 0.1 * torch.rand(3000, 3, generator=generator, dtype=torch.float64)
    cloud = PointCloud(points, points + 1.0, points[0])
    thin = voxel_downsample(cloud, 0.02)
    # the oracle: a dictionary from voxel to its points, the nearest to the centre of each
    voxels = {}
    for i, place in enumerate(((points - points.amin(0)) / 0.02).tolist()):
        key = tuple(int(x) for x in place)
        far = sum((x - k - 0.5) ** 2 for x, k in zip(place, key, strict=True))
        voxels[key] = min(voxels.get(key, (9.0, -1)), (far, i))
    rows = sorted(i for _, i in voxels.values())
    assert torch.equal(thin.points, points[rows])
    assert torch.equal(thin.normals, points[rows] + 1.0)
    assert torch.equal(thin.viewpoint, points[0])
    again = voxel_downsample(PointCloud(thin.points), 1e-5)
    assert torch.equal(again.points, thin.points)


def test_thinning_moves_and_scales_with_the_cloud_and_keeps_the_dtype():
    cloud = load_object("jug").view
    rows = voxel_downsample(cloud, 0.01)
    moved = voxel_downsample(PointCloud(cloud.points + torch.tensor([3.0, -2.0, 5.0]).double()), 0.01)
    large = voxel_downsample(PointCloud(4 * cloud.points), 0.04)
    torch.testing.assert_close(moved.points - torch.tensor([3.0, -2.0, 5.0]).double(), rows.points, atol=1e-12, rtol=0)
    assert torch.equal(large.points, 4 * rows.points)
    assert voxel_downsample(PointCloud(cloud.points.float()), 0.01).points.dtype == torch.float32


@pytest.mark.parametrize("voxel", [0.0, -1.0, float("nan"), float("inf"), 1e-6])
def test_a_voxel_out_of_range_is_refused(voxel):
    with pytest.raises(BadArgument, match="voxel"):
        voxel_downsample(load_object("jug").view, voxel)


def test_too_large_a_voxel_is_named():
    with pytest.raises(TooFewPoints, match=r"1 voxels of 1 m"):
        voxel_downsample(load_object("jug").view, 1.0)


@pytest.mark.parametrize("name", list_objects())
def test_outliers_go_and_hardly_anything_else(name):
    view = load_object(name).view
    directions = torch.randn(10, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    far = view.points.mean(0) + 0.4 * directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
    clean = remove_outliers(PointCloud(torch.cat([view.points, far]), None, view.viewpoint))
    assert not bool((torch.cdist(clean.points, far) == 0).any())
    assert len(clean) > 0.96 * len(view)
    assert torch.equal(clean.viewpoint, view.viewpoint)
