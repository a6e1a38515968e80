"""Planes that support objects, each with the region that it covers.

All points are in one frame, which may be any.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import Points, Vector, number_cells
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.plane_fit import PLANES, plane_axes


@dataclasses.dataclass(frozen=True)
class SupportNumbers:
    """Bounds that decide whether a plane supports objects, and how far it extends."""

    points: int = 20_000
    """Greatest number of points of a view that are used, which bounds the time."""
    least_points: int = 50
    """Least number of points of a view in which supports are sought."""
    at_once: int = 10_000
    """Number of points that are compared with a region at once, which bounds the memory."""
    thickness: float = 4.0
    """Greatest distance of a point that counts as on a support, in multiples of the point's noise.
    """
    least_thickness: float = 0.001
    """Distance [m] that is added to the noise: a table is not quite flat.
    """
    most_through: float = 0.1
    """Greatest number of points that the camera sees below a support, through its region. It is a
    share of the points on it.
    """
    slats: float = 0.5
    """Least number of points on a support in a cell that is no hole. It is a share of the points
    seen through the cell.
    """
    edge: float = 0.05
    """Border of the region, as a share of the region's width, through which the camera may see
    points below.
    """
    bowed: float = 0.5
    """Factor on the score of a support that is flat in a small part only."""
    flat: float = 1.1
    """Greatest scale (ratio of measured to assumed noise) of a small part that is as flat as the
    noise. Such a part is not bowed.
    """
    downward: float = 0.3
    """Least cosine between the normal of a plane and the image's downward direction. An upright
    camera cannot see this plane from above. A wall faces a camera that looks down so.
    """
    upside_down: float = 0.25
    """Factor on the score of a plane that an upright camera cannot see from above (`downward`). Few
    cameras are upside down.
    """
    plausible: float = 0.2
    """Least score of a support at an angle to the best one, over the best: a wall has less."""
    margin: float = 0.1
    """Distance [m] beside a bowed support at which its surface may not go on at another height."""
    most_away: float = 0.5
    """Greatest number of points within the `margin` that are near the plane but not on it. It is a
    share of the points on the support.
    """
    near: float = 0.08
    """Distance [m] from a target within which a support of its own is sought, if no other carries
    it.
    """
    shallow: float = 0.01
    """Greatest depth [m] of the target's foot below its own support: its own top is no support."""
    outliers: float = 0.02
    """Share of a target's points that may be lower than its foot."""
    foot: float = 0.03
    """Greatest depth [m] of a target's foot below its support: masks are a little too large."""
    afloat: float = 0.15
    """Height [m] of a target's foot above a plane from which on the plane is not its support. Things
    in front of a target seldom hide so much of it.
    """
    overhang: float = 0.05
    """Greatest distance [m] of a target's points beside the region of its support."""
    over: float = 0.5
    """Least share of a target's points that are above the region of its support."""
    plain: float = 0.75
    """Share of its weight in a support's score that a point on another plane, perhaps a wall,
    loses.
    """
    bow: float = 0.010
    """Greatest height [m] of a bowed support above or below the plane that was fitted to a part of
    it.
    """
    low: float = 0.06
    """Height [m] above a support below which points are low, so that their object stands on it."""
    pierced_cell: float = 0.02
    """Width [m] of the columns, perpendicular to a support, in which points above and below it are
    counted.
    """
    crossed: float = 0.5
    """Least ratio of points below to points on a plane, in a column in which a surface crosses the
    plane.
    """
    askew: float = 0.7
    """Greatest cosine between the normals of a support and a wall beside it."""
    sag: float = 2.0
    """Least depth of a point that counts as below a support, in multiples of the tolerance of
    points on it. Dark feet sag less.
    """
    below: float = 0.2
    """Least ratio of points below to points above a support, in a column in which an object goes
    through it.
    """
    most_pierced: float = 0.15
    """Greatest share of the low points over a support that continue below it. Between slats, some
    points of an object do.
    """
    least_standing: float = 0.001
    """Least share of all points that lie low above a support, over its region."""
    least_low: float = 0.05
    """Least share of the low points that lie over the region."""
    steep: float = 0.9
    """Sine of the camera's elevation above a support, over which objects hide their lowest points.
    """
    grazing: float = 5.0
    """Least angle [deg] between a support and the direction to the camera, at which the camera sees
    it from above.
    """
    favour: float = 2.0
    """Factor on the score of the support that the camera looks at."""
    least_width: float = 0.14
    """Least width [m] of a support's region."""
    furniture: float = 0.3
    """Width [m] of the region of a plane from which on it is furniture, no object that a hand
    grasps.
    """
    small_table: float = 0.2
    """Least width [m] of a bowed support that is parallel to a plane as wide as furniture. Above a
    floor it is a small table.
    """
    parallel: float = 0.985
    """Least cosine between the normals of parallel planes: ten degrees."""
    same: float = 0.02
    """Distance [m] between parallel planes below which they are the same one."""
    cell: float = 0.03
    """Width [m] of the cells in which points on a plane are connected."""
    closing: int = 2
    """Number of cells by which the groups of points grow and shrink again, to close gaps."""
    gap: float = 0.25
    """Greatest number of points below the plane that the camera sees in a cell of a gap. It is a
    share of the mean number of points in a cell of the plane. With fewer, an object hides the gap.
    """
    least_part: float = 0.02
    """Least size of a group of points that counts, as a share of the largest group."""
    most_open: float = 0.05
    """Greatest number of points below the plane that the camera sees between two groups which one
    object divides. It is a share of the smaller group.
    """
    least_height: float = 1e-9
    """Least height [m] by which a ray to a plane is divided."""


