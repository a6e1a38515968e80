"""Which pieces of a depth image are parts of one thing."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.geometry.frames import inverse, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.image import DepthImage

GAP, TOUCH = 0.008, 3
"""Distance [m] within which so many pixels of a piece lie from another when both are one thing."""
LARGE = 30
"""Pixels of a piece that can join others; a smaller one goes to the nearest piece and tells nothing."""
OVERLAP = 0.2
"""Least share of the smaller piece that stands over the convex footprint of the other; things stand side by side."""
STEP = 4
"""Pixels below a piece's edge at which the table, or a nearer piece, is looked for."""
FREE, LEAST_LOW, LOW_SHARE, FLOATING_GAP = 0.7, 0.006, 0.4, 0.013
"""A piece floats when this share of its lower edge is before the table, yet so high above it [m], and so high for its
own height. What floats is a part of the nearest piece, within the last distance [m]."""


def merge_pieces(
    image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]
) -> Int[Tensor, "k"]:
    """Return the number of the thing of each piece, 0 for the piece 0.

    Pieces are one thing if they nearly touch, if one stands over the footprint of the other, or if one floats beside
    the other.

    Args:
        image: with smoothed depth.
        pieces: number of the piece of each pixel, 0 for none.
        table: the plane below.
        jump: difference of depth [m] that parts two surfaces.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    rows = pieces > 0
    new = torch.zeros(int(pieces.max()) + 1, dtype=torch.long)
    names, number, count = pieces[rows].unique(return_inverse=True, return_counts=True)
    large = count >= LARGE
    if not bool(large.any()):
        return new
    place = image.points()[rows]
    parts = [place[number == k] for k in torch.nonzero(large)[:, 0].tolist()]
    floating = _floating(image, pieces, table, jump)[names[large]].tolist()
    joined = _join(parts, [_Footprint(part, table) for part in parts], floating)
    i, j = np.array(joined, dtype=int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(i), dtype=bool), (i, j)), shape=(len(parts), len(parts)))
    new[names[large]] = torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64)) + 1
    tree, owner = KDTree(torch.cat(parts).numpy()), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    for k in torch.nonzero(~large)[:, 0].tolist():
        distance, index = tree.query(place[number == k].numpy(), distance_upper_bound=GAP)
        if np.isfinite(distance).sum() >= TOUCH:
            new[names[k]] = new[names[large]][int(owner[np.asarray(index)[distance.argmin()]])]
    return new


def _join(parts: list[Tensor], footprints: "list[_Footprint]", floating: list[bool]) -> list[tuple[int, int]]:
    """Return the pairs of pieces that are one thing."""
    from scipy.spatial import KDTree

    trees: list[KDTree] = [KDTree(part.numpy()) for part in parts]
    low, high = np.stack([tree.mins for tree in trees]), np.stack([tree.maxes for tree in trees])
    joined: list[tuple[int, int]] = []
    for a in range(len(parts)):
        between = np.linalg.norm(np.maximum(0, np.maximum(low[a] - high, low - high[a])), axis=-1)
        nearest, least = -1, FLOATING_GAP
        for b in np.nonzero(between < FLOATING_GAP)[0].tolist():
            if b == a:
                continue
            small, large = (a, b) if len(parts[a]) < len(parts[b]) else (b, a)
            distance = trees[large].query(trees[small].data, distance_upper_bound=FLOATING_GAP)[0]
            if distance.min() < least:
                nearest, least = b, float(distance.min())
            touches = (distance < GAP).sum() >= TOUCH
            if b < a and (touches or footprints[large].share_of(parts[small]) > OVERLAP):
                joined.append((a, b))
        if floating[a] and nearest >= 0:
            joined.append((a, nearest))
    return joined


class _Footprint:
    """The convex hull of points seen from above."""

    def __init__(self, points: Float[Tensor, "n 3"], table: Plane):
        from scipy.spatial import ConvexHull, QhullError

        normal = table.normal.double()
        x = unit(torch.linalg.cross(normal, torch.eye(3, dtype=torch.float64)[int(normal.abs().argmin())]))
        self.axes = torch.stack([x, torch.linalg.cross(normal, x)], -1)
        try:
            self.sides = torch.from_numpy(ConvexHull((points @ self.axes).numpy()).equations)
        except QhullError:  # all on a line
            self.sides = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)

    def share_of(self, points: Float[Tensor, "n 3"]) -> float:
        """Return the share of points that stand over the hull."""
        inside = (points @ self.axes @ self.sides[:, :2].T + self.sides[:, 2] < 0).all(-1)
        return float(inside.double().mean())


def _floating(image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]) -> Tensor:
    """Tell which pieces float: the table is seen below their lower edge, and that edge is high."""
    floating = torch.zeros(int(pieces.max()) + 1, dtype=torch.bool)
    down = -rotate(inverse(image.obj_from_camera), table.normal.double()[None])[0, :2]
    if float(torch.linalg.vector_norm(down)) < 0.2:  # seen from above, no edge is the lower one
        return floating
    column, row = torch.round(STEP * unit(down)).long().tolist()
    below, depth_below = (torch.roll(x, (-row, -column), (0, 1)) for x in (pieces, image.depth))
    edge = (pieces > 0) & (below != pieces) & (depth_below > 0)
    hidden = edge & (below > 0) & (depth_below < image.depth - jump)
    free = edge & (below == 0)
    height = table.height(image.points())
    for k in pieces[free].unique().tolist():
        mine = free & (pieces == k)
        count = int(mine.sum())
        if count >= TOUCH and count >= FREE * (count + int((hidden & (pieces == k)).sum())):
            low, top = float(height[mine].quantile(0.1)), float(height[pieces == k].quantile(0.9))
            floating[k] = low > max(LEAST_LOW, LOW_SHARE * top)
    return floating
