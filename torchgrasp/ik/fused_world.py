"""The world of a hand in compiled loops: its parts, and the clearance of points from them.

A pose is an array of its columns. Vectors are tuples of three numbers, or rows of arrays.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.fused import array, inlined
from torchgrasp.geometry.fused_grid import cell_of, inside_grid
from torchgrasp.geometry.fused_vectors import add, dot, scale
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.ik.clearance import CLEARANCE, CollisionWorld


class WorldPart(NamedTuple):
    """A thing that a hand must not touch (the object, the obstacles or the table), for compiled
    loops.

    It is a grid of signed distances, negative inside the thing, or a plane, or nothing. Here s
    counts the collision spheres of the hand.
    """

    kind: int  # 0: nothing; 1: a plane, the table; 2: a grid, of the object or the obstacles
    # signed distances [m] at the grid's nodes, those along z adjacent; empty for a plane
    values: np.ndarray
    # position (3,) [m] of node (0, 0, 0) of the grid; for a plane its unit normal
    origin: np.ndarray
    shape: np.ndarray  # number of nodes (3,) along the three axes; 0 for a plane
    spacing: float  # distance [m] of neighbouring nodes; of a plane its offset from the origin
    # numbers (s,) [m]: the distance of a sphere's centre plus its number is the sphere's clearance;
    # infinite if the sphere may touch this thing
    grown: np.ndarray


@inlined
def turn(frame, v):
    """Return the vector `v` of a frame b in frame a: the rotation of the pose a_from_b.

    The rows of `frame` are the columns of this pose: three axes, then the origin.
    """
    turned = scale(frame[0], v[0])
    return add(add(turned, frame[1], v[1]), frame[2], v[2])


@inlined
def place(frame, v):
    """Return the point `v` [m] of a frame b in frame a: the rotation and translation of a_from_b.

    The rows of `frame` are the columns of this pose: three axes, then the origin [m].
    """
    return add(turn(frame, v), frame[3], 1.0)


@inlined
def coarse_clearance(part, p):
    """Return the distance [m] of a point `p` [m] from a `WorldPart`, without the radius of a
    sphere.

    It is the height over a plane. In a grid it is the signed distance at the node nearest to the
    point.
    """
    if part.kind == 1:
        return dot(p, part.origin) - part.spacing
    number = 0
    for axis in range(3):
        node = inside_grid(part, np.rint(cell_of(part, p, axis)), axis)
        number = number * part.shape[axis] + int(node)
    return part.values[number]


def world_parts(
    radius: Float[Tensor, "s"], touching: Bool[Tensor, "s"], world: CollisionWorld
) -> tuple[WorldPart, ...]:
    """Return the object, the obstacles and the table of `world`, in this order, for compiled loops.

    What does not exist in the world has the `kind` 0. The field `grown` turns distances of the
    spheres' centres into clearances: it is minus their radius. Spheres of fingertips may touch the
    object, so it is infinite there. At the table, their clearance is raised by 4 mm (`CLEARANCE`).

    Args:
        radius: radii (s,) [m] of the s collision spheres of the hand.
        touching: mask (s,) of the spheres on fingertips, which may touch object and table.
        world: what the hand must not touch.
    """
    none = np.zeros(0)
    size = np.zeros(3, np.int64)
    parts = []
    for field in (world.field, world.obstacles and world.obstacles.field):
        if not isinstance(field, SignedDistanceField):
            parts.append(WorldPart(0, none, none, size, 0.0, none))
            continue
        spared = touching & (field is world.field)
        grown = array(torch.where(spared, math.inf, -radius))
        shape = np.array(field.values.shape)
        spacing = float(field.spacing)
        parts.append(WorldPart(2, array(field.nodes), array(field.origin), shape, spacing, grown))
    plane = world.plane
    if plane is None:
        return (*parts, WorldPart(0, none, none, size, 0.0, none))
    # contacts tell how low tips are; a bool times a number would be a float32
    grown = array(CLEARANCE * touching.to(radius) - radius)
    return (*parts, WorldPart(1, none, array(plane.normal), size, float(plane.offset), grown))
