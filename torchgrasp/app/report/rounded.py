"""Collision shapes of a URDF as meshes with rounded edges, which show where a box ends."""

import functools
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchgrasp.hand.urdf import Shape

EDGE = 0.004
"""Largest radius of an edge [m], of about a robot finger's; the solid stays inside its shape."""

EDGE_SHARE = 0.25
"""Largest radius of an edge, over the shortest side: thin plates stay plates."""

STEPS = 3
"""Steps of a quarter turn: edges of 30 degrees, which are shaded as smooth."""

SIDES = 40
"""Sides of a cylinder."""


class Rounded(NamedTuple):
    """A mesh with a unit normal at each vertex, in the frame of its link [m]."""

    vertices: Float[np.ndarray, "v 3"]
    faces: np.ndarray
    normals: Float[np.ndarray, "v 3"]


@functools.lru_cache(maxsize=512)  # those of a hand are drawn again and again
def round_shape(shape: Shape) -> Rounded:
    """Return a box, a cylinder or a sphere with rounded edges in the frame of its link.

    It is the convex hull of balls, so its normals are the directions from their centres.
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
    return Rounded(points @ place[:3, :3].T + np.array(shape.xyz), faces, normals @ place[:3, :3].T)


def _box(size: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the centres, directions and radius of the balls of a box's corners."""
    radius = min(EDGE, EDGE_SHARE * min(size))
    grid = [ij for ij in itertools.product(range(STEPS + 1), repeat=3) if sum(ij) == STEPS]
    octant = np.array(grid) / np.linalg.norm(grid, axis=1, keepdims=True)
    signs = np.repeat(list(itertools.product((-1.0, 1.0), repeat=3)), len(octant), axis=0)
    return signs * (np.array(size) / 2 - radius), signs * np.tile(octant, (8, 1)), radius


def _cylinder(radius: float, length: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the centres, directions and radius of the balls along a cylinder's rims."""
    edge = min(EDGE, EDGE_SHARE * min(2.0 * radius, length))
    turn, tilt, side = np.meshgrid(
        np.linspace(0.0, 2 * np.pi, SIDES, endpoint=False), np.linspace(0.0, np.pi / 2, STEPS + 1), (-1.0, 1.0)
    )
    around = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], -1).reshape(-1, 3)
    tilt, up = tilt.reshape(-1, 1), side.reshape(-1, 1) * np.array([0.0, 0.0, 1.0])
    return (radius - edge) * around + (length / 2 - edge) * up, np.cos(tilt) * around + np.sin(tilt) * up, edge
