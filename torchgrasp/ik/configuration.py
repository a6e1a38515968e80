"""Where a placed hand's links are, and how what is fixed to them moves with the hand's pose and joints.

A row of a Jacobian is virtual work: the change of `directions . points` is the work of a force along the direction at
the point. So a row is a wrench (force, then torque about the object's origin), and its derivative by a joint is the
wrench times the joint's twist, if the joint moves the link.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch, Value
from torchgrasp.frames import apply, rigid, rotate, rotation_from_vector
from torchgrasp.hand.hand import Hand


@dataclasses.dataclass(frozen=True)
class Configuration(Batch):
    """Where the hand is: `joints` (g, h) [rad] and `obj_from_hand` (g, 4, 4)."""

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]

    def moved(self, step: Float[Tensor, "g d"], hand: Hand) -> "Configuration":
        """Return the posture after a step (translation [m], rotation vector, joints [rad]), projected on the limits.

        The step of the pose is in the hand's own axes, so that a solver's path does not depend on the object's frame.
        """
        turn, place = self.obj_from_hand[:, :3, :3], self.obj_from_hand[:, :3, 3]
        joints = (self.joints + step[:, 6:]).clamp(hand.lower.to(place), hand.upper.to(place))
        place = place + (turn @ step[:, :3, None])[..., 0]
        return Configuration(joints, rigid(turn @ rotation_from_vector(step[:, 3:6]), place))


@dataclasses.dataclass(frozen=True)
class SpatialJacobian(Value):
    """The hand's links and its joints' twists in the object's frame, at one posture: all that its Jacobians need."""

    hand: Hand
    obj_from_link: Float[Tensor, "g l 4 4"]
    twists: Float[Tensor, "g 6 j"]
    pose: Float[Tensor, "g 4 4"]

    @classmethod
    def at(cls, posture: Configuration, hand: Hand) -> "SpatialJacobian":
        """Evaluate the forward kinematics once."""
        links, pose = hand.link_poses(posture.joints), posture.obj_from_hand
        axes, origins = hand.tree.joint_axes(links)
        axes, origins = rotate(pose, axes), apply(pose, origins)
        slide = hand.tree.prismatic.to(axes)[:, None]
        twists = torch.cat([torch.linalg.cross(origins, axes) * (1 - slide) + axes * slide, axes * (1 - slide)], -1)
        return cls(hand, pose[:, None] @ links, twists.mT, pose)

    def points(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return points that are fixed in links, in the object's frame."""
        return self.columns(links, local).permute(2, 0, 1)

    def columns(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3 g"]:
        """Return `points` with the postures last in memory: the fast layout for sums over few coordinates."""
        g, count = self.obj_from_link.shape[:2]
        frames = self.obj_from_link[:, :, :3].permute(1, 3, 2, 0).reshape(4 * count, 3 * g)
        # One product with a sparse matrix is many times faster than a product for each point.
        k = torch.arange(len(links), device=links.device)
        place = frames.new_zeros(len(links), count, 4)
        place[k, links, :3] = local.to(frames)
        place[k, links, 3] = 1.0
        return (place.flatten(1) @ frames).unflatten(1, (3, g))

    def directions(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return directions that are fixed in links, in the object's frame."""
        return (self.obj_from_link[:, links, :3, :3] @ local.to(self.pose)[:, :, None])[..., 0]

    def jacobian(self, wrench: Float[Tensor, "g k 6"], links: Int[Tensor, "*g k"]) -> Float[Tensor, "g k d"]:
        """Return the derivative of rows, each the work of a wrench on a link, by pose and joints."""
        force, torque = wrench.split(3, -1)
        turn, origin = self.pose[:, :3, :3], self.pose[:, :3, 3]
        about = torque - torch.linalg.cross(origin[:, None].expand_as(force), force)
        moves, coupling = self.hand.tree.moves[links].to(wrench), self.hand.actuated.coupling.to(wrench)
        joints = ((wrench @ self.twists) * moves) @ coupling
        return torch.cat([force @ turn, about @ turn, joints], -1)


def wrench_of(points: Float[Tensor, "g k 3"], directions: Float[Tensor, "g k 3"]) -> Float[Tensor, "g k 6"]:
    """Return the wrenches of unit forces along directions at points: rows of the derivative of directions . points."""
    return torch.cat([directions, torch.linalg.cross(points, directions)], -1)
