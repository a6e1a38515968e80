"""The model of success: its fit, its calibration on other families, and the bench that judges it."""

import dataclasses

import numpy as np
import pytest
import torch

pytest.importorskip("sklearn")
from benchmarks.headline import predictions as bench
from benchmarks.headline.predictions import (
    Cell,
    judge_order,
    judge_predictions,
    judge_promise,
    judge_trials,
)
from train import success as fit
from train.measured import Trials
from train.success import find_bands, fit_model, judge, keep_trials

from torchgrasp.files import read_value, save_tensors
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.success.features import FEATURES
from torchgrasp.success.model import KIND, SuccessModel, load_success_model
from torchgrasp.success.promise import Promise


def draw_trials(count: int = 6000, families: int = 30, seed: int = 0) -> tuple[Trials, np.ndarray]:
    """Return trials whose log-odds depend on two features, and the true probabilities."""
    draw = np.random.default_rng(seed)
    features = draw.uniform(0.0, 1.0, (count, len(FEATURES)))
    odds = (
        4.0
        - 9.0 * features[:, FEATURES.index("force needed")]
        + 2.0 * features[:, FEATURES.index("force to spare")]
    )
    beside = np.stack(
        [features, draw.uniform(0.0, 1.0, features.shape), np.full_like(features, np.nan)], 1
    )
    chance = 1 / (1 + np.exp(-odds))
    family = np.array([f"family {k:02d}" for k in draw.integers(families, size=count)])
    hand = np.array(["allegro"] * count)
    rank = draw.integers(40, size=count)
    passed = draw.random(count) < chance
    return Trials(features, passed, family, rank, hand, beside, np.zeros(count, dtype=int)), chance


@pytest.fixture(scope="module")
def fitted():
    """A model fitted to drawn trials, the mask of the families that calibrated it, trials and true
    probabilities.
    """
    trials, chance = draw_trials()
    left = np.isin(trials.family, np.unique(trials.family)[::3])
    return fit_model(trials, left), left, trials, chance


def test_the_model_finds_true_probabilities_and_families_that_calibrate_fit_no_tree(fitted):
    model, left, trials, chance = fitted
    predicted = 1 / (1 + np.exp(-model.log_odds(tensor(trials.features)).numpy()))
    assert np.abs(predicted - chance)[left].mean() < 0.07
    lied = trials._replace(passed=np.where(left, ~trials.passed, trials.passed))
    other = fit_model(lied, left)
    assert np.array_equal(
        other.feature.numpy(), model.feature.numpy()
    )  # the same trees, calibrated to the lie
    assert (
        np.corrcoef(
            other.log_odds(tensor(trials.features)), model.log_odds(tensor(trials.features))
        )[0, 1]
        < -0.99
    )
    lines = judge(model, trials.select(left))
    assert lines[0].startswith("all: predicted") and any(
        line.startswith("best of its body") for line in lines
    )


def test_the_best_of_a_body_has_the_greatest_prediction_and_promises_know_outcomes_and_families(
    fitted,
):
    model, left, trials, _ = fitted
    others = trials.select(left)
    own, other = (model.log_odds(tensor(others.beside[:, k])).numpy() for k in (0, 1))
    assert np.array_equal(others.is_best(model), own >= other)
    kept = keep_trials(model, others).numpy()
    np.testing.assert_allclose(kept[:, 0], own)
    assert np.array_equal(kept[:, 1] > 0, others.passed) and len(np.unique(kept[:, 2])) == 10


def test_trials_on_further_families_support_the_promises_beside_those_before(
    fitted, tmp_path, monkeypatch
):
    model, left, trials, _ = fitted
    some = trials.select(left)
    earlier, _ = draw_trials(count=600, seed=1)
    before = dataclasses.replace(model, kept=keep_trials(model, earlier))
    path = tmp_path / "model.safetensors"
    save_tensors(path, KIND, named_tensors(before), {"promised_on": "600 trials of best grasps"})
    monkeypatch.setattr(fit, "read_at_rest", lambda folders, workers: some)
    fit.promise((tmp_path,), model=path)
    after, about = read_value(path, KIND, SuccessModel)
    count = len(earlier.passed)
    further = keep_trials(model, some)
    assert torch.equal(after.kept[:count], before.kept)
    assert torch.equal(after.kept[count:, :2], further[:, :2])
    # families of equal numbers are others
    families = [len(kept[:, 2].unique()) for kept in (before.kept, further, after.kept)]
    assert families[2] == families[0] + families[1]
    assert about["promised_on"].startswith("600 trials of best grasps, ")
    for name, value in named_tensors(before).items():
        assert name == "kept" or torch.equal(value, named_tensors(after)[name])
    with pytest.raises(BadArgument, match=r"^folders: expected other trials"):
        fit.promise((tmp_path,), model=path)


