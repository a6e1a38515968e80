"""What a closing hand follows, derived once from hand and grasp: the control model, three poses, contacts and gains."""

import dataclasses
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_tensor
from torchgrasp.control.closing_law import (
    FORCE_BANDWIDTH,
    FORCE_FLOOR,
    force_gain,
    position_gain,
    surface_covariance,
)
from torchgrasp.control.forces import contacts_in_hand, desired_forces, force_covariance, press
from torchgrasp.control.stiffness import drive_stiffness, joint_stiffness, tip_compliance
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Hand
from torchgrasp.values import ClosingGains, Grasps

if TYPE_CHECKING:
    from torchgrasp.control.adaptive.stability import StabilityModel


@dataclasses.dataclass(frozen=True)
class ControlModel(Value):
    """A hand as its controllers know it: every joint of the URDF is `coupling @ actuated + offset`.

    Args:
        joint_names: all joints, in the order of every vector of joints.
        coupling: of all joints to the actuated ones.
        offset: of all joints [rad].
        actuated: places of the actuated joints among all.
        kp: stiffness of every joint's drive [N m/rad].
        lower: limits of the actuated joints [rad].
        upper: limits of the actuated joints [rad].
        radius: of the round fingertips [m]; 0: the contact point itself is the tip.
    """

    joint_names: tuple[str, ...]
    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, " j"]
    actuated: tuple[int, ...]
    kp: Float[Tensor, " j"]
    lower: Float[Tensor, " h"]
    upper: Float[Tensor, " h"]
    radius: Float[Tensor, "3"]

    @classmethod
    def from_hand(cls, hand: Hand, kp: float | None = None) -> "ControlModel":
        """Return the model of a hand whose drives have the stiffness `kp` [N m/rad]; None: its own."""
        return cls(
            joint_names=hand.tree.joint_names,
            coupling=hand.actuated.coupling.double(),
            offset=hand.actuated.offset.double(),
            actuated=tuple(hand.tree.joint_names.index(name) for name in hand.joint_names),
            kp=drive_stiffness(hand, kp),
            lower=hand.lower.double(),
            upper=hand.upper.double(),
            radius=hand.tip_radius.double(),
        )

    def reorder(self, joint_names: tuple[str, ...]) -> "ControlModel":
        """Return the model with all joints in another order."""
        order = [self.joint_names.index(name) for name in joint_names]
        return dataclasses.replace(
            self,
            joint_names=joint_names,
            coupling=self.coupling[order],
            offset=self.offset[order],
            actuated=tuple(order.index(place) for place in self.actuated),
            kp=self.kp[order],
        )

    def expand(self, actuated: Float[Tensor, " h"]) -> Float[Tensor, " j"]:
        """Return all joints of the URDF."""
        return self.coupling @ actuated + self.offset

    def clamp(self, actuated: Float[Tensor, " h"]) -> Float[Tensor, " h"]:
        """Return actuated joints within their limits."""
        return torch.minimum(torch.maximum(actuated, self.lower), self.upper)


