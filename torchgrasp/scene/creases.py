"""Division of a connected surface into parts along its creases, where two surfaces meet at a
concave angle.
"""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import number_components
from torchgrasp.scene.image import DepthImage, scale_pixels


@dataclasses.dataclass(frozen=True)
class CreaseNumbers:
    """Parameters of the search for concave creases, at which touching objects are separated."""

    reach: float = 0.012
    """Distance [m] on either side of a crease over which its angle is measured."""
    part: int = 300
    """Least number of pixels of a part that a crease cuts off, in an image of 640 x 480."""
    bend: float = 0.35
    """Least sine of the angle by which each side of a crease rises above the chord across it."""
    chord: float = 0.048
    """Greatest length [m] of the chord across a crease: a longer one spans a jump of depth."""
    border: int = 5
    """Least number of border pixels of two parts that may be joined again. Parts that share fewer
    stay apart.
    """
    near: float = 0.004
    """Distance [m] from the border within which points are on the crease, rounded, and do not count
    for its angle.
    """
    far: float = 0.025
    """Distance [m] from the border beyond which points do not count for the angle of a crease."""
    points: int = 20
    """Least number of points of a side of a crease whose normal is fitted."""
    concave: float = 0.5
    """Least sine of the angle by which each fitted side of a concave crease rises above the chord.
    """
    least_share: float = 1e-9
    """Least share of averaged pixels that is a divisor, so that nothing is divided by 0."""
    least_length: float = 1e-12
    """Least length [m] that is a divisor, so that nothing is divided by 0."""


CREASE = CreaseNumbers()
# ways across a crease (row, column), in the length of a step
WAYS = ((1.0, 0.0), (0.0, 1.0), (0.7, 0.7), (0.7, -0.7))


def cut_creases(
    image: DepthImage, points: Float[Tensor, "h w 3"], pieces: Int[Tensor, "h w"]
) -> Int[Tensor, "h w"]:
    """Cut the pieces of a depth image along their concave creases; return each pixel's part.

    The result holds the number of the part, 0 for none. A piece holds the pixels with one number >
    0 in `pieces` (h, w). At a concave crease two surfaces meet, as those of touching objects do.
    Each part gets a number of its own. `points` (h, w, 3) [m] are those of the image, in the frame
    "obj" to which its pose leads.
    """
    least = scale_pixels(CREASE.part, pieces)
    # from the camera, so that normals can face it
    seen = (points - image.obj_from_camera[:3, 3]).numpy()
    parts = pieces.clone()
    last = int(pieces.max())
    # only pieces of two parts or more are searched, and numbered 1, 2, ...
    names, count = pieces[pieces > 0].unique(return_counts=True)
    large = names[count >= 2 * least]
    numbers = torch.zeros(last + 1, dtype=torch.int32)
    numbers[large] = torch.arange(1, 1 + len(large), dtype=torch.int32)
    found = numbers[pieces].numpy()
    boxes: list[tuple[slice, slice]] = ndimage.find_objects(found)
    for number, box in enumerate(boxes, start=1):
        mask = found[box] == number
        pixels_a_metre = image.focal / float(image.depth[box][torch.from_numpy(mask)].median())
        own = _divide(seen[box], mask, pixels_a_metre * CREASE.reach, least)
        # parts that meet at no concave angle are one
        joined = [pair for pair in _borders(own) if not _is_concave(own, seen[box], *pair)]
        pairs = np.array(joined, dtype=np.int64).reshape(-1, 2)
        own = number_components(pairs, int(own.max()) + 1)[own]
        new = torch.from_numpy(own.astype(np.int64))
        parts[box] = torch.where(new > 1, last + new - 1, parts[box])
        last += max(0, int(own.max()) - 1)
    return parts


