"""The things in a depth image: what rises above the table, divided where the depth jumps."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.merge import merge_pieces

BAND = 0.010
"""Heights [m] below this, of either sign, measure the noise of the table."""
SIGMAS, LEAST_HEIGHT = 2.5, 0.002
"""A thing's pixels rise this many deviations of the smoothed table, and this much [m], above it."""
SMOOTHING = 5
"""Side [px] of the square whose mean height tells a foot from the table."""
JUMP, JUMP_SPACINGS = 0.006, 2.0
"""Difference of depth of two pixels of one surface: this [m] and so many spacings of pixels there, at most."""
RIM = 1
"""Pixels about a jump that are no surface for certain: a camera's rim pixels fly."""
NEAR, PASSES = 0.005, 12
"""Distance [m] within which a rim's pixel belongs to a thing, and passes of this: thin parts are rim throughout."""
FEW = 6
"""Pixels of a piece that are too few to say anything."""
OWN = 0.6
"""Share of that height that a pixel itself has: the mean is raised beside a thing, too."""
LEAST_TOP, LEAST_FLOOR = 0.0035, 0.001
"""Smoothed height [m] that a tenth of a thing's pixels have: waves of the table do not. Median height [m] of pixels
within a thing that are its floor, such as a pan's."""
SPECK = 40
"""Least pixels of a thing: 6 mm x 6 mm at 0.6 m."""


def segment(image: DepthImage, table: Plane) -> Int[Tensor, "h w"]:
    """Return the label of each pixel: 0 for table, flying pixels and nothing; 1, 2, ... for things, largest first.

    A thing is a connected component of the pixels above the table, in which depth has no jump. Pixels at jumps go to
    the thing whose surface they lie on, if there is one. Pieces that nearly touch are one thing.

    Args:
        image: one view of the scene.
        table: the plane that the things stand on, in the frame of the image.

    >>> k = torch.tensor([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]).double()
    >>> depth = torch.full((48, 64), 0.5).double()
    >>> depth[10:20, 10:30] = 0.45
    >>> segment(DepthImage(depth, k, torch.eye(4).double()), Plane(torch.tensor([0, 0, -1.0]), -0.5)).unique()
    tensor([0, 1])
    """
    measured, smooth = image.depth > 0, dataclasses.replace(image, depth=torch.from_numpy(_median(image.depth.numpy())))
    mean, threshold = _smoothed(image, table)
    risen = _risen(smooth, table, mean, threshold)
    core, jump = _core(smooth, risen)
    pieces = _grown(image.points(), _components(core, smooth.depth, jump), risen)
    thin = _components(risen & (pieces == 0), smooth.depth, jump)
    pieces = torch.where((pieces == 0) & (thin > 0), pieces.max() + thin, pieces)
    sure = core | (thin > 0)
    high = _counts(torch.where(mean > LEAST_TOP, pieces, 0), len(_counts(pieces))) >= 0.1 * _counts(pieces)
    few = _counts(torch.where(sure, pieces, 0), len(high)) < FEW
    pieces = _without(pieces, few | ~high)
    group = merge_pieces(smooth, torch.where(sure, pieces, 0), table, jump)
    return _numbered(_filled(group[pieces], measured, table.height(image.points())))


def on_surface(image: DepthImage, table: Plane) -> Bool[Tensor, "h w"]:
    """Tell which pixels rise above the table and lie on a surface; flying pixels do not."""
    smooth = dataclasses.replace(image, depth=torch.from_numpy(_median(image.depth.numpy())))
    risen = _risen(smooth, table, *_smoothed(image, table))
    return _grown(image.points(), _core(smooth, risen)[0].long(), risen) > 0


def _smoothed(image: DepthImage, table: Plane) -> tuple[Tensor, Tensor]:
    """Return the mean height about each pixel, and the least that is no noise, which grows with the squared depth."""
    from scipy.ndimage import uniform_filter

    measured, height = image.depth > 0, table.height(image.points())
    near = measured & (height.abs() < 3 * BAND)  # a foot has distant neighbours, too
    share = torch.from_numpy(uniform_filter(near.double().numpy(), SMOOTHING))
    total = torch.from_numpy(uniform_filter(torch.where(near, height, 0.0).numpy(), SMOOTHING))
    mean = torch.where(near, total / share.clamp_min(1e-9), height)
    squared = image.depth.square()
    flat = measured & (mean.abs() < BAND)
    noise = 1.4826 * float((mean.abs() / squared)[flat].median()) if bool(flat.any()) else 0.0
    return mean, (SIGMAS * noise * squared).clamp_min(LEAST_HEIGHT)


