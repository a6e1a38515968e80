"""Configurations of a free-floating hand, and Jacobians of points on its links.

A Jacobian is built from wrenches. The derivative of a residual by a joint or pose motion is the
product of a wrench and a twist. The wrench is about the object's origin, and the twist is that of
the motion. Here g counts configurations. The q motions are three translations along the hand's
axes, and three rotations about them. Last are the joints that the actuated joints move. The number
d = 6 + h counts pose and actuated joints.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Batch, Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Poses
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import matvec
from torchgrasp.geometry.optim import Residuals
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import map_points


@checked
@dataclasses.dataclass(frozen=True)
class Configuration(Batch):
    """g configurations of a free-floating hand with h actuated joints."""

    joints: Float[Tensor, "g h"]  # positions [rad or m] of the actuated joints
    obj_from_hand: Poses  # pose (g, 4, 4) [m] of the hand's root link in the object's frame

    @checked(gradients=True)
    def integrate(self, hand: Hand, step: Float[Tensor, "g d"]) -> "Configuration":
        """Return the configurations after a `step`: translation [m], then rotation vector [rad],
        then joints [rad].

        Translation and rotation vector are in the hand's axes. The joints are clamped to their
        limits. Raises `BadArgument` for a step of another length.
        """
        if step.shape[1] != 6 + self.joints.shape[1]:
            raise BadArgument(
                "step",
                f"{step.shape[1]} numbers",
                f"6 of the pose and {self.joints.shape[1]} joints",
            )
        rotation = self.obj_from_hand[:, :3, :3]
        position = self.obj_from_hand[:, :3, 3]
        joints = self.joints + step[:, 6:]
        joints = joints.clamp(hand.lower.to(position), hand.upper.to(position))
        position = position + matvec(rotation, step[:, :3])
        turned = rotation @ rotation_from_vector(step[:, 3:6])
        return Configuration(joints, rigid(turned, position))


class ResidualRows(NamedTuple):
    """k residuals of each of g hand configurations, and what their Jacobian is computed from.

    The hand has q motions: three translations, three rotations, and those of the moved joints. The
    derivative of a residual by a motion is `wrench` times the motion's twist
    (`SpatialJacobian.twists`) times `moves`.
    """

    # weighted lengths [mm], or weighted errors of the cosines between pads and surface
    residual: Float[Tensor, "g k"]
    # derivatives of each residual by a translation [m] (3) and a rotation [rad] about the object's
    # origin (3)
    wrench: Float[Tensor, "g k 6"]
    # (g, k, q): 1 where a motion moves the link of a residual, else 0. For a residual between two
    # links: that of the second link minus that of the first, so 1, 0 or -1.
    moves: Float[Tensor, "*g k q"]


@dataclasses.dataclass(frozen=True)
class SpatialJacobian(Value):
    """The kinematics of a hand at g configurations, from which Jacobians are computed. All is in
    the object's frame.

    Letters in shapes: l links, s collision spheres, f fingertips, and q motions of the hand. The
    motions are three translations, three rotations, and those of the moved joints. A step has d = 6
    + h numbers, for the pose and the h actuated joints.
    """

    hand: Hand  # the hand
    obj_from_link: Float[Tensor, "3 4 l g"]  # poses (3 x 4) [m] of the links
    spheres: Float[Tensor, "3 s g"]  # centres [m] of the collision spheres
    tips: Float[Tensor, "3 f g"]  # centres [m] of the fingertips
    pads: Float[Tensor, "3 f g"]  # outward unit normals of the fingertips' pads
    # velocity at the object's origin (3) and rotation (3) that each motion causes
    twists: Float[Tensor, "6 q g"]

    @classmethod
    def at(cls, hand: Hand, configuration: Configuration) -> "SpatialJacobian":
        """Return the kinematics of a `hand` at g configurations, in the frame of their poses: the
        object's.
        """
        root = configuration.obj_from_hand[:, :3].permute(1, 2, 0)
        frames = hand.tree.frames(hand.actuated.couple(configuration.joints).T.contiguous(), root)
        spheres, tips, pads, origins, turning, sliding = hand.motion.place(frames)
        twists = torch.cat([torch.linalg.cross(origins, turning, dim=0) + sliding, turning])
        return cls(hand, frames, spheres, tips, pads, twists)

    def points(
        self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]
    ) -> Float[Tensor, "g k 3"]:
        """Return the positions (g, k, 3) [m] in the object's frame of k points on the hand's links.

        `links` (k,) are the indices of their links, and `local` [m] their positions in the frames
        of these links.
        """
        return map_points(self.obj_from_link.index_select(2, links), local).permute(2, 1, 0)

    @property
    def sphere_centres(self) -> Float[Tensor, "g s 3"]:
        """Centres [m] of the hand's collision spheres in the object's frame."""
        return self.spheres.permute(2, 1, 0)

    def jacobian(
        self, wrench: Float[Tensor, "g k 6"], moves: Float[Tensor, "*g k q"]
    ) -> Float[Tensor, "g k d"]:
        """Return the derivatives of k residuals of each configuration by its d = 6 + h unknowns.
        These are the hand's translation [m], its rotation [rad], then the h actuated joints [rad or
        m].

        Translation is along the axes of the hand's root link, and rotation about them.

        `wrench` holds the residuals' derivatives by a translation [m] and a rotation [rad] about
        the object's origin. `moves` is 1 where a motion moves the link of a residual, else 0. For a
        residual between two links it is that of the second minus that of the first. Its axis g may
        be missing.
        """
        by_motion = (wrench @ self.twists.permute(2, 0, 1)) * moves
        coupling = self.hand.motion.coupling
        return by_motion if coupling is None else by_motion @ coupling.to(by_motion)


def differentiate(spatial: SpatialJacobian, parts: Sequence[ResidualRows]) -> Residuals:
    """Return the residuals (g, m) of g hands, joined from several groups, then their Jacobian (g,
    m, 6 + h).

    `parts` are the groups, in the order of the result. The m residuals are weighted. They are
    lengths [mm], or errors of the cosines between pads and surface. The Jacobian is by the hand's
    translation [m] and rotation [rad], then by the h actuated joints [rad or m]. Translation is
    along the axes of the hand's root link, and rotation about them. `spatial` holds the kinematics
    of the hands.
    """
    residual, wrench, moves = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    return residual, spatial.jacobian(wrench, moves)
