"""Segmentation of a depth image: pixels above the table are cut at jumps and creases, and merged to
objects.
"""

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.cloud.sensor import fit_noise
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import number_components
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SupportPlane
from torchgrasp.scene.creases import cut_creases
from torchgrasp.scene.image import DepthImage, label_radii
from torchgrasp.scene.merge import REACH, merge_pieces

BAND = 0.010  # heights [m] below this, of either sign, measure the noise of the table
LEAST_HEIGHT = 0.002  # least height [m] of an object's pixels above the table
NEAR = 0.005  # distance [m] within which a pixel at a depth jump belongs to an object
FEW = 6  # pieces with fewer pixels are noise
OVERHANG = 0.05  # distance [m] to which an object extends beyond the visible region of its support
# greatest root mean square distance [m] of an object's points from their middle; a wall has more
VAST = 0.2


def segment(image: DepthImage, support: SupportPlane) -> Int[Tensor, "h w"]:
    """Return the label of each pixel: 1, 2, ... for objects, the largest first, and 0 for all other
    pixels.

    A piece is a connected component of the pixels above the table, without a jump of depth and
    without a crease. Pieces of one object are merged. Pixels at jumps go to the object whose
    surface they lie on, if there is one. Pixels beside the region of the support get 0.
    """
    table = support.plane
    points = image.points()
    measured = image.depth > 0
    smooth = image.without_speckle()
    mean, threshold = _smoothed(image, table)
    risen = _risen(smooth, table, mean, threshold)
    risen[risen.clone()] = support.covers(points[risen], OVERHANG)
    core, jump = _core(smooth, risen)
    pieces = _grown(points, _components(core, smooth.depth, jump), risen)
    thin = _components(risen & (pieces == 0), smooth.depth, jump)
    pieces = torch.where((pieces == 0) & (thin > 0), pieces.max() + thin, pieces)
    sure = core | (thin > 0)
    # A tenth of an object's pixels are 5 mm high and four deviations of the noise; an uneven table
    # is not.
    flat = measured & (mean.abs() < BAND)
    whole = count_labels(pieces)
    noise = fit_noise(image.depth[flat], mean[flat]).sigma(image.depth)
    high = (
        count_labels(torch.where(mean > (4 * noise).clamp_min(0.005), pieces, 0), len(whole))
        >= 0.1 * whole
    )
    few = count_labels(torch.where(sure, pieces, 0), len(high)) < FEW
    over = pieces[pieces > 0][support.covers(points[pieces > 0])]
    beside = count_labels(over, len(high)) < 0.2 * whole
    vast = label_radii(points, pieces) > VAST
    pieces = cut_creases(smooth, torch.where((few | ~high | beside | vast)[pieces], 0, pieces))
    group = merge_pieces(smooth, torch.where(sure, pieces, 0), table, jump)
    whole = _numbered(_filled(group[pieces], measured, table.height(points)))
    small = torch.nonzero(count_labels(whole) < 500 * whole.numel() / (640 * 480))[:, 0].tolist()
    pixel = image.depth / float(image.intrinsics[0, 0])
    noisy = [k for k in small if k > 0 and _is_noise(whole, k, points, pixel, mean / noise)]
    return _numbered(
        torch.where(torch.isin(whole, torch.tensor(noisy, dtype=whole.dtype)), 0, whole)
    )


def rests_on(image: DepthImage, table: Plane) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels that rise above the table and lie on a surface; flying pixels are
    left out.
    """
    smooth = image.without_speckle()
    risen = _risen(smooth, table, *_smoothed(image, table))
    return _grown(image.points(), _core(smooth, risen)[0].long(), risen) > 0


def _smoothed(image: DepthImage, table: Plane) -> tuple[Tensor, Tensor]:
    """Return the mean height [m] of the 5 x 5 pixels around each pixel, and the least height of an
    object there.
    """
    measured = image.depth > 0
    height = table.height(image.points())
    near = measured & (
        height.abs() < 3 * BAND
    )  # at an object's foot, without its distant neighbours
    share = torch.from_numpy(ndimage.uniform_filter(near.double().numpy(), 5))
    total = torch.from_numpy(ndimage.uniform_filter(torch.where(near, height, 0.0).numpy(), 5))
    mean = torch.where(near, total / share.clamp_min(1e-9), height)
    squared = image.depth.square()
    flat = measured & (mean.abs() < BAND)
    noise = 1.4826 * float((mean.abs() / squared)[flat].median()) if bool(flat.any()) else 0.0
    return mean, (2.5 * noise * squared).clamp_min(LEAST_HEIGHT)


def _risen(
    smooth: DepthImage, table: Plane, mean: Tensor, threshold: Tensor
) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels above the table: their own height and the mean around them exceed
    a threshold.
    """
    return (
        (smooth.depth > 0) & (mean > threshold) & (table.height(smooth.points()) > 0.6 * threshold)
    )