SUPPORTS = SupportNumbers()


@dataclasses.dataclass(frozen=True)
class SupportPlane:
    """A plane that objects stand on (a support), and its region: the convex hull of the points on
    it. Vectors are in the frame of these points.
    """

    plane: Plane  # the plane; the camera is above it
    # Of each of s sides of the region: outward unit vector u (x, y, z) in the plane, and offset o
    # [m]. Points p within have u . p + o < 0. None means that the region is unbounded.
    sides: Float[Tensor, "s 4"] | None = None
    width: float = math.inf  # least width of the region [m]
    # whether the support is bowed or small, so that the plane holds near its region only
    local: bool = False

    def covers(self, points: Float[Tensor, "*b 3"], margin: float = 0.0) -> Bool[Tensor, "*b"]:
        """Return a mask (*b,) of the points (*b, 3) [m] that are straight above or below the
        region.

        Straight means along the plane's normal. Points at most `margin` [m] beside the region
        count, too; a negative margin shrinks the region. An unbounded region covers all points.
        Here b stands for any batch axes.
        """
        if self.sides is None:
            return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
        # parts that a cache holds
        sides = self.sides.to(points)
        rows = points.reshape(-1, 3).split(SUPPORTS.at_once)
        parts = [(sides[:, :3] @ part.T + sides[:, 3:]).amax(0) < margin for part in rows]
        return torch.cat(parts).reshape(points.shape[:-1])

    def moved(self, shift: Vector) -> "SupportPlane":
        """Return the support after a translation by `shift` (3,) [m]."""
        plane = Plane(self.plane.normal, self.plane.offset + float(self.plane.normal @ shift))
        sides = self.sides
        if sides is not None:
            sides = torch.cat([sides[:, :3], sides[:, 3:] - sides[:, :3] @ shift[:, None]], -1)
        return dataclasses.replace(self, plane=plane, sides=sides)


def bound(
    plane: Plane, points: Points, on: Bool[Tensor, "n"], eye: Vector | None
) -> SupportPlane | None:
    """Return a plane as a support, with the region that it covers.

    Args:
        plane: the plane, with its normal to the upper side.
        points: all points (n, 3) [m] of the view, in the frame of the plane.
        on: mask of the points that lie on the plane.
        eye: position (3,) [m] of the camera; None if unknown.

    The region is the convex hull of the largest connected group of the points on the plane. An
    object on the plane may hide the area between two groups. So another large group joins if the
    camera sees almost nothing below the plane through that area. If `eye` is None, points up to 0.3
    m straight below the area are counted instead. Returns None if the points on the plane span no
    area.
    """
    if int(on.sum()) < 3:
        return None
    middle = points[on].mean(0)
    axes = plane_axes(plane.normal.to(points), points[on])
    crossing, behind = cross(plane, points, eye)
    # (n, 2), in the plane
    flat = (points[on] - middle) @ axes
    flat = flat[~_crossed((points - middle) @ axes, on, plane.height(points))[on]]
    if len(flat) < 3:
        return None
    lower = (crossing[behind & ~on] - middle) @ axes
    region = None
    for part in _parts(flat, lower):
        if region is None:
            region = Hull.of(part)
            continue
        grown = Hull.of(torch.cat([region.corners, part]))
        seen = grown.holds(lower) & ~region.holds(lower)
        if int(seen.sum()) < SUPPORTS.most_open * len(part):
            region = grown
    if region is None or region.width <= 0:
        return None
    outward = region.sides[:, :2] @ axes.T
    offset = region.sides[:, 2] - outward @ middle
    return SupportPlane(plane, torch.cat([outward, offset[:, None]], -1), region.width)


