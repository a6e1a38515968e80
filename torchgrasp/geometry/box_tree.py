"""A balanced tree of boxes around points, in arrays that compiled loops search."""

import math
from typing import NamedTuple

import numpy as np

LEAF = 32  # most points in a leaf: a loop tries them faster than it opens further boxes


class Boxes(NamedTuple):
    """A balanced tree of boxes around points of any unit, in which nearest points are sought.

    Box 1 is the root, and box i holds boxes 2 i and 2 i + 1. There is no box 0. The last l boxes
    are leaves, which hold s points each, the last one filled up with NaN.
    """

    low: np.ndarray  # least coordinates (2 l, 3) of the points in a box
    high: np.ndarray  # greatest coordinates (2 l, 3) of the points in a box
    points: np.ndarray  # points (l, s, 3) of each leaf; the last leaf is filled up with NaN
    # index (l, s) of each of these points in the array from which the tree was made
    rows: np.ndarray


def sort_into_boxes(points: np.ndarray) -> Boxes:
    """Return a tree of boxes around points (n, 3), in which nearest points are sought.

    Each box is halved across its longest side, so that its halves hold equally many points. A leaf
    holds at most 32 points (`LEAF`).
    """
    leaves = 2 ** max(math.ceil(math.log2(len(points) / LEAF)), 0)
    missing = -len(points) % leaves
    # NaN comes last, and is neither the least nor the greatest of several
    left = np.pad(points.T, ((0, 0), (0, missing)), constant_values=np.nan)
    index = np.pad(np.arange(len(points)), (0, missing))
    low = []
    high = []
    for boxes in 2 ** np.arange(leaves.bit_length()):
        left = left.reshape(3, boxes, -1)
        index = index.reshape(boxes, -1)
        low.append(np.fmin.reduce(left, 2))
        high.append(np.fmax.reduce(left, 2))
        if boxes < leaves:
            longest = (high[-1] - low[-1]).argmax(0)
            along = np.take_along_axis(left, longest[None, :, None], 0)[0]
            order = np.argpartition(along, along.shape[1] // 2, 1)
            left = np.take_along_axis(left, order[None], 2)
            index = np.take_along_axis(index, order, 1)
    low, high = (np.concatenate([each[0], *each], 1).T.copy() for each in (low, high))
    return Boxes(low, high, left.transpose(1, 2, 0).copy(), index)
