"""Internal forces of contacts: in equilibrium, with the least friction.

Of three contacts a push along each side of the triangle spans the null space of the grasp map. The search goes over
directions in it: balance holds by construction. More contacts have a method of centres (`cone_forces`).
"""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.border import ANY, Positive, checked
from torchgrasp.linalg import GOLDEN_ANGLE, fibonacci_sphere, unit
from torchgrasp.plan.cone_forces import forces_in_cones
from torchgrasp.plan.problem import contact_pairs, pull_signs

DIRECTIONS, NEIGHBOURS = 1024, 64
"""Directions in the null space that are tried first, 0.06 rad apart, and around the best in each refinement."""
REFINEMENTS, SHRINK = 24, 0.75
"""Rounds of the search, and the radius of each over the last: from 0.12 rad down to 1e-4 rad."""
EVENNESS = 0.01
"""Worth of equal normal forces against the friction angle (its tangent): it decides only between equally good sets."""
PREFERENCE = 0.2
"""Worth of the preferred proportions of the normal forces against the friction angle (its tangent)."""
SLACK = 0.04
"""Tangent that four or five contacts give for more even forces. Without it some push with a hundredth of the others'.
Planned contacts need 0.02 more friction on average and 0.07 at most, and the weakest pushes with a sixth."""
LEAST_PREFERRED = 0.05
"""Least preferred normal force of four or five contacts, over the greatest: all have to push."""


def internal_forces(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b p f 3"]:
    """Return pushes between the p pairs of contacts: `[..., k, i, :]` is the force at contact i under push k.

    Forces and torques cancel. For three contacts the pairs are (0, 1), (1, 2) and (2, 0), and the pushes span the null
    space of the grasp map. For four and five (`contact_pairs`) they do unless the contacts lie in one plane.

    >>> internal_forces(torch.eye(3)).sum(1).abs().max()
    tensor(0.)
    """
    f = points.shape[-2]
    first, second = contact_pairs(f, points.device)
    sides = unit(points[..., second, :] - points[..., first, :])
    return pull_signs(f, points.device).to(points).T[..., None] * sides[..., None, :]


def tangential_ratio(forces: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b f"]:
    """Return tangential over normal force, the friction needed; infinite where a contact pulls."""
    push = -(forces * normals).sum(-1)
    tangential = torch.linalg.vector_norm(forces + push[..., None] * normals, dim=-1)
    return torch.where(push > 0, tangential / push.clamp_min(1e-12), torch.inf)


@checked
def least_friction_forces(
    points: Annotated[Float[Tensor, "*b f 3"], ANY],
    normals: Annotated[Float[Tensor, "*b f 3"], ANY],
    strongest: Positive = 4.0,
    preferred: Annotated[Float[Tensor, "*#b f"], ANY] | None = None,
) -> Float[Tensor, "*b f 3"]:
    """Return the balanced forces of the fingers on the object [N] that need the least friction.

    Those of three contacts lie in the friction cones whenever any balanced set does; those of more need up to 0.1 more
    than the least tangent, for more even forces. A thumb against two fingers presses with the sum of their forces.

    Args:
        points: contacts [m].
        normals: outward unit normals of the object.
        strongest: normal force of the strongest finger [N].
        preferred: normal forces whose proportions decide between sets that need nearly the same friction; None: equal.

    Returns:
        Forces; NaN rows where no balanced set pushes at all contacts.

    >>> points = torch.tensor([[[0.0, 1, 0], [0, 0, 0], [1, 0.5, 0]]])
    >>> normals = torch.tensor([[[-1.0, 0, 0], [-1, 0, 0], [1, 0, 0]]])
    >>> least_friction_forces(points, normals, 2.0)[0, :, 0].round(decimals=2)
    tensor([ 1.,  1., -2.])
    """
    search = _search_forces if points.shape[-2] == 3 else _central_forces
    forces = search(points, normals, preferred)
    push = -(forces * normals).sum(-1)
    return forces * (strongest / push.amax(-1))[..., None, None]


def _central_forces(
    points: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"], preferred: Float[Tensor, "*#b f"] | None
) -> Float[Tensor, "*b f 3"]:
    """Return the forces of four or five contacts, NaN where none push everywhere."""
    wanted = points.new_ones(points.shape[:-1])
    if preferred is not None:
        wanted = (preferred / preferred.amax(-1, keepdim=True)).clamp(min=LEAST_PREFERRED).expand(points.shape[:-1])
    rows, wanted = (-1, *points.shape[-2:]), wanted.double().reshape(-1, points.shape[-2])
    forces = forces_in_cones(points.double().reshape(rows), normals.double().reshape(rows), wanted, SLACK)
    return forces.to(points).view_as(points)


def _search_forces(
    points: Float[Tensor, "*b 3 3"], normals: Float[Tensor, "*b 3 3"], preferred: Float[Tensor, "*#b 3"] | None
) -> Float[Tensor, "*b 3 3"]:
    """Return the forces of three contacts, NaN where none push everywhere."""
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
    return torch.where(torch.isfinite(cost)[..., None, None], forces, torch.nan)
