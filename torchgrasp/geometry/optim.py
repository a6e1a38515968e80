"""Levenberg-Marquardt for a batch of small problems; each problem has its own state and damping.

`levenberg_marquardt` is the loop. A `Minimisation` defines the steps and which are accepted. A
batch holds problems of d variables each, a of which go on. See Nocedal and Wright, Numerical
Optimization, ch. 10.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Batch, flatnonzero, named_tensors, pick, put

SOLVED = 0.1  # sum of squared residuals below which a problem of `LeastSquares` ends
CHECK_EVERY = 6  # steps between two looks for ended problems on an accelerator: the host waits


@dataclasses.dataclass(frozen=True)
class Linearisation(Batch):
    """Linear model of each minimisation problem of a batch at its present state, with its cost.

    a counts the problems. Subclasses add what a step needs, such as residuals and their Jacobian.
    """

    cost: Float[Tensor, "a"]  # cost of each problem, which is minimised (no unit)


Damping = Float[Tensor, "a"]  # damping of each problem's next step; infinite once it has ended
Step = Float[Tensor, "a d"]  # changes of the d variables of each problem
Steps = tuple[Step, Bool[Tensor, "a"]]
"""The step (a, d) of each problem, and a mask (a,) of the problems whose minimisation goes on."""
Verdict = tuple[Bool[Tensor, "a"], Damping]
"""A mask (a,) of the accepted steps, and the damping (a,) of each problem's next step."""
State = TypeVar("State", bound=Batch)
Model = TypeVar("Model", bound=Linearisation)


class Minimisation(abc.ABC, Generic[State, Model]):
    """Base class of b minimisation problems, which `levenberg_marquardt` solves together.

    A subclass says how problems are linearised, how a step is computed, and when it is accepted. A
    state holds the variables of the problems. A model is the linear approximation of the problems
    at a state: a `Linearisation` with their costs. In the methods, a counts the problems that still
    go on, and d the variables of each. `rows` (a,) are their indices among all b problems. The
    damping (a,) is the number that shortens the step of each problem.
    """

    first_damping: float = 1e-2  # damping of every problem's first step (no unit)

    @abc.abstractmethod
    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> Model:
        """Return the model of some problems at their states: their costs, and what a step needs.

        Args:
            state: states of these problems.
            rows: their indices (a,) among all problems.
        """

    @abc.abstractmethod
    def step(self, model: Model, damping: Damping) -> Steps:
        """Return the step (a, d) of each problem, and a mask (a,) of the problems that go on.

        A step is the change of the d variables that solves the damped normal equations.

        Args:
            model: linear model of the problems at their present states.
            damping: damping (a,) of their steps.
        """

    @abc.abstractmethod
    def move(self, state: State, x: Step, rows: Int[Tensor, "a"]) -> State:
        """Return the states of the problems after the steps `x` (a, d) of their variables.

        `state` holds their states before the steps, and `rows` (a,) are their indices among all
        problems.
        """

    @abc.abstractmethod
    def judge(self, model: Model, trial: Model, x: Step, damping: Damping) -> Verdict:
        """Return a mask (a,) of the accepted steps, and the damping (a,) of each problem's next
        step.

        An infinite damping ends a problem.

        Args:
            model: linear model before the steps.
            trial: linear model after the steps.
            x: the steps (a, d) of the variables.
            damping: damping (a,) with which these steps were computed.
        """

    def refuse(self, model: Model, trial: Model) -> Model:
        """Return the linear model with which a problem goes on after a rejected step.

        By default it is `model`, that before the step. `trial` is the linear model after the
        rejected step.
        """
        return model


@torch.no_grad()
def levenberg_marquardt(
    problem: Minimisation[State, Model], state: State, steps: int
) -> tuple[State, Float[Tensor, "b"]]:
    """Minimise b problems by damped Gauss-Newton steps; return their final states and costs.

    Every problem takes at most `steps` steps from its initial `state`, each with one evaluation. No
    gradient flows through the minimisation. Problems that have ended leave the batch. On an
    accelerator this is checked only every 6 steps (`CHECK_EVERY`), because the host has to wait.
    """
    whole = state
    rows = torch.arange(len(state), device=next(iter(named_tensors(state).values())).device)
    model = problem.linearise(state, rows)
    costs = model.cost
    damping = torch.full_like(model.cost, problem.first_damping)
    going = torch.ones_like(rows, dtype=torch.bool)
    every = 1 if rows.device.type == "cpu" else CHECK_EVERY
    for k in range(steps):
        x, taken = problem.step(model, damping)
        going = going & taken
        if k % every == 0:
            left = flatnonzero(going)  # the only wait for the device
            if not len(left):
                break
            if len(left) < len(going):
                whole = put(whole, rows, state)
                costs = costs.index_copy(0, rows, model.cost)
                rows = rows[left]
                state = state[left]
                model = model[left]
                x = x[left]
                damping = damping[left]
                going = going[left]
        trial_state = problem.move(state, x, rows)
        trial = problem.linearise(trial_state, rows)
        accepted, after = problem.judge(model, trial, x, damping)
        if every > 1:  # problems that have ended, but have not left, stay as they are
            accepted = accepted & going
            after = torch.where(going, after, damping)
        if every == 1 and accepted.all():  # nothing to choose
            state, model = trial_state, trial
        else:
            refused = problem.refuse(model, trial)
            if every > 1:
                refused = pick(going, refused, model)
            state = pick(accepted, trial_state, state)
            model = pick(accepted, trial, refused)
        damping = after
    return put(whole, rows, state), costs.index_copy(0, rows, model.cost)


