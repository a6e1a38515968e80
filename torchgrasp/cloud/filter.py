"""Fewer points: one a voxel, or none that stray."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.errors import BadArgument, TooFewPoints
from torchgrasp.values import PointCloud

OUTLIER_NEIGHBOURS = 8
"""Neighbours whose mean distance tells a stray point."""
OUTLIER_RATIO = 2.5
"""A point is stray when that distance is more than so many times the median one."""
MIN_VOXEL, MAX_VOXEL = 1e-5, 1.0
"""Sides [m] that a voxel may have."""


def voxel_downsample(cloud: PointCloud, voxel: float) -> PointCloud:
    """Return the cloud with one point a voxel: the one nearest to the voxel's centre, as it was measured.

    The grid starts at the lowest corner of the cloud, so that the choice moves with it. Points are chosen, not
    averaged: a mean of the two sides of a thin wall lies on neither. The order of the points is kept.

    Args:
        cloud: points [m], with or without normals and viewpoint.
        voxel: side of a voxel [m], in [1e-5, 1].

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`; a voxel outside its range.
        TooFewPoints: fewer than 4 voxels hold points.

    >>> len(voxel_downsample(PointCloud(0.1 * torch.rand(5000, 3)), 0.05)) <= 27
    True
    """
    cloud = check_cloud(cloud)
    if not MIN_VOXEL <= voxel <= MAX_VOXEL:  # also refuses NaN
        raise BadArgument("voxel", voxel, f"a side in [{MIN_VOXEL:g}, {MAX_VOXEL:g}] m")
    points = cloud.points.double()
    place = (points - points.amin(0)) / voxel
    cell = torch.floor(place)
    _, group = torch.unique(cell, dim=0, return_inverse=True)
    order = torch.argsort(torch.linalg.vector_norm(place - cell - 0.5, dim=-1), stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool, device=order.device)
    first[1:] = group[order][1:] != group[order][:-1]
    keep = torch.zeros_like(first)
    keep[order[first]] = True
    return select_rows(cloud, keep, f"voxels of {voxel:g} m")


def remove_outliers(cloud: PointCloud) -> PointCloud:
    """Return the distinct points of a cloud without those that stray, such as flying pixels behind a rim.

    Stray is a point whose mean distance to its 8 nearest neighbours is more than 2.5 times the median one.

    Args:
        cloud: points [m], with or without normals and viewpoint.

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`.
        TooFewPoints: fewer than 4 points, before or after.

    >>> points = torch.cat([0.1 * torch.rand(500, 3), torch.ones(1, 3)])
    >>> bool(remove_outliers(PointCloud(points)).points.max() < 0.2)
    True
    """
    cloud = remove_duplicates(check_cloud(cloud))
    neighbour, _ = nearest(cloud.points.double(), OUTLIER_NEIGHBOURS + 1)
    spacing = neighbour[:, 1:].mean(-1)
    return select_rows(cloud, spacing <= OUTLIER_RATIO * spacing.median(), "points that are not stray")


def select_rows(cloud: PointCloud, keep: Bool[Tensor, "n"], what: str) -> PointCloud:
    """Return the points of a mask; refuse to leave fewer than a surface needs, calling them `what`."""
    if int(keep.sum()) < 4:
        raise TooFewPoints("points", f"{int(keep.sum())} {what}", "at least 4")
    return cloud.select(keep)


def nearest(points: Float[Tensor, "n 3"], k: int) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Return distances and indices of the k nearest points of each point, itself first; fewer in a small cloud."""
    from scipy.spatial import KDTree

    array = points.detach().cpu().numpy()
    distance, index = KDTree(array).query(array, k=min(k, len(array)))
    return torch.from_numpy(distance).to(points), torch.from_numpy(np.asarray(index, dtype=np.int64)).to(points.device)
