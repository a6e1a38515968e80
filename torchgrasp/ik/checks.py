"""Errors of grasps, measured from geometry, whatever a solver believed.

The frame-invariant code stays the same when all normals are negated, mirrored or rotated together. A solver can stop
anywhere. So everything is measured anew.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, link_clearance
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.refine import FLAT_PAD, ROUND_PAD, tip_targets
from torchgrasp.plan.feasibility import first_violation
from torchgrasp.values import Contacts

TIP_TOLERANCE = 1 * MILLIMETRE
"""Largest distance [m] of a fingertip from its contact: a tenth of a fingertip's radius or so."""
TIP_PENETRATION = 2 * MILLIMETRE
"""Largest depth [m] of a fingertip in the estimated surface; a round tip at its contact has none."""
ANGLE_TOLERANCE = math.radians(2)
"""How far [rad] a contact direction may lie outside the pad's cone: a soft residual leaves a little."""


@dataclasses.dataclass(frozen=True)
class GraspErrors(Batch):
    """Errors of grasps; `Grasps` explains the fields."""

    tip_error: Float[Tensor, "g 3"]
    normal_angle: Float[Tensor, "g 3"]
    clearance: Float[Tensor, "g"]
    status: Int[Tensor, "g"]


def tip_error(spatial: SpatialJacobian, contacts: Contacts) -> Float[Tensor, "g 3"]:
    """Return the distance [m] of each fingertip from its contact."""
    hand = spatial.hand
    return torch.linalg.vector_norm(
        spatial.points(hand.tips.index, hand.tips.center) - tip_targets(hand, contacts), dim=-1
    )


def normal_angle(spatial: SpatialJacobian, contacts: Contacts) -> Float[Tensor, "g 3"]:
    """Return the angle [rad] between pad axes and inward normals."""
    pads = spatial.directions(spatial.hand.tips.index, spatial.hand.tips.normal)
    return torch.acos((-(pads * contacts.normals).sum(-1)).clamp(-1.0, 1.0))


def measure_errors(hand: Hand, configuration: Configuration, contacts: Contacts, world: CollisionWorld) -> GraspErrors:
    """Measure tips, contact directions, joint limits and clearances.

    `status` names the first error out of tolerance. NaN is out of tolerance.
    """
    spatial = SpatialJacobian.at(hand, configuration)
    error, angle = tip_error(spatial, contacts), normal_angle(spatial, contacts)
    links, tips, table = link_clearance(spatial, world, tips_touch=True)
    between = hand.self_clearance(configuration.joints)
    lower, upper = hand.lower.to(error), hand.upper.to(error)
    cone = torch.where(hand.tips.radius.to(error) > 0, ROUND_PAD, FLAT_PAD) + ANGLE_TOLERANCE
    conditions = {
        Status.TIP_ERROR: (error <= TIP_TOLERANCE).all(1),
        Status.NORMAL_ANGLE: (angle <= cone).all(1),
        Status.JOINT_LIMITS: ((configuration.joints >= lower - 1e-9) & (configuration.joints <= upper + 1e-9)).all(1),
        Status.SELF_COLLISION: between >= 0,
        Status.OBJECT_COLLISION: (links >= 0) & (tips >= -TIP_PENETRATION),
        Status.TABLE_COLLISION: table >= 0,
    }
    return GraspErrors(error, angle, torch.stack([links, table, between]).amin(0), first_violation(conditions))


def is_clear(hand: Hand, configuration: Configuration, world: CollisionWorld) -> Bool[Tensor, "g"]:
    """Tell which hands touch nothing, not even with their fingertips."""
    links, _, table = link_clearance(SpatialJacobian.at(hand, configuration), world, tips_touch=False)
    return (links >= 0) & (table >= 0) & (hand.self_clearance(configuration.joints) >= 0)
