"""Kinematics against three other readers of the same URDF, by joint name, and its derivatives of
both orders.
"""

import numpy as np
import pytest
import torch
from pytorch_kinematics import SerialChain, build_chain_from_urdf

from tests.make import near
from torchgrasp import Hand, load_hand
from torchgrasp.hand.kinematics import chain_from_urdf, chain_poses, tree_from_urdf
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.testing import random_joints

BRANCHED = """<robot name="branched">
  <link name="tip"/><link name="base"/><link name="slider"/><link name="arm"/><link name="side"/><link name="bolt"/>
  <joint name="fix" type="fixed"><parent link="arm"/><child link="bolt"/>
    <origin xyz="0.1 0 0.2" rpy="0.4 -0.3 2"/></joint>
  <joint name="end" type="revolute"><origin xyz="0 0.2 0" rpy="0 1 0"/><parent link="slider"/><child link="tip"/>
    <axis xyz="0.6 0 -0.8"/><limit lower="-3" upper="3"/></joint>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.3" rpy="1 2 3"/><parent link="base"/><child link="arm"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3"/></joint>
  <joint name="slide" type="prismatic"><origin xyz="0.5 0 0" rpy="0 0 -1"/><parent link="bolt"/><child link="slider"/>
    <axis xyz="0 0.6 0.8"/><limit lower="-1" upper="1"/></joint>
  <joint name="away" type="revolute"><parent link="base"/><child link="side"/><limit lower="-3" upper="3"/></joint>
</robot>"""


@pytest.fixture(params=["allegro", "barrett"])
def hand(request) -> Hand:
    return load_hand(request.param)


def assert_same_poses(found: torch.Tensor, truth: torch.Tensor) -> None:
    near(found, truth, 1e-6)  # [m], and entries of rotations


def test_fk_equals_pytorch_kinematics_and_the_derivative_of_the_jacobian_is_symmetric(hand):
    """Its own reader keeps seven digits of an angle."""
    joints = random_joints(hand, 100)
    chain = build_chain_from_urdf(hand.urdf_path.read_bytes()).to(torch.float64)
    poses = chain.forward_kinematics(hand.expand(joints))
    assert_same_poses(
        hand.link_poses(joints),
        torch.stack([poses[n].get_matrix() for n in hand.tree.link_names], 1),
    )
    second = torch.func.jacfwd(hand.jacobian)(random_joints(hand, 1)[0])
    near(second, second.mT, 1e-12)  # as second derivatives are


def test_the_chain_is_pytorch_kinematics_own_and_keeps_dtype_and_place_of_the_hand(hand):
    joints = random_joints(hand, 3).requires_grad_()
    tip = hand.tips.links[0]
    found = hand.chain.forward_kinematics(hand.expand(joints))[tip].get_matrix()
    near(found, hand.link_poses(joints)[:, hand.tree.link_names.index(tip)], 1e-8)
    assert torch.autograd.grad(found.sum(), joints)[0].abs().max() > 0
    serial = SerialChain(hand.chain, tip, dtype=torch.float64)
    assert serial.jacobian(torch.zeros(2, serial.n_joints, dtype=torch.float64)).shape == (
        2,
        6,
        serial.n_joints,
    )
    assert hand.to(torch.float32).chain.dtype == torch.float32
    joints = random_joints(hand, 3)
    moved = hand.to(torch.float32)
    assert moved.tree.tables.dtype == torch.float32
    near(moved.link_poses(joints.float()), hand.link_poses(joints.float()), 1e-7)
    assert hand.link_poses(joints[0]).shape == (len(hand.tree.link_names), 4, 4)


def test_fk_and_jacobian_equal_pinocchios_by_joint_name(hand):
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(hand.urdf_path))
    data = model.createData()
    joints = random_joints(hand, 100)
    every = {name: values.tolist() for name, values in hand.expand(joints).items()}
    order = [every[name] for name in list(model.names)[1:]]
    frames = [model.getFrameId(name) for name in hand.tree.link_names]
    truth = torch.zeros(100, len(frames), 4, 4, dtype=torch.float64)
    column = [hand.tree.joint_names.index(name) for name in list(model.names)[1:]]
    found = hand.jacobian(joints)
    at = [frames[k] for k in hand.tips.index.tolist()]
    for row in range(100):
        q = np.array([values[row] for values in order])
        pin.framesForwardKinematics(model, data, q)
        for k, frame in enumerate(frames):
            truth[row, k] = torch.from_numpy(data.oMf[frame].homogeneous)
        if row % 5:
            continue
        for finger, frame in enumerate(at):
            twist = torch.from_numpy(
                pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
            )
            arm = torch.from_numpy(data.oMf[frame].rotation) @ hand.tips.contact[finger]
            moved = twist[:3] + torch.linalg.cross(twist[3:], arm[:, None].expand(3, len(q)), dim=0)
            near(found[row, finger], moved @ hand.actuated.coupling[column], 1e-12)
    assert_same_poses(hand.link_poses(joints), truth)
    assert float((hand.link_poses(joints) - truth).abs().max()) < 1e-12


def test_fk_is_differentiable_twice():
    hand = load_hand("barrett")
    joints = random_joints(hand, 1).requires_grad_()
    for action in (hand.link_poses, hand.fingertips, hand.jacobian):
        assert torch.autograd.gradgradcheck(action, joints)


def test_a_tree_of_every_kind_of_joint_is_that_of_pytorch_kinematics(tmp_path, generator):
    path = tmp_path / "hand.urdf"
    path.write_text(BRANCHED)
    urdf = read_urdf(path)
    tree = tree_from_urdf(urdf)
    assert tree.joint_names == ("end", "turn", "slide", "away")
    values = torch.randn(50, 4, generator=generator, dtype=torch.float64)
    chain = chain_from_urdf(urdf)
    poses = chain_poses(chain, tree.joint_names, values.T)[
        [chain.frame_to_idx[link] for link in tree.link_names]
    ]
    near(tree.poses(values), poses.transpose(0, 1), 1e-12)
    assert torch.autograd.gradgradcheck(tree.poses, values[:1].requires_grad_())
