"""Export of grasps as postures of named joints: plain JSON, and keyframes of a MuJoCo model."""

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.finger_forces import Squeeze, check_all_executable, squeeze
from torchgrasp.control.protocol import POSE_TIME
from torchgrasp.files import format_json
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, NoEffect, Status
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.rules import Force, Pose, Positive
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.frames import rotate
from torchgrasp.geometry.linalg import check_unit_vectors, norm
from torchgrasp.hand.drives import drive_stiffness, stiff_drives, strongest_leads
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.ik.motion import APPROACH_DISTANCE, opened_pose
from torchgrasp.sim.mujoco_scene import nest_links, render_mjcf
from torchgrasp.values.planning import Grasps

CONVENTIONS: dict[str, Any] = json.loads(
    (Path(__file__).parent / "templates" / "conventions.json").read_text("utf-8")
)
"""Meaning of the numbers in a JSON file of grasps; the file contains this text."""
OWN_FORMAT = "torchgrasp grasps"
OWN_VERSION = 3  # version 1 had no approach, version 2 no rise
FARTHEST = 1.0  # distance [m] of a flange from a hand: farther is in millimetres
TASK = "task_margin", "task_load", "task_twist", "task_forces", "task_strength"
"""Fields of the `Certificate`, which explains them. The file has them if grasps were planned with
`resist`.
"""


@checked
def format_grasps(
    hand: Hand,
    grasps: Grasps,
    force: Force = 4.0,
    kp: Positive | None = None,
    rename: Mapping[str, str] | None = None,
    flange: Pose | None = None,
) -> str:
    """Return grasps as JSON text, with three postures by joint name and an explanation of all
    numbers.

    A robot plays a grasp in three steps. In the posture "pregrasp" the hand moves along "approach"
    to its "pose", displaced by the vector "rise" [m]. Then it moves to "pose" and closes to
    "grasp". At last it moves towards "squeeze", targets with which the fingers press. "rise" is 0
    unless the opened fingers would be in the table. The times are in "time"; joints move at
    constant speeds. Poses are in the object's frame, which is the frame of the planned cloud.

    Args:
        hand: the hand.
        grasps: grasps planned for this hand, best first.
        force: normal force [N] of the strongest finger at the squeeze.
        kp: stiffness [N m/rad] of the robot's position control; None means the hand's own.
        rename: dict from a joint's name in the URDF to the robot's name; None keeps all names.
        flange: pose (4, 4) [m] of the robot's flange in the frame of the hand's root link. With it,
            the flange's pose is added as "flange". None adds nothing.

    Raises `BadArgument` for joints of another hand, and for names that are unknown, empty or equal.
    It is also raised for a `force` outside 0.01 to 100 N, or a `kp` that is not positive. It is
    raised for a flange beyond 1 m, and for executable grasps whose joints exceed their limits.
    `NoEffect` warns, as in all exports, of a `force` that the drives of the hand cannot exert.

    >>> import json
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_grasps(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> sorted(json.loads(text)["grasps"][0]["joints"])
    ['grasp', 'pregrasp', 'squeeze']
    """
    grasps = grasps.to("cpu")
    path = hand.urdf_path
    squeezed, postures = named_postures(hand, grasps, force, kp)
    opened = opened_pose(hand.to("cpu"), grasps.pregrasp, grasps.obj_from_hand, grasps.table)
    names = rename_joints(hand, rename)
    actuated = [names[joint] for joint in hand.joint_names]
    forces = rotate(grasps.obj_from_hand.double(), squeezed.forces)
    std = grasps.contacts.std_m

    def describe_contact(row: int, i: int) -> dict[str, Any]:
        return {
            "finger": hand.tips.names[i],
            "link": hand.tips.links[i],
            "point": grasps.contacts.points[row, i].tolist(),
            "normal": grasps.contacts.normals[row, i].tolist(),
            "force": forces[row, i].tolist(),
            "std_m": None if std is None else float(std[row, i]),
            "tip_error": float(grasps.tip_error[row, i]),
        }

    def describe_grasp(row: int) -> dict[str, Any]:
        pose = grasps.obj_from_hand[row]
        entry: dict[str, Any] = {
            "rank": row,
            "status": Status(int(grasps.status[row])).name,
            "success": float(grasps.success[row]),
            "pose": describe_pose(pose),
        }
        if flange is not None:
            entry["flange"] = describe_pose(pose.double() @ check_flange(flange))
        direction = grasps.approach[row].tolist()
        entry["approach"] = {"direction": direction, "distance": APPROACH_DISTANCE}
        entry["rise"] = (opened[row] - pose)[:3, 3].tolist()
        entry["joints"] = {
            posture: {names[joint]: float(q[joint][row]) for joint in names}
            for posture, q in postures.items()
        }
        entry["torque"] = dict(zip(actuated, squeezed.torques[row].tolist(), strict=True))
        entry["contacts"] = [describe_contact(row, i) for i in range(len(hand.tips.names))]
        entry["clearance"] = float(grasps.clearance[row])
        entry["closure_margin"] = float(grasps.certificate.margin[row])
        # what a task adds to the certificate
        for name, x in vars(grasps.certificate).items():
            if x is not None and name in TASK:
                entry[name] = x[row].tolist()
        return entry

    content = {
        "format": OWN_FORMAT,
        "version": OWN_VERSION,
        **CONVENTIONS,
        "hand": {
            "name": hand.name,
            "urdf": path.name,
            "root": read_urdf(path).root,
            "sha256": hand.source.sha256,
        },
        "actuated": actuated,
        "rename": dict(rename or {}),
        "stiffness": {names[joint]: x.kp for joint, x in stiff_drives(hand, kp).items()},
        "strongest_normal_force": force,
        "time": {"pregrasp": 0.0, "grasp": POSE_TIME, "squeeze": 2 * POSE_TIME},
        "provenance": grasps.meta,
        "grasps": [describe_grasp(row) for row in range(len(grasps))],
    }
    return format_json(content)


