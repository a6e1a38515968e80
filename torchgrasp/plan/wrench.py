"""Contact wrenches of three frictional contacts, and the exact closure test (Eq. 13).

Normals are outward unit normals of the surface; fingertips push against them. Torques are about the contacts' centre,
over the contacts' radius: units and origin do not matter.
"""

import itertools
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.frames import degenerate
from torchgrasp.linalg import unit

Triples = Float[Tensor, "b 3 3"]
"""A vector at each of three contacts in every row: points or normals."""
BALANCED = 1e-9
"""Largest |W phi| of balanced coefficients: above rounding in float64, far below any wrench (about 1)."""
MIN_MARGIN = 1e-6
"""Least positive coefficient: far above the certificate's errors, far below equal coefficients, 1 / (3 e)."""
MIN_RANK_RATIO = 1e-3
"""Least singular value of the wrench matrix over its largest. Eq. (13) alone also holds for contacts on a line."""
PARALLEL = 1e-9
"""Planar wrenches (of length about 1) with a shorter cross product are parallel: above rounding in float64."""


def centre_and_radius(points: Triples) -> tuple[Float[Tensor, "b 1 3"], Float[Tensor, "b 1 1"]]:
    """Return the contacts' centre and root-mean-square radius; 1 for a radius of 0."""
    centre = points.mean(-2, keepdim=True)
    radius = torch.linalg.vector_norm(points - centre, dim=(-2, -1), keepdim=True) / math.sqrt(3.0)
    return centre, torch.where(radius == 0, 1.0, radius)


def tangents(points: Triples, normals: Triples) -> Triples:
    """Return the unit tangent at each contact that lies in the plane of the contacts.

    It turns with the object. For a normal perpendicular to the plane it is arbitrary: no friction closes there, because
    balanced forces are coplanar. So it is for contacts on a line.
    """
    plane = torch.linalg.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    inside = torch.linalg.cross(plane[:, None].expand_as(normals), normals)
    length = torch.linalg.vector_norm(inside, dim=-1, keepdim=True)
    size = torch.linalg.vector_norm(plane, dim=-1)[:, None, None]
    smallest = normals.abs().argmin(-1)
    axis = torch.eye(3, dtype=normals.dtype, device=normals.device)[smallest]
    stand_in = torch.linalg.cross(axis, normals)
    seam = ~(length > 1e-9 * size) | (size == 0)
    return unit(torch.where(seam, stand_in, inside))


def cone_edges(
    normals: Float[Tensor, "*b 3"], tangent: Float[Tensor, "*b 3"], friction: float, edges: int
) -> Float[Tensor, "*b e 3"]:
    """Return the edges of the linearised cones: forces of normal component 1, the first leaning along `tangent`."""
    angle = torch.arange(edges, dtype=normals.dtype, device=normals.device) * (2 * math.pi / edges)
    other = torch.linalg.cross(normals, tangent)
    lean = angle.cos()[:, None] * tangent[..., None, :] + angle.sin()[:, None] * other[..., None, :]
    return friction * lean - normals[..., None, :]


def wrenches(points: Triples, normals: Triples, friction: float, edges: int = 8) -> Float[Tensor, "b 3 e 6"]:
    """Return the primitive contact wrenches w of Eq. (13): force, then torque.

    >>> wrenches(torch.eye(3)[None], torch.eye(3)[None], friction=0.5).shape
    torch.Size([1, 3, 8, 6])
    """
    force = cone_edges(normals, tangents(points, normals), friction, edges)
    centre, radius = centre_and_radius(points)
    arm = ((points - centre) / radius)[:, :, None].expand_as(force)
    return torch.cat([force, torch.linalg.cross(arm, force)], -1)


def rank_ratio(wrench: Float[Tensor, "b 3 e 6"]) -> Float[Tensor, "b"]:
    """Return the smallest over the largest singular value of each wrench matrix."""
    values = torch.linalg.svdvals(wrench.flatten(1, 2))
    return values[:, -1] / values[:, 0]


def closed_exact(points: Triples, normals: Triples, friction: float) -> Bool[Tensor, "b"]:
    """Tell which triples have frictional form closure with round cones: Eq. (13) as edges go to infinity.

    Balanced forces lie in the plane of the contacts. Each cone cuts an angle about the projected normal from it. The
    six planar wrenches along these angles must positively span the planar wrenches: no plane through two of them has
    the others on one side. Degenerate and non-finite rows are not closed.
    """
    centre, radius = centre_and_radius(points)
    arm = (points - centre) / radius
    across = unit(torch.linalg.cross(arm[:, 1] - arm[:, 0], arm[:, 2] - arm[:, 0]))
    along = unit(arm[:, 1] - arm[:, 0])
    basis = torch.stack([along, torch.linalg.cross(across, along)], -1)  # (b, 3, 2)
    inward, position = -normals @ basis, arm @ basis
    projected = torch.linalg.vector_norm(inward, dim=-1)
    cone = math.cos(math.atan(friction))
    half = torch.arccos((cone / projected).clamp(max=1.0))
    middle = torch.atan2(inward[..., 1], inward[..., 0])
    angle = torch.stack([middle - half, middle + half], -1)  # (b, 3, 2)
    c, s = angle.cos(), angle.sin()
    planar = torch.stack([c, s, position[..., 0, None] * s - position[..., 1, None] * c], -1).flatten(1, 2)
    first, second = torch.tensor(list(itertools.combinations(range(6), 2)), device=points.device).unbind(-1)
    plane = torch.linalg.cross(planar[:, first], planar[:, second])  # (b, 15, 3)
    side = plane @ planar.mT  # (b, 15, 6)
    spans = torch.linalg.vector_norm(plane, dim=-1) > PARALLEL
    both = (side.amax(-1) > PARALLEL) & (side.amin(-1) < -PARALLEL)
    spanned = (both | ~spans).all(-1) & spans.any(-1)
    return spanned & (projected > cone).all(-1) & ~degenerate(points)
