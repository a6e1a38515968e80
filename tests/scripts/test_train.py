"""scripts/train.py: fits find the numbers behind synthetic data, and authored bodies are sound."""

import numpy as np
import pytest
from train.bands import fit_factor
from train.bodies import COUNTS, author_body


@pytest.mark.parametrize("spread", [0.4, 1.1])
def test_fit_factor_is_the_spread_of_normal_errors(spread: float):
    generator = np.random.default_rng(0)
    views = [spread * np.abs(generator.standard_normal(4000)) for _ in range(12)]
    assert fit_factor(views) == pytest.approx(spread, abs=0.03)


def test_success_model_recovers_its_weights_and_judges_held_out_families():
    pytest.importorskip("sklearn")
    from benchmarks.close.success import Trials, describe, fit, leave_one_out

    rng = np.random.default_rng(0)
    known, hand = rng.normal(size=(4000, 4)), np.where(rng.random(4000) < 0.5, "one", "other")
    test = np.where(rng.random(4000) < 0.5, "pose-noise, uncertainty", "dexgraspbench, open_loop")
    true = np.array([1.5, -1.0, 0.0, 0.5])
    odds = known @ true + np.where(hand == "one", 0.9, -0.1) - 1.0 * (test == "pose-noise, uncertainty")
    passed = rng.random(4000) < 1 / (1 + np.exp(-odds))
    kind = np.array([f"kind {k}" for k in rng.integers(0, 8, 4000)])
    trials = Trials(known, passed, kind, kind, hand, test)
    model = fit(trials)
    np.testing.assert_allclose([*model.weights, model.pose_error], [*true, -1.0], atol=0.2)
    predicted, mine = leave_one_out(trials), kind == "kind 3"
    assert describe(predicted, trials)["error"] < 0.05
    lied = trials._replace(passed=np.where(mine, ~passed, passed))  # the own outcomes of a family do not matter
    np.testing.assert_array_equal(leave_one_out(lied)[mine], predicted[mine])


def test_authored_bodies_are_closed_and_repeatable():
    bodies = {kind: author_body(kind, 0) for kind in COUNTS}
    assert all(body.is_volume for body in bodies.values())
    np.testing.assert_array_equal(author_body("bowl", 0).vertices, bodies["bowl"].vertices)
