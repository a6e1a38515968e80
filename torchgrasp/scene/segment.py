"""The objects in a depth image: what rises above the table, divided where the depth jumps, and merged again.

Pieces of one object touch, are over each other's footprint, make one hollow body's rim, or float beside it.
"""

import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.sensor import fit_noise
from torchgrasp.geometry.frames import inverse, rotate
from torchgrasp.geometry.linalg import across, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support import Hull, Support
from torchgrasp.scene.image import DepthImage, label_radii

BAND = 0.010  # heights [m] below this, of either sign, measure the noise of the table
LEAST_HEIGHT = 0.002  # least height [m] of an object's pixels above the table
NEAR = 0.005  # distance [m] within which a pixel at a depth jump belongs to an object
FEW = 6  # pieces with fewer pixels are noise
GAP, TOUCH, FAR = 0.008, 3, 0.05
"""Pieces touch where TOUCH pixels are within GAP [m]; parts of one object are within FAR [m]."""
NESTED = 0.4  # a body with this share of its points over the footprint of a larger one is a part of it
OVERHANG = 0.05  # distance [m] to which an object extends beyond the visible region of its support
VAST = 0.2  # greatest root mean square distance [m] of an object's points from their middle; a wall has more


def segment(image: DepthImage, support: Support) -> Int[Tensor, "h w"]:
    """Return the label of each pixel: 0 for the table, flying pixels and nothing; 1, 2, ... for objects by size.

    An object is a connected component of the pixels above the table, in which depth has no jump. Pixels at jumps go to
    the object whose surface they lie on, if there is one.

    Args:
        image: one view of the scene.
        support: the plane that the objects stand on, in the frame of the image; what is beside its region is no object.
    """
    table, points = support.plane, image.points()
    measured, smooth = image.depth > 0, image.without_speckle()
    mean, threshold = _smoothed(image, table)
    risen = _risen(smooth, table, mean, threshold)
    risen[risen.clone()] = support.covers(points[risen], OVERHANG)
    core, jump = _core(smooth, risen)
    pieces = _grown(points, _components(core, smooth.depth, jump), risen)
    thin = _components(risen & (pieces == 0), smooth.depth, jump)
    pieces = torch.where((pieces == 0) & (thin > 0), pieces.max() + thin, pieces)
    sure = core | (thin > 0)
    # A tenth of an object's pixels are 3.5 mm high and four deviations of the noise; an uneven table is not.
    flat, whole = measured & (mean.abs() < BAND), count_labels(pieces)
    noise = fit_noise(image.depth[flat], mean[flat]).sigma(image.depth)
    high = count_labels(torch.where(mean > (4 * noise).clamp_min(0.0035), pieces, 0), len(whole)) >= 0.1 * whole
    few = count_labels(torch.where(sure, pieces, 0), len(high)) < FEW
    over = pieces[pieces > 0][support.covers(points[pieces > 0])]
    beside = count_labels(over, len(high)) < 0.2 * whole
    vast = label_radii(points, pieces) > VAST
    pieces = torch.where((few | ~high | beside | vast)[pieces], 0, pieces)
    group = _merge(smooth, torch.where(sure, pieces, 0), table, jump)
    return _numbered(_filled(group[pieces], measured, table.height(points)))


def on_surface(image: DepthImage, table: Plane) -> Bool[Tensor, "h w"]:
    """Return which pixels rise above the table and lie on a surface; flying pixels do not."""
    smooth = image.without_speckle()
    risen = _risen(smooth, table, *_smoothed(image, table))
    return _grown(image.points(), _core(smooth, risen)[0].long(), risen) > 0


def _smoothed(image: DepthImage, table: Plane) -> tuple[Tensor, Tensor]:
    """Return the mean height of the 5 x 5 pixels about each, and the least height of an object there."""
    from scipy.ndimage import uniform_filter

    measured, height = image.depth > 0, table.height(image.points())
    near = measured & (height.abs() < 3 * BAND)  # at an object's foot, without its distant neighbours
    share = torch.from_numpy(uniform_filter(near.double().numpy(), 5))
    total = torch.from_numpy(uniform_filter(torch.where(near, height, 0.0).numpy(), 5))
    mean = torch.where(near, total / share.clamp_min(1e-9), height)
    squared = image.depth.square()
    flat = measured & (mean.abs() < BAND)
    noise = 1.4826 * float((mean.abs() / squared)[flat].median()) if bool(flat.any()) else 0.0
    return mean, (2.5 * noise * squared).clamp_min(LEAST_HEIGHT)


def _risen(smooth: DepthImage, table: Plane, mean: Tensor, threshold: Tensor) -> Bool[Tensor, "h w"]:
    """Return which pixels rise above the table, with their neighbours and by themselves."""
    return (smooth.depth > 0) & (mean > threshold) & (table.height(smooth.points()) > 0.6 * threshold)


