"""The Gaussian process posterior in the normalised frame: mean, derivatives, covariances; Eqs.
(7)-(8) of the paper.
"""

import dataclasses
import math
import types
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchgrasp.foundation.base import Value, at_once, in_chunks, kept
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import IndefiniteCovariance
from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.rules import is_known
from torchgrasp.geometry.linalg import Points, norm
from torchgrasp.shape import jets
from torchgrasp.shape.estimate import JointEstimate, MeanAndGradient, MeanJet, Moments, SurfaceJet
from torchgrasp.shape.jets import Weighted
from torchgrasp.shape.kernel import (
    CovarianceRows,
    Kernel,
    Queries,
    cross_covariance,
    differentiate,
    gram,
    is_plain,
    is_thin,
)


@dataclasses.dataclass(frozen=True)
class ChunkNumbers:
    """Numbers of points that are processed at once, in chunks.

    On a CPU the temporaries of a chunk stay in the cache.
    """

    mean: int = 2048
    """Number of points of a chunk for the mean."""
    gradient: int = 512
    """Number of points of a chunk for the mean's gradient."""
    jet: int = 256
    """Number of points of a chunk for an estimate, or for a jet (the mean with two derivatives)."""
    memory: int = 2**27
    """Greatest memory [B] of an estimate's temporaries on an accelerator."""
    entry: int = 32
    """Memory [B] for each column of the covariance of distance and gradient."""
    least: int = 64
    """Least number of points of a chunk on an accelerator."""
    tile: int = 24
    """Number of which the number of columns is a multiple, as matrix products are then fastest."""


CHUNK = ChunkNumbers()
# least eigenvalue of a covariance, over the prior variance: less is more than rounding
LEAST_EIGENVALUE = -1e-8
# eigenvalue over the prior variance that counts as zero in derivatives. It is above rounding, and
# above that of points one millionth of the shape's size apart
SINGULAR = 1e-12


