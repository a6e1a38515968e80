"""Public laws: what a hand of your own must satisfy before torchgrasp can plan with it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import HandFileError
from torchgrasp.frames import rotation_from_rpy
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import HandSpec, read_hand_toml
from torchgrasp.hand.load import find_hand, load_hand
from torchgrasp.hand.urdf import Joint, Shape, Urdf, read_urdf

POSTURES = 50
"""Random postures in which the kinematics are compared."""
FK_TOLERANCE = 1e-6
"""Largest difference [m, and entries of rotations] between two readers of the same URDF."""


def check_hand(name_or_path: str | Path, fingers: str = "default") -> Hand:
    """Check a hand's files and return the hand: the public law for hands.

    The tree, the coupling, the limits and drives, masses and inertias, the pads, the parked posture, self-collision,
    and the forward kinematics against pytorch-kinematics and yourdfpy, which applies `<mimic>` by itself.

    Args:
        name_or_path: a shipped hand, or the folder of another one.
        fingers: the finger option of its hand.toml.

    Raises:
        HandFileError: a file breaks a rule; the message names the file, what was found and what is allowed.
        BadArgument: the hand has no such option.
        AssertionError: the library places a link elsewhere than they do.

    >>> check_hand("barrett").name
    'barrett'
    """
    hand = load_hand(name_or_path, fingers)
    for fault in find_faults(name_or_path, fingers):
        raise fault
    joints = random_joints(hand, POSTURES)
    if not bool((hand.self_clearance(joints) > 0).any()):
        found = f"{find_hand(name_or_path)}: links that meet in all of {POSTURES} random postures"
        raise HandFileError("hand.toml", found, "pairs of self_collision that can part")
    worst, where = largest_fk_error(hand, joints)
    if not worst < FK_TOLERANCE:
        raise AssertionError(f"{hand.name}: link {where} differs by {worst:.3g} from others' pose")
    return hand


def find_faults(name_or_path: str | Path, fingers: str = "default") -> Iterator[HandFileError]:
    """Yield every rule that the two files of a hand break, of those that a hand can be loaded with.

    Raises:
        HandFileError: the hand cannot be loaded.
        BadArgument: the hand has no such option.
    """
    spec = read_hand_toml(find_hand(name_or_path) / "hand.toml", fingers)
    urdf, hand = read_urdf(spec.urdf), load_hand(name_or_path, fingers)
    yield from _wrong_bodies(urdf)
    yield from _wrong_joints(urdf, spec, hand)
    yield from _wrong_pads(urdf, spec)


def random_joints(hand: Hand, n: int, seed: int = 0) -> Float[Tensor, "n h"]:
    """Draw postures uniformly within the limits [rad]."""
    share = torch.rand(n, hand.dof, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return hand.lower + (hand.upper - hand.lower) * share


def _wrong_bodies(urdf: Urdf) -> Iterator[HandFileError]:
    """Find masses and inertias that no body can have."""
    for link in urdf.links:
        where = f"{urdf.path}: link {link.name}"
        if not link.mass > 0:
            yield HandFileError("urdf", f"{where} of mass {link.mass} kg", "a positive mass")
        xx, xy, xz, yy, yz, zz = link.inertia
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if principal[0] <= 0 or principal[0] + principal[1] < principal[2] * (1 - 1e-6):
            yield HandFileError("urdf", f"{where} of principal inertias {principal}", "positive, any two >= the third")


def _wrong_joints(urdf: Urdf, spec: HandSpec, hand: Hand) -> Iterator[HandFileError]:
    """Find drives that cannot move, and parked and coupled joints beyond their limits."""
    joints = {j.name: j for j in urdf.joints if j.kind != "fixed"}
    for joint in joints.values():
        if not (joint.effort > 0 and joint.velocity > 0):
            found = f"{urdf.path}: joint {joint.name} of effort {joint.effort}, velocity {joint.velocity}"
            yield HandFileError("urdf", found, "positive effort and velocity")
    ends = {name: set[float]() for name in joints}
    for end in (hand.lower, hand.upper):
        for name, value in hand.expand(end).items():
            ends[name].add(float(value))
    for name, values in ends.items():
        joint, outside = joints[name], [q for q in values if not _within(q, joints[name])]
        if outside:
            found = f"{spec.path}: joint {name} at {outside[0]:.6g}"
            yield HandFileError("hand.toml", found, f"within its limits [{joint.lower:.6g}, {joint.upper:.6g}]")


def _within(value: float, joint: Joint) -> bool:
    """Tell whether a value is within a joint's limits."""
    return joint.lower - 1e-6 <= value <= joint.upper + 1e-6


