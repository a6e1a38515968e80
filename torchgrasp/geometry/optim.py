"""Levenberg-Marquardt for a batch of small problems; each problem has its own state and damping.

`levenberg_marquardt` is the loop. A `Minimisation` defines steps and their acceptance. See Nocedal
and Wright, Numerical Optimization, ch. 10.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Batch, flatnonzero, named_tensors, pick, put

SOLVED = 0.1  # sum of squared residuals at which a row of `LeastSquares` ends
CHECK_EVERY = 6  # steps between two looks for ended problems on an accelerator: the host waits


@dataclasses.dataclass(frozen=True)
class Linearisation(Batch):
    """The cost of each problem of a batch at its current state; subclasses add the linear model."""

    cost: Float[Tensor, "a"]


Damping = Float[Tensor, "a"]
Step = Float[Tensor, "a d"]
Steps = tuple[Step, Bool[Tensor, "a"]]
"""The step of each problem, and whether its minimisation goes on."""
Verdict = tuple[Bool[Tensor, "a"], Damping]
"""Whether the step of each problem is accepted, and the damping of its next step."""
State = TypeVar("State", bound=Batch)
Model = TypeVar("Model", bound=Linearisation)


class Minimisation(abc.ABC, Generic[State, Model]):
    """A batch of minimisation problems: their costs, their steps, and the rule by which a step is
    accepted.
    """

    first_damping: float = 1e-2

    @abc.abstractmethod
    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> Model:
        """Return the costs and linear models of the problems with the indices `rows`, at their
        states.
        """

    @abc.abstractmethod
    def step(self, model: Model, damping: Damping) -> Steps:
        """Return the steps that solve the damped normal equations, and which problems go on."""

    @abc.abstractmethod
    def move(self, state: State, x: Step, rows: Int[Tensor, "a"]) -> State:
        """Return the states of the problems with the indices `rows` after the steps `x`."""

    @abc.abstractmethod
    def judge(self, model: Model, trial: Model, x: Step, damping: Damping) -> Verdict:
        """Return which steps are accepted, and the next damping, given the models before and after
        the step.
        """

    def refuse(self, model: Model, trial: Model) -> Model:
        """Return the model to use after a rejected step: by default the model before the step."""
        return model


@torch.no_grad()
def levenberg_marquardt(
    problem: Minimisation[State, Model], state: State, steps: int
) -> tuple[State, Float[Tensor, "b"]]:
    """Minimise every problem of a batch by damped Gauss-Newton steps; return final states and
    costs.

    Every problem takes at most `steps` steps, each with one evaluation. No gradient flows through
    the minimisation. Problems that have ended leave the batch. An accelerator looks for them in few
    steps only, because the host waits.
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
        refused = problem.refuse(model, trial)
        if every > 1:  # problems that have ended, but have not left, stay as they are
            accepted = accepted & going
            after = torch.where(going, after, damping)
            refused = pick(going, refused, model)
        state = pick(accepted, trial_state, state)
        model = pick(accepted, trial, refused)
        damping = after
    return put(whole, rows, state), costs.index_copy(0, rows, model.cost)


Residuals = tuple[Float[Tensor, "g m"], Float[Tensor, "g m d"]]


@dataclasses.dataclass(frozen=True)
class LinearResiduals(Linearisation):
    """The residuals of each problem of a batch at its state, and their Jacobian."""

    residual: Float[Tensor, "a m"]
    jacobian: Float[Tensor, "a m d"]


@dataclasses.dataclass(frozen=True)
class LeastSquares(Minimisation[State, LinearResiduals]):
    """A batch of least-squares problems: the cost is the sum of squared residuals."""

    # with Jacobian, of the problems with given indices
    residuals: Callable[[State, Int[Tensor, "a"]], Residuals]
    moved: Callable[[State, Float[Tensor, "a d"]], State]  # the states after given steps
    solved: float = SOLVED  # sum of squared residuals below which a problem is solved
    largest: float = 0.3  # largest change of a variable in one step
    floor: float = 1e-3  # damping of a joint that moves nothing
    fall: float = 3.0  # divisor of the damping after an accepted step
    rise: float = 4.0  # factor on the damping after a refused step
    least: float = 1e-6  # least damping
    most: float = 1e6  # greatest damping
    lost: float = 30.0  # damping beyond which a refused step ends a problem
    stalled: float = 0.02  # relative decrease of the cost below which a problem has converged

    def linearise(self, state: State, rows: Int[Tensor, "a"]) -> LinearResiduals:
        """Return the residuals, their Jacobian and the sum of squared residuals of each problem."""
        residual, jacobian = self.residuals(state, rows)
        return LinearResiduals(residual.square().sum(1), residual, jacobian)

    def step(self, model: LinearResiduals, damping: Damping) -> Steps:
        """Return the damped step of each problem, zero if its matrix is singular, and whether the
        problem goes on.
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
        """Return the states of the problems after the steps `x`."""
        return self.moved(state, x)

    def judge(
        self, model: LinearResiduals, trial: LinearResiduals, x: Step, damping: Damping
    ) -> Verdict:
        """Accept a step that lowers the cost; stop a problem that has converged or is stuck."""
        better = trial.cost < model.cost
        converged = trial.cost > (1 - self.stalled) * model.cost
        rests = torch.where(better, converged, damping > self.lost)
        after = torch.where(better, damping / self.fall, damping * self.rise)
        return better, torch.where(rests, torch.inf, after.clamp(self.least, self.most))
