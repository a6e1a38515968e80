"""Observations of a real robot: those of another hand, sign, unit or frame are refused by name, and
right ones are taken.
"""

import dataclasses
import functools
import math

import pytest
import torch

from tests.make import real
from torchgrasp import ClosingReference, GraspController, load_hand
from torchgrasp.control import feel_flags, feel_torques, no_contact, observe
from torchgrasp.control.observation_check import BOUNDS
from torchgrasp.control.tactile import TactileState
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.values.closing import SensorModel

PERIOD = 0.01


@functools.cache
def plan(hand: str = "allegro") -> ClosingReference:
    return ClosingReference.from_grasp(load_hand(hand), load_shipped_grasp("jug", hand))


def pressing(reference: ClosingReference, **changes) -> TactileState:
    """Readings of fingertips that press at the planned contacts with friction; some are changed."""
    normals = reference.normals.clone()
    forces = reference.gains.desired_force.clone()
    tips = reference.hand.tip_centres(reference.joints)
    points = reference.contact_points(tips)
    push = -(forces * normals).sum(-1)
    known = {"reading": push, "forces": forces, "points": points, "normals": normals}
    contact = torch.ones(len(normals), dtype=torch.bool)
    return dataclasses.replace(
        no_contact(fingers=len(normals)), contact=contact, average=push, **(known | changes)
    )


def seen(reference: ClosingReference, tactile: TactileState, joints=None, up=None):
    return observe(reference.hand, reference.joints if joints is None else joints, tactile, up)


@pytest.mark.parametrize("hand", ["allegro", "barrett"])
def test_what_a_robot_measures_is_taken_also_with_noise_and_a_tilted_hand(hand):
    reference = plan(hand)
    controller = GraspController(reference)
    generator = torch.Generator().manual_seed(0)
    table = reference.planned_table
    for _ in range(20):
        draw = [
            torch.randn(3, 3, generator=generator, dtype=torch.float64),
            torch.randn(3, generator=generator, dtype=torch.float64),
        ]
        right = pressing(reference)
        noisy = dataclasses.replace(
            right,
            reading=right.reading + 0.1 * draw[1],
            forces=right.forces + 0.3 * draw[0],
            points=right.points + 0.002 * draw[0],
        )
        up = table.normal + 0.1 * draw[1]
        controller.step(seen(reference, noisy, up=up / up.norm()), PERIOD)


def wrong_readings(reference: ClosingReference) -> dict[str, dict]:
    """Readings with one fault each, by the name that the error tells."""
    right = pressing(reference)
    pose = reference.obj_from_hand
    return {
        "reading.*positive": {"reading": -right.reading},
        "reading.*newtons": {"reading": 1000 * right.reading, "forces": 1000 * right.forces},
        "forces.*against": {"forces": -right.forces},
        "points.*metres": {"points": 1000 * right.points},
        "points.*frame": {"points": apply(pose, right.points)},
        "normals.*outward": {"normals": -right.normals},
        "normals.*unit": {"normals": 1.1 * right.normals},
        "points.* root link": {
            "points": apply(pose, right.points),
            "normals": rotate(pose, right.normals),
            "forces": rotate(pose, right.forces),
        },
    }


@pytest.mark.parametrize("hand", ["allegro", "barrett"])
@pytest.mark.parametrize("told", [*wrong_readings(plan())])
def test_readings_of_another_sign_unit_or_frame_are_refused(hand, told):
    reference = plan(hand)
    wrong = pressing(reference, **wrong_readings(reference)[told])
    with pytest.raises(BadArgument, match=told):
        GraspController(reference).step(seen(reference, wrong), PERIOD)


def test_readings_of_a_sensor_that_is_known_to_be_dead_do_not_count():
    reference = plan()
    dead = dataclasses.replace(reference, sensor=SensorModel(dead=("middle",)))
    ours = GraspController(dead)
    theirs = GraspController(dead)
    for k in range(5):
        silent = pressing(reference)
        loud = pressing(reference)
        for name in ("reading", "average", "contact", "forces", "points", "normals"):
            nothing = getattr(no_contact(), name)
            # a broken sensor shows anything
            garbage = {"contact": True, "points": 9.0, "normals": 5.0}.get(name, -1e5 + k)
            getattr(silent, name)[1] = nothing[1]
            getattr(loud, name)[1] = garbage
        sent = ours.step(seen(dead, silent), PERIOD)
        assert torch.equal(sent.joints, theirs.step(seen(dead, loud), PERIOD).joints)


