"""A software renderer in NumPy: triangles to pixels, without OpenGL."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8


class Triangles(NamedTuple):
    """Corners of triangles with normals and colours in [0, 1]; unlit triangles keep their colours."""

    corners: Float[np.ndarray, "t 3 3"]
    normals: Float[np.ndarray, "t 3 3"]
    colors: Float[np.ndarray, "t 3 3"]
    lit: Bool[np.ndarray, " t"]


class Camera(NamedTuple):
    """A pinhole camera: the rows of `frame` are right, up and back; `angle` is the vertical field of view [rad]."""

    position: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]
    angle: float


class _Screen(NamedTuple):
    """Triangles projected to the screen, in samples.

    `start` is the first corner. A triangle covers sample centres in the rows from `first` to before `last`. `edges` are
    its long, upper and lower side, each as upper end and slope over the rows. `planes` are the inverse distance, and
    the colour over the distance: values at the first corner, and gradients.
    """

    start: Float[np.ndarray, "t 2"]
    first: Int[np.ndarray, " t"]
    last: Int[np.ndarray, " t"]
    edges: Float[np.ndarray, "t 3 3"]
    planes: Float[np.ndarray, "t 3 4"]


def concatenate(parts: list[Triangles]) -> Triangles:
    """Return several sets of triangles, or none, as one set."""
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
    """Return the picture of opaque triangles, with the nearest layer of half-transparent triangles over them."""
    samples = 2  # samples of a pixel along each axis; the mean of the samples gives smooth edges
    width, height = size[0] * samples, size[1] * samples
    image = np.tile(np.array(background, dtype=np.float32), (height * width, 1))
    near = np.zeros(height * width, dtype=np.float32)
    sample, inverse_distance, color = _cast(_project(solid, camera, width, height), width, height)
    image[sample], near[sample] = color, inverse_distance
    sample, inverse_distance, color = _cast(_project(transparent, camera, width, height), width, height)
    front = inverse_distance > near[sample]
    image[sample[front]] += 0.5 * (color[front] - image[sample[front]])
    pixels = image.reshape(size[1], samples, size[0], samples, 3).mean((1, 3))
    return (255.0 * np.clip(pixels, 0.0, 1.0) + 0.5).astype(np.uint8)


def _project(triangles: Triangles, camera: Camera, width: int, height: int) -> _Screen:
    """Return triangles projected to the screen of a camera, with their lit colours."""
    local = (triangles.corners - camera.position) @ camera.frame.T
    near = 1.0 / np.maximum(-local[..., 2], 1e-6)  # the scene is framed in front of the camera
    focal = height / 2 / np.tan(camera.angle / 2)
    x = width / 2 + focal * local[..., 0] * near
    y = height / 2 - focal * local[..., 1] * near
    # Sample centres lie at integers + 0.5; a triangle covers the rows whose centres lie between its ends.
    first, last = (np.clip(np.ceil(end - 0.5), 0, height).astype(np.int64) for end in (y.min(1), y.max(1)))

    # Edges run from the upper end to the lower, so triangles that share an edge agree to the last bit: no cracks.
    order = np.argsort(y, axis=1)
    sorted_x, sorted_y = np.take_along_axis(x, order, 1), np.take_along_axis(y, order, 1)
    upper, lower = [0, 0, 1], [2, 1, 2]
    high = sorted_y[:, lower] - sorted_y[:, upper]
    slope = (sorted_x[:, lower] - sorted_x[:, upper]) / np.where(high > 0.0, high, 1.0)
    edges = np.stack([sorted_x[:, upper], sorted_y[:, upper], slope], -1)

    # A value that is linear in space is, divided by its distance, linear on the screen.
    values = np.concatenate([near[..., None], _shade(triangles, camera) * near[..., None]], -1)
    ab, ac = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    bx, cx, by, cy = (column[:, None] for side in (x, y) for column in (side[:, 1:] - side[:, :1]).T)
    area = bx * cy - cx * by
    area = np.where(area == 0.0, 1.0, area)
    planes = np.stack([values[:, 0], (ab * cy - ac * by) / area, (ac * bx - ab * cx) / area], 1)
    return _Screen(np.stack([x[:, 0], y[:, 0]], 1), first, last, edges, planes.astype(np.float32))


def _cast(screen: _Screen, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the covered samples, with inverse distance (k,) and colour (k, 3) of the nearest triangle at each."""
    owner, row = _ranges(screen.first, screen.last)
    middle = row + 0.5
    short = np.where(middle < screen.edges[owner, 2, 1], 1, 2)
    ends = [x + slope * (middle - y) for x, y, slope in (screen.edges[owner, side].T for side in (0, short))]
    begin, end = (np.clip(np.ceil(x - 0.5), 0, width).astype(np.int64) for x in (np.minimum(*ends), np.maximum(*ends)))
    some = np.flatnonzero(end > begin)
    owner, row, begin, end = owner[some], row[some], begin[some], end[some]

    # The inverse distance: its value where the row of a triangle begins, and its step along the row.
    x, y = (np.stack([begin, row], 1) + 0.5 - screen.start[owner]).astype(np.float32).T
    value, step, down = screen.planes[owner, :, 0].T
    value = value + step * x + down * y
    span, column = _ranges(begin, end)
    near = value[span] + step[span] * (column - begin[span]).astype(np.float32)
    sample = (row * width)[span] + column
    nearest = np.zeros(height * width, dtype=np.float32)
    np.maximum.at(nearest, sample, near)
    seen = np.flatnonzero(near == nearest[sample])

    near, sample, span = near[seen], sample[seen], span[seen]
    x, y = x[span] + (column[seen] - begin[span]).astype(np.float32), y[span]
    planes = screen.planes[owner[span], :, 1:]
    color = planes[:, 0] + x[:, None] * planes[:, 1] + y[:, None] * planes[:, 2]
    return sample, near, color / near[:, None]


def _ranges(begin: np.ndarray, end: np.ndarray) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return all integers of the ranges [begin, end), each with the index of its range."""
    counts = np.maximum(end - begin, 0)
    owner = np.repeat(np.arange(len(begin)), counts)
    start = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - (start - begin)[owner]


def _shade(triangles: Triangles, camera: Camera) -> Float[np.ndarray, "t 3 3"]:
    """Return the colours of the corners, lit by two lamps fixed to the camera."""
    ambient, key_strength, fill_strength, shine_strength = 0.52, 0.50, 0.22, 0.08  # chosen by eye, as are the lamps
    key, fill = (np.array(lamp) / np.linalg.norm(lamp) for lamp in ((-0.45, 0.65, 0.62), (0.70, 0.10, 0.60)))
    normal = triangles.normals @ camera.frame.T
    normal = normal / np.maximum(np.sqrt(np.einsum("tci,tci->tc", normal, normal)), 1e-12)[..., None]
    normal = np.where(normal[..., 2].sum(1)[:, None, None] < 0.0, -normal, normal)
    half = key + np.array([0.0, 0.0, 1.0])
    light = ambient + key_strength * np.maximum(normal @ key, 0.0) + fill_strength * np.maximum(normal @ fill, 0.0)
    shine = shine_strength * np.maximum(normal @ (half / np.linalg.norm(half)), 0.0) ** 40
    lit = triangles.lit[:, None]
    return triangles.colors * np.where(lit, light, 1.0)[..., None] + np.where(lit, shine, 0.0)[..., None]
