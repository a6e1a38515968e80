"""Jets in closed form: mean and variance of the distance at many points, with their derivatives.

`Posterior.jet` gives the formulas. All is in normalised units.
"""

import dataclasses
from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.fused import array
from torchgrasp.geometry.linalg import Points
from torchgrasp.shape.kernel import CovarianceRows, Kernel, Queries, psi_of, separations

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, float]
"""Observed points (3, n), weights (1 or q, n) of distances and (1 or q, 3, n) of normals, and psi."""


@dataclasses.dataclass(frozen=True, eq=False)
class Weighted:
    """What determines the posterior mean of a surface's signed distance: observed points, their
    weights, and the kernel.

    The mean at a point is a weighted sum of the kernel's values and slopes at the n observed
    points. The first `near` of these have observed normals. With a leading axis q, each of q query
    points has a posterior of its own.
    """

    x: Float[Tensor, "*q n 3"]  # observed points, normalised, those with normals first
    a: Float[Tensor, "*q n"]  # weight of each point's observed distance
    b: Float[Tensor, "*q near 3"]  # weight of each component of a point's observed normal
    kernel: Kernel  # covariance of the signed distances at two points

    @cached_property
    def arrays(self) -> Arrays:
        """The NumPy arrays (points, a, b, psi) that the compiled loops take, computed once.

        They are the observed points (3, n), and the weights (1, n) of distances and (1, 3, n) of
        normals. The weights of points without normals are 0. The number psi is the kernel's length,
        normalised. Ask for them only if all query points share one posterior with a thin plate
        kernel.
        """
        return arrays_of(self, self.a[None], self.b.mT[None])


def arrays_of(
    of: Weighted,
    a: Float[Tensor, "#q n"],
    b: Float[Tensor, "#q 3 near"],
) -> Arrays:
    """Return (points, a, b, psi) as NumPy arrays and a number, in the form that compiled loops
    take.

    They are the observed points (3, n) and the kernel's length psi, both of `of`, and the given
    weights. All q query points share the weights `a` of distances and `b` of normals, or each has
    its own. Weights of normals become (1 or q, 3, n); points without normals get 0.
    """
    shifts = a.new_zeros(len(b), 3, len(of.x))  # points without normals have weight 0
    shifts[..., : b.shape[2]] = b
    return array(of.x.T), array(a), array(shifts), psi_of(of.kernel)


# `Posterior.explain`: function of covariances (q, r) with all observed numbers, which returns (the
# variance (q,) that these explain, the covariances times the inverse covariance)
Explain = Callable[[Tensor], tuple[Tensor, Tensor]]
Values = Float[Tensor, "q n"]
Kernels = tuple[list[Tensor], Values, Values, Float[Tensor, "q near"]]
"""Components of the differences from the observed points, k, k', and k'' for the points with
normals.
"""


def evaluate_mean(
    of: Weighted,
    x: Queries,
    gradient: bool,
) -> tuple[Tensor, ...]:
    """Return a surface's mean signed distance at q points and, if `gradient` is True, its gradient.

    The result is (distance,) or (distance, gradient), of the shapes (q,) and (q, 3). It is at the
    points `x` (q, 3), all normalised. `of` holds the observations of the surface and their weights.
    """
    near = of.b.shape[-2]  # the points with normals come first
    if of.x.ndim == 2:
        distances = torch.cdist(x, of.x, compute_mode="donot_use_mm_for_euclid_dist")
    else:
        distances = separations(x, of.x)[1]
    k, first, *second = of.kernel.derivatives(distances, 3 if gradient else 2)
    along = _along_normals(of, x)
    distance = _dot(k, of.a) - torch.linalg.vecdot(first[:, :near], along)
    if not gradient:
        return (distance,)
    c = first * of.a
    c[:, :near].addcmul_(second[0][:, :near], along, value=-1.0)
    return distance, _sum_differences(c, x, of.x) - _times(first[:, :near], of.b)


