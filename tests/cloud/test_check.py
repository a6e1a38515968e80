import numpy as np
import pytest
import torch

from tests.make import real
from torchgrasp.cloud.check import (
    check_cloud,
    coordinate_step,
    remove_duplicates,
    remove_outliers,
    voxel_downsample,
    warn_of_step,
)
from torchgrasp.cloud.diagnose import diagnose_cloud
from torchgrasp.cloud.read import read_cloud, save_cloud
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.foundation.errors import BadArgument, CloudWarning, SuspiciousScale, TooFewPoints
from torchgrasp.values.planning import PointCloud


def cloud(n=50, scale=0.1, seed=0):
    return (
        torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * scale
    )


def test_check_cloud_returns_a_good_cloud_itself():
    for points in (cloud(), cloud() * real([1.0, 1.0, 0.0]), cloud().float() + 3):
        value = PointCloud(points, torch.ones_like(points), torch.ones_like(points[0]))
        assert check_cloud(value) is value


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        *[
            (1e-6, "normalised, or in m .--unit m"),
            (0.04, "normalised, or in m .--unit m"),
            (25.0, "whole scene.*--unit cm"),
            (60.0, "whole scene.*--unit cm"),
            (110.0, "cloud in cm.*--unit cm"),
        ],
        *[(1e3, "--unit mm"), (1e6, "--unit mm")],
    ],
)
def test_check_cloud_names_a_wrong_unit(factor, words):
    with pytest.raises(SuspiciousScale, match=words):
        check_cloud(PointCloud(cloud() * factor))


@pytest.mark.parametrize("unit", [100.0, 1000.0])
def test_check_cloud_refuses_a_camera_in_another_unit_than_the_points(unit):
    """Its noise would grow with the squared distance, and hide a table above the foot."""
    for name in list_objects():
        view = load_object(name).view
        assert view.viewpoint is not None
        check_cloud(view)
        each = (unit * view.viewpoint).expand(len(view), 3).clone()
        for viewpoint in (unit * view.viewpoint, each):
            with pytest.raises(BadArgument, match=r"viewpoint: .* within 50 m .* in metres"):
                check_cloud(PointCloud(view.points, None, viewpoint))
    check_cloud(PointCloud(cloud(), None, real([0.0, 0.0, 49.0])))


def test_check_cloud_finds_few_distinct_points_among_many_copies():
    points = cloud(2).repeat(30_000, 1)
    with pytest.raises(TooFewPoints, match="2 distinct"):
        check_cloud(PointCloud(points))
    points[[1, 3]] = cloud(9)[5:7]  # the sample of the rows misses them
    assert len(check_cloud(PointCloud(points))) == 60_000


def test_check_cloud_refuses_zero_normals_other_values_gradients_and_later_changes():
    with pytest.raises(BadArgument, match="length zero"):
        check_cloud(PointCloud(cloud(), torch.zeros(50, 3)))
    with pytest.raises(
        (BadArgument, TypeError), match="cloud"
    ):  # TypeError: the annotations are checked in tests
        check_cloud(cloud())  # pyright: ignore[reportArgumentType]
    for value, name in (
        (PointCloud(cloud().requires_grad_()), "points"),
        (PointCloud(cloud(), None, cloud(1)[0].requires_grad_()), "viewpoint"),
    ):
        with pytest.raises(BadArgument, match=rf"{name}\.detach\(\)"):
            check_cloud(value)
    value = PointCloud(cloud())
    value.points[3, 1] = float("inf")
    with pytest.raises(BadArgument, match=r"index \[3, 1\]"):
        check_cloud(value)


