"""Maximum-likelihood fitting of Gaussian mixtures by expectation-maximisation (Eqs. 19-20), for standardised data.

Both steps are one matrix product each over the features [1, x, x_i x_j]: the log-density of a Gaussian is linear in
them, and their responsibility-weighted sums are all that the maximisation needs. That halves the work of whitening
and keeps the statistics of a step small enough to be summed over machines. The features cancel unless every column
of the data has mean 0 and variance 1, which the caller sees to.
"""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument, IndefiniteCovariance
from torchgrasp.linalg import cholesky

ROWS = 1024
"""Rows of one pass: features and responsibilities of so many rows stay in the cache."""


@dataclasses.dataclass(frozen=True)
class Components(Value):
    """Weights, means and covariances of m Gaussians in d dimensions (Eqs. 19-20)."""

    weights: Float[Tensor, "m"]
    means: Float[Tensor, "m d"]
    covariances: Float[Tensor, "m d d"]


@dataclasses.dataclass(frozen=True)
class Fit(Value):
    """A fitted mixture and the mean log-likelihood before each step, the last one after the last step."""

    components: Components
    log_likelihood: Float[Tensor, "t"]
    converged: bool


def features_from_data(x: Float[Tensor, "n d"]) -> Float[Tensor, "f n"]:
    """Return [1, x_i, x_i x_j (i <= j)] of every row, one column a row."""
    columns = x.T
    i, j = torch.triu_indices(x.shape[1], x.shape[1], device=x.device)
    return torch.cat([torch.ones_like(columns[:1]), columns, columns[i] * columns[j]])


def coefficients_from_components(components: Components) -> Float[Tensor, "m f"]:
    """Return the coefficients that turn features into log(weight) + log N(x | mean, covariance), Eq. (19).

    Raises:
        IndefiniteCovariance: a component collapsed.
    """
    means, d = components.means, components.means.shape[1]
    factor = cholesky(components.covariances, "a component's covariance", "use fewer components or more samples")
    eye = torch.eye(d, dtype=means.dtype, device=means.device)
    whitening = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    precision = whitening.transpose(-1, -2) @ whitening
    linear = (precision @ means[..., None])[..., 0]
    constant = (
        components.weights.log()
        - 0.5 * d * math.log(2 * math.pi)
        + whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        - 0.5 * (linear * means).sum(-1)
    )
    i, j = torch.triu_indices(d, d, device=means.device)
    quadratic = precision[:, i, j] * torch.where(i == j, -0.5, -1.0)  # each mixed product stands for two
    return torch.cat([constant[:, None], linear, quadratic], dim=1)


def components_from_sums(sums: Float[Tensor, "m f"], n: int, regularisation: float) -> Components:
    """Maximise: weights, means and covariances from the weighted sums of the features."""
    # The features determine d: 1 + d + d (d + 1) / 2 of them.
    d = round((math.sqrt(8 * sums.shape[1] + 1) - 3) / 2)
    count = sums[:, :1]
    if bool((count[:, 0] < 1e-8).any()):
        raise IndefiniteCovariance("the covariance of a component without data", 0.0, "use fewer components")
    means = sums[:, 1 : d + 1] / count
    i, j = torch.triu_indices(d, d, device=sums.device)
    second = sums.new_zeros(len(sums), d, d)
    second[:, i, j] = sums[:, d + 1 :] / count
    second[:, j, i] = second[:, i, j]
    covariances = second - means[:, :, None] * means[:, None, :]
    covariances = covariances + regularisation * torch.eye(d, dtype=sums.dtype, device=sums.device)
    return Components(count[:, 0] / n, means, covariances)


def expectation(x: Float[Tensor, "n d"], components: Components) -> tuple[Float[Tensor, "m f"], Float[Tensor, ""]]:
    """Return the responsibility-weighted sums of the features, and the total log-likelihood of Eq. (19)."""
    coefficients = coefficients_from_components(components)
    sums = torch.zeros_like(coefficients)
    total = x.new_zeros(())
    for rows in x.split(ROWS):
        features = features_from_data(rows)
        log_joint = coefficients @ features  # (m, rows)
        # log-sum-exp by hand: its exponentials are the responsibilities but for a division
        largest = log_joint.amax(0)
        scaled = (log_joint - largest).exp()
        density = scaled.sum(0)
        sums += (scaled / density) @ features.T
        total += (density.log() + largest).sum()
    return sums, total


def expectation_maximisation(
    x: Float[Tensor, "n d"], start: Components, iterations: int, tolerance: float, regularisation: float
) -> Fit:
    """Iterate until the mean log-likelihood gains less than `tolerance` in a step.

    Args:
        x: standardised data.
        start: where to begin.
        iterations: most steps.
        tolerance: of the mean log-likelihood [nats].
        regularisation: added to every diagonal of a covariance, relative to the data's variance of 1.

    Raises:
        IndefiniteCovariance: a component collapsed.
    """
    components, history, converged = start, [], False
    for _ in range(iterations):
        sums, total = expectation(x, components)
        history.append(total / len(x))
        if len(history) > 1 and float(history[-1] - history[-2]) < tolerance:
            converged = True
            break
        components = components_from_sums(sums, len(x), regularisation)
    if not converged:
        history.append(expectation(x, components)[1] / len(x))
    return Fit(components, torch.stack(history), converged)


def nearest(x: Float[Tensor, "n d"], centres: Float[Tensor, "m d"]) -> Tensor:
    """Return the index of the nearest centre of every row."""
    return torch.cat([(0.5 * (centres**2).sum(1) - rows @ centres.T).argmin(1) for rows in x.split(ROWS)])


def start_components(
    x: Float[Tensor, "n d"], m: int, seed: int, regularisation: float, subsample: int = 20_000, rounds: int = 10
) -> Components:
    """Return a start from k-means: centres by k-means++ on a subsample, then `rounds` of Lloyd on all the data.

    Raises:
        BadArgument: fewer different rows than components.
    """
    generator = torch.Generator().manual_seed(seed)
    pool = x[torch.randperm(len(x), generator=generator)[:subsample].to(x.device)]
    centres = pool[:1]
    squared = ((pool - centres) ** 2).sum(1)
    for k in range(1, m):
        if not bool((squared > 0).any()):
            raise BadArgument("components", m, f"at most {k}, the number of different rows of the data")
        pick = torch.multinomial(squared.cpu(), 1, generator=generator).to(x.device)
        centres = torch.cat([centres, pool[pick]])
        squared = torch.minimum(squared, ((pool - pool[pick]) ** 2).sum(1))
    for _ in range(rounds):
        label = nearest(x, centres)
        count = torch.bincount(label, minlength=m)[:, None]
        moved = torch.zeros_like(centres).index_add(0, label, x) / count
        centres = torch.where(count > 0, moved, centres)  # a centre without data stays where it is
    label = nearest(x, centres)
    sums = torch.zeros(m, 1 + x.shape[1] * (x.shape[1] + 3) // 2, dtype=x.dtype, device=x.device)
    for rows, labels in zip(x.split(ROWS), label.split(ROWS), strict=True):
        sums = sums.index_add(0, labels, features_from_data(rows).T)
    return components_from_sums(sums, len(x), regularisation)
