"""Open vessels: an outer and an inner wall about a vertical axis. The camera sees the inner wall
through the mouth.

All is in a frame with z up, with lengths in metres.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Batch, Value
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, norm, solve_least_squares, unit
from torchgrasp.shape.completion.axis import fit_axis, rotations_about_z
from torchgrasp.shape.completion.complete import HIDDEN, merge_hidden
from torchgrasp.shape.completion.silhouette import Outlines, pick_apart
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class VesselNumbers:
    """Parameters by which an open vessel with two walls is recognised and fitted to a cloud."""

    level: float = 0.5
    """Least length of the horizontal part of a wall's unit normals: that of rim, floor and noise is
    shorter.
    """
    terms: int = 4
    """Number of coefficients of the outer radius as a polynomial of the height: those of a cubic
    one.
    """
    top: float = 0.98
    """Quantile of the heights of the points that is the top: noise lifts some points above the rim.
    """
    below_top: float = 0.002
    """Height [m] below the top from which points join the fit."""
    rounds: int = 30
    """Number of rounds of the fit; each has new weights."""
    miss: float = 0.006
    """Distance [m] of a point from its wall at which its weight in the last rounds is a half."""
    wider: float = 4.0
    """Excess of this distance over `miss` in the first round, in multiples of `miss`: the axis is
    not yet known.
    """
    narrowing: float = 0.8
    """Factor by which the excess `wider` shrinks from round to round."""
    on_body: float = 0.002
    """Greatest distance [m] of a point of the body from its wall: twice a camera's noise."""
    thinnest: float = 0.0003
    """Least thickness [m] of a fitted wall."""
    thickest: float = 0.012
    """Greatest thickness [m] of a fitted wall."""
    floor: float = 0.7
    """Vertical part of a unit normal from which a point inside the mouth belongs to the floor."""
    rim: float = 0.003
    """Height [m] below the rim within which points belong to no wall: their normals depend on both
    walls.
    """
    body_share: float = 0.65
    """Least share of the points on walls that lie on the fitted body."""
    inner_share: float = 0.09
    """Least share of the cloud that is on the inner wall."""
    outer_share: float = 0.07
    """Least share of the cloud that is on the outer wall."""
    depth: float = 0.012
    """Least depth [m] below the rim to which the inside is seen: the recess of a lid is no cavity.
    """
    usual: float = 0.0035
    """Usual thickness [m] of a wall."""
    spread: float = 0.0015
    """Standard deviation [m] of the usual thickness."""
    error: float = 0.0012
    """Standard deviation [m] of a fitted thickness."""
    least_slope: float = 1e-9
    """Least length of the horizontal part of a unit normal that is a divisor."""
    least_spread: float = 1e-6
    """Least standard deviation of the heights [m] that is a divisor."""


VESSEL = VesselNumbers()


@dataclasses.dataclass(frozen=True)
class WallNumbers:
    """Parameters of the points that complete the hidden parts of a vessel's walls."""

    center: float = 0.0006
    """Standard deviation [m] of the position of the vessel's axis, on each of two axes."""
    form: float = 0.001
    """Standard deviation [m] of a wall's form, a smooth error of its hidden points."""
    floor: float = 0.003
    """Standard deviation [m] of the height of a floor that was not seen."""
    up: float = 0.9
    """Least component along z of the unit normals of a seen floor."""
    floor_points: int = 10
    """Number of points that a seen floor must exceed."""
    floor_rings: tuple[tuple[float, int], ...] = ((0.0, 1), (0.4, 5), (0.75, 8))
    """Rings of points on an unseen floor. Each has its radius, as a share of the floor's, and its
    number of points.
    """
    lid_rings: tuple[tuple[float, int], ...] = ((0.0, 1), (0.5, 6))
    """Rings of points on a lid. Each has its radius, as a share of the lid's, and its number of
    points.
    """
    turned: int = 80
    """Greatest number of points of a wall that are rotated about the axis, to estimate its hidden
    parts.
    """
    turns: int = 24
    """Number of parts of a full circle by which these points are rotated."""
    thinned: int = 200
    """Greatest number of hidden points of one part of a wall that are compared with those of other
    parts.
    """
    budget: int = 50
    """Greatest number of hidden points of one wall."""


WALL = WallNumbers()


@dataclasses.dataclass(frozen=True)
class Vessel(Value):
    """An open vessel with a vertical axis, such as a cup, found in a cloud of n points. The frame
    is that of the cloud.

    Its outer and inner wall meet at the rim, around the mouth.
    """

    center: Float[Tensor, "2"]  # position (x, y) [m] of the axis
    # thickness [m] of the wall: mean of the fitted and the usual one, weighted by certainty
    thickness: float
    radius: float  # outer radius [m] of the mouth
    rim: float  # height [m] of the mouth, along z
    inner: Bool[Tensor, "n"]  # mask of the cloud's points that were seen through the mouth
    # mask of the cloud's points on either wall, without handles, rim and floor
    body: Bool[Tensor, "n"]


