"""The order of grasps: known before unknown before failed, each by score; the domain of trials;
kept promises.
"""

import dataclasses
import math

import pytest
import torch

from tests.make import near, real
from tests.success.scenes import around, grasps_at, stump
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.success import order
from torchgrasp.success.features import FEATURES
from torchgrasp.success.model import load_success_model
from torchgrasp.success.promise import Promise
from torchgrasp.success.task import Conditions
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import format_success

OK = int(Status.OK)
FAILED = int(Status.BURIED)
MODEL = stump("mass", 0.5, 1.0, -1.0)


@pytest.fixture
def model(monkeypatch):
    """A model whose trials have every feature between -10 and 10."""
    monkeypatch.setattr(order, "load_success_model", lambda device="cpu": MODEL)


def grasps_of(scores, status=None, known=None):
    """Grasps with scores, each at another height."""
    contacts = around(*torch.linspace(-0.01, 0.01, len(scores)).tolist())
    known = None if known is None else torch.tensor(known)
    return dataclasses.replace(grasps_at(contacts, score=scores, status=status)[1], known=known)


@pytest.mark.parametrize("name", order.DOMAIN)
def test_a_prediction_is_known_up_to_the_edges_of_the_trials(name):
    least, most = load_success_model().range[FEATURES.index(name)].tolist()
    at = torch.tensor([-math.inf, least, (least + most) / 2, most, math.inf], dtype=torch.float64)
    beside = [math.nextafter(least, -math.inf), math.nextafter(most, math.inf)]
    rows = load_success_model().range.mean(1).repeat(7, 1)
    rows[:, FEATURES.index(name)] = torch.cat([at, real(beside)])
    assert order.is_covered(rows).tolist() == [False, True, True, True, False, False, False]
    assert order.is_covered(rows[:0]).shape == (0,)


def test_other_features_may_be_outside_of_the_trials():
    row = load_success_model().range.mean(1)
    others = [k for k, name in enumerate(FEATURES) if name not in order.DOMAIN]
    row[others] = 1e6
    assert order.is_covered(row[None]).tolist() == [True]
    assert order.largest_known() == float(load_success_model().range[FEATURES.index("size"), 1])


def test_the_order_is_known_then_unknown_then_failed_each_by_falling_score(generator):
    draw = torch.randn(60, generator=generator, dtype=torch.float64).tolist()
    status = [FAILED if k % 3 == 0 else OK for k in range(60)]
    known = [bool(k % 2) for k in range(60)]
    rows = grasps_of(draw, status, known)
    wanted = sorted(
        range(60), key=lambda k: (status[k] != OK, status[k] == OK and not known[k], -draw[k])
    )
    found = order.by_success(rows)
    assert torch.equal(found.contacts.points, rows.contacts.points[wanted])
    assert found.score.tolist() == [draw[k] for k in wanted]
    plain = order.by_success(dataclasses.replace(rows, known=None))
    assert plain.score.tolist() == [
        draw[k] for k in sorted(range(60), key=lambda k: (status[k] != OK, -draw[k]))
    ]


def test_scores_intervals_and_knowledge_are_those_of_the_executable_grasps(model):
    rows = grasps_of([9.0, 8.0, 7.0, 6.0], [OK, FAILED, OK, OK])
    odds = real([-1.0, 3.0, 2.0])
    covered = real([1.0, 0.0, 1.0])
    ranked = order.by_success(order.grade(rows, odds, covered))
    assert ranked.score.tolist() == [2.0, -1.0, 3.0, 8.0] and ranked.status.tolist() == [
        OK,
        OK,
        OK,
        FAILED,
    ]
    assert ranked.known.tolist() == [True, True, False, True]
    near(ranked.interval[:2], MODEL.interval(real([2.0, -1.0])), 1e-9)
    assert ranked.interval[2].tolist() == [0.0, 1.0]  # nothing is known of it
    assert [format_success(grasp) for grasp in ranked] == ["88%", "27%", "unknown", "0%"]
    assert ranked.interval[3].tolist() == [0.0, 0.0]  # it is not executed


def test_what_no_trial_supports_widens_the_interval_and_beyond_a_share_nothing_is_known(model):
    odds = real([0.4, 0.4, 0.4])
    graded = order.grade(grasps_of([0.0, 0.0, 0.0]), odds, real([1.0, 0.93, 0.89]))
    low, high = MODEL.interval(odds)[0].tolist()
    assert graded.interval[0].tolist() == pytest.approx([low, high])
    # in 7 % of the cases it may hold or not
    assert graded.interval[1].tolist() == pytest.approx([0.93 * low, 0.93 * high + 0.07])
    assert graded.interval[2].tolist() == [0.0, 1.0]
    assert graded.known.tolist() == [True, True, False]


