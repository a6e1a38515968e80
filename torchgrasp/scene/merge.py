"""Merging of pieces, which are connected smooth surfaces in a depth image, that belong to one
object.

Two pieces belong to one object if they meet at two ends, as a handle and its cup do. So do pieces
of which one is over the footprint of the other. So do pieces that form the rim of a hollow body,
and a piece that floats beside another. Touching pieces also belong to one object, unless both stand
on the table or one lies upon the other.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.parts import label_bodies
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.frames import inverse, rotate
from torchgrasp.geometry.linalg import across, norm, unit
from torchgrasp.geometry.support_planes import Hull
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.table_image import TableImage


@dataclasses.dataclass(frozen=True)
class MergeNumbers:
    """Bounds by which pieces of a segmented image are merged to objects.

    A piece is a connected smooth surface in the image. A body is a group of pieces of one object.
    """

    gap: float = 0.008
    """Distance [m] between points of two pieces below which the pieces touch."""
    touching: int = 3
    """Number of a piece's points, the nearest to another piece, of which the farthest gives the
    gap. With fewer, the gap is not known.
    """
    far: float = 0.05
    """Greatest distance [m] between parts of one object."""
    spacing: float = 0.0015
    """Distance [m] between the points that are kept of a large piece."""
    dense: int = 3000
    """Number of pixels of a piece below which it keeps all its points."""
    small: int = 30
    """Number of points of a piece below which it is no body, and goes to the nearest body."""
    points: int = 2000
    """Greatest number of points, about, that a body keeps: a larger one is thinned."""
    reach: float = 0.02
    """Distance [m] below which two pieces may meet at two ends: pixels at rims are missing."""
    end_depth: float = 0.01
    """Additional distance [m], beyond the least one between two pieces, up to which points belong
    to an end.
    """
    end_gap: float = 0.015
    """Distance [m] between points below which they belong to one end."""
    end_points: int = 6
    """Least number of points of an end."""
    low: float = 0.02
    """Quantile of the heights of a body's points that is its foot."""
    high: float = 0.98
    """Quantile of the heights of a body's points that is its top."""
    nested: float = 0.4
    """Share of a body's points over a larger body's footprint above which the body is a part of it.
    """
    beside: float = 0.3
    """Share of the points of a body over another one, below which the two stand side by side."""
    standing: float = 0.015
    """Height [m] of a body's foot below which the body stands on the table."""
    standing_share: float = 0.5
    """Height of a body's foot, as a share of the height of its top, below which the body stands,
    too: its true foot is hidden.
    """
    lesser: float = 0.1
    """Greatest number of points of a part of another body, such as a knob. It is a share of that
    body's points.
    """
    upon: float = 0.01
    """Least height [m] of the top of a body over that of another one on which it lies."""
    upon_foot: float = 0.5
    """Least height of the foot of a body that lies on another one, as a share of the other's top.
    """
    upon_share: float = 0.5
    """Least share of the points of a body on another one that are over that other body."""
    ring_width: float = 0.025
    """Greatest width [m] of the footprint of a standing ring that is seen from its edge."""
    ring_foot: float = 0.01
    """Least height [m] of the foot of both parts of a standing ring, neither of which stands."""
    level: float = 0.005
    """Greatest difference [m] of the tops of two parts of one rim."""
    rim_gap: float = 0.4
    """Greatest gap between two parts of a rim, as a share of the width of their footprint."""
    rim: float = 0.004
    """Greatest depth [m] below the top of points that belong to a rim."""
    wall: float = 0.012
    """Distance [m] from the outline of the footprint, inside of it, beyond which points are in a
    rim's middle.
    """
    hollow: float = 0.2
    """Share of high points in the middle from which on a body is not hollow."""
    handle: float = 0.7
    """Ratio of the size of a floating body to its neighbour's. A smaller body may be a handle that
    is far off.
    """
    from_above: float = 0.2
    """Least length, in the image, of the unit vector that points down. In a view from above no
    piece has a lower edge.
    """
    below: int = 4
    """Distance [px] from an edge pixel of the pixel that is taken as below it."""
    seen: float = 0.7
    """Least share of the lower edge of a floating piece below which the table is seen."""
    edge: float = 0.1
    """Quantile of the heights of the lower edge that counts as its height."""
    peak: float = 0.9
    """Quantile of the heights of a piece that counts as its top, for a floating piece."""
    floating: float = 0.006
    """Height [m] of the lower edge of a piece above which it floats."""
    floating_share: float = 0.4
    """Least height of the lower edge of a floating piece, as a share of the top of the piece."""


MERGE = MergeNumbers()


