"""Exported grasps, read back by others: yourdfpy places the tips of the JSON, MuJoCo those of the
keyframes.
"""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.pinch import pinch
from torchgrasp import Plane, load_hand
from torchgrasp.app import cli
from torchgrasp.control.finger_forces import squeeze
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export import (
    format_grasps,
    format_isaac,
    format_keyframes,
    format_moveit,
    grasps_from_joints,
    read_foreign,
)
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.geometry.frames import apply

HANDS = ["allegro", "barrett"]


def planned_tips(hand, grasp):
    """Return the contact points of the tips in the object's frame, by the library itself."""
    return apply(grasp.obj_from_hand, hand.fingertips(grasp.joints)[0])[0].numpy()


@pytest.mark.parametrize("name", HANDS)
def test_the_json_replays_to_the_planned_tips(name):
    yourdfpy = pytest.importorskip("yourdfpy")
    hand, grasp = pinch(name)
    content = json.loads(format_grasps(hand, grasp, 5.0), parse_constant=pytest.fail)
    row = content["grasps"][0]
    robot = yourdfpy.URDF.load(str(hand.urdf_path), load_meshes=False, load_collision_meshes=False)
    robot.update_cfg(row["joints"]["grasp"])
    w, x, y, z = row["pose"]["quaternion_wxyz"]
    turn = Rotation.from_quat([x, y, z, w]).as_matrix()
    place = np.array(row["pose"]["position"])
    for i, contact in enumerate(row["contacts"]):
        assert contact["finger"] == hand.tips.names[i]
        tip = robot.get_transform(contact["link"], content["hand"]["root"])
        point = turn @ (tip @ np.append(hand.tips.contact[i].numpy(), 1.0))[:3] + place
        np.testing.assert_allclose(point, planned_tips(hand, grasp)[i], atol=1e-9)
    assert row["approach"] == {"direction": grasp.approach[0].tolist(), "distance": 0.1}
    joints = row["joints"]
    assert set(joints["squeeze"]) == set(hand.tree.joint_names) and content["time"]["squeeze"] > 0
    for joint in content["actuated"]:  # stiffness x lead = torque
        lead = joints["squeeze"][joint] - joints["grasp"][joint]
        if name == "allegro":  # no coupling
            assert content["stiffness"][joint] * lead == pytest.approx(
                row["torque"][joint], abs=1e-12
            )
    forces = np.array([contact["force"] for contact in row["contacts"]])
    normals = np.array([contact["normal"] for contact in row["contacts"]])
    np.testing.assert_allclose(forces.sum(0), 0, atol=1e-9)
    assert (-(forces * normals).sum(1)).max() == pytest.approx(5.0, rel=1e-6)


@pytest.mark.parametrize("name", HANDS)
def test_mujoco_loads_the_keyframes_and_places_the_tips(name):
    mujoco = pytest.importorskip("mujoco")
    hand, grasp = pinch(name)
    model = mujoco.MjModel.from_xml_string(format_keyframes(hand, grasp, 5.0))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("grasp_0_grasp").id)
    mujoco.mj_kinematics(model, data)
    for i, link in enumerate(hand.tips.links):
        point = (
            data.body(link).xmat.reshape(3, 3) @ hand.tips.contact[i].numpy() + data.body(link).xpos
        )
        np.testing.assert_allclose(point, planned_tips(hand, grasp)[i], atol=1e-9)
    pressed = hand.expand(squeeze(hand, grasp, 5.0).joints)
    key = model.key("grasp_0_squeeze")
    np.testing.assert_array_equal(key.qpos, model.key("grasp_0_grasp").qpos)
    for k in range(model.nu):  # each actuator by its name, whatever the order
        assert key.ctrl[k] == float(pressed[model.actuator(k).name][0])
    mujoco.mj_resetDataKeyframe(model, data, model.key("grasp_0_pregrasp").id)
    for joint, q in hand.expand(grasp.pregrasp).items():
        assert data.joint(joint).qpos[0] == float(q[0])
    start, arrived = (model.key(f"grasp_0_{pose}").qpos for pose in ("approach", "pregrasp"))
    np.testing.assert_array_equal(start[3:], arrived[3:])
    np.testing.assert_allclose(arrived[:3] - start[:3], 0.1 * grasp.approach[0].numpy(), atol=1e-12)


