"""Export of grasps as ROS 2 messages in YAML: moveit_msgs/Grasp and trajectory_msgs/JointTrajectory."""

import math
from collections.abc import Iterator
from typing import Annotated, Any

from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Positive, Range, checked
from torchgrasp.control.forces import squeeze
from torchgrasp.control.paper.closings import POSE_TIME
from torchgrasp.export.postures import quaternion
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.ik.motion import APPROACH_DISTANCE
from torchgrasp.values import Grasps

OBJECT_FRAME = "object"
"""Name of the object's frame in the messages: the frame of the cloud; publish a transform of that name."""


@checked
def format_moveit(
    hand: Hand, grasps: Grasps, force: Annotated[float, Range(0.01, 100.0)] = 4.0, kp: Positive | None = None
) -> str:
    """Return grasps as a YAML list of moveit_msgs/Grasp.

    `grasp_pose` is that of the root link of the hand's URDF in `OBJECT_FRAME`: attach the end-effector there. The
    pre-grasp posture has positions; the grasp posture closes to the contacts, then to targets that press, with the
    torques [N m] as effort. `grasp_quality` is the predicted success. The retreat is opposite to the approach. `force`
    [N] is the normal force of the strongest finger. `kp` is the stiffness of the robot's own position control [N
    m/rad]; None: the hand's.

    Raises:
        BadArgument: joints of another hand, or a force or stiffness that is not positive.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_moveit(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> print(text.splitlines()[2])
    # the hand's frame is link 'palm' of hand.urdf; joints in the order of joint_names
    """
    root = read_urdf(hand.urdf_path).root
    messages = [
        {
            "id": f"grasp_{row}",
            "pre_grasp_posture": _posture(root, points[:1]),
            "grasp_posture": _posture(root, points[1:]),
            "grasp_pose": {"header": {"frame_id": OBJECT_FRAME}, "pose": _pose(grasps.obj_from_hand[row])},
            "grasp_quality": float(grasps.success[row]),
            "pre_grasp_approach": _translation(grasps.approach[row]),
            "post_grasp_retreat": _translation(-grasps.approach[row]),
            "max_contact_force": force,
            "allowed_touch_objects": [],
        }
        for row, points in enumerate(_points(hand, grasps, force, kp))
    ]
    return _heading(hand, root, "a list of moveit_msgs/Grasp") + _document(messages)


@checked
def format_trajectories(
    hand: Hand, grasps: Grasps, force: Annotated[float, Range(0.01, 100.0)] = 4.0, kp: Positive | None = None
) -> str:
    """Return a YAML document of trajectory_msgs/JointTrajectory for each grasp: pre-grasp, grasp, squeeze.

    The hand must already be at its pose, which `format_moveit` and `format_grasps` give. Arguments and errors are those
    of `format_moveit`.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_trajectories(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> text.count("time_from_start")
    3
    """
    root = read_urdf(hand.urdf_path).root
    documents = [_document(_posture(root, points)) for points in _points(hand, grasps, force, kp)]
    return _heading(hand, root, "a trajectory_msgs/JointTrajectory for each grasp") + "---\n".join(documents)


def _points(hand: Hand, grasps: Grasps, force: float, kp: float | None) -> Iterator[list[dict[str, Any]]]:
    """Yield the trajectory points of each grasp, with every joint by name."""
    hand, grasps = hand.to("cpu"), grasps.to("cpu")
    squeezed = squeeze(hand, grasps, force, kp)
    postures = [hand.expand(q.double()) for q in (grasps.pregrasp, grasps.joints, squeezed.joints)]
    for row in range(len(grasps)):
        torque = dict(zip(hand.joint_names, squeezed.torques[row].tolist(), strict=True))
        points = list[dict[str, Any]]()
        for k, posture in enumerate(postures):
            seconds = k * POSE_TIME
            nanoseconds = round(1e9 * (seconds - math.floor(seconds)))
            points.append(
                {
                    "positions": {joint: float(q[row]) for joint, q in posture.items()},
                    "effort": {joint: torque.get(joint, 0.0) for joint in posture} if k == 2 else {},
                    "time_from_start": {"sec": math.floor(seconds), "nanosec": nanoseconds},
                }
            )
        yield points


def _posture(root: str, points: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a trajectory_msgs/JointTrajectory."""
    listed = [
        {key: list(value.values()) if key != "time_from_start" else value for key, value in point.items()}
        for point in points
    ]
    return {"header": {"frame_id": root}, "joint_names": list(points[0]["positions"]), "points": listed}


def _pose(obj_from_hand: Float[Tensor, "4 4"]) -> dict[str, Any]:
    """Return a geometry_msgs/Pose."""
    w, x, y, z = quaternion(obj_from_hand)
    position = dict(zip("xyz", obj_from_hand[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _translation(direction: Float[Tensor, "3"]) -> dict[str, Any]:
    """Return a moveit_msgs/GripperTranslation along a direction, as long as the approach."""
    vector = dict(zip("xyz", direction.tolist(), strict=True))
    stamped = {"header": {"frame_id": OBJECT_FRAME}, "vector": vector}
    return {"direction": stamped, "desired_distance": APPROACH_DISTANCE, "min_distance": APPROACH_DISTANCE}


def _heading(hand: Hand, root: str, what: str) -> str:
    """Return comment lines that explain the numbers."""
    return (
        f"# {what}, for the {hand.name} hand, by torchgrasp\n"
        f"# metres, radians, newtons, N m; quaternions by name; frame {OBJECT_FRAME!r}: that of the planned cloud\n"
        f"# the hand's frame is link {root!r} of {hand.urdf_path.name}; joints in the order of joint_names\n"
    )


def _document(value: Any) -> str:
    """Return plain values as a YAML document in block style; lists of scalars take one line."""
    return "\n".join(_lines(value)) + "\n"


def _lines(value: Any) -> list[str]:
    """Return the YAML lines of a mapping, or of a list of mappings."""
    lines = list[str]()
    if isinstance(value, dict):
        for key, item in value.items():
            nested = isinstance(item, dict) or (isinstance(item, list) and any(isinstance(x, dict) for x in item))
            lines += [f"{key}:", *(f"  {line}" for line in _lines(item))] if nested else [f"{key}: {_scalar(item)}"]
        return lines
    for item in value:
        first, *rest = _lines(item)
        lines += [f"- {first}", *(f"  {line}" for line in rest)]
    return lines or ["[]"]


def _scalar(value: Any) -> str:
    """Return a scalar, or a list of scalars, as YAML on one line."""
    digits = 9  # decimals of a number [nm, nrad]: YAML 1.1 takes 1e-05 for a text, so none has an exponent
    if isinstance(value, list):
        return f"[{', '.join(map(_scalar, value))}]"
    if isinstance(value, float):
        return f"{value:.{digits}f}" if math.isfinite(value) else ".nan"
    return str(value) if isinstance(value, int) else f'"{value}"'
