#!/usr/bin/env python3
"""The action `plan_grasp`: a PointCloud2 goes in, moveit_msgs/Grasp come out, with the stages as
feedback.

`plan` holds what the node does with messages; it needs no ROS.
`torchgrasp_ros/action/PlanGrasp.action` has the fields.
"""

import contextlib
import functools
import json
import math
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import messages
import numpy as np
import torch

from torchgrasp import ContactSpec, GraspError, Status, load_hand, plan_grasps
from torchgrasp.cloud import cut_object, remove_outliers, voxel_downsample
from torchgrasp.export import format_moveit
from torchgrasp.ik import opened_pose

load = functools.cache(load_hand)


class Settings(NamedTuple):
    """What stays the same for all goals of a node: parameters of the node, by these names."""

    starts: int = 200
    folder: str = ""  # where the grasps are written; by default a new folder
    camera_frame: str = ""  # frame at the camera's centre; by default that of the cloud
    names: str = ""  # JSON file of the driver's names of joints, in its order
    flange: Sequence[float] = (
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        1.0,
    )  # x y z qx qy qz qw, in the hand's frame


class Planned(NamedTuple):
    """The fields of the action's result."""

    grasps: list[Any]
    file: str = ""
    message: str = ""


def plan(
    types: messages.Types,
    goal: Any,
    frame_from_cloud: np.ndarray,
    camera: np.ndarray | None,
    settings: Settings,
    tell: Callable[[str, str], None],
) -> Planned:
    """Plan the grasps of a goal; `tell` gets each stage and a line about it.

    `frame_from_cloud` (4, 4) leads from the cloud's frame to the goal's, whose z is up. `camera`
    (3,) is the camera's position [m] there, or None.
    """
    frame = goal.gravity_frame or goal.cloud.header.frame_id
    try:
        rename = json.loads(Path(settings.names).read_text()) if settings.names else None
        flange = torch.from_numpy(messages.read_pose(settings.flange[:3], settings.flange[3:]))
        hand = load(goal.hand or "allegro")
        cloud = messages.read_cloud(goal.cloud, frame_from_cloud, camera)
        table = None if math.isnan(goal.table) else goal.table
        if goal.cut:
            near = (
                None
                if math.isnan(goal.near.x)
                else torch.tensor([goal.near.x, goal.near.y, goal.near.z])
            )
            cloud, table = cut_object(cloud, torch.tensor([0.0, 0.0, 1.0]), near, gap=0.02)
        cloud = remove_outliers(voxel_downsample(cloud, 0.002))
        tell("cloud", f"{len(cloud)} points")
        observer = lambda stage, message, _: tell(stage, message)  # noqa: E731
        grasps = plan_grasps(
            cloud, hand, ContactSpec(table=table), settings.starts, observer=observer
        )
    except (GraspError, OSError, ValueError) as error:
        return Planned([], message=str(error))
    stays = (
        opened_pose(hand, grasps.pregrasp, grasps.obj_from_hand, grasps.table)
        == grasps.obj_from_hand
    )
    best = grasps[(grasps.status == Status.OK) & stays.all(2).all(1)][: goal.most or None]
    if not len(best):
        return Planned(
            [],
            message="no executable grasp: torchgrasp cloud check and grasp tell more about the cloud",
        )
    name = re.sub(r"[^\w-]", "_", goal.object_id) or "object"  # no id leads out of the folder
    file = Path(settings.folder or tempfile.mkdtemp(), f"{name}.safetensors")
    best.save(file)
    text = format_moveit(
        hand, best, rename=rename, flange=flange, object_id=goal.object_id or "object"
    )
    return Planned(messages.write_grasps(types, text, frame, goal.cloud.header.stamp), str(file))


def main() -> None:
    """Serve the action until the node is shut down."""
    import rclpy  # pyright: ignore[reportMissingImports]
    import tf2_ros  # pyright: ignore[reportMissingImports]
    from rclpy.action import ActionServer, CancelResponse  # pyright: ignore[reportMissingImports]
    from rclpy.callback_groups import ReentrantCallbackGroup  # pyright: ignore[reportMissingImports]
    from rclpy.duration import Duration  # pyright: ignore[reportMissingImports]
    from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor  # pyright: ignore[reportMissingImports]
    from torchgrasp_ros.action import PlanGrasp  # pyright: ignore[reportMissingImports]

    rclpy.init()
    node = rclpy.create_node("plan_grasp")
    types = messages.ros_types()
    defaults = Settings()._asdict() | {"flange": list(Settings().flange)}
    settings = Settings(
        **{name: node.declare_parameter(name, value).value for name, value in defaults.items()}
    )
    frames = tf2_ros.Buffer()
    wait = Duration(seconds=1.0)
    tf2_ros.TransformListener(frames, node)

    def pose(frame: str, header: Any) -> np.ndarray:
        """Return the pose of the cloud's or the camera's frame in another frame, when the cloud was
        seen.
        """
        found = frames.lookup_transform(frame, header.frame_id, header.stamp, wait)
        return messages.read_transform(found.transform)

    def execute(handle: Any) -> Any:
        """Plan for one goal."""

        def tell(stage: str, message: str) -> None:
            if handle.is_cancel_requested:
                raise GraspError("canceled")
            handle.publish_feedback(PlanGrasp.Feedback(stage=stage, message=message))

        goal = handle.request
        header = handle.request.cloud.header
        frame = goal.gravity_frame or header.frame_id
        seen = types.Header(stamp=header.stamp, frame_id=settings.camera_frame or header.frame_id)
        try:
            camera = None if seen.frame_id == frame else pose(frame, seen)[:3, 3]
            planned = plan(types, goal, pose(frame, header), camera, settings, tell)
        except tf2_ros.TransformException as error:
            planned = Planned([], message=str(error))
        if handle.is_cancel_requested:
            handle.canceled()
        elif planned.grasps:
            handle.succeed()
        else:
            handle.abort()
        return PlanGrasp.Result(**planned._asdict())

    ActionServer(
        node,
        PlanGrasp,
        "plan_grasp",
        execute,
        callback_group=ReentrantCallbackGroup(),
        cancel_callback=lambda _: CancelResponse.ACCEPT,
    )
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node, MultiThreadedExecutor())


if __name__ == "__main__":
    main()
