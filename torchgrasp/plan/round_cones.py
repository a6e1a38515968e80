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

from torchgrasp.geometry.frames import degenerate, subsets
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.wrench import BALANCED, Vectors, centre_and_radius, wrenches

PARALLEL = 1e-9
"""Planar wrenches (of length about 1) with a shorter cross product are parallel: above rounding in float64."""
FIRST_EDGES = 4
"""Edges of a cone in the first programme."""
ROUNDS = 12
"""Most programmes: twenty random grasps of four contacts close at friction 2e-7 too great at most, relatively; after
eight programmes it is 4e-5."""


def closed_exact(
    points: Vectors, normals: Vectors, friction: float, guess: Float[Tensor, "b m"] | None = None
) -> Bool[Tensor, "b"]:
    """Tell which contacts have frictional form closure with round cones.

    Degenerate and non-finite rows are not closed, nor are those at the very border.

    Args:
        points: three to five a row.
        normals: outward unit normals.
        friction: coefficient of friction.
        guess: the `first_balance` of contacts nearby, which most often decides four or five at once; None: unknown.
    """
    if points.shape[1] == 3:
        return _closed_in_plane(points, normals, friction) & ~degenerate(points)
    return _closed_by_proof(points, normals, friction, guess) & ~degenerate(points)


def first_balance(points: Vectors, normals: Vectors, friction: float) -> Float[Tensor, "b m"]:
    """Return the balance of the greatest margin of the edges with which a proof begins; any where nothing balances."""
    return solve_closure_lp(wrenches(points, normals, friction, FIRST_EDGES).flatten(1, 2))[0]


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


def _closed_by_proof(
    points: Vectors, normals: Vectors, friction: float, guess: Float[Tensor, "b m"] | None
) -> Bool[Tensor, "b"]:
    """Decide for more contacts, row by row until it is proven."""
    closed = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    if friction == 0:  # forces along normals may balance, but only seven or more span all wrenches
        return closed
    rows = torch.nonzero((torch.isfinite(points) & torch.isfinite(normals)).flatten(1).all(1))[:, 0]
    wrench = wrenches(points[rows], normals[rows], friction, FIRST_EDGES).flatten(1, 2)
    if guess is not None:
        proven = _balances(wrench, _corrected(wrench, guess[rows]))
        closed[rows[proven]] = True
        rows, wrench = rows[~proven], wrench[~proven]
    for _ in range(ROUNDS):
        phi, witness = solve_closure_lp(wrench)
        proven = _balances(wrench, phi)
        closed[rows[proven]] = True
        least, opposing = most_opposing(points[rows], normals[rows], friction, witness)
        left = torch.nonzero(~proven & (least.amin(-1) < -BALANCED))[:, 0]
        if len(left) == 0:
            break
        rows, wrench = rows[left], torch.cat([wrench[left], opposing[left]], 1)
    return closed


def _balances(wrench: Float[Tensor, "b m 6"], phi: Float[Tensor, "b m"]) -> Bool[Tensor, "b"]:
    """Tell whether coefficients are positive and balance."""
    return ((phi[:, None] @ wrench)[:, 0].abs().amax(-1) <= BALANCED) & (phi.amin(-1) > BALANCED)


def _corrected(wrench: Float[Tensor, "b m 6"], phi: Float[Tensor, "b m"]) -> Float[Tensor, "b m"]:
    """Return the balance with the least relative changes of given coefficients, of either sign."""
    weighted = phi.square()[..., None] * wrench
    factor, _ = torch.linalg.cholesky_ex(wrench.mT @ weighted)
    dual = torch.cholesky_solve((phi[:, None] @ wrench).mT, factor)
    return phi - (weighted @ dual)[..., 0]


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
