"""From observations to the posterior of a shape, Eqs. (7)-(9)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Positive, checked
from torchgrasp.geometry.linalg import cholesky
from torchgrasp.shape.gp import Normalisation, ShapeGP
from torchgrasp.shape.gradient_kernel import gram
from torchgrasp.shape.kernel import Kernel, KernelName, kernel_by_name
from torchgrasp.shape.observations import Observations
from torchgrasp.shape.posterior import Posterior
from torchgrasp.values import PointCloud


@checked
def condition(
    observations: Observations,
    normalisation: Normalisation,
    cloud: PointCloud,
    psi_scale: Positive = 1.5,
    std_factor: Positive = 1.0,
    kernel: KernelName | Kernel = "thin_plate",
) -> ShapeGP:
    """Return the shape given normalised observations.

    Args:
        psi_scale: psi over the longest distance of the observations; 1 is the paper's, whose covariance is indefinite.
        kernel: a name (see `kernel_by_name`), or any `Kernel` of normalised distances.

    Raises:
        BadArgument: an unknown kernel.
        IndefiniteCovariance: psi is too small for these observations.

    >>> x, noise = torch.cat([torch.eye(3), -torch.eye(3)]).double() / 2, torch.full((6,), 0.01).double()
    >>> seen = Observations(x, 0 * noise, 2 * x, noise > 0, noise, noise)
    >>> shape = condition(seen, Normalisation(torch.zeros(3).double(), 0.05), PointCloud(0.05 * x))
    >>> shape.predict(0.05 * x[:2]).distance.abs() < 0.01
    tensor([True, True])
    """
    observations = observations.to(normalisation.center)
    psi = psi_scale * longest_distance(observations.x)
    kernel = kernel_by_name(kernel, psi) if isinstance(kernel, str) else kernel
    posterior = posterior_given(observations, kernel)
    check_kernel(posterior, observations.least_noise)
    return ShapeGP.of(posterior, normalisation, cloud, psi, std_factor)


def posterior_given(observations: Observations, kernel: Kernel) -> Posterior:
    """Return the posterior given observations, by one Cholesky factorisation of their covariance."""
    observations = observations.with_normals_first()
    y, noise = observations.rows()
    matrix = gram(kernel, observations.x, int(observations.has_normal.sum()))
    matrix.diagonal().add_(noise)
    factor = cholesky(matrix, "the covariance K + sigma^2 I", kernel.remedy)
    weights = torch.cholesky_solve(y[:, None], factor)[:, 0]
    return Posterior(observations.x, observations.has_normal, weights, factor, None, kernel)


def check_kernel(posterior: Posterior, least_noise: float) -> None:
    """Refuse observations beyond the kernel's diameter, unless K is positive definite.

    Generous noise on some rows can hide an indefinite K: K is factored again with the least noise of all rows.
    """
    kernel = posterior.kernel
    if longest_distance(posterior.x) > kernel.diameter:
        matrix = gram(kernel, posterior.x, posterior.n_oriented)
        matrix.diagonal().add_(least_noise**2)
        cholesky(matrix, "the covariance K", kernel.remedy)


def longest_distance(x: Float[Tensor, "n 3"]) -> float:
    """Return the longest distance between two of the points."""
    return float(torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").max())
