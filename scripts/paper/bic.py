"""The Bayesian information criterion of separate fits: the reference of `growing_bic`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from torchgrasp import GraspMixture, fit_mixture
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.posture_model import HandSamples
from torchgrasp.posture_model.score import BicCurve


def bic_curve(
    samples: HandSamples,
    components: Sequence[int] = tuple(range(5, 61)),
    *,
    checkpoints: Path | str | None = None,
    observer: Callable[[int, GraspMixture], object] = lambda m, mixture: None,
    **fit: Any,
) -> BicCurve:
    """Fit a mixture for each number of components, and return the BIC of each (Fig. 6 b, d); raises
    as `fit_mixture`.

    `checkpoints` is a folder from which an interrupted call continues. `fit` holds more arguments
    of `fit_mixture`.
    """
    if not components:
        raise BadArgument("components", "none", "at least one number")
    criterion = []
    for m in components:
        checkpoint = None if checkpoints is None else Path(checkpoints) / f"em_{m}.safetensors"
        mixture = fit_mixture(samples, m, checkpoint=checkpoint, **fit)
        criterion.append(float(mixture.meta["bic"]))
        observer(m, mixture)
    found = torch.tensor(criterion, dtype=torch.float64, device="cpu")
    return BicCurve(torch.tensor(list(components), device="cpu"), found)
