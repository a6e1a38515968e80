"""Nearest and farthest points, as compiled loops."""

import numpy as np

from torchgrasp.foundation.fused import compiled, inlined
from torchgrasp.geometry.box_tree import Boxes
from torchgrasp.geometry.fused_vectors import dot, insert, minus


def nearest(points: np.ndarray, boxes: Boxes, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (distance, index) of the point in `boxes` that is nearest to each of n points (n, 3).

    The distance (n,) is in the points' unit. The index (n,) is that in the array from which `boxes`
    was made. Where no point is nearer than `limit`, distance and index are infinity and 0.
    """
    distance = np.empty(len(points))
    index = np.empty(len(points), np.int64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    _put_nearest(points, *boxes, limit * limit, distance, index)
    return distance, index


def farthest(points: np.ndarray, count: int, first: int, tie: float) -> np.ndarray:
    """Return the indices of `count` of n points (n, d), each the farthest from all those before it.

    The choice begins with the point of the index `first`. Points count as equally far if their
    squared distance is at least (1 - `tie`) times the greatest one. The first of them is taken.
    `tie` has no unit.
    """
    picks = np.full(count, first)
    _put_farthest(np.ascontiguousarray(points), tie, picks)
    return picks


@inlined
def _squared_gap(point, low, high):
    """Return the squared distance of a point from a box."""
    total = 0.0
    for k in range(3):
        gap = max(low[k] - point[k], point[k] - high[k], 0.0)
        total += gap * gap
    return total


@inlined
def find_nearest(point, boxes, stack, kept, nearest):
    """Write the indices of the points in `boxes` that are nearest to a `point` into `nearest`.

    An index counts the points of all leaves, leaf by leaf, and not those of the array that was
    sorted. As many points are found as `nearest` has entries.

    Args:
        point: the point, three numbers.
        boxes: the tree (`Boxes`) of the points.
        stack: integers, the memory for the search.
        kept: squared distances, ascending, up to which points are taken; those of the found points
            replace them.
        nearest: indices of the found points, in the order of `kept`. Where fewer are within `kept`,
            entries stay as they were.
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
                away = minus(point, samples[leaf, j])
                squared = dot(away, away)
                if squared < kept[last]:
                    insert(kept, nearest, squared, leaf * size + j)
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
def _put_nearest(points, low, high, leaves, order, limit, distance, index):
    """Write the results of `nearest`; `limit` is squared."""
    boxes = low, high, leaves
    stack = np.empty(len(low), np.int64)
    kept = np.empty(1)
    found = np.empty(1, np.int64)
    size = leaves.shape[1]
    for i in range(len(points)):
        kept[0] = limit
        found[0] = -1
        find_nearest(points[i], boxes, stack, kept, found)
        distance[i] = np.inf
        index[i] = 0
        if found[0] >= 0:
            distance[i] = np.sqrt(kept[0])
            index[i] = order[found[0] // size, found[0] % size]


@compiled
def _put_farthest(points, tie, picks):
    """Write the choice of `farthest`, whose first index `picks` has."""
    n, d = points.shape
    gap = np.full(n, np.inf)
    for k in range(1, len(picks)):
        most = 0.0
        for i in range(n):
            squared = 0.0
            for j in range(d):
                off = points[i, j] - points[picks[k - 1], j]
                squared += off * off
            gap[i] = min(gap[i], squared)
            most = max(most, gap[i])
        # the first of the largest
        for i in range(n):
            if gap[i] >= (1.0 - tie) * most:
                picks[k] = i
                break
