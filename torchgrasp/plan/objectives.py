"""Objectives of a plan besides Eq. (14): costs of contacts, lowered from where the centre was reached."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import pick, put
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.closure_probability import closure_share
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.problem import ContactProblem, Shape, device_of
from torchgrasp.plan.solver import EXACT_FINISH, Stage, State, descend, project, start_state
from torchgrasp.plan.wrench import Vectors, wrenches
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.values import ContactPlan

Cost = Callable[[Tensor, Tensor], Tensor]
"""Contacts (b, f, 3) [m] and outward unit normals (b, f, 3) in, a cost (b,) out, differentiable by autograd."""
Objective = Literal["center", "epsilon", "min_weight", "probability"] | Cost
"""What a plan minimises."""
Improvement = Callable[[ContactPlan, Float[Tensor, "b p"]], ContactPlan]
"""A plan and the tensions of its pairs in, the improved plan out. `quality` then holds the cost."""
DOWN = Stage(centre=0.0, cones=3.0, steps=15)
"""The stage down a cost; feasibility alone is beside it."""
ON_FACET = 1e-9
"""Wrenches (of about unit length) this near a facet are its corners: far above rounding."""
MOVES, FIRST_MOVE, SHRINK = 12, 0.01, 0.85
"""Moves towards a more probable closure: their number, the length of the first [m], and each over the last.
The lengths fall from a fingertip's to 2 mm, below which 400 draws tell nothing."""
SURFACE_DRAWS = 400
"""Surfaces on which a move is judged: the standard error is at most 0.025, and less for differences on equal draws."""


def improvement(objective: Objective, shape: Shape, spec: ContactSpec, seed: int) -> Improvement | None:
    """Return what improves a plan; None for "center". A user's cost is tried on two rows first.

    Raises:
        BadArgument: an unknown name, a cost without a number for each row or without a gradient, or "probability"
            with a shape that cannot be sampled.
    """
    if objective == "center":
        return None
    if objective == "probability":
        if not isinstance(shape, ShapeGP):
            raise BadArgument("objective", f"'probability' with a {type(shape).__name__}", "a ShapeGP, to be sampled")
        return partial(raise_probability, shape, spec, seed)
    named = {"epsilon": partial(epsilon_cost, spec), "min_weight": partial(min_weight_cost, spec)}
    cost = objective if callable(objective) else named.get(objective)
    if cost is None:
        expected = "'center', 'epsilon', 'min_weight', 'probability' or a cost of contacts"
        raise BadArgument("objective", repr(objective), expected)
    if cost is objective:
        corners = [[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0], [0, 0.6, 0.8], [0, 0.6, -0.8]]
        outward = torch.tensor(corners[: spec.fingertips], dtype=torch.float64).to(device_of(shape)).repeat(2, 1, 1)
        cost_gradients(cost, shape.metres(outward), outward)
    return partial(lower_cost, shape, spec, cost)


def lower_cost(
    shape: Shape, spec: ContactSpec, cost: Cost, plan: ContactPlan, tension: Float[Tensor, "b p"]
) -> ContactPlan:
    """Return the plan with a lower cost in its OK rows."""
    problem, good = ContactProblem.of(shape, spec), torch.nonzero(plan.status == Status.OK)[:, 0]
    state = start_state(shape, shape.normalise(plan.contacts.points[good]))
    state = dataclasses.replace(state, tension=tension[good])
    state = descend(shape, problem, state, DOWN, partial(differentiate_cost, cost, shape))
    state = descend(shape, problem, state, EXACT_FINISH)
    lower = check_feasibility(shape, spec, project(shape, state.points, steps=3))
    plan, lower = (
        dataclasses.replace(p, quality=evaluate_cost(cost, p.contacts.points, p.contacts.normals))
        for p in (plan, lower)
    )
    better = (lower.status == Status.OK) & (lower.quality < plan.quality[good])
    return put(plan, good, pick(better, lower, plan[good]))


def raise_probability(
    shape: ShapeGP, spec: ContactSpec, seed: int, plan: ContactPlan, tension: Float[Tensor, "b p"]
) -> ContactPlan:
    """Return the plan with a more probable closure in its OK rows.

    A count of draws has no gradient: random moves along the surface are kept where they raise it.
    """

    def with_probability(plan: ContactPlan) -> ContactPlan:
        ok = torch.nonzero(plan.status == Status.OK)[:, 0]
        share = closure_share(shape, plan.contacts[ok], spec.friction, SURFACE_DRAWS, seed)
        return dataclasses.replace(plan, quality=torch.zeros_like(plan.quality).index_put((ok,), -share))

    generator = torch.Generator().manual_seed(seed)
    good = torch.nonzero(plan.status == Status.OK)[:, 0]
    best = with_probability(plan[good])
    for k in range(MOVES):
        drawn = torch.randn(spec.fingertips, 3, generator=generator, dtype=torch.float64).to(tension.device)
        normals = best.contacts.normals
        along = drawn - (drawn * normals).sum(-1, keepdim=True) * normals
        points = shape.normalise(best.contacts.points + FIRST_MOVE * SHRINK**k * unit(along))
        trial = with_probability(check_feasibility(shape, spec, project(shape, points, steps=4)))
        best = pick(trial.quality < best.quality, trial, best)
    return put(dataclasses.replace(plan, quality=torch.zeros_like(plan.quality)), good, best)


