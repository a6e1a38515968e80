"""Postures that press from above: their feet are level, all else is higher, and their forces follow
from statics.
"""

import dataclasses
import functools

import pytest
import torch

from tests.make import load_hand, near, same_bits
from tests.settings import other_settings
from torchgrasp.foundation.base import named_tensors
from torchgrasp.geometry.frames import apply
from torchgrasp.ik.press import PRESS, PressPostures, press_postures

HANDS = ["allegro", "barrett", "leap", "shadow"]
STEP = 1e-6
"""Step [rad] of finite differences."""


@functools.cache
def found(name):
    hand = load_hand(name)
    return hand, press_postures(hand)


def height_of(hand, postures):
    """The lowest heights of all links (p, s) and fingertips (p, f) in the postures' frames, by
    the chain of pytorch-kinematics.
    """
    spheres = hand.collision_spheres
    poses = hand.chain.forward_kinematics(hand.expand(postures.joints))
    links = [poses[name].get_matrix() for name in hand.tree.link_names]
    here = postures.press_from_hand[:, None] @ torch.stack(links, 1)
    around = apply(here[:, spheres.link_index], spheres.center[:, None])[:, :, 0, 2]
    tips = apply(here[:, hand.tips.index], hand.tips.center[:, None])[:, :, 0, 2]
    return around - spheres.radius, tips - hand.tips.radius


@pytest.mark.parametrize("name", HANDS)
def test_pressing_tips_are_level_and_all_else_is_higher(name):
    hand, postures = found(name)
    assert len(postures) <= PRESS.kept
    count = postures.presses.sum(1)
    assert set(count.tolist()) == {1, 2}
    assert bool((count.diff() <= 0).all())  # pairs come first
    around, tips = height_of(hand, postures)
    near(tips[postures.presses], torch.zeros(int(count.sum())).double(), 1e-6)
    near(postures.feet[..., 2], tips, 1e-9)
    assert float(tips[~postures.presses].min()) > PRESS.gap
    fingers = postures.presses[:, hand.collision_spheres.finger.clamp_min(0)]
    own = hand.collision_spheres.touching & fingers
    assert float(around[~own].min()) > PRESS.gap
    assert float(around[own].min()) > -1e-4  # a tip's link ends where its sphere does
    # the origin is in the middle of the pressing feet
    middle = (postures.feet * postures.presses[..., None]).sum(1) / count[:, None]
    near(middle, torch.zeros_like(middle), 1e-9)
    two = postures.feet[count == 2][postures.presses[count == 2]].unflatten(0, (-1, 2))
    assert float((two[:, 0] - two[:, 1]).norm(dim=-1).min()) > PRESS.apart - PRESS.level


@pytest.mark.parametrize("name", HANDS)
def test_the_pads_face_down_and_the_joints_are_within_their_limits(name):
    hand, postures = found(name)
    hand.check_joints(postures.joints)
    _, pads = hand.fingertips(postures.joints)
    down = (pads @ postures.press_from_hand[:, :3, :3].mT)[..., 2]
    # the direction of a pair is turned a little to level it
    slack = PRESS.level / PRESS.apart
    assert float(down[postures.presses].max()) < -PRESS.cosine + slack


def differences(hand, postures):
    """The derivatives (p, f, 3, h) of the tips' lowest points by the joints, by differences.

    A lowest point is fixed to its link, so it is found again from the link's pose.
    """
    index = hand.tips.index
    hand_from_press = torch.linalg.inv(postures.press_from_hand)
    feet = apply(hand_from_press, postures.feet)
    poses = hand.link_poses(postures.joints)[:, index]
    on_link = apply(torch.linalg.inv(poses), feet[:, :, None])
    columns = []
    for k in range(hand.dof):
        step = torch.zeros(hand.dof).double()
        step[k] = STEP
        ends = [
            apply(hand.link_poses(postures.joints + sign * step)[:, index], on_link)[:, :, 0]
            for sign in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    turn = postures.press_from_hand[:, None, :3, :3]
    return turn @ torch.stack(columns, -1)


@pytest.mark.parametrize("name", HANDS)
def test_strength_and_stiffness_follow_from_virtual_work(name):
    hand, postures = found(name)
    jacobian = differences(hand, postures)
    drives = [hand.actuators[joint] for joint in hand.joint_names]
    effort = torch.tensor([drive.effort for drive in drives]).double()
    # at its strength, some joint of a pressing finger has its greatest torque, and none has more
    torque = jacobian[:, :, 2].abs() * postures.strength[:, None, None]
    most = (torque / effort).amax(2)
    most = torch.where(postures.presses, most, 0.0).amax(1)
    near(most, torch.ones_like(most), 1e-6)
    assert float(postures.strength.min()) >= PRESS.weakest
    assert float(postures.strength.max()) <= PRESS.strongest
    kp = torch.tensor([drive.kp for drive in drives]).double()
    # a unit force on a tip bends joints, gears and links
    stiffness = postures.stiffness
    near(stiffness, stiffness.mT, 1e-6 * float(stiffness.abs().max()))
    assert float(torch.linalg.eigvalsh(stiffness).min()) > 0
    force = torch.eye(3).double()
    joints = jacobian.mT @ force / kp[:, None]  # (p, f, h, 3) for three unit forces
    moved = jacobian @ joints + PRESS.compliance * force
    near(stiffness @ moved, force.expand_as(stiffness), 1e-6)


def test_the_seed_alone_determines_the_postures():
    hand, postures = found("barrett")
    with other_settings():
        again = press_postures(load_hand.__wrapped__("barrett"))
    assert same_bits(postures, again)
    assert press_postures(hand) is postures  # cached
    other = press_postures(hand, seed=1)
    assert not torch.equal(other.joints[:20], postures.joints[:20])
    # of a hand in single precision they are those of its rounded numbers
    single = press_postures(hand.to(torch.float32))
    assert all(
        x.dtype in (torch.float64, torch.bool) and x.device.type == "cpu"
        for x in named_tensors(single).values()
    )


def test_a_hand_none_of_whose_postures_press_has_none(monkeypatch):
    hand, _ = found("barrett")
    none = dataclasses.replace(PRESS, gap=1.0)
    monkeypatch.setattr("torchgrasp.ik.press.PRESS", none)
    assert len(press_postures(hand, seed=2)) == 0
    del hand.derived[PressPostures, 2]
