"""What a plan is for besides Eq. (14): from where that was reached, on to a lower cost or a more probable closure."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import pick, put
from torchgrasp.errors import BadArgument, Status
from torchgrasp.linalg import unit
from torchgrasp.plan.closure_probability import closure_share
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.objectives import Cost, epsilon_cost, evaluate_cost, min_weight_cost, slope_of
from torchgrasp.plan.problem import ContactProblem, Shape
from torchgrasp.plan.solver import FINISH, Stage, descend, project, start_state
from torchgrasp.plan.surface_samples import sample_surfaces, well_inside
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.values import ContactPlan

Objective = Literal["center", "epsilon", "min_weight", "probability"] | Cost

Improve = Callable[[ContactPlan, Float[Tensor, "b 3"]], ContactPlan]
"""A plan and the tensions of its sides in, the improved plan out."""

LOWER = Stage(centre=0.0, cones=3.0, steps=15)
"""Down a cost, with feasibility alone beside it."""

MOVES, LONGEST_MOVE, SHRINK = 12, 0.01, 0.85
"""Moves that are tried for a more probable closure, the length of the first [m], and of each over the last."""

DRAWS = 400
"""Surfaces on which such a move is judged: the standard error is at most 0.025, that of a difference is less, as all
are judged on the same."""


def improver(objective: Objective, shape: Shape, spec: ContactSpec, seed: int) -> Improve | None:
    """Return what improves a plan, or None for "center", which the rows of the problem hold.

    A user's cost is tried on two triples about the centre of the shape.

    Raises:
        BadArgument: an unknown name, a cost that returns no number for each row or has no gradient, or "probability"
            with a shape that no surfaces can be drawn from.
    """
    if callable(objective):
        outward = torch.tensor([[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]], dtype=torch.float64)
        outward = outward.to(getattr(shape, "device", "cpu")).repeat(2, 1, 1)
        slope_of(objective, shape.metres(outward), outward)
        return partial(lower_cost, shape, spec, objective)
    if objective == "center":
        return None
    if objective == "epsilon":
        return partial(lower_cost, shape, spec, partial(epsilon_cost, spec))
    if objective == "min_weight":
        return partial(lower_cost, shape, spec, partial(min_weight_cost, spec))
    if objective != "probability":
        expected = "'center', 'epsilon', 'min_weight', 'probability' or a cost of contacts"
        raise BadArgument("objective", repr(objective), expected)
    if not isinstance(shape, ShapeGP):
        raise BadArgument("objective", f"'probability' with a {type(shape).__name__}", "a ShapeGP, which can be drawn")
    return partial(raise_probability, shape, spec, seed)


def lower_cost(
    shape: Shape, spec: ContactSpec, cost: Cost, plan: ContactPlan, tension: Float[Tensor, "b 3"]
) -> ContactPlan:
    """Return the plan with its OK rows improved in a cost of the contacts, which then is the `quality` of all."""
    problem = ContactProblem.of(shape, spec)
    good = torch.nonzero(plan.status == Status.OK)[:, 0]
    state = start_state(shape, shape.normalise(plan.contacts.points[good]))
    state = dataclasses.replace(state, tension=tension[good])
    for stage, objective in ((LOWER, cost), (FINISH, None)):
        state = descend(shape, problem, state, stage, objective)
    lower = check_feasibility(shape, spec, project(shape, state.points, steps=3))
    plan, lower = (
        dataclasses.replace(p, quality=evaluate_cost(cost, p.contacts.points, p.contacts.normals))
        for p in (plan, lower)
    )
    better = (lower.status == Status.OK) & (lower.quality < plan.quality[good])
    return put(plan, good, pick(better, lower, plan[good]))


def raise_probability(
    shape: ShapeGP, spec: ContactSpec, seed: int, plan: ContactPlan, tension: Float[Tensor, "b 3"]
) -> ContactPlan:
    """Return the plan with contacts moved along the surface while closure gets more probable; `quality` is minus that.

    The count of closed draws has no gradient: moves are drawn, the same for all rows,
    judged on the same draws, and kept where more of these are closed.
    """
    generator = torch.Generator().manual_seed(seed)
    plan = dataclasses.replace(plan, quality=torch.zeros_like(plan.quality))
    good = torch.nonzero(plan.status == Status.OK)[:, 0]
    best = _with_probability(shape, spec, seed, plan[good])
    for k in range(MOVES):
        drawn = torch.randn(3, 3, generator=generator, dtype=torch.float64).to(tension.device)
        normals = best.contacts.normals
        move = drawn - (drawn * normals).sum(-1, keepdim=True) * normals
        points = shape.normalise(best.contacts.points + LONGEST_MOVE * SHRINK**k * unit(move))
        tried = _with_probability(shape, spec, seed, check_feasibility(shape, spec, project(shape, points, steps=4)))
        best = pick(tried.quality < best.quality, tried, best)
    return put(plan, good, best)


def _with_probability(shape: ShapeGP, spec: ContactSpec, seed: int, plan: ContactPlan) -> ContactPlan:
    """Return the plan with minus the probability of closure as its quality; 0 where a contact or its rim is unfit."""
    fit = torch.nonzero((plan.status == Status.OK) & well_inside(shape, plan.contacts))[:, 0]
    share = closure_share(sample_surfaces(shape, plan.contacts[fit]), spec.friction, DRAWS, seed)
    return dataclasses.replace(plan, quality=torch.zeros_like(plan.quality).index_put((fit,), -share))
