"""Inputs and outputs of the controller at a tick: `Observation` and `Targets`."""

import dataclasses
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_device
from torchgrasp.checks import checked
from torchgrasp.control.tactile import TactileState
from torchgrasp.hand.hand import Hand

STILL = torch.zeros(3, dtype=torch.float64)  # displacement of a palm that stays on its path


class Targets(NamedTuple):
    """Commands until the next tick.

    Args:
        joints: targets of all joints of the URDF, in the order of `hand.tree.joint_names` [rad].
        palm: displacement of the palm [m] from its path, in the axes of the hand. The wrist does not turn.
        left: remaining length [m] of the approach; 0: the hand is at its pre-grasp.

    >>> Targets(torch.zeros(16)).palm
    tensor([0., 0., 0.], dtype=torch.float64)
    """

    joints: Float[Tensor, " j"]
    palm: Float[Tensor, "3"] = STILL
    left: float = 0.0


@checked
@dataclasses.dataclass(frozen=True)
class Observation(Value):
    """Joints, fingertips and touch at a tick, in the hand's frame.

    Args:
        joints: all joints of the URDF, in the order of `hand.tree.joint_names` [rad].
        tips: centres of the fingertips [m].
        jacobian: of these centres by all joints [m/rad].
        tactile: readings of the fingertips.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.control import no_contact
    >>> hand = load_hand("barrett")
    >>> observe(hand, (hand.lower + hand.upper) / 2, no_contact()).jacobian.shape
    torch.Size([3, 3, 8])
    """

    joints: Float[Tensor, " j"]
    tips: Float[Tensor, "f 3"]
    jacobian: Float[Tensor, "f 3 j"]
    tactile: TactileState


@checked
def observe(hand: Hand, joints: Float[Tensor, " h"], tactile: TactileState) -> Observation:
    """Return the observation of a robot with measured actuated joints [rad] and fingertip readings.

    Raises:
        BadArgument: joints or fingertips on another device than the hand.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.control import no_contact
    >>> hand = load_hand("barrett")
    >>> joints = (hand.lower + hand.upper) / 2
    >>> torch.allclose(observe(hand, joints, no_contact()).tips, hand.tip_centres(joints))
    True
    """
    check_device("tactile", tactile.lagged.device, "the hand", hand.lower.device)
    joints = joints.double()
    tips, everything = hand.tip_centres(joints), hand.expand_joints(joints)
    return Observation(everything, tips, joint_jacobian(hand, everything, tips), tactile)


def joint_jacobian(hand: Hand, joints: Float[Tensor, " j"], points: Float[Tensor, "f 3"]) -> Float[Tensor, "f 3 j"]:
    """Return the Jacobian of points on the fingertips [m/rad] by all joints of the URDF, each on its own."""
    axes, origins = hand.tree.joint_axes(hand.tree.poses(joints[None])[0])
    turning = torch.linalg.cross(axes.expand(len(points), -1, 3), points[:, None] - origins)
    columns = torch.where(hand.tree.prismatic[:, None] > 0, axes, turning)
    return (columns * hand.tree.moves[hand.tips.index][:, :, None]).transpose(1, 2)
