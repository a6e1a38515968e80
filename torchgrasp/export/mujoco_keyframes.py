"""Grasps as keyframes of a MuJoCo model: the hand floats on a free joint, every joint has a position actuator."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np

from torchgrasp.control.squeeze import squeeze
from torchgrasp.export.grasp_json import quaternion
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.ik.approach import DISTANCE
from torchgrasp.sim.mjcf import add_drive, add_links
from torchgrasp.values import Grasps

FREE = "hand"
"""Name of the free joint; its seven numbers are position [m] and quaternion (w, x, y, z)."""


def format_keyframes(grasps: Grasps, hand: Hand, force: float = 4.0) -> str:
    """Return MJCF of the hand with four keyframes for each grasp: grasp_0_approach, _pregrasp, _grasp, _squeeze.

    The world is the object's frame, in which the object may be added. `qpos` is the free joint and then the joints in
    the order of the model, `ctrl` the actuators' targets in theirs; both orders are written as text elements "qpos"
    and "ctrl". The approach begins with the joints of the pre-grasp; in the squeeze the hand is in its grasp, and only
    the targets have gone on.

    Args:
        grasps: g rows.
        hand: the hand that they were planned for.
        force: normal force of the strongest finger [N] in the squeeze.

    Raises:
        BadArgument: joints of another hand, or a force that is not positive.
    """
    pressed, urdf = squeeze(grasps, hand, force), read_urdf(hand.urdf_path)
    root = ET.Element("mujoco", model=hand.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    tags = "custom", "worldbody", "actuator", "keyframe"
    custom, world, actuator, keys = (ET.SubElement(root, tag) for tag in tags)
    palm = add_links(world, urdf, np.eye(4))
    palm.insert(0, ET.Element("freejoint", name=FREE))
    order = [joint.attrib["name"] for joint in palm.iter("joint")]  # bodies as they nest, as MuJoCo numbers them
    for name in order:
        add_drive(actuator, name, hand.actuators[name])
    ET.SubElement(custom, "text", name="qpos", data=" ".join([*(f"{FREE}/{axis}" for axis in POSE), *order]))
    ET.SubElement(custom, "text", name="ctrl", data=" ".join(order))
    opened, closed = hand.expand(grasps.pregrasp.double()), hand.expand(grasps.joints.double())
    postures = (
        ("approach", DISTANCE, opened, opened),
        ("pregrasp", 0.0, opened, opened),
        ("grasp", 0.0, closed, closed),
        ("squeeze", 0.0, closed, hand.expand(pressed.joints)),
    )
    for row in range(len(grasps)):
        pose = grasps.obj_from_hand[row]
        for name, before, joints, targets in postures:
            place = pose[:3, 3] - before * grasps.approach[row]
            state = _text([*place.tolist(), *quaternion(pose), *(float(joints[joint][row]) for joint in order)])
            control = _text(float(targets[joint][row]) for joint in order)
            ET.SubElement(keys, "key", name=f"grasp_{row}_{name}", qpos=state, ctrl=control)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""The numbers of the free joint."""


def _text(numbers: Iterable[float]) -> str:
    """Return numbers without loss."""
    return " ".join(map(repr, numbers))
