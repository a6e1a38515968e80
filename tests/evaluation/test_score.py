"""Calibration of predictions against scikit-learn, and on predictions with known probabilities."""

import math

import numpy as np
import pytest
import torch

from torchgrasp.evaluation.summary import judge

UNITS = [f"family_{k % 40}" for k in range(6000)]


@pytest.fixture
def trials(generator):
    predicted = torch.rand(6000, generator=generator, dtype=torch.float64)
    return predicted, torch.rand(6000, generator=generator, dtype=torch.float64) < predicted


def test_judge_agrees_with_scikit_learn(trials):
    metrics = pytest.importorskip("sklearn.metrics")
    calibration = pytest.importorskip("sklearn.calibration")
    predicted, passed = trials
    for p in (predicted, (20 * predicted).round() / 20):  # the second with ties
        found = judge(p, passed, UNITS)
        assert found["auc"] == pytest.approx(metrics.roc_auc_score(passed, p))
        assert found["brier"] == pytest.approx(metrics.brier_score_loss(passed, p))
    share, mean = calibration.calibration_curve(passed.numpy(), predicted.numpy(), n_bins=10)
    bins = judge(predicted, passed, UNITS)["bins"]
    np.testing.assert_allclose([x.passed.value for x in bins], share)
    np.testing.assert_allclose([x.predicted for x in bins], mean)
    assert [x.passed.units for x in bins] == [40] * 10 and sum(x.passed.total for x in bins) == 6000


def test_judge_finds_true_probabilities_calibrated_shifted_ones_not_and_constants_without_skill(
    trials,
):
    predicted, passed = trials
    found = judge(predicted, passed, UNITS)
    high = judge(predicted.sqrt(), passed, UNITS)
    assert found["error"] < 0.03 and found["skill"] == pytest.approx(
        1 / 3, abs=0.03
    )  # 1 - (1/6) / (1/4)
    assert found["auc"] == pytest.approx(5 / 6, abs=0.02) and found["auc"] == pytest.approx(
        high["auc"]
    )
    assert all(x.passed.low - 0.02 <= x.predicted <= x.passed.high + 0.02 for x in found["bins"])
    assert (
        high["error"] == pytest.approx(2 / 3 - 1 / 2, abs=0.03) and high["skill"] < found["skill"]
    )
    _, passed = trials
    constant = torch.full((6000,), float(passed.double().mean()), dtype=torch.float64)
    found = judge(constant, passed, UNITS)
    assert found["skill"] == pytest.approx(0.0, abs=1e-12) and found["auc"] == 0.5
    sure = judge(constant[:5], torch.ones(5, dtype=torch.bool), UNITS[:5])
    assert math.isnan(sure["skill"]) and math.isnan(sure["auc"])