def find_vessel(
    points: Points,
    normals: Points,
    numbers: VesselNumbers = VESSEL,
) -> Vessel | None:
    """Return the open vessel, such as a cup, that a cloud shows, or None if it shows none.

    `points` (n, 3) [m] and outward unit `normals` (n, 3) are in a frame with z up. Normals of an
    inner wall point to the axis. Both walls are fitted at once. The outer radius is a cubic
    polynomial of the height. The inner radius is less by the thickness over the length of the
    normal's horizontal part. Robust weights (Cauchy) ignore handles. `numbers` are the bounds that
    a vessel must meet.
    """
    height = points[:, 2]
    slope = norm(normals[:, :2])
    level = normals[:, :2] / slope[:, None].clamp_min(numbers.least_slope)
    steep = slope > numbers.level
    middle = height.mean()
    spread = height.std().clamp_min(numbers.least_spread)
    exponents = torch.arange(numbers.terms, device=points.device).to(points)
    powers = ((points[:, 2:] - middle) / spread) ** exponents  # (n, terms)
    below = height < height.quantile(numbers.top) - numbers.below_top
    center = fit_axis(points, normals)
    miss = torch.zeros_like(slope)
    found = miss
    radius = miss
    facing = miss
    for k in range(numbers.rounds):
        arm = points[:, :2] - center
        radius = norm(arm)
        out = unit(arm)
        facing = (out * level).sum(1)
        wall = below & steep & (facing.abs() > numbers.level)
        scale = numbers.miss * (1.0 + numbers.wider * numbers.narrowing**k)
        weight = (wall / (1.0 + (miss / scale) ** 2)).sqrt()[:, None]
        inside = (facing < 0) / slope.clamp_min(numbers.level)
        # the last two columns move the axis
        terms = torch.cat([powers, -inside[:, None], out], 1)  # (n, terms + 3)
        if not bool((weight > 0).sum() > 2 * terms.shape[1]):
            return None
        found = solve_least_squares(weight * terms, weight[:, 0] * radius)
        miss = radius - terms @ found
        center = center + found[-2:]

    wall = steep & (facing.abs() > numbers.level)
    body = wall & (miss.abs() < numbers.on_body)
    low = points[:, :2].amin(0)
    high = points[:, :2].amax(0)
    within = (low < center) & (center < high)
    thickness = float(found[numbers.terms])
    if not numbers.thinnest < thickness < numbers.thickest:
        return None
    if not bool(within.all() & body.any()):
        return None

    rim = float(height[body].quantile(numbers.top))
    mouth = float(((rim - middle) / spread) ** exponents @ found[: numbers.terms])
    floor = normals[:, 2] > numbers.floor
    inward = ((facing < 0) & (slope > 1.0 - numbers.floor)) | floor
    below = height < rim - numbers.rim
    inner = inward & (radius < mouth) & below
    enough = (
        float((body & inner).double().mean()) > numbers.inner_share
        and float((body & ~inner).double().mean()) > numbers.outer_share
        and float(body.sum() / wall.sum()) > numbers.body_share
    )
    if not enough or not math.isfinite(mouth) or float(rim - height[inner].min()) < numbers.depth:
        return None
    usual = 1.0 / (1.0 + (numbers.spread / numbers.error) ** 2)
    thickness = usual * numbers.usual + (1.0 - usual) * thickness
    return Vessel(center, thickness, mouth, rim, inner, body & below)


@dataclasses.dataclass(frozen=True)
class HiddenWall(Batch):
    """Estimated points of the part of a vessel's wall that the camera did not see.

    A vessel has an outer and an inner wall about a vertical axis. Four errors move the points along
    their normals. They are those of the axis (x and y), of the wall's thickness, and of the floor's
    height.
    """

    # hidden points [m] of the wall, in the frame of the vessel's cloud
    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]  # unit normals at these points, away from the material
    # errors [m] of the points, one column for each cause at one standard deviation of it
    shared: Float[Tensor, "m 4"]


@dataclasses.dataclass(frozen=True)
class Wall(Value):
    """One wall of an open vessel, the outer or the inner one."""

    seen: Bool[Tensor, "n"]  # mask of the cloud's n points that lie on this wall
    hidden: HiddenWall  # estimated points of the part that the camera did not see


