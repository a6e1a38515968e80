"""Public laws: what a hand of your own must satisfy before torchgrasp can plan with it."""

from pathlib import Path

import numpy as np
import torch

from torchgrasp.errors import HandFileError
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand, load_hand
from torchgrasp.hand.spec import HandSpec, read_hand_toml
from torchgrasp.hand.urdf import Urdf, read_urdf

POSTURES = 50
"""Random postures in which the kinematics are compared."""
FK_TOLERANCE = 1e-6
"""Largest difference [m, and entries of rotations] between two readers of the same URDF."""


def check_hand(name_or_path: str | Path, fingers: str = "default") -> Hand:
    """Check a hand's files and return the hand: the public law for hands.

    The tree, the coupling, the limits and drives, masses and inertias, the pads, the parked posture, and the forward
    kinematics against yourdfpy, coupled joints included.

    Args:
        name_or_path: a shipped hand, or the folder of another one.
        fingers: the finger option of its hand.toml.

    Raises:
        HandFileError: a file breaks a rule; the message names the file, what was found and what is allowed.
        AssertionError: a law of the library does not hold for this hand.

    >>> check_hand("barrett").name
    'barrett'
    """
    spec = read_hand_toml(find_hand(name_or_path) / "hand.toml", fingers)
    urdf, hand = read_urdf(spec.urdf), load_hand(name_or_path, fingers)
    _check_bodies(urdf)
    _check_joints(urdf, spec, hand)
    _check_pads(urdf, spec)
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(POSTURES, hand.dof, generator=generator, dtype=torch.float64)
    joints = hand.lower + (hand.upper - hand.lower) * share
    _check_coupling(hand, joints)
    _check_kinematics(hand, joints)
    free = hand.self_clearance(joints) > 0
    assert bool(free.any()), f"{spec.path}: none of {POSTURES} random postures is free of self-collision"
    return hand


def _check_bodies(urdf: Urdf) -> None:
    """Refuse masses and inertias that no body can have."""
    for link in urdf.links:
        where = f"{urdf.path}: link {link.name}"
        if not link.mass > 0:
            raise HandFileError("urdf", f"{where} of mass {link.mass} kg", "a positive mass")
        xx, xy, xz, yy, yz, zz = link.inertia
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if principal[0] <= 0 or principal[0] + principal[1] < principal[2] * (1 - 1e-6):
            raise HandFileError("urdf", f"{where} of principal inertias {principal}", "positive, any two >= the third")


def _check_joints(urdf: Urdf, spec: HandSpec, hand: Hand) -> None:
    """Refuse drives that cannot move, parked and coupled joints beyond their limits, and a second coupling."""
    joints = {j.name: j for j in urdf.joints if j.kind != "fixed"}
    for joint in joints.values():
        if not (joint.effort > 0 and joint.velocity > 0):
            found = f"{urdf.path}: joint {joint.name} of effort {joint.effort}, velocity {joint.velocity}"
            raise HandFileError("urdf", found, "positive effort and velocity")
        if joint.mimic is not None and spec.coupling.get(joint.name) != joint.mimic:
            found = f"{urdf.path}: joint {joint.name} mimics {joint.mimic}"
            raise HandFileError("urdf", found, f"the coupling of hand.toml, {spec.coupling.get(joint.name)}")
    for end in (hand.lower, hand.upper):
        for name, value in hand.expand(end).items():
            joint, q = joints[name], float(value)
            if not joint.lower - 1e-6 <= q <= joint.upper + 1e-6:
                found = f"{spec.path}: joint {name} at {q:.6g}"
                raise HandFileError("hand.toml", found, f"within its limits [{joint.lower:.6g}, {joint.upper:.6g}]")


def _check_pads(urdf: Urdf, spec: HandSpec) -> None:
    """Refuse a fingertip that its own joints do not move, and a normal that points into the tip's shape."""
    above = {j.child: j for j in urdf.joints}
    shapes = {x.name: x.shapes for x in urdf.links}
    for finger in spec.all_fingers:
        chain, link = [], finger.tip_link
        while link in above:
            chain.append(above[link].name)
            link = above[link].parent
        moving = [j for j in reversed(chain) if above and any(u.name == j and u.kind != "fixed" for u in urdf.joints)]
        if list(finger.joints) != moving:
            found = f"{spec.path}: finger {finger.name} of joints {list(finger.joints)}"
            raise HandFileError("hand.toml", found, f"the joints above {finger.tip_link} in order, {moving}")
        outside = np.array(finger.contact) + 1e-4 * np.array(finger.normal)
        for shape in shapes[finger.tip_link]:
            if shape.kind == "sphere" and np.linalg.norm(outside - shape.xyz) < shape.size[0]:
                found = f"{spec.path}: the contact of finger {finger.name} lies inside its tip's sphere"
                raise HandFileError("hand.toml", found, "a contact on the surface, its normal outward")


def _check_coupling(hand: Hand, joints: torch.Tensor) -> None:
    """Assert that every joint is linear in the actuated ones."""
    half = hand.expand_joints(joints / 2 + joints.flip(0) / 2)
    mean = (hand.expand_joints(joints) + hand.expand_joints(joints.flip(0))) / 2
    assert torch.allclose(half, mean, rtol=0, atol=1e-12), f"{hand.name}: the coupling is not linear"


def _check_kinematics(hand: Hand, joints: torch.Tensor) -> None:
    """Assert that yourdfpy, which applies `<mimic>` by itself, places every link in the same pose."""
    worst, where = largest_fk_error(hand, joints)
    assert worst < FK_TOLERANCE, f"{hand.name}: link {where} differs by {worst:.3g} from yourdfpy's pose"


def largest_fk_error(hand: Hand, joints: torch.Tensor) -> tuple[float, str]:
    """Return the largest difference of a link pose from yourdfpy's over postures (n, h), and the link."""
    import yourdfpy

    robot = yourdfpy.URDF.load(str(hand.urdf_path), load_meshes=False, load_collision_meshes=False)
    poses = hand.link_poses(joints).double().numpy()
    worst, where = 0.0, ""
    for row in range(len(joints)):
        values = {n: float(v) for n, v in hand.expand(joints[row]).items()}
        robot.update_cfg([values[n] for n in robot.actuated_joint_names])
        for index, link in enumerate(hand.link_names):
            error = float(np.abs(robot.get_transform(link) - poses[row, index]).max())
            if error > worst:
                worst, where = error, link
    return worst, where
