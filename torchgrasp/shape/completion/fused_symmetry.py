"""Mirror images of a cloud's points beside the cloud and its outline, as compiled loops."""

import math

import numpy as np
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.box_tree import Boxes
from torchgrasp.geometry.fused_points import find_nearest
from torchgrasp.geometry.fused_vectors import add, dot, minus, put


def match_images(
    probes: tuple[Tensor, Tensor], normals: Tensor, boxes: Boxes, planes: Tensor, far: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the probes (p, k, 3) [m] mirrored in p planes, their distances (p, k) [m] from the
    nearest points of the cloud, and the cosines (p, k) of the normals there.

    `probes` are k points [m] and their unit normals. `planes` (p, 4) are (n, o) for planes n . x =
    o, with a unit normal n and an offset o [m]. `boxes` hold the n points of the cloud, and
    `normals` (n, 3) are theirs. Beyond `far` [m] the distance is infinity, and the cosine that with
    the first normal.
    """
    p = len(planes)
    k = len(probes[0])
    mirrored = planes.new_empty(p, k, 3)
    distance = planes.new_empty(p, k)
    cosine = planes.new_empty(p, k)
    given = (*map(array, (*probes, normals, planes)), *boxes, far * far)
    _put_images(*given, *(x.numpy() for x in (mirrored, distance, cosine)))
    return mirrored, distance, cosine


@compiled
def _put_images(
    points, turned, normals, planes, low, high, leaves, order, limit, mirrored, distance, cosine
):
    """Write the results of `match_images`; `limit` is squared."""
    boxes = low, high, leaves
    stack = np.empty(len(low), np.int64)
    kept = np.empty(1)
    found = np.empty(1, np.int64)
    size = leaves.shape[1]
    for j in range(len(points)):
        found[0] = -1
        for i in range(len(planes)):
            plane = planes[i]
            x = add(points[j], plane, -2.0 * (dot(points[j], plane) - plane[3]))
            # the plane before is often near, and so is its nearest point
            kept[0] = limit
            if found[0] >= 0:
                way = minus(x, leaves[found[0] // size, found[0] % size])
                kept[0] = dot(way, way)
                if not kept[0] < limit:
                    kept[0] = limit
                    found[0] = -1
            find_nearest(x, boxes, stack, kept, found)
            row = 0
            distance[i, j] = np.inf
            if found[0] >= 0:
                distance[i, j] = math.sqrt(kept[0])
                row = order[found[0] // size, found[0] % size]
            normal = add(turned[j], plane, -2.0 * dot(turned[j], plane))
            cosine[i, j] = dot(normal, normals[row])
            put(mirrored[i, j], x)


def look_up(
    points: Tensor,
    camera: tuple[Tensor, Tensor, Tensor],
    cell: float,
    rasters: tuple[Tensor, Tensor],
    least_depth: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return each point's distance from an outline, the depth [m] seen there, and its own depth
    [m].

    The `points` (*b, 3) are in metres. The signed distance is that in the image plane at depth 1,
    positive outside (no unit). `camera` holds the camera's position [m], its axes, and the first
    node of the silhouette's rasters. `cell` is the distance of neighbouring nodes at depth 1.
    `rasters` hold distance and depth at the nodes. Own depths are at least `least_depth` [m].
    """
    shape = points.shape[:-1]
    rows = array(points.reshape(-1, 3))
    found = tuple(points.new_empty(len(rows)) for _ in range(3))
    given = (rows, *map(array, camera), cell, *map(array, rasters), least_depth)
    _put_views(*given, *(x.numpy() for x in found))
    return found[0].reshape(shape), found[1].reshape(shape), found[2].reshape(shape)


@inlined
def _within(position, count):
    """Return the nearest place on an axis of so many nodes."""
    if position > 0.0:
        return min(position, count - 1.0)
    return 0.0


@compiled
def _put_views(
    points, viewpoint, axes, corner, cell, outside, depth, least_depth, away, visible, own
):
    """Write the results of `look_up`."""
    rows, columns = outside.shape
    for i in range(len(points)):
        local = minus(points[i], viewpoint)
        own[i] = max(dot(local, axes[2]), least_depth)
        x = (dot(local, axes[0]) / own[i] - corner[0]) / cell
        y = (dot(local, axes[1]) / own[i] - corner[1]) / cell
        x_in = _within(x, columns)
        y_in = _within(y, rows)
        # as torch, to the even one of two
        column = int(np.rint(x_in))
        row = int(np.rint(y_in))
        away[i] = outside[row, column] + math.sqrt((x - x_in) ** 2 + (y - y_in) ** 2) * cell
        visible[i] = depth[row, column]