def merge_pieces(view: TableImage, pieces: Int[Tensor, "h w"]) -> Int[Tensor, "k"]:
    """Merge the pieces of a depth image to objects; return the number of each piece's object.

    A piece is a connected smooth surface of the image. Entry i of the result is for the piece with
    the number i in `pieces` (h, w). Objects count from 1. Number 0 is no piece, and its entry is 0.
    A small piece far from all objects gets 0, too.
    """
    new = torch.zeros(int(pieces.max()) + 1, dtype=torch.long)
    whole = torch.bincount(pieces.reshape(-1))
    if len(whole) == 1:
        return new
    floating = _floating(view, pieces)
    thin = _thinned(view.image, pieces, whole)
    kept = thin > 0
    names, count = thin[kept].unique(return_counts=True)
    # z is the height above the table (n, 3)
    axes = torch.stack(across(view.support.plane.normal.double()), -1)
    points = torch.cat([view.points @ axes, view.height[..., None]], -1)[kept]
    parts = points[torch.argsort(thin[kept], stable=True)].split(count.tolist())
    gap = _gaps([spatial.KDTree(part.numpy()) for part in parts])
    large = [k for k, part in enumerate(parts) if len(part) >= MERGE.small]
    bodies = [_Body((k,), parts[k], int(whole[names[k]])) for k in large]
    joined = _joined(bodies, gap, floating[names].tolist())
    for number, body in enumerate(joined, start=1):
        new[names[list(body.rows)]] = number
    # smaller pieces go to the nearest large one
    for k in range(len(parts)):
        if large and k not in large and gap[k, large].min() < MERGE.gap:
            new[names[k]] = new[names[large[int(gap[k, large].argmin())]]]
    return new


def _thinned(
    image: DepthImage, pieces: Int[Tensor, "h w"], count: Int[Tensor, "k"]
) -> Int[Tensor, "h w"]:
    """Return the piece numbers at pixels 1.5 mm apart, 0 between them; small pieces keep their
    number everywhere.
    """
    depth = float(image.depth[pieces > 0].median())
    step = max(1, int(MERGE.spacing * image.focal / depth))
    kept = (count < MERGE.dense)[pieces]
    kept[::step, ::step] = True
    return torch.where(kept, pieces, 0)


def find_touching(
    image: DepthImage, points: Float[Tensor, "h w 3"], labels: Int[Tensor, "h w"]
) -> list[tuple[int, int]]:
    """Return the pairs of labels of objects in an image that touch: the border between them is a
    guess.

    Objects touch if the gap between their points is below 4 mm (half of `MERGE.gap`). `labels`
    holds the label of each of the h x w `points` [m] of the image, 0 for none.
    """
    names = labels[labels > 0].unique().tolist()
    if len(names) < 2:
        return []
    labels = _thinned(image, labels, torch.bincount(labels.reshape(-1)))
    gap = _gaps([spatial.KDTree(points[labels == k].numpy()) for k in names])
    return [
        (names[a], names[b])
        for a, b in itertools.combinations(range(len(gap)), 2)
        if gap[a, b] < MERGE.gap / 2
    ]


def _joined(bodies: list["_Body"], gap: np.ndarray, floating: list[bool]) -> list["_Body"]:
    """Join bodies (groups of pieces) to whole objects, given the gaps [m] between pieces and which
    pieces float.
    """

    def between(a: _Body, b: _Body) -> float:
        return float(gap[np.ix_(a.rows, b.rows)].min())

    done: list[_Body] = []
    while bodies:
        body = bodies.pop()
        parts = (x for x in bodies + done if _one_body(body, x, between(body, x)))
        part = next(parts, None)
        if part is None:
            done.append(body)
            continue
        # a joined body is compared with all others again
        bodies = [x for x in bodies if x is not part] + [body + part]
        done = [x for x in done if x is not part]
    for body in [x for x in done if all(floating[row] for row in x.rows)]:
        others = [x for x in done if x is not body]
        if body not in done or not others:
            continue
        nearest = min(others, key=lambda other: between(body, other))
        # a handle may be far from its object: its roots are hidden
        reach = MERGE.far if body.size < MERGE.handle * nearest.size else MERGE.gap
        if between(body, nearest) < reach and not _upon(body, nearest):
            done = [x for x in others if x is not nearest] + [body + nearest]
    return done


def _gaps(trees: list[Any]) -> np.ndarray:
    """Return the gaps [m] between each two point sets (KD-trees). They are 0 if they meet at two
    ends, infinite if they are far apart.
    """
    low = np.stack([tree.mins for tree in trees])
    high = np.stack([tree.maxes for tree in trees])
    gap = np.full((len(trees), len(trees)), np.inf)
    for a, b in itertools.combinations(range(len(trees)), 2):
        small, large = sorted((a, b), key=lambda k: trees[k].n)
        points = trees[small].data
        # only points near the other's bounding box can be near its points
        near = (points > low[large] - MERGE.far) & (points < high[large] + MERGE.far)
        points = points[near.all(-1)]
        if len(points) < MERGE.touching:
            continue
        distance = trees[large].query(points, distance_upper_bound=MERGE.far)[0]
        least = np.partition(distance, MERGE.touching - 1)[MERGE.touching - 1]
        if least < MERGE.reach:
            # a handle or a rim meets its body at two ends
            ends = torch.from_numpy(points[distance < least + MERGE.end_depth])
            count = torch.bincount(label_bodies(ends, gap=MERGE.end_gap))
            least = 0.0 if int((count >= MERGE.end_points).sum()) > 1 else least
        gap[a, b] = least
        gap[b, a] = least
    return gap


