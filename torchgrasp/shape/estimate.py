"""Value classes of a shape: its normalised frame, its observations and its estimates."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Batch, Value
from torchgrasp.foundation.checks import checked
from torchgrasp.geometry.linalg import Points, unit
from torchgrasp.shape.kernel import Queries

MeanAndGradient = tuple[Float[Tensor, "q"], Queries]
"""The mean signed distance at each query point, and its gradient."""
Moments = tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]
"""Mean and covariance of distance and gradient (d, w) at each query point."""


@dataclasses.dataclass(frozen=True)
class Normalisation(Value):
    """A normalised frame without units: points [m] minus `center` [m], divided by `scale` [m].

    >>> frame = Normalisation(torch.tensor([0.0, 0.0, 0.1]), scale=0.05)
    >>> frame.normalise(torch.tensor([0.0, 0.0, 0.15])), frame.metres(torch.tensor([0.0, 0.0, 1.0]))
    (tensor([0.0000, 0.0000, 1.0000]), tensor([0.0000, 0.0000, 0.1500]))
    """

    center: Float[Tensor, "3"]
    scale: float

    @checked(gradients=True)
    def normalise(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b 3"]:
        """Return points [m], given in the cloud's frame, in the normalised frame (centred and
        scaled).
        """
        return (points - self.center.to(points)) / self.scale

    @checked(gradients=True)
    def metres(
        self,
        x: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b 3"]:
        """Return normalised points in the cloud's frame [m]."""
        return x * self.scale + self.center.to(x)


@checked
@dataclasses.dataclass(frozen=True)
class Observations(Batch):
    """Observed signed distances at points, and observed normals where `has_normal`; all normalised.

    The noises are standard deviations.

    >>> x, some = torch.eye(3), torch.ones(3)
    >>> len(Observations(x, 0 * some, x, some > 0, 0.01 * some, 0.05 * some).rows()[0])
    12
    """

    x: Points
    distance: Float[Tensor, "n"]
    normal: Points
    has_normal: Bool[Tensor, "n"]
    distance_noise: Float[Tensor, "n"]
    normal_noise: Float[Tensor, "n"]

    def rows(self) -> tuple[Float[Tensor, "rows"], Float[Tensor, "rows"]]:
        """Return all observed values and the variances of their noise: first distances, then
        normals by component.
        """
        y = torch.cat([self.distance, self.normal[self.has_normal].T.reshape(-1)])
        noise = torch.cat([self.distance_noise, self.normal_noise[self.has_normal].repeat(3)])
        return y, noise * noise

    @property
    def least_noise(self) -> float:
        """The least standard deviation of the noise of all observed values."""
        every = torch.cat([self.distance_noise, self.normal_noise[self.has_normal]])
        return float(every.detach().min())

    def with_normals_first(self) -> "Observations":
        """Return the observations in another order: first those with normals."""
        return self[torch.argsort(~self.has_normal, stable=True)]


def on_surface(
    x: Points,
    normals: Points,
    noise: Float[Tensor, "n"],
    normal_noise: float,
) -> Observations:
    """Return observations of points on the surface (distance 0) with their normals."""
    yes = torch.ones(len(x), dtype=torch.bool, device=x.device)
    return Observations(
        x, torch.zeros_like(noise), normals, yes, noise, torch.full_like(noise, normal_noise)
    )


def off_surface(
    x: Points,
    distance: Float[Tensor, "n"],
    noise: float,
) -> Observations:
    """Return observations of signed distances at points off the surface, without normals."""
    no = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    sigma = torch.full_like(distance, noise)
    return Observations(x, distance, torch.zeros_like(x), no, sigma, sigma)


@dataclasses.dataclass(frozen=True)
class MeanJet(Batch):
    """The posterior mean of the signed distance at points, with its gradient and Hessian.

    The derivatives are by normalised coordinates (centred and scaled). Gradients need not have unit
    length.
    """

    distance: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 3"]
    hessian: Float[Tensor, "*b 3 3"]

    @property
    def normals(self) -> Float[Tensor, "*b 3"]:
        """The outward unit normals, Eq. (11) of the paper."""
        return unit(self.gradient)

    @property
    def normal_jacobian(self) -> Float[Tensor, "*b 3 3"]:
        """The derivatives of the normals by the points, (1 - n n^T) H / |g|, with normal n, Hessian
        H, gradient g.
        """
        n = self.normals
        steep = torch.linalg.vector_norm(self.gradient, dim=-1)[..., None, None]
        along = n[..., :, None] * (n[..., None, :] @ self.hessian)
        return (self.hessian - along) / steep


@dataclasses.dataclass(frozen=True)
class SurfaceJet(MeanJet):
    """The mean distance with two derivatives, and its variance with one."""

    variance: Float[Tensor, "*b"]
    variance_gradient: Float[Tensor, "*b 3"]


@dataclasses.dataclass(frozen=True)
class JointEstimate(Value):
    """The joint posterior of distance and gradient (d, w) at k points, normalised, ordered by
    point.

    The gradient w need not have unit length. Points i and j have the block `covariance.reshape(k,
    4, k, 4)[i, :, j]`.
    """

    mean: Float[Tensor, "k 4"]
    covariance: Float[Tensor, "rows rows"]


@dataclasses.dataclass(frozen=True)
class ShapeDerivatives(Value):
    """Derivatives of a `ShapeEstimate` by the query point, per metre: `normal[i, j]` is d normal_i
    / d point_j.
    """

    distance: Float[Tensor, "*b 3"]
    normal: Float[Tensor, "*b 3 3"]
    variance: Float[Tensor, "*b 3"]
    std_m: Float[Tensor, "*b 3"]


def surface_deviation(
    variance: Float[Tensor, "*b"],
    gradient: Float[Tensor, "*b 3"],
) -> Float[Tensor, "*b"]:
    """Return the standard deviation of the surface along its normal, linearised from the distance's
    variance.
    """
    return variance.sqrt() / torch.linalg.vector_norm(gradient, dim=-1)
