"""Internal forces of contacts: in equilibrium, with the least friction.

Of three contacts a push along each side of the triangle spans the null space of the grasp map. The search goes over
directions in it: balance holds by construction. More contacts have a method of centres (`cone_forces`).
"""

import functools
import math
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import ANY, Positive, checked
from torchgrasp.geometry.linalg import GOLDEN_ANGLE, fibonacci_sphere, unit
from torchgrasp.plan.cone_forces import forces_in_cones
from torchgrasp.plan.problem import contact_pairs, pull_signs

DIRECTIONS, NEIGHBOURS = 1024, 128
"""Directions in the null space that are tried first, 0.06 rad apart, and around the best in each refinement."""
REFINEMENTS, SHRINK = 12, 0.55
"""Rounds of the search, and the radius of each over the last: from 0.12 rad down to 1e-4 rad."""
FEW = 8
"""Sets of contacts up to which NumPy searches sooner than torch."""
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
    sets = [x.double().reshape(-1, 3, 3) for x in (points, normals)]
    if preferred is not None:
        proportions = (preferred / preferred.amax(-1, keepdim=True)).double()
        sets.append(proportions.expand(points.shape[:-1]).reshape(-1, 3, 1))
    if len(sets[0]) <= FEW and points.device.type == "cpu":
        with np.errstate(all="ignore"):  # of contacts that are not finite, or far away, and of those that pull
            forces = torch.from_numpy(_search_sets(np, *(x.numpy() for x in sets)))
    else:
        forces = _search_sets(torch, *sets)
    return forces.to(points).reshape(points.shape)


def _search_sets(space: Any, points: Any, normals: Any, preferred: Any = None) -> Any:
    """Return the forces (b, 3, 3) of b sets of contacts; arguments as for `_search_weights`.

    With NumPy all of it is: a hand that begins to hold has one tick for it, and torch's calls took a third of that.
    """
    signs = pull_signs(3, torch.device("cpu")).T.numpy() if space is np else pull_signs(3, points.device).T
    sides = points[:, [1, 2, 0]] - points
    sides = sides / ((sides * sides).sum(-1) ** 0.5)[..., None]
    basis = signs[..., None] * sides[:, :, None]
    push = -(basis * normals[:, None]).sum(-1)
    slide = basis + push[..., None] * normals[:, None]
    turned = push.swapaxes(1, 2), slide.reshape(-1, 3, 9).swapaxes(1, 2)
    weights, cost = _search_weights(space, *turned, preferred)
    forces = (weights[:, None] @ basis.reshape(-1, 3, 9)).reshape(-1, 3, 3)
    return space.where(space.isfinite(cost)[:, None, None], forces, math.nan)


def _search_weights(space: Any, push: Any, slide: Any, preferred: Any = None) -> tuple[Any, Any]:
    """Return the best weights of the pushes for each of b sets, and their costs; infinite where a contact pulls.

    Args:
        space: `torch`, or `numpy` with arrays: the fewer the sets, the more of the time goes into calls.
        push: (b, 3, 3), normal forces at each contact of each push.
        slide: (b, 9, 3), tangential forces at each contact of each push.
        preferred: (b, 3, 1), proportions of the normal forces; None: equal ones.
    """
    rows, *rounds = np.arange(len(push)), *_rounds()
    if space is torch:
        rows, *rounds = (torch.from_numpy(x).to(push.device) for x in (rows, *rounds))
    weights = space.zeros_like(push[:, 0])
    best, costs = rows, weights
    for steps in rounds:
        tried = weights[:, :, None] + steps
        normal = push @ tried
        across = slide @ tried
        ratio = space.amax((across * across).reshape(*push.shape, steps.shape[1]).sum(2) / (normal * normal), 1) ** 0.5
        least, most = space.amin(normal, 1), space.amax(normal, 1)
        if preferred is None:
            uneven = EVENNESS * most / least
        else:
            off = normal / most[:, None] - preferred
            uneven = PREFERENCE * (off * off).sum(1) ** 0.5
        costs = space.where(least > 1e-12, ratio + uneven, math.inf)
        best = space.argmin(costs, -1)
        weights = tried[rows, :, best]
        weights = weights / (weights * weights).sum(-1)[:, None] ** 0.5
    return weights, costs[rows, best]


@functools.cache
def _rounds() -> tuple[np.ndarray, ...]:
    """Return the steps that each round of the search tries: all directions first, then ever shorter ones."""
    with torch.device("cpu"):  # whatever the default device is
        first, near = (fibonacci_sphere(n, GOLDEN_ANGLE, 0.0).numpy() for n in (DIRECTIONS, NEIGHBOURS))
    around = np.concatenate([np.zeros((1, 3)), near]).T
    radii = 4 / math.sqrt(DIRECTIONS) * SHRINK ** np.arange(REFINEMENTS)
    return first.T.copy(), *(radius * around for radius in radii)
