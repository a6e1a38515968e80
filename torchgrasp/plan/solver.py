"""The solver of a `ContactProblem`: Levenberg-Marquardt along the surface.

After every step one Newton step of the mean brings the points back to the surface. It costs a fraction of a full
evaluation, and steps may be long.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.geometry.linalg import limit_norm
from torchgrasp.geometry.optim import Damping, Linearisation, Problem, Steps, Verdict, levenberg_marquardt
from torchgrasp.plan.closure import Vectors
from torchgrasp.plan.problem import (
    ContactProblem,
    Shape,
    SurfaceJet,
    contact_pairs,
    forces_from_tensions,
    split_unknowns,
    triple_jet,
    triple_mean_jet,
    with_variance,
)
from torchgrasp.shape.surface import newton_step

LONGEST_STEP = 0.3
"""A point moves at most this far in a step (normalised): about the range in which the surface is smooth."""
TENSION_DAMPING = 0.1  # damping of the tensions relative to that of the points: tensions may change faster
SURFACE = 10.0  # weight of the surface: a step off it would be undone by the projection, which the cones then resist
BOUNDS = 3.0  # weight of all bounds but the cones, as great as that of the cones in the last stage


@dataclasses.dataclass(frozen=True)
class Stage:
    """At most so many steps with constant weights of centre (Eq. 14) and cones (Eq. 13).

    A row rests when its next step is shorter than `settled`. The variance, which costs more than all else, is evaluated
    at every step, or if not `exact` extrapolated from the start.
    """

    centre: float
    cones: float
    steps: int
    settled: float = 1e-3
    exact: bool = True


FINISH = Stage(centre=0.0, cones=3.0, steps=30, settled=1e-8, exact=False)  # the last stage, feasibility alone


@dataclasses.dataclass(frozen=True)
class State(Batch):
    """Normalised contacts, the internal force between each pair of contacts, and the shape at the contacts."""

    points: Vectors
    tension: Float[Tensor, "b p"]
    jet: SurfaceJet


@dataclasses.dataclass(frozen=True)
class LinearConstraints(Linearisation):
    """Weighted residuals, their weights, and the Jacobian without weights.

    `inside`: all points are in the domain.
    """

    residual: Float[Tensor, "a r"]
    weight: Float[Tensor, "a r"]
    jacobian: Float[Tensor, "a r u"]
    inside: Bool[Tensor, "a"]

    @property
    def weighted_jacobian(self) -> Float[Tensor, "a r u"]:
        """The Jacobian of the weighted residuals."""
        return self.weight[..., None] * self.jacobian


@dataclasses.dataclass(frozen=True)
class Descent(Problem[State, LinearConstraints]):
    """The cost of a stage: half the sum of weighted squares."""

    shape: Shape
    problem: ContactProblem
    stage: Stage

    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> LinearConstraints:
        """Evaluate the constraints; bounds that hold weigh nothing."""
        constraints = self.problem.constraints(state.points, state.tension, state.jet)
        bounds = torch.full_like(constraints.bounds, BOUNDS)
        bounds[:, : state.points.shape[1]] = self.stage.cones
        centre = torch.full_like(constraints.centre, self.stage.centre)
        surface = torch.full_like(constraints.surface, SURFACE)
        weight = torch.cat([centre, surface, bounds * (constraints.bounds > 0)], 1)
        residual = weight * constraints.values
        cost = residual.square().sum(1) / 2
        inside = torch.linalg.vector_norm(state.points, dim=-1).amax(-1) < self.problem.domain_radius
        return LinearConstraints(cost, residual, weight, constraints.jacobian, inside)

    def step(self, model: LinearConstraints, damping: Damping) -> Steps:
        """Return the damped step, no point farther than `LONGEST_STEP`. Rows without a factor rest."""
        jacobian = model.weighted_jacobian
        scale = jacobian.new_ones(1, jacobian.shape[2])
        split_unknowns(scale)[1][:] = TENSION_DAMPING
        normal = jacobian.mT @ jacobian + torch.diag_embed(damping[:, None] * scale)
        factor, failed = torch.linalg.cholesky_ex(normal)
        descent = -(jacobian.mT @ model.residual[..., None])
        x = torch.cholesky_solve(descent, factor)[..., 0]
        x = torch.where((failed == 0)[:, None], x, torch.nan)
        length = torch.linalg.vector_norm(split_unknowns(x)[0], dim=-1).amax(-1)
        shrink = (length / LONGEST_STEP).clamp(min=1.0)
        return x / shrink[:, None], length / shrink > self.stage.settled  # NaN is not longer

    def move(self, state: State, x: Float[Tensor, "a u"]) -> State:
        """Return the contacts moved along the surface."""
        by_points, by_tension = split_unknowns(x)
        points = project(self.shape, state.points + by_points, steps=1)
        tension = normalise_tensions(points, state.tension + by_tension)
        if self.stage.exact:
            return State(points, tension, triple_jet(self.shape, points))
        slope = state.jet.variance_gradient
        variance = state.jet.variance + (slope * (points - state.points)).sum(-1)
        return State(points, tension, with_variance(triple_mean_jet(self.shape, points), variance, slope))

    def judge(
        self, model: LinearConstraints, trial: LinearConstraints, x: Float[Tensor, "a u"], damping: Damping
    ) -> Verdict:
        """Accept a decrease inside the domain; damp by the kept share of its promise (Nielsen)."""
        kept = (model.cost - trial.cost) / promised_decrease(model, x)
        accepted = (kept > 0) & trial.inside  # NaN is not accepted
        eased = damping * (1 - (2 * kept - 1) ** 3).clamp(min=1 / 5, max=2.0)
        return accepted, torch.where(accepted, eased.clamp(min=1e-9), (4 * damping).clamp(max=1e9))

    def refuse(self, model: LinearConstraints, trial: LinearConstraints) -> LinearConstraints:
        """Return the model with the mean Jacobian of both ends of the step (a bundle of gradients).

        Near an observation a thin plate's normals turn in a cusp. Steps from either side lead across it; the mean
        points down along it.
        """
        return dataclasses.replace(model, jacobian=(model.jacobian + trial.jacobian) / 2)


def promised_decrease(model: LinearConstraints, x: Float[Tensor, "a u"]) -> Float[Tensor, "a"]:
    """Return by how much a step lowers the model's cost."""
    linear = model.residual + (model.weighted_jacobian @ x[..., None])[..., 0]
    return (model.residual.square().sum(1) - linear.square().sum(1)) / 2


