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
def _cell(part, p, axis):
    """Return the coordinate of a point in a grid [nodes]."""
    return (p[axis] - part.origin[axis]) / part.spacing


@inlined
def _inside(part, at, axis):
    """Return the nearest coordinate inside the grid; 0 for NaN, which would be no index."""
    last = part.shape[axis] - 1.0
    at = at if at > 0.0 else 0.0
    return at if at < last else last


@inlined
def coarse_clearance(part, p):
    """Return the height over a plane, or the distance at the nearest node of a grid."""
    if part.kind == 1:
        return dot(p, part.origin) - part.spacing
    number = 0
    for axis in range(3):
        node = _inside(part, np.rint(_cell(part, p, axis)), axis)
        number = number * part.shape[axis] + int(node)
    return part.values[number]


@inlined
def _lerp(a, b, share):
    """Return the number at a share of the way from a to b."""
    return a + share * (b - a)


@inlined
def exact_clearance(part, p):
    """Return distance and gradient, as `DistanceField.query`."""
    x = _cell(part, p, 0)
    y = _cell(part, p, 1)
    z = _cell(part, p, 2)
    inside_x = _inside(part, x, 0)
    inside_y = _inside(part, y, 1)
    inside_z = _inside(part, z, 2)
    nx, ny, nz = part.shape
    i = min(int(inside_x), nx - 2)
    j = min(int(inside_y), ny - 2)
    k = min(int(inside_z), nz - 2)
    fx = inside_x - i
    fy = inside_y - j
    fz = inside_z - k
    at = (i * ny + j) * nz + k
    v = part.values
    low = v[at], v[at + nz], v[at + ny * nz], v[at + ny * nz + nz]
    at += 1
    high = v[at], v[at + nz], v[at + ny * nz], v[at + ny * nz + nz]
    p00 = _lerp(low[0], high[0], fz)
    p01 = _lerp(low[1], high[1], fz)
    p10 = _lerp(low[2], high[2], fz)
    p11 = _lerp(low[3], high[3], fz)
    back = _lerp(p00, p01, fy)
    front = _lerp(p10, p11, fy)
    up_back = _lerp(high[0] - low[0], high[1] - low[1], fy)
    up_front = _lerp(high[2] - low[2], high[3] - low[3], fy)
    slope = front - back, _lerp(p01 - p00, p11 - p10, fx), _lerp(up_back, up_front, fx)
    distance = _lerp(back, front, fx)
    h = part.spacing
    beyond = (x - inside_x) * h, (y - inside_y) * h, (z - inside_z) * h
    away = math.sqrt(dot(beyond, beyond))
    if away == 0.0:
        return distance, scale(slope, 1 / h)
    gx = slope[0] / h if beyond[0] == 0.0 else beyond[0] / away
    gy = slope[1] / h if beyond[1] == 0.0 else beyond[1] / away
    gz = slope[2] / h if beyond[2] == 0.0 else beyond[2] / away
    return distance + away, (gx, gy, gz)


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
