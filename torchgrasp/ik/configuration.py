"""Configurations of a free-floating hand, and Jacobians of points on its links.

A Jacobian is built from wrenches: the derivative of a residual by a joint or pose motion is the product of a wrench
about the object's origin and the twist of the motion.
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
    """Joints [rad] and pose of a free-floating hand."""

    joints: Float[Tensor, "g h"]
    obj_from_hand: Poses

    @checked(gradients=True)
    def integrate(self, hand: Hand, step: Float[Tensor, "g d"]) -> "Configuration":
        """Return the configuration after a step of translation [m], rotation vector and joints, within the limits.

        Translation and rotation vector are in the hand's axes.
        """
        if step.shape[1] != 6 + self.joints.shape[1]:
            raise BadArgument("step", f"{step.shape[1]} numbers", f"6 of the pose and {self.joints.shape[1]} joints")
        rotation, position = self.obj_from_hand[:, :3, :3], self.obj_from_hand[:, :3, 3]
        joints = (self.joints + step[:, 6:]).clamp(hand.lower.to(position), hand.upper.to(position))
        position = position + (rotation @ step[:, :3, None])[..., 0]
        return Configuration(joints, rigid(rotation @ rotation_from_vector(step[:, 3:6]), position))


class Rows(NamedTuple):
    """Residuals with their derivatives: `wrench` times the twist of each motion for which `moves` is 1."""

    residual: Float[Tensor, "g k"]
    wrench: Float[Tensor, "g k 6"]
    moves: Float[Tensor, "*g k q"]


@dataclasses.dataclass(frozen=True)
class SpatialJacobian(Value):
    """Link frames, sphere centres, fingertips, pad axes and motion twists of a hand, in the object's frame."""

    hand: Hand
    obj_from_link: Float[Tensor, "3 4 l g"]
    spheres: Float[Tensor, "3 s g"]
    tips: Float[Tensor, "3 f g"]
    pads: Float[Tensor, "3 f g"]
    twists: Float[Tensor, "6 q g"]

    @classmethod
    def at(cls, hand: Hand, configuration: Configuration) -> "SpatialJacobian":
        """Evaluate the kinematics at configurations; Jacobians follow from the result."""
        root = configuration.obj_from_hand[:, :3].permute(1, 2, 0)
        frames = hand.tree.frames(hand.actuated.couple(configuration.joints).T.contiguous(), root)
        spheres, tips, pads, origins, turning, sliding = hand.motion.place(frames)
        twists = torch.cat([torch.linalg.cross(origins, turning, dim=0) + sliding, turning])
        return cls(hand, frames, spheres, tips, pads, twists)

    def points(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return points [m] that are fixed in links, in the object's frame."""
        return map_points(self.obj_from_link.index_select(2, links), local).permute(2, 1, 0)

    @property
    def sphere_centres(self) -> Float[Tensor, "g s 3"]:
        """Centres [m] of the hand's collision spheres."""
        return self.spheres.permute(2, 1, 0)

    def jacobian(self, wrench: Float[Tensor, "g k 6"], moves: Float[Tensor, "*g k q"]) -> Float[Tensor, "g k d"]:
        """Return the derivatives of residuals by pose and joints; the arguments are fields of `Rows`."""
        by_motion = (wrench @ self.twists.permute(2, 0, 1)) * moves
        coupling = self.hand.motion.coupling
        return by_motion if coupling is None else by_motion @ coupling.to(by_motion)


def differentiate(spatial: SpatialJacobian, parts: Sequence[Rows]) -> Residuals:
    """Return the residuals of all parts, concatenated, and their Jacobian by pose and joints."""
    residual, wrench, moves = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    return residual, spatial.jacobian(wrench, moves)
