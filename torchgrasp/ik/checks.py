"""Judge every refined grasp by its own geometry, whatever the solver believed (the code fixes no side of the normals).

The frame-invariant code is unchanged when all three normals are negated, mirrored or rotated together, and a solver
can stop anywhere: so tips, contact directions, limits and every clearance are measured again here.
"""

import dataclasses
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, link_clearance
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.refine import FLAT_PAD, ROUND_PAD, tip_targets
from torchgrasp.values import Contacts

TIP_TOLERANCE = 1 * MILLIMETRE
"""Largest distance [m] of a fingertip from its contact."""
TIP_PENETRATION = 2 * MILLIMETRE
"""Largest depth [m] of a fingertip in the estimated surface; a tip that touches where it should has none."""
ANGLE_TOLERANCE = math.radians(2)
"""How far [rad] beyond the pad's cone, which `refine` asks for, a contact direction may lie."""


@dataclasses.dataclass(frozen=True)
class GraspErrors(Batch):
    """What was measured of each grasp; see `Grasps` for the meaning of the fields."""

    tip_error: Float[Tensor, "g 3"]
    normal_angle: Float[Tensor, "g 3"]
    clearance: Float[Tensor, "g"]
    status: Int[Tensor, "g"]


def tip_error(jacobians: SpatialJacobian, contacts: Contacts) -> Float[Tensor, "g 3"]:
    """Return the distance [m] of each fingertip's touching point from its contact."""
    hand = jacobians.hand
    centres = jacobians.points(hand.tips.index, hand.tips.center)
    return torch.linalg.vector_norm(centres - tip_targets(hand, contacts), dim=-1)


def normal_angle(jacobians: SpatialJacobian, contacts: Contacts) -> Float[Tensor, "g 3"]:
    """Return the angle [rad] between each pad's axis and the direction into the surface."""
    hand = jacobians.hand
    pads = jacobians.directions(hand.tips.index, hand.tips.normal)
    return torch.acos((-(pads * contacts.normals).sum(-1)).clamp(-1.0, 1.0))


def measure(posture: Configuration, hand: Hand, contacts: Contacts, world: CollisionWorld) -> GraspErrors:
    """Measure tips, contact directions, limits and clearances of g grasps; contact i is the one of finger i.

    Returns:
        The measures, with the `Status` of the first that is out of tolerance.
    """
    jacobians = SpatialJacobian.at(posture, hand)
    error, angle = tip_error(jacobians, contacts), normal_angle(jacobians, contacts)
    links, tips, table = link_clearance(jacobians, world, tips_touch=True)
    itself = hand.self_clearance(posture.joints)
    lower, upper = hand.lower.to(error), hand.upper.to(error)
    within = ((posture.joints >= lower - 1e-9) & (posture.joints <= upper + 1e-9)).all(1)
    cone = torch.where(hand.tip_radius.to(error) > 0, ROUND_PAD, FLAT_PAD) + ANGLE_TOLERANCE
    findings = [  # each says what is right, so that a number that is none is wrong
        (Status.TIP_ERROR, (error <= TIP_TOLERANCE).all(1)),
        (Status.NORMAL_ANGLE, (angle <= cone).all(1)),
        (Status.JOINT_LIMITS, within),
        (Status.SELF_COLLISION, itself >= 0),
        (Status.OBJECT_COLLISION, (links >= 0) & (tips >= -TIP_PENETRATION)),
        (Status.TABLE_COLLISION, table >= 0),
    ]
    status = torch.full_like(itself, Status.OK, dtype=torch.int64)
    for code, right in reversed(findings):
        status = torch.where(right, status, int(code))
    return GraspErrors(error, angle, torch.stack([links, table, itself]).amin(0), status)


def check(
    posture: Configuration, pregrasp: Float[Tensor, "g h"], hand: Hand, contacts: Contacts, world: CollisionWorld
) -> GraspErrors:
    """Measure grasps as `measure` does, and whether their opened hands are clear of everything.

    Args:
        posture: g grasps.
        pregrasp: joints of the opened hand at the same poses.
        hand: the hand.
        contacts: contact i is the one of finger i.
        surroundings: the estimated object and the table.
    """
    found = measure(posture, hand, contacts, world)
    opened = SpatialJacobian.at(Configuration(pregrasp, posture.obj_from_hand), hand)
    links, _, table = link_clearance(opened, world, tips_touch=False)
    clear = (links >= 0) & (table >= 0) & (hand.self_clearance(pregrasp) >= 0)
    fine = (found.status != Status.OK) | clear
    return dataclasses.replace(found, status=torch.where(fine, found.status, int(Status.PREGRASP)))
