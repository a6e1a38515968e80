"""What is observed of an open vessel: of an outer body with a lid, and of the space within its inner wall."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value, join
from torchgrasp.geometry.linalg import farthest_points, fibonacci_sphere
from torchgrasp.shape.completion.complete import LEAST_NOISE, PART
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.vessel import RIM, Vessel
from torchgrasp.shape.completion.walls import FORM_ERROR, HiddenWall, Wall, complete_walls, lid
from torchgrasp.shape.gp import Normalisation
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.joint_posterior import symmetric_root
from torchgrasp.shape.observations import Observations, off_surface, on_surface
from torchgrasp.values import PointCloud

HIDDEN_NORMAL_NOISE = 0.25
"""Standard deviation of the normal of a hidden or a rim point: that of mirrored ones."""
RIM_NOISE = 0.002
"""Standard deviation [m] of a rim point: 2.5 pixels of a camera at 0.5 m."""
OUTER_POINTS, OUTER_RADIUS = 20, 1.2
"""Points outside, and the radius, normalised, of the sphere on which they lie (Sec. 3.1)."""
OVER = 0.5
"""Height over the rim, in radii of the mouth, at which the inner wall still surrounds free space: it has no lid."""
SIDE = 0.8
"""Upward part of a normal below which a wall is as thick as the rest; floors may be thicker, not thinner."""
PROBES, ROUNDS, MOST = 150, 3, 24
"""Places at which a wall's thickness is looked at, times it is, and places that are observed each time."""
TOLERANCE, TIE_NOISE = 0.0005, 0.0007
"""The wall may be off its thickness by this much [m]; standard deviation [m] with which it then is observed."""

Part = tuple[Observations, Tensor | None]
"""Observations, and the errors that their distances share."""


@dataclasses.dataclass(frozen=True)
class Middle(Value):
    """Places amid the material of a vessel, normalised, and its thickness there.

    Args:
        x: the places.
        side: which are as thick as `thickness`; others are at least as thick.
        thickness: of the wall, normalised.
    """

    x: Float[Tensor, "n 3"]
    side: Bool[Tensor, "n"]
    thickness: float


@dataclasses.dataclass(frozen=True)
class WallObservations(Value):
    """What is observed of one wall beside the seen points `rows`; normalised, in the frame of the whole shape."""

    rows: Bool[Tensor, "n"]
    anchors: Observations
    parts: tuple[Part, ...]


def observe_walls(
    cloud: PointCloud, vessel: Vessel, outline: Outlines, frame: Normalisation, table: float, noise: float
) -> tuple[WallObservations, WallObservations, Middle]:
    """Return what is observed of the outer and of the inner wall of a vessel, and where the material between them is.

    Distances are negative in the material. So the inner wall's are positive around the axis, and negative all around.

    Args:
        cloud: the view [m] with normals, in float64 on the CPU.
        vessel: found in it.
        outline: of its views.
        frame: to normalise with.
        table: the table's height [m].
        noise: standard deviation of an anchor's distance, normalised.
    """
    outer, inner = complete_walls(cloud, vessel, outline, table)
    hidden = join([outer.hidden, lid(vessel)])
    axis = torch.cat([vessel.center, torch.zeros(1, dtype=torch.float64)])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    sphere = frame.metres(OUTER_RADIUS * fibonacci_sphere(OUTER_POINTS))

    surface = torch.cat([cloud.points[outer.seen], hidden.points])
    middle = (axis + 0.5 * (table + vessel.rim) * up)[None]
    depth = torch.minimum(torch.cdist(middle, surface).amin(1), middle[:, 2] - table)
    distance = torch.cat([-depth, torch.cdist(sphere, surface).amin(1)])
    body = _anchors(frame, torch.cat([middle, sphere]), distance, noise)
    rim = _observe(frame, outline.rim, outline.rim_normals, RIM_NOISE, 2 * HIDDEN_NORMAL_NOISE)
    parts = ((rim, None), _hidden(frame, hidden))

    surface = torch.cat([cloud.points[inner.seen], inner.hidden.points])
    bottom = float(surface[:, 2].min())
    heights = torch.tensor([0.5 * (bottom + vessel.rim), vessel.rim, vessel.rim + OVER * vessel.radius]).double()
    inside = axis + heights[:, None] * up
    clear = torch.cdist(inside, surface).amin(1)
    around = sphere[sphere[:, 2] < vessel.rim]
    places = torch.cat([inside, around])
    space = _anchors(frame, places, torch.cat([clear, -torch.cdist(around, surface).amin(1)]), noise)
    return (
        WallObservations(outer.seen, body, parts),
        WallObservations(inner.seen, space, (_hidden(frame, inner.hidden),)),
        _middle(cloud, vessel, (outer, inner), frame),
    )


