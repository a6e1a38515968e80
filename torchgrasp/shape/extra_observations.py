"""Observations in addition to the seen points: inside and outside, on the hidden side, in free
space.

A normalised length is in units of the `scale` [m] of a surface's frame.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.prepare import PreparedCloud
from torchgrasp.foundation.base import Value, flatnonzero, join
from torchgrasp.geometry.linalg import Points, fibonacci_sphere, norm, unit
from torchgrasp.shape.completion.complete import HIDDEN, Completion, Kind, correlated_errors
from torchgrasp.shape.completion.silhouette import (
    OUTLINE,
    Outlines,
    Silhouette,
    find_middle,
    pick_apart,
)
from torchgrasp.shape.completion.symmetry import AXIS
from torchgrasp.shape.completion.vessel import (
    VESSEL,
    WALL,
    HiddenWall,
    Vessel,
    Wall,
    complete_walls,
    lid,
)
from torchgrasp.shape.estimate import Normalisation, Observations, off_surface, on_surface
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class OutsideNumbers:
    """Parameters of the observed points on a sphere around the object."""

    points: int = 20
    """Number of points on the sphere (Sec. 3.1 of the paper)."""
    radius: float = 1.2
    """Radius of the sphere, normalised."""
    noise: float = 0.3
    """Standard deviation of an observed distance of these points, normalised. The distance is that
    of the nearest surface point, too long where these are sparse.
    """


OUTSIDE = OutsideNumbers()


@dataclasses.dataclass(frozen=True)
class ObservationNumbers:
    """Standard deviations of what a shape's Gaussian process observes: normals, outline points and
    free-space distances.
    """

    normal: float = 0.05
    """Standard deviation of each component of a unit normal on the seen side."""
    rim_normal: float = 0.5
    """Standard deviation of each component of a unit normal on the outline."""
    hidden_normal: float = 0.25
    """Standard deviation of each component of a unit normal on the hidden side."""
    vessel_rim_normal: float = 0.5
    """Standard deviation of each component of a unit normal on a vessel's outline."""
    rim: float = 0.002
    """Standard deviation [m] of a point of the outline."""
    free: float = 0.003
    """Standard deviation [m] of a distance from a point in free space to the surface. The distance
    is only a lower bound.
    """


NOISE = ObservationNumbers()


@dataclasses.dataclass(frozen=True)
class FreeNumbers:
    """Parameters of the points in free space at which the object's distance is bounded."""

    outline_error: float = 0.005
    """Distance [m] by which the object may reach beyond its outline for a given camera, as a camera
    loses rims.
    """
    estimated_error: float = 0.010
    """Distance [m] by which the object may reach beyond its outline for a camera whose position is
    estimated.
    """
    radius: float = 1.15
    """Ratio of the radius within which free space is observed to that of all points."""
    ground: int = 9
    """Number of points along each side of a square grid below the table."""
    ground_side: float = 0.9
    """Half the side of the square grid below the table, normalised."""
    below: tuple[float, ...] = (0.003, 0.012)
    """Depths [m] below the table of the points of the square grid."""
    least: float = 0.001
    """Least distance [m] from the surface that is used as a bound."""
    beside: tuple[float, ...] = (0.008, 0.016)
    """Distances [m] of camera rays from the outline."""
    rays: int = 32
    """Number of camera rays at each distance `beside` the outline."""
    depths: int = 13
    """Number of points along each ray, over the object's depth."""
    violation: float = 0.002
    """Depth [m] of a point of free space inside the shape from which on the point violates free
    space.
    """
    violations: int = 16
    """Greatest number of points that violate free space and are observed in addition, in one round.
    """


FREE = FreeNumbers()


@dataclasses.dataclass(frozen=True)
class MiddleNumbers:
    """Parameters of the observed points in the middle of a vessel's wall and above its rim."""

    points: int = 150
    """Greatest number of points in the middle of a vessel's wall."""
    side: float = 0.8
    """Greatest vertical part of the unit normals of a vessel's sides: a floor may be thicker than
    known.
    """
    over: float = 0.5
    """Height of an observed point above the vessel's rim, in radii of its mouth. The inner surface
    has no lid, so it surrounds free space there, too.
    """


