"""The next grasp of a robot after a failed lift: when the lift has failed, how the hand withdraws,
and where it then expects the object.
"""

import dataclasses

import pytest
import torch

from tests.control.test_guarded_approach import LENGTH, above
from tests.control.test_localization import CENTER
from tests.control.test_relook import seen_ball
from tests.pinch import pinch
from tests.point_fingers import (
    FREE,
    PERIOD,
    TARGET,
    TOUCHING,
    close_on_block,
    observation,
    on_table,
    real,
)
from torchgrasp import GraspController
from torchgrasp.control import GraspTry, no_contact
from torchgrasp.control.regrasp import next_grasp
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps

AWAY = 0.008  # displacement [m] of the block along x of the hand
PRESSED = 0.05  # joints of the closed hand [rad]


def around(*degrees: float) -> Grasps:
    """The pinch of a cylinder, turned about its axis."""
    grasp = pinch("allegro")[1][[0] * len(degrees)]
    turns = torch.deg2rad(real(degrees))[:, None] * real([0.0, 0.0, 1.0])
    pose = rigid(rotation_from_vector(turns), torch.zeros(len(degrees), 3).double())
    approach = (pose[:, :3, :3] @ grasp.approach[..., None])[..., 0]
    return dataclasses.replace(grasp, obj_from_hand=pose @ grasp.obj_from_hand, approach=approach)


def start(grasp: Grasps) -> GraspController:
    """The controller of three point fingers on a table, at the pose of a grasp."""
    return GraspController(on_table(obj_from_hand=grasp.obj_from_hand[0]))


def test_a_lift_fails_where_the_object_is_lost_or_too_heavy():
    attempt = GraspTry(around(0.0, 90.0), start)
    held = observation(-0.001, (2.0, 2.0, 4.0), TOUCHING)
    assert not attempt.fails(held, 0.03, PERIOD) and not attempt.failed
    list(close_on_block(attempt.controller, 3.0))
    attempt.controller.hold.status = Status.TOO_HEAVY
    assert attempt.fails(held, 0.03, PERIOD) and attempt.failed and not attempt.lost
    attempt = GraspTry(around(0.0, 90.0), start)
    assert attempt.fails(observation(contact=FREE), 0.03, PERIOD) and attempt.lost
    assert attempt.fails(held, 0.03, PERIOD)  # for good


def test_a_controller_of_another_grasp_is_refused():
    grasps = around(0.0, 90.0)
    fixed = start(grasps[0])
    attempt = GraspTry(grasps, lambda grasp: fixed)
    with pytest.raises(BadArgument, match=r"start: .*another pose"):
        attempt.next()


def test_the_hand_opens_before_it_withdraws_and_then_waits():
    attempt = GraspTry(around(0.0), start)
    closed = observation(joints=torch.full((9,), PRESSED).double())
    withdrawal = attempt.withdraw(closed, PERIOD, 0.1)
    sent = []
    speed = []
    for targets in withdrawal:
        sent.append(targets)
        speed.append(withdrawal.speed)
    left = real([0.0, *(x.left for x in sent)])
    joints = torch.stack([x.joints for x in sent])
    first = int((left > 0).nonzero()[0]) - 1
    opened = attempt.controller.reference.pregrasp
    assert (joints[0] - PRESSED).abs().max() < 0.1 * PRESSED
    assert torch.equal(joints[first:], opened.expand(len(sent) - first, -1))
    assert bool((left.diff() >= 0).all()) and float(left[-1]) == 0.1
    resting = int((left == 0.1).sum())
    assert resting == pytest.approx((len(left) - first) / 2, abs=2)
    # the speed is the rate of the distance, between the ticks before and after
    rates = (left[2:] - left[:-2]) / (2 * PERIOD)
    assert torch.allclose(real(speed[:-1]), rates, rtol=0, atol=5e-3)


def test_the_next_try_is_of_the_next_grasp_at_the_object_where_the_touches_show_it():
    """Each time the block is found again at the same side of the hand; tries add up."""
    grasps = around(0.0, 40.0, 80.0)
    attempt = GraspTry(grasps, start)
    there = torch.eye(4).double()
    tried = [0]
    for _ in range(2):
        believed = attempt.obj_from_hand
        list(close_on_block(attempt.controller, 2.0, away=AWAY))
        # points of the block where the hand expects them, and the same points where they are
        before = apply(believed, TARGET)
        after = apply(believed, TARGET + real([AWAY, 0.0, 0.0]))
        there = attempt.moved
        following = attempt.next()
        row = next_grasp(grasps, tried)
        tried.append(row)
        assert (following.row, following.tried) == (row, tuple(tried))
        pose = following.controller.reference.obj_from_hand
        assert torch.equal(pose, grasps.obj_from_hand[row])
        step = following.moved @ torch.linalg.inv(there)
        assert (apply(step, before) - after).norm(dim=-1).max() < 0.2 * AWAY
        expected = following.moved @ grasps.obj_from_hand[row]
        assert torch.equal(following.obj_from_hand, expected)
        attempt = following
    assert len(attempt.others) == 0 and attempt.next() is None


