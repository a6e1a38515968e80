"""Division of a connected surface into parts along its creases, where two surfaces meet at a
concave angle.
"""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import number_components
from torchgrasp.scene.image import DepthImage

REACH = 0.012  # distance [m] on either side of a crease over which its angle is measured


def cut_creases(image: DepthImage, pieces: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Cut each piece along its concave creases, and return an image of each pixel's part number, 0
    for none.
    """
    least = 300 * pieces.numel() / (640 * 480)  # pixels of the smallest part
    points = (
        image.points() - image.obj_from_camera[:3, 3]
    ).numpy()  # from the camera, so that normals can face it
    parts = pieces.clone()
    last = int(pieces.max())
    names, count = pieces[pieces > 0].unique(return_counts=True)
    numbers = torch.zeros(last + 1, dtype=torch.int32)
    numbers[names[count >= 2 * least]] = torch.arange(
        1, 1 + int((count >= 2 * least).sum()), dtype=torch.int32
    )
    found = numbers[pieces].numpy()
    boxes: list[tuple[slice, slice]] = ndimage.find_objects(found)
    for number, box in enumerate(boxes, start=1):
        mask = found[box] == number
        scale = float(image.intrinsics[0, 0]) / float(
            image.depth[box][torch.from_numpy(mask)].median()
        )
        own = _divide(points[box], mask, scale * REACH, least)
        joined = [(a, b) for a, b in _borders(own) if not _is_concave(own, points[box], a, b)]
        own = number_components(
            np.array(joined, dtype=np.int64).reshape(-1, 2), int(own.max()) + 1
        )[own]
        new = torch.from_numpy(own.astype(np.int64))
        parts[box] = torch.where(new > 1, last + new - 1, parts[box])
        last += max(0, int(own.max()) - 1)
    return parts


def _divide(points: np.ndarray, mask: np.ndarray, reach: float, least: float) -> np.ndarray:
    """Return the part (1, 2, ...) of each pixel of a piece, 0 outside it; pixels on creases join
    the nearest part.
    """
    step = max(2, round(reach))
    inside = (slice(step, -step), slice(step, -step))
    mask = np.pad(mask, step)
    points = np.pad(points, ((step, step), (step, step), (0, 0)))
    share = np.maximum(ndimage.uniform_filter(mask.astype(float), step | 1), 1e-9)
    smooth = [
        ndimage.uniform_filter(np.where(mask, points[..., k], 0.0), step | 1) / share
        for k in range(3)
    ]
    smooth = np.stack(smooth, -1)
    normal, known = _normals(smooth, mask, max(1, step // 2))
    crease = np.zeros_like(mask)
    for down, right in ((1.0, 0.0), (0.0, 1.0), (0.7, 0.7), (0.7, -0.7)):
        shift = (round(step * down), round(step * right))
        before = (-shift[0], -shift[1])
        after = shift
        chord = np.roll(smooth, before, (0, 1)) - np.roll(smooth, after, (0, 1))
        length = np.linalg.norm(chord, axis=-1) + 1e-12
        first = (np.roll(normal, after, (0, 1)) * chord).sum(-1) / length
        second = -(np.roll(normal, before, (0, 1)) * chord).sum(-1) / length
        ends = np.roll(known, after, (0, 1)) & np.roll(known, before, (0, 1))
        crease |= ends & (np.minimum(first, second) > 0.35) & (length < 4 * REACH)
    number = np.empty(mask.shape, dtype=np.int32)
    ndimage.label(
        ndimage.binary_erosion(mask & ~crease, iterations=max(1, step // 3)), output=number
    )
    large = np.bincount(number.ravel()) >= least
    large[0] = False
    names: np.ndarray = np.where(large, np.cumsum(large), 0)[number]
    if large.sum() < 2:
        return mask[inside].astype(np.int64)
    nearest = np.asarray(
        ndimage.distance_transform_edt(names == 0, return_distances=False, return_indices=True)
    )
    return np.where(mask, names[tuple(nearest)], 0)[inside]


def _normals(points: np.ndarray, mask: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Return each pixel's unit normal towards the camera at (0, 0, 0), and a mask of the pixels
    where it is known.
    """
    known = mask.copy()
    sides = []
    for axis in (1, 0):
        sides.append(np.roll(points, -step, axis) - np.roll(points, step, axis))
        known &= np.roll(mask, -step, axis) & np.roll(mask, step, axis)
    normal = np.cross(*sides)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
    return np.where((normal * points).sum(-1, keepdims=True) > 0, -normal, normal), known


def _borders(parts: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of part numbers whose parts share a border of at least 5 pixels."""
    found = []
    for one, other in ((parts[1:], parts[:-1]), (parts[:, 1:], parts[:, :-1])):
        differ = (one != other) & (one > 0) & (other > 0)
        found.append(np.sort(np.stack([one[differ], other[differ]], -1), -1))
    pairs, count = np.unique(np.concatenate(found), axis=0, return_counts=True)
    return [(int(a), int(b)) for a, b in pairs[count >= 5]]


def _is_concave(parts: np.ndarray, points: np.ndarray, a: int, b: int) -> bool:
    """Return whether the surfaces of two parts, measured beside their border, meet at a concave
    angle.
    """
    first = parts == a
    second = parts == b
    border = spatial.KDTree(points[first & ndimage.binary_dilation(second)])
    sides = []
    for side in (points[first], points[second]):
        distance = border.query(side, distance_upper_bound=0.025)[0]
        sides.append(side[(distance > 0.004) & np.isfinite(distance)])
    if min(len(side) for side in sides) < 20:
        return False
    middles = [side.mean(0) for side in sides]
    chord = (middles[1] - middles[0]) / (np.linalg.norm(middles[1] - middles[0]) + 1e-12)
    rise = []
    for side, middle, sign in zip(sides, middles, (1.0, -1.0), strict=True):
        normal = np.linalg.svd(side - middle, full_matrices=False)[2][2]
        rise.append(sign * float(normal @ chord) * (-1.0 if normal @ middle > 0 else 1.0))
    return min(rise) > 0.5
