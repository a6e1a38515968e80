"""Closing once more: what is judged before a lift, how the hand opens, and when the controller does
so.
"""

import dataclasses
import math

import pytest
import torch

from tests.make import load_hand
from tests.point_fingers import (
    NORMALS,
    PERIOD,
    TARGET,
    TOUCHING,
    close_on_block,
    observation,
    on_table,
    real,
    reference,
)
from torchgrasp import ClosingReference, ContactSpec, GraspController
from torchgrasp.control.controller import CLOSING_TIME
from torchgrasp.control.recovery import (
    OPENING,
    PRESSING_TIME,
    GraspCheck,
    Reopening,
)
from torchgrasp.control.uncertainty_closing import PALM_SPEED
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.closing import NO_OPTIONS, ClosingOptions, SensorModel
from torchgrasp.values.distribution import Distribution

STILL = torch.zeros(3).double()
PLACE = torch.zeros(6).double()


def judge(seen, believed=PLACE, last=False, reference=None) -> GraspCheck:
    check = GraspCheck(on_table() if reference is None else reference, believed, STILL, last, [])
    for k in range(60):
        check(seen, k * PERIOD)
    return check


def pressing(contact=TOUCHING, **changes):
    seen = observation(-0.001, (2.0, 2.0, 4.0), contact)
    return dataclasses.replace(seen, tactile=dataclasses.replace(seen.tactile, **changes))


def test_grasp_check_accepts_balanced_contacts_and_rejects_a_finger_in_the_air():
    for missing in (None, 0, 1, 2):
        check = judge(pressing(TOUCHING if missing is None else torch.arange(3) != missing))
        assert check.judged and check.secure is (missing is None)


@pytest.mark.parametrize(
    ("degrees", "friction"), [(25.0, 0.6), (36.0, 0.6), (36.0, 0.8), (25.0, 0.4)]
)
def test_grasp_check_rejects_forces_beyond_the_planned_friction(degrees, friction):
    """All normals lean the same way across the line of the forces, by more or less than the angle
    of friction.
    """
    angle = torch.deg2rad(real(degrees))
    leaning = torch.stack([NORMALS[:, 0] * angle.cos(), angle.sin().expand(3), NORMALS[:, 2]], -1)
    check = judge(pressing(normals=leaning), reference=on_table(friction=friction))
    assert check.secure is (math.tan(math.radians(degrees)) < friction)
    likely = Distribution.between(friction - 0.1, friction + 0.1)  # its mean decides
    assert (
        judge(pressing(normals=leaning), reference=on_table(friction=likely)).secure is check.secure
    )


def test_the_closing_plan_knows_the_friction_that_the_grasp_was_planned_for():
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")

    def planned(friction):
        meta = {
            name: text
            for name, text in (grasp.meta | {"friction": friction}).items()
            if text is not None
        }
        return ClosingReference.from_grasp(hand, dataclasses.replace(grasp, meta=meta)).friction

    assert list(map(planned, ("0.5", "1", None))) == [0.5, 1.0, ContactSpec().friction]
    assert planned("0.2:0.6") == Distribution.between(0.2, 0.6)
    for text in ("wet", "-1", "nan", "-0.1:0.5"):
        with pytest.raises(BadArgument, match=r"friction.*a positive number"):
            planned(text)


@pytest.mark.parametrize(("off", "secure"), [(0.006, True), (0.01, False)])
def test_grasp_check_rejects_a_misplaced_object(off, secure):
    """The place is known to 4 mm; twice as far from the palm, the object is misplaced."""
    assert judge(pressing(), torch.cat([real([0, 0, off]), STILL])).secure is secure


def test_grasp_check_without_places_judges_by_touch_and_accepts_the_last_attempt():
    assert judge(pressing(torch.zeros(3, dtype=torch.bool)), last=True).secure
    nowhere = torch.full((3, 3), torch.nan).double()
    assert judge(pressing(points=nowhere, normals=nowhere)).secure
    dead = on_table()
    dead = dataclasses.replace(dead, sensor=SensorModel(dead=(dead.hand.finger_names[2],)))
    contact = torch.tensor([True, True, False])
    assert judge(pressing(contact), reference=dead).secure
    assert not judge(pressing(torch.tensor([True, False, False])), reference=dead).secure


