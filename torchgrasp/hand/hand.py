"""The hand as a value: joints, fingers, pads, coupling; where its links and fingertips are and how they move."""

import dataclasses
import hashlib
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument, HandFileError
from torchgrasp.hand.cover import SphereCover, cover_from_urdf
from torchgrasp.hand.kinematics import Kinematics, ancestor_mask, kinematics_from_urdf
from torchgrasp.hand.selfcollide import SelfCollision, self_collision_from_spec
from torchgrasp.hand.spec import HandSpec, read_hand_toml
from torchgrasp.hand.urdf import Urdf, read_urdf


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
    `all joints = coupling @ joints + offset`, in the order of `urdf_joint_names`. Fingers are in grasp order.
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
        self._check_shape(joints)
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
        self._check_shape(joints)
        return joints @ self.coupling.to(joints).T + self.offset.to(joints)

    def link_poses(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b l 4 4"]:
        """Return `hand_from_link` of every link, in the order of `link_names`."""
        values = self.expand_joints(joints)
        poses = self.kinematics.poses(values.reshape(-1, values.shape[-1]))
        return poses.reshape(*joints.shape[:-1], *poses.shape[1:])

    def fingertips(self, joints: Float[Tensor, "*b h"]) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3 3"]]:
        """Return the contact points [m] on the three pads and their outward unit normals (the pads' axes).

        >>> points, normals = load_hand("allegro").fingertips(torch.zeros(5, 12))
        >>> points.shape, normals.shape
        (torch.Size([5, 3, 3]), torch.Size([5, 3, 3]))
        """
        return self.fingertips_from_poses(self.link_poses(joints))

    def fingertips_from_poses(
        self, poses: Float[Tensor, "*b l 4 4"]
    ) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3 3"]]:
        """Return the contact points [m] and normals of the pads for known `link_poses`."""
        tips = poses[..., self.tip_index, :, :]
        return _map(tips, self.contact.to(poses)), _turn(tips, self.normal.to(poses))

    def tip_centres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b 3 3"]:
        """Return the centres [m] of the tips' spheres of `tip_radius`; the contact points where the radius is 0."""
        return self.tip_centres_from_poses(self.link_poses(joints))

    def tip_centres_from_poses(self, poses: Float[Tensor, "*b l 4 4"]) -> Float[Tensor, "*b 3 3"]:
        """Return the centres [m] of the tips' spheres for known `link_poses`."""
        return _map(poses[..., self.tip_index, :, :], self.center.to(poses))

    def jacobian(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b 3 3 h"]:
        """Return the derivative of the contact points by the actuated joints, coupling included [m/rad].

        The axes are: finger, coordinate, joint.
        """
        poses = self.link_poses(joints)
        points, _ = self.fingertips_from_poses(poses)
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

    def direction_jacobian(
        self, poses: Float[Tensor, "*b l 4 4"], link_index: Int[Tensor, " p"], directions: Float[Tensor, "*b p 3"]
    ) -> Float[Tensor, "*b p 3 h"]:
        """Return the derivative of directions fixed to links (given in the palm's frame) by the actuated joints."""
        axes, _ = self.screws(poses)
        turning = axes * (1 - self.prismatic.to(poses))[:, None]
        arm = directions[..., None, :, :].expand(*turning.shape[:-1], *directions.shape[-2:])
        column = torch.linalg.cross(turning[..., :, None, :].expand_as(arm), arm)
        column = column * self.moves[link_index].T.to(poses)[:, :, None]
        return torch.einsum("...jpi,jh->...pih", column, self.coupling.to(poses))

    def spheres(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b s 3"]:
        """Return the centres [m] of `collision_spheres` in the palm's frame."""
        return self.spheres_from_poses(self.link_poses(joints))

    def spheres_from_poses(self, poses: Float[Tensor, "*b l 4 4"]) -> Float[Tensor, "*b s 3"]:
        """Return the centres [m] of `collision_spheres` for known `link_poses`."""
        cover = self.collision_spheres
        return _map(poses[..., cover.link_index, :, :], cover.center.to(poses))

    def self_clearance(self, joints: Float[Tensor, "*b h"], chunk: int = 512) -> Float[Tensor, "*b"]:
        """Return the signed least distance [m] between links that can meet; negative: they overlap.

        Parked fingers and the palm are included; the pairs are those of hand.toml. Rows are taken in chunks, which
        bounds the memory and keeps the work in the cache.
        """
        self._check_shape(joints)
        rows = joints.reshape(-1, joints.shape[-1])
        parts = [self.self_collision.clearance(self.link_poses(part)) for part in rows.split(chunk)]
        return torch.cat(parts).reshape(joints.shape[:-1]) if parts else rows.new_zeros(joints.shape[:-1])

    def screws(self, poses: Float[Tensor, "*b l 4 4"]) -> tuple[Float[Tensor, "*b j 3"], Float[Tensor, "*b j 3"]]:
        """Return the axes and origins of all movable joints in the palm's frame."""
        frames = poses[..., self.child, :, :]
        return _turn(frames, self.axis.to(poses)), frames[..., :3, 3]

    def _check_shape(self, joints: Tensor) -> None:
        """Refuse joints of another count or dtype before any work."""
        if joints.ndim < 1 or joints.shape[-1] != self.dof:
            raise BadArgument("joints", f"shape {tuple(joints.shape)}", f"{self.dof} joints last: {self.joint_names}")
        if joints.dtype not in (torch.float32, torch.float64):
            raise BadArgument("joints", str(joints.dtype), "torch.float32 or torch.float64")


def _map(poses: Float[Tensor, "*b p 4 4"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "*b p 3"]:
    """Map one point per pose into the palm's frame."""
    return _turn(poses, local) + poses[..., :3, 3]


def _turn(poses: Float[Tensor, "*b p 4 4"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "*b p 3"]:
    """Map one direction per pose into the palm's frame."""
    x, y, z = local[:, :, None].unbind(1)  # many small matrix products are slower than three long sums
    return poses[..., :3, 0] * x + poses[..., :3, 1] * y + poses[..., :3, 2] * z


def hands_folder() -> Path:
    """Return the folder of the shipped hands: inside the installed package, else beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "hands"
    return installed if installed.is_dir() else package.parent / "hands"


def find_hand(name_or_path: str | Path) -> Path:
    """Return the folder of a shipped hand by its name, or of a hand's folder or hand.toml by its path.

    Raises:
        HandFileError: there is no such hand; the message lists the shipped ones.
    """
    shipped = hands_folder()
    names = sorted(p.parent.name for p in shipped.glob("*/hand.toml"))
    if isinstance(name_or_path, str) and name_or_path in names:
        return shipped / name_or_path
    path = Path(name_or_path)
    folder = path.parent if path.name == "hand.toml" else path
    if not (folder / "hand.toml").is_file():
        raise HandFileError("hand", f"{str(name_or_path)!r}", f"one of {names}, or a folder with a hand.toml")
    return folder


def load_hand(name_or_path: str | Path, fingers: str = "default") -> Hand:
    """Load a hand from its hand.toml and URDF, with one of the finger options that its hand.toml offers.

    Args:
        name_or_path: a shipped hand ("allegro", "barrett"), or the folder of another one.
        fingers: "default", or for the Allegro "paper_literal" (index, middle and ring finger).

    Raises:
        HandFileError: a file is missing, malformed, or the two do not fit each other.
        BadArgument: the hand has no such option.

    >>> load_hand("barrett").joint_names
    ('spread', 'f1_flex', 'f2_flex', 'f3_flex')
    """
    spec = read_hand_toml(find_hand(name_or_path) / "hand.toml", fingers)
    return hand_from_files(spec, read_urdf(spec.urdf))


def hand_from_files(spec: HandSpec, urdf: Urdf) -> Hand:
    """Assemble a hand from its two files, checking that they name the same links and joints."""
    movable = {j.name: j for j in urdf.joints if j.kind != "fixed"}
    links = {x.name: i for i, x in enumerate(urdf.links)}
    _check_names(spec, urdf, set(movable), set(links))
    names = tuple(dict.fromkeys(j for f in spec.fingers for j in f.joints if j not in spec.coupling))
    coupling, offset = _coupling(spec, tuple(movable), names)
    limits = torch.tensor([[movable[n].lower, movable[n].upper] for n in names], dtype=torch.float64)
    limits = limits + torch.tensor([spec.limit_margin, -spec.limit_margin], dtype=torch.float64)
    kinematics = kinematics_from_urdf(urdf)
    fingers = spec.fingers
    return Hand(
        name=spec.name,
        option=spec.option,
        urdf_path=urdf.path,
        sha256=hashlib.sha256(spec.data + b"\0" + urdf.data).hexdigest(),
        joint_names=names,
        lower=limits[:, 0].clone(),
        upper=limits[:, 1].clone(),
        finger_names=(fingers[0].name, fingers[1].name, fingers[2].name),
        tip_links=(fingers[0].tip_link, fingers[1].tip_link, fingers[2].tip_link),
        urdf_joint_names=kinematics.joint_names,
        link_names=kinematics.link_names,
        coupling=coupling,
        offset=offset,
        approach=torch.tensor(spec.approach, dtype=torch.float64),
        tip_index=torch.tensor([links[f.tip_link] for f in fingers]),
        contact=torch.tensor([f.contact for f in fingers], dtype=torch.float64),
        normal=torch.tensor([f.normal for f in fingers], dtype=torch.float64),
        center=torch.tensor([f.center for f in fingers], dtype=torch.float64),
        tip_radius=torch.tensor([f.radius for f in fingers], dtype=torch.float64),
        axis=torch.tensor([j.axis for j in movable.values()], dtype=torch.float64),
        prismatic=torch.tensor([float(j.kind == "prismatic") for j in movable.values()], dtype=torch.float64),
        child=torch.tensor([links[j.child] for j in movable.values()]),
        moves=torch.tensor(ancestor_mask(urdf), dtype=torch.float64),
        actuators={n: Actuator(j.effort, j.velocity, spec.kp, spec.kd) for n, j in movable.items()},
        collision_spheres=cover_from_urdf(urdf, spec),
        self_collision=self_collision_from_spec(urdf, spec),
        kinematics=kinematics,
    )


def _coupling(
    spec: HandSpec, movable: tuple[str, ...], names: tuple[str, ...]
) -> tuple[Float[Tensor, "j h"], Float[Tensor, " j"]]:
    """Return the matrix and offset that give every joint from the actuated ones."""
    matrix = torch.zeros(len(movable), len(names), dtype=torch.float64)
    offset = torch.zeros(len(movable), dtype=torch.float64)
    for row, joint in enumerate(movable):
        source, ratio, shift = spec.coupling.get(joint, (joint, 1.0, 0.0))
        if source in names:
            matrix[row, names.index(source)] = ratio
            offset[row] = shift
        elif source in spec.parked:
            offset[row] = ratio * spec.parked[source] + shift
        else:
            raise HandFileError("hand.toml", f"{spec.path}: joint {joint} neither grasps nor is parked", "either")
    return matrix, offset


def _check_names(spec: HandSpec, urdf: Urdf, movable: set[str], links: set[str]) -> None:
    """Refuse names in hand.toml that the URDF does not have."""
    if spec.base_link != urdf.root:
        raise HandFileError("hand.toml", f"{spec.path}: base_link {spec.base_link!r}", f"the URDF's root {urdf.root!r}")
    joints = [j for f in spec.all_fingers for j in f.joints] + list(spec.parked) + list(spec.coupling)
    joints += [source for source, _, _ in spec.coupling.values()]
    named = [f.tip_link for f in spec.all_fingers] + [s.link for s in (*spec.capsules, *spec.boxes)]
    named += [x for pair in spec.pairs or () for x in pair]
    for kind, found, known in (("joint", joints, movable), ("link", named, links)):
        unknown = sorted(set(found) - known)
        if unknown:
            raise HandFileError("hand.toml", f"{spec.path}: {kind} {unknown[0]!r}", f"one of {sorted(known)}")
    actuated = {j for f in spec.fingers for j in f.joints} | {s for s, _, _ in spec.coupling.values()}
    both = sorted(set(spec.parked) & actuated)
    if both:
        raise HandFileError("hand.toml", f"{spec.path}: parked joint {both[0]!r} grasps", "joints that do not grasp")