@dataclasses.dataclass(frozen=True)
class Posterior(Value):
    """The posterior of a Gaussian process over the signed distance, given observed distances and
    normals.

    All is in normalised units and float64. n counts observed points, and r observed numbers: n
    distances, and three for each observed normal. (d, w) are the signed distance and its gradient.
    All methods but `explain` are differentiable, to any order, in the points and in the posterior's
    tensors. Plain tensors take faster formulas, which reuse buffers. The subclass `ShapeGP` has the
    frame: its `normalise`, `scale`, `domain_radius`, `predict` and `joint` are meant in the
    methods.
    """

    x: Points  # observed points (n, 3), those with normals first
    has_normal: Bool[Tensor, "n"]  # mask of the points with observed normals
    # (K + noise)^-1 y of the observed y: all distances, then the normals by component
    weights: Float[Tensor, "rows"]
    # lower Cholesky factor of K + noise; rows of later observations come last
    factor: Float[Tensor, "rows rows"]
    order: Int[Tensor, "rows"] | None  # row in `weights` of each row of `factor`; None if the same
    kernel: Kernel

    @kept
    def whiteners(self) -> list[Float[Tensor, "columns width"]]:
        """The matrix L^-T (r, r), as a list of blocks of its columns. L (`factor`) is the Cholesky
        factor of the covariance of the r observed numbers with their noise.

        The block of the columns i to j - 1 holds the rows 0 to j - 1. The rows below are zero.
        """
        rows = len(self.factor)
        one = torch.eye(rows, dtype=self.x.dtype, device=self.x.device)
        inverse = torch.linalg.solve_triangular(self.factor, one, upper=False)
        width = CHUNK.tile * max(round(rows / (4 * CHUNK.tile)), 1)
        return [inverse[i : i + width, : i + width].T.contiguous() for i in range(0, rows, width)]

    @cached_property
    def n_oriented(self) -> int:
        """Number of observed points with normals. They are the first points of `x`."""
        return int(self.has_normal.sum())

    @checked(gradients=True)
    def ordered(
        self,
        rows: Shaped[Tensor, "rows *c"],
    ) -> Shaped[Tensor, "rows *c"]:
        """Return `rows` (r, ...), one for each observed number, sorted from the order of `weights`
        into the order of `factor`.

        In the order of `weights`, the n distances come first, then the normals by component.
        """
        return rows if self.order is None else rows[self.order]

    @checked(gradients=True)
    def mean(self, x: Queries) -> Float[Tensor, "q"]:
        """Return the mean signed distance (q,) at q points `x` (q, 3) that `normalise` returned.

        The distance is negative inside, and normalised: one unit is `scale` [m]. It is valid within
        `domain_radius` of the origin; `predict` also covers points outside.
        """
        if not self._is_plain(x):
            return self.distance_rows(x) @ self.weights
        mean = partial(self._jets(x).evaluate_mean, self.weighted, gradient=False)
        return in_chunks(mean, x, CHUNK.mean)[0]

    @checked(gradients=True)
    def mean_and_gradient(self, x: Queries) -> MeanAndGradient:
        """Return (distance, gradient): the mean signed distance (q,) and its gradient (q, 3).

        They are at q points `x` (q, 3) that `normalise` returned. The distance is normalised: one
        unit is `scale` [m]. The gradient is with respect to normalised coordinates (no unit).
        """
        if not self._is_plain(x):
            distance, *slope = (self.cross(x) @ self.weights).unbind(0)
            return distance, torch.stack(slope, -1)
        mean = partial(self._jets(x).evaluate_mean, self.weighted, gradient=True)
        return in_chunks(mean, x, at_once(x, CHUNK.gradient))  # pyright: ignore[reportReturnType]

    @checked(gradients=True)
    def estimate(self, x: Queries) -> Moments:
        """Return (mean, covariance) of signed distance and gradient (d, w) at each of q points `x`,
        Eqs. (7)-(8) of the paper.

        The points `x` (q, 3) are those that `normalise` returned. The mean is (q, 4) and the
        covariance (q, 4, 4), both normalised: one unit is `scale` [m]. The covariance between
        different points is left out; `joint_at` has it.
        """
        prior = self.prior_block()
        rows = len(self.factor)

        def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
            cross = self.cross(x)
            mean = (cross @ self.weights).T
            whitened = self.whiten(cross.reshape(-1, rows)).reshape(4, len(x), rows)
            whitened = whitened.transpose(0, 1)
            return mean, prior - whitened @ whitened.mT

        size = CHUNK.jet
        if x.device.type != "cpu":
            size = max(CHUNK.memory // (CHUNK.entry * rows), CHUNK.least)
        return in_chunks(evaluate, x, size)  # pyright: ignore[reportReturnType]

    @checked(gradients=True)
    def variance(self, x: Queries) -> Float[Tensor, "q"]:
        """Return the variance (q,) of the signed distance at q points `x` (q, 3) that `normalise`
        returned.

        The variance is in squared normalised units: one unit is `scale` [m]. It is not calibrated;
        `predict(...).std_m` is. It costs less than `estimate`.
        """
        prior = self.kernel.profile(self.x.new_zeros(()))

        def evaluate(x: Tensor) -> tuple[Tensor]:
            whitened = self.whiten(self.distance_rows(x))
            return (prior - torch.linalg.vecdot(whitened, whitened),)

        return in_chunks(evaluate, x, at_once(x, CHUNK.jet))[0]

    @checked(gradients=True)
    def jet(self, x: Queries) -> SurfaceJet:
        """Return mean and variance of the signed distance with derivatives, at q points `x` (q, 3).

        The points are those that `normalise` returned. The mean has first and second derivatives,
        the variance the first. All are normalised: one unit is `scale` [m]. The fields of the
        `SurfaceJet` are `distance` (q,), `gradient` (q, 3), `hessian` (q, 3, 3), `variance` (q,)
        and `variance_gradient` (q, 3).
        """
        # The mean is sum_j (a_j k - k' d.b_j), with d = x - x_j and k' = dk / d(|d|^2 / 2).
        # Here a_j is the weight of the distance at the observed point x_j, b_j that of its normal.
        # The variance is k0 - k*^T A k*. Here k0 is the prior variance, and k* the covariance of
        # the point with the data. A is the inverse covariance of the data. Its gradient is -2 times
        # the gradient of a mean with the weights A k*.
        evaluate = partial(_differentiable_jet, self)
        if self._is_plain(x):
            evaluate = partial(self._jets(x).evaluate_jet, self.weighted, explain=self.explain)
        return SurfaceJet(*in_chunks(evaluate, x, at_once(x, CHUNK.jet)))

    @checked(gradients=True)
    def mean_jet(self, x: Queries) -> MeanJet:
        """Return the mean signed distance with first and second derivatives, at q points `x`
        (q, 3).

        The points are those that `normalise` returned. The result is normalised: one unit is
        `scale` [m]. The fields of the `MeanJet` are `distance` (q,), `gradient` (q, 3) and
        `hessian` (q, 3, 3). The call costs less than `jet`.
        """
        size = at_once(x, CHUNK.jet)
        if not self._is_plain(x):
            return MeanJet(*in_chunks(partial(_differentiable_jet, self), x, size)[:3])
        evaluate = partial(self._jets(x).evaluate_mean_jet, self.weighted)
        return MeanJet(*in_chunks(lambda part: evaluate(part)[0], x, size))

    @checked(gradients=True)
    def joint_at(self, x: Float[Tensor, "k 3"]) -> JointEstimate:
        """Return the joint posterior of signed distance and gradient at k points `x` (k, 3), Eqs.
        (7)-(8) of the paper.

        The points are those that `normalise` returned. The result is normalised: one unit is
        `scale` [m]. It has the covariances between all k points. `joint` does the same for points
        [m], but limits their number and refuses points outside the domain.
        """
        k = len(x)
        cross = self.cross(x)
        mean = (cross @ self.weights).T
        by_point = self.ordered(cross.transpose(0, 1).flatten(0, 1).T)
        whitened = torch.linalg.solve_triangular(self.factor, by_point, upper=False)
        prior = gram(self.kernel, x, k).reshape(4, k, 4, k)
        prior = prior.permute(1, 0, 3, 2).reshape(4 * k, 4 * k)
        return JointEstimate(mean, prior - whitened.T @ whitened)

    def prior_block(self) -> Float[Tensor, "4 4"]:
        """Return the prior covariance (4, 4) of signed distance (index 0) and gradient (1 to 3) at
        a point, normalised.

        It is the same at every point. Distances are in units of `scale` [m], and gradients have no
        unit.
        """
        here = self.x.new_zeros(1, 3)
        return cross_covariance(self.kernel, here, here, 1)[:, 0]

    @checked(gradients=True)
    def distance_rows(self, x: Queries) -> CovarianceRows:
        """Return the prior covariance (q, r) of the signed distance at q points with all r observed
        numbers.

        The points `x` (q, 3) are those that `normalise` returned. The columns are in the order of
        `weights`: first the n observed distances, then the observed normals by component.
        """
        if not self._is_plain(x):
            d = x[:, None] - self.x
            k, first = differentiate(self.kernel.profile, (d * d).sum(-1) / 2, 2)
            slope = (first[..., None] * d)[:, : self.n_oriented]
            return torch.cat([k, -slope.mT.flatten(1)], 1)
        return self._jets(x).rows_at(self.x, self.n_oriented, self.kernel, x)

    @checked(gradients=True)
    def whiten(self, rows: CovarianceRows) -> CovarianceRows:
        """Return `rows` (q, r) times L^-T, where L is the Cholesky factor `factor`.

        A row holds the prior covariances of one number with all r observed numbers, as
        `distance_rows` returns them. The dot product of two rows of the result (q, r) is the
        covariance of their numbers that the observations explain. Prior minus explained covariance
        is the posterior covariance.
        """
        rows = rows if self.order is None else rows[:, self.order]
        if not self._is_plain(rows):
            return torch.linalg.solve_triangular(self.factor, rows.T, upper=False).T
        whitened = torch.empty_like(rows)
        first = 0
        for block in self.whiteners:
            end = first + block.shape[1]
            torch.mm(rows[:, : len(block)], block, out=whitened[:, first:end])
            first = end
        return whitened

    @checked
    def explain(
        self,
        rows: CovarianceRows,
    ) -> tuple[Float[Tensor, "q"], CovarianceRows]:
        """Return (explained, solved): k A k^T (q,) and k A (q, r) for each row k of `rows` (q, r).

        A is the inverse covariance of the r observed numbers. A row holds the prior covariances of
        one number with them, as `distance_rows` returns them. The prior variance of this number
        minus the explained variance k A k^T is its posterior variance.
        """
        whitened = self.whiten(rows)
        solved = torch.zeros_like(rows)
        first = 0
        for block in self.whiteners:
            end = first + block.shape[1]
            solved[:, : len(block)].addmm_(whitened[:, first:end], block.T)
            first = end
        if self.order is not None:
            solved = torch.empty_like(solved).index_copy(1, self.order, solved)
        return torch.linalg.vecdot(whitened, whitened), solved

    @checked(gradients=True)
    def cross(self, x: Queries) -> Float[Tensor, "4 q rows"]:
        """Return the prior covariance (4, q, r) of distance and gradient at q points with all r
        observed numbers.

        The points `x` (q, 3) are those that `normalise` returned. On the first axis, index 0 is the
        signed distance, and 1 to 3 are its gradient. The last axis is in the order of `weights`:
        first the n observed distances, then the observed normals by component.
        """
        return cross_covariance(self.kernel, x, self.x, self.n_oriented)

    def _is_plain(self, x: Tensor) -> bool:
        """Return whether torch neither differentiates points and posterior nor maps over them."""
        return is_plain(x, self.x, self.weights, self.factor)

    def _jets(self, x: Queries) -> types.ModuleType:
        """Return the module that evaluates mean and jets at plain points: `jets`, or its loops."""
        if not (is_fused(x, self.x, self.weights) and is_thin(self.kernel)):
            return jets
        from torchgrasp.shape import fused_jets  # it imports numba

        return fused_jets

    @kept
    def weighted(self) -> Weighted:
        """What the posterior mean is made of: observed points, weights of their distances and
        normals, and the kernel.

        Of its fields, `x` (n, 3) are the n observed points, normalised. `a` (n,) are the weights of
        their distances, and `b` (k, 3) those of the k observed normals.
        """
        n = len(self.x)
        normals = self.weights[n:].reshape(3, self.n_oriented).T
        return Weighted(self.x, self.weights[:n], normals, self.kernel)


def _differentiable_jet(posterior: Posterior, x: Queries) -> tuple[Tensor, ...]:
    """Return the fields of `SurfaceJet` at some points by autograd of mean and variance."""

    def total(x: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
        mean, spread = posterior.estimate(x)
        gradient = mean[:, 1:]
        variance = spread[:, 0, 0]
        return (gradient.sum(0), variance.sum(0)), (mean[:, 0], gradient, variance)

    (hessian, slope), (distance, gradient, variance) = torch.func.jacrev(total, has_aux=True)(x)
    return distance, gradient, hessian.transpose(0, 1), variance, slope


def combined_covariance(
    posterior: Posterior,
    x: Float[Tensor, "b g p 3"],
    weights: Float[Tensor, "#b #g m p"],
) -> Float[Tensor, "b v v"]:
    """Return the posterior covariance (b, v, v) of v weighted sums of signed distances, for each of
    b sets of points.

    `x` are normalised points. Each set has g groups of p points. `weights` are those of m sums over
    the points of each group, so v = g m. The sums of the first group come first. The result is in
    squared normalised units; one unit is `scale` [m].
    """
    b, g, p, _ = x.shape
    rows = len(posterior.factor)
    v = g * weights.shape[2]
    points = x.flatten(1, 2)
    cross = posterior.distance_rows(points.flatten(0, 1)).view(b, g, p, rows)
    # the sums are whitened: they are fewer than the points
    sums = (weights @ cross).view(b * v, rows)
    whitened = posterior.whiten(sums).view(b, v, rows)
    offset = points[:, :, None] - points[:, None]
    apart = norm(offset)
    if not is_plain(points):
        # the length of a zero vector has no second derivative, and counts as constant here
        same = (offset == 0).all(-1)
        apart = norm(torch.where(same[..., None], 1.0, offset))
        apart = torch.where(same, 0.0, apart)
    prior = posterior.kernel.profile(apart)  # (b, g p, g p)
    prior = weights @ prior.view(b, g, p, g * p)  # (b, g, m, g p)
    prior = weights @ prior.view(b, v, g, p).permute(0, 2, 3, 1)  # (b, g, m, v)
    return torch.baddbmm(prior.reshape(b, v, v), whitened, whitened.mT, alpha=-1.0)


def symmetric_root(
    covariance: Float[Tensor, "*b k k"],
    prior: float,
    fix: str,
) -> Float[Tensor, "*b k k"]:
    """Return the symmetric square roots of covariance matrices, unique even with equal eigenvalues.

    Rounding may turn eigenvalues of zero, as of coinciding points, slightly negative; they count as
    zero. Eigenvalues below -1e-8 (`LEAST_EIGENVALUE`) times the `prior` variance raise
    `IndefiniteCovariance`, whose message ends with `fix`. The root is differentiable twice. Where
    eigenvalues are zero, its derivatives are those along covariances of the same rank.
    """
    values, vectors = torch.linalg.eigh(covariance.detach())
    if is_known(values) and values.numel():
        least = float(values.min())
        if not least >= LEAST_EIGENVALUE * prior:
            raise IndefiniteCovariance("the joint covariance", least, fix)
    roots = torch.where(values > 0, values, 0.0).sqrt()
    root = (vectors * roots[..., None, :]) @ vectors.mT
    if is_plain(covariance):
        return root
    both = roots[..., None] + roots[..., None, :]
    both = torch.where(both > math.sqrt(SINGULAR * prior), both, torch.inf)
    # Newton's steps change the derivatives alone
    for _ in range(2):
        rest = vectors.mT @ (covariance - root @ root) @ vectors
        root = root + vectors @ (rest / both) @ vectors.mT
    return root
