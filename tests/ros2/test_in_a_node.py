"""The nodes' own code, `main`, in a stand-in for rclpy that calls back what the nodes registered."""

import dataclasses
import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import close_node
import messages
import numpy as np
import plan_node
import pytest
import torch

from tests.pinch import pinch
from tests.ros2 import bags
from tests.ros2.test_plan_node import CAMERA, goal
from torchgrasp.export import format_moveit


class Lost(Exception):
    """Stands for tf2_ros.TransformException."""


class Node:
    """A node that keeps what is registered with it."""

    def __init__(self, parameters):
        self.parameters = parameters
        self.published = []
        self.timers = []
        self.services = {}
        self.heard = {}

    def declare_parameter(self, name, default):
        assert isinstance(default, str | int | float | bool | list)
        return SimpleNamespace(value=self.parameters.pop(name, default))

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def create_subscription(self, kind, topic, callback, depth):
        self.heard[topic] = callback

    def create_service(self, kind, name, callback):
        self.services[name] = callback

    def create_timer(self, period, callback):
        self.timers.append((period, callback))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: bags.time(3)))


@pytest.fixture
def ros(monkeypatch):
    """A function that runs a node's `main` with parameters, and returns the node and its action's
    callback.
    """

    def run(main, poses=None, **parameters):
        node = Node(parameters)
        served = []
        transforms = poses or {}

        def look_up(frame, source, stamp, wait):
            if (frame, source) not in transforms:
                raise Lost(f"no {source} in {frame}")
            return SimpleNamespace(transform=transforms[frame, source])

        actions = {
            x: bags.STORE.types[f"torchgrasp_ros/msg/PlanGrasp_{x}"] for x in ("Result", "Feedback")
        }
        content = {
            "rclpy": {
                "init": lambda: None,
                "create_node": lambda name: node,
                "spin": lambda *_: None,
            },
            "rclpy.action": {
                "ActionServer": lambda *a, **k: served.append(a[3]),
                "CancelResponse": MagicMock(),
            },
            "rclpy.callback_groups": {"ReentrantCallbackGroup": MagicMock()},
            "rclpy.duration": {"Duration": lambda seconds: seconds},
            "rclpy.executors": {
                "ExternalShutdownException": Lost,
                "MultiThreadedExecutor": MagicMock(),
            },
            "tf2_ros": {
                "Buffer": lambda: SimpleNamespace(lookup_transform=look_up),
                "TransformListener": MagicMock(),
                "TransformException": Lost,
            },
            "torchgrasp_ros.action": {"PlanGrasp": SimpleNamespace(**actions)},
            "std_srvs.srv": {"SetBool": None},
        }
        for package in {*messages.PACKAGES.values()}:
            of = [name for name, home in messages.PACKAGES.items() if home == package]
            content[f"{package}.msg"] = {
                name: bags.STORE.types[f"{package}/msg/{name}"] for name in of
            }
        content["std_msgs.msg"]["Bool"] = bags.STORE.types["std_msgs/msg/Bool"]
        for name, attributes in content.items():
            module = ModuleType(name)
            vars(module).update(attributes)
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setattr(
            messages._Ros, "floats", staticmethod(lambda x: np.array(list(x), dtype=np.float64))
        )
        monkeypatch.setattr("gc.freeze", lambda: None)
        main()
        assert not node.parameters  # each is a parameter of the node
        return node, served

    return run


def as_transform(pose):
    x, y, z, w = plan_node.messages.Rotation.from_matrix(pose[:3, :3]).as_quat()
    place = [float(v) for v in pose[:3, 3]]
    return bags.message(
        "geometry_msgs/Transform",
        translation=bags.message("geometry_msgs/Vector3", **dict(zip("xyz", place, strict=True))),
        rotation=bags.message("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
    )


def test_the_action_gives_pose_and_camera_to_the_plan_and_its_grasps_to_the_result(
    ros, monkeypatch
):
    hand, grasp = pinch("allegro")
    given = []

    def plan(types, asked, pose, camera, settings, tell):
        given.extend((pose, camera, settings))
        tell("shape", "a line")
        return plan_node.Planned(
            messages.write_grasps(types, format_moveit(hand, grasp), "base", bags.time(7)), "file"
        )

    monkeypatch.setattr(plan_node, "plan", plan)
    _, (execute,) = ros(
        plan_node.main, {("base", "camera"): as_transform(CAMERA.numpy())}, starts=7
    )
    handle = MagicMock(request=goal(), is_cancel_requested=False)
    result = bags.through_cdr(execute(handle), "torchgrasp_ros/PlanGrasp_Result")
    assert result.file == "file" and len(result.grasps) == 1 and given[2].starts == 7
    np.testing.assert_allclose(given[0], CAMERA, atol=1e-9)
    np.testing.assert_allclose(given[1], CAMERA[:3, 3], atol=1e-9)
    (told,) = handle.publish_feedback.call_args.args
    assert bags.through_cdr(told, "torchgrasp_ros/PlanGrasp_Feedback").stage == "shape"
    handle.succeed.assert_called_once_with()


def test_a_goal_that_tf_cannot_place_aborts_and_a_canceled_one_is_canceled(ros):
    _, (execute,) = ros(plan_node.main)
    handle = MagicMock(request=goal(), is_cancel_requested=False)
    result = bags.through_cdr(execute(handle), "torchgrasp_ros/PlanGrasp_Result")
    assert "no camera in base" in result.message
    handle.abort.assert_called_once_with()
    pose = {("base", "camera"): as_transform(CAMERA.numpy())}
    _, (execute,) = ros(plan_node.main, pose)
    handle = MagicMock(request=goal(), is_cancel_requested=True)
    assert execute(handle).message == "canceled"
    handle.canceled.assert_called_once_with()


def test_the_timer_hears_the_allegro_and_sends_its_commands(ros, tmp_path):
    hand, grasp = pinch("allegro")
    meta = grasp.meta | {"hand": "allegro", "hand_sha256": hand.source.sha256}
    dataclasses.replace(grasp, meta=meta).save(tmp_path / "g")
    node, _ = ros(close_node.main, grasps=str(tmp_path / "g"), rate=250.0)
    ((period, tick),) = node.timers
    tick()
    assert period == 1 / 250 and [topic for topic, _ in node.published] == [
        "~/closed"
    ]  # nothing was heard yet
    opened = hand.expand_joints(grasp.pregrasp)[0]
    state = bags.message(
        "sensor_msgs/JointState",
        header=bags.header(""),
        name=[],
        position=opened.numpy(),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
    node.heard["allegroHand/joint_states"](state)
    tick()
    topic, command = node.published[1]
    assert topic == "allegroHand/joint_cmd" and torch.allclose(
        torch.from_numpy(command.position), opened
    )
    bags.through_cdr(command, "sensor_msgs/JointState")
    for wish, sent in ((True, True), (False, False)):
        answer = node.services["~/close"](SimpleNamespace(data=wish), SimpleNamespace())
        assert answer.success and answer.message == ""
        node.heard["allegroHand/joint_states"](state)
        tick()
        assert bool((node.published[-2][1].position != opened.numpy()).any()) == sent
    bags.through_cdr(node.published[-1][1], "std_msgs/Bool")
