"""The shape as a Gaussian process over signed distance and normal, Eqs. (1), (7)-(9)."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value, check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import cholesky, unit
from torchgrasp.shape.kernel import covariance, thin_plate
from torchgrasp.values import PointCloud, ShapeEstimate

REMEDY = "use a psi_scale of at least 1.34: the thin plate kernel is a covariance only within 3/4 psi"
LEAST_PSI = 4.0 / 3.0
"""psi over the diameter of a ball on which the kernel is positive definite (dense limit 1.313)."""
REACH = 1.25
"""The domain's radius over that of the observations, at most: the posterior says nothing further out."""


@dataclasses.dataclass(frozen=True)
class Observations(Value):
    """What is known of the surface at points: signed distances, and normals where `has_normal`.

    All is normalised: positions and distances are divided by the shape's scale. `normal` is ignored elsewhere.
    """

    x: Float[Tensor, "n 3"]
    distance: Float[Tensor, "n"]
    normal: Float[Tensor, "n 3"]
    has_normal: Bool[Tensor, "n"]
    distance_noise: Float[Tensor, "n"]
    normal_noise: Float[Tensor, "n"]

    def rows(self) -> tuple[Float[Tensor, "rows"], Float[Tensor, "rows"]]:
        """Return the observed numbers and the noise variances in the order of `covariance`'s rows."""
        y = torch.cat([self.distance, self.normal[self.has_normal].T.reshape(-1)])
        noise = torch.cat([self.distance_noise, self.normal_noise[self.has_normal].repeat(3)])
        return y, noise * noise


@dataclasses.dataclass(frozen=True)
class SurfaceJet(Value):
    """The posterior mean to second order and its variance to first, at normalised points; gradients are not unit."""

    distance: Float[Tensor, "q"]
    gradient: Float[Tensor, "q 3"]
    hessian: Float[Tensor, "q 3 3"]
    variance: Float[Tensor, "q"]
    variance_gradient: Float[Tensor, "q 3"]


