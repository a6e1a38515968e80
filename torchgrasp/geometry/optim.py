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
    """The costs of a problems of a batch at their current states; subclasses add linear models."""

    cost: Float[Tensor, "a"]  # cost that is minimised (no unit)


Damping = Float[Tensor, "a"]  # damping of each problem's next step; infinite once it has ended
Step = Float[Tensor, "a d"]  # changes of the d variables of each problem
Steps = tuple[Step, Bool[Tensor, "a"]]
"""The step (a, d) of each problem, and a mask (a,) of the problems whose minimisation goes on."""
Verdict = tuple[Bool[Tensor, "a"], Damping]
"""A mask (a,) of the accepted steps, and the damping (a,) of each problem's next step."""
State = TypeVar("State", bound=Batch)
Model = TypeVar("Model", bound=Linearisation)


class Minimisation(abc.ABC, Generic[State, Model]):
    """Base class of a batch of minimisation problems: costs, steps, and what is accepted."""

    first_damping: float = 1e-2  # damping of the first step (no unit)

    @abc.abstractmethod
    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> Model:
        """Return the costs and linear models, at the states `state`, of the problems with the
        indices `rows`.
        """

    @abc.abstractmethod
    def step(self, model: Model, damping: Damping) -> Steps:
        """Return the steps (a, d) of a problems, and a mask (a,) of those that go on.

        Steps solve the damped normal equations. `model` holds the linear models of the problems,
        and `damping` the damping of their steps.
        """

    @abc.abstractmethod
    def move(self, state: State, x: Step, rows: Int[Tensor, "a"]) -> State:
        """Return the states of the problems with the indices `rows` after the steps `x`."""

    @abc.abstractmethod
    def judge(self, model: Model, trial: Model, x: Step, damping: Damping) -> Verdict:
        """Return a mask (a,) of the accepted steps, and the damping (a,) of the next steps.

        `model` is the linear model before the steps `x`, `trial` the one after them, and `damping`
        that of these steps. An infinite damping ends a problem.
        """

    def refuse(self, model: Model, trial: Model) -> Model:
        """Return the model to use after a rejected step: by default the model before the step.

        `trial` is the model after the step.
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
        if every == 1 and bool(accepted.all()):  # nothing to choose
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
    """The m residuals of each problem of a batch at its state, with their Jacobian by its d
    variables.
    """

    residual: Float[Tensor, "a m"]  # the cost is the sum of their squares
    jacobian: Float[Tensor, "a m d"]


@dataclasses.dataclass(frozen=True)
class LeastSquares(Minimisation[State, LinearResiduals]):
    """A batch of least-squares problems: the cost is the sum of squared residuals."""

    # function of states, and the indices of their problems: their residuals and Jacobians
    residuals: Callable[[State, Int[Tensor, "a"]], Residuals]
    # function of states and their steps (a, d): the states after the steps
    moved: Callable[[State, Float[Tensor, "a d"]], State]
    solved: float = SOLVED  # sum of squared residuals below which a problem is solved
    largest: float = 0.3  # largest change of a variable in one step, in its own unit
    # damping that is added for every variable, as one may change no residual
    floor: float = 1e-3
    fall: float = 3.0  # divisor of the damping after an accepted step
    rise: float = 4.0  # factor on the damping after a refused step
    least: float = 1e-6  # least damping
    most: float = 1e6  # greatest damping
    lost: float = 30.0  # damping beyond which a refused step ends a problem
    stalled: float = 0.02  # relative decrease of the cost below which a problem has converged

    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> LinearResiduals:
        """Return residuals, Jacobian and sum of squared residuals of the problems with the indices
        `rows`.
        """
        residual, jacobian = self.residuals(state, rows)
        return LinearResiduals(residual.square().sum(1), residual, jacobian)

    def step(self, model: LinearResiduals, damping: Damping) -> Steps:
        """Return the damped steps (a, d), and a mask (a,) of the problems that go on.

        The step of a problem with a singular matrix is zero.
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
        """Return the states of the problems after the steps `x`; `rows` has no effect."""
        return self.moved(state, x)

    def judge(
        self, model: LinearResiduals, trial: LinearResiduals, x: Step, damping: Damping
    ) -> Verdict:
        """Return a mask (a,) of the steps that lower the cost, and the damping (a,) of the next
        steps.

        `model` holds the residuals before the step, `trial` those after it. The damping is infinite
        for a problem that has converged or is stuck, which ends it.
        """
        better = trial.cost < model.cost
        converged = trial.cost > (1 - self.stalled) * model.cost
        rests = torch.where(better, converged, damping > self.lost)
        after = torch.where(better, damping / self.fall, damping * self.rise)
        return better, torch.where(rests, torch.inf, after.clamp(self.least, self.most))
