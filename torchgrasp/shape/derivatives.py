"""Derivatives of the posterior by the query point, and estimates that carry them through autograd."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.values import ShapeEstimate


@dataclasses.dataclass(frozen=True)
class ShapeDerivatives(Value):
    """Derivatives of a `ShapeEstimate` by the query point, per metre: `normal[i, j]` is d normal_i / d point_j.

    >>> from torchgrasp import fit_shape, load_object
    >>> view = load_object("jug").view
    >>> slopes = fit_shape(view).differentiate(view.points[:4])
    >>> slopes.distance.shape, slopes.normal.shape, slopes.std_m.shape
    (torch.Size([4, 3]), torch.Size([4, 3, 3]), torch.Size([4, 3]))
    """

    distance: Float[Tensor, "*b 3"]
    normal: Float[Tensor, "*b 3 3"]
    variance: Float[Tensor, "*b 3"]
    std_m: Float[Tensor, "*b 3"]


def carry_gradients(
    estimate: ShapeEstimate, points: Float[Tensor, "*b 3"], differentiate: Callable[[Tensor], ShapeDerivatives]
) -> ShapeEstimate:
    """Return an estimate whose distance, normal, variance and std_m pass gradients to the points.

    Their closed form is evaluated when the gradient is asked for. The covariance passes none, and there is no second
    derivative.
    """
    outputs = estimate.distance, estimate.normal, estimate.variance, estimate.std_m
    distance, normal, variance, std_m = _Estimate.apply(points, differentiate, *outputs)  # pyright: ignore
    return ShapeEstimate(distance, normal, variance, estimate.covariance, std_m)


class _Estimate(torch.autograd.Function):
    """Outputs that are known already, and their product with a gradient."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, differentiate: Callable[[Tensor], ShapeDerivatives], *outputs: Tensor) -> Any:
        ctx.save_for_backward(points)
        ctx.differentiate = differentiate
        return tuple(output.clone() for output in outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        (points,) = ctx.saved_tensors
        by = ctx.differentiate(points)
        distance, normal, variance, std_m = (g[..., None] for g in gradients)
        gradient = distance * by.distance + (normal * by.normal).sum(-2)
        gradient = gradient + variance * by.variance + std_m * by.std_m
        return gradient, None, None, None, None, None
