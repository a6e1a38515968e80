"""Maximum-likelihood fitting of Gaussian mixtures by expectation-maximisation (Eqs. 19-20), for standardised data.

Both steps are one matrix product each over the features [1, x, x_i x_j]: the log-density of a Gaussian is linear in
them, and their responsibility-weighted sums are all that the maximisation needs. That halves the work of whitening
and keeps the statistics of a step small enough to be summed over processes. The features cancel unless every column
of the data has mean 0 and variance 1, which the caller sees to.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import IndefiniteCovariance
from torchgrasp.linalg import cholesky
from torchgrasp.posture_model.shard import Shard

ROWS = 2048
"""Rows of one pass: features and responsibilities of so many rows stay in the cache."""

SINGULAR = 1e-12
"""A variance, given the dimensions before it, that is rounding beside the data's variance of 1."""

RESEEDS = 3
"""How often a component that collapses is placed anew before that is an error."""


@dataclasses.dataclass(frozen=True)
class Components(Value):
    """Weights, means and covariances of m Gaussians in d dimensions (Eqs. 19-20)."""

    weights: Float[Tensor, "m"]
    means: Float[Tensor, "m d"]
    covariances: Float[Tensor, "m d d"]


@dataclasses.dataclass(frozen=True)
class Progress(Value):
    """Where a fit stands: all that its next step depends on but for the data.

    Args:
        components: after the steps so far.
        reseeded: how often each component was placed anew.
        log_likelihood: the mean over the data before each of those steps [nats].
        jumped: whether the last step placed a component anew, after which the likelihood may have fallen.
    """

    components: Components
    reseeded: Int[Tensor, "m"]
    log_likelihood: Float[Tensor, "t"]
    jumped: bool = False


@dataclasses.dataclass(frozen=True)
class Fit(Progress):
    """A fitted mixture; the last log-likelihood is that of the components themselves."""

    converged: bool = False


def expectation_maximisation(
    shard: Shard,
    start: Progress,
    iterations: int,
    tolerance: float,
    regularisation: float,
    observer: Callable[[Progress], None] = lambda progress: None,
) -> Fit:
    """Iterate until the mean log-likelihood gains less than `tolerance` in a step.

    Args:
        shard: standardised data.
        start: where to begin, or to go on.
        iterations: most steps, those already taken included.
        tolerance: of the mean log-likelihood [nats].
        regularisation: added to every diagonal of a covariance, relative to the data's variance of 1.
        observer: called after every step.

    Raises:
        IndefiniteCovariance: a component collapsed more than `RESEEDS` times, or the start is indefinite.
    """
    n = shard.count()
    state = start
    while True:
        sums, log_likelihood = expectation(shard, state.components)
        history = torch.cat([state.log_likelihood, (log_likelihood / n)[None]])
        converged = len(history) > 1 and not state.jumped and float(history[-1] - history[-2]) < tolerance
        if converged or len(history) > iterations:
            return Fit(state.components, state.reseeded, history, state.jumped, converged)
        components, reseeded = maximisation(sums, n, regularisation, state.reseeded)
        jumped = not torch.equal(reseeded, state.reseeded)
        state = Progress(components, reseeded, history, jumped)
        observer(state)


def expectation(shard: Shard, components: Components) -> tuple[Float[Tensor, "m f"], Float[Tensor, ""]]:
    """Return the responsibility-weighted sums of the features, and the total log-likelihood of Eq. (19)."""
    x, coefficients = shard.rows, coefficients_from_components(components)
    sums, log_likelihood = torch.zeros_like(coefficients), x.new_zeros(())
    features = x.new_empty(coefficients.shape[1], min(ROWS, len(x)))  # written anew in every pass, and kept in cache
    joint = x.new_empty(len(coefficients), min(ROWS, len(x)))
    least = math.log(torch.finfo(x.dtype).tiny) / 2  # far below rounding; underflow and what is near it are slow
    for rows in x.split(ROWS):
        phi = features_from_data(rows, features[:, : len(rows)])
        responsibility = torch.mm(coefficients, phi, out=joint[:, : len(rows)])  # log joint density (m, rows), so far
        # log-sum-exp by hand: its exponentials are the responsibilities but for a division
        largest = responsibility.amax(0)
        density = responsibility.sub_(largest).clamp_(min=least).exp_().sum(0)
        sums.addmm_(responsibility.div_(density), phi.T)
        log_likelihood += (density.log() + largest).sum()
    both = shard.sum(torch.cat([sums.flatten(), log_likelihood[None]]))
    return both[:-1].reshape(sums.shape), both[-1]


