"""The objects in a depth image: what rises above the table, divided where the depth jumps, and merged again.

Pieces are parts of one object if they nearly touch, if one stands above the footprint of the other, or if one floats
beside the other.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.sensor import fit_noise
from torchgrasp.cloud.support import Support
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import inverse, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.image import LEAST_PIXELS, DepthImage, label_radii

BAND = 0.010  # heights [m] below this, of either sign, measure the noise of the table
LEAST_HEIGHT = 0.002  # least height [m] of an object's pixels above the table
NEAR = 0.005  # distance [m] within which a pixel at a depth jump belongs to an object
FEW = 6  # pieces with fewer pixels are noise
GAP, TOUCH, FLOATING_GAP = 0.008, 3, 0.013
"""Pieces touch where TOUCH pixels are within GAP [m]; a floating piece belongs to one within FLOATING_GAP [m]."""
OVERHANG = 0.05  # distance [m] to which an object extends beyond the visible region of its support
VAST = 0.2  # greatest root mean square distance [m] of an object's points from their middle; a wall has more
MASK_SHARE = 0.05  # least share of a mask's pixels on the target: a third of a box drawn around an object are


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
    flat, whole = measured & (mean.abs() < BAND), _counts(pieces)
    noise = fit_noise(image.depth[flat], mean[flat]).sigma(image.depth)
    high = _counts(torch.where(mean > (4 * noise).clamp_min(0.0035), pieces, 0), len(whole)) >= 0.1 * whole
    few = _counts(torch.where(sure, pieces, 0), len(high)) < FEW
    over = pieces[pieces > 0][support.covers(points[pieces > 0])]
    beside = _counts(over, len(high)) < 0.2 * whole
    vast = label_radii(points, pieces) > VAST
    pieces = torch.where((few | ~high | beside | vast)[pieces], 0, pieces)
    group = _merge(smooth, torch.where(sure, pieces, 0), table, jump)
    return _numbered(_filled(group[pieces], measured, table.height(points)))


def on_surface(image: DepthImage, table: Plane) -> Bool[Tensor, "h w"]:
    """Return which pixels rise above the table and lie on a surface; flying pixels do not."""
    smooth = image.without_speckle()
    risen = _risen(smooth, table, *_smoothed(image, table))
    return _grown(image.points(), _core(smooth, risen)[0].long(), risen) > 0


def label_image(
    image: DepthImage, support: Support, labels: Int[Tensor, "h w"] | None, mask: Bool[Tensor, "h w"] | None
) -> Int[Tensor, "h w"]:
    """Return the label of each pixel: the given ones without table and flying pixels, or those of `segment`.

    A mask becomes label 1. It loses the table and strips of neighbours. Other parts of its object just outside of it
    belong to nothing.

    Raises:
        BadArgument: nothing but the table is left of a mask, or nothing of all labels.
    """
    if labels is not None:
        kept = torch.where(on_surface(image, support.plane), labels, 0)
        if not bool((kept > 0).any()):
            raise BadArgument("labels", "none that rises above the table", "labels of objects on the table")
        return kept
    objects = segment(image, support)
    if mask is None:
        return objects
    inside = mask & on_surface(image, support.plane)
    pieces, length = torch.where(inside, objects, 0), int(objects.max()) + 1
    whole, part = _counts(objects, length), _counts(pieces, length)
    belongs = (part >= 0.5 * whole) | (part >= 0.3 * max(1, int(inside.sum())))
    belongs[0] = True
    target = inside & belongs[objects]
    seen = int((mask & (image.depth > 0)).sum())
    if int(target.sum()) < max(LEAST_PIXELS, MASK_SHARE * seen):
        found = f"{int(target.sum())} of {seen} measured pixels above the table"
        least = f"at least {LEAST_PIXELS}, and a {1 / MASK_SHARE:.0f}th: this target is the table"
        raise BadArgument("mask", found, least)
    from scipy.ndimage import binary_dilation

    about = torch.from_numpy(binary_dilation(mask.numpy(), iterations=4))  # masks are off by a few pixels
    rest = torch.where(target | (about & belongs[objects]), 0, objects)
    few = _counts(rest, length) < LEAST_PIXELS
    rest = torch.where(few[rest], 0, rest)
    _, number = torch.cat([torch.zeros(1, dtype=torch.long), rest.reshape(-1)]).unique(return_inverse=True)
    rest = number[1:].reshape(rest.shape)
    return torch.where(target, 1, torch.where(rest > 0, rest + 1, 0))


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
    h, w = core.shape
    index = torch.arange(h * w).reshape(h, w)
    edges = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)):
        a = (slice(0, h - down), slice(max(0, -right), w - max(0, right)))
        b = (slice(down, h), slice(max(0, right), w - max(0, -right)))
        joined = core[a] & core[b] & ((depth[a] - depth[b]).abs() < jump[a])
        edges.append(torch.stack([index[a][joined], index[b][joined]]))
    number = _connected(torch.cat(edges, 1).numpy(), h * w).reshape(h, w)
    return torch.where(core, number + 1, 0)


def _connected(edges: np.ndarray, count: int) -> Int[Tensor, "n"]:
    """Return the component of each of `count` nodes, given edges (2, e)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(edges.shape[1], dtype=bool), tuple(edges)), shape=(count, count))
    return torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))


