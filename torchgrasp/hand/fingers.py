"""The grasping fingers of a hand: actuated joints with the joints coupled to them, and fingertips
with their pads.
"""

import dataclasses
import math
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, check_device, kept
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import ANY, is_known
from torchgrasp.geometry.frames import real
from torchgrasp.hand.hand_toml import HandSpec
from torchgrasp.hand.kinematics import (
    Frames,
    KinematicTree,
    map_directions,
    map_points,
    pose_in_carrier,
    tree_from_urdf,
)
from torchgrasp.hand.urdf import Mimic, Urdf

ROUNDING = 1e-6  # a joint [rad or m] may pass its limits by float32 rounding
ROUND_PAD = math.radians(60)
FLAT_PAD = math.radians(40)
"""Half angles [rad] of the cone about the pad's axis in which a round and a flat fingertip may
touch.
"""


@dataclasses.dataclass(frozen=True)
class ActuatedJoints(Value):
    """The h actuated joints of the grasping fingers; a `Hand` holds them as `actuated`.

    The actuated joints determine all j movable joints of the URDF. Their positions are `coupling @
    joints + offset`, in the order of `Hand.tree.joint_names`.

    Attributes:
        names: names of the h actuated joints, in the order of every tensor of joints.
        lower: lower limits (h,) [rad, or m for a sliding joint]: those of the URDF plus the
            `limit_margin` in hand.toml.
        upper: upper limits (h,) [rad or m]: those of the URDF minus this margin.
        coupling: matrix (j, h): the motion of each movable joint for a unit motion of each actuated
            joint. It has no unit between joints of one kind. It is [m/rad] for a sliding joint that
            follows a turning one, and [rad/m] in the opposite case.
        offset: positions (j,) [rad or m] of the movable joints if all actuated joints are at 0.

    >>> from torchgrasp import load_hand
    >>> actuated = load_hand("barrett").actuated
    >>> torch.equal(actuated.couple(actuated.lower), actuated.expand(actuated.lower))
    True
    """

    names: tuple[str, ...]
    lower: Float[Tensor, " h"]
    upper: Float[Tensor, " h"]
    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, " j"]

    @checked(gradients=True)
    def expand(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b j"]:
        """Return the positions (*b, j) [rad or m] of all j movable joints of the URDF.

        They are in the order of `Hand.tree.joint_names`. b stands for any batch axes. Limits are
        not checked.

        Args:
            joints: positions (*b, h) [rad or m] of the h actuated joints.

        Raises `BadArgument` for joints of a wrong count, dtype or device, and for NaN or infinity.
        """
        self.check(joints)
        return self.couple(joints)

    @checked(gradients=True)
    def couple(self, joints: Annotated[Float[Tensor, "*b h"], ANY]) -> Float[Tensor, "*b j"]:
        """Return the positions (*b, j) [rad or m] of all j movable joints of the URDF.

        They are in the order of `Hand.tree.joint_names`. Unlike `expand`, it does not check for NaN
        and infinity. On a GPU this check would have to wait for the values.

        Args:
            joints: positions (*b, h) [rad or m] of the h actuated joints.

        Raises `BadArgument` for a wrong count of joints.
        """
        return joints @ self.coupling.to(joints).T + self.offset.to(joints)

    @checked(gradients=True)
    def check(self, joints: Tensor, name: str = "joints") -> None:
        """Raise `BadArgument` unless `joints` are finite positions of the h actuated joints.

        Count, dtype and device are also checked. Limits are not.

        Args:
            joints: positions (*b, h) [rad or m] of the actuated joints.
            name: name of the argument in the text of the error.
        """
        if joints.ndim < 1 or joints.shape[-1] != len(self.names):
            allowed = f"{len(self.names)} joints in the last axis: {self.names}"
            raise BadArgument(name, f"shape {tuple(joints.shape)}", allowed)
        if joints.dtype not in (torch.float32, torch.float64):
            raise BadArgument(name, str(joints.dtype), "torch.float32 or torch.float64")
        check_device(name, joints.device, "the hand", self.lower.device)
        self._refuse(name, joints, ~torch.isfinite(joints), "finite numbers")

    @checked(gradients=True)
    def check_limits(self, joints: Tensor, name: str = "joints") -> None:
        """Raise `BadArgument` unless all `joints` are within their limits.

        A limit may be exceeded by 1e-6 (`ROUNDING`), the rounding of float32. A wrong count, dtype
        or device also raises `BadArgument`, and so does a number that is not finite.

        Args:
            joints: positions (*b, h) [rad or m] of the actuated joints.
            name: name of the argument in the text of the error.
        """
        self.check(joints, name)
        low = self.lower.to(joints) - ROUNDING
        high = self.upper.to(joints) + ROUNDING
        self._refuse(name, joints, (joints < low) | (joints > high), None)

    def _refuse(self, name: str, joints: Tensor, wrong: Tensor, allowed: str | None) -> None:
        """Raise `BadArgument` for the first joint marked as `wrong`; it names `allowed`, or else
        the joint's range.
        """
        if not torch.compiler.is_compiling() and is_known(joints) and bool(wrong.any()):
            *batch, k = torch.nonzero(wrong)[0].tolist()
            limits = f"a number in [{self.lower[k].item():.6g}, {self.upper[k].item():.6g}]"
            raise BadArgument(
                name, f"{joints[(*batch, k)].item():.6g} for {self.names[k]}", allowed or limits
            )


def joints_from_files(spec: HandSpec, urdf: Urdf) -> ActuatedJoints:
    """Return the actuated joints of a hand with their limits and coupling.

    They are the joints of the grasping fingers that follow no other joint. Joints that their
    coupled joints follow are actuated, too. `spec` is the content of hand.toml. Its limit margin is
    taken off both ends of each range. Raises `HandFileError` if the margin leaves an empty range.
    Raises it also if the chosen option of hand.toml gives no position to a joint that does not
    grasp.
    """
    movable = {j.name: j for j in urdf.movable}
    own = [j for f in spec.fingers for j in f.joints]
    leaders = [name for j in own if j in spec.coupling for name, _ in spec.coupling[j].terms]
    names = tuple(dict.fromkeys([*(j for j in own if j not in spec.coupling), *leaders]))
    margin = spec.limit_margin
    limits = real([[movable[n].lower, movable[n].upper] for n in names]) + real([margin, -margin])
    for name, (low, high) in zip(names, limits.tolist(), strict=True):
        if not low < high:
            found = (
                f"limit_margin {spec.limit_margin:g}, which leaves [{low:g}, {high:g}] to joint "
                f"{name}"
            )
            raise spec.wrong(found, "a range with lower < upper")
    coupling = limits.new_zeros(len(movable), len(names))
    offset = limits.new_zeros(len(movable))
    for row, joint in enumerate(movable):
        mimic = spec.coupling.get(joint, Mimic(joint, 1.0, 0.0))
        still = dict.fromkeys((source for source, _ in mimic.terms), 0.0)
        for source, ratio in mimic.terms:
            if source in names:
                coupling[row, names.index(source)] = ratio
            elif source in spec.parked or spec.option not in spec.options:
                still[source] = spec.parked.get(source, movable[source].rest)
            else:
                raise spec.wrong(
                    f"joint {joint}, which does neither", "every joint to grasp or to be parked"
                )
        offset[row] = mimic.follow(still)
    return ActuatedJoints(names, limits[:, 0].clone(), limits[:, 1].clone(), coupling, offset)


@dataclasses.dataclass(frozen=True)
class Fingertips(Value):
    """The f grasping fingertips of a hand, in the order of `names`; a `Hand` holds them as `tips`.

    A fingertip touches objects with its pad: a sphere, or a single point. The carrier of a
    fingertip is the last link that a joint moves; the tip's link is fixed to it.

    Attributes:
        names: names of the fingers.
        links: names of the tips' links.
        index: index (f,) of each tip's link in `Hand.tree.link_names`.
        contact: contact point (f, 3) [m] of each pad, in the frame of the tip's link.
        normal: outward unit normal (f, 3) of each pad at its contact point, in the frame of the
            tip's link.
        center: centre (f, 3) [m] of each pad's sphere, in the frame of the tip's link. A pad that
            is a point has its contact point here.
        radius: radius (f,) [m] of each pad's sphere; 0 for a point.
        chains: the part of the kinematic tree that leads to the carriers.
        carrier: index (f,) of each carrier in `chains.link_names`.
        carrier_from_tip: pose (3, 4, f, 1) [m] of each tip's link in its carrier, without the last
            row of the 4 x 4 matrix.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("allegro")
    >>> hand.tips.names, hand.tips.frames(hand.expand_joints(hand.lower[None]).T)[1].shape
    (('index', 'middle', 'thumb'), torch.Size([3, 4, 3, 1]))
    """

    names: tuple[str, ...]
    links: tuple[str, ...]
    index: Int[Tensor, "f"]
    contact: Float[Tensor, "f 3"]
    normal: Float[Tensor, "f 3"]
    center: Float[Tensor, "f 3"]
    radius: Float[Tensor, "f"]
    chains: KinematicTree
    carrier: Int[Tensor, "f"]
    carrier_from_tip: Float[Tensor, "3 4 f 1"]

    def __len__(self) -> int:
        return len(self.names)

    @kept
    def cone(self) -> Float[Tensor, "f"]:
        """Half angle (f,) [rad] of the cone about each pad's normal in which the pad may touch a
        surface: 60 degrees for a sphere, 40 degrees for a point. A cached property.
        """
        # float32, as when results were published
        angles = self.radius.new_tensor([ROUND_PAD, FLAT_PAD], dtype=torch.float32)
        return torch.where(self.radius > 0, *angles).to(self.radius)

    @kept
    def in_carriers(
        self,
    ) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
        """Contact points [m], unit normals and sphere centres [m] of the pads, each (f, 3).

        Each is in the frame of the tip's carrier. It is a cached property.
        """
        pose = self.carrier_from_tip
        contact = map_points(pose, self.contact)[..., 0].T
        normal = map_directions(pose, self.normal)[..., 0].T
        center = map_points(pose, self.center)[..., 0].T
        return contact, normal, center

    @checked(gradients=True)
    def frames(self, values: Float[Tensor, "j n"]) -> tuple[Frames, Float[Tensor, "3 4 f n"]]:
        """Return (links, carriers): poses [m] in the palm's frame, in n postures.

        `links` (3, 4, m, n) are those of the m links that lead to the carriers
        (`chains.link_names`). `carriers` (3, 4, f, n) are those of the f carriers. A fingertip's
        carrier is the last link, up to its own, that a joint moves. The last row of each 4 x 4
        matrix is left out.

        Args:
            values: positions (j, n) [rad or m] of all j movable joints of the URDF, in the order of
                `Hand.tree.joint_names`.

        Raises `BadArgument` for a wrong number of joints.
        """
        if len(values) != (every := len(self.chains.joint_names)):
            raise BadArgument("values", f"{len(values)} joints", f"all {every} joints of the URDF")
        frames = self.chains.frames(values)
        return frames, frames.index_select(2, self.carrier)


def tips_from_files(spec: HandSpec, urdf: Urdf, chain: Any) -> Fingertips:
    """Return the fingertips of the grasping fingers, with their pads and their place in the
    kinematic tree.

    `spec` is the content of hand.toml, and `chain` the pytorch-kinematics chain of the URDF.
    """
    links = [x.name for x in urdf.links]
    tips = tuple(f.tip_link for f in spec.fingers)
    pads = zip(*(f.pad for f in spec.fingers), strict=True)
    contact, normal, center, radius = map(real, pads)
    carriers, poses = zip(*(pose_in_carrier(chain, tip) for tip in tips), strict=True)
    chains = tree_from_urdf(urdf, chain, carriers)
    carrier = torch.tensor([chains.link_names.index(name) for name in carriers], device="cpu")
    index = torch.tensor([links.index(tip) for tip in tips], device="cpu")
    names = tuple(f.name for f in spec.fingers)
    poses = torch.stack(poses, -1)[..., None]
    return Fingertips(names, tips, index, contact, normal, center, radius, chains, carrier, poses)
