"""Segmentation of a depth image: pixels above the table are cut at jumps and creases, and merged to
objects.
"""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import number_components
from torchgrasp.scene.creases import cut_creases
from torchgrasp.scene.image import label_radii, scale_pixels
from torchgrasp.scene.merge import MERGE, merge_pieces
from torchgrasp.scene.table_image import TableImage


@dataclasses.dataclass(frozen=True)
class SegmentNumbers:
    """Parameters of the segmentation of a depth image into objects on a table.

    Counts of pixels are for an image of 640 x 480. They are scaled to the size of others, unless it
    is said otherwise.
    """

    risen: float = 2.5
    """Least mean height of an object's pixels, in standard deviations of the table's noise."""
    least_height: float = 0.002
    """Least mean height of an object's pixels [m], however small the noise."""
    own: float = 0.6
    """Least height of an object's pixel itself, as a share of the least mean height around it
    (`risen`, `least_height`).
    """
    near: float = 0.005
    """Distance [m] from an object within which a pixel at a jump of depth joins it."""
    near_pixels: float = 4.0
    """The distance `near` in widths of a pixel, if that is more, for a pixel of a given mask.
    Pixels of a small image lie farther apart.
    """
    rounds: int = 12
    """Greatest number of rounds in which objects grow into pixels at jumps."""
    few: int = 6
    """Least number of pixels of a piece or hole that is not noise, in an image of any size."""
    overhang: float = 0.05
    """Greatest distance [m] by which an object extends beyond the visible region of its support."""
    high: float = 0.005
    """Least height [m] of a pixel that counts as high; an uneven table has few such pixels."""
    high_deviations: float = 4.0
    """Least height of a high pixel (`high`) in standard deviations of the table's noise, if that is
    more.
    """
    high_share: float = 0.1
    """Least share of high pixels among those of an object."""
    over: float = 0.2
    """Least share of an object's pixels over the visible region of its support."""
    vast: float = 0.2
    """Greatest root mean square distance [m] of an object's points from their middle: that of a
    wall is larger.
    """
    floor: float = 0.001
    """Height [m] above the table from which on a hole in an object is its inner floor."""
    speck: int = 100
    """Number of pixels of an object below which it is left out."""
    small: int = 500
    """Number of pixels of an object below which it may be noise, or a fringe of a large object."""
    uneven: float = 8.0
    """Height, in standard deviations of the table's noise, that pixels of a small object must
    exceed.
    """
    uneven_share: float = 0.25
    """Least share of a small object's pixels that exceed the height `uneven`; else the object is
    noise.
    """
    margin: int = 4
    """Distance [px] from a small object within which a large one is sought, of which it may be a
    fringe.
    """
    fringe: float = 0.005
    """Largest half width of a fringe [m]."""
    larger: int = 10
    """Least ratio of the number of pixels of a large object to that of its fringe."""


SEGMENT = SegmentNumbers()
# (row, column) of the pixels to which a pixel is joined; two steps bridge a missing pixel
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))


def segment(view: TableImage) -> Int[Tensor, "h w"]:
    """Return the label of each pixel of a depth image that is cut into objects on a table.

    Labels are 1, 2, ... for objects, the largest first, and 0 for none. A piece is a connected
    component of the pixels above the table. It has no jump of depth and no crease. Pieces of one
    object are merged. Pixels at jumps go to the object whose surface they lie on, if there is one.
    Pixels beside the region of the support get 0.
    """
    smooth = view.smooth
    risen = _risen(view)
    risen[risen.clone()] = view.support.covers(view.points[risen], SEGMENT.overhang)
    core = _core(smooth, risen)
    pieces = _grown(view, find_components(smooth, core), risen)
    # what has no core, such as a pen, is a piece of its own
    thin = find_components(smooth, risen & (pieces == 0))
    pieces = torch.where((pieces == 0) & (thin > 0), pieces.max() + thin, pieces)
    sure = core | (thin > 0)
    pieces = torch.where(_are_things(view, pieces, sure)[pieces], pieces, 0)
    pieces = cut_creases(smooth.image, smooth.points, pieces)
    group = merge_pieces(smooth, torch.where(sure, pieces, 0))
    labels = _numbered(_filled(view, group[pieces]))
    # small objects that are noise are known only beside whole ones
    small = count_labels(labels) < scale_pixels(SEGMENT.small, labels)
    deviations = view.mean_height / view.fitted_noise
    noise = torch.zeros_like(small)
    for k in flatnonzero(small).tolist():
        noise[k] = k > 0 and _is_noise(view, deviations, labels, k)
    return _numbered(torch.where(noise[labels], 0, labels))