def named_postures(
    hand: Hand, grasps: Grasps, force: float, kp: float | None
) -> tuple[Squeeze, dict[str, dict[str, Float[Tensor, "g"]]]]:
    """Return (squeeze, postures) for g grasps, on the CPU: the pressing of the fingers, and the
    joint positions of three postures.

    The `Squeeze` holds joint targets with which the fingers press, their forces and torques. The
    dict `postures` has the keys "pregrasp", "grasp" and "squeeze". Each posture has the positions
    (g,) [rad or m] of all movable joints of the URDF, by the joint's name.

    `force` [N] is the normal force of the strongest finger at the squeeze. `kp` [N m/rad] is the
    stiffness of every drive; None means the hand's own. Raises `BadArgument` for joints of
    executable grasps beyond their limits, or an approach that is no unit vector. `NoEffect` warns
    of a force that the drives cannot exert in an executable grasp.
    """
    hand = hand.to("cpu")
    grasps = grasps.to("cpu")
    squeezed = squeeze(hand, grasps, force, kp)
    _check_executable(hand, grasps.executable)
    _tell_weak(hand, grasps, squeezed, force, kp)
    postures = {
        "pregrasp": grasps.pregrasp.double(),
        "grasp": grasps.joints.double(),
        "squeeze": squeezed.joints,
    }
    return squeezed, {name: hand.expand(joints) for name, joints in postures.items()}


def _check_executable(hand: Hand, grasps: Grasps) -> None:
    """Raise `BadArgument` for joints of executable grasps beyond their limits, or an approach that
    is no unit vector.
    """
    limits = hand.to(torch.float64).actuated
    limits.check_limits(grasps.joints.double(), "grasps.joints")
    limits.check_limits(grasps.pregrasp.double(), "grasps.pregrasp")
    check_unit_vectors("grasps.approach", grasps.approach.double())


def _tell_weak(
    hand: Hand, grasps: Grasps, squeezed: Squeeze, force: float, kp: float | None
) -> None:
    """Warn of a normal `force` [N] for which a drive would exceed its largest torque in an
    executable grasp.
    """
    leads = strongest_leads(hand, drive_stiffness(hand, kp))
    shares = (squeezed.joints - grasps.joints.double()).abs() / leads
    shares = shares[grasps.status == Status.OK]
    if not len(shares) or not (shares > 1).any():
        return
    worst = shares.amax(0)
    name = hand.joint_names[int(worst.argmax())]
    most = float(worst.max())
    asked = f"{force:g} N need {most:.1f} times the effort of {name}"
    warn_user(NoEffect, f"force: {asked}: at most {force / most:.2g} N are exerted")


