"""A hand that collides with itself: its named pairs of links stop each other, and no other two do."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
import trimesh

from tests.pinch import QUICK, close, cylinder, pinch, quick_trial
from torchgrasp import load_hand
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver, Truth
from torchgrasp.foundation.errors import HandFileError, Status
from torchgrasp.sim.scene_spec import SceneSpec, pair_masks
from torchgrasp.sim.simulated_hand import open_scene

HANDS = ("allegro", "barrett", "allegro_biotac")


@pytest.mark.parametrize("name", HANDS)
def test_pair_masks_let_only_named_pairs_collide_and_refuse_more_than_bits(name):
    pairs = load_hand(name).self_pairs
    masks = pair_masks(pairs, first=3)
    named = {frozenset(pair) for pair in pairs}
    for one, two in itertools.combinations(masks, 2):
        meet = (masks[one][0] & masks[two][1]) | (masks[two][0] & masks[one][1])
        assert (meet != 0) == (frozenset((one, two)) in named)
    assert all(number & 0b111 == 0 and number < 2**31 for mask in masks.values() for number in mask)
    links = [f"link_{k}" for k in range(40)]
    with pytest.raises(HandFileError, match="self_collision"):
        pair_masks(itertools.combinations(links, 2), first=3)


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_scene_stops_fingers_driven_through_each_other(name, simulator):
    """The hand's own boxes tell how deep its links end in each other: a reference that no simulator
    computes.
    """
    pytest.importorskip(simulator)
    hand = load_hand(name)
    drawn = torch.rand(
        1000, hand.dof, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    joints = hand.lower + (hand.upper - hand.lower) * drawn
    clear = hand.self_clearance(joints)
    opened, crossed = (hand.expand(joints[row]) for row in (clear.argmax(), clear.argmin()))
    ball = trimesh.creation.icosphere(radius=0.02).apply_translation([0, 0, 0.02])
    pose = np.eye(4)
    pose[2, 3] = 1.0
    ends = {}
    for pairs in ((), hand.self_pairs):
        start = {joint: float(value) for joint, value in opened.items()}
        spec = SceneSpec(
            hand.urdf_path, pose, start, hand.actuators, hand.tips.links, ball, [ball], 0.1
        )
        spec = dataclasses.replace(spec, self_pairs=pairs)
        scene = open_scene(spec, simulator)
        assert scene.penetration() == 0.0
        scene.drive(np.array([float(crossed[joint]) for joint in scene.joint_names]))
        strays = sum(scene.step().stray.sum() for _ in range(400))
        assert strays == 0.0  # the hand itself is no neighbour, table or object
        order = [scene.joint_names.index(joint) for joint in hand.tree.joint_names]
        frames = hand.tree.frames(torch.from_numpy(scene.joints()[order])[:, None].contiguous())
        ends[bool(pairs)] = float(hand.self_collision.clearance(frames))
        inside = dataclasses.replace(
            spec, joints={joint: float(value) for joint, value in crossed.items()}
        )
        depth = open_scene(inside, simulator).penetration()
        assert depth == pytest.approx(-float(clear.min()) if pairs else 0.0, rel=0.05)
    assert ends[False] == pytest.approx(float(clear.min()), abs=1e-4)
    assert abs(ends[True]) < 1e-3


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_trial_refuses_a_hand_that_starts_in_itself():
    pytest.importorskip("sapien")
    hand, grasp = pinch("barrett")
    joints = hand.lower + (hand.upper - hand.lower) * torch.rand(
        1000, hand.dof, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    crossed = joints[hand.self_clearance(joints).argmin()][None]
    trial = GraspTrial(
        hand, dataclasses.replace(grasp, pregrasp=crossed), Truth(cylinder((1.0, 0.0)))
    )
    for on in (True, False):
        run = TrialDriver(trial, dataclasses.replace(QUICK, table=False, self_collision=on)).open()
        assert run.starts is not on


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_trial_is_the_same_with_self_collision_if_fingers_stay_apart():
    there = quick_trial()
    here = close("allegro", spec=dataclasses.replace(QUICK, self_collision=False))
    assert there.status is Status.OK
    assert torch.equal(there.joints, here.joints) and torch.equal(
        there.object_pose, here.object_pose
    )