def _are_things(view: TableImage, pieces: Tensor, sure: Tensor) -> Bool[Tensor, "k"]:
    """Return a mask of the piece numbers whose pixels are many, high, over the support and near
    each other.
    """
    whole = count_labels(pieces)
    least = (SEGMENT.high_deviations * view.fitted_noise).clamp_min(SEGMENT.high)
    high = count_labels(torch.where(view.mean_height > least, pieces, 0), len(whole))
    many = count_labels(torch.where(sure, pieces, 0), len(whole)) >= SEGMENT.few
    mine = pieces > 0
    over = count_labels(pieces[mine][view.support.covers(view.points[mine])], len(whole))
    return (
        many
        & (high >= SEGMENT.high_share * whole)
        & (over >= SEGMENT.over * whole)
        & (label_radii(view.points, pieces) <= SEGMENT.vast)
    )


def rests_on(view: TableImage) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels that are above the table and on the surface of an object.

    A pixel beside a jump of depth must be near another pixel on a surface. Near is within 5 mm, or
    4 widths of a pixel if that is more (`SEGMENT`). So flying pixels are left out.
    """
    risen = _risen(view)
    near = (SEGMENT.near_pixels * view.image.depth / view.image.focal).clamp_min(SEGMENT.near)
    return _grown(view, _core(view.smooth, risen).long(), risen, near) > 0


def _risen(view: TableImage) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels above the table: their own height and the mean around them exceed
    a threshold.
    """
    noise = SEGMENT.risen * view.median_noise * view.image.depth.square()
    least = noise.clamp_min(SEGMENT.least_height)
    smooth = view.smooth
    return smooth.measured & (view.mean_height > least) & (smooth.height > SEGMENT.own * least)


def above_table_not_flying(view: TableImage) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels above the table that are not flying pixels.

    A flying pixel lies between a nearer and a farther surface. So the depth jumps back beside it on
    one side, and forward on another. The pixels of a thin bar are beside jumps back only. They are
    in the result, but not in the mask of `rests_on`.
    """
    before_jump, behind_jump = _jumps(view.smooth)
    return _risen(view) & ~(before_jump & behind_jump)


def _core(smooth: TableImage, risen: Tensor) -> Bool[Tensor, "h w"]:
    """Return a mask of pixels above the table and away from depth jumps."""
    before_jump, behind_jump = _jumps(smooth)
    return risen & ~(before_jump | behind_jump)


def _jumps(smooth: TableImage) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Return masks of the pixels beside which depth jumps back, and of those beside which it jumps
    forward.
    """
    depth = smooth.image.depth
    behind = torch.where(smooth.measured, depth, 0.0).numpy()
    # where nothing was measured, all is far away
    before = torch.where(smooth.measured, depth, 100.0).numpy()
    farthest = torch.from_numpy(ndimage.maximum_filter(behind, 3))
    nearest = torch.from_numpy(ndimage.minimum_filter(before, 3))
    return farthest - depth > smooth.jump, depth - nearest > smooth.jump


def find_components(smooth: TableImage, core: Tensor) -> Int[Tensor, "h w"]:
    """Return the number, from 1, of each pixel's connected component in the mask `core` (h, w).

    It is 0 outside of the mask. A jump of depth in the image `smooth` separates components.
    """
    h, w = core.shape
    depth = smooth.image.depth
    index = torch.arange(h * w).reshape(h, w)
    edges = []
    for down, right in NEIGHBOURS:
        a = (slice(0, h - down), slice(max(0, -right), w - max(0, right)))
        b = (slice(down, h), slice(max(0, right), w - max(0, -right)))
        step = (depth[a] - depth[b]).abs()
        joined = core[a] & core[b] & (step < smooth.jump[a])
        edges.append(torch.stack([index[a][joined], index[b][joined]]))
    pairs = torch.cat(edges, 1).T.numpy()
    number = torch.from_numpy(number_components(pairs, h * w).astype(np.int64))
    return torch.where(core, number.reshape(h, w) + 1, 0)


