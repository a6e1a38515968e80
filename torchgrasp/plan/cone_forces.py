"""Balanced forces of any number of contacts with the least friction: a method of centres.

Forces that balance are F = N z, with normal parts a_i and tangential parts t_i. The friction cones of a tangent tau
have an analytic centre among them. It is where this is least:

    sum c_i a_i - sum log(tau^2 a_i^2 - |t_i|^2).

Newton's steps go there while tau falls towards the ratio that the forces
need [1]. The c_i, of which 2 / c_i are preferred normal forces, also fix the scale.

[1] Boyd and El Ghaoui, Linear Algebra and its Applications 188, 1993.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.frames import skew
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.wrench import Vectors, centre_and_radius, wrenches

STEPS, KEPT = 30, 0.3
"""Newton's steps, and the share of tau's distance from the needed ratio that is left after each near the centre."""
NEAR = 1.0
"""Newton decrement below which forces are near the centre. Farther off, tau waits: there it would outrun the steps."""
LENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Lengths that are tried, over that of a step which is safe for every self-concordant function."""
MOST_FRICTION, EDGES = 10.0, 4
"""Tangent of the widest cones, 84 degrees, and their edges, in which forces are sought that push everywhere."""


def forces_in_cones(points: Vectors, normals: Vectors, preferred: Float[Tensor, "b f"], slack: float) -> Vectors:
    """Return balanced forces that need the least friction, of about the preferred normal forces.

    Args:
        points: contacts, in any unit.
        normals: outward unit normals.
        preferred: normal forces.
        slack: how far the tangent of the cones exceeds the ratio needed. The more, the nearer to the preferred forces.

    Returns:
        Forces; NaN rows where no balanced set pushes at every contact within `MOST_FRICTION`.
    """
    basis = _null_space(points)  # (b, f, 3, k)
    push = -(normals[..., None] * basis).sum(2)  # (b, f, k): a = push z
    slide = basis + normals[..., None] * push[:, :, None]
    pushes, slides = push[..., :, None] * push[..., None, :], slide.mT @ slide
    start = torch.einsum("bfik,bfi->bk", basis, -preferred[..., None] * normals)
    pulls = ~((push @ start[..., None])[..., 0] > 0).all(1)
    found = pushing_forces(points[pulls], normals[pulls])
    start = start.index_put((pulls,), torch.einsum("bfik,bfi->bk", basis[pulls], found))
    linear = (2 / preferred[..., None] * push).sum(1)
    x = start * (2 * points.shape[1] / (linear * start).sum(1))[:, None]
    ratio = _needed(push, slide, x)
    tau = 1.1 * ratio + slack
    row, lengths = torch.arange(len(x), device=x.device), x.new_tensor(LENGTHS)
    for _ in range(STEPS):
        cone = tau.square()[:, None, None, None] * pushes - slides  # (b, f, k, k)
        half = (cone @ x[:, None, :, None])[..., 0]
        height = (half * x[:, None]).sum(-1, keepdim=True)
        scaled = 2 * half / height
        gradient = linear - scaled.sum(1)
        hessian = scaled.mT @ scaled - (2 * cone / height[..., None]).sum(1)
        factor, _ = torch.linalg.cholesky_ex(hessian)
        step = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        decrement = (-(gradient * step).sum(1)).clamp(min=0).sqrt()
        tried = x[:, None] + (lengths / (1 + decrement[:, None]))[..., None] * step[:, None]  # (b, l, k)
        normal, tangential = _sizes(push, slide, tried)
        widest = tau[:, None, None] * normal
        value = (tried @ linear[..., None])[..., 0] - ((widest - tangential).log() + (widest + tangential).log()).sum(
            -1
        )
        x = tried[row, torch.where(torch.isfinite(value), value, torch.inf).argmin(1)]
        ratio = _needed(push, slide, x)
        tau = torch.where(decrement < NEAR, ratio + (KEPT * (tau - ratio)).clamp(min=slack), tau)
    return (basis @ x[:, None, :, None])[..., 0]


def pushing_forces(points: Vectors, normals: Vectors) -> Vectors:
    """Return balanced forces that push at every contact, NaN where there are none within `MOST_FRICTION`."""
    wrench = wrenches(points, normals, MOST_FRICTION, EDGES)
    phi, _ = solve_closure_lp(wrench.flatten(1, 2))
    forces = (phi.unflatten(1, wrench.shape[1:3])[..., None] * wrench[..., :3]).sum(2)
    return torch.where((phi.amin(-1) > 0)[:, None, None], forces, torch.nan)


def _null_space(points: Vectors) -> Float[Tensor, "b f 3 k"]:
    """Return an orthonormal basis of the k = 3 f - 6 dimensions of forces that balance."""
    centre, radius = centre_and_radius(points)
    arm = (points - centre) / radius
    identity = torch.eye(3, dtype=points.dtype, device=points.device).expand(*arm.shape, 3)
    grasp_map = torch.cat([identity, skew(arm)], 2).transpose(1, 2).flatten(2)  # (b, 6, 3 f)
    return torch.linalg.qr(grasp_map.mT, mode="complete").Q[:, :, 6:].unflatten(1, points.shape[1:])


def _sizes(
    push: Float[Tensor, "b f k"], slide: Float[Tensor, "b f 3 k"], x: Float[Tensor, "b l k"]
) -> tuple[Float[Tensor, "b l f"], Float[Tensor, "b l f"]]:
    """Return the normal and tangential forces of l combinations."""
    tangential = (slide.flatten(1, 2) @ x.mT).unflatten(1, slide.shape[1:3])  # (b, f, 3, l)
    return x @ push.mT, torch.linalg.vector_norm(tangential, dim=2).mT


def _needed(
    push: Float[Tensor, "b f k"], slide: Float[Tensor, "b f 3 k"], x: Float[Tensor, "b k"]
) -> Float[Tensor, "b"]:
    """Return the greatest ratio of tangential to normal force."""
    normal, tangential = _sizes(push, slide, x[:, None])
    return (tangential / normal)[:, 0].amax(1)
