"""Merging of pieces, which are connected smooth surfaces in a depth image, that belong to one
object.

Two pieces belong to one object if they meet at two ends, as a handle and its cup do; if one is over
the footprint of the other; if they form the rim of a hollow body; or if one floats beside the
other. Touching pieces also belong to one object, unless both stand on the table or one lies upon
the other.
"""

import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.parts import label_bodies
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.frames import inverse, rotate
from torchgrasp.geometry.linalg import across, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import Hull
from torchgrasp.scene.image import DepthImage

GAP = 0.008
TOUCH = 3
FAR = 0.05
"""Pieces touch where TOUCH pixels are within GAP [m]; parts of one object are within FAR [m]."""
REACH = (
    0.02  # greatest distance [m] of two pieces that meet at two ends: pixels at rims are missing
)
NESTED = (
    0.4  # a body with this share of its points over the footprint of a larger one is a part of it
)


def merge_pieces(
    image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]
) -> Tensor:
    """Return, for each piece number, the number of the piece's object; 0 for number 0 and for
    pieces of no object.
    """
    new = torch.zeros(int(pieces.max()) + 1, dtype=torch.long)
    whole = torch.bincount(pieces.reshape(-1))
    if len(whole) == 1:
        return new
    floating = _floating(image, pieces, table, jump)
    thin = _thinned(image, pieces, whole)
    names, count = thin[thin > 0].unique(return_counts=True)
    order = torch.argsort(thin[thin > 0], stable=True)
    axes = torch.stack(across(table.normal.double()), -1)
    points = image.points()
    points = torch.cat(
        [points @ axes, table.height(points)[..., None]], -1
    )  # z is the height above the table
    parts = points[thin > 0][order].split(count.tolist())
    gap = _gaps([spatial.KDTree(part.numpy()) for part in parts])
    large = [k for k in range(len(parts)) if len(parts[k]) >= 30]
    bodies = _joined(
        [_Body((k,), parts[k], int(whole[names[k]])) for k in large], gap, floating[names].tolist()
    )
    for number, body in enumerate(bodies, start=1):
        new[names[list(body.rows)]] = number
    for k in range(len(parts)):  # smaller pieces go to the nearest large one
        if large and k not in large and gap[k, large].min() < GAP:
            new[names[k]] = new[names[large[int(gap[k, large].argmin())]]]
    return new


def _thinned(
    image: DepthImage, pieces: Int[Tensor, "h w"], count: Int[Tensor, "k"]
) -> Int[Tensor, "h w"]:
    """Return the piece numbers at pixels 1.5 mm apart, 0 between them; small pieces keep their
    number everywhere.
    """
    step = max(
        1, int(0.0015 * float(image.intrinsics[0, 0]) / float(image.depth[pieces > 0].median()))
    )
    kept = (count < 3000)[pieces]
    kept[::step, ::step] = True
    return torch.where(kept, pieces, 0)


