"""A hand as solids to draw: the collision shapes of its URDF, each with its finger."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import Shape, read_urdf
from torchgrasp.report.palette import FINGERS, HAND

if TYPE_CHECKING:
    import trimesh

PARKED = -1
"""Finger of a link that no grasping finger owns, such as the palm."""


class Solid(NamedTuple):
    """A triangle mesh in the picture's frame, of a grasping finger (from 0) or `PARKED`."""

    vertices: Float[np.ndarray, "v 3"]
    faces: np.ndarray
    finger: int

    @property
    def color(self) -> str:
        """The finger's colour, or that of the palm."""
        return HAND if self.finger == PARKED else FINGERS[self.finger]


def solids_from_hand(
    hand: Hand, joints: Float[Tensor, " j"], names: tuple[str, ...], obj_from_hand: Float[Tensor, "4 4"]
) -> list[Solid]:
    """Return the shapes of a hand, at all movable joints [rad] of its URDF in the order of `names`."""
    values = torch.stack([joints[names.index(n)] for n in hand.tree.joint_names]).double()
    poses = (obj_from_hand.double() @ hand.tree.poses(values[None])[0]).cpu().numpy()
    shapes = {link.name: link.shapes for link in read_urdf(hand.urdf_path).links}
    fingers = finger_of_links(hand)
    solids = []
    for pose, name in zip(poses, hand.tree.link_names, strict=True):
        for shape in shapes[name]:
            mesh = _mesh(shape)
            vertices = np.asarray(mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
            solids.append(Solid(vertices, np.asarray(mesh.faces), fingers[name]))
    return solids


def finger_of_links(hand: Hand) -> dict[str, int]:
    """Return each link's finger: all joints that move the link move this fingertip alone."""
    moves = hand.tree.moves.bool().cpu()
    finger_of = {}
    for mine, name in zip(moves, hand.tree.link_names, strict=True):
        owners = [f for f in range(len(hand.tips)) if bool(mine.any()) and bool(moves[hand.tips.index[f]][mine].all())]
        finger_of[name] = owners[0] if len(owners) == 1 else PARKED
    return finger_of


def _mesh(shape: Shape) -> "trimesh.Trimesh":
    """Return the mesh of a shape in the frame of its link."""
    from trimesh import creation
    from trimesh.transformations import euler_matrix

    if shape.kind == "box":
        mesh = creation.box(shape.size)
    elif shape.kind == "sphere":
        mesh = creation.uv_sphere(shape.size[0], count=[24, 24])
    else:
        mesh = creation.cylinder(shape.size[0], shape.size[1], sections=40)
    place = euler_matrix(*shape.rpy, axes="sxyz")
    place[:3, 3] = shape.xyz
    return mesh.apply_transform(place)
