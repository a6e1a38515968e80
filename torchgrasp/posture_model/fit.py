"""Learning what a hand can reach from sampled postures (Eqs. 19-20, Sec. 6.3)."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.posture_model.allreduce import AllReduce, choose_allreduce, device_of
from torchgrasp.posture_model.checkpoint import Checkpoint
from torchgrasp.posture_model.em import Fit, Progress, expectation_maximisation
from torchgrasp.posture_model.encoding import CODE_NAMES
from torchgrasp.posture_model.kmeans import start_components
from torchgrasp.posture_model.mixture import GraspMixture
from torchgrasp.posture_model.sample import HandSamples

LARGEST_REGULARISATION = 1e-6
"""Most variance that may be added to a dimension of a component, relative to that dimension's over all samples."""

TRIAL_STEPS = 20
"""Steps by which starts are compared, where there are several."""


def fit_mixture(
    samples: HandSamples,
    components: int,
    seed: int = 0,
    iterations: int = 300,
    tolerance: float = 1e-3,
    regularisation: float = LARGEST_REGULARISATION,
    *,
    starts: int = 1,
    checkpoint: Path | str | None = None,
    distributed: bool = False,
    observer: Callable[[Progress], None] = lambda progress: None,
) -> GraspMixture:
    """Fit the mixture of Eqs. (19)-(20) to sampled postures by expectation-maximisation from a k-means start.

    A component that collapses is placed anew, at most three times.

    Args:
        samples: postures and their codes, more of them than the mixture has free numbers in one component.
        components: m, the number of Gaussians.
        seed: of the start.
        iterations: most steps.
        tolerance: stop when the mean log-likelihood gains less in a step [nats].
        regularisation: variance added to every dimension of a component, relative to that dimension's variance over
            all samples. It is kept in the result.
        starts: how many k-means starts, of seeds one after the other, take `TRIAL_STEPS` steps each; the likeliest of
            them goes on.
        checkpoint: file in which the fit is kept after every further step, and from which it goes on when the file
            exists: to the same bits on the same machine. More iterations or another tolerance may be asked of it then.
        distributed: whether `samples` are this process's share and sums go over all processes of torch.distributed's
            default group, as under torchrun; every process gets the same mixture. The checkpoint, if any, must be a
            file that all of them see.
        observer: called after every step, to show how far the fit is.

    Returns:
        The mixture; `meta` tells iterations, convergence, components placed anew, mean log-likelihood and BIC.

    Raises:
        BadArgument: too few samples, a joint that does not vary, a number outside its range, the checkpoint of another
            fit.
        ModelFileError: a damaged checkpoint.
        OutputError: the checkpoint cannot be written.
        IndefiniteCovariance: a component collapsed onto a few samples more than three times.

    >>> import torch
    >>> numbers = torch.rand(500, 7, generator=torch.Generator().manual_seed(0))
    >>> fit_mixture(HandSamples(numbers[:, :1], numbers[:, 1:], ("knuckle",)), components=2).joint_names
    ('knuckle',)
    """
    allreduce = choose_allreduce(distributed)
    x = samples.rows().double()
    check_tensor("samples", x, (len(samples), x.shape[1]))
    n, d = int(allreduce(x.new_tensor(len(x)))), x.shape[1]
    least = d + 2  # a covariance of d dimensions from fewer samples is singular
    if n < least:
        raise BadArgument("samples", f"{n} samples", f"at least {least}")
    for name, value, low, high in [
        ("components", components, 1, n // least),
        ("iterations", iterations, 1, 100_000),
        ("starts", starts, 1, 1000),
        ("tolerance", tolerance, 0.0, 1.0),
        ("regularisation", regularisation, 0.0, LARGEST_REGULARISATION),
    ]:
        if not low <= value <= high:
            raise BadArgument(name, value, f"a number in [{low:g}, {high:g}]")
    names = (*samples.joint_names, *CODE_NAMES)
    centre, scale = _standardise(x, n, names, allreduce)  # `rows` made a copy: the samples stay as they are

    kept = None
    if checkpoint is not None:
        kept = Checkpoint(Path(checkpoint), n, centre, scale, components, seed, starts, regularisation)
    start = _agreed(kept.load() if kept else None, x, allreduce)
    if start is None:
        begun = [start_components(x, components, seed + k, regularisation, allreduce) for k in range(starts)]
        start = _likeliest(x, begun, regularisation, allreduce)

    def observe(progress: Progress) -> None:
        if kept and device_of(allreduce)[0] == 0:
            kept.save(progress)
        observer(progress)

    fit = expectation_maximisation(x, start, iterations, tolerance, regularisation, allreduce, observe)
    found = fit.components
    mixture = GraspMixture(
        weights=found.weights,
        means=found.means * scale + centre,
        covariances=found.covariances * scale[:, None] * scale,
        names=names,
        regularisation=regularisation,
    )
    log_likelihood = float(fit.log_likelihood[-1] - scale.log().sum())
    return dataclasses.replace(mixture, meta=samples.meta | _report(fit, seed, starts, n, log_likelihood))


def bic(mixture: GraspMixture, samples: HandSamples) -> float:
    """Return the Bayesian information criterion of a mixture on samples; less is better.

    Codes are exact functions of the joints, so that it keeps falling with the number of components: read its elbow
    beside the error on held-out postures, not its minimum.
    """
    m, d = mixture.means.shape
    return _criterion(float(mixture.log_prob(samples.rows().double()).sum()), m, d, len(samples))


def _criterion(log_likelihood: float, m: int, d: int, n: int) -> float:
    """Return -2 log-likelihood + free parameters x log(n) for m full covariances in d dimensions."""
    free = (m - 1) + m * d + m * d * (d + 1) // 2
    return -2 * log_likelihood + free * math.log(n)


def _standardise(
    x: Float[Tensor, "n d"], n: int, names: tuple[str, ...], allreduce: AllReduce
) -> tuple[Float[Tensor, "d"], Float[Tensor, "d"]]:
    """Give every column mean 0 and variance 1, in place, and return what they were; refuse one that does not vary."""
    centre = allreduce(x.sum(0)) / n
    x.sub_(centre)
    scale = (allreduce(x.square().sum(0)) / n).sqrt()
    constant = (scale <= 1e-9 * (1 + centre.abs())).tolist()
    if any(constant):
        found = ", ".join(name for name, c in zip(names, constant, strict=True) if c)
        raise BadArgument("samples", f"no variation in {found}", "samples that vary in every dimension")
    x.div_(scale)
    return centre, scale


def _likeliest(
    x: Float[Tensor, "n d"], starts: list[Progress], regularisation: float, allreduce: AllReduce
) -> Progress:
    """Return the start whose likelihood is largest after some steps, with these steps taken."""
    if len(starts) == 1:
        return starts[0]
    tried = [expectation_maximisation(x, start, TRIAL_STEPS, 0.0, regularisation, allreduce) for start in starts]
    best = max(tried, key=lambda fit: float(fit.log_likelihood[-1]))
    return Progress(best.components, best.reseeded, best.log_likelihood[:-1], best.jumped)


def _agreed(progress: Progress | None, x: Tensor, allreduce: AllReduce) -> Progress | None:
    """Return what a checkpoint held, refusing processes that found different ones: they would wait for ever."""
    steps = x.new_tensor(len(progress.log_likelihood) if progress else 0)
    if not torch.equal(allreduce(steps), steps * device_of(allreduce)[1]):
        raise BadArgument("checkpoint", "a file that some processes see and others do not", "a file for all of them")
    return progress


def _report(fit: Fit, seed: int, starts: int, n: int, log_likelihood: float) -> dict[str, str]:
    """Return what a fit tells about itself; the mean log-likelihood is that in the samples' units."""
    m, d = fit.components.means.shape
    return {
        "samples": str(n),
        "fit_seed": str(seed),
        "fit_starts": str(starts),
        "iterations": str(len(fit.log_likelihood) - 1),
        "converged": str(fit.converged).lower(),
        "reseeded": str(int(fit.reseeded.sum())),
        "log_likelihood": f"{log_likelihood:.6f}",
        "bic": f"{_criterion(n * log_likelihood, m, d, n):.1f}",
    }