def find_touching(image: DepthImage, labels: Int[Tensor, "h w"]) -> list[tuple[int, int]]:
    """Return the pairs of labels of objects that touch, so that the border between the objects is a
    guess.
    """
    names = labels[labels > 0].unique().tolist()
    points = image.points()
    if len(names) < 2:
        return []
    labels = _thinned(image, labels, torch.bincount(labels.reshape(-1)))
    gap = _gaps([spatial.KDTree(points[labels == k].numpy()) for k in names])
    return [
        (names[a], names[b])
        for a, b in itertools.combinations(range(len(gap)), 2)
        if gap[a, b] < 0.5 * GAP
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
        parts = [other for other in bodies + done if _one_body(body, other, between(body, other))][
            :1
        ]
        bodies, done = ([other for other in some if other not in parts] for some in (bodies, done))
        (bodies if parts else done).append(sum(parts, body))
    for body in [
        body for body in done if all(floating[row] for row in body.rows)
    ]:  # the roots of a handle are hidden
        others = [other for other in done if other is not body]
        nearest = min(others, key=lambda other: between(body, other), default=body)
        reach = FAR if body.size < 0.7 * nearest.size else GAP
        if (
            body in done
            and nearest is not body
            and between(body, nearest) < reach
            and not _upon(body, nearest)
        ):
            done = [other for other in others if other is not nearest] + [body + nearest]
    return done


def _gaps(trees: list[Any]) -> np.ndarray:
    """Return the gaps [m] between each two point sets (KD-trees): 0 if they meet at two ends,
    infinite beyond `FAR`.
    """
    low = np.stack([tree.mins for tree in trees])
    high = np.stack([tree.maxes for tree in trees])
    gap = np.full((len(trees), len(trees)), np.inf)
    for a, b in itertools.combinations(range(len(trees)), 2):
        small, large = sorted((a, b), key=lambda k: trees[k].n)
        rows = (
            (trees[small].data > low[large] - FAR) & (trees[small].data < high[large] + FAR)
        ).all(-1)
        if rows.sum() >= TOUCH:
            points = trees[small].data[rows]
            distance = trees[large].query(points, distance_upper_bound=FAR)[0]
            least = np.partition(distance, TOUCH - 1)[TOUCH - 1]
            if least < REACH:  # a handle or a rim meets its body at two ends
                ends = label_bodies(torch.from_numpy(points[distance < least + 0.01]), gap=0.015)
                least = 0.0 if int((torch.bincount(ends) >= 6).sum()) > 1 else least
            gap[a, b] = gap[b, a] = least
    return gap


class _Body:
    """Pieces of one object: their indices, their number of points, some points, and the hull of
    their footprint.
    """

    def __init__(self, rows: tuple[int, ...], points: Float[Tensor, "n 3"], count: int) -> None:
        self.rows = rows
        self.count = count
        self.points = points[:: 1 + len(points) // 2000]
        self.hull = Hull.of(points[:, :2])
        self.foot, self.top = (
            self.points[:, 2].quantile(torch.tensor([0.02, 0.98], dtype=points.dtype)).tolist()
        )

    def share_over(self, other: "_Body") -> float:
        """Return the share of the points that are over the footprint of another body."""
        return float(other.hull.holds(self.points[:, :2]).double().mean())

    def __add__(self, other: "_Body") -> "_Body":
        return _Body(
            self.rows + other.rows, torch.cat([self.points, other.points]), self.count + other.count
        )

    @property
    def size(self) -> float:
        """The longest side [m] of the bounding box of the body's points."""
        return float((self.points.amax(0) - self.points.amin(0)).max())


def _one_body(a: _Body, b: _Body, gap: float) -> bool:
    """Return whether two bodies are one object: they touch, one is over the other's footprint, or
    both form a rim.
    """
    if gap == 0.0 or gap > FAR:
        return gap == 0.0
    small, large = (a, b) if a.count < b.count else (b, a)
    over = small.share_over(large)
    beside = over < 0.3 and all(body.foot < max(0.015, 0.5 * body.top) for body in (small, large))
    apart = (beside and small.count > 0.1 * large.count) or _upon(
        small, large
    )  # side by side, or one upon the other
    if not apart and (gap < GAP or over > NESTED):
        return True
    hull = Hull.of(torch.cat([a.hull.corners, b.hull.corners]))
    if (
        hull.width < 0.025 and min(a.foot, b.foot) > 0.01
    ):  # a standing ring from its edge: none of its parts stands
        return True
    if (
        abs(a.top - b.top) > 0.005 or gap > 0.4 * hull.width
    ):  # two heights, or a wide gap in the rim
        return False
    both = torch.cat([a.points, b.points])
    high = both[
        both[:, 2] > max(a.top, b.top) - 0.004, :2
    ]  # only a hollow body has no top in its middle
    return float(hull.holds(high, -0.012).double().mean()) < 0.2


def _upon(small: _Body, large: _Body) -> bool:
    """Return whether a body is an object that lies upon another one: a lid or a knob is smaller."""
    higher = small.top > large.top + 0.01 and small.foot > 0.5 * large.top
    return higher and small.count > 0.1 * large.count and small.share_over(large) > 0.5


def _floating(
    image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]
) -> Tensor:
    """Return a mask of the pieces that float: the table is seen below most of their lower edge,
    which is high.
    """
    floating = torch.zeros(int(pieces.max()) + 1, dtype=torch.bool)
    down = -rotate(inverse(image.obj_from_camera), table.normal.double()[None])[0, :2]
    if float(torch.linalg.vector_norm(down)) < 0.2:  # seen from above, no edge is the lower one
        return floating
    column, row = torch.round(4 * unit(down)).long().tolist()
    below, depth_below = (torch.roll(x, (-row, -column), (0, 1)) for x in (pieces, image.depth))
    edge = (pieces > 0) & (below != pieces) & (depth_below > 0)
    hidden = edge & (below > 0) & (depth_below < image.depth - jump)
    free = edge & (below == 0)
    height = table.height(image.points())
    count = torch.bincount(pieces[free], minlength=len(floating))
    some = (count >= TOUCH) & (
        count >= 0.7 * (count + torch.bincount(pieces[hidden], minlength=len(floating)))
    )
    for k in torch.nonzero(some)[:, 0].tolist():
        mine = pieces == k
        low = float(height[mine & free].quantile(0.1))
        top = float(height[mine].quantile(0.9))
        floating[k] = low > max(0.006, 0.4 * top)
    return floating
