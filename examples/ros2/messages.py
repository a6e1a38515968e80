"""ROS 2 messages to clouds and poses, and grasps to messages.

The classes of messages are given as `types`: those of ROS (`ros_types`), or those of rosbags, as in
the tests.
"""

import array
import functools
import importlib
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from torchgrasp import PointCloud

if (
    TYPE_CHECKING
):  # rosbags has the definitions with types, which pyright compares with the code below
    from rosbags.typesys.stores import ros2_humble as ros

PACKAGES = {
    "Duration": "builtin_interfaces",
    "Grasp": "moveit_msgs",
    "GripperTranslation": "moveit_msgs",
    "Header": "std_msgs",
    "JointState": "sensor_msgs",
    "JointTrajectory": "trajectory_msgs",
    "JointTrajectoryPoint": "trajectory_msgs",
    "MultiDOFJointState": "sensor_msgs",
    "Point": "geometry_msgs",
    "Pose": "geometry_msgs",
    "PoseStamped": "geometry_msgs",
    "Quaternion": "geometry_msgs",
    "RobotState": "moveit_msgs",
    "Vector3": "geometry_msgs",
    "Vector3Stamped": "geometry_msgs",
}
"""The package of each message that the nodes make."""


class Types(Protocol):
    """The classes of messages, and the function that makes a message's list of numbers."""

    Duration: "type[ros.builtin_interfaces__msg__Duration]"
    Grasp: Callable[..., Any]
    GripperTranslation: Callable[..., Any]
    Header: "type[ros.std_msgs__msg__Header]"
    JointState: "type[ros.sensor_msgs__msg__JointState]"
    JointTrajectory: "type[ros.trajectory_msgs__msg__JointTrajectory]"
    JointTrajectoryPoint: "type[ros.trajectory_msgs__msg__JointTrajectoryPoint]"
    MultiDOFJointState: "type[ros.sensor_msgs__msg__MultiDOFJointState]"
    Point: "type[ros.geometry_msgs__msg__Point]"
    Pose: "type[ros.geometry_msgs__msg__Pose]"
    PoseStamped: "type[ros.geometry_msgs__msg__PoseStamped]"
    Quaternion: "type[ros.geometry_msgs__msg__Quaternion]"
    RobotState: Callable[..., Any]
    Vector3: "type[ros.geometry_msgs__msg__Vector3]"
    Vector3Stamped: "type[ros.geometry_msgs__msg__Vector3Stamped]"
    floats: Callable[[Iterable[float]], Any]


def ros_types() -> Types:
    """Return the classes of a sourced ROS; each is imported when it is first used."""
    types: Any = _Ros()
    return types


class _Ros:
    """The classes of messages as attributes, by name."""

    floats = functools.partial(array.array, "d")

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(f"{PACKAGES[name]}.msg"), name)


def read_points(message: "ros.sensor_msgs__msg__PointCloud2") -> np.ndarray:
    """Return the finite points (n, 3) of a cloud of any layout: padding, colours, rows, float32 or
    float64.
    """
    order = ">" if message.is_bigendian else "<"
    kinds = {7: "f4", 8: "f8"}
    at = {field.name: field for field in message.fields if field.name in ("x", "y", "z")}
    if len(at) < 3 or any(field.datatype not in kinds for field in at.values()):
        raise ValueError(
            f"a cloud with fields {[field.name for field in message.fields]}, not x, y and z as floats"
        )
    if len(message.data) < message.height * message.row_step:
        raise ValueError(
            f"{len(message.data)} bytes of points, less than {message.height} rows have"
        )
    layout = np.dtype(
        {
            "names": list(at),
            "formats": [order + kinds[field.datatype] for field in at.values()],
            "offsets": [field.offset for field in at.values()],
            "itemsize": message.point_step,
        }
    )
    shape = (message.height, message.width)
    strides = (message.row_step, message.point_step)
    rows = np.ndarray(shape, layout, np.asarray(message.data, np.uint8).tobytes(), strides=strides)
    points = np.stack([rows[axis].astype(float).ravel() for axis in "xyz"], axis=1)
    return points[np.isfinite(points).all(axis=1)]


def read_cloud(
    message: "ros.sensor_msgs__msg__PointCloud2",
    frame_from_cloud: np.ndarray,
    camera: np.ndarray | None,
) -> PointCloud:
    """Return the cloud in another frame; `camera` (3,) is the camera's position [m] there, None if
    it is unknown.
    """
    points = read_points(message) @ frame_from_cloud[:3, :3].T + frame_from_cloud[:3, 3]
    return PointCloud(
        torch.from_numpy(points), viewpoint=None if camera is None else torch.from_numpy(camera)
    )


def read_pose(position: Iterable[float], quaternion_xyzw: Iterable[float]) -> np.ndarray:
    """Return the pose matrix (4, 4) of a position [m] and a quaternion."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(list(quaternion_xyzw)).as_matrix()
    pose[:3, 3] = list(position)
    return pose


def read_transform(transform: "ros.geometry_msgs__msg__Transform") -> np.ndarray:
    """Return the pose matrix (4, 4) of a transform of tf."""
    place = transform.translation
    turn = transform.rotation
    return read_pose((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def write_grasps(types: Types, text: str, frame: str, stamp: Any) -> list[Any]:
    """Return the moveit_msgs/Grasp of a text that `format_moveit` made, with poses in `frame`."""
    header = types.Header(stamp=stamp, frame_id=frame)
    return [
        types.Grasp(
            id=content["id"],
            pre_grasp_posture=write_trajectory(types, content["pre_grasp_posture"], stamp),
            grasp_posture=write_trajectory(types, content["grasp_posture"], stamp),
            grasp_pose=types.PoseStamped(
                header=header,
                pose=types.Pose(
                    position=types.Point(**content["grasp_pose"]["pose"]["position"]),
                    orientation=types.Quaternion(**content["grasp_pose"]["pose"]["orientation"]),
                ),
            ),
            grasp_quality=max(
                0.0, content["grasp_quality"]
            ),  # MoveIt sorts by it, which NaN would break
            pre_grasp_approach=_translation(types, content["pre_grasp_approach"], header),
            post_grasp_retreat=_translation(types, content["post_grasp_retreat"], header),
            post_place_retreat=_translation(types, content["post_place_retreat"], header),
            max_contact_force=content["max_contact_force"],
            allowed_touch_objects=content["allowed_touch_objects"],
        )
        for content in yaml.safe_load(text)
    ]


def _translation(types: Types, content: dict[str, Any], header: Any) -> Any:
    """Return a moveit_msgs/GripperTranslation."""
    vector = types.Vector3(**content["direction"]["vector"])
    distances = {name: content[name] for name in ("desired_distance", "min_distance")}
    return types.GripperTranslation(
        direction=types.Vector3Stamped(header=header, vector=vector), **distances
    )


def write_trajectory(
    types: Types, content: dict[str, Any], stamp: Any
) -> "ros.trajectory_msgs__msg__JointTrajectory":
    """Return a trajectory_msgs/JointTrajectory of a text of `format_moveit` or
    `format_trajectories`.
    """
    points = [
        types.JointTrajectoryPoint(
            positions=types.floats(point["positions"]),
            velocities=types.floats(()),
            accelerations=types.floats(()),
            effort=types.floats(point["effort"]),
            time_from_start=types.Duration(**point["time_from_start"]),
        )
        for point in content["points"]
    ]
    header = types.Header(stamp=stamp, frame_id=content["header"]["frame_id"])
    return types.JointTrajectory(header=header, joint_names=content["joint_names"], points=points)