def test_remove_duplicates_keeps_the_first_in_order():
    points = cloud(40)
    copies = torch.randint(0, 40, (200,), generator=torch.Generator().manual_seed(1))
    order = torch.cat([torch.arange(40).flip(0), copies])
    jitter = 1e-12 * torch.randn(
        240, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    kept = remove_duplicates(PointCloud((points[order] + jitter), points[order] + 1, points[0]))
    torch.testing.assert_close(kept.points, points.flip(0), rtol=0, atol=1e-11)
    torch.testing.assert_close(kept.normals, points.flip(0) + 1)


def test_remove_duplicates_of_many_copies_keeps_points_a_little_apart():
    """A pair of points for every two copies would be 5e9 pairs here."""
    copies = cloud(1) + 1e-11 * cloud(100_000, 1.0, seed=3)
    apart = cloud(1) + 3e-10 * torch.arange(1, 4, dtype=torch.float64)[:, None] * real(
        [1.0, 0.0, 0.0]
    )
    kept = remove_duplicates(PointCloud(torch.cat([cloud(9), copies, apart])))
    assert torch.equal(kept.points, torch.cat([cloud(9), apart]))


def test_voxel_downsample_keeps_the_point_nearest_to_each_centre():
    points = cloud(3000)
    thin = voxel_downsample(PointCloud(points, points + 1.0, points[0]), 0.02)
    voxels = {}  # the oracle: a dictionary from voxel to its points
    for i, place in enumerate(((points - points.amin(0)) / 0.02).tolist()):
        key = tuple(int(x) for x in place)
        far = sum((x - k - 0.5) ** 2 for x, k in zip(place, key, strict=True))
        voxels[key] = min(voxels.get(key, (9.0, -1)), (far, i))
    rows = sorted(i for _, i in voxels.values())
    assert torch.equal(thin.points, points[rows]) and torch.equal(thin.normals, points[rows] + 1.0)
    assert torch.equal(thin.viewpoint, points[0])
    assert torch.equal(voxel_downsample(PointCloud(thin.points), 1e-5).points, thin.points)


def test_voxel_downsample_moves_and_scales_with_the_cloud_and_keeps_the_dtype():
    points = load_object("jug").view.points
    shift = real([3.0, -2.0, 5.0])
    rows = voxel_downsample(PointCloud(points), 0.01).points
    moved = voxel_downsample(PointCloud(points + shift), 0.01).points
    torch.testing.assert_close(moved - shift, rows, atol=1e-12, rtol=0)
    assert torch.equal(voxel_downsample(PointCloud(4 * points), 0.04).points, 4 * rows)
    assert voxel_downsample(PointCloud(points.float()), 0.01).points.dtype == torch.float32


@pytest.mark.parametrize("voxel", [0.0, -1.0, float("nan"), float("inf"), 1e-6, 1.0])
def test_voxel_downsample_refuses_a_voxel_out_of_range_or_too_large(voxel):
    with pytest.raises(BadArgument, match="1 voxels of 1 m" if voxel == 1.0 else "voxel"):
        voxel_downsample(load_object("jug").view, voxel)


@pytest.mark.parametrize("name", list_objects())
def test_remove_outliers_removes_hardly_anything_else(name):
    view = load_object(name).view
    directions = torch.randn(10, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    far = view.points.mean(0) + 0.4 * directions / torch.linalg.vector_norm(
        directions, dim=-1, keepdim=True
    )
    clean = remove_outliers(PointCloud(torch.cat([view.points, far]), None, view.viewpoint))
    assert not bool((torch.cdist(clean.points, far) == 0).any())
    assert len(clean) > 0.96 * len(view) and torch.equal(clean.viewpoint, view.viewpoint)


def rounded(points, digits):
    return torch.from_numpy(np.round(points.numpy(), digits))


def test_coordinates_of_large_steps_are_told():
    """Far from the origin float32 has few digits, as a text of two decimals has."""
    points = 0.1 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).double()
    far = points + torch.tensor([432_100.0, 5_412_300.0, 230.0]).double()
    assert coordinate_step(points) == coordinate_step(far) == 0.0
    assert coordinate_step(far.float()) == 0.5  # 2**-23 of a number from 2**22 on
    assert coordinate_step((points + 40_000.0).float()) == 2.0**-8
    assert coordinate_step(points.float()) == coordinate_step(rounded(points, 3)) == 0.0
    assert coordinate_step(rounded(points, 2)) == 0.01
    for cloud in (PointCloud(rounded(points, 2)), PointCloud((points + 70_000.0).float())):
        assert any("coordinates in steps of" in str(x) for x in diagnose_cloud(cloud).advice)
        with pytest.warns(CloudWarning, match=r"points: coordinates in steps of \d+"):
            warn_of_step(cloud.points)


def test_a_ply_far_from_the_origin_keeps_its_digits(tmp_path):
    far = 0.1 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).double() + 432_100.0
    read = read_cloud(save_cloud(PointCloud(far), tmp_path / "far.ply"))
    assert torch.equal(read.points, far)
