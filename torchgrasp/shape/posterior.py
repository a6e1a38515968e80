"""The posterior of distance and normal in the normalised frame: mean, derivatives and covariances, Eqs. (7)-(8)."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.shape.blocks import cross_covariance
from torchgrasp.shape.profiles import Kernel

BLOCK = 2**27
"""Bytes of the largest temporary of a query on an accelerator; memory stays bounded for any number of points."""


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
    def oriented(self) -> int:
        """Number of observed points with normals."""
        return int(self.has_normal.sum())

    def ordered(self, rows: Shaped[Tensor, "rows *c"]) -> Shaped[Tensor, "rows *c"]:
        """Return what is given by `covariance`'s rows in the order of the factor's."""
        return rows if self.order is None else rows[self.order]

    def mean(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
        """Return the mean signed distance alone, normalised, at normalised points: for grids of many points."""

        def evaluate(x: Tensor) -> tuple[Tensor]:
            n, near = len(self.x), self.oriented
            b = self.weights[n:].reshape(3, near).T
            k, slope = self.kernel.slopes(_distances(x, self.x), 2)
            along = x @ b.T - (self.x[:near] * b).sum(-1)
            return (k @ self.weights[:n] - (slope[:, :near] * along).sum(1),)

        return in_chunks(evaluate, x, 2048)[0]

    def slope(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the mean signed distance and its gradient, normalised, without variances: O(n) a point.

        With d = x - x_j, the gradient is sum_j c_j d - k' / r b_j, which two matrix products give from c.
        """

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            n, near = len(self.x), self.oriented
            a, b = self.weights[:n], self.weights[n:].reshape(3, near).T
            k, slope, bend = self.kernel.slopes(_distances(x, self.x), 3)
            along = x @ b.T - (self.x[:near] * b).sum(-1)
            distance = k @ a - (slope[:, :near] * along).sum(1)
            c = slope * a
            c[:, :near] -= bend[:, :near] * along
            return distance, x * c.sum(1, keepdim=True) - c @ self.x - slope[:, :near] @ b

        return in_chunks(evaluate, x, 512 if x.device.type == "cpu" else 16384)  # pyright: ignore[reportReturnType]

    def estimate(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]:
        """Return the mean and the covariance of (d, w), Eqs. (7)-(8), with the derivatives in closed form."""
        prior = self.prior_block()

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            cross = self.cross(x)
            mean = (cross @ self.weights).T
            if self.order is not None:
                cross = cross[..., self.order]
            rows = cross.shape[-1]
            whitened = torch.linalg.solve_triangular(self.factor, cross.reshape(-1, rows).T, upper=False)
            whitened = whitened.T.reshape(4, len(x), rows)
            spread = prior.expand(len(x), 4, 4).clone()
            for m in range(4):
                for p in range(m, 4):
                    explained = torch.linalg.vecdot(whitened[m], whitened[p])
                    spread[:, m, p] -= explained
                    if p > m:
                        spread[:, p, m] -= explained
            return mean, spread

        return in_chunks(evaluate, x, self._chunk(x))  # pyright: ignore[reportReturnType]

    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return the mean to second order and the variance to first, for planners: no check, no autograd.

        With d = x - x_j, r = |d|, the mean is sum_j a_j k - k' / r d.b_j, its weights being (a, b). The gradient of
        the variance k0 - k*^T A k* is -2 times the gradient of the mean with weights A k*.

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
        return cross_covariance(self.kernel, x, self.x, self.oriented)

    def _chunk(self, x: Tensor) -> int:
        """Return how many points to query at once."""
        if x.device.type == "cpu":
            return 512
        return max(BLOCK // (32 * len(self.factor)), 64)

    def _jet(self, x: Float[Tensor, "q 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the fields of `SurfaceJet` for one chunk."""
        n, oriented = len(self.x), self.oriented
        near = slice(0, oriented)  # the points with normals come first
        a, b = self.weights[:n], self.weights[n:].reshape(3, oriented)
        d = [x[:, m, None] - self.x[None, :, m] for m in range(3)]
        k, slope, bend, third = self.kernel.slopes(torch.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 4)
        row = torch.cat([k] + [-slope[:, near] * d[m][:, near] for m in range(3)], 1)
        distance = row @ self.weights

        def gradient_of(a: Tensor, b: list[Tensor], along: Tensor) -> Tensor:
            """Sum a_j k'/r d - bend (d.b_j) d - k'/r b_j over the points; `along` is d.b_j."""
            c = slope * a
            c[:, near] -= bend[:, near] * along
            return torch.stack([(c * d[m]).sum(1) - (slope[:, near] * b[m]).sum(1) for m in range(3)], 1)

        along = d[0][:, near] * b[0] + d[1][:, near] * b[1] + d[2][:, near] * b[2]
        gradient = gradient_of(a, [b[0], b[1], b[2]], along)

        trace = slope @ a - (bend[:, near] * along).sum(1)
        outer = bend * a
        outer[:, near] -= third[:, near] * along
        tilt = bend[:, near]
        hessian = torch.empty(len(x), 3, 3, dtype=x.dtype, device=x.device)
        scaled = [outer * d[m] for m in range(3)]
        tilted = [(tilt * d[m][:, near]) @ b.T for m in range(3)]
        for m in range(3):
            for p in range(m, 3):
                entry = (scaled[m] * d[p]).sum(1) - tilted[m][:, p] - tilted[p][:, m]
                hessian[:, m, p] = hessian[:, p, m] = entry + trace if m == p else entry

        solved = row @ self.precision
        variance = self.kernel.profile(x.new_zeros(())) - (solved * row).sum(1)
        u = [solved[:, n + m * oriented : n + (m + 1) * oriented] for m in range(3)]
        along = d[0][:, near] * u[0] + d[1][:, near] * u[1] + d[2][:, near] * u[2]
        return distance, gradient, hessian, variance, -2.0 * gradient_of(solved[:, :n], u, along)


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