def check_flange(flange: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return `flange`, the pose (4, 4) [m] of a robot's flange, in float64 on the CPU.

    It is in the frame of the hand's root link. Raises `BadArgument` if it is more than 1 m from the
    root link, as it is then not in metres.
    """
    away = float(norm(flange[:3, 3]))
    if away > FARTHEST:
        found = f"one {away:g} m from the hand's root link"
        raise BadArgument("flange", found, f"a position within {FARTHEST:g} m, in metres")
    return flange.double().cpu()


def stands_still(hand: Hand, grasps: Grasps) -> Bool[Tensor, "g"]:
    """Return a mask (g,) of the grasps in which the hand keeps its pose while it closes. In the
    other grasps the hand goes down while it closes. The reason is that at the grasp's pose its
    opened fingers would be in the table.
    """
    opened = opened_pose(hand, grasps.pregrasp, grasps.obj_from_hand, grasps.table)
    return (opened == grasps.obj_from_hand).all(2).all(1)


def check_still(hand: Hand, grasps: Grasps) -> None:
    """Raise `BadArgument` if the hand must go down while it closes in one of the grasps.

    It must do so if its opened fingers would be in the table at the pose of the grasp. A format
    with one pose for each grasp cannot express this motion.
    """
    if not stands_still(hand, grasps).all():
        found = "a hand that goes down while it closes"
        raise BadArgument("grasps", found, "hands that close at one pose")


def rename_joints(
    hand: Hand, rename: Mapping[str, str] | None, actuated: bool = False
) -> dict[str, str]:
    """Return a dict from the name of each movable joint in the hand's URDF to its name on the
    robot.

    `rename` is such a dict of some joints. These joints come first, in its order; the others keep
    their names. None keeps all names. With `actuated`, joints that follow others are left out.
    Raises `BadArgument` for joints that the hand lacks, and for equal or empty names.
    """
    given = dict(rename or {})
    ours = hand.tree.joint_names
    if unknown := [joint for joint in given if joint not in ours]:
        raise BadArgument("rename", repr(unknown[0]), f"a joint of the hand: {', '.join(ours)}")
    names = given | {joint: joint for joint in ours if joint not in given}
    if "" in names.values() or len(set(names.values())) < len(names):
        raise BadArgument("rename", ", ".join(names.values()), "a name for each joint")
    left_out = follower_joints(hand) if actuated else ()
    return {joint: name for joint, name in names.items() if joint not in left_out}


def follower_joints(hand: Hand) -> tuple[str, ...]:
    """Return the names in the URDF of the coupled joints, which follow others and have no drive.

    The coupling is that of the hand's `hand.toml`.
    """
    return tuple(read_hand_toml(hand.urdf_path.with_name("hand.toml")).coupling)


def describe_pose(a_from_b: Float[Tensor, "4 4"]) -> dict[str, list[float]]:
    """Return a pose as a dict with "position" [m] and the unit quaternion "quaternion_wxyz".
    `a_from_b` [m] is the pose of frame b in frame a.
    """
    return {"position": a_from_b[:3, 3].tolist(), "quaternion_wxyz": quaternion(a_from_b)}


def quaternion(a_from_b: Tensor | np.ndarray) -> list[float]:
    """Return a rotation (3, 3), or that of a pose (4, 4), as a unit quaternion (w, x, y, z)."""
    matrix = torch.as_tensor(a_from_b)[:3, :3].double().cpu().numpy()
    return spatial.transform.Rotation.from_matrix(matrix).as_quat(scalar_first=True).tolist()


@checked
def format_keyframes(
    hand: Hand, grasps: Grasps, force: Force = 4.0, kp: Positive | None = None
) -> str:
    """Return the hand as MJCF, MuJoCo's model format, with four keyframes for each grasp.

    The keyframes of the first grasp are `grasp_0_approach`, `grasp_0_pregrasp`, `grasp_0_grasp` and
    `grasp_0_squeeze`. At the approach the opened hand is 0.1 m before its pre-grasp. The squeeze
    has the joints of the grasp, and targets with which the fingers press.

    The world is the object's frame. `qpos` is the pose of the hand's free joint, then the joints of
    the model [rad or m]. `ctrl` holds the targets [rad or m] of the actuators. The text elements
    "qpos" and "ctrl" of the model name their order.

    Args:
        hand: the hand.
        grasps: grasps planned for this hand, best first.
        force: normal force [N] of the strongest finger at the squeeze.
        kp: stiffness [N m/rad] of every drive; None means the hand's own.

    Raises `BadArgument` for joints of another hand, and for grasps that failed a check. It is also
    raised for a `force` outside 0.01 to 100 N, or a `kp` that is not positive.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_keyframes(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> text.count("<key ")
    4
    """
    check_all_executable(grasps)
    grasps = grasps.to("cpu")
    urdf = read_urdf(hand.urdf_path)
    _, postures = named_postures(hand, grasps, force, kp)
    nested = nest_links(urdf)
    # as MuJoCo numbers them
    order = [joint.name for _, joint, _ in nested if joint and joint.kind != "fixed"]
    steps = (  # name, distance from the pose, joints, targets
        ("approach", APPROACH_DISTANCE, "pregrasp", "pregrasp"),
        ("pregrasp", 0.0, "pregrasp", "pregrasp"),
        ("grasp", 0.0, "grasp", "grasp"),
        ("squeeze", 0.0, "grasp", "squeeze"),
    )
    opened = opened_pose(hand.to("cpu"), grasps.pregrasp, grasps.obj_from_hand, grasps.table)
    keys = []
    for row, closed in enumerate(grasps.obj_from_hand):
        for name, distance, state, targets in steps:
            pose = opened[row] if state == "pregrasp" else closed
            position = pose[:3, 3] - distance * grasps.approach[row]
            joints = [float(postures[state][joint][row]) for joint in order]
            control = [float(postures[targets][joint][row]) for joint in order]
            qpos = [*position.tolist(), *quaternion(pose), *joints]
            keys.append((f"grasp_{row}_{name}", qpos, control))
    known = {
        "name": hand.name,
        "nested": nested,
        "pose": np.eye(4),
        "order": order,
        "drives": stiff_drives(hand, kp),
        "keys": keys,
    }
    root = ET.fromstring(render_mjcf("robot.xml", **known, free=True))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"
