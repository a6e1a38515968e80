"""Observations besides the seen points: points inside and outside, the hidden side, and free space."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.prepare import PreparedCloud
from torchgrasp.foundation.base import Value, join
from torchgrasp.geometry.linalg import Points, farthest_points, fibonacci_sphere, unit
from torchgrasp.shape.completion.complete import (
    LEAST_NOISE,
    PART,
    Completion,
    Kind,
    correlated_errors,
)
from torchgrasp.shape.completion.silhouette import TIE, Outlines, Silhouette
from torchgrasp.shape.completion.vessel import (
    FORM_ERROR,
    RIM,
    HiddenWall,
    Vessel,
    Wall,
    complete_walls,
    lid,
)
from torchgrasp.shape.estimate import Normalisation, Observations, off_surface, on_surface
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values.planning import PointCloud

# number of points outside, and normalised radius of their sphere (Sec. 3.1)
OUTER_POINTS = 20
OUTER_RADIUS = 1.2
# standard deviation, normalised, of a distance outside: the nearest of sparse points is too far
# away
OUTER_NOISE = 0.3
NORMAL_NOISE = 0.05
RIM_NORMAL_NOISE = 0.5
HIDDEN_NORMAL_NOISE = 0.25
"""Standard deviations of unit normals: on the seen side, on the outline, and on the hidden side."""
RIM_NOISE = 0.002  # standard deviation [m] of a point of the outline
FREE_NOISE = (
    0.003  # standard deviation [m] of a distance observed in free space: it is only a lower bound
)
OUTLINE_ERROR = 0.005  # the object may reach this far [m] beyond its outline: a camera loses rims
MAX_RADIUS = 1.15  # share of the radius of all points within which free space is probed
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
Part = tuple[Observations, Tensor | None]  # observations, and the errors that their distances share
FreeSpace = tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]
"""Normalised points in free space, and least signed distances there."""


@dataclasses.dataclass(frozen=True)
class ExtraObservations(Value):
    """The normalised frame of a surface, and the observations besides the cloud."""

    frame: Normalisation
    anchors: (
        Observations  # observed distances at points inside and outside the object, without normals
    )
    normal_noise: float  # standard deviation of the cloud's normals
    std_factor: float = (
        1.0  # ratio of the surface's true deviations to the posterior's standard deviations
    )
    parts: tuple[Part, ...] = ()  # observed points of the outline and of the hidden side
    free: FreeSpace | None = None  # points in free space, or None if they are not used
    rows: Bool[Tensor, "rows"] | None = (
        None  # mask of the cloud's points on this surface; None means all
    )
    kind: Kind = "guess"  # how the hidden side was completed, as in `ShapeGP`


def paper_support(
    seen: PreparedCloud, noise: float, generator: torch.Generator
) -> ExtraObservations:
    """Return the additional observations of the paper: the centre, and random points outside (Sec.
    3.1).
    """
    center = seen.points.mean(0)
    scale = float(torch.linalg.vector_norm(seen.points - center, dim=-1).max())
    sphere = unit(
        torch.randn(OUTER_POINTS, 3, dtype=torch.float64, device="cpu", generator=generator)
    ).to(center)
    x = torch.cat([torch.zeros_like(center)[None], OUTER_RADIUS * sphere])
    distance = torch.cat([-torch.ones_like(center[:1]), torch.ones_like(sphere[:, 0])])
    return ExtraObservations(Normalisation(center, scale), off_surface(x, distance, noise), noise)


def frame_around(points: Float[Tensor, "n 3"]) -> Normalisation:
    """Return the normalised frame of points: origin in the centre of their box, farthest point at
    distance 1.
    """
    center = (points.amin(0) + points.amax(0)) / 2
    return Normalisation(center, float(torch.linalg.vector_norm(points - center, dim=-1).max()))


def camera_support(
    seen: PreparedCloud, completion: Completion | None, noise: float, table: float | None
) -> ExtraObservations:
    """Return the observations that are added to the points of the cloud, with distances that are
    true to scale.

    If the cloud is a view with a `completion`, they include its hidden side and free space. `noise`
    is the standard deviation of the distance observed inside, normalised; `table` is the table's
    height [m].
    """
    hidden = seen.points[:0] if completion is None else completion.points.to(seen.points)
    surface = torch.cat([seen.points, hidden])
    # The domain holds the whole of a ball. Of others the hidden side is too uncertain to set the
    # scale.
    frame = frame_around(
        surface if completion is not None and completion.kind == "ball" else seen.points
    )
    center = frame.center
    kind = "whole"
    parts = ()
    free = None
    inside = True
    if completion is not None:
        parts = _observe_completion(completion, frame)
        kind = completion.kind
        reach = (
            torch.linalg.vector_norm(frame.normalise(surface), dim=-1).max()
            if completion.frame
            else 1.0
        )
        free = free_space(completion.outline, frame, table, float(reach))
        inside = (
            not completion.frame and float(completion.outline.violation(center.cpu())) == 0.0
        )  # an arch, a bowl
    sphere = OUTER_RADIUS * fibonacci_sphere(OUTER_POINTS).to(center)
    x = torch.cat([torch.zeros_like(center)[None], sphere]) if inside else sphere
    distance = torch.cdist(x, frame.normalise(surface)).amin(1)
    inner = off_surface(x[:-OUTER_POINTS], -distance[:-OUTER_POINTS], noise)
    outer = x[-OUTER_POINTS:]
    anchors = join([inner, off_surface(outer, distance[-OUTER_POINTS:], OUTER_NOISE)])
    return ExtraObservations(
        frame, anchors, NORMAL_NOISE, STD_FACTORS[kind, table is not None], parts, free, kind=kind
    )


def _observe_completion(completion: Completion, frame: Normalisation) -> tuple[Part, ...]:
    """Return observations of points on the outline and on the hidden side, and the errors that they
    share.
    """
    outline = completion.outline
    hidden = observe(frame, completion.points, completion.normals, LEAST_NOISE, HIDDEN_NORMAL_NOISE)
    tilt = (completion.asymmetry / PART).to(
        frame.center
    )  # slope of a field with that deviation and length
    hidden = dataclasses.replace(hidden, normal_noise=torch.hypot(hidden.normal_noise, tilt))
    rim = observe(frame, outline.rim, outline.rim_normals, RIM_NOISE, RIM_NORMAL_NOISE)
    return (rim, None), (hidden, completion.deviations.to(frame.center) / frame.scale)


def observe(
    frame: Normalisation, points: Points, normals: Points, noise: float, normal_noise: float
) -> Observations:
    """Return observations of surface points [m] with normals; `noise` is their deviation [m] along
    the normals.
    """
    x = frame.normalise(points.to(frame.center))
    return on_surface(x, normals.to(x), torch.full_like(x[:, 0], noise / frame.scale), normal_noise)


@dataclasses.dataclass(frozen=True)
class Middle(Value):
    """Points `x` in the middle of a vessel's wall and its thickness, normalised; `side` masks
    points off the floor.
    """

    x: Points
    side: Bool[Tensor, "n"]
    thickness: float


def vessel_supports(
    cloud: PointCloud, vessel: Vessel, outline: Outlines, table: float, noise: float
) -> tuple[ExtraObservations, ExtraObservations, Middle]:
    """Return additional observations of a vessel's outer and inner surface, and points in the
    middle of its wall.

    `noise` is the standard deviation of the distances observed off the surface, normalised.
    Distances of the inner surface are positive around the axis.
    """
    device = cloud.points.device
    cloud = cloud.to("cpu")
    frame = frame_around(cloud.points)
    outer, inner = complete_walls(cloud, vessel, outline, table)
    hidden = join([outer.hidden, lid(vessel)])
    axis = torch.cat([vessel.center, torch.zeros(1, dtype=torch.float64, device="cpu")])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu")
    sphere = frame.metres(OUTER_RADIUS * fibonacci_sphere(OUTER_POINTS))

    def anchors(points: Points, distance: Float[Tensor, "n"]) -> Observations:
        return off_surface(frame.normalise(points), distance / frame.scale, noise)

    surface = torch.cat([cloud.points[outer.seen], hidden.points])
    middle = (axis + 0.5 * (table + vessel.rim) * up)[None]
    depth = torch.minimum(torch.cdist(middle, surface).amin(1), middle[:, 2] - table)
    body = anchors(
        torch.cat([middle, sphere]), torch.cat([-depth, torch.cdist(sphere, surface).amin(1)])
    )
    rim = observe(frame, outline.rim, outline.rim_normals, RIM_NOISE, 2 * HIDDEN_NORMAL_NOISE)

    surface = torch.cat([cloud.points[inner.seen], inner.hidden.points])
    bottom = float(surface[:, 2].min())
    over = (
        vessel.rim + 0.5 * vessel.radius
    )  # there the inner surface still surrounds free space: it has no lid
    heights = torch.tensor(
        [0.5 * (bottom + vessel.rim), vessel.rim, over], dtype=torch.float32, device="cpu"
    ).double()
    inside = axis + heights[:, None] * up
    around = sphere[sphere[:, 2] < vessel.rim]
    clear = torch.cat([torch.cdist(inside, surface).amin(1), -torch.cdist(around, surface).amin(1)])
    space = anchors(torch.cat([inside, around]), clear)

    def support(
        anchors: Observations, parts: list[Part], free: FreeSpace | None, rows: Tensor
    ) -> ExtraObservations:
        on_device = tuple(
            (part.to(device), None if errors is None else errors.to(device))
            for part, errors in parts
        )
        placed = (frame.to(device), anchors.to(device), NORMAL_NOISE)
        factor = STD_FACTORS["vessel", True]
        return ExtraObservations(*placed, factor, on_device, free, rows.to(device), "vessel")

    free = free_space(outline, frame.to(device), table)
    return (
        support(body, [(rim, None), _observe_hidden(frame, hidden)], free, outer.seen),
        support(space, [_observe_hidden(frame, inner.hidden)], None, inner.seen),
        _middle(cloud, vessel, (outer, inner), frame).to(device),
    )


def _middle(
    cloud: PointCloud, vessel: Vessel, walls: tuple[Wall, Wall], frame: Normalisation
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
    below = at[:, 2] < vessel.rim - RIM
    at = at[below]
    out = out[below]
    rows = farthest_points(at, 150, tie=TIE)
    x = frame.normalise(at[rows] - 0.5 * vessel.thickness * out[rows])
    return Middle(
        x, out[rows, 2].abs() < 0.8, vessel.thickness / frame.scale
    )  # a floor may be thicker


def _observe_hidden(frame: Normalisation, wall: HiddenWall) -> Part:
    """Return observations of points on a hidden wall, in normalised units, and their correlated
    errors.
    """
    errors = correlated_errors(wall.points, wall.shared, FORM_ERROR)
    return observe(
        frame, wall.points, wall.normals, LEAST_NOISE, HIDDEN_NORMAL_NOISE
    ), errors / frame.scale


def free_space(
    outline: Outlines, frame: Normalisation, table: float | None = None, reach: float = 1.0
) -> FreeSpace:
    """Return points in free space, and lower bounds of their signed distance, out to the normalised
    radius `reach`.

    The points lie beside the object's outline, and below the table. A bound becomes an observation
    only where the shape violates it: otherwise the shape would inflate to its visual hull.
    """
    origin = frame.center.double().cpu()
    scale = frame.scale * reach
    points = torch.cat([_points_beside(view, origin, scale) for view in outline.views])
    least = outline.hull_distance(points) - OUTLINE_ERROR
    if table is not None:
        side = scale * torch.linspace(-0.9, 0.9, 9, dtype=torch.float64, device="cpu")
        ground = torch.cartesian_prod(side, side) + origin[:2]
        for below in (0.003, 0.012):  # [m]
            height = torch.full_like(ground[:, :1], table - below)
            points = torch.cat([points, torch.cat([ground, height], 1)])
            least = torch.cat([least, torch.full_like(ground[:, 0], below)])
    x = (points - origin) / scale
    keep = (torch.linalg.vector_norm(x, dim=-1) < MAX_RADIUS) & (
        least > 0.001
    )  # a smaller distance is no constraint
    return reach * x[keep].to(frame.center), least[keep].to(frame.center) / frame.scale


def free_space_violations(
    shape: ShapeGP, x: Float[Tensor, "n 3"], least: Float[Tensor, "n"]
) -> Tensor:
    """Return the indices of at most 16 free-space points that lie 2 mm or more inside the shape,
    the worst first.
    """
    short = shape.mean(x) - least
    rows = torch.nonzero(short < -0.002 / shape.scale)[:, 0]
    rows = rows[torch.argsort(short[rows], stable=True)]
    return rows[farthest_points(x[rows], 16, tie=TIE)]


def _points_beside(
    outline: Silhouette, origin: Float[Tensor, "3"], scale: float
) -> Float[Tensor, "n 3"]:
    """Return points [m] on camera rays, 32 each 8 and 16 mm outside the outline, over the object's
    depth.
    """
    # the depth is 0 beyond the image
    depth = float(outline.depth[outline.depth > 0].median())
    rays = []
    for offset in (0.008, 0.016):
        near = (outline.outside - offset / depth).abs() <= 0.75 * outline.cell
        row, column = torch.nonzero(near, as_tuple=True)
        position = outline.corner + outline.cell * torch.stack([column, row], -1).double()
        beside = torch.cat(
            [position, torch.ones_like(position[:, :1])], -1
        )  # at depth 1 in the camera's frame
        rays.append(beside[farthest_points(beside, 32, tie=TIE)])
    middle = float((origin - outline.viewpoint) @ outline.axes[2])
    depths = middle + scale * torch.linspace(-1.0, 1.0, 13, dtype=torch.float64, device="cpu")
    return (torch.cat(rays)[:, None] * depths[:, None]).reshape(
        -1, 3
    ) @ outline.axes + outline.viewpoint
