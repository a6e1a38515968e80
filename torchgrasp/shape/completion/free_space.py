"""Free space, which the camera or the table excludes from the object."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.shape.completion.silhouette import TIE, Outlines, Silhouette
from torchgrasp.shape.gp import Normalisation, ShapeGP

OUTLINE_ERROR = 0.005
"""The object may reach this far [m] beyond its outline: a camera loses rims (docs/shape.md)."""
OFFSETS = (0.008, 0.016)
"""Distances [m] from the outline at which the space beside the object is probed."""
RAYS, DEPTHS = 32, 13
"""Rays along the outline at each offset, and points of each ray."""
TABLE_OFFSETS = (0.003, 0.012)
"""Depths [m] below the table at which it is probed."""
TABLE_GRID = 9
"""Points along each side of the probed part of the table."""
MAX_RADIUS = 1.15
"""Radius, normalised, within which space is probed: inside the sphere of the points outside."""
LEAST_DISTANCE = 0.001
"""Least distance [m] of a probe from the object: a smaller one says nothing."""
TOLERANCE = 0.002
"""The shape may reach this far [m] into free space: two to three times the noise of a camera."""
MAX_PROBES = 16
"""Probes that are observed in one round, at most."""


def free_space(
    outline: Outlines, frame: Normalisation, table: float | None = None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return points of free space and their least signed distance, both normalised.

    The points lie beside the outline and below the table of this height [m]. The distances are lower bounds. Observed
    everywhere they would inflate the object to its visual hull.
    """
    origin, scale = frame.center.double().cpu(), frame.scale
    points = torch.cat([_points_beside(view, origin, scale) for view in outline.views])
    least = outline.hull_distance(points) - OUTLINE_ERROR
    if table is not None:
        side = scale * torch.linspace(-0.9, 0.9, TABLE_GRID, dtype=torch.float64)
        ground = torch.cartesian_prod(side, side) + origin[:2]
        for below in TABLE_OFFSETS:
            height = torch.full_like(ground[:, :1], table - below)
            points = torch.cat([points, torch.cat([ground, height], 1)])
            least = torch.cat([least, torch.full_like(ground[:, 0], below)])
    x = (points - origin) / scale
    keep = (torch.linalg.vector_norm(x, dim=-1) < MAX_RADIUS) & (least > LEAST_DISTANCE)
    return x[keep].to(frame.center), least[keep].to(frame.center) / scale


def free_space_violations(shape: ShapeGP, x: Float[Tensor, "n 3"], least: Float[Tensor, "n"]) -> Tensor:
    """Return at most 16 rows of free space that the shape reaches into, the worst first.

    Observed at their least distance they push the shape out.
    """
    short = shape.mean(x) - least
    rows = torch.nonzero(short < -TOLERANCE / shape.scale)[:, 0]
    rows = rows[torch.argsort(short[rows], stable=True)]
    return rows[farthest_points(x[rows], MAX_PROBES, tie=TIE)]


def _points_beside(outline: Silhouette, origin: Float[Tensor, "3"], scale: float) -> Float[Tensor, "n 3"]:
    """Return points [m] on rays beside an outline, over the object's depth."""
    depth = float(outline.depth[outline.depth > 0].median())  # 0 beyond the image
    rays = [_rays_beside(outline, offset / depth) for offset in OFFSETS]
    middle = float((origin - outline.viewpoint) @ outline.axes[2])
    depths = middle + scale * torch.linspace(-1.0, 1.0, DEPTHS, dtype=torch.float64)
    return (torch.cat(rays)[:, None] * depths[:, None]).reshape(-1, 3) @ outline.axes + outline.viewpoint


def _rays_beside(outline: Silhouette, offset: float) -> Float[Tensor, "k 3"]:
    """Return rays at an offset from the outline, in the camera's frame and up to depth 1."""
    near = (outline.outside - offset).abs() <= 0.75 * outline.cell
    row, column = torch.nonzero(near, as_tuple=True)
    position = outline.corner + outline.cell * torch.stack([column, row], -1).double()
    rays = torch.cat([position, torch.ones_like(position[:, :1])], -1)
    return rays[farthest_points(rays, RAYS, tie=TIE)]
