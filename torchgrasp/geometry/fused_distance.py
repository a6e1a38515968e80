"""Distances of points from a triangle mesh as one compiled loop over points.

`MeshSurface.distance` computes the same with a search tree and arrays.
"""

import numpy as np

from torchgrasp.foundation.fused import compiled, inlined
from torchgrasp.geometry.box_tree import Boxes
from torchgrasp.geometry.fused_points import find_nearest
from torchgrasp.geometry.fused_vectors import add, dot, minus
from torchgrasp.geometry.mesh import LEAST_SPAN

LEEWAY = 1.0 + 1e-9  # factor of a squared distance, above the rounding of its sum


def distance(
    points: np.ndarray,
    boxes: Boxes,
    owner: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray,
    tried: int,
) -> np.ndarray:
    """Return the signed distances (n,) [m] of points (n, 3) [m] from a mesh, positive outside.

    Args:
        points: the points, in the frame of the mesh.
        boxes: sample points of the surface, in a tree of boxes.
        owner: index (s,) of the triangle of each of the s samples.
        triangles: corners (f, 3, 3) [m] of the f triangles.
        normals: normals (f, 7, 3) that give the sign: of each triangle's face, sides and corners.
        tried: number of samples nearest to a point, whose triangles are tried. The distance is that
            from the nearest of these triangles.
    """
    found = np.empty(len(points))
    points = np.ascontiguousarray(points, dtype=np.float64)
    numbers = LEAST_SPAN, LEEWAY
    low, high, leaves, index = boxes
    mesh = owner[index], triangles, normals
    _put_distances(points, low, high, leaves, *mesh, tried, numbers, found)
    return found


@inlined
def _gap_from_triangle(point, corners, least_span):
    """Return (gap, feature). The gap is the vector from the closest point of a triangle to a point.
    The feature says where the closest point lies, as in `closest_on_triangles`.
    """
    u = minus(corners[1], corners[0])
    v = minus(corners[2], corners[0])
    w = minus(point, corners[0])
    uu = dot(u, u)
    vv = dot(v, v)
    uv = dot(u, v)
    uw = dot(u, w)
    vw = dot(v, w)
    span = max(uu * vv - uv * uv, least_span)
    s = (vv * uw - uv * vw) / span
    t = (uu * vw - uv * uw) / span
    gap = add(add(w, u, -s), v, -t)
    feature = 0
    if s < 0.0 or t < 0.0 or s + t > 1.0:
        # then the closest point lies on a side
        least = np.inf
        for k in range(3):
            corner = corners[k]
            side = minus(corners[(k + 1) % 3], corner)
            away = minus(point, corner)
            along = min(max(dot(away, side) / dot(side, side), 0.0), 1.0)
            tried = add(away, side, -along)
            squared = dot(tried, tried)
            if squared < least:
                least = squared
                gap = tried
                feature = 1 + k
                if along <= 0.0:
                    feature = 4 + k
                elif along >= 1.0:
                    feature = 4 + (k + 1) % 3
    return gap, feature


@compiled
def _put_distances(points, low, high, samples, owner, triangles, normals, tried, numbers, found):
    """Write the signed distance of each point into `found` (n,).

    Points that follow each other are near each other, as nodes of a grid. So the samples that were
    nearest to the last point bound the distance from this one.
    """
    least_span, leeway = numbers
    boxes = low, high, samples
    size = samples.shape[1]
    kept = np.empty(tried)
    nearest = np.full(tried, -1)
    stack = np.empty(len(low), np.int64)
    for i in range(len(points)):
        point = points[i]
        bound = np.inf if i == 0 else 0.0
        for k in range(tried if i > 0 else 0):
            away = minus(point, samples[nearest[k] // size, nearest[k] % size])
            bound = max(bound, dot(away, away))
        # these samples are found again, whatever the rounding
        kept[:] = bound * leeway
        find_nearest(point, boxes, stack, kept, nearest)
        least = np.inf
        sign = 1.0
        for k in range(tried):
            triangle = owner[nearest[k] // size, nearest[k] % size]
            gap, feature = _gap_from_triangle(point, triangles[triangle], least_span)
            squared = dot(gap, gap)
            if squared < least:
                least = squared
                sign = dot(gap, normals[triangle, feature])
        found[i] = np.copysign(np.sqrt(least), sign)
