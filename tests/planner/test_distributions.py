"""Plans under distributions of friction and mass: their success is the mean over single numbers."""

import dataclasses

import pytest
import torch

from tests.make import load_hand, near
from torchgrasp import (
    ContactSpec,
    Distribution,
    GraspTask,
    certify,
    critical_friction,
    load_grasps,
    load_object,
    plan_grasps,
)
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.model import load_success_model
from torchgrasp.success.reasons import explain_success, measure_again, stand_upright

FRICTION = Distribution.parse("0.3:0.8@3|1.0")
MASS = Distribution.between(0.1, 0.4)


@pytest.fixture(scope="module")
def planned():
    """Grasps under a distribution of friction and mass, and the estimated shape."""
    stages = {}
    grasps = plan_grasps(
        load_object("cylinder").view,
        load_hand("barrett"),
        ContactSpec(friction=FRICTION, table=0.0),
        starts=24,
        task=GraspTask(mass=MASS),
        observer=lambda stage, _, value: stages.update({stage: value}),
    )
    return grasps, stages["shape"]


@pytest.fixture
def one_body(monkeypatch):
    """Estimate the body of the shape once: it depends on neither friction nor mass."""
    estimate = EstimatedBody.of
    bodies = []

    def once(shape):
        if not bodies:
            bodies.append(estimate(shape))
        return bodies[0]

    monkeypatch.setattr(EstimatedBody, "of", once)


def success_at(grasps, shape, friction, mass):
    """The success of grasps if friction and mass were known."""
    known = dataclasses.replace(grasps, meta=grasps.meta | {"friction": str(friction)})
    [features] = measure_again(
        *stand_upright(known, load_hand("barrett"), shape), GraspTask(mass=mass)
    )
    return torch.sigmoid(load_success_model().log_odds(features))


def test_the_score_is_that_of_the_mean_success_over_single_frictions_and_masses(planned, one_body):
    grasps, shape = planned
    good = grasps.executable
    assert len(good) >= 3
    single = torch.zeros(len(good), dtype=torch.float64)
    frictions = [*(torch.linspace(0.3, 0.8, 17)[1::2].tolist()), 1.0]  # eight middles, and a number
    for friction in frictions:
        weight = 0.25 if friction == 1.0 else 0.75 / 8
        for mass in (0.15, 0.25, 0.35):
            single += weight / 3 * success_at(good, shape, friction, mass)
    near(torch.sigmoid(good.score), single, 0.02)  # in another frame features differ a bit
    # the exact mean is near, too
    drawn = zip(FRICTION.sample(20, 0).tolist(), MASS.sample(20, 1).tolist(), strict=True)
    mean = torch.stack([success_at(good, shape, *pair) for pair in drawn]).mean(0)
    near(torch.sigmoid(good.score), mean, 0.12)


def test_files_and_descriptions_keep_the_distributions(planned, tmp_path):
    grasps, _ = planned
    grasps.save(tmp_path / "grasps.safetensors")
    back = load_grasps(tmp_path / "grasps.safetensors")
    assert Distribution.parse(back.meta["friction"]) == FRICTION
    assert back.meta["task"] == f"task of {MASS} kg" == "task of 0.1:0.4 kg"
    assert torch.equal(back.score, grasps.score)


def test_success_is_explained_under_the_distribution(planned):
    grasps, shape = planned
    costs = explain_success(grasps, load_hand("barrett"), shape, GraspTask(mass=MASS))
    assert costs and all(cost.log_odds > 0 for cost in costs)
    told = {cost.cause: cost.sentence for cost in costs}
    heavy = explain_success(
        grasps, load_hand("barrett"), shape, GraspTask(mass=Distribution.parse("0.7:0.9"))
    )
    assert "the task is 0.8 kg at a friction of 0.66" in [cost.sentence for cost in heavy], told


def test_what_no_trial_supports_is_told(planned):
    """The trials have masses up to 1 kg: a quarter of 0.7 to 1.1 kg is above."""
    grasps, shape = planned
    task = GraspTask(mass=Distribution.parse("0.7:1.1"))
    told = {x.cause: x for x in explain_success(grasps, load_hand("barrett"), shape, task)}
    assert told["task"].sentence.endswith("no trial supports 25% of these frictions and masses")
    known = explain_success(grasps, load_hand("barrett"), shape, GraspTask(mass=MASS))
    assert not any("no trial" in cost.sentence for cost in known)


def test_distributions_of_impossible_numbers_are_refused():
    with pytest.raises(BadArgument, match=r"friction: expected a distribution in \[0, 10\]"):
        ContactSpec(friction=Distribution.between(-0.1, 0.5))
    with pytest.raises(BadArgument, match=r"mass: expected a distribution in \[0.001, 10\]"):
        GraspTask(mass=Distribution.between(0.0, 0.5))
    with pytest.raises(BadArgument, match=r"friction: expected a number in \[0, 10\] or"):
        ContactSpec(friction="0.3:0.8")  # type: ignore[arg-type]


def test_contacts_close_at_the_planned_friction_of_the_distribution(planned):
    """A set that needs more friction would not be closed (`critical_friction` is exact)."""
    grasps, _ = planned
    spec = ContactSpec(FRICTION)
    assert spec.planned_friction == pytest.approx(0.33125)
    assert float(grasps.meta["planned_friction"]) == pytest.approx(0.33125, rel=1e-5)
    good = grasps.executable
    needed = critical_friction(good.contacts.points, good.contacts.normals)
    assert len(good) and bool((needed <= spec.planned_friction + 1e-6).all())
    again = certify(grasps.contacts, spec)
    assert torch.equal(again.closed, grasps.certificate.closed)
    near(again.margin, grasps.certificate.margin, 1e-6)


def test_a_certain_distribution_is_planned_as_its_number():
    certain = ContactSpec(friction=Distribution.between(0.5, 0.5))
    assert certain.planned_friction == ContactSpec(friction=0.5).planned_friction == 0.25
