"""Learning what a hand can reach from sampled postures (Eqs. 19-20, Sec. 6.3)."""

import dataclasses
import math

from torchgrasp.base import check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.hand.code import CODE_NAMES
from torchgrasp.hand.em import expectation_maximisation, start_components
from torchgrasp.hand.mixture import GraspMixture
from torchgrasp.hand.sample import HandSamples


def fit_mixture(
    samples: HandSamples,
    components: int,
    seed: int = 0,
    iterations: int = 300,
    tolerance: float = 1e-3,
    regularisation: float = 1e-6,
) -> GraspMixture:
    """Fit the mixture of Eqs. (19)-(20) to sampled postures by expectation-maximisation from a k-means start.

    Args:
        samples: postures and their codes, more of them than the mixture has free numbers in one component.
        components: m, the number of Gaussians.
        seed: of the start.
        iterations: most steps.
        tolerance: stop when the mean log-likelihood gains less in a step [nats].
        regularisation: variance added to every dimension of a component, relative to that dimension's variance over
            all samples. It is kept in the result.

    Returns:
        The mixture; `meta` tells iterations, convergence, mean log-likelihood and BIC.

    Raises:
        BadArgument: too few samples, a joint that does not vary, a number outside its range.
        IndefiniteCovariance: a component collapsed onto a few samples.

    >>> import torch
    >>> numbers = torch.rand(500, 7, generator=torch.Generator().manual_seed(0))
    >>> fit_mixture(HandSamples(numbers[:, :1], numbers[:, 1:], ("knuckle",)), components=2).joint_names
    ('knuckle',)
    """
    x = samples.rows().double()
    n, d = x.shape
    least = d + 2  # a covariance of d dimensions from fewer samples is singular
    if n < least:
        raise BadArgument("samples", f"{n} samples", f"at least {least}")
    check_tensor("samples", x, (n, d))
    for name, value, low, high in [
        ("components", components, 1, n // least),
        ("iterations", iterations, 1, 100_000),
        ("tolerance", tolerance, 0.0, 1.0),
        ("regularisation", regularisation, 0.0, 1e-2),
    ]:
        if not low <= value <= high:
            raise BadArgument(name, value, f"a number in [{low:g}, {high:g}]")
    centre, scale = x.mean(0), x.std(0, correction=0)
    names = (*samples.joint_names, *CODE_NAMES)
    constant = (scale <= 1e-9 * (1 + centre.abs())).tolist()
    if any(constant):
        found = ", ".join(name for name, c in zip(names, constant, strict=True) if c)
        raise BadArgument("samples", f"no variation in {found}", "samples that vary in every dimension")
    standard = (x - centre) / scale
    start = start_components(standard, components, seed, regularisation)
    fit = expectation_maximisation(standard, start, iterations, tolerance, regularisation)
    found = fit.components
    mixture = GraspMixture(
        weights=found.weights / found.weights.sum(),
        means=found.means * scale + centre,
        covariances=found.covariances * scale[:, None] * scale,
        names=names,
        regularisation=regularisation,
    )
    report = {
        **samples.meta,
        "samples": str(n),
        "fit_seed": str(seed),
        "iterations": str(len(fit.log_likelihood) - 1),
        "converged": str(fit.converged).lower(),
        "log_likelihood": f"{float(fit.log_likelihood[-1] - scale.log().sum()):.6f}",
        "bic": f"{bic(mixture, samples):.1f}",
    }
    return dataclasses.replace(mixture, meta=report)


def bic(mixture: GraspMixture, samples: HandSamples) -> float:
    """Return the Bayesian information criterion of a mixture on samples; less is better.

    Codes are exact functions of the joints, so that it keeps falling with the number of components: read its elbow
    beside the error on held-out postures, not its minimum.
    """
    m, d = mixture.means.shape
    free = (m - 1) + m * d + m * d * (d + 1) // 2
    x = samples.rows().double()
    return float(-2 * mixture.log_prob(x).sum() + free * math.log(len(x)))
