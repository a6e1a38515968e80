"""Grasps as an `isaac_grasp` file of version 1.0, which Isaac Sim and Isaac ROS read.

Facts: https://docs.isaacsim.omniverse.nvidia.com/latest/robot_simulation/grasp_editor.html and
https://nvidia-isaac-ros.github.io/concepts/manipulation/isaac_grasp.html.
"""

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.finger_forces import check_all_executable
from torchgrasp.export.postures import (
    check_flange,
    check_still,
    named_postures,
    quaternion,
    rename_joints,
)
from torchgrasp.export.ros_messages import OBJECT_FRAME
from torchgrasp.files import Field
from torchgrasp.files.write import Malformed, Refuse, explain, read_bounded
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, GraspFileWarning
from torchgrasp.foundation.limits import JSON_BYTES
from torchgrasp.foundation.rules import Force, Pose, Positive
from torchgrasp.foundation.told import warn_user
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.values.planning import Grasps

FORMAT = "isaac_grasp"
VERSION = 1.0
FRAMES = "object_frame_link", "gripper_frame_link"
ROS_FRAMES = "object_frame", "gripper_frame"  # names of Isaac ROS, and of what the editor writes
GRASP = "cspace_position"
PREGRASP = "pregrasp_cspace_position"
SQUEEZE = "squeeze_cspace_position"  # a key of ours, which other readers skip
FLANGE = "flange"
POSE_KEYS = "confidence", "position", "orientation"
ALLOWED = f"an {FORMAT} file of version {VERSION}"
ROUNDING = 1e-6  # largest difference [m] of a flange from a link of its name
DEEPEST = 8  # most levels of a file; the format has five
OWN = "# grasps of the {} hand, by torchgrasp"  # the first line of our files
OWN_HAND = re.compile(OWN.format("(.+)"))
RENAMED = "# joints of the URDF, and their names here: "  # a line of our files with other names
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")  # YAML 1.1 takes 1e-05 for a text