@dataclasses.dataclass(frozen=True)
class ShapeGP(Value):
    """The posterior of an object's shape: g of Eq. (1), conditioned on observations. `fit_shape` makes it.

    Args:
        x: observed points, normalised, those with normals first.
        has_normal: which of them have normals.
        weights: (K + noise)^-1 y, in the order of `covariance`'s rows.
        factor: lower Cholesky factor of K + noise.
        precision: (K + noise)^-1.
        center: origin of the normalised frame [m] in the cloud's frame.
        psi: parameter of the thin plate kernel, normalised.
        scale: length [m] of the normalised unit.
        domain_radius: radius, normalised, of the ball in which the posterior is valid.
        std_factor: ratio of the surface's real deviations to sqrt(variance), from held-out hidden sides.
        cloud: what was seen, after cleaning.
    """

    x: Float[Tensor, "n 3"]
    has_normal: Bool[Tensor, "n"]
    weights: Float[Tensor, "rows"]
    factor: Float[Tensor, "rows rows"]
    precision: Float[Tensor, "rows rows"]
    center: Float[Tensor, "3"]
    psi: float
    scale: float
    domain_radius: float
    std_factor: float
    cloud: PointCloud

    def to(self, *args: Any, **kwargs: Any) -> "ShapeGP":
        """Return the shape on another device; it stays in float64, which its condition number of 1e7 needs."""
        device = torch.empty(0, device=self.x.device).to(*args, **kwargs).device
        return super().to(device)

    @property
    def device(self) -> torch.device:
        """Where the shape lives; planners put their points there."""
        return self.x.device

    def normalise(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Map points [m] of the cloud's frame to the normalised frame."""
        return (points - self.center.to(points)) / self.scale

    def metres(self, x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Map normalised points to the cloud's frame [m]."""
        return x * self.scale + self.center.to(x)

    def contains(self, points: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
        """Tell which points [m] lie in the ball in which the posterior is valid."""
        return torch.linalg.vector_norm(self.normalise(points), dim=-1) <= self.domain_radius

    def predict(self, points: Float[Tensor, "*b 3"]) -> ShapeEstimate:
        """Return signed distance, normal and their covariance at query points, Eqs. (7)-(8).

        The estimate carries no gradient to the points; `jet` returns the derivatives.

        Args:
            points: query points [m] in the cloud's frame.

        Raises:
            BadArgument: non-finite numbers, or a point outside the ball in which the posterior is valid. A thin
                plate's variance turns negative out there, and would pass for certainty.

        Returns:
            The estimate in the dtype of `points`; see `ShapeEstimate` for units.
        """
        flat = _check_queries(points).reshape(-1, 3)
        x = self.normalise(flat.detach().double())
        radius = torch.linalg.vector_norm(x, dim=-1)
        outside = radius > self.domain_radius
        if bool(outside.any()):
            first = int(torch.nonzero(outside)[0])
            raise BadArgument(
                "points",
                f"{int(outside.sum())} of {len(flat)} points outside the domain, the first {flat[first].tolist()} m, "
                f"{float(radius[first]) * self.scale:.4g} m from the centre",
                f"points within {self.domain_radius * self.scale:.4g} m of {self.center.tolist()} m",
            )
        mean, spread = _in_chunks(self._estimate, x, 1024)
        variance = spread[:, 0, 0]
        found = ShapeEstimate(
            distance=mean[:, 0],
            normal=unit(mean[:, 1:]),
            variance=variance,
            covariance=spread,
            std_m=self.std_factor * self.scale * torch.sqrt(variance),
        )
        fields = {f.name: getattr(found, f.name).to(points.dtype) for f in dataclasses.fields(found)}
        shaped = {name: t.reshape(points.shape[:-1] + t.shape[1:]) for name, t in fields.items()}
        return ShapeEstimate(**shaped)

    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return the mean to second order and the variance to first, for planners: no check, no autograd.

        With d = x - x_j, r = |d|, the mean is sum_j a_j k + 6 (psi - r) d.b_j, its weights being (a, b). The
        gradient of the variance k0 - k*^T A k* is -2 times the gradient of the mean with weights A k*.

        Args:
            x: points in the normalised frame, float64.
        """
        # Small chunks keep every temporary in the cache of a CPU core.
        chunk = 256 if x.device.type == "cpu" else 16384
        return SurfaceJet(*_in_chunks(self._jet, x, chunk))

    def mean(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
        """Return the mean signed distance alone, normalised, at normalised points: for grids of many points."""

        def evaluate(x: Tensor) -> tuple[Tensor]:
            n, oriented = len(self.x), int(self.has_normal.sum())
            b = self.weights[n:].reshape(3, oriented).T
            r = torch.cdist(x, self.x, compute_mode="donot_use_mm_for_euclid_dist")
            along = x @ b.T - (self.x[:oriented] * b).sum(-1)
            return (thin_plate(r, self.psi) @ self.weights[:n] - (6.0 * (r[:, :oriented] - self.psi) * along).sum(1),)

        return _in_chunks(evaluate, x, 2048)[0]

    def _estimate(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]:
        """Return the mean and the covariance of (d, w), Eqs. (7)-(8), normalised."""
        profile = partial(thin_plate, psi=self.psi)
        everywhere = torch.ones(len(x), dtype=torch.bool, device=x.device)
        cross = covariance(x, self.x, everywhere, self.has_normal, profile)
        mean = (cross @ self.weights).reshape(4, len(x)).T
        whitened = torch.linalg.solve_triangular(self.factor, cross.T, upper=False)
        whitened = whitened.reshape(len(self.factor), 4, len(x)).permute(2, 1, 0)
        here, yes = x.new_zeros(1, 3), everywhere.new_ones(1)
        prior = covariance(here, here, yes, yes, profile)
        return mean, prior - whitened @ whitened.transpose(-1, -2)

    def _jet(self, x: Float[Tensor, "q 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the fields of `SurfaceJet` for one chunk."""
        n, oriented = len(self.x), int(self.has_normal.sum())
        near = slice(0, oriented)  # the points with normals come first
        a, b = self.weights[:n], self.weights[n:].reshape(3, oriented)
        d = [x[:, m, None] - self.x[None, :, m] for m in range(3)]
        squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        r = torch.sqrt(squared)
        inverse = torch.where(r > 0, 1.0 / r, 0.0)
        slope = 6.0 * (r - self.psi)  # k'/r
        k = squared * (2.0 * r - 3.0 * self.psi) + self.psi**3
        row = torch.cat([k] + [-slope[:, near] * d[m][:, near] for m in range(3)], 1)
        distance = row @ self.weights

        def gradient_of(a: Tensor, b: list[Tensor], along: Tensor) -> Tensor:
            """Sum a_j k'/r d - 6 (d.b_j) d / r - k'/r b_j over the points; `along` is d.b_j."""
            c = slope * a
            c[:, near] -= 6.0 * inverse[:, near] * along
            return torch.stack([(c * d[m]).sum(1) - (slope[:, near] * b[m]).sum(1) for m in range(3)], 1)

        along = d[0][:, near] * b[0] + d[1][:, near] * b[1] + d[2][:, near] * b[2]
        gradient = gradient_of(a, [b[0], b[1], b[2]], along)

        trace = slope @ a - 6.0 * (inverse[:, near] * along).sum(1)
        outer = 6.0 * inverse * a
        outer[:, near] += 6.0 * inverse[:, near] ** 3 * along
        tilt = 6.0 * inverse[:, near]
        hessian = torch.empty(len(x), 3, 3, dtype=x.dtype, device=x.device)
        scaled = [outer * d[m] for m in range(3)]
        tilted = [(tilt * d[m][:, near]) @ b.T for m in range(3)]
        for m in range(3):
            for p in range(m, 3):
                entry = (scaled[m] * d[p]).sum(1) - tilted[m][:, p] - tilted[p][:, m]
                hessian[:, m, p] = hessian[:, p, m] = entry + trace if m == p else entry

        solved = row @ self.precision
        variance = self.psi**3 - (solved * row).sum(1)
        u = [solved[:, n + m * oriented : n + (m + 1) * oriented] for m in range(3)]
        along = d[0][:, near] * u[0] + d[1][:, near] * u[1] + d[2][:, near] * u[2]
        return distance, gradient, hessian, variance, -2.0 * gradient_of(solved[:, :n], u, along)


def condition(
    observations: Observations,
    center: Float[Tensor, "3"],
    scale: float,
    cloud: PointCloud,
    psi_scale: float = 1.5,
    std_factor: float = 1.0,
) -> ShapeGP:
    """Return the posterior given observations, with psi = `psi_scale` times their longest distance.

    Args:
        observations: of the surface, normalised.
        center: origin of the normalised frame [m].
        scale: length [m] of the normalised unit.
        cloud: what was seen.
        psi_scale: 1 is the paper's psi, for which the covariance is indefinite.
        std_factor: see `ShapeGP`.

    Raises:
        IndefiniteCovariance: psi is too small for these observations.
    """
    order = torch.argsort(~observations.has_normal, stable=True)
    fields = {f.name: getattr(observations, f.name)[order].to(center) for f in dataclasses.fields(observations)}
    fields["has_normal"] = observations.has_normal[order].to(center.device)
    observations = Observations(**fields)
    x, has_normal = observations.x, observations.has_normal
    psi = psi_scale * longest_distance(x)
    prior = covariance(x, x, has_normal, has_normal, partial(thin_plate, psi=psi))
    y, noise = observations.rows()
    if psi_scale < LEAST_PSI:
        # Generous noise on some rows can hide a kernel that is no covariance; the least noise must suffice.
        cholesky(prior + torch.diag_embed(torch.full_like(noise, float(noise.min()))), "the covariance K", REMEDY)
    factor = cholesky(prior + torch.diag_embed(noise), "the covariance K + sigma^2 I", REMEDY)
    radius = REACH * float(torch.linalg.vector_norm(x, dim=-1).max())
    return ShapeGP(
        x=x,
        has_normal=has_normal,
        weights=torch.cholesky_solve(y[:, None], factor)[:, 0],
        factor=factor,
        precision=torch.cholesky_inverse(factor),
        center=center,
        psi=psi,
        scale=scale,
        domain_radius=min(psi / (2.0 * LEAST_PSI), radius),
        std_factor=std_factor,
        cloud=cloud,
    )


def longest_distance(x: Float[Tensor, "n 3"]) -> float:
    """Return the longest distance between two of the points.

    >>> longest_distance(torch.tensor([[0.0, 0, 0], [0, 3, 4]]))
    5.0
    """
    return float(torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").max())


def _check_queries(points: Any) -> Float[Tensor, "*b 3"]:
    """Return the query points; refuse what is no finite floating tensor of triples."""
    if not isinstance(points, Tensor) or points.ndim < 1 or points.shape[-1] != 3:
        found = f"shape {tuple(points.shape)}" if isinstance(points, Tensor) else type(points).__name__
        raise BadArgument("points", found, "a tensor of shape (..., 3)")
    check_tensor("points", points.reshape(-1, 3), (None, 3))
    return points


def _in_chunks(evaluate: Callable[[Tensor], tuple[Tensor, ...]], x: Tensor, size: int) -> tuple[Tensor, ...]:
    """Evaluate a function of the leading axis piece by piece, so that memory stays bounded."""
    parts = [evaluate(piece) for piece in x.split(size)] if len(x) else [evaluate(x)]
    return tuple(torch.cat(column) for column in zip(*parts, strict=True))
