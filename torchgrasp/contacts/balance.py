"""Balanced forces of three to five contacts that need the least friction.

Forces that balance lie in the null space of the grasp map. For three contacts the null space has
three dimensions: opposite pushes along each side of the triangle. A search over directions in this
space finds the best forces. For four and five contacts the forces are F = N z. N is a basis of the
null space, with normal parts a_i and tangential parts t_i. Friction cones with friction coefficient
tau have an analytic centre, the forces that minimise

    sum c_i a_i - sum log(tau^2 a_i^2 - |t_i|^2).

Newton steps follow the centre while tau falls towards the least friction coefficient that balanced
forces need [1]. The factors c_i = 2 / (preferred normal force) also fix the scale.

[1] Boyd and El Ghaoui, Linear Algebra and its Applications 188, 1993.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts.form_closure import (
    Vectors,
    centre_and_radius,
    count_contacts,
    solve_closure_lp,
    wrenches,
)
from torchgrasp.contacts.problem import Tensions, contact_pairs, pull_signs
from torchgrasp.foundation.base import row_numbers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.rules import ANY, Positive
from torchgrasp.geometry.frames import skew
from torchgrasp.geometry.linalg import (
    GOLDEN_ANGLE,
    check_unit_vectors,
    dot,
    eye_like,
    fibonacci_sphere,
    matvec,
    norm,
    unit,
)


@dataclasses.dataclass(frozen=True)
class BalanceNumbers:
    """Parameters of the searches for balanced contact forces.

    One search tries directions in the space of balanced forces of three contacts. A short search
    changes known weights of pairs of contacts. Newton's method finds the forces of four or five
    contacts, in friction cones of a falling coefficient tau.
    """

    directions: int = 1024
    """Number of directions that the search tries first."""
    neighbours: int = 128
    """Number of neighbours of the best direction in each later round."""
    refinements: int = 12
    """Number of later rounds."""
    shrink: float = 0.55
    """Factor on the radius of the neighbours from round to round."""
    evenness: float = 0.01
    """Weight of the ratio of the largest to the least normal force, relative to the friction
    coefficient needed.
    """
    preference: float = 0.2
    """Weight of the distance from the preferred proportions, relative to the friction coefficient
    needed.
    """
    near: int = 24
    """Number of changes of the pairs' weights that each round of the short search tries."""
    near_radii: tuple[float, ...] = (0.5, 0.28, 0.15)
    """Lengths of the longest changes of these weights, one for each round of the short search."""
    near_least: float = 0.3
    """Length of the shortest change in a round, as a share of the longest."""
    slack: float = 0.04
    """Coefficient of friction that four or five contacts may need beyond the least one, for more
    even forces.
    """
    least_preferred: float = 0.05
    """Least preferred normal force, as a share of the largest: every finger has to push."""
    steps: int = 30
    """Number of Newton steps."""
    lengths: int = 5
    """Number of lengths of each step that are tried, each twice the one before."""
    kept: float = 0.3
    """Share that each step leaves of tau's distance from the friction that the forces need."""
    first: float = 1.1
    """The first tau, as a multiple of the friction that the first forces need."""
    max_friction: float = 10.0
    """Friction coefficient of the widest cones in which forces are sought."""
    edges: int = 4
    """Number of edges of these cones."""
    pushing: float = 1e-12
    """Normal force above which a contact pushes: above rounding."""


BALANCE = BalanceNumbers()
Push = Float[Tensor, "b f k"]
"""The map from k coordinates in the null space to normal forces at f contacts, for b contact sets.
"""
Slide = Float[Tensor, "b f 3 k"]
"""The map from k coordinates in the null space to tangential forces (3 components) at f contacts.
"""


