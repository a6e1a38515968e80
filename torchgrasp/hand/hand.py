"""The hand as a value: joints, fingers, pads, coupling; where its links and fingertips are and how they move."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument
from torchgrasp.hand.cover import SphereCover
from torchgrasp.hand.kinematics import Kinematics
from torchgrasp.hand.selfcollide import SelfCollision


class Actuator(NamedTuple):
    """Drive of one joint: largest torque [N m], largest speed [rad/s], stiffness [N m/rad], damping [N m s/rad]."""

    effort: float
    velocity: float
    kp: float
    kd: float


@dataclasses.dataclass(frozen=True)
class Hand(Value):
    """A robot hand with three grasping fingers; positions are in the frame of the palm (the URDF's root) in metres.

    `joints` (.., h) below are always the actuated joints of the grasping fingers, in the order of `joint_names`, with
    `lower` and `upper` as limits [rad]. Coupled joints follow them, and the other joints are parked:
    `all joints = coupling @ joints + offset`, in the order of `urdf_joint_names`. Fingers are in grasp order. Every
    method refuses joints of another count or dtype, or that are not finite, with `BadArgument`.

    `contact`, `normal` and `center` [m] are the pads in the frames of `tip_links`, `approach` points out of the palm,
    `axis`, `prismatic` and `child` (an index into `link_names`) describe the joints of the URDF, `moves` tells which
    of them move a link, and `sha256` is that of both files.
    """

    name: str
    option: str
    urdf_path: Path
    sha256: str
    joint_names: tuple[str, ...]
    lower: Float[Tensor, " h"]
    upper: Float[Tensor, " h"]
    finger_names: tuple[str, str, str]
    tip_links: tuple[str, str, str]
    urdf_joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, " j"]
    approach: Float[Tensor, "3"]
    tip_index: Int[Tensor, "3"]
    contact: Float[Tensor, "3 3"]
    normal: Float[Tensor, "3 3"]
    center: Float[Tensor, "3 3"]
    tip_radius: Float[Tensor, "3"]
    axis: Float[Tensor, "j 3"]
    prismatic: Float[Tensor, " j"]
    child: Int[Tensor, " j"]
    moves: Float[Tensor, "l j"]
    actuators: dict[str, Actuator]
    collision_spheres: SphereCover
    self_collision: SelfCollision
    kinematics: Kinematics = dataclasses.field(repr=False)

    @property
    def dof(self) -> int:
        """Count the actuated joints, h."""
        return len(self.joint_names)

    def check_joints(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b h"]:
        """Return `joints` if they are finite and within the limits.

        Raises:
            BadArgument: with the first joint's name, value and limits.
        """
        self._check(joints)
        low, high = self.lower.to(joints), self.upper.to(joints)
        # the limits are rounded to the dtype of the joints, and so may the joints be
        wrong = ~((joints >= low - 1e-6) & (joints <= high + 1e-6))
        if bool(wrong.any()):
            *_, j = first = torch.nonzero(wrong)[0].tolist()
            found = f"{joints[tuple(first)].item():.6g} for {self.joint_names[j]}"
            raise BadArgument("joints", found, f"[{self.lower[j].item():.6g}, {self.upper[j].item():.6g}]")
        return joints

    def expand(self, joints: Float[Tensor, "*b h"]) -> dict[str, Float[Tensor, "*b"]]:
        """Return every movable joint of the URDF by name: actuated, coupled and parked."""
        return dict(zip(self.urdf_joint_names, self.expand_joints(joints).unbind(-1), strict=True))

    def expand_joints(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b j"]:
        """Return every movable joint of the URDF in the order of `urdf_joint_names`."""
        self._check(joints)
        return joints @ self.coupling.to(joints).T + self.offset.to(joints)

    def link_poses(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b l 4 4"]:
        """Return `hand_from_link` of every link, in the order of `link_names`."""
        values = self.expand_joints(joints)
        poses = self.kinematics.poses(values.reshape(-1, values.shape[-1]))
        return poses.reshape(*joints.shape[:-1], *poses.shape[1:])

    def fingertips(self, joints: Float[Tensor, "*b h"]) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3 3"]]:
        """Return the contact points [m] on the three pads and their outward unit normals (the pads' axes).

        >>> from torchgrasp.hand.load import load_hand
        >>> points, normals = load_hand("allegro").fingertips(torch.zeros(5, 12))
        >>> points.shape, normals.shape
        (torch.Size([5, 3, 3]), torch.Size([5, 3, 3]))
        """
        tips = self.link_poses(joints)[..., self.tip_index, :, :]
        return _map(tips, self.contact.to(tips)), _turn(tips, self.normal.to(tips))

    def tip_centres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b 3 3"]:
        """Return the centres [m] of the tips' spheres of `tip_radius`; the contact points where the radius is 0."""
        poses = self.link_poses(joints)
        return _map(poses[..., self.tip_index, :, :], self.center.to(poses))

    def jacobian(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b 3 3 h"]:
        """Return the derivative of the contact points by the actuated joints, coupling included [m/rad].

        The axes are: finger, coordinate, joint.
        """
        poses = self.link_poses(joints)
        points = _map(poses[..., self.tip_index, :, :], self.contact.to(poses))
        return self.point_jacobian(poses, self.tip_index, points)

    def point_jacobian(
        self, poses: Float[Tensor, "*b l 4 4"], link_index: Int[Tensor, " p"], points: Float[Tensor, "*b p 3"]
    ) -> Float[Tensor, "*b p 3 h"]:
        """Return the derivative of points fixed to links by the actuated joints [m/rad].

        Args:
            poses: `link_poses` of the posture.
            link_index: the link each point is fixed to, an index into `link_names`.
            points: where the points are now, in the palm's frame [m].
        """
        axes, origins = self.screws(poses)
        arm = points[..., None, :, :] - origins[..., :, None, :]
        column = torch.linalg.cross(axes[..., :, None, :].expand_as(arm), arm)
        slide = self.prismatic.to(poses)[:, None, None]
        column = column * (1 - slide) + axes[..., :, None, :] * slide
        column = column * self.moves[link_index].T.to(poses)[:, :, None]
        return torch.einsum("...jpi,jh->...pih", column, self.coupling.to(poses))

    def spheres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b s 3"]:
        """Return the centres [m] of `collision_spheres` in the palm's frame."""
        cover, poses = self.collision_spheres, self.link_poses(joints)
        return _map(poses[..., cover.link_index, :, :], cover.center.to(poses))

    def self_clearance(self, joints: Float[Tensor, "*b h"], chunk: int = 512) -> Float[Tensor, "*b"]:
        """Return the signed least distance [m] between links that can meet; negative: they overlap.

        Parked fingers and the palm are included; the pairs are those of hand.toml. Rows are taken in chunks, which
        bounds the memory and keeps the work in the cache.
        """
        self._check(joints)
        rows = joints.reshape(-1, joints.shape[-1])
        parts = [self.self_collision.clearance(self.link_poses(part)) for part in rows.split(chunk)]
        return torch.cat(parts).reshape(joints.shape[:-1]) if parts else rows.new_zeros(joints.shape[:-1])

    def screws(self, poses: Float[Tensor, "*b l 4 4"]) -> tuple[Float[Tensor, "*b j 3"], Float[Tensor, "*b j 3"]]:
        """Return the axes and origins of all movable joints in the palm's frame."""
        frames = poses[..., self.child, :, :]
        return _turn(frames, self.axis.to(poses)), frames[..., :3, 3]

    def _check(self, joints: Tensor) -> None:
        """Refuse joints of another count or dtype, and numbers that are none, before any work."""
        if joints.ndim < 1 or joints.shape[-1] != self.dof:
            raise BadArgument("joints", f"shape {tuple(joints.shape)}", f"{self.dof} joints last: {self.joint_names}")
        if joints.dtype not in (torch.float32, torch.float64):
            raise BadArgument("joints", str(joints.dtype), "torch.float32 or torch.float64")
        finite = torch.isfinite(joints)
        if not bool(finite.all()):
            first = torch.nonzero(~finite)[0].tolist()
            found = f"{joints[tuple(first)].item()} for {self.joint_names[first[-1]]}"
            raise BadArgument("joints", found, "finite numbers")


def _map(poses: Float[Tensor, "*b p 4 4"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "*b p 3"]:
    """Map one point per pose into the palm's frame."""
    return _turn(poses, local) + poses[..., :3, 3]


def _turn(poses: Float[Tensor, "*b p 4 4"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "*b p 3"]:
    """Map one direction per pose into the palm's frame."""
    x, y, z = local[:, :, None].unbind(1)  # many small matrix products are slower than three long sums
    return poses[..., :3, 0] * x + poses[..., :3, 1] * y + poses[..., :3, 2] * z