def _crossed(
    flat: Float[Tensor, "n 2"], on: Bool[Tensor, "n"], height: Float[Tensor, "n"]
) -> Bool[Tensor, "n"]:
    """Return a mask of the points in narrow columns in which a surface goes on below a plane.

    There the plane cuts a wall or a bed, or ends. `flat` holds the place of each point in the plane
    [m], and `height` is that above it [m]. The points `on` lie on it.
    """
    cells = number_cells(flat, SUPPORTS.pierced_cell)
    below = ~on & (height < 0) & (height > -SUPPORTS.low)
    lower = torch.bincount(cells, below.double())
    return (lower > SUPPORTS.crossed * torch.bincount(cells, on.double()))[cells]


@dataclasses.dataclass(frozen=True)
class Hull:
    """A convex polygon in a plane, the convex hull of points with two coordinates (x, y) [m]."""

    corners: Float[Tensor, "k 2"]  # the k corners (x, y) of the polygon [m]
    # outward unit normal n (x, y) of each of s sides, and offset o [m]; points p within have n . p
    # + o < 0
    sides: Float[Tensor, "s 3"]

    @classmethod
    def of(cls, points: Float[Tensor, "n 2"]) -> "Hull":
        """Return the convex hull of points (n, 2) [m] in a plane.

        If all points lie on a line, the hull contains no point.
        """
        try:
            hull = spatial.ConvexHull(points.numpy())
        except spatial.QhullError:
            return cls(points, points.new_tensor([[0.0, 0.0, math.inf]]))
        return cls(points[torch.from_numpy(hull.vertices).long()], torch.from_numpy(hull.equations))

    def holds(self, points: Float[Tensor, "n 2"], margin: float = 0.0) -> Bool[Tensor, "n"]:
        """Return a mask (n,) of the points (n, 2) [m] in the polygon, or at most `margin` [m]
        outside.

        A negative margin shrinks the polygon.
        """
        return (points @ self.sides[:, :2].T + self.sides[:, 2] < margin).all(-1)

    @property
    def width(self) -> float:
        """The least distance [m] of two parallel lines that enclose the polygon."""
        return -float((self.corners @ self.sides[:, :2].T + self.sides[:, 2]).amin(0).amax())


def _parts(
    flat: Float[Tensor, "n 2"], lower: Float[Tensor, "k 2"]
) -> Iterator[Float[Tensor, "m 2"]]:
    """Yield the connected groups of points in a plane, the largest first, without narrow strips and
    specks.

    `lower` are the places at which rays to points below the plane cross it. Groups do not connect
    where they fill the cells of a gap.
    """
    cells = torch.floor(flat / SUPPORTS.cell).long()
    # Groups grow into the empty cells at the border.
    border = SUPPORTS.closing + 1
    first = cells.amin(0) - border
    cells = cells - first
    place = tuple(cells.T.numpy())
    grid = np.zeros((cells.amax(0) + border + 1).tolist(), dtype=bool)
    grid[place] = True
    box = np.ones((3, 3))
    closed = ndimage.binary_closing(grid, box, iterations=SUPPORTS.closing)
    gaps = torch.floor(lower / SUPPORTS.cell).long() - first
    gaps = gaps[((gaps >= 0) & (gaps < torch.tensor(grid.shape))).all(-1)]
    seen = np.zeros(grid.shape)
    np.add.at(seen, tuple(gaps.T.numpy()), 1)
    closed &= grid | (seen <= SUPPORTS.gap * len(flat) / grid.sum())
    labels = np.empty(grid.shape, dtype=np.int32)
    ndimage.label(ndimage.binary_opening(closed, box), output=labels)
    own = torch.from_numpy(labels[place]).long()
    count = torch.bincount(own)[1:]
    for k in torch.argsort(count, descending=True, stable=True).tolist():
        if count[k] >= SUPPORTS.least_part * count.max():
            yield flat[own == k + 1]


def cross(plane: Plane, points: Points, eye: Vector | None) -> tuple[Points, Bool[Tensor, "n"]]:
    """Return (crossing, behind): where camera rays cross a plane, and which points are below it.

    `crossing` (n, 3) [m] are the points in which the rays through the `points` (n, 3) [m] cross the
    plane. `behind` (n,) is a mask of the points below the plane. The camera is above the plane, at
    `eye` (3,) [m]. If `eye` is None, the points themselves are returned as `crossing`. Then points
    more than 0.3 m (`PLANES.reach`) below the plane do not count as behind it. All arguments are in
    one frame.
    """
    height = plane.height(points)
    if eye is None:
        return points, (height < 0) & (height > -PLANES.reach)
    above = float(plane.height(eye))
    ratio = above / (above - height).clamp_min(SUPPORTS.least_height)
    return eye + ratio[:, None] * (points - eye), height < 0
