"""A hand as meshes to draw: collision shapes with rounded edges, in the colours of the fingers."""

import functools
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.canvas import FINGERS, HAND
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import Shape, read_urdf

PARKED = -1  # finger index of a link that no grasping finger owns, such as the palm
EDGE = 0.004  # largest radius of a rounded edge [m], about that of a robot finger


class Solid(NamedTuple):
    """A mesh of one collision shape with vertex normals, the index of its link, and its finger or `PARKED`."""

    vertices: Float[np.ndarray, "v 3"]
    faces: np.ndarray
    normals: Float[np.ndarray, "v 3"]
    link: int
    finger: int

    @property
    def color(self) -> str:
        """The colour of the finger, or of the palm."""
        return HAND if self.finger == PARKED else FINGERS[self.finger]


def solids_of_links(hand: Hand) -> list[Solid]:
    """Return the collision shapes of a hand as meshes, each in the frame of its link."""
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
    """Return the poses of all links in the object's frame; `names` gives the order of the joints [rad]."""
    values = joints[:, [names.index(n) for n in hand.tree.joint_names]].double()
    return obj_from_hand.double()[:, None] @ hand.tree.poses(values)


def solids_from_hand(
    hand: Hand, joints: Float[Tensor, " j"], names: tuple[str, ...], obj_from_hand: Float[Tensor, "4 4"]
) -> list[Solid]:
    """Return the collision shapes of a hand as meshes in the object's frame; arguments as in `link_poses`."""
    poses = link_poses(hand, joints[None], names, obj_from_hand[None])[0].cpu().numpy()
    return [
        solid._replace(
            vertices=solid.vertices @ poses[solid.link, :3, :3].T + poses[solid.link, :3, 3],
            normals=solid.normals @ poses[solid.link, :3, :3].T,
        )
        for solid in solids_of_links(hand)
    ]


def finger_of_links(hand: Hand) -> dict[str, int]:
    """Return the index of the finger that each link belongs to; `PARKED` if it belongs to none or several."""
    moves = hand.tree.moves.bool().cpu()
    finger_of = {}
    for mine, name in zip(moves, hand.tree.link_names, strict=True):
        owners = [f for f in range(len(hand.tips)) if bool(mine.any()) and bool(moves[hand.tips.index[f]][mine].all())]
        finger_of[name] = owners[0] if len(owners) == 1 else PARKED
    return finger_of


@functools.lru_cache(maxsize=512)  # a hand is drawn many times
def round_shape(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and normals of a collision shape with rounded edges, in the frame of its link.

    The solid is the convex hull of balls, so the normals point away from the balls' centres.
    """
    from scipy.spatial import ConvexHull
    from trimesh import creation
    from trimesh.transformations import euler_matrix

    if shape.kind == "sphere":
        ball = creation.icosphere(subdivisions=3, radius=1.0)
        normals, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
        points = shape.size[0] * normals
    else:
        centres, normals, radius = _box(shape.size) if shape.kind == "box" else _cylinder(*shape.size)
        points = centres + radius * normals
        faces = np.asarray(ConvexHull(points).simplices)
        a, b, c = points[faces].transpose(1, 0, 2)
        inward = (np.cross(b - a, c - a) * normals[faces].sum(1)).sum(1) < 0.0
        faces[inward] = faces[inward, ::-1]
    place = euler_matrix(*shape.rpy, axes="sxyz")
    return points @ place[:3, :3].T + np.array(shape.xyz), faces, normals @ place[:3, :3].T


def _box(size: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return centres, directions and radius of the balls at the corners of a box."""
    radius = min(EDGE, min(size) / 4)  # thin plates stay plates
    grid = [ij for ij in itertools.product(range(4), repeat=3) if sum(ij) == 3]  # an octant in steps of 30 degrees
    octant = np.array(grid) / np.linalg.norm(grid, axis=1, keepdims=True)
    signs = np.repeat(list(itertools.product((-1.0, 1.0), repeat=3)), len(octant), axis=0)
    return signs * (np.array(size) / 2 - radius), signs * np.tile(octant, (8, 1)), radius


def _cylinder(radius: float, length: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return centres, directions and radius of the balls along the rims of a cylinder."""
    edge = min(EDGE, min(2.0 * radius, length) / 4)
    turn, tilt, side = np.meshgrid(
        np.linspace(0.0, 2 * np.pi, 40, endpoint=False), np.linspace(0.0, np.pi / 2, 4), (-1.0, 1.0)
    )
    around = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], -1).reshape(-1, 3)
    tilt, up = tilt.reshape(-1, 1), side.reshape(-1, 1) * np.array([0.0, 0.0, 1.0])
    return (radius - edge) * around + (length / 2 - edge) * up, np.cos(tilt) * around + np.sin(tilt) * up, edge