def test_reopening_opens_before_the_palm_moves():
    start = torch.full((9,), 0.1).double()
    shift = real([0.01, 0.005, -0.01])
    opening = Reopening(on_table(), torch.cat([shift, STILL]), start, STILL, STILL, 0.02)
    # along the table
    goal = shift * real([1, 0, 1])
    palms = [STILL]
    ticks = 0
    while not opening.done:
        joints = opening(PERIOD)
        ticks = ticks + 1
        palms.append(opening.palm)
        if not torch.equal(joints, opening.opened):
            assert torch.equal(opening.palm, STILL)
    assert torch.equal(opening.palm, goal)
    speeds = torch.stack(palms).diff(dim=0).norm(dim=-1) / PERIOD
    assert speeds.max() <= PALM_SPEED * (1 + 1e-9)
    assert (
        abs(ticks * PERIOD - (OPENING.opening + float(goal.norm()) / PALM_SPEED + 0.1)) < 3 * PERIOD
    )


@pytest.mark.parametrize(("reach", "length"), [(0.02, 0.02), (0.0, 0.0)])
def test_reopening_keeps_the_palm_within_its_reach(reach, length):
    far = torch.cat([real([0.03, 0, 0.04]), STILL])
    joints = torch.zeros(9).double()
    opening = Reopening(on_table(), far, joints, STILL, STILL, reach)
    while not opening.done:
        opening(PERIOD)
    assert abs(float(opening.palm.norm()) - length) < 1e-12


def test_reopening_takes_fingers_and_palm_back_at_the_same_time():
    start = torch.full((9,), 0.1).double()
    begun = real([0.02, 0, 0])
    closed = real([0.01, 0, 0.01])
    opening = Reopening(on_table(), PLACE, start, closed, begun, 0.0)
    while not opening.done:
        joints = opening(PERIOD)
        share = (joints - start) / (opening.opened - start)
        assert torch.allclose(
            opening.palm, closed + share[:3] * (begun - closed), rtol=0, atol=1e-12
        )
    assert torch.equal(joints, opening.opened) and torch.equal(opening.palm, begun)


def test_only_a_hand_whose_fingers_have_all_touched_presses_before_it_is_judged():
    for missing in (None, 1):
        controller = GraspController(on_table())
        contact = TOUCHING if missing is None else torch.arange(3) != missing
        seen = observation(0.0, (0.3 * contact.double()).tolist(), contact)
        targets = []
        while controller.reopening is None and len(targets) < 1000:
            joints = controller.step(seen, PERIOD).joints
            targets += [joints] if controller.hold is not None else []
        assert torch.stack(targets).diff(dim=0).any() == (missing is None)


def close(controller: GraspController, seen) -> int:
    """Close on what is always observed; return the ticks until the hand counts as closed."""
    for k in range(3000):
        if controller.closed:
            return k
        controller.step(seen, PERIOD)
    raise AssertionError("the hand never closed")


@pytest.mark.parametrize("closing", ["uncertainty", "fixed"])
def test_controller_closes_again_after_meeting_nothing(closing):
    controller = GraspController(on_table(), closing, options=ClosingOptions(attempts=2))
    ticks = close(controller, observation(0.02))
    assert controller.attempts == 2
    assert ticks * PERIOD < controller.attempts * (
        CLOSING_TIME + PRESSING_TIME + OPENING.opening + 0.02 / PALM_SPEED + 0.3
    )


@pytest.mark.parametrize(
    ("closing", "options", "table"),
    [
        ("uncertainty", ClosingOptions(attempts=1), True),
        ("uncertainty", NO_OPTIONS, True),
        ("uncertainty", None, False),
        ("position", None, True),
        ("paper", None, True),
    ],
)
def test_controller_with_one_attempt_or_without_table_closes_once(closing, options, table):
    held = on_table() if table else reference()
    controller = GraspController(held, closing, options=options)
    for _ in range(240):
        controller.step(observation(0.02), 0.05)
    assert controller.attempts == 1 and controller.reopening is None


def test_controller_accepts_a_good_grasp_at_once_and_expects_the_object_where_it_was_found():
    controller = GraspController(on_table())
    for _ in close_on_block(controller, 3.0):
        pass
    assert controller.closed and controller.attempts == 1
    controller = GraspController(on_table())
    while controller.reopening is None:
        controller.step(observation(0.02), PERIOD)
    found = controller.reopening.displacement
    while controller.attempts == 1:
        targets = controller.step(observation(0.02), PERIOD)
    assert torch.equal(controller.closing.planes.expected, found)
    assert torch.equal(controller.closing.palm, targets.palm)
    in_air = controller.closing.planes.displacement(TARGET + 0.05 * NORMALS, ~TOUCHING)
    assert torch.equal(in_air, found)  # fingers before their contacts tell nothing
