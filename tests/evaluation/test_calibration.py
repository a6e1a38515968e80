"""Calibration against scikit-learn, and on predictions whose truth is known."""

import math

import numpy as np
import pytest
import torch

from torchgrasp.evaluation.calibration import (
    area_under_curve,
    brier_score,
    brier_skill,
    calibration_error,
    judge,
    reliability,
)


@pytest.fixture
def trials(generator):
    predicted = torch.rand(6000, generator=generator, dtype=torch.float64)
    return predicted, torch.rand(6000, generator=generator, dtype=torch.float64) < predicted


UNITS = [f"family_{k % 40}" for k in range(6000)]


def test_scores_are_those_of_scikit_learn(trials):
    metrics = pytest.importorskip("sklearn.metrics")
    calibration = pytest.importorskip("sklearn.calibration")
    predicted, passed = trials
    rounded = (20 * predicted).round() / 20  # with ties
    for p in (predicted, rounded):
        assert area_under_curve(p, passed) == pytest.approx(metrics.roc_auc_score(passed, p))
        assert brier_score(p, passed) == pytest.approx(metrics.brier_score_loss(passed, p))
    share, mean = calibration.calibration_curve(passed.numpy(), predicted.numpy(), n_bins=10)
    bins = reliability(predicted, passed, UNITS)
    np.testing.assert_allclose([x.passed.value for x in bins], share)
    np.testing.assert_allclose([x.predicted for x in bins], mean)
    assert [x.passed.units for x in bins] == [40] * 10 and sum(x.passed.total for x in bins) == 6000


def test_true_probabilities_are_calibrated_and_shifted_ones_are_not(trials):
    predicted, passed = trials
    found = judge(predicted, passed, UNITS)
    assert found["error"] < 0.03 and found["skill"] == pytest.approx(1 / 3, abs=0.03)  # 1 - (1/6) / (1/4)
    assert found["auc"] == pytest.approx(5 / 6, abs=0.02)
    assert found["predicted"] == pytest.approx(found["passed"], abs=0.02)
    assert all(x.passed.low - 0.02 <= x.predicted <= x.passed.high + 0.02 for x in found["bins"])
    high = judge(predicted.sqrt(), passed, UNITS)
    assert high["error"] == pytest.approx(2 / 3 - 1 / 2, abs=0.03) and high["skill"] < found["skill"]
    assert high["auc"] == pytest.approx(found["auc"])


def test_a_constant_has_no_skill_and_one_outcome_has_no_curve(trials):
    _, passed = trials
    constant = torch.full((6000,), float(passed.double().mean()), dtype=torch.float64)
    assert brier_skill(constant, passed) == pytest.approx(0.0, abs=1e-12) and area_under_curve(constant, passed) == 0.5
    sure = torch.ones(5, dtype=torch.bool)
    assert math.isnan(brier_skill(constant[:5], sure)) and math.isnan(area_under_curve(constant[:5], sure))
    assert math.isnan(calibration_error([]))
