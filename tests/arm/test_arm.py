"""The arm's kinematics beside Denavit and Hartenberg's products and pinocchio; files that are
refused.
"""

import re

import numpy as np
import pytest
import torch
import trimesh

from tests.arm.ur5e import by_products, ur5e, ur5e_urdf
from tests.make import random_motion
from torchgrasp import load_object, plan_grasps
from torchgrasp.app.author import clean_arm
from torchgrasp.arm import load_arm
from torchgrasp.arm.reach import measure_ease, reach_poses
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.geometry.frames import inverse
from torchgrasp.planner.changes import list_changes
from torchgrasp.planner.request import Request


def test_poses_are_products_of_the_published_matrices(arm):
    joints = arm.library[:20]
    flange = inverse(arm.obj_from_base) @ arm.hand_poses(joints) @ inverse(arm.tip_from_hand)
    assert np.allclose(flange.numpy(), [by_products(q) for q in joints.numpy()], atol=1e-12)


def test_inverse_kinematics_and_manipulability_agree_with_pinocchio(arm):
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromXML(ur5e_urdf())
    data = model.createData()
    frame = model.getFrameId("tool0")

    def placed(q):
        pin.framesForwardKinematics(model, data, q)
        return data.oMf[frame].homogeneous

    generator = torch.Generator().manual_seed(3)
    moved = arm.moved(random_motion(4))
    joints = arm.lower + torch.rand(300, 6, generator=generator, dtype=torch.float64) * (
        arm.upper - arm.lower
    )
    base_from_tip = torch.tensor(np.array([placed(q) for q in joints.numpy()]))
    poses = moved.obj_from_base @ base_from_tip @ moved.tip_from_hand
    assert reach_poses(moved, poses).double().mean() > 0.95  # all are reached by some posture
    ease = measure_ease(arm, joints[:20].T)
    for q, (room, measure) in zip(joints[:20].numpy(), ease.tolist(), strict=True):
        jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        assert measure == pytest.approx(abs(np.linalg.det(jacobian)), abs=1e-9)
        low = model.lowerPositionLimit
        high = model.upperPositionLimit
        assert room == pytest.approx(
            1 - (np.abs(q - (low + high) / 2) / ((high - low) / 2)).max(), abs=1e-9
        )


def test_poses_out_of_reach_are_refused(arm):
    """The flange is at most 0.98 m from the shoulder, by the lengths of the links."""
    poses = arm.hand_poses(arm.library[:50])
    far = poses.clone()
    far[:, :3, 3] += 2.2 * torch.nn.functional.normalize(
        poses[:, :3, 3] - arm.obj_from_base[:3, 3], dim=1
    )
    assert not reach_poses(arm, far).any() and reach_poses(arm, poses).double().mean() > 0.95
    assert reach_poses(arm, poses[:0]).shape == (0,)


def test_same_seed_same_library(arm, hand):
    assert torch.equal(arm.library, ur5e(hand).library) and not torch.equal(
        arm.library, ur5e(hand, seed=1).library
    )


def test_an_arm_is_for_the_hand_that_is_named(arm, hand, monkeypatch):
    named = ur5e("allegro")
    assert torch.equal(named.center, arm.center) and named.hand_sha256 == arm.hand_sha256
    with pytest.raises(BadArgument, match=r"^hand: .*'octopus'"):
        ur5e("octopus")
    monkeypatch.setattr("torchgrasp.planner.grasps.plan_request", None)  # no work is begun
    with pytest.raises(BadArgument, match=r"^arm: expected .* barrett hand"):
        plan_grasps(load_object("cylinder"), "barrett", arm=arm)
    changes = list_changes(Request(load_object("cylinder").view, hand, arm=arm))
    assert all(
        change.request.hand.name == hand.name for change in changes
    )  # another hand would need another arm