MIDDLE = MiddleNumbers()
STD_FACTORS: dict[tuple[Kind, bool], float] = {
    ("ball", True): 0.5,
    ("revolution", True): 0.56,
    ("mirrored", True): 0.59,
    ("vessel", True): 0.58,
    ("ball", False): 0.56,
    ("revolution", False): 0.59,
    ("mirrored", False): 0.75,
    ("guess", True): 1.0,
    ("cut off", True): 2.0,
    ("whole", True): 0.5,
    ("guess", False): 1.0,
    ("cut off", False): 2.0,
    ("whole", False): 0.5,
}
"""Ratio of real errors to the posterior's standard deviations, by kind of hidden side and whether
the table is known.

`scripts/train.py bands DIR` fits them.
"""
ESTIMATED = 1.15
"""Ratio by which errors are greater where the camera was estimated: outline and free space are less
exact then.
"""
# observations of n points, and the correlated errors (n, c) of their distances, normalised
Part = tuple[Observations, Tensor | None]
"""Observations of m points, and the normalised errors (m, c) that they share: a column for each of c
causes. None means no shared errors.
"""
FreeSpace = tuple[Points, Float[Tensor, "n"]]
"""Points (n, 3) in free space, and the least signed distances (n,) there, both normalised."""


@dataclasses.dataclass(frozen=True)
class ExtraObservations(Value):
    """What the Gaussian process of a surface observes in addition to the points of the cloud, in a
    normalised frame.
    """

    frame: Normalisation  # the normalised frame of the surface
    # observed distances at points inside and outside the object, without normals
    anchors: Observations
    normal_noise: float  # standard deviation of the components of the cloud's unit normals
    # ratio of the surface's true deviations to the posterior's standard deviations
    std_factor: float = 1.0
    # observations of the outline and of the hidden side, each with the errors (m, c) that its
    # points share, one column for each cause; None: no shared errors
    parts: tuple[Part, ...] = ()
    # points in free space, with lower bounds of their signed distances; None if they are not used
    free: FreeSpace | None = None
    # mask of the points of the cloud that are on this surface; None means all
    rows: Bool[Tensor, "rows"] | None = None
    kind: Kind = "guess"  # how the hidden side was completed, such as "mirrored"


def paper_support(
    seen: PreparedCloud,
    noise: float,
    generator: torch.Generator,
) -> ExtraObservations:
    """Return the paper's observations in addition to the cloud: its centre, and random points
    outside (Sec. 3.1).

    The centre is inside, at distance -1. 20 points (`OUTSIDE.points`) on a sphere of radius 1.2
    have the distance 1, all normalised. `seen` is the cloud [m], and `noise` the standard deviation
    of distances (normalised) and of components of normals. `generator` draws the points.
    """
    center = seen.points.mean(0)
    scale = float(norm(seen.points - center).max())
    draws = torch.randn(OUTSIDE.points, 3, dtype=torch.float64, device="cpu", generator=generator)
    sphere = unit(draws).to(center)
    x = torch.cat([torch.zeros_like(center)[None], OUTSIDE.radius * sphere])
    distance = torch.cat([-torch.ones_like(center[:1]), torch.ones_like(sphere[:, 0])])
    return ExtraObservations(Normalisation(center, scale), off_surface(x, distance, noise), noise)


def frame_around(points: Points) -> Normalisation:
    """Return the normalised frame of points (n, 3) [m].

    Its origin is the centre of the points' bounding box. Its scale [m] is the distance of the
    farthest point from there.
    """
    center = find_middle(points)
    scale = float(norm(points - center).max())
    return Normalisation(center, scale)


