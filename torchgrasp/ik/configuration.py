"""Configurations of a free hand, and Jacobians of points on it.

A row of a Jacobian is the virtual work of a unit force at a point: a wrench about the object's origin. Its derivative
by a joint is the wrench times the joint's twist.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch, Value
from torchgrasp.border import checked
from torchgrasp.frames import apply, rigid, rotate, rotation_from_vector
from torchgrasp.hand.hand import Hand


@checked
@dataclasses.dataclass(frozen=True)
class Configuration(Batch):
    """Joints [rad] and pose of a free hand."""

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]

    def integrate(self, hand: Hand, step: Float[Tensor, "g d"]) -> "Configuration":
        """Step by a translation [m], a rotation vector (both in the hand's axes) and joints, clamped to the limits."""
        rotation, position = self.obj_from_hand[:, :3, :3], self.obj_from_hand[:, :3, 3]
        joints = (self.joints + step[:, 6:]).clamp(hand.lower.to(position), hand.upper.to(position))
        position = position + (rotation @ step[:, :3, None])[..., 0]
        return Configuration(joints, rigid(rotation @ rotation_from_vector(step[:, 3:6]), position))


@dataclasses.dataclass(frozen=True)
class SpatialJacobian(Value):
    """Link poses and joint twists in the object's frame."""

    hand: Hand
    obj_from_link: Float[Tensor, "g l 4 4"]
    twists: Float[Tensor, "g 6 j"]
    obj_from_hand: Float[Tensor, "g 4 4"]

    @classmethod
    def at(cls, hand: Hand, configuration: Configuration) -> "SpatialJacobian":
        """Evaluate the forward kinematics once."""
        links, pose = hand.tree.poses(hand.actuated.couple(configuration.joints)), configuration.obj_from_hand
        axes, origins = hand.tree.joint_axes(links)
        axes, origins = rotate(pose, axes), apply(pose, origins)
        slide = hand.tree.prismatic.to(axes)[:, None]
        twists = torch.cat([torch.linalg.cross(origins, axes) * (1 - slide) + axes * slide, axes * (1 - slide)], -1)
        return cls(hand, pose[:, None] @ links, twists.mT, pose)

    def points(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return points fixed in links, in the object's frame [m]."""
        g, count = self.obj_from_link.shape[:2]
        frames = self.obj_from_link[:, :, :3].permute(1, 3, 2, 0).reshape(4 * count, 3 * g)
        # One product with a sparse matrix is many times faster than a product for each point.
        k = torch.arange(len(links), device=links.device)
        selection = frames.new_zeros(len(links), count, 4)
        selection[k, links] = torch.cat([local.to(frames), frames.new_ones(len(links), 1)], 1)
        return (selection.flatten(1) @ frames).unflatten(1, (3, g)).permute(2, 0, 1)

    def directions(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return directions fixed in links, in the object's frame."""
        return (self.obj_from_link[:, links, :3, :3] @ local.to(self.obj_from_hand)[:, :, None])[..., 0]

    def jacobian(self, wrench: Float[Tensor, "g k 6"], links: Int[Tensor, "*g k"]) -> Float[Tensor, "g k d"]:
        """Return the derivatives by pose and joints of rows, each a wrench on a link."""
        force, torque = wrench.split(3, -1)
        rotation, origin = self.obj_from_hand[:, :3, :3], self.obj_from_hand[:, :3, 3]
        torque = torque - torch.linalg.cross(origin[:, None].expand_as(force), force)  # about the hand's origin
        moves, coupling = self.hand.tree.moves[links].to(wrench), self.hand.actuated.coupling.to(wrench)
        joints = ((wrench @ self.twists) * moves) @ coupling
        return torch.cat([force @ rotation, torque @ rotation, joints], -1)


def wrench_of(points: Float[Tensor, "g k 3"], directions: Float[Tensor, "g k 3"]) -> Float[Tensor, "g k 6"]:
    """Return the wrenches of unit forces along directions at points."""
    return torch.cat([directions, torch.linalg.cross(points, directions)], -1)
