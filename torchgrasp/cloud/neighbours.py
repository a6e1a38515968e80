"""Outliers, local planes and local quadrics of a cloud, computed from the nearest neighbours of
each point.
"""

import dataclasses
import math
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, dot, matvec, norm, unit


@dataclasses.dataclass(frozen=True)
class NeighbourNumbers:
    """Numbers of neighbours of a point, itself included, and parameters of the fits to them."""

    spacing: int = 9
    """Number of neighbours by which the spacing is measured: a raster's eight and the point. Flying
    pixels come in smaller groups, so each counts as far from its neighbours.
    """
    outlier: float = 2.5
    """Multiple of the median of the points' mean distances from their neighbours, above which a
    point is an outlier. Depth and slope vary the distance less.
    """
    plane: int = 25
    """Number of neighbours to which a plane is fitted: about eight for each of its three unknowns.
    """
    quadric: int = 30
    """Number of neighbours to which a quadric is fitted: five for each of its six unknowns."""
    width: float = 0.7
    """Width w of the weights exp(-(d / (w d_k))^2) of neighbours at the distances d. Here d_k is
    the distance of the farthest neighbour.
    """
    ridge: float = 1e-3
    """Weight of the squared coefficients of a quadric, other than the constant one, relative to the
    squared errors. It matters only where points are few.
    """
    block: int = 1 << 14
    """Number of points whose quadrics are fitted at once, which bounds the memory."""
    flat: int = 2000
    """Greatest number of points by which a cloud is found to be flat."""
    thin: float = 1e-3
    """Thickness over length below which a cloud without noise is flat."""


NEAR = NeighbourNumbers()


def draw_rows(count: int, most: int) -> Int[Tensor, "m"]:
    """Return at most `most` of the indices 0 to `count` - 1, drawn with a fixed seed, ascending."""
    if count <= most:
        return torch.arange(count)
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:most].sort().values


def nearest(
    points: Points, k: int, rows: Int[Tensor, "m"] | None = None
) -> tuple[Float[Tensor, "m k"], Int[Tensor, "m k"]]:
    """Return the distances and the indices of the k nearest points to each of m points.

    The m points are those of `points` (n, 3) with the indices `rows`, by default all. The results
    are distances to `points`, and indices into them. Distances have the unit of `points` and
    ascend; each point itself comes first. A cloud of fewer than k points gives fewer columns.
    """
    array = points.detach().cpu().numpy()
    asked = array if rows is None else array[rows.cpu().numpy()]
    distance, index = spatial.KDTree(array).query(asked, k=min(k, len(array)))
    places = torch.from_numpy(np.asarray(index, dtype=np.int64))
    return torch.from_numpy(distance).to(points), places.to(points.device)


def usual_spacing(points: Points) -> float:
    """Return the median, over the points (n, 3), of the mean distance to the 8 nearest neighbours.

    It has the unit of the points.
    """
    return float(nearest(points, NEAR.spacing)[0][:, 1:].mean(-1).median())


def find_inliers(points: Points, rows: Int[Tensor, "m"] | None = None) -> Bool[Tensor, "m"]:
    """Return a mask of those of m points that are not outliers, such as flying pixels.

    The m points are those of `points` (n, 3) with the indices `rows`, by default all. Each has a
    mean distance to its 8 nearest neighbours. That of an outlier is more than 2.5 times
    (`NEAR.outlier`) the median one.
    """
    spacing = nearest(points, NEAR.spacing, rows)[0][:, 1:].mean(-1)
    return spacing <= NEAR.outlier * spacing.median()


