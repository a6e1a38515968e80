"""Exports with a robot's names of joints and the pose of its flange, and messages for a planning
scene.
"""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.pinch import pinch
from torchgrasp import Plane, load_hand
from torchgrasp.app import cli
from torchgrasp.control import squeeze
from torchgrasp.control.protocol import POSE_TIME
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export import (
    ArmMotion,
    format_grasps,
    format_motion,
    format_moveit,
    format_trajectories,
    read_foreign,
)
from torchgrasp.foundation.errors import BadArgument, NoEffect, Status
from torchgrasp.geometry.frames import apply, rigid, rotate, rotation_from_vector

yaml = pytest.importorskip("yaml")
DRIVER = {
    f"joint_{k}": f"joint_{k}.0" for k in reversed(range(16))
}  # in another order than the URDF's


@pytest.mark.parametrize(
    ("table", "up"), [("0.6 0 0.8, offset 0.1", [0.6, 0, 0.8]), (None, [0, 0, 1])]
)
def test_the_retreat_lifts_off_the_table_of_the_plan_or_along_z(table, up):
    hand, grasp = pinch("allegro")
    normal = {} if table is None else {"table": f"normal {table}"}
    grasp = dataclasses.replace(grasp, meta={"hand": "allegro"} | normal)
    (message,) = yaml.safe_load(format_moveit(hand, grasp, object_id="jug"))
    assert [
        message["post_grasp_retreat"]["direction"]["vector"][k] for k in "xyz"
    ] == pytest.approx(up)
    assert message["allowed_touch_objects"] == ["jug"]


def test_a_turned_world_turns_the_retreat_with_it():
    hand, grasp = pinch("allegro")
    turn = rigid(
        rotation_from_vector(torch.tensor([0.3, -0.8, 0.2]).double()),
        torch.tensor([0.1, 0, 0.2]).double(),
    )
    contacts = dataclasses.replace(
        grasp.contacts,
        points=apply(turn, grasp.contacts.points),
        normals=rotate(turn, grasp.contacts.normals),
    )
    turned = dataclasses.replace(
        grasp,
        contacts=contacts,
        obj_from_hand=turn @ grasp.obj_from_hand,
        approach=grasp.approach @ turn[:3, :3].T,
        meta=grasp.meta | {"table": Plane.horizontal(0.0).moved(turn).describe()},
    )
    (message,) = yaml.safe_load(format_moveit(hand, turned))
    back = np.array([message["post_grasp_retreat"]["direction"]["vector"][k] for k in "xyz"])
    np.testing.assert_allclose(back @ turn[:3, :3].numpy(), [0, 0, 1], atol=1e-8)


def test_all_sixteen_joints_of_an_allegro_have_the_drivers_names_in_its_order(tmp_path):
    hand, grasp = pinch("allegro")
    assert grasp.joints.shape == (1, 12)  # the planned fingers alone
    every = dict(
        zip(hand.tree.joint_names, hand.expand_joints(grasp.joints)[0].tolist(), strict=True)
    )
    assert [every[f"joint_{k}"] for k in range(8, 12)] == [
        0.0,
        -0.196,
        -0.174,
        -0.227,
    ]  # parked by hand.toml
    (message,) = yaml.safe_load(format_moveit(hand, grasp, rename=DRIVER))
    trajectory = yaml.safe_load(format_trajectories(hand, grasp, rename=DRIVER))
    for posture, row in ((message["grasp_posture"], 0), (trajectory, 1)):
        assert posture["joint_names"] == list(DRIVER.values())
        assert posture["points"][row]["positions"] == pytest.approx(
            [every[joint] for joint in DRIVER], abs=1e-9
        )
    content = json.loads(format_grasps(hand, grasp, rename=DRIVER))
    row = content["grasps"][0]
    assert list(row["joints"]["grasp"].items()) == [
        (DRIVER[joint], every[joint]) for joint in DRIVER
    ]
    assert (
        set(content["actuated"])
        == set(row["torque"])
        == {DRIVER[joint] for joint in hand.joint_names}
    )
    assert set(content["stiffness"]) == set(DRIVER.values())
    (tmp_path / "grasps.json").write_text(json.dumps(content))
    assert torch.equal(read_foreign(tmp_path / "grasps.json", hand).joints, grasp.joints)


def test_a_joint_that_is_not_named_keeps_its_name_after_the_others():
    hand, grasp = pinch("barrett")
    names = yaml.safe_load(
        format_trajectories(hand, grasp, rename={"f1_flex": "a", "spread": "b"})
    )["joint_names"]
    assert names[:2] == ["a", "b"] and names[2:] == [
        x for x in hand.tree.joint_names if x not in ("f1_flex", "spread")
    ]