def min_weight_cost(spec: ContactSpec, points: Vectors, normals: Vectors) -> Float[Tensor, "b"]:
    """Return minus the margin s of the certificate, with its derivative.

    By duality ds = -v . sum phi_k da_k (see `closure_lp`).
    """
    wrench = wrenches(points, normals, spec.planned_friction, spec.edges).flatten(1, 2)
    fixed = wrench.detach()
    phi, witness = solve_closure_lp(fixed)
    margin = phi.amin(-1)
    along = (fixed.mean(1) * witness).sum(-1)
    dual = witness * ((1 / fixed.shape[1] - margin) / along)[:, None]
    change = (phi[..., None] * (wrench - fixed)).sum(1)
    return (dual * change).sum(-1) - margin


def epsilon_cost(spec: ContactSpec, points: Vectors, normals: Vectors) -> Float[Tensor, "b"]:
    """Return minus Ferrari and Canny's epsilon: the radius of the largest ball in the hull of the wrenches.

    It is the least offset u . sum lambda_k w_k of a facet with unit normal u and corners w_k, at the foot of the
    perpendicular: u and lambda are stationary there. It is negative with the origin outside. Qhull takes 5 ms a hull.
    """
    from scipy.spatial import ConvexHull, QhullError

    costs = []
    for wrench in wrenches(points, normals, spec.planned_friction, spec.edges).flatten(1, 2):
        fixed = wrench.detach().cpu().numpy()
        try:
            planes = ConvexHull(fixed, qhull_options="Qt").equations
        except (QhullError, ValueError):  # flat, or not finite: no ball at all
            costs.append(0.0 * wrench.sum())
            continue
        u, offset = planes[np.argmax(planes[:, -1]), :-1], planes[:, -1].max()
        # All corners of the facet: more than six where the edges of one cone lie in its plane.
        corners = np.flatnonzero(fixed @ u + offset > -ON_FACET)
        weights = np.linalg.lstsq(fixed[corners].T, -offset * u, rcond=ON_FACET)[0]
        stationary = torch.from_numpy(np.outer(weights, u)).to(wrench)
        costs.append(-(wrench[torch.from_numpy(corners).to(wrench.device)] * stationary).sum())
    return torch.stack(costs) if costs else points.new_zeros(0)


def evaluate_cost(cost: Cost, points: Vectors, normals: Vectors) -> Float[Tensor, "b"]:
    """Return the cost of contacts [m]; raise `BadArgument` without one number a row."""
    value = cost(points, normals)
    if not isinstance(value, Tensor) or value.shape != points.shape[:1]:
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise BadArgument("objective", f"a cost that returns {shape} for {len(points)} rows", f"({len(points)},)")
    return value


def cost_gradients(cost: Cost, points: Vectors, normals: Vectors) -> tuple[Float[Tensor, "b"], Vectors, Vectors]:
    """Return the cost of contacts [m] and its gradients by points and normals."""
    with torch.enable_grad():
        leaves = points.detach().requires_grad_(), normals.detach().requires_grad_()
        value = evaluate_cost(cost, *leaves)
        if not value.requires_grad:
            raise BadArgument("objective", "a cost without a gradient", "one that is made of torch's operations")
        by_point, by_normal = torch.autograd.grad(value.sum(), leaves, allow_unused=True, materialize_grads=True)
    return value.detach(), by_point, by_normal


def differentiate_cost(cost: Cost, shape: Shape, state: State) -> tuple[Float[Tensor, "b"], Float[Tensor, "b u"]]:
    """Return the cost of contacts and its gradient by normalised points and (zero) tensions."""
    jet, normals = state.jet, state.jet.normals  # dn = (1 - n n^T) H dx / |g|
    value, by_point, by_normal = cost_gradients(cost, shape.metres(state.points), normals)
    across = by_normal - (by_normal * normals).sum(-1, keepdim=True) * normals
    steep = torch.linalg.vector_norm(jet.gradient, dim=-1, keepdim=True)
    gradient = float(shape.scale) * by_point + (jet.hessian @ (across / steep)[..., None])[..., 0]
    return value, torch.cat([gradient.flatten(1), torch.zeros_like(state.tension)], 1)
