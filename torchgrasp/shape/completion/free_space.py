"""Free space: where the camera or the table shows that there is no object, the shape must be outside."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.linalg import farthest_points
from torchgrasp.shape.completion.silhouette import TIE, Outlines, Silhouette
from torchgrasp.shape.gp import Normalisation, ShapeGP

OUTLINE_ERROR = 0.005
"""How far [m] the object may stand out of the outline: a camera loses rims. Of 24 true surfaces 99 % stay within
2 to 9 mm. With 0 here the hand overlapped with the true duck."""
OFFSETS = (0.008, 0.016)
"""Distances [m] from the outline at which the space beside the object is probed."""
RAYS, DEPTHS = 32, 13
"""Rays along the outline at each offset, and points of each ray."""
TABLE_OFFSETS = (0.003, 0.012)
"""Depths [m] under the table at which it is probed."""
TABLE_GRID = 9
"""Points along each side of the probed part of the table."""
REACH = 1.15
"""Radius, normalised, within which space is probed: within the sphere of the points outside."""
LEAST = 0.001
"""Least distance [m] of a probe from the object: a nearer one says nothing."""
TOLERANCE = 0.002
"""How far [m] the shape may reach into free space."""
MOST = 16
"""Probes that are observed, at most, in one round."""


def free_space(
    outline: Outlines, frame: Normalisation, table: float | None = None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return points beside the outline and under the table, normalised, and the least signed distance there.

    Beside the outline the object is at least as far as the outline's edge, less the outline's own error; under the
    table as far as its top. These are lower bounds: observed everywhere as distances they would blow the object up
    to its visual hull. See `free_space_violations`.

    Args:
        outline: of the views.
        frame: the normalised one.
        table: height [m] of the table, whose normal is z; None: not known.
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
    keep = (torch.linalg.vector_norm(x, dim=-1) < REACH) & (least > LEAST)
    return x[keep].to(frame.center), least[keep].to(frame.center) / scale


def free_space_violations(shape: ShapeGP, x: Float[Tensor, "n 3"], least: Float[Tensor, "n"]) -> Tensor:
    """Return the rows of free space that the shape reaches into, the worst and then far ones: 16 at most.

    Observed at their least distance these push the shape out; where it is outside already nothing is observed.

    Args:
        shape: the posterior.
        x, least: of `free_space`.
    """
    short = shape.mean(x) - least
    rows = torch.nonzero(short < -TOLERANCE / shape.scale)[:, 0]
    rows = rows[torch.argsort(short[rows], stable=True)]
    return rows[farthest_points(x[rows], MOST, tie=TIE)]


def _points_beside(outline: Silhouette, origin: Float[Tensor, "3"], scale: float) -> Float[Tensor, "n 3"]:
    """Return points [m] along the rays beside an outline, about as deep as the object can be."""
    depth = float(outline.depth.median())
    rays = [_rays_beside(outline, offset / depth) for offset in OFFSETS]
    middle = float((origin - outline.viewpoint) @ outline.axes[2])
    depths = middle + scale * torch.linspace(-1.0, 1.0, DEPTHS, dtype=torch.float64)
    return (torch.cat(rays)[:, None] * depths[:, None]).reshape(-1, 3) @ outline.axes + outline.viewpoint


def _rays_beside(outline: Silhouette, offset: float) -> Float[Tensor, "k 3"]:
    """Return rays of the camera's frame, of depth 1, beside the outline by an offset in the plane at depth 1."""
    near = (outline.outside - offset).abs() <= 0.75 * outline.cell
    row, column = torch.nonzero(near, as_tuple=True)
    place = outline.corner + outline.cell * torch.stack([column, row], -1).double()
    rays = torch.cat([place, torch.ones_like(place[:, :1])], -1)
    return rays[farthest_points(rays, RAYS, tie=TIE)]
