"""Whether predicted probabilities are true: reliability by bins, calibration error, Brier skill, order."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.evaluation.intervals import Share, count_by, share_over

BINS = 10
"""Of predicted probability, equally wide."""


class Bin(NamedTuple):
    """Predictions in [low, high): their mean, and the share of their trials that passed."""

    low: float
    high: float
    predicted: float
    passed: Share


def reliability(predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"], units: Sequence[str]) -> list[Bin]:
    """Return the bins that have trials; `units` names what is resampled for their intervals.

    >>> found = reliability(torch.tensor([0.15, 0.11, 0.9]), torch.tensor([False, True, True]), ["tin", "cup", "tin"])
    >>> [(round(x.low, 1), round(x.predicted, 2), x.passed.value, x.passed.total) for x in found]
    [(0.1, 0.13, 0.5, 2), (0.9, 0.9, 1.0, 1)]
    """
    at, bins = (predicted * BINS).long().clamp(0, BINS - 1), []
    for k in at.unique().tolist():
        rows: list[int] = torch.nonzero(at == k)[:, 0].tolist()
        counts = count_by((units[row], bool(passed[row])) for row in rows)
        bins.append(Bin(k / BINS, (k + 1) / BINS, float(predicted[rows].mean()), share_over(counts)))
    return bins


def calibration_error(bins: Sequence[Bin]) -> float:
    """Return the expected calibration error: how far off the bins are, each weighed by its trials."""
    total = sum(x.passed.total for x in bins)
    return sum(abs(x.predicted - x.passed.value) * x.passed.total for x in bins) / total if total else math.nan


def brier_score(predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"]) -> float:
    """Return the mean squared error of probabilities.

    >>> brier_score(torch.tensor([0.5, 1.0]), torch.tensor([True, True]))
    0.125
    """
    return float((predicted - passed.to(predicted)).square().mean())


def brier_skill(predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"]) -> float:
    """Return how much better than their own base rate probabilities are: 1 is perfect, 0 no better.

    >>> brier_skill(torch.tensor([0.5, 0.5]), torch.tensor([True, False]))
    0.0
    """
    rate = passed.to(predicted).mean()
    return 1 - brier_score(predicted, passed) / float(rate * (1 - rate)) if 0 < rate < 1 else math.nan


def area_under_curve(predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"]) -> float:
    """Return how often a trial that passed was given more than one that failed; ties count half.

    >>> area_under_curve(torch.tensor([0.9, 0.4, 0.4]), torch.tensor([True, True, False]))
    0.75
    """
    good, bad = predicted[passed], predicted[~passed]
    if not len(good) or not len(bad):
        return math.nan
    bad = bad.sort().values
    below, upto = torch.searchsorted(bad, good), torch.searchsorted(bad, good, right=True)
    return float((below + upto).double().mean()) / 2 / len(bad)


def judge(
    predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"], units: Sequence[str]
) -> dict[str, float | list[Bin]]:
    """Return all of these by name: "predicted", "passed", "brier", "skill", "auc", "error" and "bins"."""
    bins = reliability(predicted, passed, units)
    return {
        "predicted": float(predicted.mean()),
        "passed": float(passed.to(predicted).mean()),
        "brier": brier_score(predicted, passed),
        "skill": brier_skill(predicted, passed),
        "auc": area_under_curve(predicted, passed),
        "error": calibration_error(bins),
        "bins": bins,
    }