def descend(shape: Shape, problem: ContactProblem, state: State, stage: Stage) -> State:
    """Return the contacts after a stage."""
    return levenberg_marquardt(Descent(shape, problem, stage), state, stage.steps)[0]


def project(shape: Shape, points: Float[Tensor, "b k 3"], steps: int) -> Float[Tensor, "b k 3"]:
    """Move normalised points onto f_d = 0 by Newton steps along the gradient."""
    x = points.flatten(0, 1)
    for _ in range(steps):
        distance, gradient = shape.mean_and_gradient(x)
        x = x + limit_norm(newton_step(distance, gradient, gradient)[:, None] * gradient, LONGEST_STEP)
    return x.view_as(points)


def start_state(shape: Shape, points: Vectors) -> State:
    """Return the first state of a descent: contacts with equal internal forces between all pairs."""
    return State(points, equal_tensions(points), triple_jet(shape, points))


def equal_tensions(points: Vectors) -> Float[Tensor, "b p"]:
    """Return equal tensions of all pairs: the forces point to the contacts' centre."""
    pairs = contact_pairs(points.shape[1], points.device).shape[1]
    return normalise_tensions(points, points.new_ones(len(points), pairs))


def normalise_tensions(points: Vectors, tension: Float[Tensor, "b p"]) -> Float[Tensor, "b p"]:
    """Return the tensions for which the mean size of the forces is 1."""
    force, _ = forces_from_tensions(points, tension)
    return tension / torch.linalg.vector_norm(force, dim=-1).mean(-1, keepdim=True)