def tie_walls(shape: HollowShape, middle: Middle) -> HollowShape:
    """Return the vessel with its wall as thick as it is known to be.

    Two posteriors that know nothing of each other let walls touch, which tears holes. Amid the material both distances
    sum to less than nothing, the thickness. Where they do not, the surer wall tells the other one where it is.
    """
    x, thickness, noise = middle.x, middle.thickness, TIE_NOISE / shape.scale
    for _ in range(ROUNDS):
        distance = torch.stack([wall.mean(x) for wall in shape.walls])
        short = distance.sum(0) + thickness
        off = torch.where(middle.side, short.abs(), short)
        rows = torch.nonzero(off > TOLERANCE / shape.scale)[:, 0]
        if not len(rows):
            break
        rows = rows[torch.argsort(off[rows], descending=True, stable=True)]
        rows = rows[farthest_points(x[rows], MOST, tie=TIE)]
        variance = torch.stack([wall.estimate(x[rows])[1][:, 0, 0] for wall in shape.walls])
        walls = []
        for number, wall in enumerate(shape.walls):
            own, other = variance[number], variance[1 - number]
            told = off_surface(x[rows], -thickness - distance[1 - number, rows], noise)
            spread = torch.sqrt(shape.std_factor**2 * other + noise**2)
            told = dataclasses.replace(told, distance_noise=spread)[own >= other]
            walls.append(wall.append(told) if len(told.x) else wall)
        shape = HollowShape.join(walls[0], walls[1], shape.cloud)
    return shape


def _middle(cloud: PointCloud, vessel: Vessel, walls: tuple[Wall, Wall], frame: Normalisation) -> Middle:
    """Return places half a thickness behind both walls, without ears, handles and rim."""
    assert cloud.normals is not None
    points, normals = [], []
    for wall, seen in zip(walls, (vessel.body & ~vessel.inner, vessel.inner), strict=True):
        points += [cloud.points[seen], wall.hidden.points]
        normals += [cloud.normals[seen], wall.hidden.normals]
    at, out = torch.cat(points), torch.cat(normals)
    below = at[:, 2] < vessel.rim - RIM
    at, out = at[below], out[below]
    rows = farthest_points(at, PROBES, tie=TIE)
    x = frame.normalise(at[rows] - 0.5 * vessel.thickness * out[rows])
    return Middle(x, out[rows, 2].abs() < SIDE, vessel.thickness / frame.scale)


def _anchors(
    frame: Normalisation, points: Float[Tensor, "n 3"], distance: Float[Tensor, "n"], noise: float
) -> Observations:
    """Return observations of distances [m] at points [m] off the surface."""
    return off_surface(frame.normalise(points), distance / frame.scale, noise)


def _observe(
    frame: Normalisation, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], noise: float, normal_noise: float
) -> Observations:
    """Return observations of points [m] of the surface with a noise [m]."""
    sigma = torch.full_like(points[:, 0], noise / frame.scale)
    return on_surface(frame.normalise(points), normals, sigma, normal_noise)


def _hidden(frame: Normalisation, wall: HiddenWall) -> Part:
    """Return hidden points with their shared errors; each error varies over `PART`, as a form's does."""
    observed = _observe(frame, wall.points, wall.normals, LEAST_NOISE, HIDDEN_NORMAL_NOISE)
    local = torch.sqrt(FORM_ERROR**2 + (wall.shared**2).sum(1))
    alike = torch.exp(-0.5 * (torch.cdist(wall.points, wall.points) / PART) ** 2)
    smooth = local[:, None] * symmetric_root(alike, 1.0, "keep hidden points apart")
    return observed, torch.cat([wall.shared, smooth], 1) / frame.scale