@checked
def format_isaac(
    hand: Hand,
    grasps: Grasps,
    force: Force = 4.0,
    kp: Positive | None = None,
    rename: Mapping[str, str] | None = None,
    flange: Pose | None = None,
    object_id: str = OBJECT_FRAME,
    actuated: bool = False,
    gripper_link: str | None = None,
    isaac_ros: bool = False,
) -> str:
    """Return grasps as the YAML text of an `isaac_grasp` file of version 1.0, in metres and
    radians.

    * `position` and `orientation` (w, x, y, z) are the pose of the gripper's frame in the object's
      frame. The object's frame is that of the planned cloud.
    * `cspace_position` has the joints at the contacts, by name.
    * `pregrasp_cspace_position` has the joints of the opened hand.
    * `squeeze_cspace_position`, a key of torchgrasp, has joint targets with which the fingers
      press.
    * `confidence` is the predicted success, 0 where it is unknown.

    Args:
        hand: the hand.
        grasps: grasps planned for this hand, best first.
        force: normal force [N] of the strongest finger when the fingers press.
        kp: stiffness [N m/rad] of the robot's position control; None means the hand's own.
        rename: dict from a joint's name in the URDF to the robot's name; None keeps all names.
        flange: pose (4, 4) [m] of the robot's flange in the frame of the hand's root link. With it,
            the gripper's frame is the flange. None means the frame of `gripper_link`.
        object_id: name of the object's frame, such as its path in the stage.
        actuated: whether to leave out coupled joints, which follow others.
        gripper_link: name of the gripper's frame, or its path in the stage. Without a `flange`, its
            last part names the link of the URDF whose poses are written. An unknown name means the
            root link. With a `flange`, it only names the flange. None means the root link, or
            "flange".
        isaac_ros: whether to write the frames under the keys of Isaac ROS, `object_frame` and
            `gripper_frame`.

    Raises:
        BadArgument: joints are of another hand, or grasps failed a check.
        BadArgument: the `force` is outside 0.01 to 100 N, or `kp` is not positive.
        BadArgument: names are unknown, empty or equal.
        BadArgument: the flange has the name of a link of the hand that is elsewhere.
        BadArgument: a hand must go down while it closes, because its opened fingers would be in the
            table. A file with one pose for each grasp cannot express this.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_isaac(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> yaml.safe_load(text)["gripper_frame_link"]
    'palm'
    """
    hand = hand.to("cpu")
    grasps = grasps.to("cpu")
    check_all_executable(grasps)
    check_still(hand, grasps)
    _, postures = named_postures(hand, grasps, force, kp)
    names = rename_joints(hand, rename, actuated)
    root = read_urdf(hand.urdf_path).root
    poses = grasps.obj_from_hand.double()
    if flange is not None:
        frame = gripper_link or FLANGE
        flange = check_flange(flange)
        _check_flange(hand, grasps, frame, flange)
        poses = poses @ flange
    else:
        frame = gripper_link or root
        poses = poses @ _root_from_link(hand, grasps, frame.rpartition("/")[2])
    # an unknown success is NaN, which readers would sort anywhere
    confidence = grasps.success.double().nan_to_num(0.0).clamp(0.0, 1.0)
    keys = {"grasp": GRASP, "pregrasp": PREGRASP, "squeeze": SQUEEZE}
    rows = dict[str, Any]()
    for row, pose in enumerate(poses):
        turn = quaternion(pose)
        rows[f"grasp_{row}"] = {
            "confidence": float(confidence[row]),
            "position": pose[:3, 3].tolist(),
            "orientation": {"w": turn[0], "xyz": turn[1:]},
            **{
                key: {names[x]: float(postures[what][x][row]) for x in names}
                for what, key in keys.items()
            },
        }
    frames = dict(zip(ROS_FRAMES if isaac_ros else FRAMES, (object_id, frame), strict=True))
    content = {"format": FORMAT, "format_version": VERSION, **frames, "grasps": rows}
    heading = (
        f"{OWN.format(hand.name)}: metres, radians; best first\n"
        f"# object's frame: that of the planned cloud; the hand's root link is {root!r} of "
        f"{hand.urdf_path.name}\n"
        f"# confidence is the predicted success, 0 where it is unknown; {SQUEEZE} has the\n"
        f"# targets that press, a key of torchgrasp\n"
    )
    if rename:
        heading += f"{RENAMED}{json.dumps(dict(rename))}\n"
    return heading + yaml.safe_dump(
        content, default_flow_style=None, width=math.inf, sort_keys=False, allow_unicode=True
    )


def _check_flange(hand: Hand, grasps: Grasps, frame: str, flange: Float[Tensor, "4 4"]) -> None:
    """Raise `BadArgument` if the flange has the name of a link of the hand that is elsewhere."""
    link = frame.rpartition("/")[2]
    if link not in hand.tree.link_names:
        return
    if not torch.allclose(_root_from_link(hand, grasps, link), flange, rtol=0.0, atol=ROUNDING):
        found = f"{frame!r}, a link of the hand that is not where the flange is"
        raise BadArgument("gripper_link", found, "another name for the flange, or no flange")


def _root_from_link(hand: Hand, grasps: Grasps, link: str) -> Float[Tensor, "*g 4 4"]:
    """Return the pose [m] of a link in the root link's frame at each grasp. It is the identity for
    a name that is none of the hand's links.
    """
    if link not in hand.tree.link_names:
        return torch.eye(4, dtype=torch.float64)
    return hand.link_poses(grasps.joints.double())[:, hand.tree.link_names.index(link)]


class IsaacFile(NamedTuple):
    """The content of an `isaac_grasp` file with g grasps, in its order.

    `gripper` is the name of the gripper's frame, or "" if the file names none. `poses` (g, 7) are
    the frame's position [m] and quaternion (w, x, y, z) in the object's frame. `postures` has
    "grasp" and, if the file has it, "pregrasp": joint values (g,) [rad or m] by joint name.
    """

    gripper: str
    poses: np.ndarray
    postures: dict[str, dict[str, np.ndarray]]


