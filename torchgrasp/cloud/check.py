"""Checks of point clouds, and removal of points: duplicates, outliers, and surplus points of dense
clouds.
"""

import dataclasses
from typing import Annotated

import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.cloud.neighbours import find_inliers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, CloudWarning, SuspiciousScale, TooFewPoints
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.limits import MAX_EXTENT, MIN_EXTENT
from torchgrasp.foundation.rules import Range
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.linalg import Points, norm, number_rows
from torchgrasp.values.planning import PointCloud

MIN_POINTS = 4  # fewest distinct points from which a surface can be estimated
FEW_POINTS = 100  # fewer points are a speck of noise, or too coarse for a shape


@dataclasses.dataclass(frozen=True)
class CloudNumbers:
    """Bounds for points that coincide or lie on a line, and for extents in another unit."""

    sample: int = 20_000
    """Number of points, about, that are first searched for enough distinct ones."""
    coincident: float = 1e-9
    """Greatest distance of coincident points, as a share of the cloud's extent: above rounding,
    below any sensor's resolution.
    """
    line: float = 1e-6
    """Ratio of the second principal spread of the points to the first, below which they are on a
    line.
    """
    scene: float = 10.0
    """Greatest extent, read as metres, that is taken for a scene in metres or an object in cm."""
    longest: float = 45.0
    """Greatest extent, read as metres, that is taken for cm: that of an object of at most 45 cm. A
    larger one is taken for mm.
    """
    digit: float = 0.01
    """Step [m] of coordinates that were rounded to two decimals."""
    equal: float = 1e-6
    """Greatest error of a coordinate that counts as rounded to two decimals, as a share of the step
    `digit`.
    """
    coarse: float = 0.002
    """Least step [m] of coordinates for a warning: its rounding errors are as large as a camera's
    noise.
    """
    farthest: float = 50.0
    """Greatest distance [m] of a camera from the points. Depth images measure no farther; a camera
    that is farther off is perhaps given in cm.
    """


CLOUD = CloudNumbers()


