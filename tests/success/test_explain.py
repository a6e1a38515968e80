"""What moves the predicted success: costs by hand, causes in order, and sentences that hold the
features' values.
"""

import dataclasses
import functools
import math
import re

import pytest
import torch

from tests.make import load_hand
from tests.success.scenes import stump
from torchgrasp import GraspTask, explain_success, fit_shape, load_object
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import move
from torchgrasp.success import reasons as explain
from torchgrasp.success.features import CAUSES, FEATURES, WEAK
from torchgrasp.success.model import load_success_model
from torchgrasp.success.reasons import SENTENCES, measure_again, stand_upright
from torchgrasp.values.distribution import Distribution

UNITS = {name: unit for names in CAUSES.values() for name, unit in names.items()}
SHOWN = {
    "m": (1000.0, " mm"),
    "rad": (180 / math.pi, " degrees"),
    "1": (1.0, ""),
    "N": (1.0, " N"),
    "kg": (1.0, " kg"),
}
TASK = GraspTask(mass=0.5)


@functools.cache
def jug():
    """The shape of the jug, and the shipped grasp of it with its hand."""
    return (
        load_shipped_grasp("jug", "barrett"),
        load_hand("barrett"),
        fit_shape(load_object("jug").view, table=0.0),
    )


@functools.cache
def features():
    """The features of the jug's grasp."""
    return measure_again(*stand_upright(*jug()), TASK)[0]


@pytest.fixture
def use(monkeypatch):
    """Explain by a model of one tree."""
    return lambda model: monkeypatch.setattr(explain, "load_success_model", lambda device: model)


def wary(name, usual=None):
    """A model that takes two log-odds for a feature as it is, and none for its usual value."""
    value = float(features()[0, FEATURES.index(name)])
    model = stump(name, value - 1e-6, 0.0, -2.0)
    return dataclasses.replace(
        model, usual=torch.full_like(model.usual, value - 1.0 if usual is None else usual)
    )


def test_the_cost_of_a_cause_is_what_its_usual_values_gain_and_the_three_greatest_are_told():
    model = load_success_model()
    row = features()
    gains = {}
    for cause, names in CAUSES.items():
        better = row.clone()
        for name in names:
            better[0, FEATURES.index(name)] = model.usual[FEATURES.index(name)]
        gains[cause] = float(model.log_odds(better) - model.log_odds(row))
    wanted = sorted(
        (cause for cause in gains if gains[cause] > 0), key=lambda cause: -gains[cause]
    )[:3]
    told = explain_success(*jug(), TASK)
    assert [cost.cause for cost in told] == wanted
    assert [cost.log_odds for cost in told] == pytest.approx([gains[cause] for cause in wanted])


@pytest.mark.parametrize("cause", CAUSES)
def test_only_the_cause_that_costs_is_told_with_the_numbers_and_units_of_its_features(cause, use):
    use(wary(next(iter(CAUSES[cause]))))
    [cost] = explain_success(*jug(), TASK)
    assert (cost.cause, cost.log_odds) == (cause, 2.0)
    names = re.findall(r"{([^}]*)}", SENTENCES[cause])
    assert names and set(names) <= set(CAUSES[cause]) | {"friction", "mass"}
    texts = re.fullmatch(re.sub(r"{[^}]*}", "(.+?)", SENTENCES[cause]), cost.sentence).groups()
    for name, text in zip(names, texts, strict=True):
        scale, unit = SHOWN[UNITS[name]]
        value = scale * float(features()[0, FEATURES.index(name)])
        assert text.endswith(unit) and float(text.removesuffix(unit)) == pytest.approx(
            value, rel=0.05
        )


def test_a_cause_that_does_not_lower_the_success_is_not_told(use):
    use(wary("mass", usual=1e6))  # a usual value as bad as the grasp's
    assert explain_success(*jug(), TASK) == ()


def test_a_heavier_object_makes_the_load_or_the_task_a_cause(use):
    for name, cause in (("mass", "task"), ("force needed", "load")):
        light, heavy = (
            measure_again(*stand_upright(*jug()), GraspTask(mass=mass))[0, 0, FEATURES.index(name)]
            for mass in (0.05, 0.5)
        )
        assert light < heavy
        use(stump(name, float(light + heavy) / 2, 1.0, -1.0))
        assert explain_success(*jug(), GraspTask(mass=0.05)) == ()
        assert [cost.cause for cost in explain_success(*jug(), GraspTask(mass=0.5))] == [cause]


