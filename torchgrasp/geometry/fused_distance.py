"""Distances of points from a triangle mesh as one compiled loop over points.

`MeshSurface.distance` defines them, by a search tree and with arrays.
"""

from typing import TYPE_CHECKING

import numpy as np

from torchgrasp.foundation.fused import compiled, inlined
from torchgrasp.geometry.fused_vectors import add, dot
from torchgrasp.geometry.mesh import LEAST_SPAN

if TYPE_CHECKING:
    from torchgrasp.geometry.mesh_distance import Boxes, MeshSurface

LEEWAY = 1.0 + 1e-9  # factor of a squared distance, above the rounding of its sum


def distance(
    points: np.ndarray,
    boxes: "Boxes",
    surface: "MeshSurface",
    tried: int,
) -> np.ndarray:
    """Return the signed distances [m] of points (n, 3), by the triangles of the `tried` nearest
    samples.
    """
    found = np.empty(len(points))
    points = np.ascontiguousarray(points, dtype=np.float64)
    numbers = LEAST_SPAN, LEEWAY
    _put_distances(points, *boxes, surface.triangles, surface.normals, tried, numbers, found)
    return found


@inlined
def _minus(a, b):
    """Return the difference of two vectors."""
    return add(a, b, -1.0)


@inlined
def _squared_gap(point, low, high):
    """Return the squared distance of a point from a box."""
    total = 0.0
    for k in range(3):
        gap = max(low[k] - point[k], point[k] - high[k], 0.0)
        total += gap * gap
    return total


@inlined
def _keep_nearest(squared, index, kept, kept_index):
    """Insert a squared distance and its sample into the ascending list of the nearest."""
    k = len(kept) - 1
    while k > 0 and squared < kept[k - 1]:
        kept[k] = kept[k - 1]
        kept_index[k] = kept_index[k - 1]
        k -= 1
    kept[k] = squared
    kept_index[k] = index


@inlined
def _gap_from_triangle(point, corners, least_span):
    """Return (gap, feature). The gap is the vector from the closest point of a triangle to a point.
    The feature says where the closest point lies, as in `closest_on_triangles`.
    """
    u = _minus(corners[1], corners[0])
    v = _minus(corners[2], corners[0])
    w = _minus(point, corners[0])
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
            side = _minus(corners[(k + 1) % 3], corner)
            away = _minus(point, corner)
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


@inlined
def _find_nearest(point, boxes, stack, kept, nearest):
    """Write the nearest samples into `nearest`, which are nearer than `kept`, with their squared
    distances.
    """
    low, high, samples = boxes
    leaves, size, _ = samples.shape
    last = len(kept) - 1
    stack[0] = 1
    top = 1
    while top > 0:
        top -= 1
        box = stack[top]
        if _squared_gap(point, low[box], high[box]) > kept[last]:
            continue
        if box >= leaves:
            leaf = box - leaves
            for j in range(size):
                away = _minus(point, samples[leaf, j])
                squared = dot(away, away)
                if squared < kept[last]:
                    _keep_nearest(squared, leaf * size + j, kept, nearest)
            continue
        # the nearer half is searched first
        halves = 2 * box
        first = _squared_gap(point, low[halves], high[halves])
        second = _squared_gap(point, low[halves + 1], high[halves + 1])
        swapped = second < first
        stack[top] = halves if swapped else halves + 1
        stack[top + 1] = halves + 1 if swapped else halves
        top += 2


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
            away = _minus(point, samples[nearest[k] // size, nearest[k] % size])
            bound = max(bound, dot(away, away))
        # these samples are found again, whatever the rounding
        kept[:] = bound * leeway
        _find_nearest(point, boxes, stack, kept, nearest)
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