def _core(smooth: DepthImage, risen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the risen pixels away from jumps, and the difference of depth [m] that is a jump."""
    from scipy.ndimage import maximum_filter, minimum_filter

    depth = smooth.depth
    jump = 0.006 + 2.0 * depth / float(smooth.intrinsics[0, 0])
    farthest = torch.from_numpy(maximum_filter(torch.where(depth > 0, depth, 0.0).numpy(), 3))
    nearest = torch.from_numpy(minimum_filter(torch.where(depth > 0, depth, 100.0).numpy(), 3))
    return risen & ~((farthest - depth > jump) | (depth - nearest > jump)), jump


def _components(core: Tensor, depth: Tensor, jump: Tensor) -> Int[Tensor, "h w"]:
    """Return the number of the connected component of each core pixel, from 1; 0 elsewhere."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    h, w = core.shape
    index = torch.arange(h * w).reshape(h, w)
    edges = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)):
        a = (slice(0, h - down), slice(max(0, -right), w - max(0, right)))
        b = (slice(down, h), slice(max(0, right), w - max(0, -right)))
        joined = core[a] & core[b] & ((depth[a] - depth[b]).abs() < jump[a])
        edges.append(torch.stack([index[a][joined], index[b][joined]]))
    pairs = torch.cat(edges, 1).numpy()
    graph = coo_matrix((np.ones(pairs.shape[1], dtype=bool), tuple(pairs)), shape=(h * w, h * w))
    number = torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))
    return torch.where(core, number.reshape(h, w) + 1, 0)


def _grown(points: Tensor, labels: Tensor, risen: Tensor) -> Int[Tensor, "h w"]:
    """Give risen pixels without a label, pass by pass, that of the nearest labelled point within `NEAR`."""
    from scipy.spatial import KDTree

    labels = torch.where((count_labels(labels) < FEW)[labels], 0, labels).reshape(-1)
    place, loose = points.reshape(-1, 3).numpy(), torch.nonzero(risen.reshape(-1) & (labels == 0))[:, 0]
    new = torch.nonzero(labels)[:, 0]
    for _ in range(12):
        if not len(new) or not len(loose):
            break
        distance, index = KDTree(place[new.numpy()]).query(place[loose.numpy()], distance_upper_bound=NEAR)
        found = torch.from_numpy(np.isfinite(distance))
        labels[loose[found]] = labels[new[torch.from_numpy(index)[found]]]
        new, loose = loose[found], loose[~found]
    return labels.reshape(risen.shape)


def _filled(labels: Tensor, measured: Tensor, height: Tensor) -> Int[Tensor, "h w"]:
    """Give the floor within an object, such as a pan's, the object's label: it is enclosed and above the table."""
    from scipy.ndimage import binary_dilation, find_objects, label

    holes = np.empty(labels.shape, dtype=np.int32)
    label((measured & (labels == 0)).numpy(), output=holes)
    whole = labels.clone()
    boxes: list[tuple[slice, slice]] = find_objects(holes)
    for number, box in enumerate(boxes, start=1):
        row, column = (slice(max(0, side.start - 2), side.stop + 2) for side in box)
        hole = torch.from_numpy(holes[row, column] == number)
        if int(hole.sum()) < FEW:
            continue
        around = labels[row, column][torch.from_numpy(binary_dilation(hole.numpy(), iterations=2)) & ~hole]
        names = around[around > 0].unique()
        edge = bool(hole[0].any() | hole[-1].any() | hole[:, 0].any() | hole[:, -1].any())
        if len(names) == 1 and not edge and float(height[row, column][hole].median()) > 0.001:
            whole[row, column] = torch.where(hole, names, whole[row, column])
    return whole


def count_labels(labels: Tensor, length: int = 0) -> Int[Tensor, "k"]:
    """Count the pixels of each label."""
    return torch.bincount(labels.reshape(-1), minlength=length)


