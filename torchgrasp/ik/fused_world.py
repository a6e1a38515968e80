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
    """A part of a hand's surroundings: a grid of distances [m] (`kind` 2), a plane (1), or nothing
    (0).

    The numbers `grown` (s,) [m] are added to the distance of each sphere's centre to give its
    clearance.
    """

    kind: int
    values: np.ndarray  # distances [m] at the grid's nodes, in one row; empty for a plane
    origin: np.ndarray  # first node [m] of the grid; of a plane its unit normal
    shape: np.ndarray  # numbers of nodes along the three axes
    spacing: float  # distance [m] of neighbouring nodes; of a plane its offset from the origin
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
    """Return the height [m] of a point `p` [m] over a plane; of a grid, the distance [m] at the
    nearest node.
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
    """Return object, obstacles and table of a world, in this order; what does not exist has kind 0.

    `radius` [m] holds the radii of s collision spheres. The spheres in the mask `touching` may
    touch object and table.
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
