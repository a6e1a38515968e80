"""The controllers without a simulator: when fingers wait, stop and press, and what the squeeze asks of the joints."""

import dataclasses

import pytest
import torch

from tests.point_fingers import FREE, GAINS, NORMALS, PERIOD, TARGET, TOUCHING, observation, real, reference
from torchgrasp.control.controller import CLOSING_TIME, GraspController
from torchgrasp.control.holding import RAMP, ForceHold, held_forces
from torchgrasp.control.law import MAX_SPEED, POSITION_FLOOR, POSITION_RATE
from torchgrasp.control.observation import Observation
from torchgrasp.control.paper.closings import POSE_TIME, SETTLED, STOP_FORCE, PositionClosing
from torchgrasp.control.recovery import PRESSING_TIME
from torchgrasp.control.sensing import WAITING_FORCE
from torchgrasp.control.uncertainty_closing import LEAD, PATIENCE, QUICK_TOUCH, UncertaintyClosing, with_equal_gains
from torchgrasp.errors import BadArgument
from torchgrasp.specs import ClosingOptions


def test_eq25_free_fingers_approach_their_contacts():
    step = UncertaintyClosing(reference(), ClosingOptions())(observation(), PERIOD).reshape(3, 3)
    assert ((step * NORMALS).sum(-1) < 0).all()
    assert step.norm(dim=-1).max() <= MAX_SPEED * PERIOD + 1e-12
    assert step[:, 1:].abs().max() < 1e-9


def test_a_finger_that_has_touched_rests_and_gives_way_to_more_than_the_waiting_force():
    one = torch.tensor([True, False, False])
    law = UncertaintyClosing(reference(), ClosingOptions(palm_reach=0.0, stops=0))
    for reading in (WAITING_FORCE, 0.1, 0.0, -0.1):
        step = law(observation(0.02, (reading, 0, 0), one), PERIOD).reshape(3, 3)
        assert step[0].abs().max() < 1e-12
        one = FREE  # it stays where it touched once
    step = law(observation(0.02, (1.0, 0, 0)), PERIOD).reshape(3, 3)
    assert float((step[0] * NORMALS[0]).sum()) > 0
    last = law(observation(0.02, (0.0, QUICK_TOUCH, QUICK_TOUCH)), PERIOD).reshape(3, 3)
    assert float((last[0] * NORMALS[0]).sum()) < float((step[0] * NORMALS[0]).sum())  # all have: now all press


def test_closing_ends_when_all_touch_or_patience_is_over():
    controller = UncertaintyClosing(reference(), ClosingOptions())
    for contact, wait in ((TOUCHING, SETTLED), (torch.tensor([True, False, False]), PATIENCE)):
        controller = UncertaintyClosing(reference(), ClosingOptions())
        ticks = 0
        while not controller.done:
            controller(observation(contact=contact), PERIOD)
            ticks += 1
        assert ticks * PERIOD == pytest.approx(wait, abs=1.5 * PERIOD)
    controller = UncertaintyClosing(reference(), ClosingOptions())
    for _ in range(300):
        controller(observation(), PERIOD)
    assert not controller.done


def test_targets_stay_within_limits_and_near_the_joints():
    controller = UncertaintyClosing(reference(), ClosingOptions())
    for _ in range(500):
        targets = controller(observation(0.5), PERIOD)
    assert targets.abs().max() == pytest.approx(LEAD)
    stopping = PositionClosing(reference())
    for _ in range(5000):
        targets = stopping(observation(0.5), PERIOD)
    assert targets.abs().max() == pytest.approx(1.0)


def test_the_baseline_stops_each_finger_by_itself_and_for_good():
    controller = PositionClosing(reference())
    first = controller(observation(0.02, (STOP_FORCE, 0.0, 0.0)), PERIOD).reshape(3, 3)
    assert first[0].abs().max() == 0
    assert (first[1:].abs().amax(-1) > 0).all()
    later = controller(observation(0.02), PERIOD).reshape(3, 3)
    assert later[0].abs().max() == 0
    assert not controller.done
    controller(observation(), PERIOD)  # at the planned contacts nothing is felt: it goes on
    assert not controller.done
    controller(observation(0.0005 - 0.02), PERIOD)
    assert controller.done


def test_held_forces_are_balanced_at_the_sensed_contacts():
    forces, total = held_forces(reference(), observation(contact=TOUCHING))
    assert forces.sum(0).abs().max() < 1e-9
    assert torch.linalg.cross(TARGET, forces).sum(0).abs().max() < 1e-9
    assert total == pytest.approx(8.0, rel=0.02)
    assert float((-(forces * NORMALS).sum(-1)).max()) == pytest.approx(4.0)
    planned, total = held_forces(reference(), observation(contact=torch.tensor([True, True, False])))
    assert torch.equal(planned, GAINS.desired_force)
    assert total == pytest.approx(8.0)