def test_an_upward_vector_is_in_the_frame_of_the_hand_until_the_hand_holds():
    reference = plan()
    up = real([0.0, 0.0, 1.0])
    in_hand = reference.obj_from_hand[:3, :3].T @ up
    controller = GraspController(reference)
    controller.step(seen(reference, pressing(reference), up=in_hand), PERIOD)
    with pytest.raises(BadArgument, match=r"observation\.up.*obj_from_hand"):
        controller.step(seen(reference, pressing(reference), up=up), PERIOD)
    while controller.hold is None:
        controller.step(seen(reference, pressing(reference), up=in_hand), PERIOD)
    # an arm turns the hand with the object
    controller.step(seen(reference, pressing(reference), up=up), PERIOD)


def test_an_observation_of_another_hand_of_equal_joints_or_of_other_fingers_is_refused():
    reference = plan()
    controller = GraspController(reference)
    left = load_hand("allegro_left")
    others = load_hand("allegro", fingers=("index", "ring", "thumb"))
    for hand in (left, others):
        middle = (hand.lower + hand.upper) / 2
        with pytest.raises(BadArgument, match=r"observation: expected allegro: index, middle"):
            controller.step(observe(hand, middle, no_contact()), PERIOD)
    with pytest.raises(BadArgument, match="tactile: expected those of the fingers index"):
        observe(reference.hand, reference.joints, no_contact(fingers=4))


def test_a_joint_that_jumps_and_a_hand_that_is_not_at_its_pregrasp_are_refused():
    reference = plan()
    start = reference.pregrasp
    lost = torch.zeros_like(start)  # a message that did not come
    controller = GraspController(reference)
    for shift in (0.0, 0.1, 0.2):
        controller.step(seen(reference, no_contact(), start + shift * (start < 0.5)), PERIOD)
    with pytest.raises(BadArgument, match=r"observation\.joints.*jump"):
        controller.step(seen(reference, no_contact(), lost), PERIOD)
    controller.step(seen(reference, no_contact(), start), PERIOD)
    # a slow loop sees large motions
    GraspController(reference).step(seen(reference, no_contact(), start), 0.1)
    other_order = start.flip(0).clamp(reference.hand.lower, reference.hand.upper)
    for joints in (lost, other_order):
        with pytest.raises(BadArgument, match=r"observation\.joints.*the pre-grasp"):
            GraspController(reference).step(seen(reference, no_contact(), joints), PERIOD)


def test_fingertips_that_sense_less_than_the_plan_says_are_told_within_half_a_second():
    reference = plan()
    flags = feel_flags(no_contact(), torch.tensor([True, True, False]))

    def touch(plan: ClosingReference) -> None:
        controller = GraspController(plan)
        for _ in range(math.ceil(BOUNDS.unplaced / PERIOD) + 1):
            controller.step(seen(plan, flags), PERIOD)

    with pytest.raises(BadArgument, match=r"reference\.sensor.*binary"):
        touch(reference)
    touch(dataclasses.replace(reference, sensor=SensorModel("binary")))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torques_of_the_other_sign_are_told_and_right_ones_taken(sign):
    reference = dataclasses.replace(plan(), sensor=SensorModel("torque"))
    controller = GraspController(reference)
    tactile = no_contact()
    jacobian = seen(reference, tactile).jacobian
    torques = sign * torch.einsum("fcj,fc->j", jacobian, reference.gains.desired_force)

    def press() -> None:
        nonlocal tactile
        for _ in range(80):
            tactile = feel_torques(tactile, reference, jacobian, torques, PERIOD)
            controller.step(seen(reference, tactile), PERIOD)

    if sign > 0:
        press()
        return
    with pytest.raises(BadArgument, match=r"tactile\.forces.*direction of their joints"):
        press()


def test_torques_in_newton_millimetres_and_periods_in_milliseconds_are_refused():
    reference = plan()
    jacobian = seen(reference, no_contact()).jacobian
    torques = torch.einsum("fcj,fc->j", jacobian, reference.gains.desired_force)
    feel_torques(no_contact(), reference, jacobian, torques, PERIOD)
    with pytest.raises(BadArgument, match=r"torques.*N m"):
        feel_torques(no_contact(), reference, jacobian, 1000 * torques, PERIOD)
    with pytest.raises(BadArgument, match="period"):
        feel_torques(no_contact(), reference, jacobian, torques, 10.0)
