"""A hand as meshes to draw, in the colours of the fingers. They are the visual meshes of its URDF,
or collision shapes with rounded edges.
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.author.visuals import link_meshes
from torchgrasp.app.report.canvas import FINGERS, HAND, sharp_normals
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import LinkShape, pose_of, read_urdf

PARKED = -1  # finger index of a link that no grasping finger owns, such as the palm
EDGE = 0.004  # largest radius of a rounded edge [m], about that of a robot finger
BALL_FINENESS = 3  # subdivisions of an icosahedron: 642 corners of a sphere
TURNS = 40  # sides of a cylinder
TILTS = 7  # rings around its rounded edges


class Solid(NamedTuple):
    """The mesh of one collision shape of a hand, or of all visuals of a link, in its link's frame.

    Attributes:
        vertices: corners [m].
        faces: indices of the three vertices of each of t triangles, (t, 3).
        normals: outward unit normals at the vertices.
        link: index of the link in `hand.tree.link_names`.
        finger: index of the finger in `hand.finger_names`; -1 (`PARKED`) if the link belongs to no
            grasping finger, or to several.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: np.ndarray
    normals: Float[np.ndarray, "v 3"]
    link: int
    finger: int

    @property
    def color(self) -> str:
        """The colour "#rrggbb" of the finger; that of the palm if `finger` is -1."""
        return HAND if self.finger == PARKED else FINGERS[self.finger]


def solids_of_links(hand: Hand) -> list[Solid]:
    """Return the hand as meshes [m], each in the frame of its link.

    A link with a <visual> in the URDF that can be read has one mesh, that of the visual. Any other
    link has a mesh for each of its collision shapes.
    """
    if "solids" not in hand.derived:
        hand.derived["solids"] = _read_solids(hand)
    return hand.derived["solids"]


def _read_solids(hand: Hand) -> list[Solid]:
    """Return the meshes of a hand, read from its URDF and the files beside it."""
    urdf = read_urdf(hand.urdf_path)
    shapes = {link.name: link.shapes for link in urdf.links}
    seen = link_meshes(urdf.path, urdf.data, urdf.path.parent)
    fingers = finger_of_links(hand)
    found = []
    for link, name in enumerate(hand.tree.link_names):
        if name not in seen:
            found += [Solid(*round_shape(shape), link, fingers[name]) for shape in shapes[name]]
            continue
        vertices, faces = seen[name]
        # each corner of each face has its own normal
        corners = vertices[faces].reshape(-1, 3)
        normals = sharp_normals(vertices, faces).reshape(-1, 3)
        one_each = np.arange(len(corners)).reshape(-1, 3)
        found.append(Solid(corners, one_each, normals, link, fingers[name]))
    return found


def solids_by_link(hand: Hand) -> dict[str, Solid]:
    """Return one mesh [m] for each link of a hand, in the link's frame, by the link's name.

    It is that of the visual or, without one, of all collision shapes. A link without either is left
    out.
    """
    found = {}
    solids = solids_of_links(hand)
    for link, name in enumerate(hand.tree.link_names):
        mine = [solid for solid in solids if solid.link == link]
        if not mine:
            continue
        vertices, faces = trimesh.util.append_faces(
            [s.vertices for s in mine], [s.faces for s in mine]
        )
        normals = np.concatenate([s.normals for s in mine])
        found[name] = Solid(vertices, faces, normals, link, mine[0].finger)
    return found


def link_poses(
    hand: Hand,
    joints: Float[Tensor, "n j"],
    names: tuple[str, ...],
    obj_from_hand: Float[Tensor, "n 4 4"],
) -> Float[Tensor, "n l 4 4"]:
    """Return the poses obj_from_link (n, l, 4, 4) [m] of all l links of a hand in n postures.

    They are in the object's frame, with the links in the order of `hand.tree.link_names`. `joints`
    (n, j) holds the positions [rad or m] of all j joints of the URDF. Their names are `names`, in
    any order. `obj_from_hand` holds the n poses of the hand in the object's frame [m].
    """
    values = joints[:, [names.index(n) for n in hand.tree.joint_names]].double()
    return obj_from_hand.double()[:, None] @ hand.tree.poses(values)