def parse_isaac(path: Path, hand: Hand, most: int, far: float, refuse: Refuse) -> IsaacFile:
    """Return the content of an `isaac_grasp` file: poses and joint values of the `hand`. The file
    has at most `most` grasps, and no number in it exceeds `far` in size.

    A `GraspFileWarning` names keys that are not read. Another one is shown if neither the first
    line nor the gripper's path names a hand. A left hand may have the joints of a right one.

    Raises an error for a malformed file, another version, or a file that torchgrasp wrote for
    another hand. It is also raised for a joint that the hand does not have, or a missing actuated
    joint. `refuse` makes the error from two texts: what was found, and what is allowed.
    """
    data = read_bounded(path, JSON_BYTES, ALLOWED, refuse)
    content = _read_yaml(path, data, refuse).entries("format", "format_version", "grasps")
    named = OWN_HAND.match(data.decode("utf-8"))
    if named is not None and named[1] != hand.name:
        allowed = f"grasps of the {hand.name} hand, which is to read them"
        raise refuse(f"{path}: grasps of the {named[1]} hand", allowed)
    for key, wanted in (("format", FORMAT), ("format_version", VERSION)):
        if content[key].value != wanted:
            raise content[key].wrong(str(wanted))
    for key in (FRAMES[0], ROS_FRAMES[0]):
        if key in content:
            content[key].text()
    frames = [content[key].text() for key in (FRAMES[1], ROS_FRAMES[1]) if key in content]
    rows = content["grasps"].entries()
    if len(rows) > most:
        raise refuse(f"{path}: {len(rows)} grasps", f"at most {most}")
    skipped = {*content} - {"format", "format_version", "grasps", *FRAMES, *ROS_FRAMES}
    poses = list[list[float]]()
    opened = {PREGRASP in x.value for x in rows.values() if isinstance(x.value, dict)}
    if len(opened) > 1:
        raise refuse(f"{path}: {PREGRASP} in some grasps only", "each grasp, or none")
    keys = {"grasp": GRASP, "pregrasp": PREGRASP} if True in opened else {"grasp": GRASP}
    taken: dict[str, list[dict[str, Field]]] = {what: [] for what in keys}
    names = _read_names(path, data, hand, refuse)
    for row in rows.values():
        fields = row.entries("position", "orientation", *keys.values())
        if "confidence" in fields:
            fields["confidence"].number(0.0, 1.0)
        turn = fields["orientation"].entries("w", "xyz")
        position = fields["position"].numbers(3, -far, far)
        xyz = turn["xyz"].numbers(3, -far, far)
        poses.append([*position, turn["w"].number(-far, far), *xyz])
        for what, key in keys.items():
            taken[what].append(_check_joints(hand, fields[key], names))
        skipped |= {*fields} - {*POSE_KEYS, *keys.values(), SQUEEZE}
    if skipped:
        warn_user(GraspFileWarning, f"{path.name}: not read: {', '.join(sorted(skipped))}")
    # Isaac's frame of the gripper may be a path in the stage, with the hand's name
    if named is None and hand.name not in "".join(frames[:1]).split("/"):
        warn_user(
            GraspFileWarning,
            f"{path.name}: it names no hand, so that its joints alone tell that it is of the "
            f"{hand.name} hand. One of the other side may have the same",
        )
    postures = {what: _fill(hand, fields, far) for what, fields in taken.items()}
    numbers = np.array(poses, dtype=float).reshape(-1, 7)
    return IsaacFile("".join(frames[:1]), numbers, postures)


def _read_names(path: Path, data: bytes, hand: Hand, refuse: Refuse) -> dict[str, str]:
    """Return the name in the file of each joint of the hand. Our own files say which joints they
    rename.
    """
    names = {joint: joint for joint in hand.tree.joint_names}
    lines = data.decode("utf-8").splitlines()
    for line in itertools.takewhile(lambda line: line.startswith("#"), lines):
        if not line.startswith(RENAMED):
            continue
        try:
            names |= json.loads(line.removeprefix(RENAMED))
        except (ValueError, TypeError, RecursionError) as error:
            raise refuse(f"{path}: {line}", "an object of names in this line") from error
    texts = all(isinstance(name, str) for name in names.values())
    if not texts or len(names) > len(hand.tree.joint_names):
        raise refuse(f"{path}: names of other joints", "names of the hand's joints")
    if len(set(names.values())) < len(names):
        raise refuse(f"{path}: one name for two joints", "a name for each joint")
    return names


