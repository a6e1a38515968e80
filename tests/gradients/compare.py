"""Comparisons of results and derivatives, which the tests of the table of gradients share."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tests.gradients.table import ROWS, Function, outputs

F64 = torch.float64


def scalar(function: Function) -> Callable[..., Tensor]:
    """Return a function that sums all results of a function with fixed weights."""
    return lambda *x: weighted_sum(outputs(function(*x)))


def weighted_sum(found: tuple[Tensor, ...]) -> Tensor:
    weights = [
        torch.linspace(0.5, 1.5, y.numel(), dtype=y.dtype, device="cpu").view(y.shape)
        for y in found
    ]
    return sum((w * y).sum() for w, y in zip(weights, found, strict=True))


def near(found: Any, expected: Any, tolerance: float = 1e-7) -> None:
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def every(x: tuple[Tensor, ...]) -> tuple[int, ...]:
    return tuple(range(len(x)))


def slopes(function: Function, x: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return the derivatives of the sum of all results, by `backward`."""
    leaves = tuple(v.detach().clone().requires_grad_() for v in x)
    return torch.autograd.grad(scalar(function)(*leaves), leaves)


def compile_rows(names: list[str]) -> None:
    """Compare rows with themselves behind `torch.compile`, inside autocast; print the names of those
    that agree.
    """
    for name in names:
        torch.compiler.reset()
        dtype = F64 if "single" in ROWS[name].lacks else torch.float32
        function, x = ROWS[name].make(dtype)
        compiled = torch.compile(lambda *v: outputs(function(*v)), backend="eager")  # noqa: B023
        leaves = tuple(v.clone().requires_grad_() for v in x)
        with torch.autocast("cpu"):
            found = compiled(*leaves)  # once, which compiles once
        near(found, outputs(function(*x)))
        near(torch.autograd.grad(weighted_sum(found), leaves), slopes(function, x))
        print(name)
