"""Balanced forces of three to five contacts that need the least friction.

Forces that balance lie in the null space of the grasp map. For three contacts the null space has
three dimensions: opposite pushes along each side of the triangle. A search over directions in this
space finds the best forces. For four and five contacts the forces are F = N z, with a basis N of
the null space, normal parts a_i and tangential parts t_i. Friction cones with friction coefficient
tau have an analytic centre, the forces that minimise

    sum c_i a_i - sum log(tau^2 a_i^2 - |t_i|^2).

Newton steps follow the centre while tau falls towards the least friction coefficient that balanced
forces need [1]. The factors c_i = 2 / (preferred normal force) also fix the scale.

[1] Boyd and El Ghaoui, Linear Algebra and its Applications 188, 1993.
"""

import functools
import math
from collections.abc import Iterable
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts.form_closure import Vectors, centre_and_radius, solve_closure_lp, wrenches
from torchgrasp.contacts.problem import contact_pairs, pull_signs
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.rules import ANY, Positive
from torchgrasp.geometry.frames import skew
from torchgrasp.geometry.linalg import GOLDEN_ANGLE, fibonacci_sphere, unit

DIRECTIONS = 1024
NEIGHBOURS = 128
REFINEMENTS = 12
SHRINK = 0.55
"""The search tries all directions, then neighbours of the best in rounds, each of a smaller radius
by `SHRINK`.
"""
EVENNESS = (
    0.01  # weight of the ratio of the largest to the least normal force, against the tangent needed
)
PREFERENCE = (
    0.2  # weight of the distance from the preferred proportions, against the tangent needed
)
# tangent that four or five contacts may need beyond the least one, so that their forces are more
# even
SLACK = 0.04
# Newton steps, and the share of tau's distance from the needed ratio that each step leaves
STEPS = 30
KEPT = 0.3
MAX_FRICTION = 10.0  # tangent of the widest friction cones in which forces are sought
Push = Float[Tensor, "b f k"]
Slide = Float[Tensor, "b f 3 k"]
"""The map from coordinates in the null space to normal forces, and to tangential forces."""


def grasp_map(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b 6 n"]:
    """Return the grasp matrix: it maps the forces at f points to total force and torque about their
    centroid.
    """
    arms = points - points.mean(-2, keepdim=True)
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*arms.shape[:-2], 3, 3)
    return torch.cat(
        [torch.cat([eye] * arms.shape[-2], -1), torch.cat(skew(arms).unbind(-3), -1)], -2
    )


def internal_forces(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b p f 3"]:
    """Return the opposite unit forces between the contacts of each pair; `[..., k, i, :]` acts on
    contact i in pair k.

    The forces of all pairs span all balanced forces, except for four or five contacts in one plane.
    """
    f = points.shape[-2]
    first, second = contact_pairs(f, points.device)
    sides = unit(points[..., second, :] - points[..., first, :])
    return pull_signs(f, points.device).to(points).T[..., None] * sides[..., None, :]


def tangential_ratio(
    forces: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]
) -> Float[Tensor, "*b f"]:
    """Return the ratio of tangential to normal force at each contact; infinite where a force does
    not push.
    """
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
    """Return balanced fingertip forces on the object [N] that need the least friction.

    Forces of three contacts lie in the friction cones whenever any balanced forces do, except for a
    small error: the search also slightly favours even forces. Forces of four or five contacts may
    need slightly more friction than the least.

    Args: points: contacts [m]. normals: outward unit normals of the object. strongest: normal force
        of the strongest finger [N]. preferred: ratios of the normal forces to prefer among forces
        of similar friction; by default they are equal.

    Returns:
        Forces; NaN rows where no balanced forces push at all contacts.

    >>> points = torch.tensor([[[0.0, 1, 0], [0, 0, 0], [1, 0.5, 0]]])
    >>> normals = torch.tensor([[[-1.0, 0, 0], [-1, 0, 0], [1, 0, 0]]])
    >>> least_friction_forces(points, normals, 2.0)[0, :, 0].round(decimals=2)
    tensor([ 1.,  1., -2.])
    """
    rows = (-1, *points.shape[-2:])
    p = points.double().reshape(rows)
    n = normals.double().reshape(rows)
    if preferred is not None:
        preferred = (preferred / preferred.amax(-1, keepdim=True)).double()
        preferred = preferred.expand(points.shape[:-1]).reshape(-1, points.shape[-2])
    if points.shape[-2] == 3:
        forces = _search_forces(p, n, preferred)
    else:  # every finger has to push
        wanted = p.new_ones(p.shape[:-1]) if preferred is None else preferred.clamp(min=0.05)
        forces = central_forces(p, n, wanted, SLACK)
    forces = forces.to(points).reshape(points.shape)
    push = -(forces * normals).sum(-1)
    return forces * (strongest / push.amax(-1))[..., None, None]


