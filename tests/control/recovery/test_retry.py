"""Closing once more: what is judged before a lift, how the hand opens, and when the controller does so."""

import dataclasses

import pytest
import torch

from tests.control.test_closing_parts import press
from tests.point_fingers import NORMALS, PERIOD, TARGET, TOUCHING, observation, real, reference
from torchgrasp.control import GraspController, load_controller_state
from torchgrasp.control.closing import PALM_SPEED
from torchgrasp.control.controller import ATTEMPTS, CLOSING_TIME, PRESSING_TIME
from torchgrasp.control.recovery.retry import ASIDE, OPENING, RESTING, PressCheck, Reopening
from torchgrasp.geometry.plane import Plane
from torchgrasp.specs import SensorModel, closes_again

STILL, PLACE = torch.zeros(3).double(), torch.zeros(6).double()


def known(**changes):
    return dataclasses.replace(reference(), table=Plane(real([0, 1, 0]), -0.1), **changes)


def judge(seen, believed=PLACE, last=False, reference=None) -> PressCheck:
    check = PressCheck(known() if reference is None else reference, believed, STILL, last)
    for k in range(60):
        check(seen, k * PERIOD, PRESSING_TIME)
    return check


def pressing(contact=TOUCHING, **changes):
    seen = observation(-0.001, (2.0, 2.0, 4.0), contact)
    return dataclasses.replace(seen, tactile=dataclasses.replace(seen.tactile, **changes))


def test_three_balanced_contacts_are_secure():
    check = judge(pressing())
    assert check.judged and check.secure


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_a_finger_in_the_air_is_not(missing):
    contact = TOUCHING.clone()
    contact[missing] = False
    check = judge(pressing(contact))
    assert check.judged and not check.secure


@pytest.mark.parametrize(("degrees", "secure"), [(25.0, True), (36.0, False)])
def test_contacts_that_balance_beyond_friction_are_not(degrees, secure):
    # all normals lean the same way across the line of the forces, by more or less than atan(0.6) = 31 degrees
    angle = torch.deg2rad(real(degrees))
    leaning = torch.stack([NORMALS[:, 0] * angle.cos(), angle.sin().expand(3), NORMALS[:, 2]], -1)
    assert judge(pressing(normals=leaning)).secure is secure


@pytest.mark.parametrize(("off", "secure"), [(0.9 * ASIDE, True), (1.1 * ASIDE, False)])
def test_an_object_aside_is_not(off, secure):
    assert judge(pressing(), torch.cat([real([0, 0, off]), STILL])).secure is secure


def test_the_last_attempt_is_lifted_in_any_case():
    check = judge(pressing(torch.zeros(3, dtype=torch.bool)), last=True)
    assert check.judged and check.secure


def test_fingertips_that_tell_no_place_are_judged_by_their_touch():
    nowhere = torch.full((3, 3), torch.nan).double()
    assert judge(pressing(points=nowhere, normals=nowhere)).secure
    dead = known()
    dead = dataclasses.replace(dead, sensor=SensorModel(dead=(dead.hand.finger_names[2],)))
    contact = torch.tensor([True, True, False])
    assert judge(pressing(contact), reference=dead).secure
    assert not judge(pressing(torch.tensor([True, False, False])), reference=dead).secure


def test_a_hand_opens_before_its_palm_moves():
    start, shift = torch.full((9,), 0.1).double(), real([0.01, 0.005, -0.01])
    opening = Reopening(known(), torch.cat([shift, STILL]), start, STILL, 0.02)
    goal, palms, ticks = shift * real([1, 0, 1]), [STILL], 0  # along the table
    while not opening.done:
        joints, ticks = opening(PERIOD), ticks + 1
        palms.append(opening.palm)
        if not torch.equal(joints, known().expand(known().pregrasp)):
            assert torch.equal(opening.palm, STILL)
    assert torch.equal(opening.palm, goal)
    speeds = torch.stack(palms).diff(dim=0).norm(dim=-1) / PERIOD
    assert speeds.max() <= PALM_SPEED * (1 + 1e-9)
    assert abs(ticks * PERIOD - (OPENING + float(goal.norm()) / PALM_SPEED + RESTING)) < 3 * PERIOD


@pytest.mark.parametrize(("reach", "length"), [(0.02, 0.02), (0.0, 0.0)])
def test_the_palm_goes_no_farther_than_the_arm_yields(reach, length):
    opening = Reopening(known(), torch.cat([real([0.03, 0, 0.04]), STILL]), torch.zeros(9).double(), STILL, reach)
    while not opening.done:
        opening(PERIOD)
    assert abs(float(opening.palm.norm()) - length) < 1e-12


def close(controller: GraspController, seen) -> int:
    """Close on what is always observed; return the ticks until the hand counts as closed."""
    for k in range(3000):
        if controller.closed:
            return k
        controller.step(seen, PERIOD)
    raise AssertionError("the hand never closed")


@pytest.mark.parametrize("closing", ["uncertainty", "fixed"])
def test_a_hand_that_meets_nothing_closes_as_often_as_it_may(closing):
    controller = GraspController(known(), closing)
    ticks = close(controller, observation(0.02))
    assert controller.attempts == ATTEMPTS
    assert ticks * PERIOD < ATTEMPTS * (CLOSING_TIME + PRESSING_TIME) + OPENING + 0.02 / PALM_SPEED + RESTING + 0.2


@pytest.mark.parametrize(
    ("closing", "without", "table"),
    [("uncertainty", ("retry",), True), ("uncertainty", ("place",), True), ("uncertainty", (), False),
     ("position", (), True), ("paper", (), True)],
)  # fmt: skip
def test_a_hand_without_retry_or_table_closes_once(closing, without, table):
    held = known() if table else reference()
    controller = GraspController(held, closing, without=without)
    for _ in range(1500):
        controller.step(observation(0.02), PERIOD)
    assert controller.attempts == 1 and controller.reopening is None
    assert not closes_again(closing, without) or not table


def test_a_good_grasp_is_lifted_at_once():
    controller = GraspController(known())
    press(controller, 3.0)
    assert controller.closed and controller.attempts == 1


def test_the_second_closing_expects_the_object_where_it_was_found():
    controller = GraspController(known())
    while controller.reopening is None:
        controller.step(observation(0.02), PERIOD)
    found = controller.reopening.displacement
    while controller.attempts == 1:
        targets = controller.step(observation(0.02), PERIOD)
    assert torch.equal(controller.closing.placement.expected, found)
    assert torch.equal(controller.closing.palm, targets.palm)
    in_air = controller.closing.placement.displacement(TARGET + 0.05 * NORMALS, ~TOUCHING)
    assert torch.equal(in_air, found)  # fingers before their contacts tell nothing


@pytest.mark.parametrize("after", [5, 40, 80, 200])
def test_a_hand_that_opens_again_is_restored_to_the_same_bits(after, tmp_path):
    whole, first, second = (GraspController(known(), "uncertainty", "grip") for _ in range(3))
    seen, count = observation(0.02), 0
    while whole.reopening is None:
        whole.step(seen, PERIOD)
        first.step(seen, PERIOD)
        count += 1
    for _ in range(after):
        whole.step(seen, PERIOD)
        first.step(seen, PERIOD)
    first.state().save(tmp_path / "state.safetensors")
    second.restore(load_controller_state(tmp_path / "state.safetensors"))
    assert second.attempts == first.attempts
    for _ in range(300):
        mine, its = second.step(seen, PERIOD), whole.step(seen, PERIOD)
        assert torch.equal(mine.joints, its.joints) and torch.equal(mine.palm, its.palm)
    assert second.closed == whole.closed
