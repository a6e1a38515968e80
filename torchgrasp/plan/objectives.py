"""Costs of contacts and their gradients: Ferrari and Canny's epsilon, the least weight, or a user's own."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.problem import Shape, TripleJet
from torchgrasp.plan.wrench import wrenches
from torchgrasp.specs import ContactSpec

Cost = Callable[[Tensor, Tensor], Tensor]
"""Contacts (b, 3, 3) [m] and outward unit normals (b, 3, 3) in, a cost (b,) out, differentiable by autograd."""

ON_FACET = 1e-9
"""Distance from a facet within which a wrench is one of its corners, for wrenches of about unit length."""


def min_weight_cost(
    spec: ContactSpec, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]
) -> Float[Tensor, "b"]:
    """Return minus the greatest margin s: W phi = 0, sum phi = 1, phi >= s, with its derivative.

    By duality s changes with the wrenches as -v . sum phi_k da_k, for the optimum v of the dual (see `margin`).
    """
    wrench = wrenches(points, normals, spec.planned_friction, spec.edges).flatten(1, 2)
    fixed = wrench.detach()
    phi, witness = solve_closure_lp(fixed)
    margin = phi.amin(-1)
    along = (fixed.mean(1) * witness).sum(-1)
    dual = witness * ((1 / fixed.shape[1] - margin) / along)[:, None]
    change = (phi[..., None] * (wrench - fixed)).sum(1)
    return (dual * change).sum(-1) - margin


def epsilon_cost(
    spec: ContactSpec, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]
) -> Float[Tensor, "b"]:
    """Return minus Ferrari and Canny's epsilon, the radius of the largest ball in the hull of the wrenches.

    It is the least offset of a facet, u . sum lambda_k w_k for the facet's unit normal u and the weights lambda of its
    corners at the foot of the perpendicular: u and lambda are stationary there. Where the origin is outside, it is
    minus the distance of the farthest facet that is exceeded. About 5 ms a row: each hull is built by Qhull.
    """
    from scipy.spatial import ConvexHull, QhullError

    wrench = wrenches(points, normals, spec.planned_friction, spec.edges).flatten(1, 2)
    found = []
    for each in wrench:
        fixed = each.detach().cpu().numpy()
        try:
            planes = ConvexHull(fixed, qhull_options="Qt").equations
        except (QhullError, ValueError):  # flat, or not finite: no ball at all
            found.append(0.0 * each.sum())
            continue
        u, offset = planes[np.argmax(planes[:, -1]), :-1], planes[:, -1].max()
        # All corners of the facet, which are more than six where the edges of one cone lie in its plane.
        corners = np.flatnonzero(fixed @ u + offset > -ON_FACET)
        weights = np.linalg.lstsq(fixed[corners].T, -offset * u, rcond=ON_FACET)[0]
        stationary = torch.from_numpy(np.outer(weights, u)).to(each)
        found.append(-(each[torch.from_numpy(corners).to(each.device)] * stationary).sum())
    return torch.stack(found) if found else points.new_zeros(0)


def evaluate_cost(cost: Cost, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b"]:
    """Return the cost of contacts [m], checked.

    Raises:
        BadArgument: the cost returns no number for each row.
    """
    found = cost(points, normals)
    if not isinstance(found, Tensor) or found.shape != points.shape[:1]:
        shape = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
        raise BadArgument("objective", f"a cost that returns {shape} for {len(points)} rows", f"({len(points)},)")
    return found


def slope_of(
    cost: Cost, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]
) -> tuple[Float[Tensor, "b"], Float[Tensor, "b 3 3"], Float[Tensor, "b 3 3"]]:
    """Return the cost of contacts [m] and its gradients by points and by normals.

    Raises:
        BadArgument: the cost returns no number for each row, or one that autograd cannot follow.
    """
    with torch.enable_grad():
        wanted = points.detach().requires_grad_(), normals.detach().requires_grad_()
        value = evaluate_cost(cost, *wanted)
        if not value.requires_grad:
            raise BadArgument("objective", "a cost without a gradient", "one that is made of torch's operations")
        by_point, by_normal = torch.autograd.grad(value.sum(), wanted, allow_unused=True, materialize_grads=True)
    return value.detach(), by_point, by_normal


def differentiate_cost(
    cost: Cost, shape: Shape, points: Float[Tensor, "b 3 3"], jet: TripleJet
) -> tuple[Float[Tensor, "b"], Float[Tensor, "b 12"]]:
    """Return a cost at normalised points and its gradient by the points and (zero) by the tensions.

    The normals turn with their points: dn = (1 - n n^T) H dx / |g|.
    """
    normals = jet.normals
    value, by_point, by_normal = slope_of(cost, shape.metres(points), normals)
    across = by_normal - (by_normal * normals).sum(-1, keepdim=True) * normals
    steep = torch.linalg.vector_norm(jet.gradient, dim=-1, keepdim=True)
    gradient = float(shape.scale) * by_point + (jet.hessian @ (across / steep)[..., None])[..., 0]
    return value, torch.cat([gradient.flatten(1), torch.zeros_like(gradient[:, 0])], 1)
