"""What the solver of a `ContactProblem` does: Levenberg-Marquardt steps along the surface.

After every step one Newton step on the mean signed distance brings the points back to the surface.
This projection costs a fraction of a full evaluation, and allows long steps. Lengths are
normalised. Letters in shapes: a contact sets, f contacts and p pairs of a set, r constraints, u
unknowns. The unknowns are 3 f coordinates, then p tensions, which `contacts.problem` explains.
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
)
from torchgrasp.shape.surface import newton_step

# least and greatest damping
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
# a point moves at most this far in a step (normalised): there the surface is smooth
LONGEST_STEP = 0.3
# damping of the tensions relative to that of the points: tensions may change faster
TENSION_DAMPING = 0.1
# weight of the surface: a step off it would be undone by the projection, which the cones then
# resist
SURFACE = 10.0
BOUNDS = 3.0  # weight of all bounds but the cones, as great as that of the cones in the last stage


@dataclasses.dataclass(frozen=True)
class Stage:
    """A stage of the contact solver: a number of steps with given weights of the constraints."""

    # weight (no unit) of the offset of the contacts' centroid from the normalised origin
    centre: float
    cones: float  # weight (no unit) of the friction cones
    steps: int  # greatest number of steps
    settled: float = 1e-3  # length of a step, normalised, below which a contact set stops
    # whether the variance of the surface is computed at each step; otherwise it is extrapolated
    # linearly
    exact: bool = True


# the last stage, feasibility alone
FINISH = Stage(centre=0.0, cones=3.0, steps=30, settled=1e-8, exact=False)


@dataclasses.dataclass(frozen=True)
class State(Batch):
    """The state of b contact sets of f contacts in the contact solver."""

    points: Vectors  # contacts (b, f, 3), normalised
    # tension (b, p) of each of p pairs of contacts, which pull each other with the force tension
    # times distance. Its scale makes the mean size of the contact forces 1.
    tension: Tensions
    jet: SurfaceJet  # signed distance and variance of the surface at the contacts, with derivatives


@dataclasses.dataclass(frozen=True)
class LinearConstraints(Linearisation):
    """The linearised constraints of the contact sets that still go on, a in number, at their
    present state.

    Each set has r constraints on u unknowns: the normalised coordinates of its contacts, then its
    tensions. A satisfied inequality has the weight 0.
    """

    # values of the constraints, in the units of `Constraints`, times their weight
    residual: Float[Tensor, "a r"]
    weight: Float[Tensor, "a r"]  # weight of each constraint (no unit)
    jacobian: Float[Tensor, "a r u"]  # derivatives of the unweighted constraints by the unknowns
    # whether all contacts of a set are in the shape's domain, where the surface is known
    inside: Bool[Tensor, "a"]

    @property
    def weighted_jacobian(self) -> Float[Tensor, "a r u"]:
        """The Jacobian of the r weighted residuals with respect to the u unknowns."""
        return self.weight[..., None] * self.jacobian


@dataclasses.dataclass(frozen=True)
class Descent(Minimisation[State, LinearConstraints]):
    """The minimisation problem of one solver stage: half the sum of the squared weighted
    constraints of each contact set.

    In shapes, a counts the contact sets that still go on. u counts the unknowns of a set: the
    normalised coordinates of its contacts, then the tensions of the pairs.
    """

    shape: ShapeLike  # the estimated surface, or one for each contact set
    problem: ContactProblem  # the constraints on the contacts
    stage: Stage  # weights of the constraints, and rules when a set stops

    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> LinearConstraints:
        """Return the constraints and their Jacobian for some contact sets, a in number.

        Satisfied inequalities have weight 0. `state` holds the contacts and tensions of these sets.
        `rows` (a,) are their indices in the batch.
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
        """Return the damped step (a, u) of each contact set, and a mask (a,) of the sets that go
        on.

        A set goes on if one of its contacts moves by more than `Stage.settled`, normalised. `model`
        holds the linearised constraints, and `damping` (a,) a number for each set. A step changes
        the u unknowns, and is NaN for a singular matrix.
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
        """Return the state of the contact sets after the step `x` (a, u) of their unknowns.

        A step changes the normalised coordinates of contacts, then the tensions. The moved contacts
        are brought back onto the surface. `state` holds contacts and tensions before the step.
        `rows` (a,) are the indices of these sets in the batch.
        """
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
        """Return a mask (a,) of the accepted steps, and the damping (a,) of the next ones by
        Nielsen's rule.

        A step is accepted if it lowers the cost and all contacts stay in the shape's domain.

        Args:
            model: linearised constraints of the contact sets before the step.
            trial: linearised constraints after the step.
            x: the step (a, u) of the unknowns.
            damping: damping (a,) with which the step was computed.
        """
        kept = (model.cost - trial.cost) / promised_decrease(model, x)
        accepted = (kept > 0) & trial.inside  # NaN is not accepted
        eased = damping * (1 - (2 * kept - 1) ** 3).clamp(min=1 / 5, max=2.0)
        eased = eased.clamp(min=LEAST_DAMPING)
        return accepted, torch.where(accepted, eased, (4 * damping).clamp(max=MOST_DAMPING))

    def refuse(self, model: LinearConstraints, trial: LinearConstraints) -> LinearConstraints:
        """Return the linearised constraints with which a contact set goes on after a rejected step.

        They are those of `model`, before the step, with another Jacobian: the mean of those before
        and after it. `trial` holds the constraints after the step.
        """
        # Near an observation a thin plate's normals change abruptly. The mean Jacobian points down
        # along the kink.
        return dataclasses.replace(model, jacobian=(model.jacobian + trial.jacobian) / 2)


def promised_decrease(model: LinearConstraints, x: Step) -> Float[Tensor, "a"]:
    """Return the decrease (a,) of each contact set's cost that its linear `model` predicts for the
    step `x` (a, u).

    The cost is half the sum of the squared weighted constraints.
    """
    linear = model.residual + matvec(model.weighted_jacobian, x)
    return (model.residual.square().sum(1) - linear.square().sum(1)) / 2


def project(shape: ShapeLike, points: Float[Tensor, "b k 3"], steps: int) -> Float[Tensor, "b k 3"]:
    """Return normalised points, moved onto the surface by Newton steps along the gradient of the
    signed distance.

    `points` (b, k, 3) holds k points for each of b contact sets, and `steps` is the number of
    Newton steps.
    """
    x = points.flatten(0, 1)
    for _ in range(steps):
        distance, gradient = shape.mean_and_gradient(x)
        x = x + newton_step(distance, gradient, LONGEST_STEP)
    return x.view_as(points)


def start_state(shape: ShapeLike, points: Vectors) -> State:
    """Return the solver's first state at normalised contacts, with equal tensions between all
    pairs.

    `points` have the shape (b, f, 3).
    """
    return State(points, equal_tensions(points), triple_jet(shape, points))


def equal_tensions(points: Vectors) -> Tensions:
    """Return equal tensions (b, p) for all pairs of contacts; the force at each contact then points
    to the centroid.

    `points` (b, f, 3) are the normalised contacts. A pair of contacts pulls together with its
    tension times its distance.
    """
    pairs = contact_pairs(points.shape[1], points.device).shape[1]
    return normalise_tensions(points, points.new_ones(len(points), pairs))


def normalise_tensions(points: Vectors, tension: Tensions) -> Tensions:
    """Return the tensions (b, p), scaled so that the mean size of the contact forces that they
    cause is 1.

    `points` (b, f, 3) are the normalised contacts.
    """
    force, _ = forces_from_tensions(points, tension)
    return tension / norm(force).mean(-1, keepdim=True)
