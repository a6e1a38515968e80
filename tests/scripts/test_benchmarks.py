"""The benchmarks' own oracles agree with the library: what they call identical is."""

from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.covariance import covariance
from torchgrasp.linalg import unit
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.wrench import wrenches
from torchgrasp.shape.kernel import kernel_by_name, thin_plate
from torchgrasp.shape.observations import on_surface
from torchgrasp.shape.select import select_points
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


def test_predicted_success_is_judged_on_objects_that_it_was_not_fitted_on(scripts):
    pytest.importorskip("sklearn")
    from benchmarks.close.success import Trials, brier, fit, judge, leave_one_out, reliability

    rng = np.random.default_rng(0)
    known, friction = rng.normal(size=(4000, 5)), np.where(rng.random(4000) < 0.5, 0.3, 0.6)
    true = np.array([1.0, -0.5, 0.0, 0.3, 0.2])
    chance = 1 / (1 + np.exp(-(known @ true + 0.4)))
    passed, ways = rng.random(4000) < chance, np.where(rng.random(4000) < 0.5, "open_loop", "uncertainty")
    bodies = np.array([f"body_{k}" for k in rng.integers(0, 8, 4000)])
    trials = Trials(known, passed, bodies, np.where(friction < 0.5, "hard", "easy"), ways)
    weights, bias = fit(trials)
    np.testing.assert_allclose([*weights, bias], [*true, 0.4], atol=0.15)
    predicted, base = leave_one_out(trials)
    assert brier(chance, trials.passed) - 0.002 < brier(predicted, trials.passed) < brier(base, trials.passed) - 0.02
    for *_, mean, (passed, low, high) in reliability(predicted, trials):
        assert abs(mean - passed) < 0.06 and low <= passed <= high
    said = judge(predicted, base, trials)
    assert len(said) == 7 + 3 * 5 and said[0].startswith("all") and said[0].endswith("of 4000")
    mine = trials.object == "body_3"  # its own outcomes must not matter
    lied = trials._replace(passed=np.where(mine, ~trials.passed, trials.passed))
    np.testing.assert_array_equal(leave_one_out(lied)[0][mine], predicted[mine])
    np.testing.assert_array_equal(leave_one_out(lied)[1][mine], base[mine])