def camera_support(
    seen: PreparedCloud,
    completion: Completion | None,
    noise: float,
    table: float | None,
) -> ExtraObservations:
    """Return the observations that `fit_shape` adds to the cloud's points with the support
    "camera".

    Points on a sphere around the object are observed, and its centre if that is inside. Their
    distances are those of the nearest points on the surface. For a view, the outline, the hidden
    side and free space are observed, too.

    Args:
        seen: the cloud [m], in a frame with z up.
        completion: the estimated hidden side of a view; None for points from all sides.
        noise: standard deviation of the distance observed at the centre, normalised.
        table: the table's height [m]; None means no table.
    """
    kind: Kind = "whole"
    parts = ()
    free = None
    inside = True
    surface = seen.points
    around = surface
    if completion is not None:
        kind = completion.kind
        surface = torch.cat([seen.points, completion.points.to(seen.points)])
        # The domain holds the whole of a ball. Of others the hidden side is too uncertain to set
        # the scale.
        if kind == "ball":
            around = surface
    frame = frame_around(around)
    center = frame.center
    if completion is not None:
        parts = _observe_completion(completion, frame)
        reach = 1.0
        if completion.frame:
            reach = float(norm(frame.normalise(surface)).max())
        error = FREE.estimated_error if seen.estimated else FREE.outline_error
        free = free_space(completion.outline, frame, table, reach, error)
        # the centre of an arch or of a bowl is not inside
        inside = not completion.frame and float(completion.outline.violation(center.cpu())) == 0.0
    sphere = OUTSIDE.radius * fibonacci_sphere(OUTSIDE.points).to(center)
    x = torch.cat([torch.zeros_like(center)[None], sphere]) if inside else sphere
    distance = torch.cdist(x, frame.normalise(surface)).amin(1)
    count = len(x) - OUTSIDE.points
    inner = off_surface(x[:count], -distance[:count], noise)
    outer = off_surface(sphere, distance[count:], OUTSIDE.noise)
    factor = STD_FACTORS[kind, table is not None]
    if completion is not None and seen.estimated:
        factor = ESTIMATED * factor
    anchors = join([inner, outer])
    return ExtraObservations(frame, anchors, NOISE.normal, factor, parts, free, kind=kind)


def _observe_completion(completion: Completion, frame: Normalisation) -> tuple[Part, ...]:
    """Return observations of points on the outline and on the hidden side, and the errors that they
    share.
    """
    hidden = observe(
        frame, completion.points, completion.normals, HIDDEN.noise, NOISE.hidden_normal
    )
    # slope of a field with that deviation and length
    tilt = (completion.asymmetry / HIDDEN.part).to(frame.center)
    hidden = dataclasses.replace(hidden, normal_noise=torch.hypot(hidden.normal_noise, tilt))
    rim = _observe_rim(completion.outline, frame, NOISE.rim_normal)
    return rim, (hidden, completion.deviations.to(frame.center) / frame.scale)


def _observe_rim(outline: Outlines, frame: Normalisation, normal_noise: float) -> Part:
    """Return observations of points on the outline."""
    return observe(frame, outline.rim, outline.rim_normals, NOISE.rim, normal_noise), None


def observe(
    frame: Normalisation,
    points: Points,
    normals: Points,
    noise: float,
    normal_noise: float,
) -> Observations:
    """Return observations, normalised by `frame`, of n surface points (n, 3) [m] with outward unit
    normals.

    `noise` is the points' standard deviation [m] along the normals, and `normal_noise` that of a
    normal's components.
    """
    x = frame.normalise(points.to(frame.center))
    deviation = torch.full_like(x[:, 0], noise / frame.scale)
    return on_surface(x, normals.to(x), deviation, normal_noise)


@dataclasses.dataclass(frozen=True)
class Middle(Value):
    """Points in the middle of the wall of an open vessel, and the wall's thickness."""

    x: Points  # points (n, 3) in the middle of the wall, normalised
    side: Bool[Tensor, "n"]  # mask of the points in the vessel's sides, not in its floor
    thickness: float  # thickness of the wall, normalised


