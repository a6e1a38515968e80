"""How many Gaussians: the information criterion of separate fits, the reference of `growing_bic`,
and cross-validation. See Fig. 6 and footnote 4 of the paper.
"""

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
from torchgrasp.posture_model.score import BicCurve, evaluate_mixture


def bic_curve(
    samples: HandSamples,
    components: Sequence[int],
    *,
    tick: Callable[[], object] = lambda: None,
    **fit: Any,
) -> BicCurve:
    """Fit a mixture for each number of components, and return the BIC of each (Fig. 6 b, d).

    `tick` is called after each fit, `fit` holds more arguments of `fit_mixture`.
    """
    criterion = []
    for m in components:
        criterion.append(float(fit_mixture(samples, m, **fit).meta["bic"]))
        tick()
    return BicCurve(torch.tensor(list(components)), torch.tensor(criterion, dtype=torch.float64))


@dataclasses.dataclass(frozen=True)
class CrossValidation(Value):
    """Results of a cross-validation of mixtures with k numbers of components, over f folds.

    `log_likelihood` (k, f) [nats] and `error` (k, f) [rad] are means over the held-out fold: of the
    log-likelihood, and of the absolute error of the joints.
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
    tick: Callable[[], object] = lambda: None,
    **fit: Any,
) -> CrossValidation:
    """Fit on all folds but one and evaluate on that one, for each number of components.

    The `seed` divides the samples and starts the fits. `tick` and `fit` are as in `bic_curve`.
    Raises `BadArgument` for `folds` outside [2, half the samples].
    """
    if not 2 <= folds <= len(samples) // 2:
        raise BadArgument("folds", folds, f"2 to {len(samples) // 2}")
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(seed))
    parts = order.tensor_split(folds)
    error, log_likelihood = torch.empty(2, len(components), folds, dtype=torch.float64)
    for k, m in enumerate(components):
        for fold, held_out in enumerate(parts):
            rest = torch.cat([part for part in parts if part is not held_out])
            mixture = fit_mixture(samples[rest], m, seed=seed, **fit)
            score = evaluate_mixture(mixture, samples[held_out])
            error[k, fold] = score.mean_error
            log_likelihood[k, fold] = score.log_likelihood
            tick()
    return CrossValidation(torch.tensor(list(components)), log_likelihood, error)