def test_bands_contain_the_true_share_and_widen_when_families_differ():
    draw = np.random.default_rng(1)
    odds = draw.normal(size=8000)
    family = draw.integers(40, size=8000)
    chance = 1 / (1 + np.exp(-odds))
    bands = find_bands(odds, draw.random(8000) < chance, family)
    assert np.all(np.diff(bands, axis=0)[:, 0] > 0) and np.all(bands[:, 1] < bands[:, 2])
    truth = 1 / (1 + np.exp(-bands[:, 0]))
    assert np.mean((bands[:, 1] - 0.02 < truth) & (truth < bands[:, 2] + 0.02)) > 0.9
    shifted = 1 / (1 + np.exp(-odds - draw.normal(scale=1.5, size=40)[family]))
    wide = find_bands(odds, draw.random(8000) < shifted, family)
    assert np.median(wide[:, 2] - wide[:, 1]) > 2 * np.median(bands[:, 2] - bands[:, 1])


def cell(family: str, group: str, outcomes: list[bool], predicted: list[float]) -> Cell:
    """Return a plan whose best grasps had these outcomes."""
    tried = [(k, p, x) for k, (p, x) in enumerate(zip(predicted, outcomes, strict=True))]
    return Cell(family, family, group, "allegro", 0.6, 0.1, 30, tried)


def test_the_bench_counts_the_best_grasp_two_tries_and_the_promise(monkeypatch):
    high = [0.99, 0.98, 0.5, 0.4]
    first = [True, False, True, False]
    second = [False, True, False, False]
    cells = [cell(f"s{k}", "solid", first, high) for k in range(3)] + [
        cell("t", "thin", second, high)
    ]
    rows = {row.what: row for row in judge_order(cells)}
    assert rows["best one over the mean of 20 best"].measured.startswith(
        "+31.2"
    )  # 3 of +50, 1 of -25
    assert (
        rows["best one, solid"].met
        and not rows["best one, thin"].met
        and rows["within two tries, thin"].met
    )
    assert rows["best one, shell"].met is None
    cells += [cell("t", "thin", second, [0.6, 0.5, 0.4, 0.3])]
    monkeypatch.setattr(bench, "find_promise", lambda share: Promise(2.0, 100, 30))  # 0.88
    promised = {row.what.removeprefix("promise 0.9: "): row for row in judge_promise(cells)}
    assert promised["views refused"].measured == "20.0 %" and not promised["views refused"].met
    assert (
        promised["held of returned, all"].measured.startswith("75.0 %")
        and promised["held of returned, solid"].met
    )
    monkeypatch.setattr(bench, "find_promise", lambda share: None)
    assert [row.met for row in judge_promise(cells)] == [False]
    trials = [(f"f{k % 7}", 0, p, (k % 10) < 10 * p) for k in range(200) for p in (0.2, 0.8)]
    said = judge_trials(trials)
    assert said["error"] < 0.01 and said["auc"] == pytest.approx(0.8)
    many = [
        cell(f"f{k}", "solid", [(k + j) % 5 < 4 for j in range(4)], [0.8] * 4) for k in range(40)
    ]
    error = next(row for row in judge_predictions(many) if row.what == "calibration error, all")
    assert error.met and "of 160" in error.measured


def test_the_shipped_model_names_all_features():
    model = load_success_model()
    friction, mass = (model.range[FEATURES.index(name)].tolist() for name in ("friction", "mass"))
    assert friction[1] == -mass[0] > 1e8 and friction[0] < 0.3 and 0.5 < mass[1] < 2.0
    assert len(model.range) == len(model.usual) == len(FEATURES) and int(model.feature.max()) < len(
        FEATURES
    )


def tensor(rows: np.ndarray):
    """Return an array as a tensor."""
    import torch

    return torch.from_numpy(rows)