def vessel_supports(
    cloud: PointCloud,
    vessel: Vessel,
    outline: Outlines,
    table: float,
    noise: float,
) -> tuple[ExtraObservations, ExtraObservations, Middle]:
    """Return (outer, inner, middle): observations of a vessel's two surfaces, and points in its
    wall.

    Args:
        cloud: the seen points [m] with normals, in a frame with z up.
        vessel: the vessel that the cloud shows.
        outline: silhouettes of the views.
        table: the table's height [m].
        noise: standard deviation of the distances observed off the surface, normalised.

    Both surfaces have observations in addition to their seen points. The signed distances of the
    inner surface are positive in the cavity.
    """
    device = cloud.points.device
    cloud = cloud.to("cpu")
    frame = frame_around(cloud.points)
    outer, inner = complete_walls(cloud, vessel, outline, table)
    hidden = join([outer.hidden, lid(vessel)])
    up = AXIS[0]
    axis = torch.cat([vessel.center, up.new_zeros(1)])
    sphere = frame.metres(OUTSIDE.radius * fibonacci_sphere(OUTSIDE.points))

    def support(
        points: Points,
        distance: Float[Tensor, "n"],
        parts: list[Part],
        rows: Bool[Tensor, "rows"],
    ) -> ExtraObservations:
        anchors = off_surface(frame.normalise(points), distance / frame.scale, noise)
        on_device = tuple(
            (part.to(device), None if errors is None else errors.to(device))
            for part, errors in parts
        )
        return ExtraObservations(
            frame.to(device),
            anchors.to(device),
            NOISE.normal,
            STD_FACTORS["vessel", True],
            on_device,
            rows=rows.to(device),
            kind="vessel",
        )

    surface = torch.cat([cloud.points[outer.seen], hidden.points])
    middle = (axis + 0.5 * (table + vessel.rim) * up)[None]
    depth = torch.cdist(middle, surface).amin(1)
    depth = torch.minimum(depth, middle[:, 2] - table)
    clear = torch.cat([-depth, torch.cdist(sphere, surface).amin(1)])
    rim = _observe_rim(outline, frame, NOISE.vessel_rim_normal)
    parts = [rim, _observe_hidden(frame, hidden)]
    body = support(torch.cat([middle, sphere]), clear, parts, outer.seen)
    body = dataclasses.replace(body, free=free_space(outline, frame.to(device), table))

    surface = torch.cat([cloud.points[inner.seen], inner.hidden.points])
    bottom = float(surface[:, 2].min())
    over = vessel.rim + MIDDLE.over * vessel.radius
    places = [0.5 * (bottom + vessel.rim), vessel.rim, over]
    heights = torch.tensor(places, dtype=torch.float32, device="cpu").double()
    inside = axis + heights[:, None] * up
    around = sphere[sphere[:, 2] < vessel.rim]
    clear = torch.cdist(inside, surface).amin(1)
    clear = torch.cat([clear, -torch.cdist(around, surface).amin(1)])
    parts = [_observe_hidden(frame, inner.hidden)]
    space = support(torch.cat([inside, around]), clear, parts, inner.seen)
    return body, space, _middle(cloud, vessel, (outer, inner), frame).to(device)


def _middle(
    cloud: PointCloud,
    vessel: Vessel,
    walls: tuple[Wall, Wall],
    frame: Normalisation,
) -> Middle:
    """Return points in the middle of a vessel's wall, half its thickness off the surfaces, without
    the rim.
    """
    assert cloud.normals is not None
    points = []
    normals = []
    for wall, seen in zip(walls, (vessel.body & ~vessel.inner, vessel.inner), strict=True):
        points += [cloud.points[seen], wall.hidden.points]
        normals += [cloud.normals[seen], wall.hidden.normals]
    at = torch.cat(points)
    out = torch.cat(normals)
    below = at[:, 2] < vessel.rim - VESSEL.rim
    at = at[below]
    out = out[below]
    rows = pick_apart(at, MIDDLE.points)
    x = frame.normalise(at[rows] - 0.5 * vessel.thickness * out[rows])
    return Middle(x, out[rows, 2].abs() < MIDDLE.side, vessel.thickness / frame.scale)


