"""A robot arm that carries a hand: its chain of joints, its collision spheres, and random postures
to start from.

A posture is one position of each of the n joints, from the base to the tip. Positions are in [rad],
or in [m] for sliding joints. The tip is the link that carries the hand.
"""

import dataclasses
import math
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.data.accept import HandLike, as_hand
from torchgrasp.foundation.base import Value, flatnonzero, row_numbers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Pose, Seed
from torchgrasp.geometry.frames import apply, inverse, real
from torchgrasp.geometry.linalg import norm
from torchgrasp.hand.collision_shapes import ALWAYS, cover
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import KinematicTree, map_directions, map_points, tree_from_urdf
from torchgrasp.hand.urdf import Urdf, read_published
from torchgrasp.ik.clearance import MILLIMETRE
from torchgrasp.ik.motion import APPROACH_DISTANCE

# distance [mm] as which a rotation by one radian counts: the depth of a hand
LEVER = APPROACH_DISTANCE / MILLIMETRE


@dataclasses.dataclass(frozen=True)
class ArmNumbers:
    """Numbers of an arm's collision spheres and of its library of postures."""

    joints: int = 6
    """Least number of joints that can bring a hand to any pose."""
    postures: int = 1024
    """Number of random postures in the library. They are so many that one brings the tip near to
    any wanted pose.
    """
    tested: int = 200
    """Number of postures in which spheres of two links are tested for overlap. Links that touch in
    nearly all of them do so by construction.
    """
    cell: float = 0.065
    """Edge [m] of the cells into which a link's shape is divided, one sphere for each. With this
    edge, one sphere fills a section of a thin link.
    """
    bulge: float = 0.01
    """Distance [m] by which a sphere may protrude from a shape."""
    mount: float = 1.0
    """Largest distance [m] of a hand from the arm's tip: a larger one is in millimetres."""
    astray: float = 1.0
    """Distance [rad or m] of a joint beyond its limits that no encoder's error explains."""


ARM = ArmNumbers()
TipPoses = Float[Tensor, "3 4 k"]  # poses [m] of the tip in k postures, in the frame of the base


