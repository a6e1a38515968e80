"""Protocols on a pinched cylinder: what holds, what does not, and what statics says of how much it
takes.
"""

import dataclasses
import math

import pytest
import torch

from tests.make import near, real
from tests.pinch import cylinder, pinch
from torchgrasp.control import squeeze
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, PullSpec, Truth, lift_grasps, pull_grasp
from torchgrasp.evaluation.trial import TrialRun
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.hand.drives import joint_stiffness

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]
MASS = 0.05
PULL = PullSpec(10.0, 0.2, 0.05, math.radians(15))
QUICK = dataclasses.replace(PROTOCOLS["dexgraspbench"].with_trial(mass=MASS, force=5.0), pull=PULL)


def pull(name, pull=PULL, **changes):
    """The quick test with some of its numbers changed, on the pinched cylinder."""
    pytest.importorskip("sapien")
    hand, grasp = pinch(name)
    protocol = dataclasses.replace(QUICK, pull=pull).with_trial(**changes)
    return pull_grasp(GraspTrial(hand, grasp, Truth(cylinder())), protocol)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_the_squeeze_presses_with_forces_that_cancel(name):
    hand, grasp = pinch(name)
    lead = squeeze(hand, grasp, force=4.0).joints[0] - grasp.joints[0]
    torque = joint_stiffness(hand) * lead
    # Forces at the planned contacts, from the torques alone: J^T f = torque, of all f the one that
    # cancels.
    hand_from_obj = inverse(grasp.obj_from_hand)
    points = apply(hand_from_obj, grasp.contacts.points)[0]
    jacobian = hand.jacobian(grasp.joints, points[None])[0].flatten(0, 1)
    still = torch.cat(
        [torch.eye(3).double().repeat(1, 3), torch.cat([cross(p) for p in points], 1)]
    )
    system = torch.cat([jacobian.T, still])
    wished = torch.cat([torque, torch.zeros(6, dtype=torch.float64)])
    force = torch.linalg.lstsq(system, wished[:, None]).solution[:, 0]
    near(system @ force, wished, 1e-6)
    push = -(force.reshape(3, 3) * (hand_from_obj[0, :3, :3] @ grasp.contacts.normals[0].T).T).sum(
        -1
    )
    assert float(push.max()) == pytest.approx(4.0, rel=1e-6) and float(push.min()) > 1.0
    twice = squeeze(hand, grasp, force=4.0, kp=2 * hand.actuators[hand.joint_names[0]].kp).joints[0]
    torch.testing.assert_close(twice - grasp.joints[0], lead / 2, rtol=1e-9, atol=1e-12)


def cross(p):
    x, y, z = p.tolist()
    return real([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def test_a_pinched_cylinder_passes_and_the_same_numbers_come_twice():
    first, second = (pull("allegro") for _ in range(2))
    assert first.passed and first.status is Status.OK and first.directions == 6
    assert dataclasses.replace(first, seconds=0.0) == dataclasses.replace(second, seconds=0.0)
    assert 2.0 < first.force < 5.0 and first.moved < 0.02


def test_more_pull_than_friction_can_hold_moves_the_object():
    """Three fingers of N newtons hold at most 3 mu N along the cylinder's axis."""
    held = 3 * 0.6 * 4.0
    strong = pull(
        "allegro", dataclasses.replace(PULL, acceleration=2 * held / MASS, seconds=1.0), force=4.0
    )
    assert not strong.passed and strong.status is Status.MOVED
    assert strong.moved >= PULL.distance or strong.turned >= PULL.angle
    slippery = pull("allegro", friction=0.01)
    assert not slippery.passed


@pytest.mark.parametrize("closing", ["uncertainty", "position"])
def test_a_controller_closes_and_holds(closing):
    result = pull(
        "allegro", dataclasses.replace(PULL, acceleration=2.0), force=4.0, closing=closing
    )
    assert result.passed and 1.0 < result.force < 5.0


def test_a_hand_inside_the_object_is_refused_and_one_beside_it_misses_it():
    hand, grasp = pinch("barrett")
    result = pull_grasp(
        GraspTrial(hand, grasp, Truth(cylinder((0.0, 0.05)))), QUICK.with_trial(overlap=1e-3)
    )
    assert (
        result.status is Status.START_OVERLAP
        and result.directions == 0
        and math.isnan(result.force)
    )
    aside = torch.eye(4, dtype=torch.float64)
    aside[2, 3] = 0.2
    hand, grasp = pinch("allegro")
    assert not pull_grasp(GraspTrial(hand, grasp, Truth(cylinder(), error=aside)), QUICK).passed


def test_an_object_that_moves_while_the_hand_closes_is_not_pulled():
    """Every closing moves the object by more than nothing, so it fails at a distance of 0."""
    result = pull("allegro", dataclasses.replace(PULL, distance=0.0))
    assert result.status is Status.EJECTED and not result.passed
    assert result.directions == 0 and result.moved > 0.0


def test_bad_arguments_are_named():
    hand, grasp = pinch("allegro")
    trial = GraspTrial(hand, grasp, Truth(cylinder()))
    for protocol, message in (
        ("best", "protocol: expected .*got 'best'"),
        ("paper", "protocol: expected .*got 'paper', which lifts"),
    ):
        with pytest.raises(BadArgument, match=message):
            pull_grasp(trial, protocol)
    with pytest.raises(BadArgument, match=r"grasp: expected .*got 0 rows"):
        pull_grasp(dataclasses.replace(trial, grasp=grasp[:0]))
    with pytest.raises(BadArgument, match=r"force: expected .*got -1"):
        QUICK.with_trial(force=-1.0)
    with pytest.raises(BadArgument, match=r"grasp\.pregrasp: expected .*got 9 for"):
        pull_grasp(
            dataclasses.replace(
                trial, grasp=dataclasses.replace(grasp, pregrasp=grasp.pregrasp * 0 + 9)
            )
        )
    with pytest.raises(BadArgument, match=r"error: expected .*got"):
        Truth(cylinder(), error=torch.full((4, 4), math.nan))
    barrett = pinch("barrett")[0]
    with pytest.raises(BadArgument, match=r"hand: expected allegro.*got barrett"):
        squeeze(barrett, grasp)
    nameless = dataclasses.replace(grasp, meta={})
    with pytest.raises(BadArgument, match=r"grasps: expected .*got 12 joints"):
        squeeze(barrett, nameless)


def test_a_pull_in_open_loop_is_the_same_whether_the_hand_observes_or_not(monkeypatch):
    """At this rate the closing ends in a tick that comes before its last target is reached."""
    pytest.importorskip("mujoco")

    def found():
        result = pull("barrett", simulator="mujoco", closing="open_loop", control_rate=1 / 0.006)
        return result.status, result.directions, result.moved, result.turned, result.force

    def observe(run, seconds):
        for _ in range(run.robot.ticks(seconds)):
            run.step()

    rests = found()
    monkeypatch.setattr(TrialRun, "hold", observe)
    assert found() == rests


def test_a_mesh_in_another_frame_is_refused():
    hand, grasp = pinch("allegro")
    off = GraspTrial(hand, grasp, Truth(cylinder((0.2, 0.0))))
    for run in (pull_grasp, lift_grasps):
        with pytest.raises(BadArgument, match=r"mesh: .*one frame, in metres.* mm off"):
            run(off)
