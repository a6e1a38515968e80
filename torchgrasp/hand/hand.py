"""The hand as a value: joints, fingers, pads, coupling; where its links and fingertips are and how they move."""

import dataclasses
import functools
import math
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument
from torchgrasp.hand.collision_spheres import CollisionSpheres
from torchgrasp.hand.kinematics import Kinematics, placed, turned
from torchgrasp.hand.self_collision import SelfCollision


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
    of them move a link, and `sha256` is that of both files. `fingers` is that part of the tree which leads to the
    last links that joints move, `tip_place` where those that carry the tips stand in it, and `tip_pose` each tip's
    frame in its carrier's.
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
    collision_spheres: CollisionSpheres
    self_collision: SelfCollision
    tip_place: Int[Tensor, "3"]
    tip_pose: Float[Tensor, "3 4 3 1"]
    kinematics: Kinematics = dataclasses.field(repr=False)
    fingers: Kinematics = dataclasses.field(repr=False)

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

    def frames(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "3 4 l n"]:
        """Return `link_poses` without their last row, all postures in one last axis: the fast layout."""
        return self.kinematics.frames(self._columns(joints))

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
        tips = self._tips(self._columns(joints))[1]
        contact, normal, _ = self._pads
        return _rows(placed(tips, contact), joints), _rows(turned(tips, normal), joints)

    def tip_centres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b 3 3"]:
        """Return the centres [m] of the tips' spheres of `tip_radius`; the contact points where the radius is 0."""
        return _rows(placed(self._tips(self._columns(joints))[1], self._pads[2]), joints)

    def jacobian(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b 3 3 h"]:
        """Return the derivative of the contact points by the actuated joints, coupling included [m/rad].

        The axes are: finger, coordinate, joint.
        """
        frames, tips = self._tips(self._columns(joints))
        return _rows(self._derivative(self.fingers, frames, self.tip_index, placed(tips, self._pads[0])), joints)

    def point_jacobian(
        self, poses: Float[Tensor, "*b l 4 4"], link_index: Int[Tensor, " p"], points: Float[Tensor, "*b p 3"]
    ) -> Float[Tensor, "*b p 3 h"]:
        """Return the derivative of points fixed to links by the actuated joints [m/rad].

        Args:
            poses: `link_poses` of the posture.
            link_index: the link each point is fixed to, an index into `link_names`.
            points: where the points are now, in the palm's frame [m].
        """
        columns = points.reshape(-1, *points.shape[-2:]).permute(2, 1, 0)
        found = self._derivative(self.kinematics, _frames(poses), link_index, columns)
        return _rows(found, points[..., 0, :])

    def _columns(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "j n"]:
        """Return every movable joint of the URDF, all postures in the last axis."""
        values = self.expand_joints(joints)
        return values.reshape(-1, values.shape[-1]).T.contiguous()

    @functools.cached_property
    def _pads(self) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"], Float[Tensor, "3 3"]]:
        """The pads' contact points and normals and the tips' centres in the frames of the links that carry the tips."""
        pose = self.tip_pose
        contact, center = (placed(pose, x)[..., 0].T for x in (self.contact, self.center))
        return contact, turned(pose, self.normal)[..., 0].T, center

    def _tips(self, values: Float[Tensor, "j n"]) -> tuple[Float[Tensor, "3 4 l n"], Float[Tensor, "3 4 3 n"]]:
        """Return the frames of the links that lead to the tips, and those of the links that carry the tips."""
        frames = self.fingers.frames(values)
        return frames, frames.index_select(2, self.tip_place)

    def _derivative(
        self,
        tree: Kinematics,
        frames: Float[Tensor, "3 4 l n"],
        link_index: Int[Tensor, " p"],
        points: Float[Tensor, "3 p n"],
    ) -> Float[Tensor, "h 3 p n"]:
        """Return the derivative of points: of each by the joints between its link and the palm alone."""
        acts = self.moves[link_index][:, :, None] * self.coupling  # on a point, through a joint, by an actuated joint
        point, joint, actuated = torch.nonzero(acts, as_tuple=True)
        link, ratio = tree.child[joint], self.coupling.to(points)[joint, actuated][:, None]
        axes = turned(frames, tree.axis).index_select(1, link) * ratio
        arm = points.index_select(1, point) - frames[:, 3].index_select(1, link)
        (ax, ay, az), (x, y, z) = axes, arm
        column = torch.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x])
        if tree.slides:
            column = torch.where(self.prismatic[joint][:, None] > 0, axes, column)
        size = (3, points.shape[1] * self.dof, points.shape[2])
        summed = points.new_zeros(size).index_add(1, point * self.dof + actuated, column)
        return summed.unflatten(1, (-1, self.dof)).movedim(2, 0)

    def spheres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b s 3"]:
        """Return the centres [m] of `collision_spheres` in the palm's frame."""
        cover = self.collision_spheres
        return _rows(placed(self.frames(joints).index_select(2, cover.link_index), cover.center), joints)

    def self_clearance(
        self, joints: Float[Tensor, "*b h"], below: float = math.inf, chunk: int = 1000
    ) -> Float[Tensor, "*b"]:
        """Return the signed least separation [m] between links that can meet; negative: they overlap.

        The links are the collision shapes of the URDF, parked fingers and the palm included, and the pairs those of
        hand.toml. Where links overlap it is how far two must move to part, and where they face one another it is their
        distance; corner to corner it is less.

        Args:
            joints: postures [rad].
            below: only values below this [m] are wanted, others may be any larger number: 0 for a verdict alone takes
                half the time.
            chunk: rows taken at a time, which bounds the memory and keeps the work in the cache.
        """
        self._check(joints)
        rows = joints.reshape(-1, joints.shape[-1])
        parts = [self.self_collision.clearance(self.frames(part), below) for part in rows.split(chunk)]
        return torch.cat(parts).reshape(joints.shape[:-1]) if parts else rows.new_zeros(joints.shape[:-1])

    def jacobians(self, poses: Float[Tensor, "*b l 4 4"]) -> tuple[Float[Tensor, "*b j 3"], Float[Tensor, "*b j 3"]]:
        """Return the axes and origins of all movable joints in the palm's frame."""
        chains = _frames(poses).index_select(2, self.child)
        like = poses[..., 0, 0, :]
        return _rows(turned(chains, self.axis), like), _rows(chains[:, 3], like)

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


def _frames(poses: Float[Tensor, "*b l 4 4"]) -> Float[Tensor, "3 4 l n"]:
    """Return the first three rows of poses with all postures in one last axis."""
    return poses.reshape(-1, *poses.shape[-3:])[..., :3, :].permute(2, 3, 1, 0)


def _rows(columns: Tensor, like: Float[Tensor, "*b h"]) -> Tensor:
    """Return what was computed for all postures in one last axis with its axes reversed, as the rows of `like`."""
    return columns.permute(*range(columns.ndim - 1, -1, -1)).reshape(*like.shape[:-1], *columns.shape[-2::-1])
