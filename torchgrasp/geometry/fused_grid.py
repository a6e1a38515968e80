"""Distances interpolated in a grid, as compiled loops.

A grid has the fields `values` (n,) [m] of its nodes, `origin` (3,) [m], `shape` (3,) and `spacing`
[m]. The results are those of `DistanceField.query`.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import dot, put, scale


class LookedUp(NamedTuple):
    """A grid of signed distances, negative inside an object, as NumPy arrays for compiled loops.

    It has n nodes, between which the function `query` interpolates. Lengths are in metres, in the
    frame of the object.
    """

    values: np.ndarray  # signed distances (n,) [m] at the nodes, those along z adjacent
    origin: np.ndarray  # position (3,) [m] of node (0, 0, 0)
    shape: np.ndarray  # number of nodes (3,) along each axis
    spacing: float  # distance [m] of neighbouring nodes


def query(
    grid: LookedUp,
    points: Float[Tensor, "*b 3"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
    """Return (distance, gradient) at points (*b, 3) [m], interpolated between the nodes of a grid.

    `distance` (*b,) is the signed distance [m], and `gradient` (*b, 3) its derivative with respect
    to the point (no unit). Points are in the frame of the grid; b stands for any batch axes.
    Outside the grid, the distance [m] from the grid is added to the value at the border.
    """
    distance = points.new_empty(points.shape[:-1])
    gradient = points.new_empty(points.shape)
    flat = array(points).reshape(-1, 3)
    _put_all(grid, flat, distance.numpy().reshape(-1), gradient.numpy().reshape(-1, 3))
    return distance, gradient


@inlined
def cell_of(part, p, axis):
    """Return the coordinate of a point `p` [m] on one axis of a grid, in spacings from node 0.

    `part` is the grid, with the fields of `LookedUp`, and `axis` is 0, 1 or 2.
    """
    return (p[axis] - part.origin[axis]) / part.spacing


@inlined
def inside_grid(part, at, axis):
    """Return the coordinate within a grid that is nearest to the coordinate `at` on one axis.

    Both are in spacings from node 0. NaN gives 0, as it would be no index. `part` is the grid, with
    the fields of `LookedUp`, and `axis` is 0, 1 or 2.
    """
    last = part.shape[axis] - 1.0
    at = at if at > 0.0 else 0.0
    return at if at < last else last


@inlined
def _lerp(a, b, share):
    """Return the number at a share of the way from a to b."""
    return a + share * (b - a)


@inlined
def look_up(part, p):
    """Return (distance, gradient) at a point `p` [m], interpolated in a grid of signed distances.

    The signed distance is in metres, negative inside the object. The gradient is its derivative
    with respect to the point, a tuple of three numbers without unit. `part` is the grid, with the
    fields of `LookedUp`.
    """
    x = cell_of(part, p, 0)
    y = cell_of(part, p, 1)
    z = cell_of(part, p, 2)
    inside_x = inside_grid(part, x, 0)
    inside_y = inside_grid(part, y, 1)
    inside_z = inside_grid(part, z, 2)
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


@compiled
def _put_all(grid, points, distance, gradient):
    """Write distance and gradient at each of the points (n, 3)."""
    for i in range(len(points)):
        distance[i], slope = look_up(grid, points[i])
        put(gradient[i], slope)
