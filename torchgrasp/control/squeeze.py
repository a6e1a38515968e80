"""The third pose of a grasp: where the joints are driven so that compliant fingers press with balanced forces."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.closing_law import joint_stiffness
from torchgrasp.control.forces import desired_forces
from torchgrasp.errors import BadArgument
from torchgrasp.frames import apply as move
from torchgrasp.frames import inverse, rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.values import Grasps


class Squeezed(NamedTuple):
    """Joint targets [rad], the fingers' forces on the object in the hand's frame [N], and the joints' torques [N m]."""

    joints: Float[Tensor, "g h"]
    forces: Float[Tensor, "g 3 3"]
    torques: Float[Tensor, "g h"]


def squeeze_joints(grasps: Grasps, hand: Hand, force: float = 4.0, kp: float | None = None) -> Float[Tensor, "g h"]:
    """Return joint targets [rad] with which the fingers press at their planned contacts, by J^T f = kp (target - q).

    The forces are balanced (`desired_forces`): they need the least friction of all that cancel. Where no balanced set
    presses at all three contacts each finger presses along its normal. Replayed open loop, pre-grasp, grasp and squeeze
    close any hand whose joints are position-controlled; targets may lie past a limit by their lead.

    Args:
        grasps: g rows.
        hand: the hand that they were planned for.
        force: normal force of the strongest finger [N].
        kp: stiffness of every joint's drive [N m/rad]; None: the hand's own.

    Raises:
        BadArgument: joints of another hand, or a force or stiffness that is not positive.

    >>> from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
    >>> hand = load_hand("allegro")
    >>> grasps = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=20)
    >>> lead = squeeze_joints(grasps, hand, force=5.0) - grasps.joints
    >>> lead.shape[1], bool((lead.abs().amax(1) > 0.01).all())
    (12, True)
    """
    return squeeze(grasps, hand, force, kp).joints


def squeeze(grasps: Grasps, hand: Hand, force: float = 4.0, kp: float | None = None) -> Squeezed:
    """Return `squeeze_joints` with the forces and torques that they stand for; torques are of the actuated joints."""
    if grasps.joints.shape[-1] != hand.dof:
        raise BadArgument("grasps", f"{grasps.joints.shape[-1]} joints", f"the {hand.dof} of {hand.name}")
    for name, value in (("force", force), ("kp", 1.0 if kp is None else kp)):
        if not 0.0 < value < 1e6:
            raise BadArgument(name, value, "a number in (0, 10^6)")
    joints = grasps.joints.double()
    hand_from_obj = inverse(grasps.obj_from_hand.double())
    points = move(hand_from_obj, grasps.contacts.points.double())
    normals = rotate(hand_from_obj, grasps.contacts.normals.double())
    forces = desired_forces(points, normals, force)
    torques = torch.einsum("gcih,gci->gh", hand.to(torch.float64).jacobian(joints), forces)
    return Squeezed(joints + torques / joint_stiffness(hand, kp), forces, torques)
