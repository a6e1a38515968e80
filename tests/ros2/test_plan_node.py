"""The planning node without ROS: a cloud from an .mcap file goes in, grasps go into an .mcap file
and come back.
"""

import dataclasses
import functools
import json
import math
from pathlib import Path

import messages
import numpy as np
import plan_node
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.pinch import pinch
from tests.ros2 import bags
from tests.ros2.test_clouds import FLOAT32, XYZ, cloud
from torchgrasp import Status, load_grasps, load_hand, load_object
from torchgrasp.export import format_moveit
from torchgrasp.geometry.frames import inverse, rigid

HAND = "leap"  # whose URDF has another order of joints than the driver
NAMES = bags.ROOT / "examples/ros2/drivers/leap.json"
CAMERA = rigid(
    torch.tensor(Rotation.from_euler("xyz", [-2.2, 0.2, 1.0]).as_matrix()),
    load_object("cylinder").view.viewpoint,
)
"""Pose of the camera in the frame of gravity: it is where it saw the cylinder."""


def seen():
    """A cylinder on a part of its table, in the camera's frame, organised, with pixels without
    depth.
    """
    thing = load_object("cylinder").view.points.double()
    steps = torch.linspace(-0.15, 0.15, 40, dtype=torch.float64)
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    ring = (x**2 + y**2 > 0.06**2).flatten()
    table = torch.stack([x.flatten(), y.flatten(), torch.zeros(1600, dtype=torch.float64)], 1)[ring]
    inside = inverse(CAMERA)
    points = torch.cat([thing, table]) @ inside[:3, :3].T + inside[:3, 3]
    points = torch.cat([points, torch.full((len(points) % 2 + 2, 3), torch.nan)])
    fields = [*XYZ, ("rgb", 16, FLOAT32)]
    pack = lambda *p: np.array([*p, 0, 9], "<f4").tobytes()  # noqa: E731
    return cloud(fields, 32, pack, points.tolist(), height=2, padding=4, dense=False)


def goal(**more):
    near = bags.message("geometry_msgs/Point", x=math.nan, y=0.0, z=0.0)
    fields = {
        "near": near,
        "cloud": seen(),
        "hand": HAND,
        "gravity_frame": "base",
        "object_id": "../can",
        "cut": True,
        "most": 3,
    }
    return bags.message("torchgrasp_ros/PlanGrasp_Goal", **fields | {"table": math.nan} | more)


@functools.cache
def planned(folder):
    """The answer to a goal that came from an .mcap file, and the stages that were told."""
    (asked,) = bags.through_mcap(folder / "in", "torchgrasp_ros/PlanGrasp_Goal", goal())
    stages = []
    tell = lambda stage, message: stages.append((stage, message))  # noqa: E731
    flange = (0.0, 0.0, -0.05, 0.0, 0.0, math.sin(0.2), math.cos(0.2))
    settings = plan_node.Settings(starts=20, folder=str(folder), names=str(NAMES), flange=flange)
    found = plan_node.plan(
        bags.types(), asked, CAMERA.numpy(), CAMERA[:3, 3].numpy(), settings, tell
    )
    return found, stages, flange


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("plan")


