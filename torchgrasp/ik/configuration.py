"""Configurations of a free hand, and Jacobians of points on it.

A row of a Jacobian is the virtual work of a force at a point: a wrench about the object's origin. Its derivative by a
motion is the wrench times the motion's twist.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch, Value
from torchgrasp.checks import Poses, checked
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.optim import Residuals
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import map_points


@checked
@dataclasses.dataclass(frozen=True)
class Configuration(Batch):
    """Joints [rad] and pose of a free hand."""

    joints: Float[Tensor, "g h"]
    obj_from_hand: Poses

    @checked(gradients=True)
    def integrate(self, hand: Hand, step: Float[Tensor, "g d"]) -> "Configuration":
        """Step by a translation [m], a rotation vector (both in the hand's axes) and joints, clamped to the limits."""
        if step.shape[1] != 6 + self.joints.shape[1]:
            raise BadArgument("step", f"{step.shape[1]} numbers", f"6 of the pose and {self.joints.shape[1]} joints")
        rotation, position = self.obj_from_hand[:, :3, :3], self.obj_from_hand[:, :3, 3]
        joints = (self.joints + step[:, 6:]).clamp(hand.lower.to(position), hand.upper.to(position))
        position = position + (rotation @ step[:, :3, None])[..., 0]
        return Configuration(joints, rigid(rotation @ rotation_from_vector(step[:, 3:6]), position))


class Rows(NamedTuple):
    """Residuals, and how a hand's motions change them: by the work of `wrench` where `moves` is 1."""

    residual: Float[Tensor, "g k"]
    wrench: Float[Tensor, "g k 6"]
    moves: Float[Tensor, "*g k q"]


@dataclasses.dataclass(frozen=True)
class SpatialJacobian(Value):
    """Frames of the links, the markers and the twists of its motions, in the object's frame."""

    hand: Hand
    obj_from_link: Float[Tensor, "3 4 l g"]
    spheres: Float[Tensor, "3 s g"]
    tips: Float[Tensor, "3 f g"]
    pads: Float[Tensor, "3 f g"]
    twists: Float[Tensor, "6 q g"]

    @classmethod
    def at(cls, hand: Hand, configuration: Configuration) -> "SpatialJacobian":
        """Return the frames and axes from which Jacobians at configurations follow, by one call of the kinematics."""
        root = configuration.obj_from_hand[:, :3].permute(1, 2, 0)
        frames = hand.tree.frames(hand.actuated.couple(configuration.joints).T.contiguous(), root)
        spheres, tips, pads, origins, turning, sliding = hand.motion.place(frames)
        twists = torch.cat([torch.linalg.cross(origins, turning, dim=0) + sliding, turning])
        return cls(hand, frames, spheres, tips, pads, twists)

    def points(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return points fixed in links, in the object's frame [m]."""
        return map_points(self.obj_from_link.index_select(2, links), local).permute(2, 1, 0)

    @property
    def sphere_centres(self) -> Float[Tensor, "g s 3"]:
        """Centres [m] of the hand's collision spheres."""
        return self.spheres.permute(2, 1, 0)

    def jacobian(self, wrench: Float[Tensor, "g k 6"], moves: Float[Tensor, "*g k q"]) -> Float[Tensor, "g k d"]:
        """Return the derivatives of rows (`Rows`) by pose and joints."""
        by_motion = (wrench @ self.twists.permute(2, 0, 1)) * moves
        coupling = self.hand.motion.coupling
        return by_motion if coupling is None else by_motion @ coupling.to(by_motion)


def differentiate(spatial: SpatialJacobian, parts: Sequence[Rows]) -> Residuals:
    """Return the residuals of all parts, one after the other, and their Jacobian by pose and joints."""
    residual, wrench, moves = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    return residual, spatial.jacobian(wrench, moves)
