"""Grasps as keyframes of a MuJoCo model. The hand has a free joint and position actuators."""

import xml.etree.ElementTree as ET
from typing import Annotated

import numpy as np

from torchgrasp.checks import Positive, Range, checked
from torchgrasp.control.forces import squeeze
from torchgrasp.export.grasp_json import quaternion
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.ik.motion import APPROACH_DISTANCE
from torchgrasp.sim.mjcf import add_drive, add_links, format_numbers
from torchgrasp.values import Grasps


@checked
def format_keyframes(
    hand: Hand, grasps: Grasps, force: Annotated[float, Range(0.01, 100.0)] = 4.0, kp: Positive | None = None
) -> str:
    """Return MJCF of the hand with four keyframes for each grasp: grasp_0_approach, _pregrasp, _grasp, _squeeze.

    The world is the object's frame. `qpos` is the free joint, then the joints of the model; `ctrl` is the targets of
    the actuators. The text elements "qpos" and "ctrl" name their order. The approach has the joints of the pre-grasp.
    The squeeze has the joints of the grasp and targets that press. `force` [N] is the normal force of the strongest
    finger. `kp` is the stiffness of every drive [N m/rad]; None: the hand's own.

    Raises:
        BadArgument: joints of another hand, or a force or stiffness that is not positive.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_keyframes(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> text.count("<key ")
    4
    """
    hand, grasps = hand.to("cpu"), grasps.to("cpu")
    squeezed, urdf = squeeze(hand, grasps, force, kp), read_urdf(hand.urdf_path)
    root = ET.Element("mujoco", model=hand.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    tags = "custom", "worldbody", "actuator", "keyframe"
    custom, world, actuator, keyframes = (ET.SubElement(root, tag) for tag in tags)
    palm = add_links(world, urdf, np.eye(4))
    palm.insert(0, ET.Element("freejoint", name="hand"))
    order = [joint.attrib["name"] for joint in palm.iter("joint")]  # bodies as they nest, as MuJoCo numbers them
    for name in order:
        drive = hand.actuators[name]
        add_drive(actuator, name, drive if kp is None else drive._replace(kp=kp))
    free = "hand/x hand/y hand/z hand/qw hand/qx hand/qy hand/qz".split()
    ET.SubElement(custom, "text", name="qpos", data=" ".join([*free, *order]))
    ET.SubElement(custom, "text", name="ctrl", data=" ".join(order))
    opened, closed = hand.expand(grasps.pregrasp.double()), hand.expand(grasps.joints.double())
    keys = (
        ("approach", APPROACH_DISTANCE, opened, opened),
        ("pregrasp", 0.0, opened, opened),
        ("grasp", 0.0, closed, closed),
        ("squeeze", 0.0, closed, hand.expand(squeezed.joints)),
    )
    for row in range(len(grasps)):
        pose = grasps.obj_from_hand[row]
        for name, distance, joints, targets in keys:
            position = pose[:3, 3] - distance * grasps.approach[row]
            state = [*position.tolist(), *quaternion(pose), *(float(joints[joint][row]) for joint in order)]
            control = format_numbers(float(targets[joint][row]) for joint in order)
            ET.SubElement(keyframes, "key", name=f"grasp_{row}_{name}", qpos=format_numbers(state), ctrl=control)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"
