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
    """Return (mirrored, distance, cosine): k points of a cloud mirrored in p planes, and their
    match.

    `mirrored` (p, k, 3) [m] are the mirrored points. `distance` (p, k) [m] is that from the nearest
    point of the cloud. `cosine` (p, k) is that of the angle between the mirrored normal and the
    cloud's normal there.

    Args:
        probes: the k points (k, 3) [m], and their unit normals (k, 3).
        normals: unit normals (n, 3) of the cloud's n points.
        boxes: the cloud's points in a tree of boxes.
        planes: p planes n . x = o as (n, o), with a unit normal n and an offset o [m].
        far: distance [m] beyond which no match is sought. There the distance is infinity, and the
            cosine is that with the cloud's first normal.
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
    """Return (away, visible, own): where points (*b, 3) [m] are in a silhouette, each (*b,).

    `away` is the signed distance from the outline in the image plane at depth 1, positive outside
    (no unit). `visible` is the depth [m] of the surface seen there, and `own` that of the point.

    Args:
        points: the points, in the frame of the cloud.
        camera: position (3,) [m] of the camera, its axes (3, 3), and the first node (2,) of the
            rasters.
        cell: distance of neighbouring nodes at depth 1.
        rasters: distance from the outline (h, w), and depth [m] (h, w), at the nodes.
        least_depth: least depth [m] of a point: `own` is not less.
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