@dataclasses.dataclass(frozen=True)
class Arm(Value):
    """A robot arm that carries a hand; `load_arm` makes it. `plan_grasps(arm=)` keeps the grasps
    that the arm reaches.

    n counts the arm's joints, from the base to the tip. The tip is the link that carries the hand.
    A posture holds one position of each joint [rad, or m for sliding joints]. Tensors are in
    float64 on the CPU.

    Attributes:
        urdf: the parsed chain from base to tip, with tuples of its `links` and `joints`.
        tree: forward kinematics of this chain.
        lower: lower limits (n,) of the joints [rad or m].
        upper: upper limits (n,) of the joints [rad or m].
        speed: greatest speed (n,) of each joint [rad/s or m/s]. It is pi rad/s if the URDF gives
            none for a turning joint.
        obj_from_base: pose (4, 4) [m] of the arm's root link in the frame of the object and its
            cloud.
        tip_from_hand: pose (4, 4) [m] of the hand's root link in the frame of the tip.
        link: index (s,) in `urdf.links` of the link of each of s collision spheres. First come the
            spheres of the links, then the spheres of the hand's palm, which belong to the tip.
        center: centre (s, 3) [m] of each sphere in the frame of its link.
        radius: radius (s,) [m] of each sphere.
        moving: indices (w,) of the spheres of links that joints move, without the palm. These
            spheres must not touch objects. They must not touch the table either, unless their links
            only slide.
        pairs: indices (p, 2) of the spheres of each pair that must not overlap. Pairs of adjacent
            links, and pairs that overlap by construction, are left out.
        library: m random postures (m, n) [rad or m], from which inverse kinematics starts.
        features: the tip's pose in each posture of the library as twelve numbers (m, 12) [mm]. They
            are its position, then the entries of its rotation matrix times 71 mm. The Euclidean
            distance of two rows is a distance of two poses.
        hand_sha256: SHA-256 of the files of the hand, by which `plan_grasps` recognises it.
    """

    urdf: Urdf = dataclasses.field(repr=False)
    tree: KinematicTree = dataclasses.field(repr=False)
    lower: Float[Tensor, "n"]
    upper: Float[Tensor, "n"]
    speed: Float[Tensor, "n"]
    obj_from_base: Float[Tensor, "4 4"]
    tip_from_hand: Float[Tensor, "4 4"]
    link: Int[Tensor, "s"]
    center: Float[Tensor, "s 3"]
    radius: Float[Tensor, "s"]
    moving: Int[Tensor, "w"]
    pairs: Int[Tensor, "p 2"]
    library: Float[Tensor, "m n"]
    features: Float[Tensor, "m 12"]
    hand_sha256: str

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the n joints, from the base to the tip."""
        return self.tree.joint_names

    @checked
    def moved(self, b_from_a: Pose) -> "Arm":
        """Return the arm for another object frame: only `obj_from_base` changes, and the arm stays
        in place.

        Args:
            b_from_a: rigid transform (4, 4) [m] from the present object frame, a, to the new one,
                b.

        Raises `BadArgument` for a transform that is not rigid.
        """
        return dataclasses.replace(self, obj_from_base=b_from_a.to(self.lower) @ self.obj_from_base)

    @checked
    def hand_poses(self, joints: Float[Tensor, "k n"]) -> Float[Tensor, "k 4 4"]:
        """Return the poses `obj_from_hand` (k, 4, 4) [m] of the hand's root link in k postures.

        They are in the object's frame, that of `obj_from_base`.

        Args:
            joints: positions (k, n) of the arm's n joints [rad, or m for sliding joints].

        Raises `BadArgument` for a joint over 1 rad or 1 m beyond its limits, as one in degrees.
        """
        beyond = torch.maximum(self.lower - joints, joints - self.upper)  # (k, n)
        if bool((beyond > ARM.astray).any()):
            most = beyond.amax(0)
            name = self.joint_names[int(most.argmax())]
            found = f"{name} {float(most.max()):.3g} beyond its limits"
            raise BadArgument("joints", found, "positions in radians, or metres of sliding joints")
        return self.obj_from_base @ self.tree.poses(joints)[:, -1] @ self.tip_from_hand

    @checked
    def tip_poses(self, obj_from_hand: Float[Tensor, "k 4 4"]) -> TipPoses:
        """Return the poses (3, 4, k) [m] of the arm's tip for k given poses of the hand.

        They are in the frame of the arm's root link. The last row (0, 0, 0, 1) of each matrix is
        left out. No inverse kinematics is solved.

        Args:
            obj_from_hand: poses (k, 4, 4) [m] of the hand's root link in the object's frame.
        """
        base_from_hand = inverse(self.obj_from_base) @ obj_from_hand.to(self.lower)
        base_from_tip = base_from_hand @ inverse(self.tip_from_hand)
        return base_from_tip[:, :3].permute(1, 2, 0).contiguous()

    @checked
    def tip_motion(self, joints: Float[Tensor, "n k"]) -> tuple[TipPoses, Float[Tensor, "6 n k"]]:
        """Return (poses, jacobian): the tip's pose and its Jacobian in k postures.

        Both are in the frame of the arm's root link. `poses` (3, 4, k) [m] lack the last row (0, 0,
        0, 1) of each matrix. `jacobian` (6, n, k) [mm/rad, or mm/m for sliding joints] has a column
        for each of the n joints. Rows 0 to 2 are for the position. Rows 3 to 5 are for the rotation
        vector. They are multiplied by a hand's depth of 100 mm (`LEVER`), to have the same unit.

        Args:
            joints: positions (n, k) of the arm's n joints [rad, or m for sliding joints].
        """
        frames = self.tree.frames(joints)
        tip = frames[:, :, -1]
        child = frames.index_select(2, self.tree.child)
        axes = map_directions(child, self.tree.axis)
        slides = self.tree.prismatic[:, None] > 0
        turning = torch.linalg.cross(axes, tip[:, 3, None] - child[:, 3], dim=0)
        place = torch.where(slides, axes, turning)
        turn = torch.where(slides, 0.0, axes)
        return tip, torch.cat([place / MILLIMETRE, LEVER * turn])

    @checked
    def sphere_centres(self, joints: Float[Tensor, "n k"]) -> Float[Tensor, "3 s k"]:
        """Return the centres (3, s, k) [m] of all s collision spheres in k postures, in the
        object's frame.

        Args:
            joints: positions (n, k) of the arm's n joints [rad, or m for sliding joints].
        """
        frames = self.tree.frames(joints.contiguous()).index_select(2, self.link)
        pose = self.obj_from_base
        centres = map_points(frames, self.center)
        turned = (pose[:3, :3] @ centres.flatten(1)).view_as(centres)
        return turned + pose[:3, 3, None, None]

    @checked
    def overlaps(self, centres: Float[Tensor, "3 s k"]) -> Bool[Tensor, "p k"]:
        """Return a mask (p, k): which of the p `pairs` of spheres overlap in each of k postures.

        Args:
            centres: centres (3, s, k) [m] of the spheres, from `sphere_centres`.
        """
        one, two = self.pairs.unbind(1)
        gap = centres.index_select(1, one) - centres.index_select(1, two)
        reach = self.radius[one] + self.radius[two]
        return (gap * gap).sum(0) < reach.square()[:, None]


def features(tip: TipPoses) -> Float[Tensor, "k 12"]:
    """Return twelve numbers [mm] for each of k poses of an arm's tip, by which poses are compared.

    The poses `tip` (3, 4, k) are in metres. The numbers are the position, then the entries of the
    rotation matrix times 71 mm. Their Euclidean distance is a distance of two poses. For small
    rotations it is sqrt(t^2 + (100 r)^2). Here t [mm] is the translation and r [rad] the angle
    between the poses.
    """
    turn = LEVER / math.sqrt(2) * tip[:, :3].flatten(0, 1)
    return torch.cat([tip[:, 3] / MILLIMETRE, turn]).T


@checked
def load_arm(
    urdf: Path | str,
    hand: HandLike,
    tip: str | None = None,
    *,
    obj_from_base: Pose | None = None,
    tip_from_hand: Pose | None = None,
    seed: Seed = 0,
) -> Arm:
    """Read the robot arm that carries a hand from the arm's URDF, for `plan_grasps(arm=)`.

    Args:
        urdf: path of the file. Joint limits are cut to [-2 pi, 2 pi] rad, or m for sliding joints;
            a turning joint without limits gets this range.
        hand: the hand on the arm, or its name, or its folder.
        tip: name of the link that carries the hand. None means the link that the most joints move.
            Of several such links, it means the last one in the file. A robot that branches, as
            one with several fingers or with two arms, needs the name.
        obj_from_base: pose (4, 4) [m] of the arm's root link in the frame of the cloud that is
            planned on. None means the identity.
        tip_from_hand: pose (4, 4) [m] of the hand's root link in the frame of the tip; None means
            the identity.
        seed: seed of the random postures from which inverse kinematics starts.

    Raises:
        HandFileError: a URDF or a hand that is missing or malformed.
        HandFileError: a collision mesh on a link between root and tip;
            `torchgrasp.app.author.clean_arm` replaces meshes.
        HandFileError: a joint between root and tip that mimics another joint.
        HandFileError: a sliding joint between root and tip without limits, or without a velocity.
        BadArgument: no link is named `tip`, fewer than six joints move it, or a pose is not rigid.
        BadArgument: `tip` is None, and the robot branches; or the hand is over 1 m from the tip.

    >>> from torchgrasp import load_hand
    >>> load_arm(load_hand("allegro").urdf_path, "allegro", "thumb_tip")
    Traceback (most recent call last):
        ...
    torchgrasp.foundation.errors.BadArgument: tip: expected a link that at least six joints move,
    got 'thumb_tip'
    """
    hand = as_hand(hand, "hand")
    whole = read_published(urdf)
    named = {link.name: link for link in whole.links}
    if tip is None:
        tip = _last_link(whole, [*named])
    if tip not in named or len(whole.movers(tip)) < ARM.joints:
        raise BadArgument("tip", repr(tip), "a link that at least six joints move")
    turn = 2 * math.pi
    if followers := [joint.name for joint in whole.joints_above(tip) if joint.mimic]:
        raise whole.wrong(
            f"joint {followers[0]} that follows another",
            "joints that each have a drive, up to the tip",
        )
    _check_sliding(whole, tip)
    way = tuple(
        dataclasses.replace(j, lower=max(j.lower, -turn), upper=min(j.upper, turn))
        for j in reversed(whole.joints_above(tip))
    )
    links = (named[whole.root], *(named[j.child] for j in way))
    for link in links:
        if any(shape.kind == "mesh" for shape in link.shapes):
            raise whole.wrong(
                f"link {link.name} with a mesh",
                "boxes, cylinders or spheres, as torchgrasp.app.author.clean_arm writes",
            )
    chain = dataclasses.replace(whole, links=links, joints=way)
    tree = tree_from_urdf(chain)
    joints = chain.movable
    lower, upper, speed = real([(j.lower, j.upper, j.velocity or math.pi) for j in joints]).T
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(ARM.postures, len(joints), generator=generator, dtype=torch.float64)
    share = 2 * drawn - 1  # (m, n)
    # Each direction of a joint once.
    reach = ((upper - lower) / 2).clamp_max(math.pi)
    library = (lower + upper) / 2 + share * reach
    same = torch.eye(4, dtype=torch.float64, device="cpu")
    given = obj_from_base, tip_from_hand
    base, mount = (same if x is None else x.to(same, copy=True) for x in given)
    away = float(norm(mount[:3, 3]))
    if away > ARM.mount:
        found = f"a hand {away:g} m from the tip"
        raise BadArgument("tip_from_hand", found, f"at most {ARM.mount:g} m, in metres")
    link, center, radius, palm = _spheres(chain, hand.to("cpu", torch.float64), mount)
    above = tree.moves.sum(1).long()[link]  # the number of joints that move each sphere
    moving = flatnonzero((above > 0) & ~palm)
    pairs = torch.nonzero(above - above[:, None] > 1)
    found = features(tree.frames(library.T.contiguous())[:, :, -1])
    arm = Arm(
        chain,
        tree,
        lower,
        upper,
        speed,
        base,
        mount,
        link,
        center,
        radius,
        moving,
        pairs,
        library,
        found,
        hand.source.sha256,
    )
    met = arm.overlaps(arm.sphere_centres(library[: ARM.tested].T))
    bodies, owner = torch.unique((link + palm)[pairs], dim=0, return_inverse=True)
    counts = torch.zeros(len(bodies), met.shape[1], dtype=torch.float32)
    counts = counts.index_add(0, owner, met.float())
    often = counts.gt(0).float().mean(1)
    # Others touch by construction.
    return dataclasses.replace(arm, pairs=pairs[often[owner] <= ALWAYS])


def _check_sliding(whole: Urdf, tip: str) -> None:
    """Raise `HandFileError` for a sliding joint, up to the tip, of unknown range or speed.

    No length of a rail is usual, as a turn is for other joints.
    """
    for joint in whole.joints_above(tip):
        if joint.kind != "prismatic":
            continue
        if math.isinf(joint.upper - joint.lower):
            allowed = "a lower and an upper limit, in metres, of each sliding joint"
            raise whole.wrong(f"sliding joint {joint.name} without limits", allowed)
        if joint.velocity <= 0:
            allowed = "a velocity above 0, in m/s, of each sliding joint"
            raise whole.wrong(f"sliding joint {joint.name} without a velocity", allowed)


def _last_link(whole: Urdf, names: list[str]) -> str:
    """Return the link of a robot that the most joints move, of several such links the last one.

    Raises `BadArgument` for a robot with another end: a link that six joints move, of which some do
    not move the returned link.
    """
    moved = {name: set(whole.movers(name)) for name in names}
    last = max(reversed(names), key=lambda name: len(moved[name]))
    ends = [x for x in names if len(moved[x]) >= ARM.joints and not moved[x] <= moved[last]]
    if ends:
        found = f"None, for a robot that ends in {last!r} and in {ends[-1]!r}"
        raise BadArgument("tip", found, "the name of the link that carries the hand")
    return last


def _spheres(
    chain: Urdf, hand: Hand, tip_from_hand: Float[Tensor, "4 4"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return link index, centre [m] and radius [m] of the spheres around an arm's links and the
    hand's palm.

    The last result is a mask of the spheres of the palm.
    """
    covers = [
        (k, *cover(shape, ARM.cell, ARM.bulge))
        for k, link in enumerate(chain.links)
        for shape in link.shapes
    ]
    rows = [(k, *centre, radius) for k, centres, radius in covers for centre in centres]
    palm = hand.collision_spheres.finger == -1
    centres = apply(tip_from_hand, hand.sphere_centres(hand.lower)[palm])
    last = real([len(chain.links) - 1.0]).expand(len(centres), 1)
    radius = hand.collision_spheres.radius[palm, None]
    of_palm = torch.cat([last, centres, radius], 1)
    link, center, radius = torch.cat([real(rows).reshape(-1, 5), of_palm]).split([1, 3, 1], 1)
    return link[:, 0].long(), center, radius[:, 0], row_numbers(link) >= len(rows)