@pytest.mark.parametrize(
    "wrong", [{"joint_16": "a"}, {"joint_0": "a", "joint_1": "a"}, {"joint_0": "joint_1"}]
)
def test_unknown_joints_and_two_joints_of_one_name_are_refused(wrong):
    hand, grasp = pinch("allegro")
    for write in (format_grasps, format_moveit, format_trajectories):
        with pytest.raises(BadArgument, match="rename"):
            write(hand, grasp, rename=wrong)


def test_the_flange_is_where_the_mount_puts_it():
    """A flange 95 mm behind the palm, turned by 90 degrees: its pose is composed by SciPy."""
    hand, grasp = pinch("allegro")
    mount = Rotation.from_euler("z", 90, degrees=True)
    flange = rigid(torch.tensor(mount.as_matrix()), torch.tensor([-0.095, 0.0, 0.0]).double())
    closed = grasp.obj_from_hand[0].numpy()
    place = closed[:3, :3] @ [-0.095, 0, 0] + closed[:3, 3]
    turn = Rotation.from_matrix(closed[:3, :3]) * mount
    text = format_moveit(hand, grasp, flange=flange)
    assert "poses are of the flange" in text.splitlines()[0]
    pose = yaml.safe_load(text)[0]["grasp_pose"]["pose"]
    found = [pose["position"][k] for k in "xyz"], [pose["orientation"][k] for k in "xyzw"]
    row = json.loads(format_grasps(hand, grasp, flange=flange))["grasps"][0]
    for position, quaternion in (
        found,
        (row["flange"]["position"], np.roll(row["flange"]["quaternion_wxyz"], -1)),
    ):
        np.testing.assert_allclose(position, place, atol=1e-8)
        assert (Rotation.from_quat(quaternion) * turn.inv()).magnitude() < 1e-7
    np.testing.assert_allclose(
        row["pose"]["position"], closed[:3, 3]
    )  # the hand's pose stays beside it


def test_trajectories_may_leave_followers_out():
    """A controller of ros2_control refuses a joint that it does not command."""
    hand, grasp = pinch("barrett")
    followers = {"spread_mimic", "f1_distal", "f2_distal", "f3_distal"}
    every = yaml.safe_load(format_trajectories(hand, grasp))
    some = yaml.safe_load(format_trajectories(hand, grasp, actuated=True))
    (message,) = yaml.safe_load(format_moveit(hand, grasp, actuated=True))
    assert set(every["joint_names"]) - set(some["joint_names"]) == followers
    assert set(some["joint_names"]) == set(hand.joint_names)
    for row, point in enumerate(every["points"]):
        of = dict(zip(every["joint_names"], point["positions"], strict=True))
        kept = [of[joint] for joint in some["joint_names"]]
        assert some["points"][row]["positions"] == kept
    assert message["grasp_posture"]["joint_names"] == some["joint_names"]
    names = tuple(hand.tree.joint_names)
    motion = ArmMotion(("arm", *names), torch.zeros(2), torch.zeros(1, 2, 9), {"above": 0})
    moved = yaml.safe_load(format_motion(hand, motion, actuated=True))
    assert moved["joint_names"] == ["arm", *(x for x in names if x not in followers)]
    assert len(moved["points"][0]["positions"]) == 5


def test_a_trajectory_starts_where_the_hand_is_and_has_no_efforts():
    """A point at time 0 is a jump; the trajectory controller of ros2_control refuses efforts."""
    hand, grasp = pinch("barrett")
    (message,) = yaml.safe_load(format_moveit(hand, grasp, actuated=True))
    trajectories = (
        yaml.safe_load(format_trajectories(hand, grasp)),
        message["pre_grasp_posture"],
        message["grasp_posture"],
    )
    for trajectory in trajectories:
        points = trajectory["points"]
        times = [
            x["time_from_start"]["sec"] + 1e-9 * x["time_from_start"]["nanosec"] for x in points
        ]
        np.testing.assert_allclose(np.diff([0.0, *times]), POSE_TIME, atol=1e-9)
        assert not any(point["effort"] for point in points)


def test_parked_joints_stay_where_followers_are_left_out():
    hand, grasp = pinch("allegro")  # a parked finger, no follower
    assert format_trajectories(hand, grasp, actuated=True) == format_trajectories(hand, grasp)


def test_the_command_tells_followers_and_leaves_them_out(tmp_path, capsys):
    hand, grasp = pinch("barrett")
    meta = {"hand": "barrett", "hand_sha256": hand.source.sha256}
    dataclasses.replace(grasp, meta=meta).save(tmp_path / "g")
    out = tmp_path / "out"
    words = ["export", str(tmp_path / "g"), "--out", str(out), "--format"]
    for kind in ("ros2", "moveit"):
        assert cli.main([*words, kind]) == 0
        assert "f3_distal; --actuated" in capsys.readouterr().out and "f3_distal" in out.read_text()
        assert cli.main([*words, kind, "--actuated"]) == 0
        assert "note" not in capsys.readouterr().out and "f3_distal" not in out.read_text()
    assert cli.main([*words, "json", "--actuated"]) == 2
    assert "--actuated" in capsys.readouterr().err