def _search_forces(
    points: Float[Tensor, "b 3 3"],
    normals: Float[Tensor, "b 3 3"],
    preferred: Float[Tensor, "b 3"] | None,
) -> Float[Tensor, "b 3 3"]:
    """Return balanced forces of three contacts that need least friction, of any scale; NaN if none
    push everywhere.
    """
    sides = points[:, [1, 2, 0]] - points
    sides = sides / ((sides * sides).sum(-1) ** 0.5)[..., None]
    basis = pull_signs(3, points.device).T[..., None] * sides[:, :, None]
    push = -(basis * normals[:, None]).sum(-1)
    slide = (basis + push[..., None] * normals[:, None]).reshape(-1, 3, 9).swapaxes(1, 2)
    push = push.swapaxes(1, 2)  # (b, 3, 3): normal force at each contact by each push
    weights, found = _improve(
        push, slide, torch.zeros_like(push[:, 0]), _search_steps(push.device), preferred
    )
    forces = (weights[:, None] @ basis.reshape(-1, 3, 9)).reshape(-1, 3, 3)
    return torch.where(found[:, None, None], forces, torch.nan)


def forces_near(points: Vectors, normals: Vectors, weights: Float[Tensor, "b p"]) -> Vectors:
    """Return balanced forces of little friction whose shares on the `internal_forces` are near
    given `weights`.

    A short search begins with the weights. Forces are of any scale; a row is NaN where none is
    found that pushes at all contacts.
    """
    pairs = internal_forces(points)
    push = -(pairs * normals[:, None]).sum(-1)
    slide = (pairs + push[..., None] * normals[:, None]).flatten(2)
    weights, found = _improve(
        push.mT, slide.mT, weights, _near_steps(weights.shape[1], push.device), None
    )
    return torch.where(
        found[:, None, None], torch.einsum("bp,bpfi->bfi", weights, pairs), torch.nan
    )


def _improve(
    push: Float[Tensor, "b f p"],
    slide: Float[Tensor, "b n p"],
    weights: Float[Tensor, "b p"],
    rounds: Iterable[Float[Tensor, "p s"]],
    preferred: Float[Tensor, "b f"] | None,
) -> tuple[Float[Tensor, "b p"], Bool[Tensor, "b"]]:
    """Return the weights of least cost in rounds of tried steps, of length 1, and whether they push
    everywhere.
    """
    row = torch.arange(len(push), device=push.device)
    best = row
    costs = weights
    for steps in rounds:
        tried = weights[:, :, None] + steps
        normal = push @ tried
        across = slide @ tried
        ratio = ((across * across).unflatten(1, (-1, 3)).sum(2) / (normal * normal)).amax(1) ** 0.5
        least = normal.amin(1)
        most = normal.amax(1)
        if preferred is None:
            uneven = EVENNESS * most / least
        else:
            off = normal / most[:, None] - preferred[..., None]
            uneven = PREFERENCE * (off * off).sum(1) ** 0.5
        costs = torch.where(least > 1e-12, ratio + uneven, torch.inf)
        best = costs.argmin(-1)
        weights = tried[row, :, best]
        weights = weights / (weights * weights).sum(-1)[:, None] ** 0.5
    return weights, torch.isfinite(costs[row, best])


@functools.cache
def _search_steps(device: torch.device) -> tuple[Float[Tensor, "3 s"], ...]:
    """Return for each round of a search the changes of the three normal forces that it tries, ever
    smaller.
    """
    with torch.device("cpu"):  # whatever the default device is
        first, near = (fibonacci_sphere(n, GOLDEN_ANGLE, 0.0) for n in (DIRECTIONS, NEIGHBOURS))
        around = torch.cat([near.new_zeros(1, 3), near]).T
    radii = 4 / math.sqrt(DIRECTIONS) * SHRINK ** np.arange(REFINEMENTS)
    return tuple(
        x.to(device)
        for x in (first.T.contiguous(), *(radius * around for radius in radii.tolist()))
    )


