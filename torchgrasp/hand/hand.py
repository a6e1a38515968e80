"""A robot hand: joints, kinematic tree, fingertips, and their kinematics."""

import copy
import dataclasses
import functools
import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import Value, changes_in_place, kept, named_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import pytorch_kinematics
from torchgrasp.foundation.rules import Count, Range, check_moved
from torchgrasp.hand.collision_shapes import CollisionSpheres
from torchgrasp.hand.fingers import ActuatedJoints, Fingertips
from torchgrasp.hand.kinematics import (
    FreeMotion,
    KinematicTree,
    chain_poses,
    map_directions,
    map_points,
)
from torchgrasp.hand.self_collision import SelfCollision


class Actuator(NamedTuple):
    """The drive of one joint; `Hand.actuators` has that of each movable joint.

    A sliding joint has [N] and [m] in place of [N m] and [rad].

    Attributes:
        effort: greatest torque [N m]; 0 if the URDF gives none.
        velocity: greatest speed [rad/s]; 0 if the URDF gives none.
        kp: stiffness of the position control [N m/rad].
        kd: damping of the position control [N m s/rad].

    >>> from torchgrasp import load_hand
    >>> load_hand("barrett").actuators["f1_flex"].effort
    4.7
    """

    effort: float
    velocity: float
    kp: float
    kd: float