def _numbered(labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Return labels 1, 2, ... by falling size, without specks of fewer than 100 pixels of 640 x 480."""
    count = count_labels(labels)
    count[0] = 0
    order = torch.argsort(count, descending=True, stable=True)
    order = order[count[order] >= 100 * labels.numel() / (640 * 480)]
    new = torch.zeros_like(count)
    new[order] = torch.arange(1, len(order) + 1)
    return new[labels]


def _merge(image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]) -> Tensor:
    """Return the number of the object of each piece, 0 for the piece 0 and for pieces of no object."""
    from scipy.spatial import KDTree

    new = torch.zeros(int(pieces.max()) + 1, dtype=torch.long)
    names, count = pieces[pieces > 0].unique(return_counts=True)
    if not len(names):
        return new
    order = torch.argsort(pieces[pieces > 0], stable=True)
    parts = _over_table(image, table)[pieces > 0][order].split(count.tolist())
    floating = _floating(image, pieces, table, jump)[names].tolist()
    gap = _gaps([KDTree(part.numpy()) for part in parts])
    large = [k for k in range(len(parts)) if len(parts[k]) >= 30]
    bodies = _joined([_Body((k,), parts[k], len(parts[k])) for k in large], gap, floating)
    for number, body in enumerate(bodies, start=1):
        new[names[list(body.rows)]] = number
    for k in range(len(parts)):  # smaller pieces go to the nearest large one
        if large and k not in large and gap[k, large].min() < GAP:
            new[names[k]] = new[names[large[int(gap[k, large].argmin())]]]
    return new


def _joined(bodies: list["_Body"], gap: np.ndarray, floating: list[bool]) -> list["_Body"]:
    """Return the bodies after joining those that are parts of one object, given the gaps [m] between pieces."""

    def between(a: _Body, b: _Body) -> float:
        return float(gap[np.ix_(a.rows, b.rows)].min())

    done: list[_Body] = []
    while bodies:
        body = bodies.pop()
        parts = [other for other in bodies + done if _one_body(body, other, between(body, other))][:1]
        bodies, done = ([other for other in some if other not in parts] for some in (bodies, done))
        (bodies if parts else done).append(sum(parts, body))
    for body in [body for body in done if all(floating[row] for row in body.rows)]:  # the roots of a handle are hidden
        others = [other for other in done if other is not body]
        nearest = min(others, key=lambda other: between(body, other), default=body)
        reach = FAR if body.size < 0.7 * nearest.size else GAP
        if body in done and nearest is not body and between(body, nearest) < reach:
            done = [other for other in others if other is not nearest] + [body + nearest]
    return done


def _over_table(image: DepthImage, table: Plane) -> Float[Tensor, "h w 3"]:
    """Return the points of all pixels in a frame whose z is the height above the table."""
    axes, points = torch.stack(across(table.normal.double()), -1), image.points()
    return torch.cat([points @ axes, table.height(points)[..., None]], -1)


def _gaps(trees: list[Any]) -> np.ndarray:
    """Return the distance [m] within which `TOUCH` points of one tree are near the other; infinity beyond `FAR`."""
    low, high = np.stack([tree.mins for tree in trees]), np.stack([tree.maxes for tree in trees])
    gap = np.full((len(trees), len(trees)), np.inf)
    for a, b in itertools.combinations(range(len(trees)), 2):
        small, large = sorted((a, b), key=lambda k: trees[k].n)
        rows = ((trees[small].data > low[large] - FAR) & (trees[small].data < high[large] + FAR)).all(-1)
        if rows.sum() >= TOUCH:
            distance = trees[large].query(trees[small].data[rows], distance_upper_bound=FAR)[0]
            gap[a, b] = gap[b, a] = np.partition(distance, TOUCH - 1)[TOUCH - 1]
    return gap


class _Body:
    """Pieces of one object: their numbers, how many points they have, some points, and the hull of their footprint."""

    def __init__(self, rows: tuple[int, ...], points: Float[Tensor, "n 3"], count: int) -> None:
        self.rows, self.count, self.points = rows, count, points[:: 1 + len(points) // 2000]
        self.hull = Hull.of(points[:, :2])
        self.top = float(self.points[:, 2].quantile(0.98))

    def __add__(self, other: "_Body") -> "_Body":
        return _Body(self.rows + other.rows, torch.cat([self.points, other.points]), self.count + other.count)

    @property
    def size(self) -> float:
        """The longest side [m] of the box about the points."""
        return float((self.points.amax(0) - self.points.amin(0)).max())


def _one_body(a: _Body, b: _Body, gap: float) -> bool:
    """Return whether two bodies touch, one is over the footprint of the other, or both are parts of one rim."""
    if gap < GAP or gap > FAR:
        return gap < GAP
    small, large = (a, b) if a.count < b.count else (b, a)
    if float(large.hull.holds(small.points[:, :2]).double().mean()) > NESTED:
        return True
    hull = Hull.of(torch.cat([a.hull.corners, b.hull.corners]))
    if abs(a.top - b.top) > 0.005 or gap > 0.4 * hull.width:  # two heights, or a wide gap in the rim
        return False
    both = torch.cat([a.points, b.points])
    high = both[both[:, 2] > max(a.top, b.top) - 0.004, :2]  # only a hollow body has no top in its middle
    return float(hull.holds(high, -0.012).double().mean()) < 0.05


def _floating(image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]) -> Tensor:
    """Return which pieces float: the table is seen below most of their lower edge, and that edge is high."""
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
    for k in pieces[free].unique().tolist():
        mine = free & (pieces == k)
        count = int(mine.sum())
        if count >= TOUCH and count >= 0.7 * (count + int((hidden & (pieces == k)).sum())):
            low, top = float(height[mine].quantile(0.1)), float(height[pieces == k].quantile(0.9))
            floating[k] = low > max(0.006, 0.4 * top)
    return floating
