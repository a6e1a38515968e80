"""A hand as solids to draw: the collision shapes of its URDF with rounded edges, each with its finger."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.palette import FINGERS, HAND
from torchgrasp.app.report.rounded import round_shape
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf

PARKED = -1
"""Finger of a link that no grasping finger owns, such as the palm."""


class Solid(NamedTuple):
    """A triangle mesh with normals, of a link and of a grasping finger (from 0) or `PARKED`.

    `link` is its index in the hand's tree.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: np.ndarray
    normals: Float[np.ndarray, "v 3"]
    link: int
    finger: int

    @property
    def color(self) -> str:
        """The finger's colour, or that of the palm."""
        return HAND if self.finger == PARKED else FINGERS[self.finger]


def solids_of_links(hand: Hand) -> list[Solid]:
    """Return the shapes of a hand, each in the frame of its link."""
    shapes = {link.name: link.shapes for link in read_urdf(hand.urdf_path).links}
    fingers = finger_of_links(hand)
    return [
        Solid(*round_shape(shape), link, fingers[name])
        for link, name in enumerate(hand.tree.link_names)
        for shape in shapes[name]
    ]


def link_poses(
    hand: Hand, joints: Float[Tensor, "n j"], names: tuple[str, ...], obj_from_hand: Float[Tensor, "n 4 4"]
) -> Float[Tensor, "n l 4 4"]:
    """Return the poses of all links, at all movable joints [rad] of its URDF in the order of `names`."""
    values = joints[:, [names.index(n) for n in hand.tree.joint_names]].double()
    return obj_from_hand.double()[:, None] @ hand.tree.poses(values)


def solids_from_hand(
    hand: Hand, joints: Float[Tensor, " j"], names: tuple[str, ...], obj_from_hand: Float[Tensor, "4 4"]
) -> list[Solid]:
    """Return the shapes of a hand in the object's frame; the joints are as in `link_poses`."""
    poses = link_poses(hand, joints[None], names, obj_from_hand[None])[0].cpu().numpy()
    return [
        solid._replace(
            vertices=solid.vertices @ poses[solid.link, :3, :3].T + poses[solid.link, :3, 3],
            normals=solid.normals @ poses[solid.link, :3, :3].T,
        )
        for solid in solids_of_links(hand)
    ]


def finger_of_links(hand: Hand) -> dict[str, int]:
    """Return each link's finger: all joints that move the link move this fingertip alone."""
    moves = hand.tree.moves.bool().cpu()
    finger_of = {}
    for mine, name in zip(moves, hand.tree.link_names, strict=True):
        owners = [f for f in range(len(hand.tips)) if bool(mine.any()) and bool(moves[hand.tips.index[f]][mine].all())]
        finger_of[name] = owners[0] if len(owners) == 1 else PARKED
    return finger_of