def _grown(
    view: TableImage, labels: Tensor, risen: Tensor, near: Float[Tensor, "h w"] | None = None
) -> Int[Tensor, "h w"]:
    """Return labels with more pixels above the table. A pixel without a label gets that of the
    nearest point, if one is near.

    `near` is the greatest distance [m] of each pixel from such a point, by default `SEGMENT.near`.
    """
    wide = np.full(risen.shape, SEGMENT.near) if near is None else near.double().numpy()
    labels = torch.where((count_labels(labels) < SEGMENT.few)[labels], 0, labels).reshape(-1)
    place = view.points.reshape(-1, 3).numpy()
    loose = flatnonzero(risen.reshape(-1) & (labels == 0))
    new = flatnonzero(labels > 0)
    for _ in range(SEGMENT.rounds):
        if not len(new) or not len(loose):
            break
        reach = wide.reshape(-1)[loose.numpy()]
        distance, index = spatial.KDTree(place[new.numpy()]).query(
            place[loose.numpy()], distance_upper_bound=reach.max()
        )
        found = torch.from_numpy(distance <= reach)
        labels[loose[found]] = labels[new[torch.from_numpy(index)[found]]]
        # the pixels found last are those at which an object grows on
        new = loose[found]
        loose = loose[~found]
    return labels.reshape(risen.shape)


def _filled(view: TableImage, labels: Tensor) -> Int[Tensor, "h w"]:
    """Return labels in which the inner floor of an object, such as a pan, has the label of that
    object.
    """
    holes = np.empty(labels.shape, dtype=np.int32)
    ndimage.label((view.measured & (labels == 0)).numpy(), output=holes)
    whole = labels.clone()
    boxes: list[tuple[slice, slice]] = ndimage.find_objects(holes)
    for number, inner in enumerate(boxes, start=1):
        # with a border of two pixels, in which the objects around the hole are seen
        box = _widened(inner, 2)
        hole = torch.from_numpy(holes[box] == number)
        count = int(hole.sum())
        # a hole at the image border may be open
        if count < SEGMENT.few or int(hole[1:-1, 1:-1].sum()) < count:
            continue
        near = torch.from_numpy(ndimage.binary_dilation(hole.numpy(), iterations=2))
        around = labels[box][near & ~hole]
        names = around[around > 0].unique()
        # a hole whose floor is the table is no part of its object, such as a ring
        if len(names) == 1 and float(view.height[box][hole].median()) > SEGMENT.floor:
            whole[box] = torch.where(hole, names, whole[box])
    return whole


def _widened(box: tuple[slice, slice], margin: int) -> tuple[slice, slice]:
    """Return the box of an image with a margin [px] on all sides, as far as the image reaches."""
    rows, columns = (slice(max(0, side.start - margin), side.stop + margin) for side in box)
    return rows, columns


def count_labels(labels: Tensor, length: int = 0) -> Int[Tensor, "k"]:
    """Return the number of pixels of each label 0, 1, ... up to the greatest one.

    If `length` is larger, the result has as many entries, the last of them 0.
    """
    return torch.bincount(labels.reshape(-1), minlength=length)


def _numbered(labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Return labels renumbered 1, 2, ... from the largest object; specks become 0."""
    count = count_labels(labels)
    count[0] = 0
    order = torch.argsort(count, descending=True, stable=True)
    order = order[count[order] >= scale_pixels(SEGMENT.speck, labels)]
    new = torch.zeros_like(count)
    new[order] = torch.arange(1, len(order) + 1)
    return new[labels]


def _is_noise(view: TableImage, deviations: Tensor, labels: Int[Tensor, "h w"], k: int) -> bool:
    """Return whether the small object k is an uneven place of the table, or the fringe of a large
    body.

    `deviations` (h, w) are heights above the table over the noise's.
    """
    mine = labels == k
    uneven = (deviations[mine] > SEGMENT.uneven).double().mean()
    if float(uneven) < SEGMENT.uneven_share:
        return True
    # only pixels about the object matter from here on
    margin = SEGMENT.margin
    box = _widened(ndimage.find_objects(mine.byte().numpy())[0], margin)
    pixel = float((view.image.depth[mine] / view.image.focal).median())
    mine = mine[box]
    inside = np.asarray(ndimage.distance_transform_edt(mine.numpy()))
    if pixel * float(np.max(inside)) > SEGMENT.fringe:
        return False
    near = torch.from_numpy(ndimage.binary_dilation(mine.numpy(), iterations=margin))
    large = count_labels(labels)[labels[box]] > SEGMENT.larger * int(mine.sum())
    around = near & (labels[box] > 0) & ~mine & large
    if not around.any():
        return False
    points = view.points[box]
    return float(torch.cdist(points[around], points[mine]).min()) < MERGE.reach