@dataclasses.dataclass(frozen=True)
class Neighbours:
    """Inliers, local planes and local quadric surfaces of a cloud, each found once and then kept.

    They follow from the nearest neighbours of each of n points. Lengths have the unit of the
    points.
    """

    points: Points

    @cached_property
    def inliers(self) -> Bool[Tensor, "n"]:
        """A mask of the points that are not outliers, such as flying pixels.

        Each point has a mean distance to its 8 nearest neighbours. That of an outlier is more than
        2.5 times (`NEAR.outlier`) the median one.
        """
        return find_inliers(self.points)

    @cached_property
    def clean(self) -> "Neighbours":
        """The `Neighbours` of the m inliers alone, whose nearest neighbours are inliers, too."""
        return Neighbours(self.points[self.inliers])

    @cached_property
    def near(self) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
        """Distances to the k = 30 nearest points (`NEAR.quadric`) of each of n points, and their
        indices.

        They ascend, and each point itself comes first. Planes and quadrics are fitted to them.
        """
        return nearest(self.points, NEAR.quadric)

    @cached_property
    def planes(self) -> tuple[Points, Float[Tensor, "n 3 3"]]:
        """Variances (n, 3) of each point's neighbours (`near`) along their principal axes, and the
        axes.

        Variances ascend, and have the squared unit of the points. The axes are unit vectors, the
        columns of (n, 3, 3). The first is the normal, of either sign, of the plane fitted to the
        neighbours.
        """
        distance, index = self.near
        return _principal_axes(self.points[index], _weigh(distance))

    @cached_property
    def quadrics(self) -> tuple[Points, Points, Float[Tensor, "n"]]:
        """A quadric surface fitted around each of n points: the moved point, the unit normal and
        the error.

        The point (n, 3) is moved onto the quadric. The normal (n, 3), of either sign, is that of
        the quadric there. The rms error has the unit of `points`. Planes would move the points of a
        ball of radius r inward by s^2 / 2r. Here s is the spread of the neighbours.
        """
        distance, index = self.near
        if len(self.points) <= NEAR.block:
            weight = _weigh(distance)
            return _fit_block(self.points, self.points[index], weight, self.planes[1])
        blocks = zip(*(x.split(NEAR.block) for x in (self.points, *self.near)), strict=True)
        fits = list[tuple[Points, Points, Tensor]]()
        for at, distance, rows in blocks:
            near = self.points[rows]
            weight = _weigh(distance)
            fits.append(_fit_block(at, near, weight, _principal_axes(near, weight)[1]))
        feet, normals, rms = map(torch.cat, zip(*fits, strict=True))
        return feet, normals, rms

    @cached_property
    def flat(self) -> bool:
        """Whether the cloud is flat: no thicker than its noise, which is twice the error of its
        quadrics.

        The thickness is the standard deviation along the principal axis of least spread. The error
        is the median rms error of the quadrics (`quadrics`). A cloud thinner than 0.001
        (`NEAR.thin`) of its length is flat, too.
        """
        some = self
        if len(self.points) > NEAR.flat:
            rows = draw_rows(len(self.points), NEAR.flat)
            some = Neighbours(self.points[rows.to(self.points.device)])
        points = some.clean.points
        spread = torch.linalg.svdvals(points - points.mean(0)) / math.sqrt(len(points))
        thickness, _, length = spread.sort().values.tolist()
        # a quadric errs by no more than a plane, which is found sooner
        mean_squares, _ = some.clean.planes
        most = 2 * float(mean_squares[:, 0].clamp_min(0).sqrt().median())
        if thickness >= max(most, NEAR.thin * length):
            return False
        return thickness < max(2 * float(some.clean.quadrics[2].median()), NEAR.thin * length)


def fit_local_planes(
    points: Points, rows: Int[Tensor, "m"] | None = None
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m"]]:
    """Fit a plane to the 25 nearest points (`NEAR.plane`) of each of m points. Return the unit
    normals (m, 3) of the planes, of either sign, and the rms errors (m,) of the fits.

    The m points are those of `points` (n, 3) with the indices `rows`, by default all. The errors
    have the unit of `points`.
    """
    distance, index = nearest(points, NEAR.plane, rows)
    mean_squares, axes = _principal_axes(points[index], _weigh(distance))
    return axes[..., 0], mean_squares[:, 0].clamp_min(0).sqrt()


def _fit_block(
    points: Float[Tensor, "m 3"],
    near: Float[Tensor, "m k 3"],
    weight: Float[Tensor, "m k"],
    axes: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "m"]]:
    """Return the quadrics of `Neighbours` around some points, given each point's neighbours, their
    weights and their principal axes.
    """
    height, u, v = ((near - points[:, None]) @ axes).unbind(-1)  # (m, k) each
    size = norm(torch.stack([u, v], -1)).amax(-1, keepdim=True)
    u = u / size
    v = v / size
    terms = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], -1)
    weighted = weight[..., None] * terms
    flat = NEAR.ridge * torch.tensor([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]).to(points)
    moments = weighted.transpose(-1, -2) @ terms + torch.diag_embed(flat)
    quadric = torch.linalg.solve(moments, (weighted * height[..., None]).sum(-2))  # (m, 6)
    residual = height - dot(terms, quadric[:, None])
    # The surface is where height - quadric is 0: its gradient there is the normal.
    slope = -quadric[:, 1:3] / size
    gradient = torch.cat([torch.ones_like(size), slope], -1)
    normals = unit(matvec(axes, gradient))
    feet = points + quadric[:, :1] * axes[..., 0]
    return feet, normals, (weight * residual**2).sum(-1).sqrt()


def _weigh(distance: Float[Tensor, "m k"]) -> Float[Tensor, "m k"]:
    """Return the weights exp(-(d / 0.7 d_k)^2) of neighbours, scaled to sum 1; d_k is the farthest
    distance d.
    """
    weight = torch.exp(-((distance / (NEAR.width * distance[:, -1:])) ** 2))
    return weight / weight.sum(-1, keepdim=True)


def _principal_axes(
    near: Float[Tensor, "n k 3"], weight: Float[Tensor, "n k"]
) -> tuple[Points, Float[Tensor, "n 3 3"]]:
    """Return the weighted variances of neighbours along their principal axes, ascending, and the
    axes as columns.
    """
    difference = near - (weight[..., None] * near).sum(1)[:, None]
    moments = (weight[..., None] * difference).transpose(-1, -2) @ difference  # (n, 3, 3)
    return torch.linalg.eigh(moments)