def grasp_map(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b 6 n"]:
    """Return the grasp matrix (*b, 6, 3 f), which maps forces at f `points` to their total force
    and torque.

    The n = 3 f columns are ordered by point, then by axis. The torque is about the centroid of the
    points, and has the unit of force times that of the points. `*b` stands for any leading axes.
    """
    arms = points - points.mean(-2, keepdim=True)
    force = eye_like(3, points).expand(*arms.shape, 3)
    # one block (6, 3) of force and torque for each contact, side by side
    return torch.cat(torch.cat([force, skew(arms)], -2).unbind(-3), -1)


def internal_forces(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b p f 3"]:
    """Return for each of p pairs of contacts the two opposite unit forces that pull them together.

    `points` (*b, f, 3) hold sets of f contacts, and `*b` stands for any leading axes. `[..., k, i,
    :]` is the force on contact i by pair k, which is 0 unless i belongs to the pair. Pairs of
    neighbours (i, i + 1) come first, then (i, i + 2). The forces of all pairs span all balanced
    forces, except for four or five contacts in one plane.
    """
    f = points.shape[-2]
    first, second = contact_pairs(f, points.device)
    sides = unit(points[..., second, :] - points[..., first, :])
    signs = pull_signs(f, points.device).to(points).T  # (p, f)
    return signs[..., None] * sides[..., None, :]


def split_forces(
    forces: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*c f 3"]
) -> tuple[Float[Tensor, "*d f"], Float[Tensor, "*d f 3"]]:
    """Return the normal parts (*d, f) of `forces` on an object, then the tangential parts (*d, f,
    3).

    A normal part is positive if the force pushes. Forces, normals and results are in one frame.
    `normals` are the outward unit normals of the object where the forces act. The leading axes *b
    and *c are broadcast to *d.
    """
    push = -dot(forces, normals)
    return push, forces + push[..., None] * normals


def tangential_ratio(
    forces: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]
) -> Float[Tensor, "*b f"]:
    """Return the ratio (no unit) of tangential to normal force at each of f contacts.

    `forces` act on the object, whose outward unit normals are `normals`. The ratio is infinite
    where a force does not push.
    """
    push, slide = split_forces(forces, normals)
    ratio = norm(slide) / push.clamp_min(BALANCE.pushing)
    return torch.where(push > 0, ratio, torch.inf)


@checked
def least_friction_forces(
    points: Annotated[Float[Tensor, "*b f 3"], ANY],
    normals: Annotated[Float[Tensor, "*b f 3"], ANY],
    strongest: Positive = 4.0,
    preferred: Annotated[Float[Tensor, "*#b f"], ANY] | None = None,
) -> Float[Tensor, "*b f 3"]:
    """Return balanced fingertip forces (*b, f, 3) [N] on the object that need the least friction.

    Their sum and the sum of their torques are zero. The friction that they need is the greatest
    ratio of tangential to normal force at a contact. It is a little more than the least possible
    one, because equal normal forces are also favoured. For four or five contacts it may be greater
    by 0.04 (`BALANCE.slack`). All forces of a set are NaN if no balanced forces are found that push
    at each contact.

    Args:
        points: positions (*b, f, 3) [m] of the f contacts of each set, 3 to 5.
        normals: outward unit normals (*b, f, 3) of the object. Points, normals and forces are in
            one frame.
        strongest: greatest normal force [N] in each set; the forces are scaled to it.
        preferred: positive ratios (*b, f) or (f,) of the normal forces to prefer among forces of
            similar friction, without unit. None means equal ones.

    Raises `BadArgument` for another number of contacts, or a `strongest` that is not positive. On
    the CPU it is also raised for normals that are not of length 1 (to 1e-3).

    >>> points = torch.tensor([[[0.0, 1, 0], [0, 0, 0], [1, 0.5, 0]]])
    >>> normals = torch.tensor([[[-1.0, 0, 0], [-1, 0, 0], [1, 0, 0]]])
    >>> least_friction_forces(points, normals, 2.0)[0, :, 0].round(decimals=2)
    tensor([ 1.,  1., -2.])
    """
    f = count_contacts(points)
    p = points.double().reshape(-1, f, 3)
    n = normals.double().reshape(-1, f, 3)
    # elsewhere a plan would wait for the device
    if n.device.type == "cpu":
        check_unit_vectors("normals", n)
    if preferred is not None:
        preferred = (preferred / preferred.amax(-1, keepdim=True)).double()
        preferred = preferred.expand(points.shape[:-1]).reshape(-1, f)
    if f == 3:
        forces = _search_forces(p, n, preferred)
    else:
        wanted = p.new_ones(p.shape[:-1])
        if preferred is not None:
            wanted = preferred.clamp(min=BALANCE.least_preferred)
        forces = central_forces(p, n, wanted, BALANCE.slack)
    forces = forces.to(points).reshape(points.shape)
    push = -dot(forces, normals)
    return forces * (strongest / push.amax(-1))[..., None, None]


def _search_forces(
    points: Float[Tensor, "b 3 3"],
    normals: Float[Tensor, "b 3 3"],
    preferred: Float[Tensor, "b 3"] | None,
) -> Float[Tensor, "b 3 3"]:
    """Return balanced forces of three contacts that need the least friction, of any scale.

    They are NaN where no balanced forces push at all contacts.
    """
    sides = points[:, [1, 2, 0]] - points
    length = dot(sides, sides, keepdim=True) ** 0.5
    signs = pull_signs(3, points.device).T  # (p, f)
    basis = signs[..., None] * (sides / length)[:, :, None]
    push, slide = split_forces(basis, normals[:, None])
    slide = slide.reshape(-1, 3, 9).swapaxes(1, 2)
    push = push.swapaxes(1, 2)  # (b, 3, 3): normal force at each contact by each push
    start = torch.zeros_like(push[:, 0])
    weights, found = _improve(push, slide, start, _search_steps(push.device), preferred)
    forces = (weights[:, None] @ basis.reshape(-1, 3, 9)).reshape(-1, 3, 3)
    return torch.where(found[:, None, None], forces, torch.nan)


def forces_near(points: Vectors, normals: Vectors, weights: Tensions) -> Vectors:
    """Return balanced forces (b, f, 3) that need little friction, found by a short search from
    `weights`.

    `points` (b, f, 3) are the contacts, `normals` (b, f, 3) the outward unit normals. The forces
    are a weighted sum of the `internal_forces` of p pairs. The search changes the `weights` (b, p),
    which have no unit. The scale of the forces is arbitrary. The forces of a set are NaN if the
    search finds none that push at all of its contacts.
    """
    pairs = internal_forces(points)
    push, slide = split_forces(pairs, normals[:, None])
    steps = _near_steps(weights.shape[1], push.device)
    weights, found = _improve(push.mT, slide.flatten(2).mT, weights, steps, None)
    forces = torch.einsum("bp,bpfi->bfi", weights, pairs)
    return torch.where(found[:, None, None], forces, torch.nan)


def _improve(
    push: Float[Tensor, "b f p"],
    slide: Float[Tensor, "b n p"],
    weights: Tensions,
    rounds: Iterable[Float[Tensor, "p _"]],
    preferred: Float[Tensor, "b f"] | None,
) -> tuple[Tensions, Bool[Tensor, "b"]]:
    """Return the weights of least cost, of length 1, after rounds of a search. Return also a mask
    of the sets where they push everywhere.

    `push` and `slide` map weights to normal and tangential forces (n = 3 f numbers). Each of the
    `rounds` (p, s) holds the s changes of the weights that it tries; s may differ.
    """
    row = row_numbers(push)
    best = row
    costs = weights
    for steps in rounds:
        tried = weights[:, :, None] + steps
        normal = push @ tried
        across = slide @ tried
        squares = (across * across).unflatten(1, (-1, 3))  # (b, f, 3, s)
        tangential = squares.sum(2)
        ratio = (tangential / (normal * normal)).amax(1) ** 0.5
        least = normal.amin(1)
        most = normal.amax(1)
        if preferred is None:
            uneven = BALANCE.evenness * most / least
        else:
            off = normal / most[:, None] - preferred[..., None]
            uneven = BALANCE.preference * (off * off).sum(1) ** 0.5
        costs = torch.where(least > BALANCE.pushing, ratio + uneven, torch.inf)
        best = costs.argmin(-1)
        weights = tried[row, :, best]
        weights = weights / dot(weights, weights, keepdim=True) ** 0.5
    return weights, torch.isfinite(costs[row, best])


@functools.cache
def _search_steps(device: torch.device) -> tuple[Float[Tensor, "3 s"], ...]:
    """Return for each round of a search the changes of the three normal forces that it tries, ever
    smaller.
    """
    with torch.device("cpu"):  # whatever the default device is
        first = fibonacci_sphere(BALANCE.directions, GOLDEN_ANGLE, 0.0)
        near = fibonacci_sphere(BALANCE.neighbours, GOLDEN_ANGLE, 0.0)
        around = torch.cat([near.new_zeros(1, 3), near]).T
    rounds = np.arange(BALANCE.refinements)
    radii = 4 / math.sqrt(BALANCE.directions) * BALANCE.shrink**rounds
    steps = [first.T.contiguous(), *(radius * around for radius in radii.tolist())]
    return tuple(x.to(device) for x in steps)


@functools.cache
def _near_steps(pairs: int, device: torch.device) -> tuple[Float[Tensor, "p s"], ...]:
    """Return for each round of a short search the changes of the weights of all pairs that it
    tries.
    """
    count = BALANCE.near
    draw = torch.Generator("cpu").manual_seed(0)
    steps = unit(torch.randn(count, pairs, generator=draw, dtype=torch.float64, device="cpu"))
    lengths = torch.linspace(BALANCE.near_least, 1.0, count, dtype=torch.float64, device="cpu")
    steps = steps * lengths[:, None]  # (s, p)
    around = torch.cat([steps.new_zeros(1, pairs), steps]).T
    return tuple((radius * around).to(device) for radius in BALANCE.near_radii)


def central_forces(
    points: Vectors, normals: Vectors, preferred: Float[Tensor, "b f"], slack: float
) -> Vectors:
    """Return balanced forces (b, f, 3) that need nearly the least friction, near the preferred
    normal forces.

    `points` (b, f, 3) are the contacts, `normals` (b, f, 3) the outward unit normals. All are in
    one frame. `preferred` are normal forces, which also fix the scale of the result. The forces may
    need a friction coefficient greater by `slack` than the least one. A larger `slack` gives forces
    nearer to the preferred ones.

    The result acts on the object and pushes into it at every contact. It is NaN for a set where no
    such forces are found. They are sought up to a friction coefficient of 10
    (`BALANCE.max_friction`).
    """
    wrench = grasp_map(points / centre_and_radius(points)[1])
    null = torch.linalg.qr(wrench.mT, mode="complete").Q[:, :, 6:]
    basis = null.unflatten(1, points.shape[1:])  # (b, f, 3, k)
    push = -(normals[..., None] * basis).sum(2)  # (b, f, k): a = push z
    slide = basis + normals[..., None] * push[:, :, None]
    pushes = push[..., :, None] * push[..., None, :]
    slides = slide.mT @ slide
    start = torch.einsum("bfik,bfi->bk", basis, -preferred[..., None] * normals)
    pulls = ~(matvec(push, start) > 0).all(1)
    # Where the preferred forces would pull somewhere, a linear programme finds a start.
    wrench = wrenches(points[pulls], normals[pulls], BALANCE.max_friction, edges=BALANCE.edges)
    phi, _ = solve_closure_lp(wrench.flatten(1, 2))
    size = phi.unflatten(1, wrench.shape[1:3])
    found = (size[..., None] * wrench[..., :3]).sum(2)
    pushing = (phi.amin(-1) > 0)[:, None, None]
    found = torch.where(pushing, found, torch.nan)
    found = torch.einsum("bfik,bfi->bk", basis[pulls], found)
    start = start.index_put((pulls,), found)
    linear = (2 / preferred[..., None] * push).sum(1)
    # the scale at which the linear part is best
    z = start * (2 * points.shape[1] / dot(linear, start, keepdim=True))
    ratio = _needed(push, slide, z)
    tau = BALANCE.first * ratio + slack
    row = row_numbers(z)
    lengths = 2 ** torch.arange(BALANCE.lengths, device=z.device).to(z)
    for _ in range(BALANCE.steps):
        cone = tau.square()[:, None, None, None] * pushes - slides  # (b, f, k, k)
        half = matvec(cone, z[:, None])
        height = dot(half, z[:, None], keepdim=True)
        scaled = 2 * half / height
        gradient = linear - scaled.sum(1)
        hessian = scaled.mT @ scaled - (2 * cone / height[..., None]).sum(1)
        factor, _ = torch.linalg.cholesky_ex(hessian)
        step = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        decrement = (-dot(gradient, step)).clamp(min=0).sqrt()
        # Multiples of a step that is safe for every self-concordant function.
        safe = lengths / (1 + decrement[:, None])
        tried = z[:, None] + safe[..., None] * step[:, None]  # (b, l, k)
        normal, tangential = _size(push, slide, tried)
        widest = tau[:, None, None] * normal
        logs = (widest - tangential).log() + (widest + tangential).log()
        value = matvec(tried, linear) - logs.sum(-1)
        best = torch.where(torch.isfinite(value), value, torch.inf).argmin(1)
        z = tried[row, best]
        ratio = _needed(push, slide, z)
        # Farther from the centre tau would fall faster than the steps can follow.
        lower = ratio + (BALANCE.kept * (tau - ratio)).clamp(min=slack)
        tau = torch.where(decrement < 1.0, lower, tau)
    return matvec(basis, z[:, None])


def _size(
    push: Push, slide: Slide, z: Float[Tensor, "b l k"]
) -> tuple[Float[Tensor, "b l f"], Float[Tensor, "b l f"]]:
    """Return the sizes of normal and tangential forces at all contacts, for l vectors z of
    null-space coordinates.
    """
    tangential = slide.flatten(1, 2) @ z.mT
    tangential = tangential.unflatten(1, slide.shape[1:3])  # (b, f, 3, l)
    return z @ push.mT, torch.linalg.vector_norm(tangential, dim=2).mT


def _needed(push: Push, slide: Slide, z: Float[Tensor, "b k"]) -> Float[Tensor, "b"]:
    """Return the friction coefficient that forces with null-space coordinates z need: the largest
    over the contacts.
    """
    normal, tangential = _size(push, slide, z[:, None])
    return (tangential / normal)[:, 0].amax(1)