def _core(smooth: DepthImage, risen: Tensor) -> tuple[Tensor, Tensor]:
    """Return a mask of pixels above the table and away from depth jumps; and, per pixel, the least
    depth jump [m].
    """
    depth = smooth.depth
    jump = 0.006 + 2.0 * depth / float(smooth.intrinsics[0, 0])
    farthest = torch.from_numpy(
        ndimage.maximum_filter(torch.where(depth > 0, depth, 0.0).numpy(), 3)
    )
    nearest = torch.from_numpy(
        ndimage.minimum_filter(torch.where(depth > 0, depth, 100.0).numpy(), 3)
    )
    return risen & ~((farthest - depth > jump) | (depth - nearest > jump)), jump


def _components(core: Tensor, depth: Tensor, jump: Tensor) -> Int[Tensor, "h w"]:
    """Return the number, from 1, of each pixel's connected component in the mask `core`; 0 outside
    of the mask.
    """
    h, w = core.shape
    index = torch.arange(h * w).reshape(h, w)
    edges = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)):
        a = (slice(0, h - down), slice(max(0, -right), w - max(0, right)))
        b = (slice(down, h), slice(max(0, right), w - max(0, -right)))
        joined = core[a] & core[b] & ((depth[a] - depth[b]).abs() < jump[a])
        edges.append(torch.stack([index[a][joined], index[b][joined]]))
    number = torch.from_numpy(
        number_components(torch.cat(edges, 1).T.numpy(), h * w).astype(np.int64)
    )
    return torch.where(core, number.reshape(h, w) + 1, 0)


def _grown(points: Tensor, labels: Tensor, risen: Tensor) -> Int[Tensor, "h w"]:
    """Return labels in which pixels above the table without a label get that of the nearest point
    within `NEAR`.
    """
    labels = torch.where((count_labels(labels) < FEW)[labels], 0, labels).reshape(-1)
    place = points.reshape(-1, 3).numpy()
    loose = torch.nonzero(risen.reshape(-1) & (labels == 0))[:, 0]
    new = torch.nonzero(labels)[:, 0]
    for _ in range(12):
        if not len(new) or not len(loose):
            break
        distance, index = spatial.KDTree(place[new.numpy()]).query(
            place[loose.numpy()], distance_upper_bound=NEAR
        )
        found = torch.from_numpy(np.isfinite(distance))
        labels[loose[found]] = labels[new[torch.from_numpy(index)[found]]]
        new = loose[found]
        loose = loose[~found]
    return labels.reshape(risen.shape)


def _filled(labels: Tensor, measured: Tensor, height: Tensor) -> Int[Tensor, "h w"]:
    """Return labels in which the inner floor of an object, such as a pan, has the label of that
    object.
    """
    holes = np.empty(labels.shape, dtype=np.int32)
    ndimage.label((measured & (labels == 0)).numpy(), output=holes)
    whole = labels.clone()
    boxes: list[tuple[slice, slice]] = ndimage.find_objects(holes)
    for number, box in enumerate(boxes, start=1):
        row, column = (slice(max(0, side.start - 2), side.stop + 2) for side in box)
        hole = torch.from_numpy(holes[row, column] == number)
        if int(hole.sum()) < FEW:
            continue
        around = labels[row, column][
            torch.from_numpy(ndimage.binary_dilation(hole.numpy(), iterations=2)) & ~hole
        ]
        names = around[around > 0].unique()
        edge = bool(hole[0].any() | hole[-1].any() | hole[:, 0].any() | hole[:, -1].any())
        if len(names) == 1 and not edge and float(height[row, column][hole].median()) > 0.001:
            whole[row, column] = torch.where(hole, names, whole[row, column])
    return whole


def count_labels(labels: Tensor, length: int = 0) -> Int[Tensor, "k"]:
    """Return the number of pixels of each label 0, 1, ..., with at least `length` entries."""
    return torch.bincount(labels.reshape(-1), minlength=length)


def _numbered(labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Return labels renumbered 1, 2, ... from the largest object; specks (below 100 pixels of 640 x
    480) become 0.
    """
    count = count_labels(labels)
    count[0] = 0
    order = torch.argsort(count, descending=True, stable=True)
    order = order[count[order] >= 100 * labels.numel() / (640 * 480)]
    new = torch.zeros_like(count)
    new[order] = torch.arange(1, len(order) + 1)
    return new[labels]


def _is_noise(
    labels: Int[Tensor, "h w"], k: int, points: Tensor, pixel: Tensor, deviations: Tensor
) -> bool:
    """Return whether the small object k is an uneven place of the table, or a fringe of a body ten
    times as large.

    `pixel` is the width of each pixel on its surface [m]. `deviations` are heights above the table
    over the noise's.
    """
    mine = labels == k
    if float((deviations[mine] > 8).double().mean()) < 0.25:
        return True
    rows, columns = (
        slice(max(0, int(side.min()) - 4), int(side.max()) + 5) for side in torch.nonzero(mine).T
    )
    width = float(pixel[mine].median())
    mine = mine[rows, columns]
    near = labels[rows, columns]
    points = points[rows, columns]
    if width * float(np.max(np.asarray(ndimage.distance_transform_edt(mine.numpy())))) > 0.005:
        return False
    around = (
        torch.from_numpy(ndimage.binary_dilation(mine.numpy(), iterations=4)) & (near > 0) & ~mine
    )
    around &= count_labels(labels)[near] > 10 * int(mine.sum())
    return bool(around.any()) and float(torch.cdist(points[around], points[mine]).min()) < REACH