def test_the_grasps_come_back_from_an_mcap_file_as_they_were_planned(folder):
    found, stages, flange = planned(folder)
    assert [stage for stage, _ in stages][:3] == ["cloud", "shape", "plan"] and not found.message
    for stage, text in stages:
        bags.through_cdr(
            bags.message("torchgrasp_ros/PlanGrasp_Feedback", stage=stage, message=text),
            "torchgrasp_ros/PlanGrasp_Feedback",
        )
    result = bags.message("torchgrasp_ros/PlanGrasp_Result", **found._asdict())
    (read,) = bags.through_mcap(folder / "out", "torchgrasp_ros/PlanGrasp_Result", result)
    assert Path(read.file).parent == folder  # whatever the id is
    grasps = load_grasps(read.file)
    hand = load_hand(HAND)
    names = json.loads(NAMES.read_text())
    assert 1 <= len(read.grasps) == len(grasps) <= 3 and bool((grasps.status == Status.OK).all())
    assert (
        abs(grasps.table.offset) < 0.002 and float(grasps.table.normal[2]) > 0.999
    )  # found below the cylinder
    order = [hand.tree.joint_names.index(joint) for joint in names]
    mount = Rotation.from_quat(flange[3:])
    for row, one in enumerate(read.grasps):
        assert one.id == f"grasp_{row}" and one.allowed_touch_objects == ["../can"]
        assert one.grasp_quality == pytest.approx(float(grasps.success[row]), abs=1e-8)
        for posture, joints in (
            (one.pre_grasp_posture, grasps.pregrasp),
            (one.grasp_posture, grasps.joints),
        ):
            assert posture.joint_names == [str(k) for k in range(16)]
            np.testing.assert_allclose(
                posture.points[0].positions, hand.expand_joints(joints)[row, order], atol=1e-6
            )
        assert (
            one.grasp_posture.points[1].effort.any()
            and one.grasp_posture.points[1].time_from_start.nanosec == 8e8
        )
        pose = grasps.obj_from_hand[row].double().numpy()
        place = one.grasp_pose.pose.position
        turn = one.grasp_pose.pose.orientation
        assert one.grasp_pose.header.frame_id == "base" and one.grasp_pose.header.stamp.sec == 7
        np.testing.assert_allclose(
            [place.x, place.y, place.z], pose[:3, 3] - 0.05 * pose[:3, 2], atol=1e-6
        )
        wanted = Rotation.from_matrix(pose[:3, :3]) * mount
        assert (
            Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]) * wanted.inv()
        ).magnitude() < 1e-5
        there, back, up = (
            [move.direction.vector.x, move.direction.vector.y, move.direction.vector.z]
            for move in (one.pre_grasp_approach, one.post_place_retreat, one.post_grasp_retreat)
        )
        np.testing.assert_allclose(there, grasps.approach[row], atol=1e-6)
        np.testing.assert_allclose(back, -np.array(there))
        np.testing.assert_allclose(up, grasps.table.normal, atol=1e-6)
        assert one.post_grasp_retreat.min_distance < one.post_grasp_retreat.desired_distance


@pytest.mark.parametrize(
    ("wrong", "words"), [({"hand": "no_hand"}, "no_hand"), ({"cut": False, "table": 2.0}, "")]
)
def test_a_goal_without_grasps_says_why(wrong, words):
    pose = CAMERA.numpy()
    camera = CAMERA[:3, 3].numpy()
    found = plan_node.plan(
        bags.types(), goal(**wrong), pose, camera, plan_node.Settings(starts=5), print
    )
    assert found.grasps == [] and words in found.message and found.message
    bags.through_cdr(
        bags.message("torchgrasp_ros/PlanGrasp_Result", **found._asdict()),
        "torchgrasp_ros/PlanGrasp_Result",
    )


def test_parameters_that_cannot_be_read_are_told_before_planning(tmp_path):
    for wrong in ({"names": str(tmp_path / "none.json")}, {"flange": (0.0,) * 7}):
        settings = plan_node.Settings(starts=5)._replace(**wrong)
        found = plan_node.plan(
            bags.types(), goal(), CAMERA.numpy(), None, settings, lambda *_: pytest.fail("planned")
        )
        assert found.grasps == [] and found.message


def test_the_object_at_a_place_is_cut_out_of_a_scene():
    """Nothing is within half a metre of a place 2 m off; at the cylinder there is the cylinder,
    without its table.
    """
    told = []

    def stop(stage, message):
        told.append(message)
        raise plan_node.GraspError("enough")

    for x in (0.0, 2.0):
        near = bags.message("geometry_msgs/Point", x=x, y=0.0, z=0.05)
        found = plan_node.plan(
            bags.types(), goal(near=near), CAMERA.numpy(), None, plan_node.Settings(), stop
        )
        assert (found.message == "enough") == (x == 0.0)
    assert len(told) == 1 and int(told[0].split()[0]) <= len(load_object("cylinder").view)


def test_an_unknown_quality_is_0_in_a_message():
    hand, grasp = pinch("allegro")
    text = format_moveit(hand, dataclasses.replace(grasp, known=torch.zeros(1, dtype=torch.bool)))
    assert "grasp_quality: .nan" in text
    (message,) = messages.write_grasps(bags.types(), text, "base", bags.time(1))
    assert message.grasp_quality == 0.0
    bags.through_cdr(message, "moveit_msgs/Grasp")


def test_a_stage_that_is_told_can_cancel():
    def stop(stage, message):
        raise plan_node.GraspError("canceled")

    found = plan_node.plan(bags.types(), goal(), CAMERA.numpy(), None, plan_node.Settings(), stop)
    assert found == plan_node.Planned([], message="canceled")


def test_the_strict_check_refuses_a_whole_number_and_a_list_of_numbers():
    point = bags.types().Point(x=1, y=0.0, z=0.0)
    with pytest.raises(AssertionError, match="x: 1"):
        bags.check(point, "geometry_msgs/msg/Point")
    with pytest.raises(TypeError):
        bags.types().Point(x=1.0, y=0.0, zz=0.0)
    assert messages.PACKAGES.keys() == {*messages.Types.__annotations__} - {"floats"}