Residuals = tuple[Float[Tensor, "g m"], Float[Tensor, "g m d"]]
"""The m residuals of g problems, and their Jacobian by the d variables."""


@dataclasses.dataclass(frozen=True)
class LinearResiduals(Linearisation):
    """Linear model of each least-squares problem of a batch: residuals, and their Jacobian.

    a counts the problems, m the residuals of each, and d its variables.
    """

    # the m residuals of each problem; its cost is the sum of their squares
    residual: Float[Tensor, "a m"]
    jacobian: Float[Tensor, "a m d"]  # derivatives of the residuals by the d variables


@dataclasses.dataclass(frozen=True)
class LeastSquares(Minimisation[State, LinearResiduals]):
    """A batch of least-squares problems: the cost of each is the sum of its squared residuals.

    In shapes, a counts the problems that still go on, m the residuals and d the variables of each.
    `levenberg_marquardt` solves the problems.
    """

    # function of states and of the indices (a,) of their problems, which returns residuals (a, m)
    # and their Jacobian (a, m, d)
    residuals: Callable[[State, Int[Tensor, "a"]], Residuals]
    # function of states and of the steps (a, d) of their variables, which returns the states after
    # the steps
    moved: Callable[[State, Float[Tensor, "a d"]], State]
    solved: float = SOLVED  # sum of squared residuals below which a problem is solved
    largest: float = 0.3  # largest change of a variable in one step, in its own unit
    # number added to the diagonal of the normal equations, as a variable may change no residual
    floor: float = 1e-3
    fall: float = 3.0  # divisor of the damping after an accepted step
    rise: float = 4.0  # factor on the damping after a rejected step
    least: float = 1e-6  # least damping
    most: float = 1e6  # greatest damping
    lost: float = 30.0  # damping beyond which a rejected step ends a problem
    stalled: float = 0.02  # relative decrease of the cost below which a problem has converged

    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> LinearResiduals:
        """Return the residuals of some problems, their Jacobian, and as cost the sum of their
        squares.

        `state` holds the states of these problems, and `rows` (a,) their indices among all
        problems.
        """
        residual, jacobian = self.residuals(state, rows)
        return LinearResiduals(residual.square().sum(1), residual, jacobian)

    def step(self, model: LinearResiduals, damping: Damping) -> Steps:
        """Return the damped steps (a, d) of the variables, and a mask (a,) of the problems that go
        on.

        `model` holds the residuals and their Jacobian, and `damping` (a,) the damping of each
        problem's step. A step whose largest change of a variable exceeds `largest` is shortened, so
        that this change is `largest`. The step of a problem with a singular matrix is zero. A
        problem ends if its cost is below `solved`, or its damping is infinite.
        """
        normal = model.jacobian.mT @ model.jacobian
        diagonal = normal.diagonal(dim1=1, dim2=2)
        # Relative damping alone would leave a joint that moves nothing undamped.
        damped = normal + torch.diag_embed(damping[:, None] * diagonal + self.floor)
        factor, info = torch.linalg.cholesky_ex(damped)
        x = -torch.cholesky_solve(model.jacobian.mT @ model.residual[..., None], factor)[..., 0]
        taken = ~(model.cost < self.solved) & torch.isfinite(damping)
        # A GPU may factor a matrix with an infinite diagonal without complaint; its step is NaN.
        x = torch.where(((info == 0) & taken)[:, None], x, 0.0)
        return x * (self.largest / x.abs().amax(1, keepdim=True).clamp_min(self.largest)), taken

    def move(self, state: State, x: Step, rows: Int[Tensor, "a"]) -> State:
        """Return the states of the problems after the steps `x` (a, d) of their variables.

        `state` holds the states before the steps. `rows` has no effect.
        """
        return self.moved(state, x)

    def judge(
        self, model: LinearResiduals, trial: LinearResiduals, x: Step, damping: Damping
    ) -> Verdict:
        """Return a mask (a,) of the accepted steps, which lower the cost, and the damping (a,) of
        the next ones.

        An accepted step divides the damping by `fall`, a rejected one multiplies it by `rise`. The
        result is kept between `least` and `most`. An infinite damping ends a problem. It is
        returned if an accepted step lowers the cost by less than the fraction `stalled`. It is also
        returned if a step is rejected at a damping above `lost`.

        Args:
            model: residuals and costs of the problems before the steps.
            trial: residuals and costs after the steps.
            x: the steps (a, d) of the variables; without effect.
            damping: damping (a,) with which these steps were computed.
        """
        better = trial.cost < model.cost
        converged = trial.cost > (1 - self.stalled) * model.cost
        rests = torch.where(better, converged, damping > self.lost)
        after = torch.where(better, damping / self.fall, damping * self.rise)
        return better, torch.where(rests, torch.inf, after.clamp(self.least, self.most))
