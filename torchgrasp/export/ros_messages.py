"""Export of grasps as ROS 2 messages in YAML: moveit_msgs/Grasp and
trajectory_msgs/JointTrajectory.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.finger_forces import check_all_executable
from torchgrasp.control.protocol import POSE_TIME
from torchgrasp.export.arm_motion import ArmMotion
from torchgrasp.export.postures import (
    check_flange,
    check_still,
    follower_joints,
    named_postures,
    quaternion,
    rename_joints,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Force, Pose, Positive
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.ik.motion import APPROACH_DISTANCE, UP
from torchgrasp.values.planning import Grasps

NANOSECONDS = 1e9  # in a second
UNPRESSED = "above", "pregrasp", "grasp"  # moments of a motion before the fingers press
OBJECT_FRAME = "object"
"""Name of the object's frame in the messages: the frame of the cloud. Publish a transform of that
name.
"""


class _Dumper(yaml.SafeDumper):
    """A writer of YAML with nine decimals and no exponent in each number. The reason is that YAML
    1.1 reads 1e-05 as a text.
    """

    def ignore_aliases(self, data: Any) -> bool:
        """Return True, so that a list that occurs twice is written twice, not as a reference."""
        return True

    def represent_number(self, number: float) -> yaml.ScalarNode:
        """Return a float as a YAML number without an exponent."""
        return self.represent_scalar(
            "tag:yaml.org,2002:float", f"{number:.9f}" if math.isfinite(number) else ".nan"
        )


_Dumper.add_representer(float, _Dumper.represent_number)


@checked
def format_moveit(
    hand: Hand,
    grasps: Grasps,
    force: Force = 4.0,
    kp: Positive | None = None,
    rename: Mapping[str, str] | None = None,
    flange: Pose | None = None,
    object_id: str = OBJECT_FRAME,
    actuated: bool = False,
) -> str:
    """Return grasps as a YAML list of moveit_msgs/Grasp, in metres, radians and seconds.

    * `grasp_pose` is the pose of the hand's root link, or of the robot's flange, in the frame
      "object". This is the frame of the planned cloud; publish a transform of this name.
    * `pre_grasp_posture` has the joints of the opened hand.
    * `grasp_posture` has the joints at the contacts, then targets with which the fingers press,
      with their torques [N m] as effort.
    * `grasp_quality` is the predicted success, .nan where it is unknown.
    * `post_grasp_retreat` is along the normal of the plan's table, or along z without a table.

    Args:
        hand: the hand.
        grasps: grasps planned for this hand, best first.
        force: normal force [N] of the strongest finger when the fingers press.
        kp: stiffness [N m/rad] of the robot's position control; None means the hand's own.
        rename: dict from a joint's name in the URDF to the robot's name. These joints come first,
            in this order. None keeps all names.
        flange: pose (4, 4) [m] of the robot's flange in the frame of the hand's root link. With it,
            `grasp_pose` is the pose of the flange. None means that of the root link.
        object_id: id of the object in the planning scene, which the hand may touch.
        actuated: whether to leave out efforts and coupled joints, which follow others. Controllers
            of ros2_control refuse both.

    Raises:
        BadArgument: joints are of another hand, or grasps failed a check.
        BadArgument: the `force` is outside 0.01 to 100 N, or `kp` is not positive.
        BadArgument: names are unknown, empty or equal.
        BadArgument: a hand must go down while it closes, because its opened fingers would be in the
            table. A message with one pose cannot express this.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_moveit(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> print(text.splitlines()[2])
    # the hand's frame is link 'palm' of hand.urdf; joints in the order of joint_names
    """
    check_all_executable(grasps)
    hand = hand.to("cpu")
    grasps = grasps.to("cpu")
    up = UP if grasps.table is None else grasps.table.normal
    poses = grasps.obj_from_hand.double()
    if flange is not None:
        poses = poses @ check_flange(flange)
    check_still(hand, grasps)
    # two motions, to the pre-grasp and from there
    times = POSE_TIME, POSE_TIME, 2 * POSE_TIME
    trajectories = _trajectories(hand, grasps, force, kp, rename, actuated, times, not actuated)
    messages = [
        {
            "id": f"grasp_{row}",
            "pre_grasp_posture": trajectory | {"points": trajectory["points"][:1]},
            "grasp_posture": trajectory | {"points": trajectory["points"][1:]},
            "grasp_pose": {"header": {"frame_id": OBJECT_FRAME}, "pose": _pose(poses[row])},
            "grasp_quality": float(grasps.success[row]),
            "pre_grasp_approach": _translation(grasps.approach[row]),
            "post_grasp_retreat": _translation(up),
            "post_place_retreat": _translation(-grasps.approach[row]),
            "max_contact_force": force,
            "allowed_touch_objects": [object_id],
        }
        for row, trajectory in enumerate(trajectories)
    ]
    of = "" if flange is None else ", whose poses are of the flange"
    return _document(hand, f"a list of moveit_msgs/Grasp{of}", [messages])


@checked
def format_trajectories(
    hand: Hand,
    grasps: Grasps,
    force: Force = 4.0,
    kp: Positive | None = None,
    rename: Mapping[str, str] | None = None,
    actuated: bool = False,
) -> str:
    """Return the trajectories of the hand's joints as text, one YAML document for each grasp.

    Each document is a ROS message trajectory_msgs/JointTrajectory. It has three points: pre-grasp,
    grasp and squeeze, the targets with which the fingers press. Positions are in [rad], or [m] for
    sliding joints. `time_from_start` is in seconds. The hand must already be at its pose, which
    `format_moveit` and `format_grasps` give. The points have no efforts, which position controllers
    refuse; `format_grasps` has the torques.

    Args:
        hand: the hand.
        grasps: grasps planned for this hand, best first.
        force: normal force [N] of the strongest finger at the squeeze.
        kp: stiffness [N m/rad] of the robot's position control; None means the hand's own.
        rename: dict from a joint's name in the URDF to the robot's name. These joints come first,
            in this order. None keeps all names.
        actuated: whether to leave out coupled joints, which follow others. Controllers of
            ros2_control refuse their names.

    Raises `BadArgument` for joints of another hand, and for grasps that failed a check. It is
    raised for names that are unknown, empty or equal. It is also raised for a `force` outside 0.01
    to 100 N, or a `kp` that is not positive.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_trajectories(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> text.count("time_from_start")
    3
    """
    check_all_executable(grasps)
    what = "a trajectory_msgs/JointTrajectory for each grasp"
    # A point at time 0 would be a jump from wherever the hand is.
    times = POSE_TIME, 2 * POSE_TIME, 3 * POSE_TIME
    documents = _trajectories(hand, grasps, force, kp, rename, actuated, times, False)
    return _document(hand, what, documents)


@checked
def format_motion(hand: Hand, motion: ArmMotion, actuated: bool = False) -> str:
    """Return the trajectories of arm and hand as text, one YAML document for each grasp.

    Each document is a ROS message trajectory_msgs/JointTrajectory, with a point for each of
    `motion.times`. Positions are in [rad], or [m] for sliding joints. `time_from_start` is in
    seconds.

    Args:
        hand: the hand on the arm.
        motion: the motions, from `plan_motion`.
        actuated: whether to leave out coupled joints of the hand, which follow others. Controllers
            of ros2_control refuse their names.

    Raises `BadArgument` for a motion of another hand, whose joints have other names or limits.

    >>> import torch
    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> names = ("shoulder", *hand.tree.joint_names)
    >>> still = torch.zeros(1, 2, len(names))
    >>> motion = ArmMotion(names, torch.tensor([0.0, 1.5]), still, {"above": 0})
    >>> format_motion(hand, motion).splitlines()[-1]
    '  time_from_start: {sec: 1, nanosec: 500000000}'
    """
    _check_hand(hand, motion)
    times = [_duration(x) for x in motion.times.tolist()]
    followers = follower_joints(hand) if actuated else ()
    kept = [k for k, joint in enumerate(motion.joint_names) if joint not in followers]
    names = [motion.joint_names[k] for k in kept]
    documents = list[dict[str, Any]]()
    for rows in motion.positions[:, :, kept].tolist():
        timed = zip(rows, times, strict=True)
        points = [{"positions": q, "time_from_start": at} for q, at in timed]
        documents.append({"joint_names": list(names), "points": points})
    what = "a trajectory_msgs/JointTrajectory of arm and hand for each grasp"
    return _document(hand, what, documents)


def _check_hand(hand: Hand, motion: ArmMotion) -> None:
    """Raise `BadArgument` if a motion's last joints are not those of the hand, within its limits.

    Only the opened and the closed fingers are compared with the limits. Targets with which the
    fingers press may lie beyond.
    """
    ours = tuple(hand.tree.joint_names)
    last = motion.joint_names[-len(ours) :]
    if last != ours:
        found = f"last joints {', '.join(last)}"
        raise BadArgument("motion", found, f"those of the hand: {', '.join(ours)}")
    driven = [motion.joint_names.index(joint) for joint in hand.joint_names]
    limits = hand.to("cpu", torch.float64).actuated
    for phase in UNPRESSED:
        if phase in motion.phases:
            joints = motion.positions[:, motion.phases[phase], driven]
            limits.check_limits(joints.cpu().double(), "motion.positions")


def _trajectories(
    hand: Hand,
    grasps: Grasps,
    force: float,
    kp: float | None,
    rename: Mapping[str, str] | None,
    actuated: bool,
    times: Sequence[float],
    pressing: bool,
) -> Iterator[dict[str, Any]]:
    """Yield for each grasp a trajectory_msgs/JointTrajectory, as a dictionary, with all joints of
    the hand. With `actuated`, joints that follow others are left out.

    `times` (3,) [s] are those of the pre-grasp, the grasp and the squeeze. If `pressing`, the last
    has the torques as effort.
    """
    squeezed, postures = named_postures(hand, grasps, force, kp)
    names = rename_joints(hand, rename, actuated)
    root = read_urdf(hand.urdf_path).root
    for row in range(len(grasps)):
        torque = dict(zip(hand.joint_names, squeezed.torques[row].tolist(), strict=True))
        pressed = [torque.get(joint, 0.0) for joint in names] if pressing else []
        points = [
            {
                "positions": [float(posture[joint][row]) for joint in names],
                "effort": effort,
                "time_from_start": _duration(time),
            }
            for posture, effort, time in zip(
                postures.values(), ([], [], pressed), times, strict=True
            )
        ]
        yield {"header": {"frame_id": root}, "joint_names": list(names.values()), "points": points}


def _duration(seconds: float) -> dict[str, int]:
    """Return a time in `seconds` as a builtin_interfaces/Duration, a dictionary."""
    # rounded first: the nanoseconds are fewer than those of a second
    whole = round(NANOSECONDS * seconds)
    return {"sec": whole // int(NANOSECONDS), "nanosec": whole % int(NANOSECONDS)}


def _pose(obj_from_hand: Float[Tensor, "4 4"]) -> dict[str, Any]:
    """Return a pose [m] as a geometry_msgs/Pose, a dictionary."""
    w, x, y, z = quaternion(obj_from_hand)
    position = dict(zip("xyz", obj_from_hand[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _translation(direction: Float[Tensor, "3"]) -> dict[str, Any]:
    """Return a moveit_msgs/GripperTranslation as a dictionary: as long as the approach, of which
    half must be free.
    """
    vector = dict(zip("xyz", direction.tolist(), strict=True))
    stamped = {"header": {"frame_id": OBJECT_FRAME}, "vector": vector}
    return {
        "direction": stamped,
        "desired_distance": APPROACH_DISTANCE,
        "min_distance": APPROACH_DISTANCE / 2,
    }


def _document(hand: Hand, what: str, documents: Iterable[Any]) -> str:
    """Return one YAML text of all documents, below comment lines that say `what` they are and
    explain the numbers.
    """
    root = read_urdf(hand.urdf_path).root
    file = hand.urdf_path.name
    heading = (
        f"# {what}, for the {hand.name} hand, by torchgrasp\n"
        "# metres, radians, newtons, N m; quaternions by name; "
        f"frame {OBJECT_FRAME!r}: that of the planned cloud\n"
        f"# the hand's frame is link {root!r} of {file}; joints in the order of joint_names\n"
    )
    return heading + yaml.dump_all(
        documents, None, _Dumper, default_flow_style=None, width=math.inf, sort_keys=False
    )
