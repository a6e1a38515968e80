"""The fingertips of a hand, three to five: their pads, and the chains of links that move them."""

import dataclasses
import functools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import checked
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand_toml import HandSpec
from torchgrasp.hand.kinematics import KinematicTree, map_directions, map_points, pose_in_carrier, tree_from_urdf
from torchgrasp.hand.urdf import Urdf

ROUND_PAD, FLAT_PAD = math.radians(60), math.radians(40)
"""Half angles [rad] of the cone about the pad's axis in which a round and a flat fingertip may touch: choices."""


@dataclasses.dataclass(frozen=True)
class Fingertips(Value):
    """Names and links of the fingers in grasp order, with the `Pad` of each in the link's frame.

    `index` locates the links in the whole tree. Each tip is fixed to a carrier, the last link that a joint moves.
    `chains` is the tree that leads to the carriers, `carrier` their index in it.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("allegro")
    >>> hand.tips.names, hand.tips.radius
    (('index', 'middle', 'thumb'), tensor([0.0120, 0.0120, 0.0120], dtype=torch.float64))
    >>> _, carriers = hand.tips.frames(hand.expand_joints(hand.lower[None]).T)
    >>> carriers.shape  # rows, columns, fingers, postures
    torch.Size([3, 4, 3, 1])
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
        """Count the fingertips, f."""
        return len(self.names)

    @property
    def cone(self) -> Float[Tensor, "f"]:
        """Half angle [rad] of the cone about each pad's axis in which the tip may touch."""
        return torch.where(self.radius > 0, ROUND_PAD, FLAT_PAD).to(self.radius)

    @functools.cached_property
    def in_carriers(self) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
        """`contact`, `normal` and `center` in the frames of the carriers."""
        pose = self.carrier_from_tip
        contact, center = (map_points(pose, x)[..., 0].T for x in (self.contact, self.center))
        return contact, map_directions(pose, self.normal)[..., 0].T, center

    @checked(gradients=True)
    def frames(self, values: Float[Tensor, "j n"]) -> tuple[Float[Tensor, "3 4 l n"], Float[Tensor, "3 4 f n"]]:
        """Return the frames of all links of `chains` and of the carriers."""
        if len(values) != len(self.chains.joint_names):
            raise BadArgument("values", f"{len(values)} joints", f"all {len(self.chains.joint_names)} of the URDF")
        frames = self.chains.frames(values)
        return frames, frames.index_select(2, self.carrier)


def tips_from_files(spec: HandSpec, urdf: Urdf) -> Fingertips:
    """Return the fingertips of the chosen fingers."""
    links = [x.name for x in urdf.links]
    contact, normal, center, radius = zip(*(f.pad for f in spec.fingers), strict=True)
    carriers, poses = zip(*(pose_in_carrier(urdf, f.tip_link) for f in spec.fingers), strict=True)
    chains = tree_from_urdf(urdf, carriers)
    return Fingertips(
        names=tuple(f.name for f in spec.fingers),
        links=tuple(f.tip_link for f in spec.fingers),
        index=torch.tensor([links.index(f.tip_link) for f in spec.fingers]),
        contact=torch.tensor(contact, dtype=torch.float64),
        normal=torch.tensor(normal, dtype=torch.float64),
        center=torch.tensor(center, dtype=torch.float64),
        radius=torch.tensor(radius, dtype=torch.float64),
        chains=chains,
        carrier=torch.tensor([chains.link_names.index(name) for name in carriers]),
        carrier_from_tip=torch.stack(poses, -1)[..., None],
    )
