"""Messages without ROS: rosbags' definitions, ours of MoveIt and of the action, strict types, and
.mcap files.
"""

from pathlib import Path
from types import SimpleNamespace

import messages
import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import Nodetype

ROOT = Path(__file__).parents[2]
STORE = get_typestore(Stores.ROS2_HUMBLE)
OTHERS = {
    "object_recognition_msgs/ObjectType": "string key\nstring db",
    "moveit_msgs/CollisionObject": """std_msgs/Header header
        geometry_msgs/Pose pose
        string id
        object_recognition_msgs/ObjectType type
        shape_msgs/SolidPrimitive[] primitives
        geometry_msgs/Pose[] primitive_poses
        shape_msgs/Mesh[] meshes
        geometry_msgs/Pose[] mesh_poses
        shape_msgs/Plane[] planes
        geometry_msgs/Pose[] plane_poses
        string[] subframe_names
        geometry_msgs/Pose[] subframe_poses
        byte operation""",
    "moveit_msgs/AttachedCollisionObject": """string link_name
        CollisionObject object
        string[] touch_links
        trajectory_msgs/JointTrajectory detach_posture
        float64 weight""",
    "moveit_msgs/RobotState": """sensor_msgs/JointState joint_state
        sensor_msgs/MultiDOFJointState multi_dof_joint_state
        AttachedCollisionObject[] attached_collision_objects
        bool is_diff""",
}
MOVEIT = {
    "GripperTranslation": "geometry_msgs/Vector3Stamped direction\nfloat32 desired_distance\nfloat32 min_distance",
    "Grasp": """string id
        trajectory_msgs/JointTrajectory pre_grasp_posture
        trajectory_msgs/JointTrajectory grasp_posture
        geometry_msgs/PoseStamped grasp_pose
        float64 grasp_quality
        GripperTranslation pre_grasp_approach
        GripperTranslation post_grasp_retreat
        GripperTranslation post_place_retreat
        float32 max_contact_force
        string[] allowed_touch_objects""",
}
"""The fields of messages of MoveIt, and of what they hold."""
ACTION = (ROOT / "examples/ros2/action/PlanGrasp.action").read_text().split("---\n")
for name, text in (OTHERS | {f"moveit_msgs/{name}": text for name, text in MOVEIT.items()}).items():
    STORE.register(
        get_types_from_msg("\n".join(map(str.strip, text.splitlines())), name.replace("/", "/msg/"))
    )
for name, text in zip(("Goal", "Result", "Feedback"), ACTION, strict=True):
    STORE.register(get_types_from_msg(text, f"torchgrasp_ros/msg/PlanGrasp_{name}"))


def message(name, /, **fields):
    """A message of rosbags, of a name such as "sensor_msgs/JointState"."""
    return STORE.types[name.replace("/", "/msg/")](**fields)


def types():
    """The classes that the nodes need, of rosbags."""
    classes = {
        name: STORE.types[f"{package}/msg/{name}"] for name, package in messages.PACKAGES.items()
    }
    return SimpleNamespace(
        **classes, floats=lambda numbers: np.array(list(numbers), dtype=np.float64)
    )


def time(seconds):
    return message("builtin_interfaces/Time", sec=seconds, nanosec=0)


def header(frame):
    return message("std_msgs/Header", stamp=time(7), frame_id=frame)


def check(value, name):
    """Refuse a field of another type than its definition's, as strictly as rclpy: a whole number is
    no float.
    """
    assert type(value).__name__ == name.replace("/", "__"), f"{type(value)} for {name}"
    for field, (kind, of) in STORE.fielddefs[name][1]:
        inner = of
        found = getattr(value, field)
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (kind, inner), _ = of
            if kind is Nodetype.BASE and inner[0] != "string":
                assert isinstance(found, np.ndarray) and found.dtype == inner[0], (
                    f"{field}: {found!r}"
                )
                continue
            assert isinstance(found, list), f"{field}: {found!r}"
        else:
            found = [found]
        for item in found:
            if kind is Nodetype.NAME:
                check(item, inner)
            else:
                wanted = {"string": str, "bool": bool}.get(
                    inner[0], float if "float" in inner[0] else int
                )
                assert type(item) is wanted, f"{name}.{field}: {item!r}"


def through_mcap(path, name, *written):
    """The messages as they are read back from an .mcap file that holds them; each is checked
    against its definition.
    """
    full = name.replace("/", "/msg/")
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/topic", full, typestore=STORE)
        for stamp, one in enumerate(written):
            check(one, full)
            bag.write(topic, stamp, STORE.serialize_cdr(one, full))
    (file,) = path.glob("*.mcap")
    with Reader(file.parent) as bag:
        return [
            STORE.deserialize_cdr(data, connection.msgtype)
            for connection, _, data in bag.messages()
        ]


def through_cdr(one, name):
    """The message as another process gets it."""
    full = name.replace("/", "/msg/")
    check(one, full)
    return STORE.deserialize_cdr(STORE.serialize_cdr(one, full), full)
