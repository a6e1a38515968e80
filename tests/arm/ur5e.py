"""The UR5e with cylinders as collision shapes, written from the numbers that Universal Robots
publishes.

These are the Denavit-Hartenberg parameters, masses, centres of mass and joint limits. The cylinders
follow its drawing.
"""

import math
import tempfile
from pathlib import Path

import numpy as np
import torch

from torchgrasp.arm import Arm, load_arm
from torchgrasp.data.accept import HandLike
from torchgrasp.geometry.frames import rotation_from_rpy

A = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)  # [m]
D = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)  # [m]
ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
MASS = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)  # [kg]
CENTRE = (
    (0, -0.02561, 0.00193),
    (0.2125, 0, 0.11336),
    (0.15, 0, 0.0265),
    (0, -0.0018, 0.01634),
    (0, 0.0018, 0.01634),
    (0, 0, -0.001159),
)
NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
# [N m], halves of a turn either way
EFFORT = (150, 150, 150, 28, 28, 28)
TURN = (2, 2, 1, 2, 2, 2)
QUARTER = math.pi / 2
CYLINDERS: tuple[tuple[tuple[float, ...], ...], ...] = (  # radius, length, centre, pitch
    ((0.075, 0.09, 0, 0, 0.045, 0),),
    ((0.06, 0.13, 0, 0, 0.165, 0),),
    (
        (0.06, 0.13, 0, 0, 0.125, 0),
        (0.055, 0.425, -0.2125, 0, 0.138, QUARTER),
        (0.055, 0.12, -0.425, 0, 0.13, 0),
    ),
    (
        (0.055, 0.1, 0, 0, 0.02, 0),
        (0.045, 0.3922, -0.1961, 0, 0.007, QUARTER),
        (0.04, 0.1, -0.3922, 0, 0.015, 0),
    ),
    ((0.038, 0.11, 0, 0, 0.125, 0),),
    ((0.038, 0.1, 0, 0, 0.09, 0),),
    ((0.038, 0.045, 0, 0, 0.077, 0),),
)


def ur5e_urdf() -> str:
    """Return the URDF from `base_link` to the flange `tool0`."""
    parts = ['<robot name="ur5e">']
    names = ("base_link", *(f"{name}_link" for name in NAMES))
    for k, (name, cylinders) in enumerate(zip(names, CYLINDERS, strict=True)):
        mass, centre = (4.0, (0, 0, 0.04)) if k == 0 else (MASS[k - 1], _centre(k - 1))
        shapes = "".join(
            f'<collision><origin xyz="{x} {y} {z}" rpy="0 {pitch} 0"/><geometry><cylinder radius="{r}" length="{h}"/>'
            "</geometry></collision>"
            for r, h, x, y, z, pitch in cylinders
        )
        r, h, *_ = cylinders[len(cylinders) > 1]
        across = mass * (3 * r * r + h * h) / 12
        along = mass * r * r / 2
        xx, zz = (along, across) if len(cylinders) > 1 else (across, along)
        at = " ".join(map(str, centre))
        body = (
            f'<inertial><origin xyz="{at}"/><mass value="{mass}"/>'
            f'<inertia ixx="{xx}" ixy="0" ixz="0" iyy="{across}" iyz="0" izz="{zz}"/></inertial>'
        )
        parts.append(f'<link name="{name}">{body}{shapes}</link>')
    place = (0.0, 0.0, 0.0)
    for k, name in enumerate(NAMES):
        roll = ALPHA[k - 1] if k else 0.0
        limit = TURN[k] * math.pi
        parts.append(
            f'<joint name="{name}_joint" type="revolute"><parent link="{names[k]}"/><child link="{names[k + 1]}"/>'
            f'<origin xyz="{" ".join(map(str, place))}" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" effort="{EFFORT[k]}" velocity="{math.pi}"/></joint>'
        )
        place = (A[k], 0.0, D[k])
    parts.append(
        f'<link name="tool0"/><joint name="flange" type="fixed"><parent link="{names[-1]}"/><child link="tool0"/>'
        f'<origin xyz="{" ".join(map(str, place))}"/></joint></robot>'
    )
    return "\n".join(parts)


def _centre(k: int) -> tuple[float, ...]:
    """Return a centre of mass in the frame of its joint, whose published one is in the next joint's
    frame.
    """
    turned = rotation_from_rpy((ALPHA[k], 0.0, 0.0)).numpy() @ np.array(CENTRE[k])
    return tuple((turned + np.array([A[k], 0.0, D[k]])).tolist())


def by_products(joints: np.ndarray) -> np.ndarray:
    """Return the pose of the flange as the product of the Denavit-Hartenberg matrices."""
    pose = np.eye(4)
    for q, a, d, alpha in zip(joints, A, D, ALPHA, strict=True):
        (cq, sq), (ca, sa) = (math.cos(q), math.sin(q)), (math.cos(alpha), math.sin(alpha))
        pose = pose @ np.array(
            [
                [cq, -sq * ca, sq * sa, a * cq],
                [sq, cq * ca, -cq * sa, a * sq],
                [0, sa, ca, d],
                [0, 0, 0, 1],
            ]
        )
    return pose


def ur5e(
    hand: HandLike,
    place: tuple[float, float, float] = (-0.55, 0.0, 0.0),
    seed: int = 0,
    *,
    urdf: str | None = None,
) -> Arm:
    """Return the arm with a hand on its flange, whose root is 95 mm away; its base stands at a
    place [m].
    """
    base = torch.eye(4, dtype=torch.float64)
    mount = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor(place, dtype=torch.float64)
    mount[2, 3] = 0.095
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "ur5e.urdf")
        file.write_text(urdf or ur5e_urdf())
        return load_arm(file, hand, obj_from_base=base, tip_from_hand=mount, seed=seed)