def evaluate_mean_jet(
    of: Weighted,
    x: Queries,
) -> tuple[tuple[Tensor, Tensor, Tensor], Kernels]:
    """Return ((distance, gradient, Hessian), kernel values): a surface's mean signed distance with
    derivatives.

    They are (q,), (q, 3) and (q, 3, 3), at q points `x` (q, 3), all normalised. `of` holds the
    observations of the surface and their weights. The kernel values serve to compute the variance.
    """
    known = of.x
    a = of.a
    b = of.b
    near = b.shape[-2]  # the points with normals come first
    d, r = separations(x, known)
    k, first, second, third = of.kernel.derivatives(r, 4)
    near_first = first[:, :near]
    near_second = second[:, :near]
    along = _along_normals(of, x)
    c = torch.mul(first, a)
    c[:, :near].addcmul_(near_second, along, value=-1.0)
    outer = second * a
    outer[:, :near].addcmul_(third[:, :near], along, value=-1.0)
    distance = _dot(k, a) - torch.linalg.vecdot(near_first, along)
    gradient = _sum_differences(c, x, known) - _times(near_first, b)
    rows = []
    for part in d:
        bent = 0.5 * _sum_differences(outer * part, x, known)
        rows.append(bent - _times(near_second * part[:, :near], b))
    half = torch.stack(rows, 1)  # (q, 3, 3)
    hessian = half + half.mT
    hessian.diagonal(dim1=1, dim2=2).add_(c.sum(1, keepdim=True))
    return (distance, gradient, hessian), (d, k, first, near_second)


def evaluate_jet(
    of: Weighted,
    x: Queries,
    explain: Explain,
) -> tuple[Tensor, ...]:
    """Return mean and variance of a surface's signed distance, with derivatives, at q points `x`.

    They are distance (q,), gradient (q, 3), Hessian (q, 3, 3), variance (q,) and the variance's
    gradient (q, 3). All are normalised. `of` holds the observations of the surface and their
    weights. `explain` is `Posterior.explain` of their posterior.
    """
    mean, (d, k, first, near_second) = evaluate_mean_jet(of, x)
    n = of.x.shape[-2]
    near = near_second.shape[1]
    near_d = [part[:, :near] for part in d]
    near_first = first[:, :near]
    explained, solved = explain(distance_rows(d, k, first, near))
    s = solved[:, :n]
    u = solved[:, n:].unflatten(1, (3, near)).unbind(1)
    along = near_d[0] * u[0]
    along.addcmul_(near_d[1], u[1]).addcmul_(near_d[2], u[2])
    c = first * s
    c[:, :near].addcmul_(near_second, along, value=-1.0)
    normals = torch.stack([(near_first * part).sum(1) for part in u], 1)
    slope = _sum_differences(c, x, of.x) - normals
    variance = of.kernel.profile(x.new_zeros(len(x), 1))[:, 0] - explained
    return *mean, variance, -2.0 * slope


def rows_at(
    known: Points,
    near: int,
    kernel: Kernel,
    x: Queries,
) -> CovarianceRows:
    """Return the prior covariance (q, r) of the signed distances at q points `x` with all r
    observed numbers.

    The observed numbers are the distances at the n points `known`. Then come the normals at the
    first `near` of them, by component. Points are normalised.
    """
    d, r = separations(x, known)
    k, first = kernel.derivatives(r, 2)
    return distance_rows(d, k, first, near)


def distance_rows(
    d: list[Tensor],
    k: Values,
    first: Values,
    near: int,
) -> CovarianceRows:
    """Return the prior covariance (q, r) of signed distances at q points with all r observed
    numbers.

    It is k for the n observed distances, then -k' d for the observed normals, by component.

    Args:
        d: the three components (q, n) of the differences between the q points and the n observed
            ones.
        k: the kernel's values (q, n) at the lengths r of these differences.
        first: the kernel's derivative k' (q, n) with respect to r^2 / 2 there.
        near: number of the observed points with normals, which come first.
    """
    slope = first[:, :near]
    return torch.cat([k, *(-(part[:, :near] * slope) for part in d)], 1)


def _along_normals(
    of: Weighted,
    x: Queries,
) -> Float[Tensor, "q near"]:
    """Return the products of the differences from the observed points with their weighted
    normals.
    """
    offset = (of.x[..., : of.b.shape[-2], :] * of.b).sum(-1)
    if of.b.ndim == 2:
        return torch.addmm(offset, x, of.b.T, beta=-1.0)
    return _times(x, of.b.mT) - offset


def _sum_differences(
    c: Values,
    x: Queries,
    y: Float[Tensor, "*q n 3"],
) -> Queries:
    """Return sum_j c_j (x - y_j) for each point x, by a matrix product."""
    return x * c.sum(1, keepdim=True) - _times(c, y)


def _times(
    rows: Float[Tensor, "q n"],
    matrix: Float[Tensor, "*q n m"],
) -> Float[Tensor, "q m"]:
    """Return rows times a matrix, or each row times a matrix of its own."""
    return rows @ matrix if matrix.ndim == 2 else (rows[:, None] @ matrix)[:, 0]


def _dot(
    rows: Values,
    weights: Float[Tensor, "*q n"],
) -> Float[Tensor, "q"]:
    """Return the products of rows with a vector, or of each row with a vector of its own."""
    return torch.mv(rows, weights) if weights.ndim == 1 else torch.linalg.vecdot(rows, weights)
