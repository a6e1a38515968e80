"""Desired forces of the fingers, and the joint targets that exert them with position-controlled
drives.
"""

import dataclasses
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.foundation.base import Value, named_tensors, settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Force, Positive, check_dense
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.hand.hand import Actuator, Hand
from torchgrasp.values.planning import Grasps


@checked
@dataclasses.dataclass(frozen=True)
class PreferredForces(Value):
    """Typical normal forces [N] of stable grasps, their covariance [N^2], and the typical spring
    stiffness [N/m].
    """

    forces: Float[Tensor, "3"]
    covariance: Float[Tensor, "3 3"]
    springs: Float[Tensor, "3"]


@runtime_checkable
class ForcePreference(Protocol):
    """What chooses among balanced forces that need nearly equal friction, such as a model of
    stability.
    """

    def preferred_forces(
        self, tips: Float[Tensor, "3 3"], force: Positive | None = None
    ) -> PreferredForces:
        """Return the forces preferred for fingertips with given centres `tips` [m].

        `force` [N] is the normal force of the finger that presses hardest; None leaves it open.
        """
        ...


def desired_forces(
    points: Float[Tensor, "*b f 3"],
    normals: Float[Tensor, "*b f 3"],
    strongest: float = 4.0,
    preferred: Float[Tensor, "*#b f"] | None = None,
) -> Float[Tensor, "*b f 3"]:
    """Return balanced fingertip forces [N] on the object that need the least friction
    (`least_friction_forces`).

    The largest normal force is `strongest` [N]; `preferred` are wanted ratios of the normal forces.
    Where no balanced forces press at every contact, each force is `strongest` along the inward
    normal.
    """
    balanced = least_friction_forces(points, normals, strongest, preferred)
    return torch.where(torch.isfinite(balanced), balanced, -strongest * normals)


def contacts_in_hand(grasps: Grasps) -> tuple[Float[Tensor, "g f 3"], Float[Tensor, "g f 3"]]:
    """Return the planned contact points [m] and outward normals of grasps, in the hand's frame."""
    hand_from_obj = inverse(grasps.obj_from_hand.double())
    points = apply(hand_from_obj, grasps.contacts.points.double())
    return points, rotate(hand_from_obj, grasps.contacts.normals.double())


class Squeeze(NamedTuple):
    """Joint targets [rad] that press on the object in g grasps, the fingertip forces [N] and joint
    torques [N m].
    """

    joints: Float[Tensor, "g h"]
    forces: Float[Tensor, "g f 3"]
    torques: Float[Tensor, "g h"]


@checked(gradients=True)
def squeeze(hand: Hand, grasps: Grasps, force: Force = 4.0, kp: Positive | None = None) -> Squeeze:
    """Return joint targets with which position-controlled fingers press at their planned contacts.

    The targets solve J^T f = kp (target - q) for the `desired_forces` f. They may exceed a joint's
    limits. They are differentiable in the joints of the grasps; the forces, found by a search, are
    not differentiable in the contacts.

    `force` [N] is the normal force of the strongest finger, `kp` [N m/rad] the stiffness of every
    joint's drive, by default the hand's own. The hand follows the grasps to their device. Raises
    `BadArgument` for joints or fingers of another hand, a force or stiffness that is not positive,
    contacts or poses by which derivatives are taken.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> pressed = squeeze(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> pressed.forces.norm(dim=-1).round(decimals=1)
    tensor([[2., 2., 4.]], dtype=torch.float64)
    """
    check_same_hand(hand, grasps)
    for name, x in named_tensors(grasps, "grasps.").items():
        check_dense(name, x, gradients=name == "grasps.joints")
    hand = settle(hand.to(torch.float64), grasps.joints.device)
    joints = grasps.joints.double()
    points, normals = contacts_in_hand(grasps)
    forces = desired_forces(points, normals, force)
    return press(joints, hand.jacobian(joints, points), forces, joint_stiffness(hand, kp))


def check_same_hand(hand: Hand, grasps: Grasps) -> None:
    """Raise `BadArgument` for grasps whose fingers or joints are not the hand's; grasps may lack
    finger names.
    """
    names = grasps.meta.get("finger_names", ",".join(hand.finger_names)).split(",")
    count = grasps.contacts.fingertips
    if tuple(names) != hand.finger_names or count != len(names):
        found = f"{count} contacts a row, of the fingers {', '.join(names)}"
        ours = ", ".join(hand.finger_names)
        advice = "`hand_of(grasps)` loads the fingers of grasps"
        raise BadArgument("grasps", found, f"those of the hand: {ours}; {advice}")
    joints = grasps.joints.shape[-1]
    if joints != hand.dof:
        raise BadArgument("grasps", f"{joints} joints", f"the {hand.dof} joints of {hand.name}")


def press(
    joints: Float[Tensor, "g h"],
    jacobian: Float[Tensor, "g f 3 h"],
    forces: Float[Tensor, "g f 3"],
    stiffness: Float[Tensor, " h"],
) -> Squeeze:
    """Return targets [rad] and torques [N m] with which joint drives of a `stiffness` [N m/rad]
    exert given forces.
    """
    torques = torch.einsum("gcih,gci->gh", jacobian, forces)
    return Squeeze(joints + torques / stiffness, forces, torques)


def stiff_drives(hand: Hand, kp: float | None) -> dict[str, Actuator]:
    """Return the drives of a hand by joint; `kp` [N m/rad], if given, is the stiffness of all."""
    if kp is None:
        return hand.actuators
    return {name: drive._replace(kp=kp) for name, drive in hand.actuators.items()}


def drive_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, " j"]:
    """Return the drive stiffness [N m/rad] of every joint of the URDF: `kp` if given, else the
    hand's own.
    """
    drives = stiff_drives(hand, kp)
    kps = [drives[name].kp for name in hand.tree.joint_names]
    return torch.tensor(kps, dtype=torch.float64, device="cpu")


def joint_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, "h"]:
    """Return the stiffness [N m/rad] of each actuated joint, coupled joints included; `kp` replaces
    the hand's own.
    """
    coupling = hand.actuated.coupling
    stiffness = drive_stiffness(hand, kp).to(coupling)
    return (coupling**2 * stiffness[:, None]).sum(0)


def tip_compliance(
    jacobian: Float[Tensor, "*b f 3 h"],
    normals: Float[Tensor, "*b f 3"],
    stiffness: Float[Tensor, "h"],
) -> Float[Tensor, "*b f"]:
    """Return how far each fingertip yields along its normal per force [m/N], given the joint
    stiffness [N m/rad].
    """
    along = torch.einsum("...cih,...ci->...ch", jacobian, normals)
    return (along**2 / stiffness).sum(-1)