def test_the_object_is_expected_where_a_second_look_has_shown_it():
    shift = real([0.05, 0.0, 0.03])
    controller = GraspController(above(), approach=LENGTH)
    assert torch.allclose(controller.object_motion, torch.eye(4).double())
    controller.relook(seen_ball(shift))
    pose = controller.planned.obj_from_hand
    found = apply(controller.object_motion, apply(pose, CENTER[None]))
    assert (found - apply(pose, (CENTER + shift)[None])).norm() < 1e-3


def test_a_controller_that_does_not_locate_the_object_expects_it_in_place():
    controller = GraspController(on_table(), closing="open_loop")
    assert torch.equal(controller.displacement, torch.eye(4).double())


@pytest.mark.parametrize("tried", [(), (2,), (0, -1)])
def test_rows_that_are_no_grasps_are_refused(tried):
    with pytest.raises(BadArgument, match="tried"):
        GraspTry(around(0.0, 90.0), start, tried=tried)


def test_no_grasp_is_next_where_none_is_left():
    with pytest.raises(BadArgument, match="another one"):
        next_grasp(around(0.0, 10.0), [0])


def test_the_next_try_begins_with_what_the_touches_have_left_of_an_uncertain_friction():
    def begin(grasp: Grasps) -> GraspController:
        friction = Distribution.read(grasp.meta["friction"])
        return GraspController(
            on_table(obj_from_hand=grasp.obj_from_hand[0], friction=friction), holding="grip"
        )

    def after(friction: str) -> Grasps:
        planned = around(0.0, 90.0)
        planned = dataclasses.replace(planned, meta=planned.meta | {"friction": friction})
        attempt = GraspTry(planned, begin)
        list(close_on_block(attempt.controller, 3.0))
        attempt.controller.hold.friction.update(0.6, 100.0, slides=False)  # it sticks
        return attempt.next()

    left = after("0.2:1")
    known = Distribution.parse(left.grasps.meta["friction"])
    assert 0.5 < known.least < 0.6 and known.most == 1.0
    assert left.controller.reference.friction == known
    assert after("0.8").grasps.meta["friction"] == "0.8"
    assert "mass" not in left.grasps.meta


def test_the_next_try_knows_what_a_load_that_is_too_heavy_shows_of_the_mass():
    attempt = GraspTry(
        around(0.0, 90.0),
        lambda grasp: GraspController(
            on_table(obj_from_hand=grasp.obj_from_hand[0]), holding="grip"
        ),
    )
    list(close_on_block(attempt.controller, 3.0))
    attempt.controller.hold.load.most = 9.81  # [N], the weight of 1 kg
    attempt.controller.hold.status = Status.TOO_HEAVY
    known = Distribution.parse(attempt.next().grasps.meta["mass"])
    assert known == attempt.controller.mass
    assert 0.3 < known.least < 1.0 < known.most


def test_grasps_that_failed_a_check_are_not_tried():
    grasps = around(0.0, 40.0, 80.0)
    failed = torch.tensor([Status.OK, Status.NOT_CLOSED, Status.OK]).to(grasps.status)
    grasps = dataclasses.replace(grasps, status=failed)
    attempt = GraspTry(grasps, start)
    assert attempt.others.tolist() == [2] and next_grasp(grasps, [0]) == 2
    assert GraspTry(grasps, start, tried=(0, 2)).next() is None
    with pytest.raises(BadArgument, match=r"tried: .*executable"):
        GraspTry(grasps, start, tried=(1,))


def test_a_surface_in_the_frame_of_the_hand_and_a_motion_that_is_changed_later_move_nothing():
    grasps = around(0.0, 90.0)
    far = SignedDistanceField(real([0.3, 0.0, 0.0]), 0.01, torch.ones(4, 4, 4).double())
    for ask in (lambda: GraspTry(grasps, start, far), lambda: next_grasp(grasps, [0], far)):
        with pytest.raises(BadArgument, match=r"surface.*frame of the grasp"):
            ask()
    moved = rigid(torch.eye(3).double(), real([0.02, 0.0, 0.0]))
    attempt = GraspTry(grasps, start, moved=moved)
    moved[0, 3] = 9.0
    assert float(attempt.moved[0, 3]) == 0.02
    other = dataclasses.replace(observation(), tactile=no_contact(fingers=4))
    with pytest.raises(BadArgument, match=r"observation: .*3 fingertips"):
        attempt.withdraw(other, PERIOD, 0.1)