@dataclasses.dataclass(frozen=True)
class ClosingReference(Value):
    """What a closing hand follows, in the hand's frame.

    Args:
        hand: the hand.
        obj_from_hand: its planned pose in the frame of the grasp.
        model: the hand as its controllers know it.
        pregrasp: actuated joints of the opened hand [rad].
        joints: actuated joints of the grasp [rad].
        squeeze: actuated joints' targets that press in open loop [rad] (`squeeze`).
        normals: outward normals of the planned contacts.
        gains: targets, gains and desired forces (Eqs. 26-28).
    """

    hand: Hand
    obj_from_hand: Float[Tensor, "4 4"]
    model: ControlModel
    pregrasp: Float[Tensor, " h"]
    joints: Float[Tensor, " h"]
    squeeze: Float[Tensor, " h"]
    normals: Float[Tensor, "3 3"]
    gains: ClosingGains

    @classmethod
    def from_grasp(
        cls,
        hand: Hand,
        grasp: Grasps,
        force: float = 4.0,
        kp: float | None = None,
        stability: "StabilityModel | None" = None,
    ) -> "ClosingReference":
        """Derive the reference of one grasp.

        Desired forces are balanced. Contacts at which no balanced set presses (a certified grasp has none) are pressed
        along their normals, each with `force`.

        Args:
            hand: the hand.
            grasp: one row, planned for it.
            force: normal force of the strongest finger [N].
            kp: stiffness of every joint's drive [N m/rad]; None: the hand's own.
            stability: decides between balanced forces that need nearly as little friction, and gives their covariance;
                None: the covariance is proportional to the force.

        Raises:
            BadArgument: not exactly one row, joints of another hand, a force or stiffness that is not positive, or
                numbers in the grasp that are not finite.
        """
        _check(hand, grasp, force, kp)
        std_m = check_tensor("grasp.contacts.std_m", grasp.contacts.std_m, (1, 3)).double()
        hand, grasp = hand.to(torch.float64), grasp.to(torch.float64)
        points, normals = contacts_in_hand(grasp)
        preferred = deviation = None
        if stability is not None:
            preferred = stability.preferred_forces(points[0] + hand.tip_radius[:, None] * normals[0], force)
            deviation = preferred.covariance.diagonal()[None].sqrt()
        forces = desired_forces(points, normals, force, None if preferred is None else preferred.forces[None])
        covariance = surface_covariance(normals, std_m)
        jacobian = hand.jacobian(grasp.joints)
        alpha_f = FORCE_BANDWIDTH * FORCE_FLOOR**2 * tip_compliance(jacobian, normals, joint_stiffness(hand))
        gains = ClosingGains(
            target=points[0],
            covariance=covariance[0],
            position_gain=position_gain(covariance)[0],
            force_gain=force_gain(force_covariance(forces, normals, FORCE_FLOOR, deviation), alpha_f)[0],
            desired_force=forces[0],
            force_source="analytic" if stability is None else "stability",
        )
        return cls(
            hand=hand,
            obj_from_hand=grasp.obj_from_hand[0],
            model=ControlModel.from_hand(hand, kp),
            pregrasp=grasp.pregrasp[0],
            joints=grasp.joints[0],
            squeeze=press(grasp.joints, jacobian, forces, joint_stiffness(hand, kp)).joints[0],
            normals=normals[0],
            gains=gains,
        )

    def reorder(self, joint_names: tuple[str, ...]) -> "ClosingReference":
        """Return the reference with all joints of the URDF in another order."""
        return dataclasses.replace(self, model=self.model.reorder(joint_names))

    def contact_points(self, tips: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
        """Return the points [m] of fingertips with given centres [m] that touch first along the planned normals."""
        return tips - self.model.radius[:, None] * self.normals


def closing_gains(
    grasp: Grasps, hand: Hand, force: float = 4.0, stability: "StabilityModel | None" = None
) -> ClosingGains:
    """Return target, gains and desired force of each finger for one grasp, in the hand's frame (Eqs. 26-28).

    Arguments and errors are those of `ClosingReference.from_grasp`.
    """
    return ClosingReference.from_grasp(hand, grasp, force, stability=stability).gains


def _check(hand: Hand, grasp: Grasps, force: float, kp: float | None) -> None:
    """Raise `BadArgument` unless a grasp is one row of finite numbers for a hand, force and stiffness are positive."""
    if len(grasp) != 1:
        raise BadArgument("grasp", f"{len(grasp)} rows", "exactly one: index the grasps, as in grasps[0]")
    if grasp.joints.shape[-1] != hand.dof:
        raise BadArgument("grasp", f"{grasp.joints.shape[-1]} joints", f"the {hand.dof} of {hand.name}")
    if not 0.0 < force < 1e3:
        raise BadArgument("force", force, "a number in (0, 1000) [N]")
    if kp is not None and not 0.0 < kp < 1e6:
        raise BadArgument("kp", kp, "a number in (0, 10^6) [N m/rad]")
    check_tensor("grasp.joints", grasp.joints, (1, hand.dof))
    check_tensor("grasp.obj_from_hand", grasp.obj_from_hand, (1, 4, 4))
    check_tensor("grasp.contacts.points", grasp.contacts.points, (1, 3, 3))
    check_tensor("grasp.contacts.normals", grasp.contacts.normals, (1, 3, 3))