def _wrong_pads(urdf: Urdf, spec: HandSpec) -> Iterator[HandFileError]:
    """Find fingertips that their own joints do not move, and contacts that lie inside the tip's own shapes."""
    shapes = {x.name: x.shapes for x in urdf.links}
    for finger in spec.all_fingers:
        moving = [j.name for j in reversed(urdf.joints_above(finger.tip_link)) if j.kind != "fixed"]
        if list(finger.joints) != moving:
            found = f"{spec.path}: finger {finger.name} of joints {list(finger.joints)}"
            yield HandFileError("hand.toml", found, f"the joints above {finger.tip_link} in order, {moving}")
        outside = np.array(finger.contact) + 1e-4 * np.array(finger.normal)
        if any(_inside(outside, shape) for shape in shapes[finger.tip_link]):
            found = f"{spec.path}: the contact of finger {finger.name} lies inside its tip's shape"
            yield HandFileError("hand.toml", found, "a contact on the surface, its normal outward")


def _inside(point: np.ndarray, shape: Shape) -> bool:
    """Tell whether a point of a link lies in one of its shapes."""
    x, y, z = rotation_from_rpy(shape.rpy).numpy().T @ (point - shape.xyz)
    if shape.kind == "box":
        return bool((2 * np.abs([x, y, z]) < shape.size).all())
    if shape.kind == "cylinder":
        return bool(np.hypot(x, y) < shape.size[0] and 2 * abs(z) < shape.size[1])
    return bool(np.linalg.norm([x, y, z]) < shape.size[0])


def largest_fk_error(hand: Hand, joints: Float[Tensor, "n h"]) -> tuple[float, str]:
    """Return the largest difference of a link's pose [m, and entries of rotations] from others', and the link.

    The others are yourdfpy and pytorch-kinematics.

    Args:
        hand: the hand.
        joints: postures (n, h) [rad].
    """
    import yourdfpy

    robot = yourdfpy.URDF.load(str(hand.urdf_path), load_meshes=False, load_collision_meshes=False)
    poses = hand.link_poses(joints).double().numpy()
    chain = reference_poses(read_urdf(hand.urdf_path), hand.expand_joints(joints)).double().numpy()
    worst, where = 0.0, ""
    for row in range(len(joints)):
        values = {n: float(v) for n, v in hand.expand(joints[row]).items()}
        robot.update_cfg([values[n] for n in robot.actuated_joint_names])
        for index, link in enumerate(hand.tree.link_names):
            both = np.stack([robot.get_transform(link), chain[row, index]])
            error = float(np.abs(both - poses[row, index]).max())
            if error > worst:
                worst, where = error, link
    return worst, where


def reference_poses(urdf: Urdf, values: Float[Tensor, "n j"]) -> Float[Tensor, "n l 4 4"]:
    """Return `root_from_link` of every link by pytorch-kinematics, which is good to 1e-8 m."""
    import pytorch_kinematics

    chain: Any = pytorch_kinematics.build_chain_from_urdf(urdf.kinematic_xml())
    chain = chain.to(dtype=values.dtype, device=values.device)
    names = [j.name for j in urdf.joints if j.kind != "fixed"]
    order = [names.index(name) for name in chain.get_joint_parameter_names()]
    poses = chain.forward_kinematics_tensor(values[:, order], analytical_grad=False)
    return poses[[chain.frame_to_idx[link.name] for link in urdf.links]].transpose(0, 1)
