"""Errors of grasps, measured anew from geometry: a solver can stop anywhere, and a code does not tell mirror images."""

import dataclasses
import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.checks import ANY, Length, checked
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, link_clearance, obstacle_clearance
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.refine import tip_targets
from torchgrasp.plan.feasibility import first_violation
from torchgrasp.values import Contacts

PAPER_TOLERANCE = 10 * MILLIMETRE
"""Largest distance [m] of a tip from its contact in the paper's chain, about a tip's radius; closing takes it up."""
TIP_TOLERANCE, TIP_PENETRATION = 1 * MILLIMETRE, 2 * MILLIMETRE
"""Largest distance [m] of a tip from its contact, a tenth of its radius or so, and depth in the estimated surface."""
ANGLE_TOLERANCE = math.radians(2)
"""How far [rad] a contact direction may lie outside the pad's cone: a soft residual leaves a little."""


@checked
@dataclasses.dataclass(frozen=True)
class GraspErrors(Batch):
    """Errors of grasps; `Grasps` explains the fields.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> placed = Configuration(grasp.joints, grasp.obj_from_hand)
    >>> found = measure_errors(load_hand("barrett"), placed, grasp.contacts, CollisionWorld(table=0.0))
    >>> Status(int(found.status)).name, found.tip_error < 0.001, found.clearance > 0
    ('OK', tensor([[True, True, True]]), tensor([True]))
    """

    tip_error: Annotated[Float[Tensor, "g f"], ANY]
    normal_angle: Annotated[Float[Tensor, "g f"], ANY]
    clearance: Annotated[Float[Tensor, "g"], ANY]
    status: Int[Tensor, "g"]


@checked
def measure_errors(
    hand: Hand,
    configuration: Configuration,
    contacts: Contacts,
    world: CollisionWorld,
    rolling: bool = True,
    tolerance: Length = TIP_TOLERANCE,
) -> GraspErrors:
    """Measure grasps; `status` names the first error out of tolerance, as NaN is.

    Round fingertips may roll on their contacts within the pads' cones. If not `rolling`, the pads' contact points
    count, in any direction, as in the paper. `tolerance` [m] is that of tips.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp, high = load_shipped_grasp("jug", "barrett"), CollisionWorld(table=0.1)
    >>> placed = Configuration(grasp.joints, grasp.obj_from_hand)
    >>> Status(int(measure_errors(load_hand("barrett"), placed, grasp.contacts, high).status)).name
    'TABLE_COLLISION'
    """
    spatial = SpatialJacobian.at(hand, configuration)
    touching, target = (
        (hand.tips.center, tip_targets(hand, contacts)) if rolling else (hand.tips.contact, contacts.points)
    )
    error = torch.linalg.vector_norm(spatial.points(hand.tips.index, touching) - target, dim=-1)
    pads = spatial.pads.permute(2, 1, 0)
    angle = torch.acos((-(pads * contacts.normals).sum(-1)).clamp(-1.0, 1.0))  # from the inward normal
    links, depth, table = link_clearance(spatial, world, tips_touch=True)
    between = hand.self_clearance(configuration.joints)
    lower, upper = hand.lower.to(error), hand.upper.to(error)
    cone = hand.tips.cone.to(error) + ANGLE_TOLERANCE
    conditions = {
        Status.TIP_ERROR: (error <= tolerance).all(1),
        Status.NORMAL_ANGLE: (angle <= cone).all(1) | (not rolling),
        Status.JOINT_LIMITS: ((configuration.joints >= lower - 1e-9) & (configuration.joints <= upper + 1e-9)).all(1),
        Status.SELF_COLLISION: between >= 0,
        Status.OBJECT_COLLISION: (links >= 0) & (depth >= -TIP_PENETRATION),
        Status.TABLE_COLLISION: table >= 0,
    }
    clearances = [links, table, between]
    if world.guarded:
        clearances.append(obstacle_clearance(spatial, world))
        conditions[Status.NEIGHBOUR_COLLISION] = clearances[-1] >= 0
    return GraspErrors(error, angle, torch.stack(clearances).amin(0), first_violation(conditions))


def is_clear(hand: Hand, configuration: Configuration, world: CollisionWorld) -> Bool[Tensor, "g"]:
    """Tell which hands touch neither object nor table nor themselves, not even with their fingertips."""
    links, _, table = link_clearance(SpatialJacobian.at(hand, configuration), world, tips_touch=False)
    return (links >= 0) & (table >= 0) & (hand.self_clearance(configuration.joints) >= 0)
