"""What carries the simulated hand: a vertical joint that lifts it and, where it comes from afar, one that approaches.

Also the hand's URDF as SAPIEN takes it: hung on this carriage at the pose of the grasp, geometry only.
"""

import math
import xml.etree.ElementTree as ET
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from torchgrasp.hand.hand import Actuator
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.sim.scene import SceneSpec

LIFT_JOINT = "torchgrasp_lift"
"""Name of the prismatic joint that carries the hand along the world's z axis."""

APPROACH_JOINT = "torchgrasp_approach"
"""Name of the prismatic joint that carries the hand along its approach, 0 where it has arrived."""

MOUNT_DRIVE = Actuator(effort=1e4, velocity=10.0, kp=1e4, kd=1e3)
"""Their motors: force [N], speed [m/s], stiffness [N/m] and damping [N s/m]."""

WRIST_JOINT = "torchgrasp_wrist"
"""Name of the fixed joint by which the hand hangs on them."""


class Slide(NamedTuple):
    """A joint of the carriage: its name, its unit axis in the world, its limits and where it starts [m]."""

    name: str
    axis: tuple[float, float, float]
    lower: float
    upper: float
    start: float


def mount_slides(setup: SceneSpec) -> list[Slide]:
    """Return the joints on which the hand hangs, the one fixed to the world first."""
    slides = [Slide(LIFT_JOINT, (0.0, 0.0, 1.0), -0.01, setup.travel + 0.05, 0.0)]
    way = float(np.linalg.norm(setup.approach))
    if way > 0:
        x, y, z = setup.approach
        slides.append(Slide(APPROACH_JOINT, (x / way, y / way, z / way), -way - 0.01, 0.01, -way))
    return slides


def mounted_urdf(setup: SceneSpec) -> str:
    """Return the URDF of the hand on its carriage.

    `<visual>` and `<material>` are left out (they need a render device), `<mimic>`, `<transmission>` and `<gazebo>`
    too: the simulator transmits force through mimic joints wrongly, so that coupled joints get targets of their own
    (`Hand.expand`).

    Raises:
        HandFileError: the file is no sound URDF (`read_urdf`).
    """
    urdf = read_urdf(setup.urdf_path)
    robot = ET.fromstring(urdf.data)
    for parent in list(robot.iter()):
        for child in list(parent):
            if child.tag in ("visual", "mimic", "transmission", "gazebo", "material"):
                parent.remove(child)
    roll, pitch, yaw = euler_from_rotation(setup.world_from_hand[:3, :3])
    x, y, z = setup.world_from_hand[:3, 3]
    stand, parent = ['<link name="torchgrasp_world"/>'], "torchgrasp_world"
    for slide in mount_slides(setup):
        child = f"{slide.name}_link"
        stand.append(
            f"""<link name="{child}"><inertial><origin xyz="0 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <joint name="{slide.name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>
    <axis xyz="{" ".join(f"{x:.12g}" for x in slide.axis)}"/>
    <limit lower="{slide.lower:.9g}" upper="{slide.upper:.9g}" effort="1000" velocity="10"/></joint>"""
        )
        parent = child
    stand.append(
        f"""<joint name="{WRIST_JOINT}" type="fixed"><parent link="{parent}"/><child link={quoteattr(urdf.root)}/>
    <origin xyz="{x:.12g} {y:.12g} {z:.12g}" rpy="{roll:.12g} {pitch:.12g} {yaw:.12g}"/></joint>"""
    )
    robot[:0] = list(ET.fromstring(f"<stand>{''.join(stand)}</stand>"))
    return ET.tostring(robot, encoding="unicode")


def euler_from_rotation(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return roll, pitch, yaw [rad] of a rotation, as URDF wants them: R = Rz(yaw) Ry(pitch) Rx(roll).

    At a pitch of 90 degrees only yaw - roll is fixed; roll is 0 there.

    >>> euler_from_rotation(np.eye(3))
    (0.0, 0.0, 0.0)
    """
    sine = -float(rotation[2, 0])
    level = math.hypot(float(rotation[0, 0]), float(rotation[1, 0]))
    pitch = math.atan2(sine, level)
    if level < 1e-9:
        return 0.0, pitch, math.atan2(-float(rotation[0, 1]), float(rotation[1, 1]))
    roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    return roll + 0.0, pitch + 0.0, math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))
