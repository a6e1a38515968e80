"""Fewer points: one a voxel, or without the outliers."""

from typing import Annotated

import torch

from torchgrasp.checks import Range, checked
from torchgrasp.cloud.check import MIN_POINTS, check_cloud, first_of_each, remove_duplicates
from torchgrasp.cloud.neighbours import find_inliers
from torchgrasp.errors import TooFewPoints
from torchgrasp.values import PointCloud


@checked
def voxel_downsample(cloud: PointCloud, voxel: Annotated[float, Range(1e-5, 1.0)]) -> PointCloud:
    """Return one point a voxel, the nearest to its centre, for voxels of a side [m] in [1e-5, 1].

    The grid starts at the cloud's lowest corner and moves with it. Points are not averaged, as a mean may lie
    inside a thin wall. Their order is kept.

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`; a voxel outside its range.
        TooFewPoints: fewer than 4 voxels hold points.

    >>> len(voxel_downsample(PointCloud(0.1 * torch.rand(5000, 3)), 0.05)) <= 27
    True
    """
    cloud = check_cloud(cloud)
    points = cloud.points.double()
    place = (points - points.amin(0)) / voxel
    cell = torch.floor(place)
    _, group = torch.unique(cell, dim=0, return_inverse=True)
    order = torch.argsort(torch.linalg.vector_norm(place - cell - 0.5, dim=-1), stable=True)
    rows = order[first_of_each(group[order])].sort().values
    if len(rows) < MIN_POINTS:
        raise TooFewPoints("points", f"{len(rows)} voxels of {voxel:g} m", f"at least {MIN_POINTS}")
    return cloud.select(rows)


@checked
def remove_outliers(cloud: PointCloud) -> PointCloud:
    """Return a cloud without copies and outliers, such as flying pixels.

    Outliers have a mean distance to 8 neighbours above 2.5 times the median.

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`.
        TooFewPoints: fewer than 4 points, before or after.

    >>> points = torch.cat([0.1 * torch.rand(500, 3), torch.ones(1, 3)])
    >>> bool(remove_outliers(PointCloud(points)).points.max() < 0.2)
    True
    """
    cloud = remove_duplicates(cloud)
    return cloud.select(find_inliers(cloud.points.double()))