def _divide(points: np.ndarray, mask: np.ndarray, reach: float, least: float) -> np.ndarray:
    """Return the part (1, 2, ...) of each pixel of a piece, 0 outside it; pixels on creases join
    the nearest part.

    `reach` [px] is the distance over which an angle is measured, `least` the pixels of a part.
    """
    step = max(2, round(reach))
    inside = (slice(step, -step), slice(step, -step))
    mask = np.pad(mask, step)
    points = np.pad(points, ((step, step), (step, step), (0, 0)))
    crease = _find_creases(points, mask, step)
    number = np.empty(mask.shape, dtype=np.int32)
    thin = ndimage.binary_erosion(mask & ~crease, iterations=max(1, step // 3))
    ndimage.label(thin, output=number)
    large = np.bincount(number.ravel()) >= least
    large[0] = False
    if large.sum() < 2:
        return mask[inside].astype(np.int64)
    names: np.ndarray = np.where(large, np.cumsum(large), 0)[number]
    nearest = np.asarray(
        ndimage.distance_transform_edt(names == 0, return_distances=False, return_indices=True)
    )
    return np.where(mask, names[tuple(nearest)], 0)[inside]


def _find_creases(points: np.ndarray, mask: np.ndarray, step: int) -> np.ndarray:
    """Return a mask of the pixels at which the surface bends towards the camera. The bend is seen
    over `step` pixels to either side.
    """
    width = step | 1
    share = np.maximum(ndimage.uniform_filter(mask.astype(float), width), CREASE.least_share)
    smooth = np.empty_like(points)
    for k in range(3):
        total = ndimage.uniform_filter(np.where(mask, points[..., k], 0.0), width)
        smooth[..., k] = total / share
    normal, known = _normals(smooth, mask, max(1, step // 2))
    crease = np.zeros_like(mask)
    for down, right in WAYS:
        after = (round(step * down), round(step * right))
        before = (-after[0], -after[1])
        start, first, first_known = (np.roll(x, after, (0, 1)) for x in (smooth, normal, known))
        end, last, last_known = (np.roll(x, before, (0, 1)) for x in (smooth, normal, known))
        chord = end - start
        length = np.linalg.norm(chord, axis=-1) + CREASE.least_length
        # how much each side rises towards the camera along the chord
        rise = (first * chord).sum(-1) / length
        fall = -(last * chord).sum(-1) / length
        bent = np.minimum(rise, fall) > CREASE.bend
        crease |= first_known & last_known & bent & (length < CREASE.chord)
    return crease


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
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + CREASE.least_length
    away = (normal * points).sum(-1, keepdims=True) > 0
    return np.where(away, -normal, normal), known


def _borders(parts: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of part numbers whose parts share a border of enough pixels."""
    found = []
    for one, other in ((parts[1:], parts[:-1]), (parts[:, 1:], parts[:, :-1])):
        differ = (one != other) & (one > 0) & (other > 0)
        pairs = np.stack([one[differ], other[differ]], -1)
        found.append(np.sort(pairs, -1))
    pairs, count = np.unique(np.concatenate(found), axis=0, return_counts=True)
    return [(int(a), int(b)) for a, b in pairs[count >= CREASE.border]]


def _is_concave(parts: np.ndarray, points: np.ndarray, a: int, b: int) -> bool:
    """Return whether the surfaces of two parts, measured beside their border, meet at a concave
    angle.
    """
    first = parts == a
    second = parts == b
    border = spatial.KDTree(points[first & ndimage.binary_dilation(second)])
    sides = []
    for side in (points[first], points[second]):
        distance = border.query(side, distance_upper_bound=CREASE.far)[0]
        sides.append(side[(distance > CREASE.near) & np.isfinite(distance)])
    if min(len(side) for side in sides) < CREASE.points:
        return False
    middles = [side.mean(0) for side in sides]
    chord = middles[1] - middles[0]
    chord = chord / (np.linalg.norm(chord) + CREASE.least_length)
    rise = []
    for side, middle, sign in zip(sides, middles, (1.0, -1.0), strict=True):
        normal = np.linalg.svd(side - middle, full_matrices=False)[2][2]
        facing = -1.0 if normal @ middle > 0 else 1.0
        rise.append(sign * float(normal @ chord) * facing)
    return min(rise) > CREASE.concave
