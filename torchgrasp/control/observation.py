"""What the controllers know: of the hand beforehand (`ControlModel`), and at each tick (`Observation`). No simulator is needed."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.control.adaptive.stability import StabilityModel, load_stability
from torchgrasp.control.closing_law import drive_stiffness
from torchgrasp.control.squeeze import squeeze_joints
from torchgrasp.control.tactile import TactileState
from torchgrasp.frames import inverse, rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.values import Grasps


@dataclasses.dataclass(frozen=True)
class ControlModel(Value):
    """What the controllers know of the hand: every joint of the URDF is `coupling @ actuated + offset`.

    `actuated` picks the actuated joints out of all; `kp` [N m/rad] belongs to all; `lower` and `upper` [rad] are the
    limits of the actuated ones; `radius` [m] of the round fingertips (0: the contact point itself is the tip);
    `normals` are the planned outward contact normals in the hand's frame; `joints` and `pregrasp` the planned posture
    and the opened one [rad], `squeeze` the targets that press open loop (`squeeze_joints`).
    """

    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, " j"]
    actuated: tuple[int, ...]
    kp: Float[Tensor, " j"]
    lower: Float[Tensor, " h"]
    upper: Float[Tensor, " h"]
    radius: Float[Tensor, "3"]
    normals: Float[Tensor, "3 3"]
    joints: Float[Tensor, " h"]
    pregrasp: Float[Tensor, " h"]
    squeeze: Float[Tensor, " h"]
    stable: StabilityModel | None = None

    def expand(self, actuated: Float[Tensor, " h"]) -> Float[Tensor, " j"]:
        """Return all joints of the URDF."""
        return self.coupling @ actuated + self.offset


@dataclasses.dataclass(frozen=True)
class Observation(Value):
    """What a robot knows at a tick, in the hand's frame: all joints, fingertip centres and Jacobian, touch.

    `reading` [N] are the normal forces, `forces` [N] all that the tips exert on the object, `contact` the flags,
    `points` [m] and outward `normals` the sensed contacts, NaN where nothing touches (`sensor.TactileState`).
    """

    joints: Float[Tensor, " j"]
    tips: Float[Tensor, "3 3"]
    jacobian: Float[Tensor, "3 3 j"]
    reading: Float[Tensor, "3"]
    forces: Float[Tensor, "3 3"]
    contact: Bool[Tensor, "3"]
    points: Float[Tensor, "3 3"]
    normals: Float[Tensor, "3 3"]


def model_from_hand(
    hand: Hand,
    grasp: Grasps,
    force: float = 4.0,
    names: tuple[str, ...] | None = None,
    kp: float | None = None,
) -> ControlModel:
    """Return what the controllers need to know of a hand and of one grasp.

    Args:
        hand: the hand.
        grasp: one row, planned for it.
        force: normal force of the strongest finger [N] in the squeeze.
        names: the order of all joints of the URDF; None: the hand's own.
        kp: stiffness of every joint's drive [N m/rad]; None: the hand's own.
    """
    names = hand.tree.joint_names if names is None else names
    order = [hand.tree.joint_names.index(name) for name in names]
    return ControlModel(
        coupling=hand.actuated.coupling[order].double(),
        offset=hand.actuated.offset[order].double(),
        actuated=tuple(names.index(name) for name in hand.joint_names),
        kp=drive_stiffness(hand, kp)[order],
        lower=hand.lower.double(),
        upper=hand.upper.double(),
        radius=hand.tip_radius.double(),
        normals=rotate(inverse(grasp.obj_from_hand.double()), grasp.contacts.normals.double())[0],
        joints=grasp.joints[0].double(),
        pregrasp=grasp.pregrasp[0].double(),
        squeeze=squeeze_joints(grasp, hand, force, kp)[0],
        stable=load_stability(hand),
    )


def observe(hand: Hand, joints: Float[Tensor, " h"], tactile: TactileState) -> Observation:
    """Return what a robot knows from the encoders of its actuated joints [rad] and its fingertips, hand's frame.

    All joints of the URDF are in the order of `hand.tree.joint_names`, as in `model_from_hand` by default.
    """
    poses = hand.link_poses(joints.double())
    tips = hand.tip_centres(joints.double())
    axes, origins = hand.tree.joint_axes(poses)
    turned = torch.linalg.cross(axes.expand(3, -1, 3), tips[:, None] - origins)
    columns = torch.where(hand.tree.prismatic[:, None] > 0, axes, turned)
    columns = columns * hand.tree.moves[hand.tips.index][:, :, None]
    return Observation(
        joints=hand.expand_joints(joints.double()),
        tips=tips,
        jacobian=columns.transpose(1, 2),
        reading=tactile.reading,
        forces=tactile.forces,
        contact=tactile.contact,
        points=tactile.points,
        normals=tactile.normals,
    )