def features_from_data(x: Float[Tensor, "n d"], out: Float[Tensor, "f n"] | None = None) -> Float[Tensor, "f n"]:
    """Return [1, x_i, x_i x_j (i <= j)] of every row, one column a row, in `out` where it is given."""
    n, d = x.shape
    out = x.new_empty(1 + d + d * (d + 1) // 2, n) if out is None else out
    out[0] = 1
    columns = out[1 : 1 + d].copy_(x.T)
    products = out[1 + d :].split(list(range(d, 0, -1)))
    for i, product in enumerate(products):
        torch.mul(columns[i:], columns[i], out=product)
    return out


def coefficients_from_components(components: Components) -> Float[Tensor, "m f"]:
    """Return the coefficients that turn features into log(weight) + log N(x | mean, covariance), Eq. (19).

    Raises:
        IndefiniteCovariance: a covariance is not positive definite.
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


def maximisation(
    sums: Float[Tensor, "m f"], n: int, regularisation: float, reseeded: Int[Tensor, "m"]
) -> tuple[Components, Int[Tensor, "m"]]:
    """Return the components of greatest likelihood for the weighted sums, the collapsed ones placed anew.

    A component has collapsed when the responsibilities for it add up to less than the d + 1 rows that span a
    covariance, or when its covariance is singular. It then takes half of the heaviest component, which is split
    across its longest axis. No data are needed for that, so that every process does the same.

    Raises:
        IndefiniteCovariance: every component collapsed, or one of them more than `RESEEDS` times.
    """
    components = components_from_sums(sums, n, regularisation)
    weights, means, covariances = components.weights.clone(), components.means.clone(), components.covariances.clone()
    factor, info = torch.linalg.cholesky_ex(covariances)
    regular = (info == 0) & (factor.diagonal(dim1=-2, dim2=-1) ** 2 > SINGULAR).all(-1)
    collapsed = (sums[:, 0] < means.shape[1] + 1) | ~regular
    reseeded = reseeded + collapsed
    if bool(collapsed.all()) or int(reseeded.max()) > RESEEDS:
        k = int(reseeded.argmax())
        smallest = float(torch.linalg.eigvalsh(covariances[k]).min()) if bool(covariances[k].isfinite().all()) else 0.0
        what = f"the covariance of component {k}, of {float(sums[k, 0]):.1f} rows, collapsed {int(reseeded[k])} times,"
        raise IndefiniteCovariance(what, smallest, "use fewer components or more samples")
    weights[collapsed] = 0
    for k in collapsed.nonzero()[:, 0].tolist():
        heaviest = int(weights.argmax())
        spread, axes = torch.linalg.eigh(covariances[heaviest])
        half = 0.5 * spread[-1].sqrt() * axes[:, -1]
        weights[[k, heaviest]] = weights[heaviest] / 2
        means[k], means[heaviest] = means[heaviest] + half, means[heaviest] - half
        covariances[k] = covariances[heaviest]
    return Components(weights / weights.sum(), means, covariances), reseeded


def components_from_sums(sums: Float[Tensor, "m f"], n: int, regularisation: float) -> Components:
    """Return weights, means and covariances from the weighted sums of the features; a component without data is NaN."""
    # The features determine d: 1 + d + d (d + 1) / 2 of them.
    d = round((math.sqrt(8 * sums.shape[1] + 1) - 3) / 2)
    count = sums[:, :1]
    means = sums[:, 1 : d + 1] / count
    i, j = torch.triu_indices(d, d, device=sums.device)
    second = sums.new_zeros(len(sums), d, d)
    second[:, i, j] = sums[:, d + 1 :] / count
    second[:, j, i] = second[:, i, j]
    covariances = second - means[:, :, None] * means[:, None, :]
    covariances = covariances + regularisation * torch.eye(d, dtype=sums.dtype, device=sums.device)
    return Components(count[:, 0] / n, means, covariances)
