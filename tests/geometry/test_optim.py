"""Levenberg-Marquardt on batches: solutions, rows by themselves, rows that rest."""

import dataclasses

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import Batch
from torchgrasp.geometry.optim import LeastSquares, Residuals, levenberg_marquardt


@dataclasses.dataclass(frozen=True)
class Point(Batch):
    x: Float[Tensor, "g 2"]


def rosenbrock(state: Point, rows: Tensor) -> Residuals:
    """Residuals (10 (y - x^2), 1 - x): a curved valley whose bottom is at (1, 1)."""
    x, y = state.x.unbind(1)
    one = torch.ones_like(x)
    zero = torch.zeros_like(x)
    jacobian = torch.stack([torch.stack([-20 * x, 10 * one], 1), torch.stack([-one, zero], 1)], 1)
    return torch.stack([10 * (y - x * x), 1 - x], 1), jacobian


def solve(start: Tensor, residuals=rosenbrock, steps: int = 200, solved: float = 1e-20) -> Tensor:
    problem = LeastSquares(residuals, lambda state, x: Point(state.x + x), solved)
    return levenberg_marquardt(problem, Point(start), steps)[0].x


def starts(generator: torch.Generator, count: int = 20) -> Tensor:
    return 2 * torch.randn(count, 2, generator=generator, dtype=torch.float64)


def test_the_bottom_of_a_curved_valley_is_found_from_anywhere_but_not_without_steps(generator):
    found = solve(starts(generator))
    torch.testing.assert_close(found, torch.ones_like(found), atol=1e-6, rtol=0)
    assert len(solve(torch.zeros(0, 2, dtype=torch.float64))) == 0
    start = starts(generator)
    assert torch.equal(solve(start, steps=0), start)


def test_no_step_raises_a_cost_or_is_longer_than_allowed(generator):
    here = starts(generator)
    for steps in range(1, 8):
        there = solve(here, steps=1)
        before, after = (
            rosenbrock(Point(x), torch.arange(20))[0].square().sum(1) for x in (here, there)
        )
        assert bool((after <= before).all())
        assert float((there - here).abs().max()) <= 0.3 + 1e-12
        assert len(solve(here, steps=steps)) == 20
        here = there


def test_rows_do_not_depend_on_each_other_and_are_named_by_their_numbers(generator):
    start = starts(generator, 6)
    target = torch.randn(6, 2, generator=generator, dtype=torch.float64)

    def residuals(state: Point, rows: Tensor) -> Residuals:
        return state.x - target[rows], torch.eye(2, dtype=torch.float64).expand(len(rows), 2, 2)

    start[3] = target[3]  # done before the first step: the rows of the others move up
    found = solve(start, residuals, solved=1e-16)
    torch.testing.assert_close(found, target, atol=1e-6, rtol=0)
    valley = solve(start)
    for i in range(6):
        torch.testing.assert_close(solve(start[i : i + 1])[0], valley[i])


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_rows_that_are_solved_or_hold_no_number_are_left_alone(generator, value):
    start = starts(generator, 4)
    start[2] = 1.0 if value == 0.0 else value
    found = solve(start)
    torch.testing.assert_close(found[2], start[2], rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(
        found[[0, 1, 3]], torch.ones(3, 2, dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_the_step_of_a_row_that_has_ended_is_zero_even_if_its_matrix_factors(
    generator, monkeypatch
):
    """A GPU factors a matrix with an infinite diagonal without complaint, and its step is NaN."""

    def factor(matrix: Tensor) -> tuple[Tensor, Tensor]:
        return matrix, torch.zeros(len(matrix), dtype=torch.int32)

    monkeypatch.setattr("torch.linalg.cholesky_ex", factor)
    problem = LeastSquares(rosenbrock, lambda state, x: Point(state.x + x))
    state = Point(torch.cat([torch.ones(1, 2, dtype=torch.float64), starts(generator, 2)]))
    model = problem.linearise(state, torch.arange(3))
    step, goes_on = problem.step(model, torch.tensor([1e-2, torch.inf, 1e-2], dtype=torch.float64))
    assert goes_on.tolist() == [False, False, True]
    assert torch.equal(step[:2], torch.zeros(2, 2, dtype=torch.float64)) and bool(
        step[2].abs().gt(0).any()
    )
