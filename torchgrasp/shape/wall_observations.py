"""What is observed of an open vessel: of an outer body with a lid, and of the space within its inner wall."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value, join
from torchgrasp.linalg import fibonacci_sphere
from torchgrasp.shape.completion.complete import LEAST_NOISE, PART
from torchgrasp.shape.completion.silhouette import Outlines
from torchgrasp.shape.completion.vessel import Vessel
from torchgrasp.shape.completion.walls import FORM_ERROR, HiddenWall, complete_walls, lid
from torchgrasp.shape.gp import Normalisation
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

Part = tuple[Observations, Tensor | None]
"""Observations, and the errors that their distances share."""


@dataclasses.dataclass(frozen=True)
class WallObservations(Value):
    """What is observed of one wall beside the seen points `rows`; normalised, in the frame of the whole shape."""

    rows: Bool[Tensor, "n"]
    anchors: Observations
    parts: tuple[Part, ...]


def observe_walls(
    cloud: PointCloud, vessel: Vessel, outline: Outlines, frame: Normalisation, table: float, noise: float
) -> tuple[WallObservations, WallObservations]:
    """Return what is observed of the outer and of the inner wall of a vessel.

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
    )


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
