"""Internal forces of three contacts: in equilibrium, with the least friction.

A push along each side of the triangle spans the null space of the grasp map. The search goes over directions in it:
balance holds by construction.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.linalg import GOLDEN_ANGLE, fibonacci_sphere, unit

DIRECTIONS, NEIGHBOURS = 1024, 64
"""Directions in the null space that are tried first, 0.06 rad apart, and around the best in each refinement."""
REFINEMENTS, SHRINK = 24, 0.75
"""Rounds of the search, and the radius of each over the last: from 0.12 rad down to 1e-4 rad."""
EVENNESS = 0.01
"""Worth of equal normal forces against the friction angle (its tangent): it decides only between equally good sets."""
PREFERENCE = 0.2
"""Worth of the preferred proportions of the normal forces against the friction angle (its tangent)."""


def internal_forces(points: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3 3"]:
    """Return the null space of the grasp map: `[..., k, i, :]` is the force at contact i under push k.

    Pushes are between contacts (0, 1), (1, 2) and (2, 0), along their side: forces and torques cancel.

    >>> internal_forces(torch.eye(3)).sum(1).abs().max()
    tensor(0.)
    """
    sides = unit(points.roll(-1, dims=-2) - points)
    basis = torch.zeros(*points.shape[:-2], 3, 3, 3, dtype=points.dtype, device=points.device)
    for pair in range(3):
        basis[..., pair, pair, :] = sides[..., pair, :]
        basis[..., pair, (pair + 1) % 3, :] = -sides[..., pair, :]
    return basis


def tangential_ratio(forces: Float[Tensor, "*b 3 3"], normals: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return tangential over normal force, the friction needed; infinite where a contact pulls."""
    push = -(forces * normals).sum(-1)
    tangential = torch.linalg.vector_norm(forces + push[..., None] * normals, dim=-1)
    return torch.where(push > 0, tangential / push.clamp_min(1e-12), torch.inf)


def least_friction_forces(
    points: Float[Tensor, "*b 3 3"],
    normals: Float[Tensor, "*b 3 3"],
    strongest: float = 4.0,
    preferred: Float[Tensor, "*#b 3"] | None = None,
) -> Float[Tensor, "*b 3 3"]:
    """Return the balanced forces of the fingers on the object [N] that need the least friction.

    They lie in the friction cones whenever any balanced set does. A thumb against two fingers presses with the sum of
    their forces.

    Args:
        points: contacts [m].
        normals: outward unit normals of the object.
        strongest: normal force of the strongest finger [N].
        preferred: normal forces whose proportions decide between sets that need nearly the same friction; None: equal.

    Returns:
        Forces; NaN rows where no balanced set pushes at all three contacts.

    >>> points = torch.tensor([[[0.0, 1, 0], [0, 0, 0], [1, 0.5, 0]]])
    >>> normals = torch.tensor([[[-1.0, 0, 0], [-1, 0, 0], [1, 0, 0]]])
    >>> least_friction_forces(points, normals, 2.0)[0, :, 0].round(decimals=2)
    tensor([ 1.,  1., -2.])
    """
    basis = internal_forces(points)
    preferred = None if preferred is None else (preferred / preferred.amax(-1, keepdim=True))[..., None, :]

    def best(weights: Float[Tensor, "*b k 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b"]]:
        """Return the best of k combinations, and its cost; infinite where a contact pulls."""
        forces = torch.einsum("...jk,...kci->...jci", weights, basis)
        outward = normals[..., None, :, :]
        push = -(forces * outward).sum(-1)
        if preferred is None:
            uneven = EVENNESS * push.amax(-1) / push.amin(-1).clamp_min(1e-12)
        else:
            uneven = PREFERENCE * torch.linalg.vector_norm(push / push.amax(-1, keepdim=True) - preferred, dim=-1)
        cost = tangential_ratio(forces, outward.expand_as(forces)).amax(-1) + uneven
        least = cost.argmin(-1, keepdim=True)
        index = least[..., None].expand(*least.shape, 3)
        return weights.gather(-2, index)[..., 0, :], cost.gather(-1, least)[..., 0]

    weights, cost = best(fibonacci_sphere(DIRECTIONS, GOLDEN_ANGLE, 0.0).to(points).expand(*points.shape[:-2], -1, 3))
    around, radius = fibonacci_sphere(NEIGHBOURS, GOLDEN_ANGLE, 0.0).to(points), 4 / math.sqrt(DIRECTIONS)
    for _ in range(REFINEMENTS):
        near = unit(weights[..., None, :] + radius * around)
        weights, cost = best(torch.cat([weights[..., None, :], near], dim=-2))
        radius *= SHRINK
    forces = torch.einsum("...k,...kci->...ci", weights, basis)
    push = -(forces * normals).sum(-1)
    scaled = forces * (strongest / push.amax(-1))[..., None, None]
    return torch.where(torch.isfinite(cost)[..., None, None], scaled, torch.nan)