def _risen(smooth: DepthImage, table: Plane, mean: Tensor, threshold: Tensor) -> Bool[Tensor, "h w"]:
    """Tell which pixels rise above the table, with their neighbours and by themselves."""
    return (smooth.depth > 0) & (mean > threshold) & (table.height(smooth.points()) > OWN * threshold)


def _core(smooth: DepthImage, risen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the risen pixels away from jumps, and the difference of depth [m] that is a jump."""
    jump = JUMP + JUMP_SPACINGS * smooth.depth / float(smooth.intrinsics[0, 0])
    return risen & ~_at_jump(smooth.depth, jump), jump


def _median(depth: np.ndarray) -> np.ndarray:
    """Return the median of the measured pixels of each 3 x 3 square; 0 where most are missing."""
    padded = np.pad(np.where(depth > 0, depth, np.nan), 1, constant_values=np.nan)
    squares = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*depth.shape, 9)
    ranked = np.sort(squares, axis=-1)  # NaN last
    count = np.isfinite(squares).sum(-1)
    middle = np.take_along_axis(ranked, np.maximum(count - 1, 0)[..., None] // 2, -1)[..., 0]
    return np.where((count >= 3) & (depth > 0), np.nan_to_num(middle), depth)


def _at_jump(depth: Tensor, jump: Tensor) -> Bool[Tensor, "h w"]:
    """Tell which pixels have, within `RIM` pixels, a depth that differs by more than a jump."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size, measured = 2 * RIM + 1, depth > 0
    farthest = torch.from_numpy(maximum_filter(torch.where(measured, depth, 0.0).numpy(), size))
    nearest = torch.from_numpy(minimum_filter(torch.where(measured, depth, 100.0).numpy(), size))
    return (farthest - depth > RIM * jump) | (depth - nearest > RIM * jump)


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
    i, j = torch.cat(edges, 1).numpy()
    graph = coo_matrix((np.ones(len(i), dtype=bool), (i, j)), shape=(h * w, h * w))
    number = torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64)).reshape(h, w)
    return torch.where(core, number + 1, 0)


def _grown(points: Tensor, labels: Tensor, risen: Tensor) -> Int[Tensor, "h w"]:
    """Give risen pixels without a label, pass by pass, that of the nearest labelled point within `NEAR`."""
    from scipy.spatial import KDTree

    labels = _without(labels, _counts(labels) < FEW).reshape(-1).clone()
    place, loose = points.reshape(-1, 3).numpy(), torch.nonzero(risen.reshape(-1) & (labels == 0))[:, 0]
    new = torch.nonzero(labels)[:, 0]
    for _ in range(PASSES):
        if not len(new) or not len(loose):
            break
        distance, index = KDTree(place[new.numpy()]).query(place[loose.numpy()], distance_upper_bound=NEAR)
        found = torch.from_numpy(np.isfinite(distance))
        labels[loose[found]] = labels[new[torch.from_numpy(index)[found]]]
        new, loose = loose[found], loose[~found]
    return labels.reshape(risen.shape)


def _filled(labels: Tensor, measured: Tensor, height: Tensor) -> Int[Tensor, "h w"]:
    """Give the floor within a thing, enclosed and a little above the table, the label of the thing."""
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
        if len(names) == 1 and not edge and float(height[row, column][hole].median()) > LEAST_FLOOR:
            whole[row, column] = torch.where(hole, names, whole[row, column])
    return whole


def _counts(labels: Tensor, length: int = 0) -> Int[Tensor, "k"]:
    """Count the pixels of each label."""
    return torch.bincount(labels.reshape(-1), minlength=length)


def _without(labels: Tensor, dropped: Bool[Tensor, "k"]) -> Int[Tensor, "h w"]:
    """Return labels without some of them."""
    return torch.where(dropped[labels], 0, labels)


def _numbered(labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Return labels 1, 2, ... by falling size, without specks."""
    count = _counts(labels)
    count[0] = 0
    order = torch.argsort(count, descending=True, stable=True)
    order = order[count[order] >= SPECK]
    new = torch.zeros_like(count)
    new[order] = torch.arange(1, len(order) + 1)
    return new[labels]
