import pytest
import torch

from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.errors import BadArgument, SuspiciousScale, TooFewPoints
from torchgrasp.values import PointCloud


def cloud(n=50, scale=0.1):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * scale


def test_a_good_cloud_passes_unchanged():
    for points in (cloud(), cloud() * torch.tensor([1.0, 1.0, 0.0]), cloud().float() + 3):
        value = PointCloud(points, torch.ones_like(points), torch.ones_like(points[0]))
        assert check_cloud(value) is value


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        *[(1e-6, "normalised"), (1e-3, "normalised"), (0.04, "normalised"), (25.0, "whole scene.*--unit cm")],
        *[(110.0, "--unit cm"), (1e3, "--unit mm"), (1e6, "--unit mm")],
    ],
)
def test_a_wrong_unit_is_named(factor, words):
    with pytest.raises(SuspiciousScale, match=words):
        check_cloud(PointCloud(cloud() * factor))


def test_of_a_large_cloud_too_few_distinct_points_are_found():
    """A part of the rows holds too few; then all are looked at."""
    points = cloud(2).repeat(30_000, 1)
    with pytest.raises(TooFewPoints, match="2 distinct"):
        check_cloud(PointCloud(points))
    points[[1, 3]] = cloud(9)[5:7]
    assert len(check_cloud(PointCloud(points))) == 60_000


def test_coincident_few_and_collinear_points_are_refused():
    with pytest.raises(BadArgument, match="coincide"):
        check_cloud(PointCloud(cloud(1).repeat(50, 1)))
    with pytest.raises(TooFewPoints, match="3 distinct"):
        check_cloud(PointCloud(cloud(3).repeat(50, 1)))
    with pytest.raises(BadArgument, match="one line"):
        check_cloud(PointCloud(torch.linspace(0, 0.1, 50).double()[:, None] * torch.tensor([1.0, 2.0, -1.0]).double()))
    with pytest.raises(BadArgument, match="length zero"):
        check_cloud(PointCloud(cloud(), torch.zeros(50, 3)))


def test_what_is_no_cloud_and_what_requires_a_gradient_is_refused():
    with pytest.raises((BadArgument, TypeError), match="cloud"):  # TypeError: the annotations are checked in tests
        check_cloud(cloud())  # pyright: ignore[reportArgumentType]
    with pytest.raises(BadArgument, match=r"points\.detach\(\)"):
        check_cloud(PointCloud(cloud().requires_grad_()))
    with pytest.raises(BadArgument, match=r"viewpoint\.detach\(\)"):
        check_cloud(PointCloud(cloud(), None, cloud(1)[0].requires_grad_()))


def test_numbers_spoilt_after_the_value_was_made_are_found():
    value = PointCloud(cloud())
    value.points[3, 1] = float("inf")
    with pytest.raises(BadArgument, match=r"index \[3, 1\]"):
        check_cloud(value)


def test_duplicates_are_reduced_to_the_first_in_order():
    points, copies = cloud(40), torch.randint(0, 40, (200,), generator=torch.Generator().manual_seed(1))
    order = torch.cat([torch.arange(40).flip(0), copies])
    jitter = 1e-12 * torch.randn(240, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    kept = remove_duplicates(PointCloud((points[order] + jitter), points[order] + 1, points[0]))
    torch.testing.assert_close(kept.points, points.flip(0), rtol=0, atol=1e-11)
    torch.testing.assert_close(kept.normals, points.flip(0) + 1)


def test_many_near_copies_of_one_point_are_one_point_and_points_a_little_apart_are_not():
    """A pair of points for every two copies would be 5e9 pairs here."""
    copies = cloud(1) + 1e-11 * torch.rand(100_000, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    apart = cloud(1) + 3e-10 * torch.arange(1, 4, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    kept = remove_duplicates(PointCloud(torch.cat([cloud(9), copies, apart])))
    assert torch.equal(kept.points, torch.cat([cloud(9), apart]))
    with pytest.raises(TooFewPoints, match="2 distinct"):
        remove_duplicates(PointCloud(cloud(2).repeat(5, 1)))
