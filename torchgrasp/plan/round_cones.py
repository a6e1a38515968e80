"""Frictional form closure with round cones: Eq. (13) as the edges of its cones go to infinity.

Three balanced forces are coplanar, and a test in their plane decides. More contacts are decided by proofs. A positive
balance of some edges proves closure. A wrench that no force of a round cone opposes proves that there is none. A
programme over some edges finds one of the two, or else a wrench that is opposed only between the edges: then the edges
that oppose it most join the programme.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.frames import degenerate, subsets
from torchgrasp.linalg import unit
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.wrench import BALANCED, Vectors, centre_and_radius, wrenches

PARALLEL = 1e-9
"""Planar wrenches (of length about 1) with a shorter cross product are parallel: above rounding in float64."""
FIRST_EDGES = 4
"""Edges of a cone in the first programme."""
ROUNDS = 12
"""Most programmes: the error of a cone falls to less than a quarter in each, so that 1e-7 of the friction is left."""


def closed_exact(points: Vectors, normals: Vectors, friction: float) -> Bool[Tensor, "b"]:
    """Tell which contacts have frictional form closure with round cones.

    Degenerate and non-finite rows are not closed, nor are those at the very border.
    """
    test = _closed_in_plane if points.shape[1] == 3 else _closed_by_proof
    return test(points, normals, friction) & ~degenerate(points)


def _closed_in_plane(points: Vectors, normals: Vectors, friction: float) -> Bool[Tensor, "b"]:
    """Decide for three contacts.

    Balanced forces lie in the plane of the contacts. Each cone cuts an angle about the projected normal from it. The
    six planar wrenches along these angles must positively span the planar wrenches: no plane through two of them has
    the others on one side.
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
    first, second = subsets(6, 2, points.device).unbind(-1)
    plane = torch.linalg.cross(planar[:, first], planar[:, second])  # (b, 15, 3)
    side = plane @ planar.mT  # (b, 15, 6)
    spans = torch.linalg.vector_norm(plane, dim=-1) > PARALLEL
    both = (side.amax(-1) > PARALLEL) & (side.amin(-1) < -PARALLEL)
    spanned = (both | ~spans).all(-1) & spans.any(-1)
    return spanned & (projected > cone).all(-1)


def _closed_by_proof(points: Vectors, normals: Vectors, friction: float) -> Bool[Tensor, "b"]:
    """Decide for more contacts, row by row until it is proven."""
    closed = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    rows = torch.nonzero((torch.isfinite(points) & torch.isfinite(normals)).flatten(1).all(1))[:, 0]
    wrench = wrenches(points[rows], normals[rows], friction, FIRST_EDGES).flatten(1, 2)
    for _ in range(ROUNDS):
        phi, witness = solve_closure_lp(wrench)
        balanced = (phi[:, None] @ wrench)[:, 0].abs().amax(-1) <= BALANCED
        proven = balanced & (phi.amin(-1) > BALANCED)
        closed[rows[proven]] = True
        least, opposing = most_opposing(points[rows], normals[rows], friction, witness)
        left = torch.nonzero(~proven & (least.amin(-1) < -BALANCED))[:, 0]
        if len(left) == 0:
            break
        rows, wrench = rows[left], torch.cat([wrench[left], opposing[left]], 1)
    return closed


def most_opposing(
    points: Vectors, normals: Vectors, friction: float, witness: Float[Tensor, "b 6"]
) -> tuple[Float[Tensor, "b f"], Float[Tensor, "b f 6"]]:
    """Return the least product of a wrench with the forces of normal component 1 at each contact, and their wrenches.

    With u = witness force + witness torque x arm, a force pushes along u at least where its friction points against the
    tangential part of u.
    """
    centre, radius = centre_and_radius(points)
    arm = (points - centre) / radius
    force, torque = witness[:, None].expand(-1, points.shape[1], -1).split(3, -1)
    motion = force + torch.linalg.cross(torque, arm)
    along = (motion * normals).sum(-1, keepdim=True)
    sideways = motion - along * normals
    length = torch.linalg.vector_norm(sideways, dim=-1, keepdim=True)
    push = -normals - friction * sideways / torch.where(length == 0, 1.0, length)
    return -(along + friction * length)[..., 0], torch.cat([push, torch.linalg.cross(arm, push)], -1)