def test_the_command_takes_names_a_file_of_names_and_a_flange(tmp_path, capsys):
    hand, grasp = pinch("allegro")
    dataclasses.replace(grasp, meta={"hand": "allegro", "hand_sha256": hand.source.sha256}).save(
        tmp_path / "g"
    )
    (tmp_path / "names.json").write_text(json.dumps(DRIVER))
    out = tmp_path / "out"
    words = ["export", str(tmp_path / "g"), "--out", str(tmp_path / "out"), "--format"]
    for names in (["joint_15=thumb.3", "joint_0=index.0"], [str(tmp_path / "names.json")]):
        assert cli.main([*words, "ros2", "--rename", *names]) == 0
        first = yaml.safe_load(out.read_text())["joint_names"][0]
        assert first == ("joint_15.0" if len(names) == 1 else "thumb.3")
    mount = ["--flange", "-0.095", "0", "0", "0", "0", "0", "1"]
    assert cli.main([*words, "moveit", *mount, "--object", "jug"]) == 0
    written = yaml.safe_load(out.read_text())
    turned = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]).double())
    turned[0, 3] = -0.095
    assert written == yaml.safe_load(format_moveit(hand, grasp, flange=turned, object_id="jug"))
    capsys.readouterr()
    wrong = {
        "--rename": (
            ["ros2", "--rename", "joint_0"],
            ["json", "--rename", "nofile.json"],
            ["mujoco", "--rename", "joint_0=a"],
        ),
        "--flange": (
            ["ros2", *mount],
            ["json", "--flange", *"0 0 0 2 0 0 0".split()],
            ["graspgen", *mount],
        ),
        "--object": (["ros2", "--object", "jug"],),
    }
    for option, cases in wrong.items():
        for case in cases:
            more = ["--object", "x"] if case[0] == "graspgen" else []
            assert cli.main([*words, *case, *more]) == 2
            assert f"torchgrasp: {option}" in capsys.readouterr().err


def test_a_time_just_below_a_second_has_valid_nanoseconds():
    """The message allows less than 1e9 of them."""
    times = torch.tensor([0.0, 0.25, 1.9999999999], dtype=torch.float64)
    hand = pinch("barrett")[0]
    motion = ArmMotion(hand.tree.joint_names, times, torch.zeros(1, 3, 8).double(), {"above": 0})
    points = yaml.safe_load(format_motion(hand, motion))["points"]
    assert [point["time_from_start"] for point in points] == [
        {"sec": 0, "nanosec": 0},
        {"sec": 0, "nanosec": 250_000_000},
        {"sec": 2, "nanosec": 0},
    ]


def test_a_force_beyond_the_drives_is_told_with_the_greatest_that_they_exert():
    hand = load_hand("allegro")
    grasp = load_shipped_grasp("jug", "allegro")
    efforts = squeeze(hand, grasp, 4.0).torques.abs() / 0.7  # [N m] of each drive, in its URDF
    most = 4.0 / float(efforts.max())
    format_trajectories(hand, grasp, 0.99 * most)  # and warns of nothing
    with pytest.warns(NoEffect, match=rf"force: 100 N .*at most {most:.2g} N are exerted"):
        format_trajectories(hand, grasp, 100.0)
    failed = dataclasses.replace(grasp, status=torch.tensor([int(Status.OBJECT_COLLISION)]))
    for few in (grasp[:0], failed):
        format_grasps(hand, few, 100.0)  # nobody plays it


def test_a_motion_of_another_hand_is_refused():
    """Equal numbers of joints, or equal names of joints, do not make two hands one."""
    hand = pinch("barrett")[0]
    names = ("arm", *hand.tree.joint_names)
    times = torch.tensor([0.0, 1.0])
    still = torch.zeros(1, 2, len(names))
    assert "arm" in format_motion(hand, ArmMotion(names, times, still, {"above": 0}))
    for other in (names[::-1], ("arm", *(f"joint_{k}" for k in range(8))), names[:-1]):
        motion = ArmMotion(other, times, still[..., : len(other)], {"above": 0})
        with pytest.raises(BadArgument, match="motion: expected those of the hand: "):
            format_motion(hand, motion)
    with pytest.raises(BadArgument, match="motion: expected those of the hand: "):
        format_motion(pinch("allegro")[0], ArmMotion(names, times, still, {"above": 0}))
    # a posture that the hand cannot have; the targets that press may be beyond the limits
    beyond = still.clone()
    beyond[:, 1] = 9.0
    assert format_motion(hand, ArmMotion(names, times, beyond, {"above": 0, "squeeze": 1}))
    with pytest.raises(BadArgument, match=r"motion\.positions: .* got 9 for spread"):
        format_motion(hand, ArmMotion(names, times, beyond, {"above": 0, "grasp": 1}))
