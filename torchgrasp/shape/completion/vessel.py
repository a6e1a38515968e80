"""Open vessels: an outer and an inner wall about a vertical axis; the camera sees the inner wall
through the mouth.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Batch, Value
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, farthest_points, solve_least_squares, unit
from torchgrasp.shape.completion.axis import fit_axis, rotations_about_z
from torchgrasp.shape.completion.complete import NEW, merge_hidden
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.values.planning import PointCloud

# least length of the horizontal part of a wall's normals: others are of rim, floor and noise
LEVEL = 0.5
# least shares: of the walls on the body, of either wall
BODY_SHARE = 0.65
INNER_SHARE = 0.09
OUTER_SHARE = 0.07
# usual thickness [m], its deviation, and that of a fit
USUAL = 0.0035
SPREAD = 0.0015
THICKNESS_ERROR = 0.0012
RIM = (
    0.003  # points so near [m] below the rim belong to no wall: their normals depend on both walls
)
# deviations [m] of axis, form and unseen floor
CENTER_ERROR = 0.0006
FORM_ERROR = 0.001
FLOOR_ERROR = 0.003


@dataclasses.dataclass(frozen=True)
class Vessel(Value):
    """An open vessel with a vertical axis; lengths in metres."""

    center: Float[Tensor, "2"]  # position (x, y) of the axis
    thickness: float  # of the wall, the mean of the fitted and the usual one, weighted by certainty
    radius: float  # outer radius of the mouth
    rim: float  # height of the mouth
    inner: Bool[Tensor, "n"]  # mask of the points seen through the mouth
    body: Bool[Tensor, "n"]  # mask of the points on either wall, without handles, rim and floor


def find_vessel(points: Points, normals: Points) -> Vessel | None:
    """Return the open vessel that a cloud shows, or None if it shows no vessel.

    Normals of an inner wall point to the axis. Both walls are fitted at once: the outer radius is a
    cubic polynomial of the height, and the inner radius is less by the thickness over the length of
    the normal's horizontal part. Robust weights (Cauchy) ignore handles.
    """
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    level = normals[:, :2] / slope[:, None].clamp_min(1e-9)
    middle = points[:, 2].mean()
    spread = points[:, 2].std().clamp_min(1e-6)
    # noise lifts some points above the rim
    exponents = torch.arange(4, device=points.device).to(points)
    top = 0.98
    powers = ((points[:, 2:] - middle) / spread) ** exponents
    below = points[:, 2] < points[:, 2].quantile(top) - 0.002
    center = fit_axis(points, normals)
    miss = torch.zeros_like(slope)
    found = torch.zeros_like(slope)
    radius = slope
    facing = slope
    for k in range(30):
        arm = points[:, :2] - center
        radius = torch.linalg.vector_norm(arm, dim=1)
        out = unit(arm)
        facing = (out * level).sum(1)
        wall = below & (slope > LEVEL) & (facing.abs() > LEVEL)
        scale = 0.006 * (1.0 + 4.0 * 0.8**k)  # miss [m] of half the weight
        weight = (wall / (1.0 + (miss / scale) ** 2)).sqrt()[:, None]
        inside = (facing < 0) / slope.clamp_min(LEVEL)
        terms = torch.cat([powers, -inside[:, None], out], 1)  # the last two columns move the axis
        if not bool((weight > 0).sum() > 2 * terms.shape[1]):
            return None
        found = solve_least_squares(weight * terms, weight[:, 0] * radius)
        miss = radius - terms @ found
        center = center + found[-2:]
    thickness = float(found[4])

    wall = (slope > LEVEL) & (facing.abs() > LEVEL)
    body = wall & (miss.abs() < 0.002)  # [m], twice a camera's noise
    within = (points[:, :2].amin(0) < center) & (center < points[:, :2].amax(0))
    if not bool(within.all() & body.any()) or not 0.0003 < thickness < 0.012:
        return None
    rim = float(points[body, 2].quantile(top))
    mouth = float(((rim - middle) / spread) ** exponents @ found[:4])
    floor = (
        0.7  # vertical part of a normal from which a point inside the mouth belongs to the floor
    )
    inward = ((facing < 0) & (slope > 1.0 - floor)) | (normals[:, 2] > floor)
    inner = inward & (radius < mouth) & (points[:, 2] < rim - RIM)
    shares = (
        (body & inner).double().mean(),
        (body & ~inner).double().mean(),
        body.sum() / wall.sum(),
    )
    enough = all(
        float(s) > least
        for s, least in zip(shares, (INNER_SHARE, OUTER_SHARE, BODY_SHARE), strict=True)
    )
    # The recess of a lid is no cavity: the inside must be seen 12 mm below the rim.
    if not enough or not math.isfinite(mouth) or float(rim - points[inner, 2].min()) < 0.012:
        return None
    usual = 1.0 / (1.0 + (SPREAD / THICKNESS_ERROR) ** 2)
    thickness = usual * USUAL + (1.0 - usual) * thickness
    return Vessel(center, thickness, mouth, rim, inner, body & (points[:, 2] < rim - RIM))


@dataclasses.dataclass(frozen=True)
class HiddenWall(Batch):
    """Estimated points of a wall that the camera did not see [m], with outward normals.

    The columns of `shared` are errors along the normals [m] for one standard deviation of the axis
    position (two columns), the wall's thickness and the floor's height.
    """

    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    shared: Float[Tensor, "m 4"]


@dataclasses.dataclass(frozen=True)
class Wall(Value):
    """One wall of a vessel: `seen` is the mask of its cloud points, `hidden` holds estimated
    points.
    """

    seen: Bool[Tensor, "n"]
    hidden: HiddenWall


def complete_walls(
    cloud: PointCloud, vessel: Vessel, outline: Outlines, table: float
) -> tuple[Wall, Wall]:
    """Return the outer and the inner wall of a vessel on a table of height `table` [m].

    The other side of a seen wall is one thickness away. Parts seen on neither side are estimated by
    rotating the seen parts about the axis.
    """
    points = cloud.points
    normals = cloud.normals
    assert normals is not None
    every = HiddenWall(
        points, normals, torch.zeros(len(points), 4, dtype=points.dtype, device="cpu")
    )
    outside = every[vessel.body & ~vessel.inner]
    inside = every[vessel.body & vessel.inner]
    seen_floor = vessel.inner & (normals[:, 2] > 0.9)
    has_floor = int(seen_floor.sum()) > 10
    floor = float(points[seen_floor, 2].median()) if has_floor else table + vessel.thickness

    outer = _merge(
        points[~vessel.inner],
        outline,
        [_across(inside, vessel), _turn(outside, vessel)],
        vessel,
        table,
    )
    parts = [
        _across(outside, vessel),
        _turn(inside, vessel),
        _across(_turn(outside, vessel), vessel),
    ]
    if not has_floor:
        radius = float(
            torch.linalg.vector_norm(points[vessel.inner, :2] - vessel.center, dim=1).min()
        )
        parts.append(_disc(vessel, floor, radius, ((0.0, 1), (0.4, 5), (0.75, 8))))
    inner = _merge(points[vessel.inner], outline, parts, vessel, floor)
    return Wall(~vessel.inner, outer), Wall(vessel.inner, inner)


def lid(vessel: Vessel) -> HiddenWall:
    """Return points of an imagined flat lid that closes the outer surface at the rim."""
    return _disc(vessel, vessel.rim, vessel.radius, ((0.0, 1), (0.5, 6)))


def _across(wall: HiddenWall, vessel: Vessel) -> HiddenWall:
    """Return the points and normals of the opposite face of a vessel's wall, one wall thickness
    away.
    """
    shared = wall.shared.clone()
    shared[:, 2] += THICKNESS_ERROR
    return HiddenWall(wall.points - vessel.thickness * wall.normals, -wall.normals, shared)


def _turn(wall: HiddenWall, vessel: Vessel) -> HiddenWall:
    """Return 80 points of a wall, rotated about the axis by 23 angles, with the errors of the axis
    position.
    """
    wall = wall[farthest_points(wall.points, 80, tie=TIE)]
    turn = rotations_about_z(24)
    axis = torch.cat([vessel.center, torch.zeros(1, dtype=torch.float64, device="cpu")])
    points = (wall.points - axis) @ turn.mT + axis
    normals = wall.normals @ turn.mT
    moved = (
        CENTER_ERROR * (torch.eye(3, dtype=torch.float64, device="cpu") - turn)[:, None]
    )  # of points, with the axis
    shared = wall.shared.expand(len(turn), -1, -1).clone()
    shared[..., :2] += (normals[..., None, :] @ moved)[..., 0, :2]
    return HiddenWall(points.flatten(0, 1), normals.flatten(0, 1), shared.flatten(0, 1))


def _disc(
    vessel: Vessel, height: float, radius: float, rings: tuple[tuple[float, int], ...]
) -> HiddenWall:
    """Return points at one height, normals up, on rings about the axis: each (share of `radius`,
    number of points).
    """
    places = []
    for share, count in rings:
        angle = torch.arange(count, dtype=torch.float64, device="cpu") * (2 * math.pi / count)
        places.append(share * radius * torch.stack([angle.cos(), angle.sin()], 1) + vessel.center)
    level = torch.cat(places)
    points = torch.cat([level, torch.full_like(level[:, :1], height)], 1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu").expand_as(points)
    shared = torch.zeros(len(points), 4, dtype=torch.float64, device="cpu")
    shared[:, 3] = FLOOR_ERROR
    return HiddenWall(points, up, shared)


def _merge(
    seen: Points, outline: Outlines, parts: list[HiddenWall], vessel: Vessel, least: float
) -> HiddenWall:
    """Return the hidden points of the parts, between rim and `least` height, apart from seen and
    earlier points.
    """
    tree = spatial.KDTree(seen.numpy())

    def allowed(part: HiddenWall) -> Bool[Tensor, "n"]:
        within = (part.points[:, 2] < vessel.rim - RIM) & (part.points[:, 2] >= least)
        return (
            within
            & outline.hides(part.points)
            & torch.from_numpy(tree.query(part.points.numpy())[0] > NEW)
        )

    merged = merge_hidden(
        parts[0][:0], parts, allowed, lambda points: farthest_points(points, 4 * 50, tie=TIE)
    )
    return merged[farthest_points(merged.points, 50, tie=TIE)]