def solids_from_hand(
    hand: Hand,
    joints: Float[Tensor, " j"],
    names: tuple[str, ...],
    obj_from_hand: Float[Tensor, "4 4"],
) -> list[Solid]:
    """Return a hand at a posture as meshes in the object's frame [m].

    `joints` [rad or m] are the positions of all joints of the URDF. Their names are `names`, in any
    order. `obj_from_hand` is the hand's pose [m].
    """
    poses = link_poses(hand, joints[None], names, obj_from_hand[None])[0].cpu().numpy()
    return place_solids(hand, poses)


def place_solids(hand: Hand, obj_from_link: Float[np.ndarray, "l 4 4"]) -> list[Solid]:
    """Return a hand as meshes [m] in the object's frame, given the poses of its l links.

    The poses `obj_from_link` [m] are in the order of `hand.tree.link_names`.
    """
    placed = []
    for solid in solids_of_links(hand):
        pose = obj_from_link[solid.link]
        turn = pose[:3, :3].T
        vertices = solid.vertices @ turn + pose[:3, 3]
        placed.append(solid._replace(vertices=vertices, normals=solid.normals @ turn))
    return placed


def finger_of_links(hand: Hand) -> dict[str, int]:
    """Return for each link of a hand, by its name, the index of its finger in `hand.finger_names`.

    The index is -1 (`PARKED`) for a link of no grasping finger, such as the palm, or of several.
    """
    moves = hand.tree.moves.bool().cpu()
    finger_of = {}
    for mine, name in zip(moves, hand.tree.link_names, strict=True):
        # a finger owns the links whose joints all move its tip; no joint moves the palm
        owners = [f for f in range(len(hand.tips)) if moves[hand.tips.index[f]][mine].all()]
        finger_of[name] = owners[0] if mine.any() and len(owners) == 1 else PARKED
    return finger_of


@functools.lru_cache(maxsize=512)  # a hand is drawn many times
def round_shape(shape: LinkShape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and vertex normals of a box, cylinder or sphere with rounded edges.

    `shape` is a collision shape of a link. Vertices (v, 3) [m] and outward unit normals (v, 3) are
    in the frame of the link. Faces (t, 3) hold the indices of the vertices of t triangles.
    """
    fineness = BALL_FINENESS if shape.kind == "sphere" else 1
    ball = np.asarray(trimesh.creation.icosphere(subdivisions=fineness, radius=1.0).vertices)
    radius = min(EDGE, min(shape.half) / 2)  # thin plates stay plates
    if shape.kind == "sphere":
        radius = shape.size[0]
        centres = np.zeros((1, 3))
    elif shape.kind == "box":
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        centres = signs * (np.array(shape.half) - radius)
    else:
        tilts = np.linspace(-np.pi / 2, np.pi / 2, TILTS)
        turns = np.linspace(0, 2 * np.pi, TURNS, endpoint=False)
        tilt, turn = np.meshgrid(tilts, turns)
        across = np.cos(tilt)
        ball = np.stack([across * np.cos(turn), across * np.sin(turn), np.sin(tilt)], -1)
        rim = (shape.size[0] - radius) * ball[:, TILTS // 2]  # the balls of a round edge lie here
        up = np.array([0.0, 0.0, shape.size[1] / 2 - radius])
        ball = ball.reshape(-1, 3)
        centres = np.concatenate([rim - up, rim + up])
    # the shape is the hull of balls at its corners or along its rims
    points = (centres[:, None] + radius * ball).reshape(-1, 3)
    normals = np.tile(ball, (len(centres), 1))
    hull = spatial.ConvexHull(points)
    kept, faces = np.unique(hull.simplices, return_inverse=True)
    points = points[kept]
    normals = normals[kept]
    faces = faces.reshape(-1, 3)
    # the hull lists the corners of a face in any order
    a, b, c = points[faces].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0.0
    faces[inward] = faces[inward, ::-1]
    place = pose_of(shape)
    turn = place[:3, :3].T
    return points @ turn + place[:3, 3], faces, normals @ turn
