"""The benchmarks' own oracles agree with the library: what they call identical is."""

from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.make import covariance
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure import solve_closure_lp
from torchgrasp.plan.wrench import wrenches
from torchgrasp.shape.conditioning import select_points
from torchgrasp.shape.kernel import kernel_by_name, thin_plate
from torchgrasp.shape.values import on_surface
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

SCRIPTS = str(Path(__file__).resolve().parents[1] / "scripts")


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)


@pytest.mark.parametrize("rows", [True, False])
@pytest.mark.parametrize("columns", [True, False])
def test_the_closed_form_of_the_peers_is_the_covariance(scripts, generator, rows, columns):
    from benchmarks.common import random_view
    from benchmarks.shape.gpytorch_peer import thin_plate_rows

    x, _ = random_view(30, generator)
    masks = [torch.full((30,), yes) for yes in (rows, columns)]
    expected = covariance(x, x, *masks, partial(thin_plate, psi=3.0))
    torch.testing.assert_close(thin_plate_rows(x, x, 3.0, rows, columns), expected, rtol=0, atol=1e-13)


def test_the_selection_picks_what_a_refit_for_each_pick_does(scripts, generator):
    from benchmarks.common import random_view
    from benchmarks.shape.exactness import observe_support
    from benchmarks.shape.gpytorch_peer import select_by_refitting

    x, normals = random_view(120, generator)
    known = observe_support(x)
    candidates = on_surface(x, normals, torch.full_like(x[:, 0], 0.01), 0.05)
    found = select_points(candidates, known, kernel_by_name("thin_plate", 3.6), 40)
    assert torch.equal(found.picks, select_by_refitting(x, known, 40, 3.6, 0.01, 0.05))


@pytest.mark.parametrize("body", ["ellipsoid", "box", "cylinder", "torus"])
def test_a_random_view_has_unit_normals_that_face_one_side(scripts, generator, body):
    from benchmarks.common import random_view

    x, normals = random_view(200, generator, body)
    assert x.shape == normals.shape == (200, 3)
    assert float(torch.linalg.vector_norm(x, dim=-1).max()) == pytest.approx(1.0)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(200, dtype=torch.float64))
    assert float(torch.linalg.vector_norm(normals.mean(0))) > 0.3


def test_rational_arithmetic_confirms_margins_and_both_verdicts(scripts, generator):
    from benchmarks.proof.exact_lp import exact_margin, proves_margin_above, proves_margin_below, solve, wrench_matrix

    points = torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    lean = torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    normals = unit(unit(points - points.mean(1, keepdim=True)) + 0.4 * lean)
    found = certify(Contacts(points, normals), ContactSpec(friction=0.6, friction_margin=1.0))
    phi, _ = solve_closure_lp(wrenches(points, normals, 0.6, 8).flatten(1, 2))
    assert 3 < int(found.closed.sum()) < 17
    for i in range(20):
        matrix = wrench_matrix(points[i].numpy(), normals[i].numpy(), 0.6, 8)
        exact = exact_margin(matrix)
        assert float(exact) == pytest.approx(float(found.margin[i]), abs=1e-12)
        little, witness = Fraction(1, 10**9), found.witness[i].numpy()
        assert proves_margin_above(matrix, phi[i].numpy(), exact - little)
        assert not proves_margin_above(matrix, phi[i].numpy(), exact + little)
        assert proves_margin_below(matrix, witness, exact + little)
        assert not proves_margin_below(matrix, witness, exact - little)
    assert solve(np.array([[2, 1], [1, 3]]), np.array([1, 1])) == [Fraction(2, 5), Fraction(1, 5)]
    assert solve(np.array([[2, 1], [4, 2]]), np.array([1, 1])) is None


def test_a_row_says_whether_its_bar_is_met(scripts):
    from benchmarks.common import Row

    assert [str(Row("a", "b", "c", met, {})).split()[0] for met in (True, False, None)] == ["met", "MISSED", "-"]


def test_predicted_success_is_fitted_to_the_truth_and_judged_on_families_left_out(scripts):
    pytest.importorskip("sklearn")
    from benchmarks.close.success import Trials, describe, fit, judge, leave_one_out

    rng = np.random.default_rng(0)
    known, hand = rng.normal(size=(4000, 4)), np.where(rng.random(4000) < 0.5, "one", "other")
    test = np.where(rng.random(4000) < 0.5, "pose-noise, uncertainty", "dexgraspbench, open_loop")
    true, bias = np.array([1.5, -1.0, 0.0, 0.5]), {"one": 0.9, "other": -0.1}
    odds = known @ true + np.where(hand == "one", 0.9, -0.1) - 1.0 * (test == "pose-noise, uncertainty")
    chance = 1 / (1 + np.exp(-odds))
    passed, kind = rng.random(4000) < chance, np.array([f"kind {k}" for k in rng.integers(0, 8, 4000)])
    trials = Trials(known, passed, np.char.add(kind, " a"), kind, hand, test)
    model = fit(trials)
    np.testing.assert_allclose([*model.weights, model.pose_error], [*true, -1.0], atol=0.2)
    assert model.bias == pytest.approx(bias, abs=0.2)
    assert np.abs(model.predict(trials) - chance).mean() < 0.03
    predicted = leave_one_out(trials)
    found, best = describe(predicted, trials), describe(chance, trials)
    assert found["skill"] > best["skill"] - 0.02 and found["error"] < 0.05
    assert all(x.passed.low - 0.03 <= x.predicted <= x.passed.high + 0.03 for x in found["bins"])
    said = judge(predicted, trials)
    assert said[0].startswith("all") and said[0].endswith("of 4000")
    assert sum(line.startswith("one") for line in said) == 1 + 10 and len(said) == 5 + 3 * 10
    mine = trials.family == "kind 3"  # its own outcomes must not matter
    lied = trials._replace(passed=np.where(mine, ~trials.passed, trials.passed))
    np.testing.assert_array_equal(leave_one_out(lied)[mine], predicted[mine])


def test_authored_bodies_are_closed_stand_on_the_table_and_have_the_size_of_their_kind(scripts):
    from train.bodies import COUNTS, author_body

    bodies = {kind: [author_body(kind, k) for k in range(count)] for kind, count in COUNTS.items()}
    assert all(body.is_volume for some in bodies.values() for body in some)
    for kind in ("bar", "pen", "plate", "spatula", "ring"):
        assert all(0.013 <= body.extents[2] <= 0.03 for body in bodies[kind]), kind
    for kind in ("cup", "bowl", "bracket"):  # they enclose most of their hull, and fill little of it
        assert all(body.volume < 0.45 * body.convex_hull.volume for body in bodies[kind]), kind
    np.testing.assert_array_equal(author_body("bowl", 1).vertices, bodies["bowl"][1].vertices)
