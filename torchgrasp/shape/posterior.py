"""The posterior in the normalised frame: mean, derivatives and covariances, Eqs. (7)-(8)."""

import dataclasses
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchgrasp.base import Batch, Value, in_chunks
from torchgrasp.checks import checked
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.gradient_kernel import cross_covariance, separations
from torchgrasp.shape.kernel import Kernel

CACHED_POINTS, GPU_POINTS = 256, 16384
"""Points of one chunk: on a CPU its temporaries stay in the cache of a core, on an accelerator they fill it."""
GPU_BYTES = 2**27
"""Largest temporary of a chunk with covariances on an accelerator."""
WIDTH = 24
"""Blocks of the inverse factor have a multiple of so many columns: 72 are a fifth faster than 70 at 280 rows."""


@dataclasses.dataclass(frozen=True)
class MeanJet(Batch):
    """The mean to second order; gradients do not have unit length.

    >>> from torchgrasp import fit_shape, load_object
    >>> shape = fit_shape(load_object("jug").view)
    >>> jet = shape.mean_jet(shape.normalise(shape.cloud.points[:5]))
    >>> jet.normals.norm(dim=1), jet.hessian.shape
    (tensor([1.0000, 1.0000, 1.0000, 1.0000, 1.0000], dtype=torch.float64), torch.Size([5, 3, 3]))
    """

    distance: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 3"]
    hessian: Float[Tensor, "*b 3 3"]

    @property
    def normals(self) -> Float[Tensor, "*b 3"]:
        """The outward unit normals, Eq. (11)."""
        return unit(self.gradient)

    @property
    def normal_jacobian(self) -> Float[Tensor, "*b 3 3"]:
        """The derivatives of the normals by their points, (1 - n n^T) H / |g|."""
        n, steep = self.normals, torch.linalg.vector_norm(self.gradient, dim=-1)[..., None, None]
        return (self.hessian - n[..., :, None] * (n[..., None, :] @ self.hessian)) / steep


@dataclasses.dataclass(frozen=True)
class SurfaceJet(MeanJet):
    """The mean to second order and the variance to first."""

    variance: Float[Tensor, "*b"]
    variance_gradient: Float[Tensor, "*b 3"]


