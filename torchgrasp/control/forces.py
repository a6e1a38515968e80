"""Desired forces of the fingers, their covariance (Eq. 28), and the joint targets that exert them."""

from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import settle
from torchgrasp.checks import Positive, Range, checked
from torchgrasp.control.stiffness import joint_stiffness
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.plan.internal_forces import least_friction_forces
from torchgrasp.values import Grasps

FORCE_SPREAD = 0.1
"""Relative standard deviation of the desired normal force: a stand-in for the learned one of Eq. (28)."""


def desired_forces(
    points: Float[Tensor, "*b f 3"],
    normals: Float[Tensor, "*b f 3"],
    strongest: float = 4.0,
    preferred: Float[Tensor, "*#b f"] | None = None,
) -> Float[Tensor, "*b f 3"]:
    """Return `least_friction_forces`, or `strongest` along the normals where no balanced set presses everywhere."""
    balanced = least_friction_forces(points, normals, strongest, preferred)
    return torch.where(torch.isfinite(balanced), balanced, -strongest * normals)


def force_covariance(
    forces: Float[Tensor, "*b 3"],
    normals: Float[Tensor, "*b 3"],
    floor: float,
    deviation: Float[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b 3 3"]:
    """Return Sigma_fd of Eq. (28) [N^2]: the normal force's variance along the normal, plus an isotropic floor.

    `floor` and `deviation` are standard deviations [N]; without `deviation` the normal force's is proportional to it.
    """
    deviation = FORCE_SPREAD * (forces * normals).sum(-1) if deviation is None else deviation
    along = normals[..., :, None] * normals[..., None, :] * deviation[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=forces.dtype, device=forces.device)


def contacts_in_hand(grasps: Grasps) -> tuple[Float[Tensor, "g f 3"], Float[Tensor, "g f 3"]]:
    """Return planned contact points [m] and normals in the hand's frame."""
    hand_from_obj = inverse(grasps.obj_from_hand.double())
    contacts = grasps.contacts
    return apply(hand_from_obj, contacts.points.double()), rotate(hand_from_obj, contacts.normals.double())


class Squeeze(NamedTuple):
    """The third pose of a grasp: joint targets [rad], forces on the object [N], torques [N m].

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> pressed = squeeze(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> pressed.forces.norm(dim=-1).round(decimals=1)  # [N] of each finger
    tensor([[2., 2., 4.]], dtype=torch.float64)
    >>> pressed.forces.sum(1).norm() < 1e-6  # they balance
    tensor(True)
    """

    joints: Float[Tensor, "g h"]
    forces: Float[Tensor, "g f 3"]
    torques: Float[Tensor, "g h"]


@checked
def squeeze(
    hand: Hand, grasps: Grasps, force: Annotated[float, Range(0.01, 100.0)] = 4.0, kp: Positive | None = None
) -> Squeeze:
    """Return joint targets with which position-controlled fingers press at their planned contacts.

    The targets solve J^T f = kp (target - q) for the `desired_forces` f; they may exceed a joint's limits.

    Args:
        hand: the hand; it follows the grasps to their device.
        grasps: g rows, planned for it.
        force: normal force of the strongest finger [N].
        kp: stiffness of every joint's drive [N m/rad]; None: the hand's own.

    Raises:
        BadArgument: joints or fingers of another hand, or a force or stiffness that is not positive.

    >>> from torchgrasp import load_hand, load_object, plan_grasps
    >>> hand = load_hand("allegro")
    >>> grasps = plan_grasps(load_object("cylinder").view, hand, starts=20)
    >>> squeeze(hand, grasps).joints.shape == grasps.joints.shape
    True
    """
    check_squeeze(hand, grasps, force, kp)
    hand, joints = settle(hand.to(torch.float64), grasps.joints.device), grasps.joints.double()
    points, normals = contacts_in_hand(grasps)
    forces = desired_forces(points, normals, force)
    return press(joints, hand.jacobian(joints, points), forces, joint_stiffness(hand, kp))


def check_squeeze(hand: Hand, grasps: Grasps, force: float, kp: float | None) -> None:
    """Refuse joints or fingers of another hand, and a force or stiffness that is not positive."""
    check_fingers(hand, grasps)
    if grasps.joints.shape[-1] != hand.dof:
        raise BadArgument("grasps", f"{grasps.joints.shape[-1]} joints", f"the {hand.dof} of {hand.name}")
    if not 0.0 < force < 1e3:
        raise BadArgument("force", force, "a number in (0, 1000) [N]")
    if kp is not None and not 0.0 < kp < 1e6:
        raise BadArgument("kp", kp, "a number in (0, 10^6) [N m/rad]")


def check_fingers(hand: Hand, grasps: Grasps) -> None:
    """Refuse grasps that were planned for other fingers of a hand; those that name none may be of any."""
    names = grasps.meta.get("finger_names", ",".join(hand.finger_names)).split(",")
    if tuple(names) != hand.finger_names or grasps.contacts.fingertips != len(names):
        found = f"{grasps.contacts.fingertips} contacts a row, of the fingers {', '.join(names)}"
        allowed = f"those of the hand: {', '.join(hand.finger_names)}; `hand_of(grasps)` loads the fingers of grasps"
        raise BadArgument("grasps", found, allowed)


def press(
    joints: Float[Tensor, "g h"],
    jacobian: Float[Tensor, "g f 3 h"],
    forces: Float[Tensor, "g f 3"],
    stiffness: Float[Tensor, " h"],
) -> Squeeze:
    """Return the `Squeeze` with which joints of a stiffness [N m/rad] exert forces [N]."""
    torques = torch.einsum("gcih,gci->gh", jacobian, forces)
    return Squeeze(joints + torques / stiffness, forces, torques)