@pytest.mark.parametrize(
    ("mass", "told"),
    [
        (0.1, ""),
        (Distribution.parse("0.5:1.5"), "no trial supports [1-9][0-9]%"),
        (2.0, "; no trial supports these frictions and masses, so the success is unknown$"),
    ],
)
def test_what_no_trial_supports_of_the_task_is_told(mass, told):
    sentences = {
        cost.cause: cost.sentence for cost in explain_success(*jug(), GraspTask(mass=mass))
    }
    task = sentences.get("task", "")
    assert re.search(told, task) if told else "no trial" not in task


def test_the_frame_of_object_and_grasp_does_not_matter(motion):
    grasp, hand, shape = jug()
    there = dataclasses.replace(
        move(grasp, motion), meta=grasp.meta | {"table": grasp.table.moved(motion).describe()}
    )
    [found] = measure_again(*stand_upright(there, hand, shape.moved(motion)), TASK)
    torch.testing.assert_close(found, features(), rtol=0.05, atol=1e-3)


def test_the_default_task_is_that_of_a_plan():
    assert explain_success(*jug()) == explain_success(*jug(), GraspTask())


def test_grasps_and_hand_may_have_different_dtypes():
    grasp, hand, shape = jug()
    for parts in ((grasp, hand.to(torch.float32)), (grasp.to(torch.float32), hand)):
        torch.testing.assert_close(
            measure_again(*stand_upright(*parts, shape), TASK)[0], features(), rtol=1e-2, atol=1e-3
        )


def test_grasps_in_single_precision_carry_what_they_carry():
    """The forces are proven to a millionth, which float32 does not reach."""
    grasp, hand, shape = jug()
    task = GraspTask(mass=0.25)
    exact = explain_success(grasp, hand, shape, task)
    rough = explain_success(grasp.to(torch.float32), hand, shape, task)
    assert [cost.cause for cost in rough] == [cost.cause for cost in exact]
    for one, other in zip(rough, exact, strict=True):
        assert one.log_odds == pytest.approx(other.log_odds, abs=0.02)
    assert not any("no forces of the fingers" in cost.sentence for cost in rough)


def test_another_hand_and_a_shape_that_is_elsewhere_are_refused():
    grasp, hand, shape = jug()
    right = load_shipped_grasp("jug", "allegro")
    assert explain_success(right, load_hand("allegro"), shape)
    with pytest.raises(
        BadArgument, match=r"hand: expected allegro, as the grasps name.*got allegro_left"
    ):
        explain_success(right, load_hand("allegro_left"), shape)
    with pytest.raises(BadArgument, match="hand: expected index,middle,thumb, as the grasps name"):
        explain_success(right, load_hand("allegro", ("index", "ring", "thumb")), shape)
    beside = torch.eye(4, dtype=torch.float64)
    for x in (0.06, 0.1, 3.0):
        beside[0, 3] = x
        with pytest.raises(BadArgument, match="shape: expected the shape of the grasped object"):
            explain_success(grasp, hand, shape.moved(beside))


def test_no_grasps_and_grasps_of_unknown_friction_are_refused():
    grasp, hand, shape = jug()
    with pytest.raises(BadArgument, match="grasps"):
        explain_success(grasp[:0], hand, shape)
    bare = dataclasses.replace(
        grasp, meta={key: text for key, text in grasp.meta.items() if key != "friction"}
    )
    with pytest.raises(BadArgument, match="grasps"):
        explain_success(bare, hand, shape)


def test_a_weight_that_no_forces_carry_is_told_and_lowers_the_success_by_the_load():
    grasp, hand, shape = jug()
    told = {}
    for mass in (0.1, 10.0):
        costs = explain_success(grasp, hand, shape, GraspTask(mass=mass))
        told[mass] = {cost.cause: cost.sentence for cost in costs}
    # the drives of the hand cannot lift ten kilograms at any friction
    assert "no forces of the fingers carry the weight" in told[10.0]["load"]
    assert all("carry the weight" not in sentence for sentence in told[0.1].values())


def test_a_weight_that_is_hardly_carried_is_told_with_how_many_times_the_fingers_carry_it():
    grasp, hand, shape = jug()
    # the greatest carried weight is the same, so its multiple is inverse to the mass
    carried = {}
    for mass in (1.0, 1.5):
        costs = explain_success(grasp, hand, shape, GraspTask(mass=mass))
        [sentence] = [cost.sentence for cost in costs if cost.cause == "load"]
        carried[mass] = float(re.search(r"at most (\S+) times the weight", sentence)[1])
    assert 1 < carried[1.5] < carried[1.0] < WEAK.enough
    assert 1.5 * carried[1.5] == pytest.approx(carried[1.0], rel=0.05)
