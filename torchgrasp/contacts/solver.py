"""The solver of a `ContactProblem`: Levenberg-Marquardt steps along the surface.

After every step one Newton step on the mean signed distance brings the points back to the surface.
This projection costs a fraction of a full evaluation, and allows long steps.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.form_closure import Vectors
from torchgrasp.contacts.problem import (
    ContactProblem,
    ShapeLike,
    SurfaceJet,
    Tensions,
    contact_pairs,
    forces_from_tensions,
    rows_of,
    split_unknowns,
    triple_jet,
    triple_mean_jet,
)
from torchgrasp.foundation.base import Batch
from torchgrasp.geometry.linalg import dot, matvec, norm
from torchgrasp.geometry.optim import (
    Damping,
    Linearisation,
    Minimisation,
    Step,
    Steps,
    Verdict,
    levenberg_marquardt,
)
from torchgrasp.shape.surface import newton_step

# least and greatest damping
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
LONGEST_STEP = (
    0.3  # a point moves at most this far in a step (normalised): there the surface is smooth
)
TENSION_DAMPING = (
    0.1  # damping of the tensions relative to that of the points: tensions may change faster
)
# weight of the surface: a step off it would be undone by the projection, which the cones then
# resist
SURFACE = 10.0
BOUNDS = 3.0  # weight of all bounds but the cones, as great as that of the cones in the last stage


@dataclasses.dataclass(frozen=True)
class Stage:
    """A solver stage: at most `steps` steps, with weights for the offset from the `centre` and for
    friction `cones`.

    A contact set stops when its step (normalised) is shorter than `settled`. Unless `exact`, the
    variance of the surface is extrapolated linearly.
    """

    centre: float
    cones: float
    steps: int
    settled: float = 1e-3
    exact: bool = True


FINISH = Stage(
    centre=0.0, cones=3.0, steps=30, settled=1e-8, exact=False
)  # the last stage, feasibility alone


@dataclasses.dataclass(frozen=True)
class State(Batch):
    """The solver's state: normalised contact points, the tension of each pair, and the shape's
    values at the points.
    """

    points: Vectors
    tension: Tensions
    jet: SurfaceJet


@dataclasses.dataclass(frozen=True)
class LinearConstraints(Linearisation):
    """The linearised constraints: weighted residuals, their weights, and the Jacobian without
    weights.
    """

    residual: Float[Tensor, "a r"]
    weight: Float[Tensor, "a r"]
    jacobian: Float[Tensor, "a r u"]
    inside: Bool[Tensor, "a"]  # whether all points are in the domain

    @property
    def weighted_jacobian(self) -> Float[Tensor, "a r u"]:
        """The Jacobian of the weighted residuals."""
        return self.weight[..., None] * self.jacobian


@dataclasses.dataclass(frozen=True)
class Descent(Minimisation[State, LinearConstraints]):
    """The least-squares problem of one stage: half the sum of squared weighted constraints."""

    shape: ShapeLike
    problem: ContactProblem
    stage: Stage

    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> LinearConstraints:
        """Evaluate the constraints and their Jacobian at a state; satisfied inequalities have
        weight 0.
        """
        problem = self.problem.rows(rows)
        constraints = problem.constraints(state.points, state.tension, state.jet)
        bounds = torch.full_like(constraints.bounds, BOUNDS)
        bounds[:, : state.points.shape[1]] = self.stage.cones
        centre = torch.full_like(constraints.centre, self.stage.centre)
        surface = torch.full_like(constraints.surface, SURFACE)
        weight = torch.cat([centre, surface, bounds * (constraints.bounds > 0)], 1)
        residual = weight * constraints.values
        cost = residual.square().sum(1) / 2
        inside = norm(state.points).amax(-1) < problem.domain_radius
        return LinearConstraints(cost, residual, weight, constraints.jacobian, inside)

    def step(self, model: LinearConstraints, damping: Damping) -> Steps:
        """Return each contact set's damped step (NaN for a singular matrix), and whether the step
        is long enough.
        """
        jacobian = model.weighted_jacobian
        scale = jacobian.new_ones(1, jacobian.shape[2])
        split_unknowns(scale)[1][:] = TENSION_DAMPING
        normal = jacobian.mT @ jacobian + torch.diag_embed(damping[:, None] * scale)
        factor, failed = torch.linalg.cholesky_ex(normal)
        descent = -(jacobian.mT @ model.residual[..., None])
        x = torch.cholesky_solve(descent, factor)[..., 0]
        x = torch.where((failed == 0)[:, None], x, torch.nan)
        length = norm(split_unknowns(x)[0]).amax(-1)
        shrink = (length / LONGEST_STEP).clamp(min=1.0)
        return x / shrink[:, None], length / shrink > self.stage.settled  # NaN is not longer

    def move(self, state: State, x: Step, rows: Int[Tensor, "a"]) -> State:
        """Return the state after a step x; the contacts move along the surface."""
        by_points, by_tension = split_unknowns(x)
        shape = rows_of(self.shape, rows)
        points = project(shape, state.points + by_points, steps=1)
        tension = normalise_tensions(points, state.tension + by_tension)
        if self.stage.exact:
            return State(points, tension, triple_jet(shape, points))
        slope = state.jet.variance_gradient
        variance = state.jet.variance + dot(slope, points - state.points)
        mean = triple_mean_jet(shape, points)
        return State(
            points, tension, SurfaceJet(**vars(mean), variance=variance, variance_gradient=slope)
        )

    def judge(
        self, model: LinearConstraints, trial: LinearConstraints, x: Step, damping: Damping
    ) -> Verdict:
        """Return a mask of the steps that lower the cost inside the domain, and the next damping
        (Nielsen's rule).
        """
        kept = (model.cost - trial.cost) / promised_decrease(model, x)
        accepted = (kept > 0) & trial.inside  # NaN is not accepted
        eased = damping * (1 - (2 * kept - 1) ** 3).clamp(min=1 / 5, max=2.0)
        eased = eased.clamp(min=LEAST_DAMPING)
        return accepted, torch.where(accepted, eased, (4 * damping).clamp(max=MOST_DAMPING))

    def refuse(self, model: LinearConstraints, trial: LinearConstraints) -> LinearConstraints:
        """Return the model after a rejected step; its Jacobian is the mean of the Jacobians at the
        step's two ends.
        """
        # Near an observation a thin plate's normals change abruptly. The mean Jacobian points down
        # along the kink.
        return dataclasses.replace(model, jacobian=(model.jacobian + trial.jacobian) / 2)


def promised_decrease(model: LinearConstraints, x: Step) -> Float[Tensor, "a"]:
    """Return the decrease of the cost that the linear model predicts for a step x."""
    linear = model.residual + matvec(model.weighted_jacobian, x)
    return (model.residual.square().sum(1) - linear.square().sum(1)) / 2


def descend(shape: ShapeLike, problem: ContactProblem, state: State, stage: Stage) -> State:
    """Run one solver stage; return the state (contacts and tensions) after it."""
    return levenberg_marquardt(Descent(shape, problem, stage), state, stage.steps)[0]


def project(shape: ShapeLike, points: Float[Tensor, "b k 3"], steps: int) -> Float[Tensor, "b k 3"]:
    """Move normalised points onto the surface, where the signed distance is 0, by Newton steps
    along the gradient.
    """
    x = points.flatten(0, 1)
    for _ in range(steps):
        distance, gradient = shape.mean_and_gradient(x)
        x = x + newton_step(distance, gradient, LONGEST_STEP)
    return x.view_as(points)


def start_state(shape: ShapeLike, points: Vectors) -> State:
    """Return the solver's first state: contacts with equal tensions between all pairs."""
    return State(points, equal_tensions(points), triple_jet(shape, points))


def equal_tensions(points: Vectors) -> Tensions:
    """Return equal tensions for all pairs of contacts; the force at each contact then points to the
    centroid.

    A pair of contacts pulls together with its tension times its distance.
    """
    pairs = contact_pairs(points.shape[1], points.device).shape[1]
    return normalise_tensions(points, points.new_ones(len(points), pairs))


def normalise_tensions(points: Vectors, tension: Tensions) -> Tensions:
    """Return the tensions, scaled so that the mean size of the contact forces that they cause is 1."""
    force, _ = forces_from_tensions(points, tension)
    return tension / norm(force).mean(-1, keepdim=True)
