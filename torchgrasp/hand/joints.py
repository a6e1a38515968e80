"""The actuated joints of a hand, their limits, and the joints that follow them."""

import dataclasses
from typing import TYPE_CHECKING, Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_device
from torchgrasp.checks import ANY, checked
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand_toml import HandSpec
from torchgrasp.hand.kinematics import Markers
from torchgrasp.hand.urdf import Mimic, Urdf

if TYPE_CHECKING:
    from torchgrasp.hand.hand import Hand

ROUNDING = 1e-6
"""Joints may pass their limits by this [rad]: limits and joints are both rounded to float32."""


@dataclasses.dataclass(frozen=True)
class ActuatedJoints(Value):
    """Joints that move the grasping fingers [rad or m]; the URDF's joints are `coupling @ joints + offset`.

    >>> from torchgrasp import load_hand
    >>> actuated = load_hand("barrett").actuated
    >>> joints = actuated.lower.expand(5, -1)
    >>> actuated.check(joints)
    >>> actuated.check_limits(joints)
    >>> actuated.expand(joints).shape, torch.equal(actuated.couple(joints), actuated.expand(joints))
    (torch.Size([5, 8]), True)
    """

    names: tuple[str, ...]
    lower: Float[Tensor, " h"]
    upper: Float[Tensor, " h"]
    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, " j"]

    @checked(gradients=True)
    def expand(self, joints: Float[Tensor, "*b h"]) -> Float[Tensor, "*b j"]:
        """Return every movable joint of the URDF."""
        self.check(joints)
        return self.couple(joints)

    @checked(gradients=True)
    def couple(self, joints: Annotated[Float[Tensor, "*b h"], ANY]) -> Float[Tensor, "*b j"]:
        """Return every movable joint without a look at numbers, for which the host would wait for a GPU."""
        return joints @ self.coupling.to(joints).T + self.offset.to(joints)

    @checked(gradients=True)
    def check(self, joints: Tensor, name: str = "joints") -> None:
        """Refuse joints of a wrong count, dtype or device, NaN and infinity."""
        if joints.ndim < 1 or joints.shape[-1] != len(self.names):
            wanted = f"{len(self.names)} joints last: {self.names}"
            raise BadArgument(name, f"shape {tuple(joints.shape)}", wanted)
        if joints.dtype not in (torch.float32, torch.float64):
            raise BadArgument(name, str(joints.dtype), "torch.float32 or torch.float64")
        check_device(name, joints.device, "the hand", self.lower.device)
        finite = torch.isfinite(joints)
        if not bool(finite.all()):
            value, k = _first(joints, ~finite)
            raise BadArgument(name, f"{value} for {self.names[k]}", "finite numbers")

    @checked(gradients=True)
    def check_limits(self, joints: Tensor, name: str = "joints") -> None:
        """Refuse joints beyond their limits, too."""
        self.check(joints, name)
        low, high = self.lower.to(joints), self.upper.to(joints)
        wrong = (joints < low - ROUNDING) | (joints > high + ROUNDING)
        if bool(wrong.any()):
            value, k = _first(joints, wrong)
            allowed = f"[{self.lower[k].item():.6g}, {self.upper[k].item():.6g}]"
            raise BadArgument(name, f"{value:.6g} for {self.names[k]}", allowed)


@dataclasses.dataclass(frozen=True)
class FreeMotion(Value):
    """How the links of a hand with a free pose move, and the markers by which that is told.

    The q motions are three translations along the root's axes, three rotations about them, and the joints that anything
    actuated moves. `moves[l, q]` is 1 if a motion moves link l. `coupling` gives the motions of the six numbers of a
    step of the pose and of the actuated joints; None: they are the same.

    `markers` are the collision spheres, the tips' centres and pads, then of the motions origins, axes of turns and axes
    of slides, of which one is zero.
    """

    markers: Markers
    moves: Float[Tensor, "l q"]
    coupling: Float[Tensor, "q d"] | None

    @classmethod
    def of(cls, hand: "Hand") -> "FreeMotion":
        """Tabulate the motions of a hand."""
        tree, tips, spheres, coupling = hand.tree, hand.tips, hand.collision_spheres, hand.actuated.coupling
        own = torch.nonzero((coupling != 0).any(1))[:, 0]
        axes, slides = torch.eye(3).to(tree.axis), tree.prismatic[own]
        root = torch.nonzero(tree.places == 0)[:, 0].expand(6)
        link = torch.cat([root, tree.child[own]])
        turning = torch.cat([0 * axes, axes, tree.axis[own] * (1 - slides[:, None])])
        sliding = torch.cat([axes, 0 * axes, tree.axis[own] * slides[:, None]])
        placed = [
            (spheres.link_index, spheres.center, 1.0),
            (tips.index, tips.center, 1.0),
            (tips.index, tips.normal, 0.0),
            (link, torch.zeros_like(turning), 1.0),
            (link, turning, 0.0),
            (link, sliding, 0.0),
        ]
        groups = [(at, local.to(axes), torch.full_like(local[:, 0], kind).to(axes)) for at, local, kind in placed]
        moves = torch.cat([axes.new_ones(len(tree.moves), 6), tree.moves[:, own]], 1)
        whole = torch.block_diag(torch.eye(6).to(axes), coupling[own])
        same = whole.shape[0] == whole.shape[1] and torch.equal(whole, torch.eye(len(whole)).to(whole))
        return cls(Markers.of(len(tree.link_names), groups), moves, None if same else whole)


def _first(joints: Tensor, wrong: Tensor) -> tuple[float, int]:
    """Return the first wrong value and the index of its joint."""
    first = torch.nonzero(wrong)[0].tolist()
    return joints[tuple(first)].item(), first[-1]


def joints_from_files(spec: HandSpec, urdf: Urdf) -> ActuatedJoints:
    """Return the joints of the grasping fingers; refuse joints without a range, and joints without a role.

    A joint of another finger is among them if one of theirs follows it.
    """
    movable = {j.name: j for j in urdf.movable}
    own = [j for f in spec.fingers for j in f.joints]
    leaders = [spec.coupling[j].source for j in own if j in spec.coupling]
    names = tuple(dict.fromkeys([*(j for j in own if j not in spec.coupling), *leaders]))
    limits = torch.tensor([[movable[n].lower, movable[n].upper] for n in names], dtype=torch.float64)
    limits = limits + torch.tensor([spec.limit_margin, -spec.limit_margin], dtype=torch.float64)
    for name, (low, high) in zip(names, limits.tolist(), strict=True):
        if not low < high:
            found = f"limit_margin {spec.limit_margin:g} leaves joint {name} [{low:g}, {high:g}]"
            raise spec.wrong(found, "lower < upper")
    coupling = torch.zeros(len(movable), len(names), dtype=torch.float64)
    offset = torch.zeros(len(movable), dtype=torch.float64)
    for row, joint in enumerate(movable):
        source, ratio, shift = spec.coupling.get(joint, Mimic(joint, 1.0, 0.0))
        if source in names:
            coupling[row, names.index(source)] = ratio
            offset[row] = shift
        elif source in spec.parked or spec.option not in spec.options:
            opened = min(max(0.0, movable[source].lower), movable[source].upper)
            offset[row] = ratio * spec.parked.get(source, opened) + shift
        else:
            raise spec.wrong(f"joint {joint} neither grasps nor is parked", "either")
    return ActuatedJoints(names, limits[:, 0].clone(), limits[:, 1].clone(), coupling, offset)
