"""Checks of a user's own hand: rules for its files, and laws of its kinematics, on which planning
relies.
"""

import dataclasses
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BrokenLaw, HandFileError
from torchgrasp.foundation.lazy import yourdfpy
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand.abilities import random_joints
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers, HandSpec, read_hand_toml
from torchgrasp.hand.load import find_hand, load_hand
from torchgrasp.hand.urdf import LinkShape, Urdf, read_urdf

__all__ = ["BrokenLaw", "check_hand"]


@dataclasses.dataclass(frozen=True)
class LawNumbers:
    """Steps and tolerances with which `check_hand` tests the files and the kinematics of a hand."""

    step: float = 1e-6
    """Step [rad] of central differences."""
    jacobian: float = 1e-6
    """Largest difference [m/rad] of central differences from the fingertips' Jacobian."""
    rounding: float = 1e-6
    """Largest error of a joint [rad or m], and largest relative error of the sum of two principal
    inertias.
    """
    outward: float = 1e-4
    """Distance [m] from a pad's contact point, along its outward normal, at which no collision
    shape of the hand may be.
    """


LAWS = LawNumbers()
FK_POSTURES = 50  # number of random postures in which kinematics are compared
FREE_POSTURES = 2000  # number of random postures of which one must be free of self-collision
FK_TOLERANCE = 1e-8  # largest difference [m, and entries of rotations] from the poses of yourdfpy


@checked
def check_hand(name_or_path: str | Path, fingers: Fingers = "default") -> Hand:
    """Check the files and kinematics of a hand with a choice of grasping fingers, and return the
    hand.

    The rules for the files concern couplings, limits, motors and masses. They also concern the
    pads, the fixed positions of joints that do not grasp, and self-collision. The kinematics of the
    loaded hand must obey three laws, by name:

    * "kinematics": the poses of all links are those that the URDF library yourdfpy computes.
    * "jacobian": the Jacobian of the fingertips equals central differences.
    * "batch": each posture of a batch gives what it gives alone, and an empty batch is empty.

    Args:
        name_or_path: name of a shipped hand, or the folder or hand.toml of another hand.
        fingers: the grasping fingers, as in `load_hand`.

    Raises:
        HandFileError: a file breaks a rule, is missing or malformed. Or links of the hand overlap
            in all of 2000 random postures.
        BrokenLaw: the kinematics break a law; `law` is the name of the first.
        BadArgument: the hand has no such fingers.

    >>> check_hand("barrett").name
    'barrett'
    """
    hand = load_hand(name_or_path, fingers)
    for fault in find_faults(name_or_path, fingers):
        raise fault
    joints = random_joints(hand, FK_POSTURES)
    free = bool((hand.self_clearance(joints) > 0).any())
    many = joints if free else random_joints(hand, FREE_POSTURES)
    if not free and not bool((hand.self_clearance(many) > 0).any()):
        met = " and ".join(most_met(hand, many))
        found = (
            f"{find_hand(name_or_path)}: links that meet in all of {FREE_POSTURES} random "
            f"postures, as {met}"
        )
        raise HandFileError(
            "hand.toml",
            found,
            "parked joints, shapes or pairs of self_collision by which they part",
        )
    worst, link = largest_fk_error(hand, joints)
    if not worst < FK_TOLERANCE:
        raise BrokenLaw(
            "kinematics", f"link {link} of {hand.name} off by {worst:.3g}", "the pose of yourdfpy"
        )
    _check_jacobian(hand, joints)
    return hand


def _check_jacobian(hand: Hand, joints: Float[Tensor, "n h"]) -> None:
    """Raise `BrokenLaw` if the Jacobian differs from central differences, or a row of a batch from
    a single posture.
    """
    step = LAWS.step
    steps = step * torch.eye(hand.dof, dtype=torch.float64, device="cpu")
    after, before = (hand.fingertips(joints[:, None] + sign * steps)[0] for sign in (1, -1))
    error = (
        ((after - before) / (2 * step) - hand.jacobian(joints).movedim(-1, 1)).abs().amax((0, 2, 3))
    )
    if not float(error.max()) < LAWS.jacobian:
        found = (
            f"the column of {hand.joint_names[int(error.argmax())]} off by {float(error.max()):.3g}"
        )
        raise BrokenLaw("jacobian", found, "that of central differences")
    points, _ = hand.fingertips(joints)
    for row in (0, len(joints) - 1):
        if not torch.allclose(
            hand.fingertips(joints[row])[0], points[row], rtol=0, atol=FK_TOLERANCE
        ):
            raise BrokenLaw(
                "batch", f"row {row} of {len(joints)} elsewhere than alone", "the same fingertips"
            )
    if hand.fingertips(joints[:0])[0].shape != (0, *points.shape[1:]):
        raise BrokenLaw("batch", "fingertips of no postures", "an empty batch")


