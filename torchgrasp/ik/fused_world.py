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
    """A grid of distances, or a plane, or nothing, as `kind` 2, 1 and 0 says. The numbers `grown`
    are added to the distance of each sphere's centre to give its clearance.
    """

    kind: int
    values: np.ndarray
    origin: np.ndarray  # of a plane its normal
    shape: np.ndarray
    spacing: float  # of a plane its offset
    grown: np.ndarray


@inlined
def turn(frame, v):
    """Return a direction in the frame in which the columns of a pose, the rows of `frame`, are."""
    turned = scale(frame[0], v[0])
    return add(add(turned, frame[1], v[1]), frame[2], v[2])


@inlined
def place(frame, v):
    """Return a point in that frame."""
    return add(turn(frame, v), frame[3], 1.0)


@inlined
def coarse_clearance(part, p):
    """Return the height over a plane, or the distance at the nearest node of a grid."""
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
    """Return object, obstacles and table of a world, in this order. The spheres in the mask
    `touching` may touch object and table.
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
