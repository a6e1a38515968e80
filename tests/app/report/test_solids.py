import numpy as np
import torch

from torchgrasp.app.report.solids import PARKED, finger_of_links, solids_from_hand
from torchgrasp.hand.load import load_hand


def test_every_fingertip_belongs_to_its_finger_and_the_palm_to_none():
    for name in ("allegro", "barrett"):
        hand = load_hand(name)
        fingers = finger_of_links(hand)
        assert [fingers[tip] for tip in hand.tips.links] == [0, 1, 2]
        assert fingers[hand.tree.link_names[0]] == PARKED


def test_solids_follow_the_pose_of_the_hand_rigidly():
    hand = load_hand("allegro")
    joints = hand.expand_joints(((hand.lower + hand.upper) / 2).double())
    here = torch.eye(4, dtype=torch.float64)
    there = here.clone()
    there[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    pairs = zip(
        solids_from_hand(hand, joints, hand.tree.joint_names, here),
        solids_from_hand(hand, joints, hand.tree.joint_names, there),
        strict=True,
    )
    for a, b in pairs:
        np.testing.assert_allclose(b.vertices - a.vertices, np.tile([0.1, -0.2, 0.3], (len(a.vertices), 1)), atol=1e-12)


def test_the_order_of_the_joints_does_not_matter():
    hand = load_hand("barrett")
    joints = hand.expand_joints(hand.upper.double() * 0.5)
    names = hand.tree.joint_names
    place = torch.eye(4, dtype=torch.float64)
    turned = solids_from_hand(hand, joints.flip(0), names[::-1], place)
    for a, b in zip(solids_from_hand(hand, joints, names, place), turned, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_a_fingertip_solid_lies_at_the_tip():
    hand = load_hand("allegro")
    joints = ((hand.lower + hand.upper) / 2).double()
    centre = hand.tip_centres(joints)[0].numpy()
    solids = solids_from_hand(hand, hand.expand_joints(joints), hand.tree.joint_names, torch.eye(4).double())
    middles = [(s.vertices.min(0) + s.vertices.max(0)) / 2 for s in solids if s.finger == 0]
    assert min(np.linalg.norm(m - centre) for m in middles) < 1e-6