def complete_walls(
    cloud: PointCloud,
    vessel: Vessel,
    outline: Outlines,
    table: float,
) -> tuple[Wall, Wall]:
    """Return (outer, inner): the two walls of a vessel on a table, with their seen and hidden
    points.

    Args:
        cloud: the cloud [m] with normals, z up.
        vessel: the vessel that it shows.
        outline: silhouettes of the views.
        table: the table's height [m].

    The other side of a seen wall is one thickness away. Parts seen on neither side are estimated by
    rotating the seen parts about the axis.
    """
    points = cloud.points
    normals = cloud.normals
    assert normals is not None
    inner = vessel.inner
    every = HiddenWall(points, normals, points.new_zeros(len(points), 4))
    outside = every[vessel.body & ~inner]
    inside = every[vessel.body & inner]
    turned = _turn(outside, vessel)
    outer_parts = [_across(inside, vessel), turned]
    inner_parts = [
        _across(outside, vessel),
        _turn(inside, vessel),
        _across(turned, vessel),
    ]
    seen_floor = inner & (normals[:, 2] > WALL.up)
    if int(seen_floor.sum()) > WALL.floor_points:
        floor = float(points[seen_floor, 2].median())
    else:
        floor = table + vessel.thickness
        away = norm(points[inner, :2] - vessel.center)
        inner_parts.append(_disc(vessel, floor, float(away.min()), WALL.floor_rings))
    outer_hidden = _merge(points[~inner], outline, outer_parts, vessel, table)
    inner_hidden = _merge(points[inner], outline, inner_parts, vessel, floor)
    return Wall(~inner, outer_hidden), Wall(inner, inner_hidden)


def lid(vessel: Vessel) -> HiddenWall:
    """Return 7 points on an imagined flat lid that closes a vessel's outer surface at its rim. They
    are in the frame of the vessel.
    """
    return _disc(vessel, vessel.rim, vessel.radius, WALL.lid_rings)


def _across(wall: HiddenWall, vessel: Vessel) -> HiddenWall:
    """Return the points and normals of the opposite face of a vessel's wall, one wall thickness
    away.
    """
    shared = wall.shared.clone()
    shared[:, 2] += VESSEL.error
    return HiddenWall(wall.points - vessel.thickness * wall.normals, -wall.normals, shared)


def _turn(wall: HiddenWall, vessel: Vessel) -> HiddenWall:
    """Return some points of a wall, rotated about the axis by parts of a full circle. Return also
    the errors of the axis position.
    """
    wall = wall[pick_apart(wall.points, WALL.turned)]
    turn = rotations_about_z(WALL.turns)  # (k, 3, 3)
    axis = torch.cat([vessel.center, turn.new_zeros(1)])
    points = (wall.points - axis) @ turn.mT + axis  # (k, m, 3)
    normals = wall.normals @ turn.mT
    # how points move with the axis
    moved = WALL.center * (torch.eye(3).to(turn) - turn)[:, None]
    shared = wall.shared.expand(len(turn), -1, -1).clone()
    shared[..., :2] += (normals[..., None, :] @ moved)[..., 0, :2]
    return HiddenWall(points.flatten(0, 1), normals.flatten(0, 1), shared.flatten(0, 1))


def _disc(
    vessel: Vessel,
    height: float,
    radius: float,
    rings: tuple[tuple[float, int], ...],
) -> HiddenWall:
    """Return points at one height, normals up, on rings about the axis: each (share of `radius`,
    number of points).
    """
    places = []
    for share, count in rings:
        angle = torch.arange(count).to(vessel.center) * (2 * math.pi / count)
        ring = torch.stack([angle.cos(), angle.sin()], 1)
        places.append(share * radius * ring + vessel.center)
    level = torch.cat(places)
    points = torch.cat([level, torch.full_like(level[:, :1], height)], 1)
    up = torch.zeros_like(points)
    up[:, 2] = 1.0
    shared = points.new_zeros(len(points), 4)
    shared[:, 3] = WALL.floor
    return HiddenWall(points, up, shared)


def _merge(
    seen: Points,
    outline: Outlines,
    parts: list[HiddenWall],
    vessel: Vessel,
    least: float,
) -> HiddenWall:
    """Return the hidden points of the parts, between rim and `least` height, apart from seen and
    earlier points.
    """
    tree = spatial.KDTree(seen.numpy())

    def allowed(part: HiddenWall) -> Bool[Tensor, "n"]:
        height = part.points[:, 2]
        within = (height < vessel.rim - VESSEL.rim) & (height >= least)
        new = torch.from_numpy(tree.query(part.points.numpy())[0] > HIDDEN.new)
        return within & outline.hides(part.points) & new

    def thin(points: Points) -> Tensor:
        return pick_apart(points, WALL.thinned)

    merged = merge_hidden(parts[0][:0], parts, allowed, thin)
    return merged[pick_apart(merged.points, WALL.budget)]
