"""The posterior of distance and normal in the normalised frame: mean, derivatives and covariances, Eqs. (7)-(8)."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.shape.gradient_kernel import cross_covariance, separations
from torchgrasp.shape.kernel import Kernel

BLOCK = 2**27
"""Bytes of the largest temporary of a query on an accelerator; memory stays bounded for any number of points."""

WIDTH = 24
"""Columns of which a block of the inverse factor has a multiple: what a product takes at once. At 280 rows blocks of
72 are a fifth faster than blocks of 70."""


@dataclasses.dataclass(frozen=True)
class SurfaceJet(Value):
    """The posterior mean to second order and its variance to first, at normalised points; gradients are not unit."""

    distance: Float[Tensor, "q"]
    gradient: Float[Tensor, "q 3"]
    hessian: Float[Tensor, "q 3 3"]
    variance: Float[Tensor, "q"]
    variance_gradient: Float[Tensor, "q 3"]


@dataclasses.dataclass(frozen=True)
class Posterior(Value):
    """A Gaussian process on distances and normals, conditioned on observations; all is normalised and float64.

    Args:
        x: observed points, those with normals first.
        has_normal: which of them have normals.
        weights: (K + noise)^-1 y, in the order of `covariance`'s rows.
        factor: lower Cholesky factor of K + noise, with rows and columns in the order of `order`.
        order: row of `covariance` that each row of the factor stands for; None: the same. Observations that came
            later are last in the factor, wherever their points are in `x`.
        kernel: the radial kernel.
    """

    x: Float[Tensor, "n 3"]
    has_normal: Bool[Tensor, "n"]
    weights: Float[Tensor, "rows"]
    factor: Float[Tensor, "rows rows"]
    order: Int[Tensor, "rows"] | None
    kernel: Kernel

    @cached_property
    def precision(self) -> Float[Tensor, "rows rows"]:
        """(K + noise)^-1, in the order of `covariance`'s rows; made when first needed."""
        inverse = torch.cholesky_inverse(self.factor)
        if self.order is None:
            return inverse
        back = torch.argsort(self.order)
        return inverse[back][:, back]

    @cached_property
    def whiteners(self) -> list[Float[Tensor, "columns width"]]:
        """L^-T in some four blocks of columns, without the zeros below.

        Products with them have five eighths of the arithmetic of a dense one, a triangular solve half of it; at 280
        rows they are a sixth faster than the solve.
        """
        rows = len(self.factor)
        inverse = torch.linalg.solve_triangular(
            self.factor, torch.eye(rows, dtype=self.x.dtype, device=self.x.device), upper=False
        )
        width = max(WIDTH * round(rows / (4 * WIDTH)), WIDTH)
        return [inverse[i : i + width, : i + width].T.contiguous() for i in range(0, rows, width)]

    @cached_property
    def n_oriented(self) -> int:
        """Number of observed points with normals."""
        return int(self.has_normal.sum())

    def ordered(self, rows: Shaped[Tensor, "rows *c"]) -> Shaped[Tensor, "rows *c"]:
        """Return what is given by `covariance`'s rows in the order of the factor's."""
        return rows if self.order is None else rows[self.order]

    def mean(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
        """Return the mean signed distance alone, normalised, at normalised points: for grids of many points."""

        def evaluate(x: Tensor) -> tuple[Tensor]:
            n, near = len(self.x), self.n_oriented
            b = self.weights[n:].reshape(3, near).T
            k, slope = self.kernel.derivatives(_distances(x, self.x), 2)
            along = x @ b.T - (self.x[:near] * b).sum(-1)
            return (k @ self.weights[:n] - (slope[:, :near] * along).sum(1),)

        return in_chunks(evaluate, x, 2048)[0]

    def slope(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the mean signed distance and its gradient, normalised, without variances: O(n) a point.

        With d = x - x_j, the gradient is sum_j c_j d - k' / r b_j, which two matrix products give from c.
        """

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            n, near = len(self.x), self.n_oriented
            a, b = self.weights[:n], self.weights[n:].reshape(3, near).T
            k, slope, bend = self.kernel.derivatives(_distances(x, self.x), 3)
            along = x @ b.T - (self.x[:near] * b).sum(-1)
            distance = k @ a - (slope[:, :near] * along).sum(1)
            c = slope * a
            c[:, :near].addcmul_(bend[:, :near], along, value=-1.0)
            return distance, self._pull(c, x) - slope[:, :near] @ b

        return in_chunks(evaluate, x, 512 if x.device.type == "cpu" else 16384)  # pyright: ignore[reportReturnType]

    def estimate(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]:
        """Return the mean and the covariance of (d, w), Eqs. (7)-(8), with the derivatives in closed form."""
        prior, rows = self.prior_block(), len(self.factor)
        size = self._chunk(x)
        # Written again for every chunk: on a CPU new memory costs more than the arithmetic.
        spaces = x.new_empty(2, 4 * min(size, len(x)) * rows)

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            source, target = (space[: 4 * len(x) * rows].view(4, len(x), rows) for space in spaces)
            cross_covariance(self.kernel, x, self.x, self.n_oriented, source)
            mean = (source @ self.weights).T
            if self.order is not None:
                source, target = torch.index_select(source, 2, self.order, out=target), source
            for block in self.whiteners:
                end, start = len(block), len(block) - block.shape[1]
                torch.mm(source.view(-1, rows)[:, :end], block, out=target.view(-1, rows)[:, start:end])
            spread = prior.repeat(len(x), 1, 1)
            for m in range(4):
                for p in range(m, 4):
                    explained = torch.linalg.vecdot(target[m], target[p])
                    spread[:, m, p] -= explained
                    if p > m:
                        spread[:, p, m] -= explained
            return mean, spread

        return in_chunks(evaluate, x, size)  # pyright: ignore[reportReturnType]

    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return the mean to second order and the variance to first, for planners: no check, no autograd.

        With d = x - x_j and k', k'', k''' the derivatives of the kernel in |d|^2 / 2, the mean is
        sum_j a_j k - k' d.b_j, its weights being (a, b). With c_j = k' a_j - k'' d.b_j its gradient is
        sum_j c_j d - k' b_j, and its Hessian sum_j (k'' a_j - k''' d.b_j) d d^T - k'' (b_j d^T + d b_j^T) + c_j I. The
        gradient of the variance k0 - k*^T A k* is -2 times the gradient of the mean with weights A k*.

        Args:
            x: points in the normalised frame, float64.
        """
        # Small chunks keep every temporary in the cache of a CPU core.
        chunk = 256 if x.device.type == "cpu" else 16384
        return SurfaceJet(*in_chunks(self._jet, x, chunk))

    def prior_block(self) -> Float[Tensor, "4 4"]:
        """Return the prior covariance of (d, w) at any one point."""
        here = self.x.new_zeros(1, 3)
        return cross_covariance(self.kernel, here, here, 1)[:, 0]

    def cross(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "4 q rows"]:
        """Return the covariance of (d, w) at points with the observations, in the order of `covariance`'s columns."""
        return cross_covariance(self.kernel, x, self.x, self.n_oriented)

    def _chunk(self, x: Tensor) -> int:
        """Return how many points to query at once."""
        if x.device.type == "cpu":
            return 256
        return max(BLOCK // (32 * len(self.factor)), 64)

    def _jet(self, x: Float[Tensor, "q 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the fields of `SurfaceJet` for one chunk."""
        n, near = len(self.x), self.n_oriented  # the points with normals come first
        a, b = self.weights[:n], self.weights[n:].reshape(3, near).T
        d, r = separations(x, self.x)
        k, slope, bend, third = self.kernel.derivatives(r, 4)
        near_d, near_slope, near_bend = [part[:, :near] for part in d], slope[:, :near], bend[:, :near]
        row = x.new_empty(len(x), n + 3 * near)
        row[:, :n] = k
        for m in range(3):
            torch.mul(near_d[m], near_slope, out=row[:, n + m * near : n + (m + 1) * near]).neg_()

        along = torch.addmm((self.x[:near] * b).sum(-1), x, b.T, beta=-1.0)
        c = torch.mul(slope, a)
        c[:, :near].addcmul_(near_bend, along, value=-1.0)
        outer = bend * a
        outer[:, :near].addcmul_(third[:, :near], along, value=-1.0)
        gradient = self._pull(c, x) - near_slope @ b
        half = torch.stack([0.5 * self._pull(outer * d[m], x) - (near_bend * near_d[m]) @ b for m in range(3)], 1)
        hessian = half + half.mT
        hessian.diagonal(dim1=1, dim2=2).add_(c.sum(1, keepdim=True))

        solved = row @ self.precision
        s, u = solved[:, :n], solved[:, n:].unflatten(1, (3, near)).unbind(1)
        along = (near_d[0] * u[0]).addcmul_(near_d[1], u[1]).addcmul_(near_d[2], u[2])
        variance = self.kernel.profile(x.new_zeros(())) - (k * s).sum(1) + (near_slope * along).sum(1)
        c = slope * s
        c[:, :near].addcmul_(near_bend, along, value=-1.0)
        explained = self._pull(c, x) - torch.stack([(near_slope * part).sum(1) for part in u], 1)
        return row @ self.weights, gradient, hessian, variance, -2.0 * explained

    def _pull(self, c: Float[Tensor, "q n"], x: Float[Tensor, "q 3"]) -> Float[Tensor, "q 3"]:
        """Return sum_j c_j (x - x_j), by a matrix product."""
        return x * c.sum(1, keepdim=True) - c @ self.x


def in_chunks(evaluate: Callable[[Tensor], tuple[Any, ...]], x: Tensor, size: int) -> tuple[Any, ...]:
    """Evaluate a function of the leading axis piece by piece, so that memory stays bounded."""
    if len(x) <= size:
        return evaluate(x)
    found: tuple[Any, ...] = ()
    for start in range(0, len(x), size):
        pieces = evaluate(x[start : start + size])
        found = found or tuple(p.new_empty((len(x), *p.shape[1:])) for p in pieces)
        for whole, piece in zip(found, pieces, strict=True):
            whole[start : start + size] = piece
    return found


def _distances(x: Float[Tensor, "q 3"], y: Float[Tensor, "n 3"]) -> Float[Tensor, "q n"]:
    """Return distances without the cancellation of |x|^2 - 2 x.y + |y|^2."""
    return torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")