def test_the_squeeze_rises_to_what_the_drives_turn_into_the_forces():
    start = 0.01 * torch.ones(9).double()
    seen = observation(0.0, contact=TOUCHING, reading=(2.0, 2.0, 4.0))
    hold = ForceHold(reference(), seen, start)
    first = hold(seen, PERIOD)
    assert (first - start).abs().max() < 0.1
    for _ in range(round(RAMP / PERIOD)):
        last = hold(seen, PERIOD)
    forces, _ = held_forces(reference(), seen)
    assert torch.allclose(2.0 * last.reshape(3, 3), forces, atol=0.02)  # kp times the lead of sliding joints is force
    weak = observation(0.0, contact=TOUCHING, reading=(1.0, 1.0, 2.0))
    for _ in range(50):
        more = hold(weak, PERIOD)
    assert more.norm() > 1.1 * last.norm()
    for _ in range(1000):
        more = hold(weak, PERIOD)
    assert more.norm() == pytest.approx(1.5 * float(forces.norm()) / 2.0, rel=1e-6)


def run(controller: GraspController, seen: Observation, seconds: float) -> list[torch.Tensor]:
    return [controller.step(seen, PERIOD).joints for _ in range(round(seconds / PERIOD))]


def test_the_open_loop_goes_through_its_three_poses_whatever_is_felt():
    opened = dataclasses.replace(reference(), pregrasp=reference().joints - 0.01)
    controller = GraspController(opened, "open_loop")
    assert not controller.closed
    path = torch.stack(run(controller, observation(contact=TOUCHING), 2 * POSE_TIME + 0.2))
    assert torch.allclose(path[39], real(0.0), atol=1e-12) and torch.allclose(path[19], real(-0.005))
    assert torch.allclose(path[79:], real(0.02)) and torch.allclose(path[59], real(0.01))
    assert controller.closed


@pytest.mark.parametrize("closing", ["position", "fixed", "uncertainty"])
def test_closing_ends_in_time_and_a_holding_takes_over(closing):
    controller = GraspController(reference(), closing)
    run(controller, observation(0.05), CLOSING_TIME - PERIOD)
    assert controller.hold is None
    run(controller, observation(0.05), 3 * PERIOD)
    assert isinstance(controller.hold, ForceHold) and not controller.closed
    run(controller, observation(0.05), PRESSING_TIME)
    assert controller.closed


@pytest.mark.parametrize("holding", ["force", "grip", "position", "law"])
def test_targets_stay_while_the_forces_of_the_holding_are_sought(holding):
    controller = GraspController(reference(), holding=holding)
    seen = observation(contact=TOUCHING, reading=(2.0, 2.0, 4.0))
    while controller.hold is None:
        before = controller.targets.joints
        targets = controller.step(seen, PERIOD)
    assert torch.equal(targets.joints, before) and controller.pressed == 0.0
    controller.step(seen, PERIOD)
    assert controller.pressed == PERIOD


def test_joints_of_a_diverged_simulation_pass():
    known, lost = reference(), torch.full((9,), torch.nan).double()
    assert torch.isnan(known.expand(lost)).all() and torch.isnan(known.pick(lost)).all()
    assert torch.isnan(known.hand.actuated.couple(lost)).all()


def test_the_first_targets_are_the_opened_hand_and_unknown_names_are_refused():
    assert torch.equal(GraspController(reference()).targets.joints, reference().pregrasp)
    with pytest.raises((BadArgument, TypeError), match="slow"):
        GraspController(reference(), "slow")  # pyright: ignore[reportArgumentType]
    with pytest.raises((BadArgument, TypeError), match="glue"):
        GraspController(reference(), "fixed", "glue")  # pyright: ignore[reportArgumentType]


def test_fixed_gains_know_nothing_of_the_surface():
    """Eq. 27 without uncertainty: each contact and each direction has the rate of the floor alone."""
    gains = with_equal_gains(reference()).gains
    assert torch.allclose(gains.position_gain, real(POSITION_RATE))
    assert torch.allclose(gains.covariance, POSITION_FLOOR**2 * torch.eye(3).double())
    assert (gains.force_gain == gains.force_gain[:, :1]).all()
    assert torch.equal(gains.target, GAINS.target)


def test_fingers_in_the_air_arrive_together():
    seen = observation(0.2)
    near = dataclasses.replace(seen, tips=TARGET + 0.01 * NORMALS + real([[0.2], [0.1], [0.2]]) * NORMALS)
    step = UncertaintyClosing(reference(), ClosingOptions())(near, PERIOD).reshape(3, 3)
    speed = -(step * NORMALS).sum(-1)
    assert float(speed[1] / speed[0]) == pytest.approx((0.1 + POSITION_FLOOR) / (0.2 + POSITION_FLOOR), rel=1e-3)
    assert float(speed[2]) == pytest.approx(float(speed[0]))


def test_a_late_finger_searches_on_beyond_its_planned_contact_and_presses_harder():
    two = torch.tensor([True, True, False])
    seen = observation(-0.03, (0.3, 0.3, 0.0), two)
    controller = UncertaintyClosing(reference(), ClosingOptions())
    first = controller(seen, PERIOD).reshape(3, 3)
    assert float(first[2] @ NORMALS[2]) < -0.5 * MAX_SPEED * PERIOD
    for _ in range(250):
        last = controller(seen, PERIOD)
    assert last.abs().max() > 1.5 * LEAD  # the joints do not follow, as if blocked