def test_a_hand_whose_opened_fingers_are_in_the_table_stays_above_its_pose():
    """The table is 5 mm above the lowest sphere of the opened hand: by hand, the hand rises by 6
    mm.
    """
    mujoco = pytest.importorskip("mujoco")
    hand, grasp = pinch("barrett")
    lowest = (
        apply(grasp.obj_from_hand, hand.sphere_centres(grasp.pregrasp))[0, :, 2]
        - hand.collision_spheres.radius
    )
    table = Plane.horizontal(float(lowest.min()) + 0.005)
    grasp = dataclasses.replace(grasp, meta=grasp.meta | {"table": table.describe()})
    row = json.loads(format_grasps(hand, grasp))["grasps"][0]
    assert row["rise"] == pytest.approx([0.0, 0.0, 0.006], abs=1e-9)
    model = mujoco.MjModel.from_xml_string(format_keyframes(hand, grasp))
    opened, closed = (model.key(f"grasp_0_{name}").qpos[:3] for name in ("pregrasp", "grasp"))
    np.testing.assert_allclose(opened - closed, row["rise"], atol=1e-12)
    for write in (format_moveit, format_isaac):  # a format of one pose
        with pytest.raises(BadArgument, match="goes down while it closes"):
            write(hand, grasp)


def test_a_robot_of_half_the_stiffness_gets_twice_the_lead():
    hand, grasp = pinch("allegro")
    own, soft = (json.loads(format_grasps(hand, grasp, 5.0, kp)) for kp in (None, 1.5))
    assert set(own["stiffness"].values()) == {3.0} and set(soft["stiffness"].values()) == {1.5}
    first, second = (content["grasps"][0] for content in (own, soft))
    assert second["torque"] == first["torque"] and second["contacts"] == first["contacts"]
    for joint in own["actuated"]:
        leads = [
            row["joints"]["squeeze"][joint] - row["joints"]["grasp"][joint]
            for row in (first, second)
        ]
        assert leads[1] == pytest.approx(2 * leads[0], abs=1e-12)
    gains = re.findall(r'<position kp="([0-9.]+)"', format_keyframes(hand, grasp, 5.0, 1.5))
    assert len(gains) == 16 and set(gains) == {"1.5"}


def test_the_command_writes_both_names_what_is_wrong_and_no_grasps_are_an_empty_list(
    tmp_path, capsys
):
    hand, grasp = pinch("allegro")
    grasp = dataclasses.replace(grasp, meta={"hand": "allegro", "hand_sha256": hand.source.sha256})
    grasp.save(tmp_path / "grasps.safetensors")
    words = ["export", str(tmp_path / "grasps.safetensors"), "--out", str(tmp_path / "out")]
    assert (
        cli.main(words) == 0
        and json.loads((tmp_path / "out").read_text())["grasps"][0]["status"] == "OK"
    )
    assert cli.main([*words, "--format", "mujoco"]) == 0 and (
        tmp_path / "out"
    ).read_text().startswith("<mujoco")
    # the folder of `torchgrasp grasp` names its file
    assert cli.main(["export", str(tmp_path), "--out", str(tmp_path / "again")]) == 0
    assert cli.main(words) == 0
    assert (tmp_path / "again").read_bytes() == (tmp_path / "out").read_bytes()
    wrong = {"--hand": "barrett", "--force": "-1", "--most": "0", "--kp": "0"}
    for named, value in wrong.items():
        more = [named, value]
        assert cli.main([*words, *more]) == 2
        assert named in capsys.readouterr().err
    hand = load_hand("allegro")
    grasp = pinch("allegro")[1][torch.zeros(0, dtype=torch.int64)]
    assert json.loads(format_grasps(hand, grasp))["grasps"] == []
    assert "<key " not in format_keyframes(hand, grasp)


@pytest.mark.parametrize("write", [format_grasps, format_isaac, format_moveit])
def test_a_flange_in_millimetres_and_grasps_in_degrees_are_refused(write):
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    flange = torch.eye(4, dtype=torch.float64)
    flange[2, 3] = 95.0
    with pytest.raises(BadArgument, match=r"flange: .*in metres"):
        write(hand, grasp, flange=flange)
    degrees = dataclasses.replace(grasp, pregrasp=grasp.pregrasp * 180 / torch.pi)
    with pytest.raises(BadArgument, match=r"grasps.pregrasp: "):
        write(hand, degrees)
    longer = dataclasses.replace(grasp, approach=2.0 * grasp.approach)
    with pytest.raises(BadArgument, match=r"grasps.approach: .*unit"):
        write(hand, longer)


def test_a_unit_that_contradicts_the_file_is_refused_and_grasps_keep_their_numbers(tmp_path):
    """A caller may read the next grasp into the same memory."""
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    file = tmp_path / "grasps.json"
    file.write_text(format_grasps(hand, grasp))
    with pytest.raises(ModelFileError, match=r"units\.length|metres"):
        read_foreign(file, hand, unit_m=0.001)
    memory = [x.clone() for x in (grasp.joints, grasp.obj_from_hand, grasp.pregrasp)]
    read = grasps_from_joints(hand, *memory)
    for x in memory:
        x.mul_(0.0)
    np.testing.assert_allclose(read.joints, grasp.joints, atol=1e-12)
    np.testing.assert_allclose(read.obj_from_hand, grasp.obj_from_hand, atol=1e-12)
    np.testing.assert_allclose(read.pregrasp, grasp.pregrasp, atol=1e-12)