def _observe_hidden(frame: Normalisation, wall: HiddenWall) -> Part:
    """Return observations of points on a hidden wall, in normalised units, and their correlated
    errors.
    """
    errors = correlated_errors(wall.points, wall.shared, WALL.form)
    seen = observe(frame, wall.points, wall.normals, HIDDEN.noise, NOISE.hidden_normal)
    return seen, errors / frame.scale


def free_space(
    outline: Outlines,
    frame: Normalisation,
    table: float | None = None,
    reach: float = 1.0,
    outline_error: float = FREE.outline_error,
) -> FreeSpace:
    """Return points (n, 3) in free space, and lower bounds (n,) of their signed distances, both
    normalised.

    Args:
        outline: silhouettes of the views, in a frame with z up.
        frame: the normalised frame of the results.
        table: the table's height [m]; None means no table.
        reach: normalised radius of the object. Points within 1.15 times this (`FREE.radius`) are
            returned.
        outline_error: distance [m] by which the object may reach beyond its outline.

    The points lie beside the object's outline, and below the table. A bound becomes an observation
    only where the shape violates it: otherwise the shape would inflate to its visual hull.
    """
    origin = frame.center.double().cpu()
    scale = frame.scale * reach
    points = torch.cat([_points_beside(view, origin, scale) for view in outline.views])
    least = outline.hull_distance(points) - outline_error
    if table is not None:
        half = FREE.ground_side
        steps = torch.linspace(-half, half, FREE.ground, dtype=torch.float64, device="cpu")
        side = scale * steps
        ground = torch.cartesian_prod(side, side) + origin[:2]
        for below in FREE.below:
            height = torch.full_like(ground[:, :1], table - below)
            points = torch.cat([points, torch.cat([ground, height], 1)])
            least = torch.cat([least, torch.full_like(ground[:, 0], below)])
    x = (points - origin) / scale
    near = norm(x) < FREE.radius
    keep = near & (least > FREE.least)
    x = x[keep].to(frame.center)
    least = least[keep].to(frame.center)
    return reach * x, least / frame.scale


def free_space_violations(
    shape: ShapeGP,
    x: Points,
    least: Float[Tensor, "n"],
) -> Tensor:
    """Return the indices of at most 16 points of free space that lie well inside the shape.

    `x` are n normalised points, and `least` the lower bounds of their signed distances, normalised.
    The points violate these bounds by over 2 mm (`FREE.violation`), and lie far apart. The worst
    comes first.
    """
    short = shape.mean(x) - least
    rows = flatnonzero(short < -FREE.violation / shape.scale)
    rows = rows[torch.argsort(short[rows], stable=True)]
    return rows[pick_apart(x[rows], FREE.violations)]


def _points_beside(
    outline: Silhouette,
    origin: Float[Tensor, "3"],
    scale: float,
) -> Points:
    """Return points [m] on camera rays beside the outline, over the object's depth."""
    # the depth is 0 beyond the image
    depth = float(outline.depth[outline.depth > 0].median())
    rays = []
    for offset in FREE.beside:
        near = (outline.outside - offset / depth).abs() <= OUTLINE.edge * outline.cell
        row, column = torch.nonzero(near, as_tuple=True)
        position = outline.corner + outline.cell * torch.stack([column, row], -1).double()
        # at depth 1 in the camera's frame
        beside = torch.cat([position, torch.ones_like(position[:, :1])], -1)
        rays.append(beside[pick_apart(beside, FREE.rays)])
    middle = float((origin - outline.viewpoint) @ outline.axes[2])
    steps = torch.linspace(-1.0, 1.0, FREE.depths, dtype=torch.float64, device="cpu")
    depths = middle + scale * steps
    local = torch.cat(rays)[:, None] * depths[:, None]  # (r, depths, 3)
    return local.reshape(-1, 3) @ outline.axes + outline.viewpoint