def surface_deviation(variance: Float[Tensor, "*b"], gradient: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return the standard deviation of the zero level across itself, to first order in that of the distance.

    A level moves by the error of the distance over the slope of the mean, which is steeper than 1 on the paper's data.

    >>> surface_deviation(torch.tensor([0.04]), torch.tensor([[0.0, 0.0, 2.0]]))
    tensor([0.1000])
    """
    return variance.sqrt() / torch.linalg.vector_norm(gradient, dim=-1)


@dataclasses.dataclass(frozen=True)
class Posterior(Value):
    """A Gaussian process given observations of distances and normals; normalised, in float64.

    Args:
        x: observed points, those with normals first.
        weights: (K + noise)^-1 y, in the order of `gram`'s rows.
        factor: lower Cholesky factor of K + noise. Later observations are last, wherever their points are in `x`.
        order: row of `gram` for each row of the factor; None: the same.
    """

    x: Float[Tensor, "n 3"]
    has_normal: Bool[Tensor, "n"]
    weights: Float[Tensor, "rows"]
    factor: Float[Tensor, "rows rows"]
    order: Int[Tensor, "rows"] | None
    kernel: Kernel

    @cached_property
    def precision(self) -> Float[Tensor, "rows rows"]:
        """(K + noise)^-1, in the order of `gram`'s rows."""
        inverse = torch.cholesky_inverse(self.factor)
        if self.order is None:
            return inverse
        back = torch.argsort(self.order)
        return inverse[back][:, back]

    @cached_property
    def whiteners(self) -> list[Float[Tensor, "columns width"]]:
        """L^-T in about four blocks of columns, without the zeros below.

        Products with them take five eighths of a dense one's arithmetic. They are faster than a triangular solve.
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

    @checked(gradients=True)
    def ordered(self, rows: Shaped[Tensor, "rows *c"]) -> Shaped[Tensor, "rows *c"]:
        """Bring rows from the order of `gram` into that of the factor."""
        return rows if self.order is None else rows[self.order]

    @checked(gradients=True)
    def mean(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
        """Return the mean signed distance at normalised points; for grids of many points."""

        def evaluate(x: Tensor) -> tuple[Tensor]:
            a, b = self._split_weights()
            k, first = self.kernel.derivatives(_distances(x, self.x), 2)
            along = x @ b.T - (self.x[: len(b)] * b).sum(-1)
            return (k @ a - (first[:, : len(b)] * along).sum(1),)

        return in_chunks(evaluate, x, 2048)[0]

    @checked(gradients=True)
    def mean_and_gradient(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the mean signed distance and its gradient at normalised points; see `jet`."""

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            a, b = self._split_weights()
            k, first, second = self.kernel.derivatives(_distances(x, self.x), 3)
            along = x @ b.T - (self.x[: len(b)] * b).sum(-1)
            near = first[:, : len(b)]
            distance = k @ a - (near * along).sum(1)
            c = first * a
            c[:, : len(b)].addcmul_(second[:, : len(b)], along, value=-1.0)
            return distance, _sum_differences(c, x, self.x) - near @ b

        return in_chunks(evaluate, x, 2 * CACHED_POINTS if x.device.type == "cpu" else GPU_POINTS)  # pyright: ignore[reportReturnType]

    @checked(gradients=True)
    def estimate(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]:
        """Return the mean and the covariance of (d, w) at normalised points, Eqs. (7)-(8)."""
        prior, rows = self.prior_block(), len(self.factor)
        size = CACHED_POINTS if x.device.type == "cpu" else max(GPU_BYTES // (32 * rows), 64)
        # Written again for every chunk: on a CPU new memory costs more than the arithmetic.
        spaces = x.new_empty(2, 4 * min(size, len(x)) * rows)

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            source, target = (space[: 4 * len(x) * rows].view(4, len(x), rows) for space in spaces)
            cross_covariance(self.kernel, x, self.x, self.n_oriented, source)
            mean = (source @ self.weights).T
            if self.order is not None:
                source, target = torch.index_select(source, 2, self.order, out=target), source
            self._whiten(source.view(-1, rows), target.view(-1, rows))
            spread = prior.repeat(len(x), 1, 1)
            for m in range(4):
                for p in range(m, 4):
                    explained = torch.linalg.vecdot(target[m], target[p])
                    spread[:, m, p] -= explained
                    if p > m:
                        spread[:, p, m] -= explained
            return mean, spread

        return in_chunks(evaluate, x, size)  # pyright: ignore[reportReturnType]

    @checked(gradients=True)
    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return mean and variance with derivatives at normalised points, without autograd.

        (a, b) are the weights of distances and normals. With d = x - x_j, k', k'' and k''' are derivatives in
        |d|^2 / 2.

        * mean: sum_j a_j k - k' d.b_j
        * gradient: sum_j c_j d - k' b_j with c_j = k' a_j - k'' d.b_j
        * Hessian: sum_j (k'' a_j - k''' d.b_j) d d^T - k'' (b_j d^T + d b_j^T) + c_j I
        * gradient of the variance k0 - k*^T A k*: -2 times the gradient of the mean with the weights A k*
        """
        chunk = CACHED_POINTS if x.device.type == "cpu" else GPU_POINTS
        return SurfaceJet(*in_chunks(partial(_jet, self), x, chunk))

    @checked(gradients=True)
    def mean_jet(self, x: Float[Tensor, "q 3"]) -> MeanJet:
        """Return the mean's part of `jet`: without the variance it costs less than half."""
        chunk = CACHED_POINTS if x.device.type == "cpu" else GPU_POINTS
        return MeanJet(*in_chunks(lambda part: _mean_jet(self, part)[0], x, chunk))

    def prior_block(self) -> Float[Tensor, "4 4"]:
        """Return the prior covariance of (d, w) at any one point."""
        here = self.x.new_zeros(1, 3)
        return cross_covariance(self.kernel, here, here, 1)[:, 0]

    @checked(gradients=True)
    def distance_rows(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q rows"]:
        """Return the covariance of the distances at points with the observations, the first block of `cross`."""
        d, r = separations(x, self.x)
        k, first = self.kernel.derivatives(r, 2)
        return _distance_rows(d, k, first, self.n_oriented)

    @checked(gradients=True)
    def whiten(self, rows: Float[Tensor, "q rows"]) -> Float[Tensor, "q rows"]:
        """Return covariances with the observations times L^-T: their products are what the observations explain."""
        rows = rows if self.order is None else rows[:, self.order]
        return self._whiten(rows, torch.empty_like(rows))

    def _whiten(self, source: Float[Tensor, "q rows"], out: Float[Tensor, "q rows"]) -> Float[Tensor, "q rows"]:
        """Write the same of rows in the factor's order."""
        for block in self.whiteners:
            end, start = len(block), len(block) - block.shape[1]
            torch.mm(source[:, :end], block, out=out[:, start:end])
        return out

    @checked(gradients=True)
    def cross(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "4 q rows"]:
        """Return the covariance of (d, w) at points with the observations."""
        return cross_covariance(self.kernel, x, self.x, self.n_oriented)

    def _split_weights(self) -> tuple[Float[Tensor, "n"], Float[Tensor, "near 3"]]:
        """Return the weights of distances and of normals."""
        n = len(self.x)
        return self.weights[:n], self.weights[n:].reshape(3, self.n_oriented).T


Kernels = tuple[list[Tensor], Float[Tensor, "q n"], Float[Tensor, "q n"], Float[Tensor, "q near"]]
"""Differences from the observations, k, k' and, where there are normals, k''."""


def _mean_jet(posterior: Posterior, x: Float[Tensor, "q 3"]) -> tuple[tuple[Tensor, Tensor, Tensor], Kernels]:
    """Return the fields of `MeanJet` for one chunk, and the kernels for the variance."""
    known, (a, b) = posterior.x, posterior._split_weights()
    near = len(b)  # the points with normals come first
    d, r = separations(x, known)
    k, first, second, third = posterior.kernel.derivatives(r, 4)
    near_first, near_second = first[:, :near], second[:, :near]
    along = torch.addmm((known[:near] * b).sum(-1), x, b.T, beta=-1.0)
    c = torch.mul(first, a)
    c[:, :near].addcmul_(near_second, along, value=-1.0)
    outer = second * a
    outer[:, :near].addcmul_(third[:, :near], along, value=-1.0)
    distance = torch.mv(k, a) - (near_first * along).sum(1)
    gradient = _sum_differences(c, x, known) - near_first @ b
    half = torch.stack(
        [0.5 * _sum_differences(outer * d[m], x, known) - (near_second * d[m][:, :near]) @ b for m in range(3)], 1
    )
    hessian = half + half.mT
    hessian.diagonal(dim1=1, dim2=2).add_(c.sum(1, keepdim=True))
    return (distance, gradient, hessian), (d, k, first, near_second)


def _jet(posterior: Posterior, x: Float[Tensor, "q 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the fields of `SurfaceJet` for one chunk."""
    mean, (d, k, first, near_second) = _mean_jet(posterior, x)
    n, near = len(posterior.x), near_second.shape[1]
    near_d, near_first = [part[:, :near] for part in d], first[:, :near]
    solved = _distance_rows(d, k, first, near) @ posterior.precision
    s, u = solved[:, :n], solved[:, n:].unflatten(1, (3, near)).unbind(1)
    along = (near_d[0] * u[0]).addcmul_(near_d[1], u[1]).addcmul_(near_d[2], u[2])
    variance = posterior.kernel.profile(x.new_zeros(())) - (k * s).sum(1) + (near_first * along).sum(1)
    c = first * s
    c[:, :near].addcmul_(near_second, along, value=-1.0)
    explained = _sum_differences(c, x, posterior.x) - torch.stack([(near_first * part).sum(1) for part in u], 1)
    return *mean, variance, -2.0 * explained


def _distance_rows(
    d: list[Tensor], k: Float[Tensor, "q n"], first: Float[Tensor, "q n"], near: int
) -> Float[Tensor, "q rows"]:
    """Return k and -k' d, the latter of the first observations, which have normals."""
    n = k.shape[1]
    row = k.new_empty(len(k), n + 3 * near)
    row[:, :n] = k
    for m in range(3):
        torch.mul(d[m][:, :near], first[:, :near], out=row[:, n + m * near : n + (m + 1) * near]).neg_()
    return row


def _sum_differences(c: Float[Tensor, "q n"], x: Float[Tensor, "q 3"], y: Float[Tensor, "n 3"]) -> Float[Tensor, "q 3"]:
    """Return sum_j c_j (x - y_j), by a matrix product."""
    return x * c.sum(1, keepdim=True) - c @ y


def _distances(x: Float[Tensor, "q 3"], y: Float[Tensor, "n 3"]) -> Float[Tensor, "q n"]:
    """Return distances without the cancellation of |x|^2 - 2 x.y + |y|^2."""
    return torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")
