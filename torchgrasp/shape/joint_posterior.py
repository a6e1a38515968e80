"""The joint posterior at several points, and samples from it."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import IndefiniteCovariance
from torchgrasp.shape.gradient_kernel import gram
from torchgrasp.shape.posterior import Posterior

ROUNDING = 1e-8
"""Negative eigenvalues of a covariance, over the prior variance, that are zero to rounding."""


@dataclasses.dataclass(frozen=True)
class JointEstimate(Value):
    """The joint posterior of (d, w) at k points, point by point and normalised.

    The gradient w has no unit length. Points i and j have the block `covariance.reshape(k, 4, k, 4)[i, :, j]`.

    >>> from torchgrasp import fit_shape, load_object
    >>> view = load_object("jug").view
    >>> joint = fit_shape(view).joint(view.points[:4])
    >>> joint.mean.shape, torch.linalg.eigvalsh(joint.covariance).min() > -1e-9
    (torch.Size([4, 4]), tensor(True))
    """

    mean: Float[Tensor, "k 4"]
    covariance: Float[Tensor, "rows rows"]


def joint_estimate(posterior: Posterior, x: Float[Tensor, "k 3"]) -> JointEstimate:
    """Return the joint posterior of (d, w) at normalised points, Eqs. (7)-(8)."""
    k = len(x)
    cross = posterior.cross(x)
    mean = (cross @ posterior.weights).T
    by_point = posterior.ordered(cross.transpose(0, 1).flatten(0, 1).T)
    whitened = torch.linalg.solve_triangular(posterior.factor, by_point, upper=False)
    prior = gram(posterior.kernel, x, k)
    prior = prior.reshape(4, k, 4, k).permute(1, 0, 3, 2).reshape(4 * k, 4 * k)
    return JointEstimate(mean, prior - whitened.T @ whitened)


def distance_covariance(posterior: Posterior, x: Float[Tensor, "b k 3"]) -> Float[Tensor, "b k k"]:
    """Return the covariance of the distances within sets of normalised points, Eq. (8)."""
    return combined_covariance(posterior, x[:, :, None], x.new_ones(1, 1, 1, 1))


def combined_covariance(
    posterior: Posterior, x: Float[Tensor, "b g p 3"], weights: Float[Tensor, "#b #g m p"]
) -> Float[Tensor, "b v v"]:
    """Return the covariance, within sets, of m weighted sums of the distances of each group of p points: v = g m."""
    (b, g, p), rows = x.shape[:3], len(posterior.factor)
    v, points = g * weights.shape[2], x.flatten(1, 2)
    cross = posterior.distance_rows(points.flatten(0, 1)).view(b, g, p, rows)
    whitened = posterior.whiten((weights @ cross).view(b * v, rows)).view(b, v, rows)  # the sums: they are fewer
    prior = posterior.kernel.profile(torch.linalg.vector_norm(points[:, :, None] - points[:, None], dim=-1))
    prior = weights @ prior.view(b, g, p, g * p)  # (b, g, m, g p)
    prior = weights @ prior.view(b, v, g, p).permute(0, 2, 3, 1)  # (b, g, m, v)
    return torch.baddbmm(prior.reshape(b, v, v), whitened, whitened.mT, alpha=-1.0)


def symmetric_root(covariance: Float[Tensor, "*b k k"], prior: float, remedy: str) -> Float[Tensor, "*b k k"]:
    """Return the symmetric root of covariances, unique even with equal eigenvalues.

    Coinciding points leave eigenvalues of zero, which rounding makes negative. Down to -`ROUNDING` times the `prior`
    variance they count as zero. `IndefiniteCovariance` is raised below, with the `remedy`.
    """
    values, vectors = torch.linalg.eigh(covariance)
    if values.numel() and not float(values.min()) >= -ROUNDING * prior:
        raise IndefiniteCovariance("the joint covariance", float(values.min()), remedy)
    return (vectors * torch.where(values > 0, values, 0.0).sqrt()[..., None, :]) @ vectors.mT


def draw_samples(joint: JointEstimate, prior: float, n: int, seed: int) -> Float[Tensor, "n k 4"]:
    """Draw n samples from a joint posterior; see `symmetric_root` for `prior` and errors."""
    root = symmetric_root(joint.covariance, prior, "query points within the domain")
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randn(n, len(root), dtype=torch.float64, generator=generator).to(root)
    return joint.mean + (draws @ root).reshape(n, *joint.mean.shape)
