"""Levenberg-Marquardt for a batch of small problems, each with its own damping, that leaves alone what is done."""

from collections.abc import Callable
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch, pick, put

State = TypeVar("State", bound=Batch)
Residuals = tuple[Float[Tensor, "g m"], Float[Tensor, "g m d"]]
"""Residuals and their derivatives."""

LARGEST_STEP = 0.3
"""Largest step of any variable in one iteration."""
SOLVED = 0.1
"""A row whose sum of squared residuals is below this is done, unless it is to be more exact: 0.3 mm in the root."""
STALLED = 0.02
"""A row whose sum falls by less than this share in a step is left alone, and so is one of more damping than `LOST`."""
LOST = 30.0


def levenberg_marquardt(
    state: State,
    evaluate: Callable[[State, Int[Tensor, "a"]], Residuals],
    move: Callable[[State, Float[Tensor, "a d"]], State],
    iterations: int,
    solved: float = SOLVED,
) -> State:
    """Lower the sum of squared residuals of every row; a step that does not lower it is undone.

    Args:
        state: where to start, g rows.
        evaluate: residuals and Jacobian of some of the rows at their states; the rows' numbers are given, too.
        move: the state after a step.
        iterations: at most.
        solved: a row is done when the sum is below this.
    """
    whole, at = state, torch.arange(len(state))
    residual, jacobian = evaluate(state, at)
    cost, at = residual.square().sum(1), at.to(residual.device)
    damping = torch.full_like(cost, 1e-2)
    done = cost < solved
    for _ in range(iterations):
        if bool(done.any()):
            whole, going = put(whole, at, state), ~done
            if bool(done.all()):
                return whole
            at, state, damping, cost = at[going], state[going], damping[going], cost[going]
            residual, jacobian = residual[going], jacobian[going]
        normal = jacobian.mT @ jacobian
        diagonal = normal.diagonal(dim1=1, dim2=2)
        # Relative damping alone would leave a joint that moves nothing undamped.
        damped = normal + torch.diag_embed(damping[:, None] * diagonal + 1e-3)
        factor, info = torch.linalg.cholesky_ex(damped)
        step = -torch.cholesky_solve(jacobian.mT @ residual[..., None], factor)[..., 0]
        step = torch.where((info == 0)[:, None], step, 0.0)  # one row without a factor waits for more damping
        step = step * (LARGEST_STEP / step.abs().amax(1, keepdim=True).clamp_min(LARGEST_STEP))
        trial = move(state, step)
        trial_residual, trial_jacobian = evaluate(trial, at)
        trial_cost = trial_residual.square().sum(1)
        better = trial_cost < cost
        done = (better & ((trial_cost < solved) | (trial_cost > (1 - STALLED) * cost))) | (~better & (damping > LOST))
        state = pick(better, trial, state)
        residual = torch.where(better[:, None], trial_residual, residual)
        jacobian = torch.where(better[:, None, None], trial_jacobian, jacobian)
        cost = torch.where(better, trial_cost, cost)
        damping = torch.where(better, damping / 3, damping * 4).clamp(1e-6, 1e6)
    return put(whole, at, state)