def test_files_that_are_no_arm_are_refused(hand, tmp_path):
    def load(text, tip=None):
        (tmp_path / "arm.urdf").write_text(text)
        return load_arm(tmp_path / "arm.urdf", hand, tip)

    good = ur5e_urdf()
    assert load(good).joint_names == load(good, "tool0").joint_names
    endless = re.sub(r'revolute(.*wrist_3.*) lower="\S+" upper="\S+"', r"continuous\1", good)
    assert load(endless).upper.tolist() == load(good).upper.tolist() and endless != good
    with pytest.raises(BadArgument, match=r"tip: .*six joints"):
        load(good, "wrist_2_link")
    # a gripper whose fingers are no place for a hand
    fingers = "".join(
        f'<link name="{x}"/><joint name="slide_{x}" type="prismatic"><parent link="tool0"/>'
        f'<child link="{x}"/><axis xyz="0 {y} 0"/><limit lower="0" upper="0.04" effort="9" '
        'velocity="1"/></joint>'
        for x, y in (("left", 1), ("right", -1))
    )
    gripper = good.replace("</robot>", f"{fingers}</robot>")
    with pytest.raises(BadArgument, match=r"tip: .*name of the link.*'right' and in 'left'"):
        load(gripper)
    mount = torch.eye(4, dtype=torch.float64)
    mount[2, 3] = 95.0
    with pytest.raises(BadArgument, match=r"tip_from_hand: .*in metres"):
        load_arm(tmp_path / "arm.urdf", hand, "tool0", tip_from_hand=mount)
    assert load(gripper, "tool0").joint_names == load(good).joint_names
    with pytest.raises(BadArgument, match=r"tip: .*'hand'"):
        load(good, "hand")
    with pytest.raises(HandFileError, match="elbow_link with a mesh"):
        load(
            re.sub(
                r"(elbow_link.*?)<cylinder[^>]*>", r'\1<mesh filename="elbow.stl"/>', good, count=1
            )
        )
    mimic = r'\1<mimic joint="elbow_joint"/></joint>'
    follower = re.sub(
        r'(joint name="wrist_1_joint".*?)</joint>', mimic, good, count=1, flags=re.DOTALL
    )
    with pytest.raises(HandFileError, match="wrist_1_joint that follows another"):
        load(follower)
    with pytest.raises(HandFileError, match="urdf"):
        load("<robot")


def test_a_sliding_joint_of_unknown_range_or_speed_is_refused(hand, tmp_path):
    """A turn of 2 pi rad and pi rad/s are usual of arms: for a rail they would be 6.28 m, 3.14 m/s."""

    def load(limit):
        # a rail below the arm
        rail = (
            '<link name="floor"/><joint name="rail" type="prismatic"><parent link="floor"/>'
            f'<child link="base_link"/><axis xyz="1 0 0"/>{limit}</joint></robot>'
        )
        (tmp_path / "arm.urdf").write_text(ur5e_urdf().replace("</robot>", rail))
        return load_arm(tmp_path / "arm.urdf", hand)

    arm = load('<limit lower="-1" upper="2" effort="100" velocity="0.5"/>')
    assert (arm.lower[0], arm.upper[0], arm.speed[0]) == (-1.0, 2.0, 0.5)
    for limit in ("", '<limit effort="9" velocity="1"/>'):
        with pytest.raises(HandFileError, match=r"in metres, .*sliding joint rail without limits"):
            load(limit)
    for limit in ('<limit lower="0" upper="1"/>', '<limit lower="0" upper="1" velocity="0"/>'):
        with pytest.raises(HandFileError, match=r"in m/s, .*sliding joint rail without a velocity"):
            load(limit)


def test_a_published_arm_with_meshes_is_cleaned_for_the_library(hand, tmp_path):
    """The forearm becomes a mesh; the spheres of the arm that is read again cover its vertices to a
    centimetre.
    """
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    body = (
        trimesh.creation.capsule(0.35, 0.045)
        .apply_transform(turn)
        .apply_translation([-0.375, 0, 0.007])
    )
    body.export(tmp_path / "forearm.stl")
    mesh = '<geometry><mesh filename="package://any/forearm.stl"/></geometry></collision></link>'
    text = re.sub(
        r'(name="elbow_link".*?<collision>).*?</link>', rf"\1{mesh}", ur5e_urdf(), count=1
    )
    (tmp_path / "published.urdf").write_text(text)
    with pytest.raises(HandFileError, match="clean_arm"):
        load_arm(tmp_path / "published.urdf", hand)
    (tmp_path / "arm.urdf").write_text(clean_arm(tmp_path / "published.urdf"))
    arm = load_arm(tmp_path / "arm.urdf", hand)
    mine = arm.link == arm.tree.link_names.index("elbow_link")
    far = (
        torch.cdist(torch.from_numpy(np.array(body.vertices)), arm.center[mine]) - arm.radius[mine]
    )
    assert mine.sum() > 4 and far.amin(1).max() < 0.002


def test_joints_in_degrees_are_refused_and_an_arm_keeps_its_pose(tmp_path):
    """A base that is moved in the same memory, for a second arm, moves no first one."""
    file = tmp_path / "ur5e.urdf"
    file.write_text(ur5e_urdf())
    base = random_motion(5)
    mount = torch.eye(4, dtype=torch.float64)
    arm = load_arm(file, "allegro", "tool0", obj_from_base=base, tip_from_hand=mount)
    joints = torch.tensor([[0.3, -1.2, 1.5, -0.4, 1.57, 0.0]], dtype=torch.float64)
    pose = arm.hand_poses(joints)
    base[:3, 3] += 1.0
    mount[2, 3] = 0.1
    assert torch.equal(arm.hand_poses(joints), pose)
    arm.hand_poses(arm.upper[None] + 0.1)
    assert arm.hand_poses(joints[:0]).shape == (0, 4, 4)
    with pytest.raises(BadArgument, match=r"joints: .*radians"):
        arm.hand_poses(torch.rad2deg(joints))
