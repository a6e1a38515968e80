"""Cross-validation of the number of Gaussians (footnote 4 of the paper)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp import fit_mixture
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.posture_model import HandSamples
from torchgrasp.posture_model.score import evaluate_mixture


@dataclasses.dataclass(frozen=True)
class CrossValidation(Value):
    """Held-out mean log-likelihood [nats] and mean absolute error [rad] for each number of
    components and fold.
    """

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


def cross_validate(
    samples: HandSamples,
    components: Sequence[int],
    folds: int = 10,
    seed: int = 0,
    *,
    observer: Callable[[int, int], None] = lambda m, fold: None,
    **fit: Any,
) -> CrossValidation:
    """Fit on all folds but one and evaluate on that one, for each number of components (footnote 4
    of the paper).

    Args:
        samples: postures to divide.
        components: numbers to try.
        folds: number of parts.
        seed: of the division and of the starts.
        observer: called after each fit with its number of components and its fold.
        fit: iterations, tolerance and regularisation of `fit_mixture`.

    Raises:
        BadArgument: no number to try, folds outside [2, half the samples], or what `fit_mixture`
            refuses.
        IndefiniteCovariance: as `fit_mixture`.
    """
    if not components:
        raise BadArgument("components", "none", "at least one number")
    if not 2 <= folds <= len(samples) // 2:
        raise BadArgument("folds", folds, f"2 to {len(samples) // 2}")
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(seed)).to(
        samples.q.device
    )
    parts = order.tensor_split(folds)
    error, log_likelihood = torch.empty(2, len(components), folds, dtype=torch.float64)
    for k, m in enumerate(components):
        for fold, held_out in enumerate(parts):
            rest = torch.cat([part for part in parts if part is not held_out])
            score = evaluate_mixture(
                fit_mixture(samples[rest], m, seed=seed, **fit), samples[held_out]
            )
            error[k, fold] = score.mean_error
            log_likelihood[k, fold] = score.log_likelihood
            observer(m, fold)
    return CrossValidation(torch.tensor(list(components)), log_likelihood, error)