def find_faults(name_or_path: str | Path, fingers: Fingers = "default") -> Iterator[HandFileError]:
    """Yield an error, without raising it, for each place where the files of a hand break a rule.

    The rules concern masses, inertias, motors, joint limits, couplings and pads. Raises
    `HandFileError` if the hand is missing or malformed, and `BadArgument` if it has no such
    fingers.
    """
    spec = read_hand_toml(find_hand(name_or_path) / "hand.toml", fingers)
    urdf = read_urdf(spec.urdf)
    hand = load_hand(name_or_path, fingers)
    yield from _wrong_bodies(urdf)
    yield from _wrong_joints(urdf, spec, hand)
    yield from _wrong_pads(urdf, spec)


def most_met(hand: Hand, joints: Float[Tensor, "n h"]) -> tuple[str, str]:
    """Return the names of the two links of a hand that overlap in the largest number of n postures.

    `joints` (n, h) are positions of the h actuated joints [rad or m].
    """
    apart = hand.self_collision.separations(
        hand.tree.frames(hand.expand_joints(joints).T.contiguous()), 0.0
    )
    links = hand.self_collision.link[hand.self_collision.pairs[int((apart < 0).sum(1).argmax())]]
    one, two = (hand.tree.link_names[int(k)] for k in links)
    return one, two


def _wrong_bodies(urdf: Urdf) -> Iterator[HandFileError]:
    """Yield errors for masses and inertias that are physically impossible."""
    for link in urdf.links:
        if not link.mass > 0:
            yield urdf.wrong(f"link {link.name} of mass {link.mass} kg", "a positive mass")
        principal = np.linalg.eigvalsh(link.inertia_matrix)
        if principal[0] <= 0 or principal[0] + principal[1] < principal[2] * (1 - LAWS.rounding):
            yield urdf.wrong(
                f"link {link.name} of principal inertias {principal}",
                "positive, any two >= the third",
            )


def _wrong_joints(urdf: Urdf, spec: HandSpec, hand: Hand) -> Iterator[HandFileError]:
    """Yield errors for drives without effort or velocity, and for fixed or coupled joints beyond
    their limits.
    """
    for joint in urdf.movable:
        if not (joint.effort > 0 and joint.velocity > 0):
            found = f"joint {joint.name} of effort {joint.effort}, velocity {joint.velocity}"
            yield urdf.wrong(found, "positive effort and velocity")
    ends = hand.expand_joints(torch.stack([hand.lower, hand.upper])).T.tolist()
    for joint, values in zip(urdf.movable, ends, strict=True):
        lower = joint.lower - LAWS.rounding
        upper = joint.upper + LAWS.rounding
        for value in [q for q in values if not lower <= q <= upper][:1]:
            allowed = f"within its limits [{joint.lower:.6g}, {joint.upper:.6g}]"
            yield spec.wrong(f"joint {joint.name} at {value:.6g}", allowed)


def _wrong_pads(urdf: Urdf, spec: HandSpec) -> Iterator[HandFileError]:
    """Yield errors for fingers with wrong joints, and for contact points inside the tip's own
    shapes.
    """
    shapes = {x.name: x.shapes for x in urdf.links}
    for finger in spec.all_fingers:
        movers = [j.name for j in reversed(urdf.movers(finger.tip_link))]
        if list(finger.joints) != movers:
            found = f"finger {finger.name} of joints {list(finger.joints)}"
            yield spec.wrong(found, f"the joints above {finger.tip_link} in order, {movers}")
        outside = np.array(finger.pad.contact) + LAWS.outward * np.array(finger.pad.normal)
        if any(_inside(outside, shape) for shape in shapes[finger.tip_link]):
            found = f"the contact of finger {finger.name} lies inside its tip's shape"
            yield spec.wrong(found, "a contact on the surface, its normal outward")


def _inside(point: np.ndarray, shape: LinkShape) -> bool:
    x, y, z = rotation_from_rpy(shape.rpy).numpy().T @ (point - shape.xyz)
    if shape.kind == "box":
        return bool((np.abs([x, y, z]) < shape.half).all())
    if shape.kind == "cylinder":
        return bool(np.hypot(x, y) < shape.size[0] and 2 * abs(z) < shape.size[1])
    return bool(np.linalg.norm([x, y, z]) < shape.size[0])


def largest_fk_error(hand: Hand, joints: Float[Tensor, "n h"]) -> tuple[float, str]:
    """Return the largest difference of a link's pose from that of the library yourdfpy, and the
    link's name.

    A difference is that of one entry of a pose (4, 4): of a translation [m], or of a rotation
    matrix (no unit). `joints` (n, h) are n postures: positions of the h actuated joints [rad or m].
    """
    urdf = read_urdf(hand.urdf_path)
    poses = hand.link_poses(joints).double()
    robot = yourdfpy.URDF.load(io.BytesIO(urdf.xml), load_meshes=False)
    others = torch.zeros_like(poses)
    for row in range(len(joints)):
        values = {name: float(value) for name, value in hand.expand(joints[row]).items()}
        robot.update_cfg([values[name] for name in robot.actuated_joint_names])
        others[row] = torch.from_numpy(
            np.stack([robot.get_transform(link) for link in hand.tree.link_names])
        )
    error = (others - poses).abs().amax((0, 2, 3))
    return float(error.max()), hand.tree.link_names[int(error.argmax())]
