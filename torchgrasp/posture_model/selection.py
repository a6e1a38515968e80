"""The number of Gaussians: Bayesian information criterion and cross-validation (Fig. 6 b, d).

The shipped models have the number of least criterion. Cross-validation, as in the paper's footnote 4, stands beside it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument
from torchgrasp.posture_model.fit import fit_mixture
from torchgrasp.posture_model.mixture import GraspMixture
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.posture_model.score import evaluate_mixture


@dataclasses.dataclass(frozen=True)
class BicCurve(Value):
    """The criterion for each number of components; less is better."""

    components: Int[Tensor, "k"]
    bic: Float[Tensor, "k"]

    def __str__(self) -> str:
        """Return the curve as a table, with its minimum."""
        rows = [f"  {m:3d} {b:14.0f}" for m, b in zip(self.components.tolist(), self.bic.tolist(), strict=True)]
        least = int(self.components[self.bic.argmin()])
        end = ", the largest asked for: no minimum is seen" if least == int(self.components.max()) else ""
        return "\n".join(["    m            BIC", *rows, f"least at {least}{end}"])


@dataclasses.dataclass(frozen=True)
class CrossValidation(Value):
    """Held-out mean log-likelihood [nats] and mean absolute error [rad] for each number of components and fold."""

    components: Int[Tensor, "k"]
    log_likelihood: Float[Tensor, "k f"]
    error: Float[Tensor, "k f"]

    def __str__(self) -> str:
        """Return means over the folds with their standard errors."""
        root = self.error.shape[1] ** 0.5
        head = f"    m  held-out log-likelihood   mean absolute error [rad]   ({self.error.shape[1]} folds)"
        rows = [
            f"  {int(m):3d}  {float(ll.mean()):10.4f} +- {float(ll.std()) / root:.4f}"
            f"      {float(e.mean()):8.4f} +- {float(e.std()) / root:.4f}"
            for m, ll, e in zip(self.components, self.log_likelihood, self.error, strict=True)
        ]
        return "\n".join([head, *rows])


def bic_curve(
    samples: HandSamples,
    components: Sequence[int] = tuple(range(5, 61)),
    *,
    checkpoints: Path | str | None = None,
    observer: Callable[[int, GraspMixture], None] = lambda m, mixture: None,
    **fit: Any,
) -> BicCurve:
    """Fit a mixture for each number of components and return their criterion (Fig. 6 b, d).

    Codes of the middles of pads are exact functions of the joints: the criterion then falls for ever. Where tips roll,
    it flattens and has a minimum.

    Args:
        samples: postures to fit.
        components: numbers to try.
        checkpoints: folder of the fits' checkpoints; a killed sweep continues from them.
        observer: called after each fit with its number of components and its mixture.
        fit: seed, iterations, tolerance and regularisation of `fit_mixture`.

    Raises:
        BadArgument: no number to try, or what `fit_mixture` refuses.
        IndefiniteCovariance, ModelFileError, OutputError: as `fit_mixture`.

    >>> numbers = torch.rand(500, 7, generator=torch.Generator().manual_seed(0))
    >>> bic_curve(HandSamples(numbers[:, :1], numbers[:, 1:], ("knuckle",)), (1, 2)).bic.shape
    torch.Size([2])
    """
    if not components:
        raise BadArgument("components", "none", "at least one number")
    criterion = []
    for m in components:
        checkpoint = None if checkpoints is None else Path(checkpoints) / f"em_{m}.safetensors"
        mixture = fit_mixture(samples, m, checkpoint=checkpoint, **fit)
        criterion.append(float(mixture.meta["bic"]))
        observer(m, mixture)
    return BicCurve(torch.tensor(list(components)), torch.tensor(criterion, dtype=torch.float64))


def cross_validate(
    samples: HandSamples,
    components: Sequence[int],
    folds: int = 10,
    seed: int = 0,
    *,
    observer: Callable[[int, int], None] = lambda m, fold: None,
    **fit: Any,
) -> CrossValidation:
    """Fit on all folds but one and evaluate on that one, for each number of components (footnote 4 of the paper).

    Args:
        samples: postures to divide.
        components: numbers to try.
        folds: number of parts.
        seed: of the division and of the starts.
        observer: called after each fit with its number of components and its fold.
        fit: iterations, tolerance and regularisation of `fit_mixture`.

    Raises:
        BadArgument: no number to try, folds outside [2, half the samples], or what `fit_mixture` refuses.
        IndefiniteCovariance: as `fit_mixture`.

    >>> numbers = torch.rand(500, 7, generator=torch.Generator().manual_seed(0))
    >>> cross_validate(HandSamples(numbers[:, :1], numbers[:, 1:], ("knuckle",)), (1, 2), folds=3).error.shape
    torch.Size([2, 3])
    """
    if not components:
        raise BadArgument("components", "none", "at least one number")
    if not 2 <= folds <= len(samples) // 2:
        raise BadArgument("folds", folds, f"2 to {len(samples) // 2}")
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(seed)).to(samples.q.device)
    parts = order.tensor_split(folds)
    error, log_likelihood = torch.empty(2, len(components), folds, dtype=torch.float64)
    for k, m in enumerate(components):
        for fold, held_out in enumerate(parts):
            rest = torch.cat([part for part in parts if part is not held_out])
            score = evaluate_mixture(fit_mixture(samples[rest], m, seed=seed, **fit), samples[held_out])
            error[k, fold], log_likelihood[k, fold] = score.mean_error, score.log_likelihood
            observer(m, fold)
    return CrossValidation(torch.tensor(list(components)), log_likelihood, error)