def _check_joints(hand: Hand, field: Field, names: dict[str, str]) -> dict[str, Field]:
    """Return the joints of a posture in a file, by their names in the hand; refuse unknown and
    missing ones. `names` holds the name in the file of each joint.
    """
    ours = {name: joint for joint, name in names.items()}
    if unknown := [x for x in field.entries() if x not in ours]:
        allowed = f"joints of the {hand.name} hand: {', '.join(ours)}"
        raise field.refuse(f"{field.path}: {field.place} with {unknown[0]!r}", allowed)
    found = field.entries(*(names[joint] for joint in hand.joint_names))
    return {ours[name]: x for name, x in found.items()}


def _fill(hand: Hand, rows: list[dict[str, Field]], far: float) -> dict[str, np.ndarray]:
    """Return the values (g,) of all joints by name; one that a grasp leaves out is our hand's."""
    joints = torch.zeros(len(rows), len(hand.joint_names), dtype=torch.float64)
    for column, name in enumerate(hand.joint_names):
        joints[:, column] = torch.tensor([row[name].number(-far, far) for row in rows])
    every = hand.expand_joints(joints)
    values = dict(zip(hand.tree.joint_names, every.numpy().T.copy(), strict=True))
    for place, row in enumerate(rows):
        for name, field in row.items():
            values[name][place] = field.number(-far, far)
    return values


def _read_yaml(path: Path, data: bytes, refuse: Refuse) -> Field:
    """Return the content `data` of a YAML file as a field: objects, lists, texts, and numbers.

    Text that is a number is one, in quotes, too, as Isaac Sim reads it. Keys are texts. Raises the
    error of `refuse` for malformed YAML, and for aliases, equal keys or a deep nesting.
    """
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        # events alone: the loaders themselves recurse, and expand aliases
        events = yaml.parse(data.decode("utf-8"), Loader=loader)
        value = _build(events, next(_content(events), None), 0)
        if isinstance(next(_content(events), None), yaml.Event):
            raise Malformed("a second document")
    except (yaml.YAMLError, ValueError) as error:
        raise refuse(f"{path}: {explain(error)}", ALLOWED) from error
    return Field(path, "", value, refuse)


def _content(events: Iterator[yaml.Event]) -> Iterator[yaml.Event]:
    """Yield the events that have content: no begin or end of a stream or document."""
    frame = yaml.StreamStartEvent, yaml.StreamEndEvent, yaml.DocumentStartEvent
    return (x for x in events if not isinstance(x, (*frame, yaml.DocumentEndEvent)))


def _build(events: Iterator[yaml.Event], event: yaml.Event | None, depth: int) -> Any:
    """Return the value that begins with `event`; raise `Malformed` for what is not allowed."""
    if depth > DEEPEST:
        raise Malformed(f"more than {DEEPEST} levels")
    if isinstance(event, yaml.ScalarEvent):
        return float(event.value) if NUMBER.fullmatch(event.value) else event.value
    if isinstance(event, yaml.SequenceStartEvent):
        items = list[Any]()
        while not isinstance(item := next(events), yaml.SequenceEndEvent):
            items.append(_build(events, item, depth + 1))
        return items
    if not isinstance(event, yaml.MappingStartEvent):
        raise Malformed("an alias" if isinstance(event, yaml.AliasEvent) else "an empty file")
    entries = dict[str, Any]()
    while not isinstance(key := next(events), yaml.MappingEndEvent):
        if not isinstance(key, yaml.ScalarEvent):
            raise Malformed("a key that is no text")
        if key.value in entries:
            raise Malformed(f"{key.value} twice")
        entries[key.value] = _build(events, next(events), depth + 1)
    return entries