class HandSource(NamedTuple):
    """The files of a hand, and how its grasping fingers were chosen.

    Attributes:
        option: name of the option, an entry of hand.toml that lists the grasping fingers. If they
            were chosen by name, it is their names with commas between.
        urdf_path: path of the URDF.
        sha256: one SHA-256 of both files, hand.toml and the URDF.
        options: names of all options of hand.toml.

    >>> from torchgrasp import load_hand
    >>> load_hand("allegro").source.options
    ('default', 'four', 'paper_literal')
    """

    option: str
    urdf_path: Path
    sha256: str
    options: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Hand(Value):
    """A robot hand with three to five grasping fingers; `load_hand` returns it.

    Positions [m] are in the palm's frame, the frame of the URDF's root link. Grasping fingers are
    always in the order of `finger_names`: finger i touches contact i of a grasp.

    In the methods, `joints` (*b, h) are positions of the h actuated joints, in the order of
    `joint_names`. Their unit is [rad], or [m] for sliding joints. Here f counts the fingertips, j
    all movable joints of the URDF, l its links, and s the collision spheres. `*b` stands for any
    batch axes. Methods raise `BadArgument` for joints of a wrong count or dtype, and for NaN or
    infinity. They also raise it for a hand whose tensors were changed in place, as by
    `hand.upper[0] = 1`.

    Attributes:
        name: name of the hand.
        source: the files of the hand, and how its grasping fingers were chosen.
        actuated: names, limits and coupling of the actuated joints.
        chain: the model as a chain of pytorch-kinematics, in which every movable joint is
            independent. `tree` and `tips` are compiled from its tensors, so do not change it in
            place.
        tree: the kinematic tree: names of links and joints, and forward kinematics.
        tips: the fingertips and their pads, the parts that touch objects.
        approach: unit vector (3,) out of the palm, along which the hand approaches objects.
        actuators: the drive of every movable joint of the URDF, by the joint's name.
        collision_spheres: spheres that cover the links.
        self_collision: shapes of the links, and the pairs of shapes that must not collide.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> q = (hand.lower + hand.upper) / 2
    >>> hand.fingertips(q)[0].shape, hand.tip_centres(q).shape, hand.jacobian(q).shape
    (torch.Size([3, 3]), torch.Size([3, 3]), torch.Size([3, 3, 4]))
    >>> hand.link_poses(q).shape, hand.sphere_centres(q).shape, hand.expand_joints(q).shape
    (torch.Size([12, 4, 4]), torch.Size([117, 3]), torch.Size([8]))
    >>> hand.chain.forward_kinematics(hand.expand(q[None]))["f3_tip"].get_matrix().shape
    torch.Size([1, 4, 4])
    """

    name: str
    source: HandSource
    actuated: ActuatedJoints
    chain: "pytorch_kinematics.chain.Chain" = dataclasses.field(repr=False, compare=False)
    tree: KinematicTree = dataclasses.field(repr=False)
    tips: Fingertips = dataclasses.field(repr=False)
    approach: Float[Tensor, "3"]
    actuators: dict[str, Actuator]
    collision_spheres: CollisionSpheres = dataclasses.field(repr=False)
    self_collision: SelfCollision = dataclasses.field(repr=False)

    def __post_init__(self) -> None:
        """Record the tensors as they are now (`_versions`)."""
        _ = self._versions

    @property
    def urdf_path(self) -> Path:
        """The path of the hand's URDF."""
        return self.source.urdf_path

    def to(self, *args: Any, **kwargs: Any) -> "Hand":
        """Return the hand on another device or in another floating dtype.

        The arguments are those of `torch.Tensor.to`. A hand that is already there is returned as it
        is. Raises `BadArgument` if the device does not exist, or the dtype is neither float32 nor
        float64.
        """
        check_moved(*args, **kwargs)
        if self.lower.to(*args, **kwargs) is self.lower:
            return self
        moved = super().to(*args, **kwargs)
        chain = copy.deepcopy(self.chain).to(dtype=moved.lower.dtype, device=moved.lower.device)
        return dataclasses.replace(moved, chain=chain)

    @kept
    def motion(self) -> FreeMotion:
        """Matrices that tell how collision spheres, fingertips and pad normals move in a small step
        of the hand's pose and joints.

        It is a cached property that only inverse kinematics uses, as in `solve_ik`. Its class
        `FreeMotion` is not public.
        """
        spheres = self.collision_spheres
        tips = self.tips
        points = (spheres.link_index, spheres.center, 1.0), (tips.index, tips.center, 1.0)
        return FreeMotion.of(
            self.tree, self.actuated.coupling, [*points, (tips.index, tips.normal, 0.0)]
        )

    @property
    def derived(self) -> dict[Any, Any]:
        """A dict in which torchgrasp caches what it computes from the hand, such as the result of
        `hand_abilities`.
        """
        self._check_unchanged()
        return self._derived

    @functools.cached_property
    def _derived(self) -> dict[Any, Any]:
        """The content of `derived`."""
        return {}

    @functools.cached_property
    def _versions(self) -> tuple[tuple[Tensor, ...], int]:
        """The hand's tensors, and how often they had been changed in place when this was computed."""
        tensors = tuple(named_tensors(self).values())
        return tensors, changes_in_place(*tensors)

    def _check_unchanged(self) -> None:
        """Raise `BadArgument` if a tensor of the hand was changed in place: cached values would
        still be those of the old one.
        """
        if torch.compiler.is_compiling():
            return
        tensors, changes = self._versions
        if changes_in_place(*tensors) != changes:
            allowed = "a hand as it was made: change a copy, or make another by dataclasses.replace"
            raise BadArgument("hand", f"{self.name}, changed in place", allowed)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the h actuated joints, in the order of every tensor of joints."""
        return self.actuated.names

    @property
    def finger_names(self) -> tuple[str, ...]:
        """The names of the f grasping fingers; finger i touches contact i of a grasp."""
        return self.tips.names

    @property
    def tip_radius(self) -> Float[Tensor, "f"]:
        """The radii (f,) [m] of the fingertips' spheres; 0 for a flat or pointed tip."""
        return self.tips.radius

    @property
    def dof(self) -> int:
        """The number h of actuated joints."""
        return len(self.actuated.names)

    @property
    def lower(self) -> Float[Tensor, " h"]:
        """The lower limits (h,) [rad, or m for a sliding joint] of the actuated joints."""
        return self.actuated.lower

    @property
    def upper(self) -> Float[Tensor, " h"]:
        """The upper limits (h,) [rad, or m for a sliding joint] of the actuated joints."""
        return self.actuated.upper

    @checked
    def require_three(self, argument: str, what: str) -> None:
        """Raise `BadArgument` unless the hand has exactly three grasping fingers.

        Functions call it for options that exist for three fingertips only.

        Args:
            argument: name of the option in the text of the error.
            what: value of the option in the text of the error.
        """
        if len(self.tips) != 3:
            raise BadArgument(
                argument,
                f"{what} for {len(self.tips)} fingertips",
                "three fingertips, as in the paper",
            )

    @checked(gradients=True)
    def check_joints(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b h"]:
        """Return `joints` (*b, h) [rad or m] unchanged if all are within their limits.

        Otherwise raise `BadArgument`, which names the first joint beyond its limits.

        >>> from torchgrasp import load_hand
        >>> hand = load_hand("barrett")
        >>> hand.check_joints(hand.upper + 1)
        Traceback (most recent call last):
            ...
        torchgrasp.foundation.errors.BadArgument: joints: expected a number in [0, 3.14159], got
        4.14159 for spread
        """
        self._check_unchanged()
        self.actuated.check_limits(joints)
        return joints

    @checked(gradients=True)
    def expand(self, joints: Float[Tensor, "*b h"]) -> dict[str, Float[Tensor, "*b"]]:
        """Return a dict of the positions (*b,) [rad or m] of all movable joints of the URDF, by
        name.

        It also has the joints of fingers that do not grasp.

        Args:
            joints: positions (*b, h) [rad or m] of the actuated joints.

        Raises `BadArgument` for joints of a wrong count, dtype or device, and for NaN or infinity.

        >>> from torchgrasp import load_hand
        >>> from torchgrasp.data.shipped import load_shipped_grasp
        >>> len(load_hand("allegro").expand(load_shipped_grasp("jug", "allegro").joints[0]))
        16
        """
        return dict(zip(self.tree.joint_names, self.expand_joints(joints).unbind(-1), strict=True))

    @checked(gradients=True)
    def expand_joints(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b j"]:
        """Return the positions (*b, j) [rad or m] of all j movable joints of the URDF.

        They are in the order of `tree.joint_names`. `joints` (*b, h) [rad or m] are positions of
        the actuated joints. Raises `BadArgument` for joints of a wrong count, dtype or device, and
        for NaN or infinity.
        """
        self._check_unchanged()
        return self.actuated.expand(joints)

    @checked(gradients=True)
    def link_poses(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b l 4 4"]:
        """Return the poses `hand_from_link` (*b, l, 4, 4) [m] of the l links in the palm's frame.

        Links are in the order of `tree.link_names`. `joints` (*b, h) [rad or m] are positions of
        the actuated joints.
        """
        values = self.expand_joints(joints)
        poses = self.tree.poses(values.reshape(-1, values.shape[-1]))
        return poses.reshape(*joints.shape[:-1], *poses.shape[1:])

    @checked(gradients=True)
    def fingertips(
        self,
        joints: Float[Tensor, "*b h"],
        backend: Literal["torchgrasp", "pytorch_kinematics"] = "torchgrasp",
    ) -> tuple[Float[Tensor, "*b f 3"], Float[Tensor, "*b f 3"]]:
        """Return (points, normals) of the f pads, the parts of the fingertips that touch objects:
        contact points [m] and outward unit normals.

        Both are (*b, f, 3), in the palm's frame, that of the hand's root link.

        Args:
            joints: positions (*b, h) [rad or m] of the actuated joints.
            backend: what computes the forward kinematics. "torchgrasp" is this library's own, which
                all other methods use. "pytorch_kinematics" is that package, with the hand's
                `chain`, as an independent check. The results agree up to rounding.

        Raises `BadArgument` for joints of a wrong count, or another `backend`.
        """
        if backend == "torchgrasp":
            _, frames = self.tips.frames(self._columns(joints))
            contact, normal, _ = self.tips.in_carriers
        else:
            poses = chain_poses(self.chain, self.tree.joint_names, self._columns(joints))
            links = [self.chain.frame_to_idx[link] for link in self.tips.links]
            frames = poses[links, :, :3].permute(2, 3, 0, 1).to(joints)
            contact = self.tips.contact
            normal = self.tips.normal
        points = map_points(frames, contact)
        normals = map_directions(frames, normal)
        return _rows(points, joints), _rows(normals, joints)

    @checked(gradients=True)
    def tip_centres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b f 3"]:
        """Return the centres (*b, f, 3) [m] of the fingertips' spheres in the palm's frame.

        A tip of radius 0 gives its contact point. `joints` (*b, h) [rad or m] are positions of the
        actuated joints.
        """
        _, carriers = self.tips.frames(self._columns(joints))
        return _rows(map_points(carriers, self.tips.in_carriers[2]), joints)

    @checked(gradients=True)
    def jacobian(
        self, joints: Float[Tensor, "*b h"], at: Float[Tensor, "*b f 3"] | None = None
    ) -> Float[Tensor, "*b f 3 h"]:
        """Return the Jacobian (*b, f, 3, h) of a point on each fingertip with respect to the
        actuated joints.

        It is in the palm's frame. Its unit is [m/rad]; columns of sliding joints have none.

        Args:
            joints: positions (*b, h) [rad or m] of the actuated joints.
            at: points (*b, f, 3) [m] in the palm's frame, each fixed to its fingertip. None means
                the contact points of the pads, the parts of the fingertips that touch objects.
        """
        chains = self.tips.chains
        frames, carriers = self.tips.frames(self._columns(joints))
        if at is None:
            contact = map_points(carriers, self.tips.in_carriers[0])
        else:
            contact = at.reshape(-1, len(self.tips), 3).permute(2, 1, 0)
        # a finger's contact moves with the joints above it, and they with the actuated joints
        coupling = self.actuated.coupling
        moves = self.tree.moves[self.tips.index][:, :, None] * coupling  # (f, j, h)
        finger, joint, actuated = torch.nonzero(moves, as_tuple=True)
        ratio = coupling.to(contact)[joint, actuated][:, None]
        child = frames.index_select(2, chains.child[joint])
        axes = map_directions(child, chains.axis[joint]) * ratio
        ax, ay, az = axes
        x, y, z = contact.index_select(1, finger) - child[:, 3]
        column = torch.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x])
        if chains.slides:
            slides = self.tree.prismatic[joint][:, None] > 0
            column = torch.where(slides, axes, column)
        f = len(self.tips)
        summed = contact.new_zeros(3, f * self.dof, contact.shape[2])
        summed = summed.index_add(1, finger * self.dof + actuated, column)
        summed = summed.unflatten(1, (f, self.dof)).movedim(2, 0)
        return _rows(summed, joints)

    @checked(gradients=True)
    def sphere_centres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b s 3"]:
        """Return the centres (*b, s, 3) [m] of the s `collision_spheres` in the palm's frame.

        `joints` (*b, h) [rad or m] are positions of the actuated joints.
        """
        spheres = self.collision_spheres
        frames = self.tree.frames(self._columns(joints)).index_select(2, spheres.link_index)
        return _rows(map_points(frames, spheres.center), joints)

    @checked(gradients=True)
    def self_clearance(
        self,
        joints: Float[Tensor, "*b h"],
        below: Annotated[float, Range(-math.inf, math.inf)] = math.inf,
        chunk: Count = 1000,
    ) -> Float[Tensor, "*b"]:
        """Return the least signed separation (*b,) [m] of the pairs of links in `self_pairs`.

        A negative value means overlap: it is minus the shortest translation that separates two
        links. A positive value is a lower bound of the distance. It is exact if the nearest point
        of one of the two shapes lies on a face. It is infinite if no pair is tested.

        Args:
            joints: positions (*b, h) [rad or m] of the actuated joints.
            below: separation [m] up to which results are needed. Where the separation is greater,
                the result is any number of at least `below`, or infinity. A small `below` saves
                time.
            chunk: number of postures that are computed at a time, which bounds the memory.

        Raises `BadArgument` for joints of a wrong count, or a `chunk` below 1.
        """
        self.actuated.check(joints)
        rows = joints.reshape(-1, joints.shape[-1])
        frames = (self.tree.frames(self._columns(part)) for part in rows.split(chunk))
        found = [self.self_collision.clearance(x, below) for x in frames]
        return torch.cat(found).reshape(joints.shape[:-1])

    @property
    def self_pairs(self) -> tuple[tuple[str, str], ...]:
        """The names of the two links of each pair that `self_clearance` tests for collision."""
        names = self.tree.link_names
        return tuple((names[one], names[two]) for one, two in self.self_collision.link_pairs())

    def _columns(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "j n"]:
        """Return the positions [rad or m] of all movable joints as columns: one posture in each."""
        values = self.expand_joints(joints)
        return values.reshape(-1, values.shape[-1]).T.contiguous()


def _rows(columns: Tensor, joints: Float[Tensor, "*b h"]) -> Tensor:
    """Return a tensor with reversed axes, so that postures come first, in the batch shape of
    `joints`.
    """
    rows = columns.permute(tuple(range(columns.ndim))[::-1])
    return rows.reshape(*joints.shape[:-1], *rows.shape[1:])