@checked
def check_cloud(cloud: PointCloud) -> PointCloud:
    """Return the cloud itself if it is fit for grasp planning, else raise an error.

    A flat cloud is also fit.

    Raises:
        TooFewPoints: fewer than 4 distinct points.
        SuspiciousScale: the longest side of the bounding box is outside [5 mm, 2 m], as of points
            in mm.
        BadArgument: points that all coincide or lie on one line; a normal of length zero. Also a
            camera more than 50 m (`CLOUD.farthest`) away, such as one in mm.

    >>> check_cloud(PointCloud(torch.rand(50, 3))).viewpoint is None
    True
    """
    points = _check(cloud)
    rows = _distinct_rows(points[:: max(1, len(points) // CLOUD.sample)])
    _check_distinct(points, rows if len(rows) >= MIN_POINTS else _distinct_rows(points))
    return cloud


@checked
def remove_duplicates(cloud: PointCloud) -> PointCloud:
    """Return a cloud without duplicate points, which would count as independent measurements.

    Of coincident points the first is kept, with its normal and camera.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a normal of length zero, or a
    camera over 50 m away.
    """
    points = _check(cloud)
    rows = _distinct_rows(points)
    _check_distinct(points, rows)
    return cloud if len(rows) == len(cloud) else cloud.select(rows)


@checked
def voxel_downsample(cloud: PointCloud, voxel: Annotated[float, Range(1e-5, 1.0)]) -> PointCloud:
    """Return a thinned cloud: from each voxel the one point that is nearest to the voxel's centre.

    The points keep their order, and their normals and cameras. They are not averaged, since a mean
    may lie inside a thin wall.

    Args:
        cloud: the points [m].
        voxel: side [m] of the voxels, 0.00001 to 1. Their grid starts at the cloud's least x, y and
            z.

    Raises `TooFewPoints` for fewer than 4 distinct points, or if fewer than 4 voxels hold points.
    Raises `SuspiciousScale` for an extent outside [5 mm, 2 m]. Raises `BadArgument` for points on
    one line, a normal of length zero, or a camera over 50 m away.

    >>> len(voxel_downsample(PointCloud(0.1 * torch.rand(5000, 3)), 0.05)) <= 27
    True
    """
    cloud = check_cloud(cloud)
    points = cloud.points.double()
    place = (points - points.amin(0)) / voxel
    cell = torch.floor(place)
    group = number_rows(cell)
    order = torch.argsort(norm(place - cell - 0.5), stable=True)
    rows = order[first_of_each(group[order])].sort().values
    if len(rows) < MIN_POINTS:
        found = f"{len(rows)} voxels of {voxel:g} m"
        raise TooFewPoints("points", found, f"points in at least {MIN_POINTS} voxels")
    return cloud.select(rows)


@checked
def remove_outliers(cloud: PointCloud) -> PointCloud:
    """Return the cloud without duplicate points and without outliers, such as flying pixels.

    Each point has a mean distance to its 8 nearest neighbours. The mean distance of an outlier is
    more than 2.5 times (`NEAR.outlier`) the median of all points.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a normal of length zero, or a
    camera over 50 m away.

    >>> points = torch.cat([0.1 * torch.rand(500, 3), torch.ones(1, 3)])
    >>> bool(remove_outliers(PointCloud(points)).points.max() < 0.2)
    True
    """
    cloud = remove_duplicates(cloud)
    return cloud.select(find_inliers(cloud.points.double()))


def _check_distinct(points: Points, rows: Int[Tensor, "m"]) -> None:
    """Raise an error if the distinct points, at the indices `rows`, are too few. Raise one also if
    all points lie on a line.
    """
    if len(rows) < MIN_POINTS:
        allowed = f"at least {MIN_POINTS} distinct points"
        raise TooFewPoints("points", f"{len(rows)} distinct points", allowed)
    spread = torch.linalg.svdvals((points - points.mean(0)).double())
    if float(spread[1]) < CLOUD.line * float(spread[0]):
        raise BadArgument("points", f"{len(points)} points on one line", "points of a surface")


def _check(cloud: PointCloud) -> Points:
    """Return the cloud's points. Raise an error if its extent or camera is implausible, or a normal
    has length zero.
    """
    points = cloud.points
    extent = float((points.amax(0) - points.amin(0)).max())
    if extent == 0.0:
        found = f"{len(points)} points that all coincide"
        raise BadArgument("points", found, "points of a surface")
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        allowed = f"an extent of {MIN_EXTENT:g} to {MAX_EXTENT:g} metres"
        found = f"{extent:.4g} m; is this cloud {_guess_unit(extent)}?"
        raise SuspiciousScale("points", found, allowed)
    if cloud.normals is not None:
        zero = int((norm(cloud.normals) == 0).sum())
        if zero:
            found = f"{zero} normals of length zero"
            raise BadArgument("normals", found, "normals with a direction")
    if cloud.viewpoint is not None:
        away = float(norm(cloud.viewpoint - points).max())
        if away > CLOUD.farthest:
            allowed = f"a camera within {CLOUD.farthest:g} m of the points, in metres as they are"
            raise BadArgument("viewpoint", f"one {away:.4g} m away", allowed)
    return points


def coordinate_step(points: Points) -> float:
    """Return the step [m] to which all coordinates (n, 3) [m] are rounded. Return 0 for a step
    below 2 mm (`CLOUD.coarse`), or for fewer than 100 points (`FEW_POINTS`).

    Float32 numbers have large steps far from the origin. Text files of two decimals have steps of
    10 mm.
    """
    found = points.detach().double().cpu()
    if len(found) < FEW_POINTS:
        return 0.0
    step = 0.0
    single = found.float()
    if (single.double() == found).all():
        farthest = single.abs().max()
        beyond = torch.nextafter(farthest, torch.full_like(farthest, torch.inf))
        step = float(beyond) - float(farthest)
    counts = found / CLOUD.digit
    if ((counts - counts.round()).abs() < CLOUD.equal).all():
        step = max(step, CLOUD.digit)
    return step if step >= CLOUD.coarse else 0.0


def describe_step(step: float) -> str:
    """Return a text on the `step` [m] to which a cloud's coordinates are rounded, for messages.

    It is, for example, "coordinates in steps of 10 mm, of few digits or far from the origin".
    """
    return f"coordinates in steps of {1e3 * step:.2g} mm, of few digits or far from the origin"


def warn_of_step(points: Points) -> None:
    """Warn (`CloudWarning`) of points (n, 3) [m] whose coordinates are rounded to a step of 2 mm
    (`CLOUD.coarse`) or more.
    """
    step = coordinate_step(points)
    if step > 0:
        fix = "give more digits, or subtract an offset in float64 before float32 is written"
        warn_user(CloudWarning, f"points: {describe_step(step)}; {fix}")


def _guess_unit(extent: float) -> str:
    """Guess the unit of an extent that is too large or too small to be in metres. Objects are 5 to
    45 cm long.
    """
    if extent < MIN_EXTENT:
        return "normalised, or in m (--unit m)"
    in_cm = f"in cm ({extent / 100.0:.3g} m: --unit cm)"
    if extent < CLOUD.scene:
        return f"a whole scene (torchgrasp cloud cut), or {in_cm}"
    return in_cm if extent < CLOUD.longest else f"in mm ({extent / 1000.0:.3g} m: --unit mm)"


def _distinct_rows(points: Points) -> Int[Tensor, "m"]:
    """Return the indices of the distinct points, ascending; of coincident points only the first
    counts.
    """
    points = points.detach().double()
    low = points.amin(0)
    tolerance = CLOUD.coincident * float((points.amax(0) - low).max())
    # Points that share a cell of half the tolerance coincide: one point a cell leaves few pairs
    # among many copies.
    cells = torch.floor((points - low) / (tolerance / 2))
    group = number_rows(cells)
    rows = first_of_each(group).sort().values
    pairs = spatial.KDTree(points[rows].cpu().numpy()).query_pairs(tolerance, output_type="ndarray")
    # The first index of a pair is the smaller one, which is kept.
    keep = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    keep[torch.from_numpy(pairs[:, 1]).to(rows.device)] = False
    return rows[keep]


def first_of_each(group: Int[Tensor, "n"]) -> Int[Tensor, "groups"]:
    """Return the index of the first point of each group; entry i of the result is for group i.

    `group` (n,) holds the number of each point's group, 0, 1, ...; no group is empty. The index is
    one of the n points.
    """
    order = torch.arange(len(group), device=group.device)
    first = torch.full_like(order, len(order)).scatter_reduce(0, group, order, "amin")
    return first[: int(group.max()) + 1]