class _Body:
    """Pieces of one object: their indices, their number of points, and some of these points.

    Points (n, 3) [m] have z as the height above the table, and `hull` is that of their footprint.
    `foot` and `top` [m] are their lowest and highest heights without outliers.
    """

    def __init__(self, rows: tuple[int, ...], points: Float[Tensor, "n 3"], count: int) -> None:
        self.rows = rows
        self.count = count
        self.points = points[:: 1 + len(points) // MERGE.points]
        self.hull = Hull.of(points[:, :2])
        ends = torch.tensor([MERGE.low, MERGE.high], dtype=points.dtype)
        self.foot, self.top = self.points[:, 2].quantile(ends).tolist()

    def share_over(self, other: "_Body") -> float:
        """Return the share of the points that are over the footprint of another body."""
        return float(other.hull.holds(self.points[:, :2]).double().mean())

    def __add__(self, other: "_Body") -> "_Body":
        points = torch.cat([self.points, other.points])
        return _Body(self.rows + other.rows, points, self.count + other.count)

    @property
    def size(self) -> float:
        """The longest side [m] of the bounding box of the body's points."""
        return float((self.points.amax(0) - self.points.amin(0)).max())

    @property
    def stands(self) -> bool:
        """Whether the body stands on the table."""
        return self.foot < max(MERGE.standing, MERGE.standing_share * self.top)


def _one_body(a: _Body, b: _Body, gap: float) -> bool:
    """Return whether two bodies are one object: they touch, one is over the other's footprint, or
    both form a rim.
    """
    if gap > MERGE.far:
        return False
    small, large = (a, b) if a.count < b.count else (b, a)
    over = small.share_over(large)
    alike = small.count > MERGE.lesser * large.count
    # an object before another one hides it between two ends, too
    two_things = over < MERGE.beside and small.stands and large.stands and alike
    if gap == 0.0 and not two_things:
        return True
    apart = two_things or _upon(small, large)
    if not apart and (gap < MERGE.gap or over > MERGE.nested):
        return True
    # a standing ring from its edge: none of its parts stands
    hull = Hull.of(torch.cat([a.hull.corners, b.hull.corners]))
    if hull.width < MERGE.ring_width and min(a.foot, b.foot) > MERGE.ring_foot:
        return True
    # a rim has one height, and no wide gap
    if abs(a.top - b.top) > MERGE.level or gap > MERGE.rim_gap * hull.width:
        return False
    # only a hollow body has no top in its middle
    both = torch.cat([a.points, b.points])
    rim = both[both[:, 2] > max(a.top, b.top) - MERGE.rim, :2]
    return float(hull.holds(rim, -MERGE.wall).double().mean()) < MERGE.hollow


def _upon(small: _Body, large: _Body) -> bool:
    """Return whether a body is an object that lies upon another one: a lid or a knob is smaller."""
    return (
        small.top > large.top + MERGE.upon
        and small.foot > MERGE.upon_foot * large.top
        and small.count > MERGE.lesser * large.count
        and small.share_over(large) > MERGE.upon_share
    )


def _floating(view: TableImage, pieces: Int[Tensor, "h w"]) -> Bool[Tensor, "k"]:
    """Return a mask of the pieces that float. The table is seen below most of their lower edge,
    which is high.
    """
    image = view.image
    floating = torch.zeros(int(pieces.max()) + 1, dtype=torch.bool)
    normal = view.support.plane.normal.double()
    down = -rotate(inverse(image.obj_from_camera), normal[None])[0, :2]
    if float(norm(down)) < MERGE.from_above:
        return floating
    column, row = torch.round(MERGE.below * unit(down)).long().tolist()
    below = torch.roll(pieces, (-row, -column), (0, 1))
    depth_below = torch.roll(image.depth, (-row, -column), (0, 1))
    edge = (pieces > 0) & (below != pieces) & (depth_below > 0)
    hidden = edge & (below > 0) & (depth_below < image.depth - view.jump)
    free = edge & (below == 0)
    count = torch.bincount(pieces[free], minlength=len(floating))
    whole = count + torch.bincount(pieces[hidden], minlength=len(floating))
    some = (count >= MERGE.touching) & (count >= MERGE.seen * whole)
    for k in flatnonzero(some).tolist():
        mine = pieces == k
        low = float(view.height[mine & free].quantile(MERGE.edge))
        top = float(view.height[mine].quantile(MERGE.peak))
        floating[k] = low > max(MERGE.floating, MERGE.floating_share * top)
    return floating