@functools.cache
def _near_steps(pairs: int, device: torch.device) -> tuple[Float[Tensor, "p s"], ...]:
    """Return for each round of a short search the changes of the weights of all pairs that it
    tries.
    """
    count = 24
    radii = (0.5, 0.28, 0.15)
    draw = torch.Generator("cpu").manual_seed(0)
    steps = unit(torch.randn(count, pairs, generator=draw, dtype=torch.float64, device="cpu"))
    steps = steps * torch.linspace(0.3, 1.0, count, dtype=torch.float64, device="cpu")[:, None]
    around = torch.cat([steps.new_zeros(1, pairs), steps]).T
    return tuple((radius * around).to(device) for radius in radii)


def central_forces(
    points: Vectors, normals: Vectors, preferred: Float[Tensor, "b f"], slack: float
) -> Vectors:
    """Return balanced forces that need nearly the least friction, near the preferred normal forces.

    `slack` is added to the friction coefficient that the forces need: a larger one gives forces
    nearer to the preferred ones. A row is NaN where no balanced forces push at every contact within
    `MAX_FRICTION`.
    """
    wrench = grasp_map(points / centre_and_radius(points)[1])
    basis = (
        torch.linalg.qr(wrench.mT, mode="complete").Q[:, :, 6:].unflatten(1, points.shape[1:])
    )  # (b, f, 3, k)
    push = -(normals[..., None] * basis).sum(2)  # (b, f, k): a = push z
    slide = basis + normals[..., None] * push[:, :, None]
    pushes = push[..., :, None] * push[..., None, :]
    slides = slide.mT @ slide
    start = torch.einsum("bfik,bfi->bk", basis, -preferred[..., None] * normals)
    pulls = ~((push @ start[..., None])[..., 0] > 0).all(1)
    wrench = wrenches(points[pulls], normals[pulls], MAX_FRICTION, edges=4)
    phi, _ = solve_closure_lp(wrench.flatten(1, 2))
    found = (phi.unflatten(1, wrench.shape[1:3])[..., None] * wrench[..., :3]).sum(2)
    found = torch.where((phi.amin(-1) > 0)[:, None, None], found, torch.nan)
    start = start.index_put((pulls,), torch.einsum("bfik,bfi->bk", basis[pulls], found))
    linear = (2 / preferred[..., None] * push).sum(1)
    z = start * (2 * points.shape[1] / (linear * start).sum(1))[:, None]
    ratio = _needed(push, slide, z)
    tau = 1.1 * ratio + slack
    row = torch.arange(len(z), device=z.device)
    lengths = 2 ** torch.arange(5, device=z.device).to(z)
    for _ in range(STEPS):
        cone = tau.square()[:, None, None, None] * pushes - slides  # (b, f, k, k)
        half = (cone @ z[:, None, :, None])[..., 0]
        height = (half * z[:, None]).sum(-1, keepdim=True)
        scaled = 2 * half / height
        gradient = linear - scaled.sum(1)
        hessian = scaled.mT @ scaled - (2 * cone / height[..., None]).sum(1)
        factor, _ = torch.linalg.cholesky_ex(hessian)
        step = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        decrement = (-(gradient * step).sum(1)).clamp(min=0).sqrt()
        # Multiples of a step that is safe for every self-concordant function.
        tried = (
            z[:, None] + (lengths / (1 + decrement[:, None]))[..., None] * step[:, None]
        )  # (b, l, k)
        normal, tangential = _size(push, slide, tried)
        widest = tau[:, None, None] * normal
        logs = ((widest - tangential).log() + (widest + tangential).log()).sum(-1)
        value = (tried @ linear[..., None])[..., 0] - logs
        z = tried[row, torch.where(torch.isfinite(value), value, torch.inf).argmin(1)]
        ratio = _needed(push, slide, z)
        # Farther from the centre tau would fall faster than the steps can follow.
        tau = torch.where(decrement < 1.0, ratio + (KEPT * (tau - ratio)).clamp(min=slack), tau)
    return (basis @ z[:, None, :, None])[..., 0]


def _size(
    push: Push, slide: Slide, z: Float[Tensor, "b l k"]
) -> tuple[Float[Tensor, "b l f"], Float[Tensor, "b l f"]]:
    """Return the sizes of normal and tangential forces at all contacts, for l vectors z of null-
    space coordinates.
    """
    tangential = (slide.flatten(1, 2) @ z.mT).unflatten(1, slide.shape[1:3])  # (b, f, 3, l)
    return z @ push.mT, torch.linalg.vector_norm(tangential, dim=2).mT


def _needed(push: Push, slide: Slide, z: Float[Tensor, "b k"]) -> Float[Tensor, "b"]:
    """Return the friction coefficient that forces with null-space coordinates z need: the largest
    over the contacts.
    """
    normal, tangential = _size(push, slide, z[:, None])
    return (tangential / normal)[:, 0].amax(1)
