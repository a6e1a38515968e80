"""Contact wrenches of three to five frictional contacts (Eq. 13).

Normals are outward unit normals of the surface; fingertips push against them. Torques are about the contacts' centre,
over the contacts' radius: units and origin do not matter.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.geometry.frames import subsets
from torchgrasp.geometry.linalg import unit

Vectors = Float[Tensor, "b f 3"]
"""A vector at each of the contacts in every row: points or normals."""
BALANCED = 1e-9  # largest |W phi| of balanced coefficients: above rounding in float64, far below any wrench (about 1)
MIN_MARGIN = 1e-6
"""Least positive coefficient: far above the certificate's errors, far below equal coefficients, 1 / (f e)."""
MIN_RANK_RATIO = 1e-3
"""Least singular value of the wrench matrix over its largest. Eq. (13) alone also holds for contacts on a line."""


def centre_and_radius(points: Vectors) -> tuple[Float[Tensor, "b 1 3"], Float[Tensor, "b 1 1"]]:
    """Return the contacts' centre and root-mean-square radius; 1 for a radius of 0."""
    centre = points.mean(-2, keepdim=True)
    radius = torch.linalg.vector_norm(points - centre, dim=(-2, -1), keepdim=True) / math.sqrt(points.shape[-2])
    return centre, torch.where(radius == 0, 1.0, radius)


def tangents(points: Vectors, normals: Vectors) -> Vectors:
    """Return a unit tangent at each contact, which turns with the object.

    It lies in the plane of three contacts. Of more, those three are taken whose plane leans most against the normal, by
    its area. Where all contacts lie in one plane and a normal is perpendicular to it, the tangent of three is
    arbitrary: no friction closes there, because balanced forces are coplanar. That of more points to the farthest
    contact. For contacts on a line it is arbitrary, too.
    """
    first, second, third = subsets(points.shape[1], 3, points.device).unbind(1)
    plane = torch.linalg.cross(points[:, second] - points[:, first], points[:, third] - points[:, first])  # (b, k, 3)
    inside = torch.linalg.cross(plane[:, None], normals[:, :, None])  # (b, f, k, 3)
    length, best = torch.linalg.vector_norm(inside, dim=-1).max(-1, keepdim=True)
    inside = _take(inside, best)
    size = torch.linalg.vector_norm(plane, dim=-1).amax(-1)[:, None, None]
    smallest = normals.abs().argmin(-1)
    axis = torch.eye(3, dtype=normals.dtype, device=normals.device)[smallest]
    stand_in = torch.linalg.cross(axis, normals)
    if points.shape[1] > 3:
        away = points[:, None] - points[:, :, None]
        away = away - (away * normals[:, :, None]).sum(-1, keepdim=True) * normals[:, :, None]
        far, farthest = torch.linalg.vector_norm(away, dim=-1).max(-1, keepdim=True)
        stand_in = torch.where(far**2 > 1e-9 * size, _take(away, farthest), stand_in)
    seam = ~(length > 1e-9 * size) | (size == 0)
    return unit(torch.where(seam, stand_in, inside))


def _take(vectors: Float[Tensor, "b f k 3"], index: Int[Tensor, "b f 1"]) -> Vectors:
    """Return one of k vectors at each contact."""
    return vectors.gather(2, index[..., None].expand(-1, -1, 1, 3))[:, :, 0]


def cone_edges(
    normals: Float[Tensor, "*b 3"], tangent: Float[Tensor, "*b 3"], friction: float, edges: int
) -> Float[Tensor, "*b e 3"]:
    """Return the edges of the linearised cones: forces of normal component 1, the first leaning along `tangent`."""
    angle = torch.arange(edges, dtype=normals.dtype, device=normals.device) * (2 * math.pi / edges)
    other = torch.linalg.cross(normals, tangent)
    lean = angle.cos()[:, None] * tangent[..., None, :] + angle.sin()[:, None] * other[..., None, :]
    return friction * lean - normals[..., None, :]


def wrenches(points: Vectors, normals: Vectors, friction: float, edges: int = 8) -> Float[Tensor, "b f e 6"]:
    """Return the primitive contact wrenches w of Eq. (13): force, then torque."""
    force = cone_edges(normals, tangents(points, normals), friction, edges)
    centre, radius = centre_and_radius(points)
    arm = ((points - centre) / radius)[:, :, None].expand_as(force)
    return torch.cat([force, torch.linalg.cross(arm, force)], -1)


def rank_ratio(wrench: Float[Tensor, "b f e 6"]) -> Float[Tensor, "b"]:
    """Return the smallest over the largest singular value of each wrench matrix."""
    values = torch.linalg.svdvals(wrench.flatten(1, 2))
    return values[:, -1] / values[:, 0]
