"""Triangles to pixels in numpy: stills without OpenGL and its system libraries, the same bytes on every machine."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

SAMPLES = 2
"""Samples of a pixel along each axis: enough for smooth edges."""

AMBIENT, KEY, FILL, SHINE = 0.52, 0.50, 0.22, 0.08
"""Strengths of the ambient light, the two lamps and the highlight: chosen by eye."""
LAMPS = ((-0.45, 0.65, 0.62), (0.70, 0.10, 0.60))
"""Directions to the two lamps in the camera's frame (right, up, back): chosen by eye."""


class Triangles(NamedTuple):
    """Corners of triangles, with their normals and colours in [0, 1]; unlit ones keep their colours."""

    corners: Float[np.ndarray, "t 3 3"]
    normals: Float[np.ndarray, "t 3 3"]
    colors: Float[np.ndarray, "t 3 3"]
    lit: Bool[np.ndarray, " t"]


class Camera(NamedTuple):
    """A pinhole camera: rows of `frame` are right, up and back; `angle` is the vertical view [rad]."""

    position: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]
    angle: float


class _Hits(NamedTuple):
    """The nearest triangle of each covered pixel, and the weights of its corners."""

    pixel: Int[np.ndarray, " k"]
    triangle: Int[np.ndarray, " k"]
    weights: Float[np.ndarray, "k 3"]
    depth: Float[np.ndarray, " k"]


def concatenate(parts: list[Triangles]) -> Triangles:
    """Return all triangles of several sets, or of none, as one."""
    empty = np.zeros((0, 3, 3))
    none = Triangles(empty, empty, empty, np.zeros(0, dtype=bool))
    return Triangles(*(np.concatenate(column) for column in zip(none, *parts, strict=True)))


def render(
    solid: Triangles,
    transparent: Triangles,
    camera: Camera,
    size: tuple[int, int],
    background: tuple[float, float, float],
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture of opaque triangles under the nearest layer of transparent ones, which hides half of them."""
    width, height = size[0] * SAMPLES, size[1] * SAMPLES
    image = np.tile(background, (width * height, 1))
    hits = _cast(solid, camera, width, height)
    image[hits.pixel] = _shade(solid, hits, camera)
    depth = np.full(width * height, np.inf)
    depth[hits.pixel] = hits.depth
    veil = _cast(transparent, camera, width, height)
    front = veil.depth < depth[veil.pixel]
    veil = _Hits(*(column[front] for column in veil))
    image[veil.pixel] += 0.5 * (_shade(transparent, veil, camera) - image[veil.pixel])
    grid = image.reshape(size[1], SAMPLES, size[0], SAMPLES, 3)
    boxes = sum(grid[:, i, :, j] for i in range(SAMPLES) for j in range(SAMPLES)) / SAMPLES**2
    return (255.0 * np.clip(boxes, 0.0, 1.0) + 0.5).astype(np.uint8)


def _cast(triangles: Triangles, camera: Camera, width: int, height: int) -> _Hits:
    """Return the nearest triangle at each pixel, found row by row."""
    local = (triangles.corners - camera.position) @ camera.frame.T
    away = np.maximum(-local[..., 2], 1e-6)  # the scene is framed in front of the camera
    focal = height / 2 / np.tan(camera.angle / 2)
    x = width / 2 + focal * local[..., 0] / away
    y = height / 2 - focal * local[..., 1] / away

    # Pixel centres lie at integers + 0.5; a triangle covers the rows whose centres lie between its ends.
    first = np.clip(np.ceil(y.min(1) - 0.5), 0, height).astype(np.int64)
    last = np.clip(np.ceil(y.max(1) - 0.5), 0, height).astype(np.int64)
    owner, row = _ranges(first, last)
    middle = row + 0.5
    left, right = np.full(len(owner), np.inf), np.full(len(owner), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):  # where the edges cross the row: numpy is slow on axes of length 3
        # From the upper end to the lower, so that triangles that share an edge agree to the last bit: no cracks.
        swap = y[:, a] > y[:, b]
        xa, xb = np.where(swap, x[:, b], x[:, a]), np.where(swap, x[:, a], x[:, b])
        ya, yb = np.minimum(y[:, a], y[:, b]), np.maximum(y[:, a], y[:, b])
        slope = (xb - xa) / np.where(yb > ya, yb - ya, 1.0)
        crossed = (ya[owner] <= middle) & (middle < yb[owner])
        at = xa[owner] + slope[owner] * (middle - ya[owner])
        left = np.where(crossed & (at < left), at, left)
        right = np.where(crossed & (at > right), at, right)
    begin = np.clip(np.ceil(left - 0.5), 0, width).astype(np.int64)
    end = np.clip(np.ceil(right - 0.5), 0, width).astype(np.int64)
    span, column = _ranges(begin, end)
    triangle, row = owner[span], row[span]

    # Barycentric weights on the screen are linear in the pixel's place.
    (ax, bx, cx), (ay, by, cy) = x.T, y.T
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    area = np.where(area == 0.0, 1.0, area)
    px, py = column + 0.5 - ax[triangle], row + 0.5 - ay[triangle]
    wb = ((cy - ay) / area)[triangle] * px - ((cx - ax) / area)[triangle] * py
    wc = ((bx - ax) / area)[triangle] * py - ((by - ay) / area)[triangle] * px
    # In space they are divided by the distance of their corners.
    near = (1.0 / away)[triangle]
    wa, wb, wc = (1.0 - wb - wc) * near[:, 0], wb * near[:, 1], wc * near[:, 2]
    depth = 1.0 / np.maximum(wa + wb + wc, 1e-12)

    pixel = row * width + column
    nearest = np.full(width * height, np.inf)
    np.minimum.at(nearest, pixel, depth)
    keep = depth == nearest[pixel]
    weights = np.stack([wa[keep], wb[keep], wc[keep]], 1) * depth[keep, None]
    return _Hits(pixel[keep], triangle[keep], weights, depth[keep])


def _ranges(begin: np.ndarray, end: np.ndarray) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return the integers of the ranges [begin, end) with their ranges."""
    counts = np.maximum(end - begin, 0)
    owner = np.repeat(np.arange(len(begin)), counts)
    start = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - start[owner] + begin[owner]


def _shade(triangles: Triangles, hits: _Hits, camera: Camera) -> Float[np.ndarray, "k 3"]:
    """Light both sides by two lamps fixed to the camera."""
    color = np.einsum("kci,kc->ki", triangles.colors[hits.triangle], hits.weights)
    normal = np.einsum("kci,kc->ki", triangles.normals[hits.triangle], hits.weights) @ camera.frame.T
    normal /= np.maximum(np.sqrt(np.einsum("ki,ki->k", normal, normal)), 1e-12)[:, None]
    normal = np.where(normal[:, 2:] < 0.0, -normal, normal)
    key, fill = (np.array(lamp) / np.linalg.norm(lamp) for lamp in LAMPS)
    half = key + np.array([0.0, 0.0, 1.0])
    light = AMBIENT + KEY * np.maximum(normal @ key, 0.0) + FILL * np.maximum(normal @ fill, 0.0)
    shine = SHINE * np.maximum(normal @ (half / np.linalg.norm(half)), 0.0) ** 40
    bright = triangles.lit[hits.triangle]
    return color * np.where(bright, light, 1.0)[:, None] + np.where(bright, shine, 0.0)[:, None]
