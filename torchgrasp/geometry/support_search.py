"""Search for supports in a view: planes with objects on them.

All points are in one frame, which may be any.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.checks import check_tensor
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.geometry.linalg import Points, Vector, norm, number_cells, unit
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.geometry.plane_fit import (
    PLANES,
    PlaneFit,
    SeenPoints,
    assume_noise,
    fit_planes,
    plane_axes,
    refine_plane,
)
from torchgrasp.geometry.support_planes import SUPPORTS, SupportPlane, bound, cross

# what a view must show
SUPPORT = "a plane with objects on it and nothing seen through it, or a table that is given"


@dataclasses.dataclass(frozen=True)
class Target:
    """An object that is to be grasped, and whose support (the plane under it) is sought: some of
    its points.
    """

    points: Points  # points (n, 3) [m] of the object

    def stands_on(self, support: SupportPlane) -> bool:
        """Return whether the object is over the region of a support, with its foot near the plane.

        More than half of its points must be over the region, or at most 50 mm (`SUPPORTS.overhang`)
        beside it. Its foot is the height above which 98 % of its points are. The foot must be less
        than 0.15 m (`SUPPORTS.afloat`) above the plane, or less than 30 mm (`SUPPORTS.foot`) below
        it. The support is in the frame of the points.
        """
        height = support.plane.height(self.points)
        foot = float(height.quantile(SUPPORTS.outliers))
        over = support.covers(self.points, SUPPORTS.overhang).double().mean()
        return -SUPPORTS.foot < foot < SUPPORTS.afloat and float(over) > SUPPORTS.over


def find_table(
    points: Points,
    viewpoint: Vector,
    table: Plane | float | None,
    up: object,
    target: Target | None = None,
    image_up: Vector | None = None,
) -> tuple[SupportPlane, ...]:
    """Return the support that a given table is, or the supports found in a view, the most plausible
    first.

    Args:
        points: the points (n, 3) [m] of the view; all arguments are in their frame.
        viewpoint: position (3,) [m] of the camera.
        table: the table as a plane without an `edge`, or its height [m] along z; None to search for
            supports.
        up: upward direction, three numbers of any length; None if unknown.
        target: the object to grasp; None if unknown. Supports on which it stands come first.
        image_up: direction (3,) that points up in the camera's image; None if unknown.

    A support has the region that the points on it cover. The region of a given table is unbounded
    if they cover none.

    Raises `BadArgument` for a camera below the given table, or a `Plane` that has an `edge`. Raises
    it also for `up` more than 60 degrees from the given table's normal. Raises `NoSupport` if no
    support is found.
    """
    plane = as_plane(table)
    if plane is not None and plane.edge is not None:
        allowed = "one without an edge, which `ContactSpec` alone takes"
        raise BadArgument("table", "a table with an edge", allowed)
    direction = None if up is None else torch.as_tensor(up, dtype=torch.float64).cpu()
    if plane is None:
        return _find_under(target, points, viewpoint, direction, image_up)
    if direction is not None and float(unit(direction) @ plane.normal.double()) < 0.5:
        allowed = "a direction within 60 degrees of the table's normal"
        raise BadArgument("up", direction.tolist(), allowed)
    above = float(plane.height(viewpoint))
    if above <= 0:
        raise BadArgument("table", f"the camera {-above:.3g} m below it", "a table below it")
    points = points.double().cpu()
    eye = viewpoint.double().cpu()
    points = points[:: 1 + len(points) // SUPPORTS.points]
    on = plane.height(points).abs() < PLANES.core * assume_noise(points, eye)
    return (bound(plane, points, on, eye) or SupportPlane(plane),)


def _find_under(
    target: Target | None,
    points: Points,
    viewpoint: Vector,
    up: Vector | None,
    image_up: Vector | None,
) -> tuple[SupportPlane, ...]:
    """Return the supports in a view; those that carry the target first.

    If none does, a plane under the target is sought close to it, too. The arguments are those of
    `find_table`.
    """
    if target is None:
        return find_supports(points, viewpoint, up, image_up=image_up)
    missing = None
    found: tuple[SupportPlane, ...] = ()
    try:
        found = find_supports(points, viewpoint, up, image_up=image_up)
    except NoSupport as error:
        missing = error
    carrying = [support for support in found if target.stands_on(support)]
    if not carrying:
        carrying = _support_near(target, points.double().cpu(), viewpoint.double().cpu(), up)
    if not found and not carrying and missing is not None:
        raise missing
    return (*carrying, *(support for support in found if support not in carrying))


def _support_near(
    target: Target, points: Points, eye: Vector, up: Vector | None
) -> list[SupportPlane]:
    """Return the plane on which a target stands among the `points` [m] close to it, in a list. The
    list is empty without one.

    A bowed or soft support has such a plane, although no plane holds its whole surface.
    """
    middle = target.points.mean(0)
    radius = float(norm(target.points - middle).quantile(1 - SUPPORTS.outliers))
    points = points[norm(points - middle) < radius + SUPPORTS.near]
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randperm(len(points), generator=generator, device="cpu")[: SUPPORTS.points]
    if len(drawn) < SUPPORTS.least_points:
        return []
    view = SeenPoints(
        points[drawn] - middle, eye - middle, None if up is None else unit(up.double().cpu())
    )
    near = dataclasses.replace(target, points=target.points - middle)
    for fit in fit_planes(view, generator):
        surface = _FlatSurface.of(view, fit)
        support = surface.support
        if support is None or not near.stands_on(support):
            continue
        deep = surface.height < -SUPPORTS.shallow - surface.tolerance
        below = float((deep & support.covers(view.points)).double().mean())
        # its own face holds most of the target
        face = support.plane.height(near.points).abs() < surface.tolerance.median()
        if below < SUPPORTS.outliers and 2 * int(face.sum()) < len(face):
            return [dataclasses.replace(support, local=True).moved(middle)]
    return []


def find_supports(
    points: Points,
    viewpoint: Vector | None = None,
    up: Vector | None = None,
    least_width: float = SUPPORTS.least_width,
    image_up: Vector | None = None,
) -> tuple[SupportPlane, ...]:
    """Return the planes that support objects in a view, the most plausible first.

    Args:
        points: the points (n, 3) [m] of the view; all arguments are in their frame.
        viewpoint: position (3,) [m] of the camera; None if unknown: then the side with more points
            is the upper one.
        up: upward direction (3,) of any length; None allows any direction.
        least_width: least width [m] of a support's region.
        image_up: direction (3,) that points up in the camera's image; None if unknown.

    Triples of points propose planes. An iterated fit with Tukey's weights refines each plane.
    Objects stand on a support, over its region, and the camera sees nothing through the region. The
    support with the most points low above it (up to 60 mm, `SUPPORTS.low`) comes first. The points
    count twice if the camera looks at the support, and half if it is bowed. They count a quarter if
    the camera would have to be upside down to see it from above. Points that lie on another plane,
    perhaps a wall, count a quarter, too. Walls beside the first support, on which far fewer points
    stand, are left out. Of parallel supports, a higher one at least 0.3 m wide
    (`SUPPORTS.furniture`) comes first. A rigid motion of all arguments moves the supports alike.

    Raises `NoSupport` if there is none.
    """
    points = check_tensor("points", points, (None, 3)).detach().cpu().double()
    eye = sky = None
    if viewpoint is not None:
        eye = check_tensor("viewpoint", viewpoint, (3,)).detach().cpu().double()
    if up is not None:
        sky = unit(check_tensor("up", up, (3,)).detach().cpu().double())
    if image_up is not None:
        image_up = unit(check_tensor("image_up", image_up, (3,)).detach().cpu().double())
    if len(points) < SUPPORTS.least_points:
        raise NoSupport("table", f"{len(points)} points", SUPPORT)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randperm(len(points), generator=generator, device="cpu")[: SUPPORTS.points]
    points = points[drawn]
    # The points are centred so that distant origins cost no digits.
    centre = points.mean(0)
    view = SeenPoints(points - centre, None if eye is None else eye - centre, sky, image_up)
    surfaces = [_FlatSurface.of(view, fit) for fit in fit_planes(view, generator)]
    found: list[_Candidate] = []
    reasons: list[str] = []
    for surface in surfaces:
        judged = _judge(view, surface, surfaces, least_width)
        if isinstance(judged, str):
            reasons.append(judged)
        elif not any(judged.repeats(other) for other in found):
            found.append(judged)
    if not found:
        raise NoSupport("table", reasons[0] if reasons else "no plane with enough points", SUPPORT)
    ordered = _ordered(found)
    best = ordered[0]
    least = SUPPORTS.plausible * best.score
    likely = [one for one in ordered if one.score >= least or one.parallel(best)]
    return tuple(candidate.support.moved(centre) for candidate in likely)


@dataclasses.dataclass(frozen=True)
class _Candidate:
    """A support, its score (points low above it), and a point [m] in the middle of its region.

    `thickness` [m] is the usual greatest distance of a point on it.
    """

    support: SupportPlane
    score: float
    middle: Vector
    thickness: float

    def parallel(self, other: "_Candidate") -> bool:
        """Return whether two planes are parallel within ten degrees."""
        cosine = float(self.support.plane.normal @ other.support.plane.normal)
        return cosine > SUPPORTS.parallel

    def repeats(self, other: "_Candidate") -> bool:
        """Return whether the other candidate is a fit of the same plane."""
        height = float(other.support.plane.height(self.middle))
        same = min(SUPPORTS.same, max(self.thickness, other.thickness))
        return self.parallel(other) and abs(height) < same


def _ordered(found: list[_Candidate]) -> list[_Candidate]:
    """Return the candidate supports ordered by score, with the best wide support parallel to the
    best one and higher first.
    """
    found = sorted(found, key=lambda candidate: -candidate.score)
    best = found[0]
    for candidate in found[1:]:
        wide = candidate.support.width > SUPPORTS.furniture and candidate.parallel(best)
        if wide and float(best.support.plane.height(candidate.middle)) > 0:
            return [candidate, *(other for other in found if other is not candidate)]
    return found


def _refit(view: SeenPoints, fit: PlaneFit) -> PlaneFit:
    """Return a rough plane fitted again, to the largest group of points on it. Without this, walls
    that a small or bowed support cuts turn its plane away.
    """
    height = view.points @ fit.normal - fit.offset
    on = height.abs() < PLANES.core * view.noise
    plane = Plane(fit.normal, fit.offset)
    support = bound(plane, view.points, on, view.eye)
    if support is None:
        return fit
    own = support.covers(view.points) & (height.abs() < SUPPORTS.bow)
    if int(own.sum()) < SUPPORTS.least_points:
        return fit
    return refine_plane(view.part(own), fit.normal, fit.offset)


@dataclasses.dataclass(frozen=True)
class _FlatSurface:
    """A plane that was fitted to a view, the points on it, and its region.

    `height` [m] is that of each point of the view. `tolerance` [m] is the greatest height of a
    point on the plane, above or below. `support` is None without a flat region. `bowed` tells that
    the plane was fitted to a part of the points alone.
    """

    fit: PlaneFit
    height: Float[Tensor, "n"]
    tolerance: Float[Tensor, "n"]
    support: SupportPlane | None
    bowed: bool

    @classmethod
    def of(cls, view: SeenPoints, fit: PlaneFit) -> "_FlatSurface":
        """Return the surface of a fit, its normal turned to the upper side."""
        bowed = fit.scale >= PLANES.rough
        fit = (_refit(view, fit) if bowed else fit).turned_up(view)
        bowed = bowed and fit.scale > SUPPORTS.flat
        height = view.points @ fit.normal - fit.offset
        tolerance = SUPPORTS.thickness * fit.scale * view.noise + SUPPORTS.least_thickness
        if bowed:
            tolerance = tolerance.clamp_max(SUPPORTS.bow)
        flat = fit.scale < PLANES.rough and fit.count >= PLANES.least_share * len(height)
        plane = Plane(fit.normal, fit.offset)
        support = bound(plane, view.points, height.abs() < tolerance, view.eye) if flat else None
        if support is not None:
            support = dataclasses.replace(support, local=bowed)
        return cls(fit, height, tolerance, support, bowed)

    @property
    def on(self) -> Bool[Tensor, "n"]:
        """Mask of the points on the plane."""
        return self.height.abs() < self.tolerance

    def beside(self, other: "_FlatSurface") -> bool:
        """Return whether this surface is at an angle to another one, as a wall to a table."""
        return abs(float(self.fit.normal @ other.fit.normal)) < SUPPORTS.askew

    def level_with(self, other: "_FlatSurface") -> bool:
        """Return whether this surface is parallel to another one that is flat, and as wide as
        furniture.
        """
        cosine = abs(float(self.fit.normal @ other.fit.normal))
        return cosine > SUPPORTS.parallel and not other.bowed and other.width > SUPPORTS.furniture

    @property
    def width(self) -> float:
        """The least width [m] of the region."""
        return 0.0 if self.support is None else self.support.width


def _judge(
    view: SeenPoints, surface: _FlatSurface, surfaces: list[_FlatSurface], least_width: float
) -> _Candidate | str:
    """Return the candidate support on a surface, or as text the reason why it supports nothing.

    Of the other `surfaces`, those of furniture do not stand on it.
    """
    support = surface.support
    wide = least_width
    if surface.bowed:
        level = any(surface.level_with(other) for other in surfaces if other is not surface)
        wide = SUPPORTS.small_table if level else SUPPORTS.furniture
    reason = _refuse_plane(view, surface)
    if reason:
        return reason
    if _is_wall(view, surface, surfaces):
        return "a plane that is level only for a camera upside down, beside a larger one"
    # a narrower round face belongs to an object
    if support is None or support.width < wide:
        return f"a flat face about {surface.width:.2f} m wide"
    own = surface.on & support.covers(view.points)
    middle = view.points[own].mean(0)
    if surface.bowed and _bends_away(view, surface, support, int(own.sum())):
        return "a part of a surface that bends away"
    # Without a camera, no object hides its feet.
    steep = False
    if view.eye is not None:
        sine = float(unit(view.eye - middle) @ surface.fit.normal)
        if sine < math.sin(math.radians(SUPPORTS.grazing)):
            return "a plane that the camera does not see from above"
        steep = sine > SUPPORTS.steep

    total = len(view.points)
    told = f"a plane with {surface.fit.count / total:.0%} of the points"
    through = _count_through(view, surface, support)
    if through > SUPPORTS.most_through * surface.fit.count:
        return f"{told}, but {through / total:.0%} of them below it"
    risen = _Risen.on(view, surface, support, _furniture(surface, surfaces, SUPPORTS.furniture))
    least = SUPPORTS.least_standing * total
    count = int(risen.standing.sum())
    if _count_pierced(view, surface, risen) > max(least, SUPPORTS.most_pierced * count):
        return f"{told}, but objects go through it"
    # From a steep view, objects hide their feet.
    feet = int(risen.over.sum()) if steep else count
    if feet < max(least, SUPPORTS.least_low * int(risen.low.sum())):
        return f"{told} and nothing that stands on it"

    plain = _furniture(surface, surfaces, least_width)
    favour = SUPPORTS.favour if _looked_at(view, surface.fit, support) else 1.0
    favour *= SUPPORTS.bowed if surface.bowed else 1.0
    favour *= SUPPORTS.upside_down if _leans(view, surface) < -SUPPORTS.downward else 1.0
    score = count - SUPPORTS.plain * int((risen.standing & plain).sum())
    return _Candidate(support, score * favour, middle, float(surface.tolerance[own].median()))


def _refuse_plane(view: SeenPoints, surface: _FlatSurface) -> str:
    """Return the reason why a fit is no plane that may be level; an empty text if it may be."""
    fit = surface.fit
    share = fit.count / len(view.points)
    if share < PLANES.least_share:
        return f"no plane with more than {share:.1%} of the points"
    if fit.scale >= PLANES.rough:
        return "no flat plane"
    level = math.cos(math.radians(PLANES.most_tilt))
    if view.sky is not None and float(fit.normal @ view.sky) < level:
        return f"no plane within {PLANES.most_tilt:g} degrees of level"
    return ""


def _leans(view: SeenPoints, surface: _FlatSurface) -> float:
    """Return the cosine between a surface's normal and the image's upward direction; 0 if that is
    unknown.
    """
    return 0.0 if view.image_up is None else float(surface.fit.normal @ view.image_up)


def _is_wall(view: SeenPoints, surface: _FlatSurface, surfaces: list[_FlatSurface]) -> bool:
    """Return whether a surface is level for a camera upside down alone, and may be a wall.

    Beside a wall is a larger surface that is level for an upright camera. It is at an angle to the
    wall, and as wide as furniture.
    """
    if _leans(view, surface) > -SUPPORTS.downward:
        return False
    return any(
        _leans(view, other) > SUPPORTS.downward
        and other.beside(surface)
        and other.width > SUPPORTS.furniture
        and other.fit.count > surface.fit.count
        for other in surfaces
    )


def _bends_away(view: SeenPoints, surface: _FlatSurface, support: SupportPlane, own: int) -> bool:
    """Return whether many points around the region of a support are near its plane, but off it.

    `own` is the number of points on the support.
    """
    around = support.covers(view.points, SUPPORTS.margin) & ~support.covers(view.points)
    away = around & ~surface.on & (surface.height.abs() < SUPPORTS.low)
    return int(away.sum()) > SUPPORTS.most_away * own


def _count_through(view: SeenPoints, surface: _FlatSurface, support: SupportPlane) -> int:
    """Return the number of points that the camera sees through the region of a support."""
    inner = SUPPORTS.edge * support.width
    crossing, behind = cross(support.plane, view.points, view.eye)
    seen = behind & (surface.height < -surface.tolerance) & support.covers(crossing, -inner)
    axes = plane_axes(surface.fit.normal, view.points)
    # slats show what is behind them beside points of their own
    cell = number_cells(crossing @ axes, SUPPORTS.cell)
    slats = torch.bincount(cell, surface.on.double())
    gaps = torch.bincount(cell, seen.double())
    slatted = slats > SUPPORTS.slats * gaps
    return int((seen & ~slatted[cell]).sum())


def _furniture(
    surface: _FlatSurface, surfaces: list[_FlatSurface], width: float
) -> Bool[Tensor, "n"]:
    """Return a mask of the points on surfaces wider than `width` [m] at an angle to `surface`."""
    found = torch.zeros_like(surface.on)
    for other in surfaces:
        if other.beside(surface) and other.width > width:
            found |= other.on
    return found


@dataclasses.dataclass(frozen=True)
class _Risen:
    """Masks of the points above a support that are not those of furniture.

    Points `over` the support are above its own region and within reach. Points that are `low` are
    near its plane. Points of both kinds are of objects that are `standing` on it.
    """

    over: Bool[Tensor, "n"]
    low: Bool[Tensor, "n"]

    @classmethod
    def on(
        cls,
        view: SeenPoints,
        surface: _FlatSurface,
        support: SupportPlane,
        furniture: Bool[Tensor, "n"],
    ) -> "_Risen":
        """Return the masks of the points of a view, given a mask of those of furniture."""
        above = (surface.height > surface.tolerance) & ~furniture
        # Low points of an object are over the plane's own region. A pan's rim is not over the floor.
        inner = SUPPORTS.edge * support.width
        near = surface.height < PLANES.reach
        over = above & near & support.covers(view.points, -inner)
        return cls(over, above & (surface.height < SUPPORTS.low))

    @property
    def standing(self) -> Bool[Tensor, "n"]:
        """Mask of the points of objects that stand on the support."""
        return self.over & self.low


def _count_pierced(view: SeenPoints, surface: _FlatSurface, risen: _Risen) -> int:
    """Return the number of standing points with many points below the plane under them."""
    depth = -surface.height
    below = (depth > SUPPORTS.sag * surface.tolerance) & (depth < SUPPORTS.low)
    axes = plane_axes(surface.fit.normal, view.points)
    cell = number_cells(view.points @ axes, SUPPORTS.pierced_cell)
    under = torch.bincount(cell, below.double())
    standing = torch.bincount(cell, risen.standing.double())
    pierced = under > SUPPORTS.below * standing
    return int((pierced[cell] & risen.standing).sum())


def _looked_at(view: SeenPoints, fit: PlaneFit, support: SupportPlane) -> bool:
    """Return whether the middle of the view points at the region of a support; True if no camera is
    known.
    """
    if view.eye is None:
        return True
    ahead = unit(view.points - view.eye).mean(0)
    distance = (fit.offset - float(view.eye @ fit.normal)) / float(ahead @ fit.normal)
    return distance > 0 and bool(support.covers(view.eye + distance * ahead))
