"""What a robot knows of itself at a control tick; no simulator is needed."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.control.tactile import TactileState
from torchgrasp.hand.hand import Hand


@dataclasses.dataclass(frozen=True)
class Observation(Value):
    """Joints, fingertips and touch at a tick, in the hand's frame.

    Args:
        joints: all joints of the URDF [rad].
        tips: centres of the fingertips [m].
        jacobian: of these centres, by all joints [m/rad].
        reading: normal forces [N].
        forces: forces of the fingertips on the object [N].
        contact: which fingertips feel contact.
        points: sensed contacts [m]; NaN where nothing touches.
        normals: outward normals of the sensed contacts; NaN where nothing touches.
    """

    joints: Float[Tensor, " j"]
    tips: Float[Tensor, "3 3"]
    jacobian: Float[Tensor, "3 3 j"]
    reading: Float[Tensor, "3"]
    forces: Float[Tensor, "3 3"]
    contact: Bool[Tensor, "3"]
    points: Float[Tensor, "3 3"]
    normals: Float[Tensor, "3 3"]

    @classmethod
    def join(
        cls,
        joints: Float[Tensor, " j"],
        tips: Float[Tensor, "3 3"],
        jacobian: Float[Tensor, "3 3 j"],
        tactile: TactileState,
    ) -> "Observation":
        """Return kinematics and touch as one observation."""
        return cls(
            joints, tips, jacobian, tactile.reading, tactile.forces, tactile.contact, tactile.points, tactile.normals
        )


def observe(hand: Hand, joints: Float[Tensor, " h"], tactile: TactileState) -> Observation:
    """Return the observation of a robot that reads its actuated joints [rad] and its fingertips.

    All joints of the URDF are in the order of `hand.tree.joint_names`, as in a `ClosingReference` by default.
    """
    joints = joints.double()
    tips = hand.tip_centres(joints)
    axes, origins = hand.tree.joint_axes(hand.link_poses(joints))
    turning = torch.linalg.cross(axes.expand(3, -1, 3), tips[:, None] - origins)
    columns = torch.where(hand.tree.prismatic[:, None] > 0, axes, turning)
    columns = columns * hand.tree.moves[hand.tips.index][:, :, None]
    return Observation.join(hand.expand_joints(joints), tips, columns.transpose(1, 2), tactile)