def _grown(points: Tensor, labels: Tensor, risen: Tensor) -> Int[Tensor, "h w"]:
    """Give risen pixels without a label, pass by pass, that of the nearest labelled point within `NEAR`."""
    from scipy.spatial import KDTree

    labels = torch.where((_counts(labels) < FEW)[labels], 0, labels).reshape(-1)
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


def _counts(labels: Tensor, length: int = 0) -> Int[Tensor, "k"]:
    """Count the pixels of each label."""
    return torch.bincount(labels.reshape(-1), minlength=length)


def _numbered(labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Return labels 1, 2, ... by falling size, without objects of fewer than 40 pixels."""
    count = _counts(labels)
    count[0] = 0
    order = torch.argsort(count, descending=True, stable=True)
    order = order[count[order] >= 40]
    new = torch.zeros_like(count)
    new[order] = torch.arange(1, len(order) + 1)
    return new[labels]


def _merge(image: DepthImage, pieces: Int[Tensor, "h w"], table: Plane, jump: Float[Tensor, "h w"]) -> Tensor:
    """Return the number of the object of each piece, 0 for the piece 0."""
    from scipy.spatial import KDTree

    rows = pieces > 0
    new = torch.zeros(int(pieces.max()) + 1, dtype=torch.long)
    names, number, count = pieces[rows].unique(return_inverse=True, return_counts=True)
    large = count >= 30  # smaller pieces go to the nearest large one
    if not bool(large.any()):
        return new
    place = image.points()[rows]
    parts = [place[number == k] for k in torch.nonzero(large)[:, 0].tolist()]
    floating = _floating(image, pieces, table, jump)[names[large]].tolist()
    joined = _join(parts, table, floating)
    new[names[large]] = _connected(np.array(joined, dtype=int).reshape(-1, 2).T, len(parts)) + 1
    tree, owner = KDTree(torch.cat(parts).numpy()), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    for k in torch.nonzero(~large)[:, 0].tolist():
        distance, index = tree.query(place[number == k].numpy(), distance_upper_bound=GAP)
        if np.isfinite(distance).sum() >= TOUCH:
            new[names[k]] = new[names[large]][int(owner[np.asarray(index)[distance.argmin()]])]
    return new


def _join(parts: list[Tensor], table: Plane, floating: list[bool]) -> list[tuple[int, int]]:
    """Return the pairs of pieces that are parts of one object."""
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
            if b < a and (touches or _stand_over(parts[small], parts[large], table)):
                joined.append((a, b))
        if floating[a] and nearest >= 0:
            joined.append((a, nearest))
    return joined


def _stand_over(part: Float[Tensor, "n 3"], other: Float[Tensor, "m 3"], table: Plane) -> bool:
    """Return whether a fifth of a part's points stand over the convex footprint of the other part."""
    from scipy.spatial import ConvexHull, QhullError

    normal = table.normal.double()
    x = unit(torch.linalg.cross(normal, torch.eye(3, dtype=torch.float64)[int(normal.abs().argmin())]))
    axes = torch.stack([x, torch.linalg.cross(normal, x)], -1)
    try:
        sides = torch.from_numpy(ConvexHull((other @ axes).numpy()).equations)
    except QhullError:  # all on a line
        return False
    return float((part @ axes @ sides[:, :2].T + sides[:, 2] < 0).all(-1).double().mean()) > 0.2


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
