"""Search for supports in a view: planes that objects stand on, each with the region that it covers,
in any frame.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.checks import check_tensor
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import Points, Vector, unit
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.geometry.plane_fit import (
    LEAST_SHARE,
    MOST_TILT,
    REACH,
    ROUGH,
    PlaneFit,
    SeenPoints,
    assume_noise,
    fit_planes,
)

MOST_THROUGH = (
    0.1  # greatest number of points seen through a support's region, over the number on it
)
MOST_PIERCED = 0.05  # greatest share of the low points over a support that continue below it
LEAST_STANDING = 0.001  # least share of the points that stand low on a support, over its region
LEAST_WIDTH = 0.14
FURNITURE = 0.3
"""Least width [m] of a support's region; a wider face than FURNITURE [m] belongs to no object that
a hand grasps.
"""
LOW = 0.06  # height [m] below which points of an object stand close to its support
# what a view must show
SUPPORT = "a plane with objects on it and nothing seen through it, or a table that is given"


@dataclasses.dataclass(frozen=True)
class SupportPlane:
    """A plane that objects stand on, and its region: the convex hull of the points on it."""

    plane: Plane  # the camera is above it
    sides: Float[Tensor, "s 4"] | None = (
        None  # outward unit vector and offset [m] of each; None: unbounded
    )
    width: float = math.inf  # smaller width of the region [m]

    def covers(self, points: Float[Tensor, "*b 3"], margin: float = 0.0) -> Bool[Tensor, "*b"]:
        """Return which points lie over the region or at most `margin` [m] beside it; a negative
        margin shrinks it.
        """
        if self.sides is None:
            return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
        # parts that a cache holds
        sides = self.sides.to(points)
        rows = points.reshape(-1, 3).split(10_000)
        parts = [(sides[:, :3] @ part.T + sides[:, 3:]).amax(0) < margin for part in rows]
        return torch.cat(parts).reshape(points.shape[:-1])

    def moved(self, shift: Vector) -> "SupportPlane":
        """Return the support after a translation [m]."""
        plane = Plane(self.plane.normal, self.plane.offset + float(self.plane.normal @ shift))
        sides = self.sides
        if sides is not None:
            sides = torch.cat([sides[:, :3], sides[:, 3:] - sides[:, :3] @ shift[:, None]], -1)
        return SupportPlane(plane, sides, self.width)


def find_table(
    points: Points, viewpoint: Vector, table: Plane | float | None, up: object
) -> tuple[SupportPlane, ...]:
    """Return the support on a given table, or all supports found in the points, best first; the
    camera is above.
    """
    plane = as_plane(table)
    direction = None if up is None else torch.as_tensor(up).double().cpu()
    if plane is None:
        return find_supports(points, viewpoint, direction)
    if direction is not None and float(unit(direction) @ plane.normal.double()) < 0.5:
        raise BadArgument(
            "up", direction.tolist(), "a direction within 60 degrees of the table's normal"
        )
    if float(plane.height(viewpoint)) <= 0:
        raise BadArgument(
            "table",
            f"the camera {-float(plane.height(viewpoint)):.3g} m below it",
            "a table below it",
        )
    points = points.double().cpu()
    eye = viewpoint.double().cpu()
    points = points[:: 1 + len(points) // 20_000]
    on = plane.height(points).abs() < 3 * assume_noise(points, eye)
    return (bound(plane, points, on, eye) or SupportPlane(plane),)


def find_supports(
    points: Points,
    viewpoint: Vector | None = None,
    up: Vector | None = None,
    least_width: float = LEAST_WIDTH,
) -> tuple[SupportPlane, ...]:
    """Return the planes that support objects in a view, the most plausible first, each with the
    region that it covers.

    Triples of points propose planes. An iterated fit with Tukey's weights refines each plane.
    Objects stand on a support, over its region, and the camera sees nothing through the region. The
    support with the most points low above it comes first; the points count twice if the camera
    looks at the support. Of parallel supports, a higher one as wide as furniture comes first. A
    rigid motion of all arguments moves the supports alike. Without a camera, the side with more
    points is the upper one. Without `up`, any direction is allowed. `NoSupport` is raised if there
    is no support.
    """
    points = check_tensor("points", points, (None, 3)).detach().cpu().double()
    eye = (
        None
        if viewpoint is None
        else check_tensor("viewpoint", viewpoint, (3,)).detach().cpu().double()
    )
    sky = None if up is None else unit(check_tensor("up", up, (3,)).detach().cpu().double())
    if len(points) < 50:
        raise NoSupport("table", f"{len(points)} points", SUPPORT)
    generator = torch.Generator().manual_seed(0)
    points = points[torch.randperm(len(points), generator=generator, device="cpu")[:20_000]]
    centre = points.mean(0)
    points = points - centre  # so that distant origins cost no digits
    view = SeenPoints(points, None if eye is None else eye - centre, sky)
    found: list[_Candidate] = []
    reasons: list[str] = []
    for fit in fit_planes(view, generator):
        judged = _judge(view, fit.turned_up(view), least_width)
        if isinstance(judged, str):
            reasons.append(judged)
        elif not any(judged.repeats(other) for other in found):
            found.append(judged)
    if not found:
        raise NoSupport("table", reasons[0] if reasons else "no plane with enough points", SUPPORT)
    return tuple(candidate.support.moved(centre) for candidate in _ordered(found))


def bound(
    plane: Plane, points: Points, on: Bool[Tensor, "n"], eye: Vector | None
) -> SupportPlane | None:
    """Return the support on a plane, with its region, or None if too few points lie on the plane
    (the mask `on`).

    The region is the convex hull of the largest connected group of these points. Another large
    group joins it if the camera `eye` sees almost nothing below the plane between the groups: then
    an object hides that area.
    """
    if int(on.sum()) < 3:
        return None
    middle = points[on].mean(0)
    axes = _axes(plane.normal.to(points), points[on])
    crossing, behind = cross(plane, points, eye)
    flat, lower = (((p - middle) @ axes) for p in (points[on], crossing[behind & ~on]))
    region = None
    for part in _parts(flat):
        grown = Hull.of(part if region is None else torch.cat([region.corners, part]))
        if region is None or int((grown.holds(lower) & ~region.holds(lower)).sum()) < 0.05 * len(
            part
        ):
            region = grown
    if region is None or region.width <= 0:
        return None
    outward = region.sides[:, :2] @ axes.T
    return SupportPlane(
        plane,
        torch.cat([outward, (region.sides[:, 2] - outward @ middle)[:, None]], -1),
        region.width,
    )


def _axes(normal: Vector, points: Points) -> Float[Tensor, "3 2"]:
    """Return two unit vectors (columns) perpendicular to a normal; they rotate with the points."""
    side = points[0] - points.mean(0)
    x = unit(side - (side @ normal) * normal)
    return torch.stack([x, torch.linalg.cross(normal, x)], -1)


@dataclasses.dataclass(frozen=True)
class Hull:
    """A convex polygon in a plane: its corners [m], and the outward unit normal and offset [m] of
    each side.
    """

    corners: Float[Tensor, "k 2"]
    sides: Float[Tensor, "s 3"]

    @classmethod
    def of(cls, points: Float[Tensor, "n 2"]) -> "Hull":
        """Return the convex hull of points in a plane. If all points lie on a line, no point is
        inside the hull.
        """
        try:
            hull = spatial.ConvexHull(points.numpy())
        except spatial.QhullError:
            return cls(points, points.new_tensor([[0.0, 0.0, math.inf]]))
        return cls(points[torch.from_numpy(hull.vertices).long()], torch.from_numpy(hull.equations))

    def holds(self, points: Float[Tensor, "n 2"], margin: float = 0.0) -> Bool[Tensor, "n"]:
        """Return which points lie in the polygon or at most `margin` [m] outside; a negative margin
        shrinks it.
        """
        return (points @ self.sides[:, :2].T + self.sides[:, 2] < margin).all(-1)

    @property
    def width(self) -> float:
        """The smallest distance [m] of two parallel lines that enclose the polygon."""
        return -float((self.corners @ self.sides[:, :2].T + self.sides[:, 2]).amin(0).amax())


def _parts(flat: Float[Tensor, "n 2"]) -> Iterator[Float[Tensor, "m 2"]]:
    """Yield the connected groups of points in a plane, the largest first, without narrow strips and
    specks.
    """
    cells = torch.floor(flat / 0.03).long()
    cells = cells - cells.amin(0) + 3
    grid = np.zeros((cells.amax(0) + 4).tolist(), dtype=bool)
    box = np.ones((3, 3))
    grid[tuple(cells.T.numpy())] = True
    labels = np.empty(grid.shape, dtype=np.int32)
    ndimage.label(
        ndimage.binary_opening(ndimage.binary_closing(grid, box, iterations=2), box), output=labels
    )
    own = torch.from_numpy(labels[tuple(cells.T.numpy())]).long()
    count = torch.bincount(own)[1:]
    for k in torch.argsort(count, descending=True, stable=True).tolist():
        if count[k] >= 0.02 * count.max():
            yield flat[own == k + 1]


def cross(plane: Plane, points: Points, eye: Vector | None) -> tuple[Points, Bool[Tensor, "n"]]:
    """Return where the camera rays through points cross a plane [m], and which points lie behind
    the plane.

    Without a camera, the points themselves are returned, and only points at most `REACH` [m] below
    count.
    """
    height = plane.height(points)
    if eye is None:
        return points, (height < 0) & (height > -REACH)
    above = float(plane.height(eye))
    ratio = above / (above - height).clamp_min(1e-9)
    return eye + ratio[:, None] * (points - eye), height < 0


@dataclasses.dataclass(frozen=True)
class _Candidate:
    """A support, its score, and a point in the middle of its region."""

    support: SupportPlane
    score: float
    middle: Vector

    def parallel(self, other: "_Candidate") -> bool:
        """Return whether two planes are parallel within ten degrees."""
        return float(self.support.plane.normal @ other.support.plane.normal) > 0.985

    def repeats(self, other: "_Candidate") -> bool:
        """Return whether the other candidate is a fit of the same plane."""
        return self.parallel(other) and abs(float(other.support.plane.height(self.middle))) < 0.02


def _ordered(found: list[_Candidate]) -> list[_Candidate]:
    """Return the candidate supports ordered by score, with the highest wide support parallel to the
    best one first.
    """
    first = max(found, key=lambda candidate: candidate.score)
    furniture = [
        candidate
        for candidate in found
        if candidate.support.width > FURNITURE and candidate.parallel(first)
    ]
    higher = [
        candidate
        for candidate in furniture
        if float(first.support.plane.height(candidate.middle)) > 0
    ]
    first = max(higher, key=lambda candidate: candidate.score, default=first)
    return [
        first,
        *sorted((c for c in found if c is not first), key=lambda candidate: -candidate.score),
    ]


def _judge(view: SeenPoints, fit: PlaneFit, least_width: float) -> _Candidate | str:
    """Return the candidate support on a fitted plane, or as text the reason why the plane supports
    nothing.
    """
    points = view.points
    height = view.points @ fit.normal - fit.offset
    tolerance = 4 * fit.scale * view.noise + 0.001
    share = fit.count / len(points)
    if share < LEAST_SHARE:
        return f"no plane with more than {share:.1%} of the points"
    if fit.scale >= ROUGH:
        return "no flat plane"
    if view.sky is not None and float(fit.normal @ view.sky) < math.cos(math.radians(MOST_TILT)):
        return f"no plane within {MOST_TILT:g} degrees of level"
    on = height.abs() < tolerance
    plane = Plane(fit.normal, fit.offset)
    support = bound(plane, points, on, view.eye)
    if support is None or support.width < least_width:
        return f"a flat face about {0.0 if support is None else support.width:.2f} m wide"
    middle = points[on & support.covers(points)].mean(0)
    if view.eye is not None and float(unit(view.eye - middle) @ fit.normal) < math.sin(
        math.radians(5.0)
    ):
        return "a plane that the camera does not see from above"
    inner = 0.05 * support.width
    crossing, behind = cross(plane, points, view.eye)
    through = int((behind & (height < -tolerance) & support.covers(crossing, -inner)).sum())
    if through > MOST_THROUGH * fit.count:
        return f"a plane with {share:.0%} of the points, but {through / len(points):.0%} of them below it"
    # Low points of an object are over the plane's own region. A pan's rim is not over its floor.
    over = (height > tolerance) & (height < REACH) & support.covers(points, -inner)
    low = int(((height > tolerance) & (height < LOW)).sum())
    standing = int((over & (height < LOW)).sum())
    cells = (
        torch.floor(points @ _axes(fit.normal, points) / 0.02)
        .long()
        .unique(dim=0, return_inverse=True)[1]
    )
    above, below = ((sign * height > tolerance) & (sign * height < LOW) for sign in (1, -1))
    pierced = torch.bincount(cells, below.double()) > 0.2 * torch.bincount(
        cells, (above & over).double()
    )
    if int((pierced[cells] & above & over).sum()) > max(
        LEAST_STANDING * len(points), MOST_PIERCED * standing
    ):
        return f"a plane with {share:.0%} of the points, but objects go through it"
    steep = (
        view.eye is not None and float(unit(view.eye - middle) @ fit.normal) > 0.9
    )  # it hides the feet of objects
    if (int(over.sum()) if steep else standing) < max(LEAST_STANDING * len(points), 0.05 * low):
        return f"a plane with {share:.0%} of the points and nothing that stands on it"
    return _Candidate(support, standing * (2.0 if _looked_at(view, fit, support) else 1.0), middle)


def _looked_at(view: SeenPoints, fit: PlaneFit, support: SupportPlane) -> bool:
    """Return whether the middle of the view points at the region of a support; True if no camera is
    known.
    """
    if view.eye is None:
        return True
    ahead = unit(view.points - view.eye).mean(0)
    distance = (fit.offset - float(view.eye @ fit.normal)) / float(ahead @ fit.normal)
    return distance > 0 and bool(support.covers(view.eye + distance * ahead))