def test_the_share_that_trials_support_is_that_of_friction_and_mass_in_their_range():
    row = load_success_model().range.mean(1).repeat(1, 2, 1)
    row[0, 1, FEATURES.index("deviation")] = 1.0  # a metre
    friction = Distribution.parse("0.101:0.301")  # from 0.201 on
    mass = Distribution.parse("0.2|2.0@3")
    least, _ = load_success_model().range[FEATURES.index("friction")].tolist()
    wanted = (0.301 - least) / 0.2
    assert order.covered_share(row, Conditions.of(friction, 0.2)).tolist() == pytest.approx(
        [wanted, 0.0]
    )
    assert order.covered_share(row, Conditions.of(friction, mass))[0] == pytest.approx(wanted / 4)
    for certain in (0.1, 0.5):
        share = order.covered_share(row, Conditions.of(certain, 0.2))[0]
        assert share == float(certain > least)


def test_float32_and_no_grasps_keep_their_dtype_and_shape(model):
    rows = grasps_of([1.0, 2.0]).to(torch.float32)
    ranked = order.by_success(order.grade(rows, real([0.5, 1.5]), real([1.0, 1.0])))
    assert (
        ranked.score.dtype == ranked.interval.dtype == torch.float32
        and ranked.score.tolist() == [1.5, 0.5]
    )
    none = order.by_success(order.grade(rows[:0], real([]), real([])))
    assert none.interval.shape == (0, 2) and len(order.by_success(none)) == 0
    assert len(order.keep_promise(none, 0.9)) == 0


def promised(monkeypatch, found):
    """Make a promise for every share."""
    monkeypatch.setattr(order, "find_promise", lambda share: found)


def test_a_promise_refuses_executable_grasps_below_its_bound_or_unknown_ones(monkeypatch):
    promised(monkeypatch, Promise(1.0, 100, 50))
    rows = grasps_of(
        [3.0, 0.9, 2.0, 1.0, 5.0], [OK, OK, OK, OK, FAILED], [True, True, False, True, True]
    )
    kept = order.by_success(order.keep_promise(rows, 0.9))
    refused = int(Status.NO_PROMISE)
    assert kept.status.tolist() == [OK, OK, FAILED, refused, refused]
    assert kept.score.tolist() == [3.0, 1.0, 5.0, 2.0, 0.9]  # refused grasps keep their predictions
    assert kept.success.tolist()[2:] == [0.0, 0.0, 0.0]
    again = order.by_success(order.keep_promise(kept, 0.9))
    assert again.status.tolist() == kept.status.tolist()
    every = order.by_success(order.keep_promise(dataclasses.replace(rows, known=None), 0.9))
    assert sorted(every.status.tolist()) == sorted([OK, OK, OK, FAILED, refused])


def test_without_a_bound_no_executable_grasp_is_promised(monkeypatch):
    promised(monkeypatch, None)
    kept = order.by_success(order.keep_promise(grasps_of([30.0, 3.0, 1.0], [OK, OK, FAILED]), 0.9))
    assert int(Status.OK) not in kept.status.tolist() and FAILED in kept.status.tolist()


def test_by_variance_the_surest_contacts_come_first_and_are_needed():
    rows = grasps_of([1.0, 2.0, 3.0], [OK, OK, FAILED])
    with pytest.raises(BadArgument, match="variance"):
        order.rank_by_variance(rows)
    contacts = dataclasses.replace(
        rows.contacts, variance=real([[1.0, 1, 1], [0.5, 0.5, 1], [0.1, 0.1, 0.1]])
    )
    assert order.rank_by_variance(dataclasses.replace(rows, contacts=contacts)).score.tolist() == [
        2.0,
        1.0,
        3.0,
    ]


def test_equal_scores_are_ordered_by_the_margin_of_their_certificates():
    rows = grasps_of([1.0, 1.0, 1.0, 2.0])
    certificate = dataclasses.replace(rows.certificate, margin=real([0.01, 0.03, 0.02, 0.0]))
    ordered = order.by_success(dataclasses.replace(rows, certificate=certificate))
    assert ordered.certificate.margin.tolist() == [0.0, 0.03, 0.02, 0.01]
