"""The hand's URDF as the simulator takes it: hung on a vertical joint at the pose of the grasp, geometry only."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from torchgrasp.hand.hand import Actuator
from torchgrasp.hand.urdf import read_urdf

LIFT_JOINT = "torchgrasp_lift"
"""Name of the prismatic joint that carries the hand along the world's z axis."""

LIFT_DRIVE = Actuator(effort=1e4, velocity=10.0, kp=1e4, kd=1e3)
"""Its motor: force [N], speed [m/s], stiffness [N/m] and damping [N s/m]."""

WRIST_JOINT = "torchgrasp_wrist"
"""Name of the fixed joint by which the hand hangs on it."""


def lifted_urdf(urdf_path: Path | str, world_from_hand: np.ndarray, travel: float) -> str:
    """Return the URDF of a hand that stands at a pose in the world and can be lifted by `travel` [m].

    `<visual>` and `<material>` are left out (they need a render device), `<mimic>`, `<transmission>` and `<gazebo>`
    too: the simulator transmits force through mimic joints wrongly, so that coupled joints get targets of their own
    (`Hand.expand`).

    Args:
        urdf_path: of the hand.
        world_from_hand: pose of the URDF's root link (4, 4).
        travel: of the lift joint [m], upwards.

    Raises:
        HandFileError: the file is no sound URDF (`read_urdf`).
    """
    urdf = read_urdf(urdf_path)
    robot = ET.fromstring(urdf.data)
    for parent in list(robot.iter()):
        for child in list(parent):
            if child.tag in ("visual", "mimic", "transmission", "gazebo", "material"):
                parent.remove(child)
    roll, pitch, yaw = euler_from_rotation(world_from_hand[:3, :3])
    x, y, z = world_from_hand[:3, 3]
    robot[:0] = list(
        ET.fromstring(
            f"""<stand>
  <link name="torchgrasp_world"/>
  <link name="torchgrasp_arm"><inertial><origin xyz="0 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <joint name="{LIFT_JOINT}" type="prismatic"><parent link="torchgrasp_world"/><child link="torchgrasp_arm"/>
    <axis xyz="0 0 1"/><limit lower="-0.01" upper="{travel + 0.05:.9g}" effort="1000" velocity="10"/></joint>
  <joint name="{WRIST_JOINT}" type="fixed"><parent link="torchgrasp_arm"/><child link={quoteattr(urdf.root)}/>
    <origin xyz="{x:.12g} {y:.12g} {z:.12g}" rpy="{roll:.12g} {pitch:.12g} {yaw:.12g}"/></joint>
</stand>"""
        )
    )
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
