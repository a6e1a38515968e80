"""Rendering of triangles to pixels in NumPy, with two lamps, without OpenGL."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

Color = tuple[float, float, float]  # red, green and blue in [0, 1]
Direction = tuple[float, float, float]  # (x, y, z) of any length
FULL = 255  # largest value of a colour part in a byte


@dataclasses.dataclass(frozen=True)
class RasterNumbers:
    """Parameters of the rendering of triangles to pixels."""

    samples: int = 2  # number of samples along each axis of a pixel; their mean gives smooth edges
    opacity: float = 0.5  # opacity of transparent triangles, in [0, 1]
    nearest: float = 1e-6  # least distance from the camera [m]; the scene is framed in front of it
    # twice the area [px^2] of a triangle below which it is not drawn: it is seen from its edge
    thinnest: float = 1e-9
    # Distance [pixels] from an edge that two triangles share, within which both cover the centre of
    # a pixel. So no crack is left between them.
    tie: float = 1e-6


@dataclasses.dataclass(frozen=True)
class Lamps:
    """Numbers of two lamps fixed to the camera, chosen by eye.

    Strengths are factors of a surface's colour; directions are (right, up, back).
    """

    ambient: float = 0.52  # brightness without the lamps
    key_strength: float = 0.50  # brightness that the main lamp adds
    fill_strength: float = 0.22  # brightness that the second lamp adds
    shine_strength: float = 0.08  # white that the highlight of the main lamp adds
    key: Direction = (-0.45, 0.65, 0.62)  # direction to the main lamp
    fill: Direction = (0.70, 0.10, 0.60)  # direction to the second lamp
    shininess: int = 40  # exponent: larger makes the highlight smaller
    least_normal: float = 1e-12  # least length of a normal as a divisor: a face without area has 0


RASTER = RasterNumbers()
LAMPS = Lamps()


class Triangles(NamedTuple):
    """A set of t triangles, each with a normal and a colour at its three corners.

    Attributes:
        corners: positions of the corners [m].
        normals: vectors across the surface at the corners, of any length and either sign.
        colors: red, green and blue at the corners, in [0, 1].
        lit: mask of the triangles that are shaded; the others keep their colours.
    """

    corners: Float[np.ndarray, "t 3 3"]
    normals: Float[np.ndarray, "t 3 3"]
    colors: Float[np.ndarray, "t 3 3"]
    lit: Bool[np.ndarray, " t"]


class Camera(NamedTuple):
    """A pinhole camera.

    Attributes:
        position: place of its centre [m], in the frame of the shapes.
        frame: unit vectors to the right, up and back of the camera, one in each row.
        angle: vertical field of view [rad].
    """

    position: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]
    angle: float


def concatenate(parts: list[Triangles]) -> Triangles:
    """Return one set with all triangles of the sets `parts`; it is empty without parts."""
    empty = np.zeros((0, 3, 3))
    none = Triangles(empty, empty, empty, np.zeros(0, dtype=bool))
    return Triangles(*(np.concatenate(column) for column in zip(none, *parts, strict=True)))


def render(
    solid: Triangles,
    transparent: Triangles,
    camera: Camera,
    size: tuple[int, int],
    background: Color,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture (h, w, 3) that a camera sees of opaque and transparent triangles.

    Its pixels are red, green and blue, 0 to 255. Of the transparent triangles, only the nearest
    layer is drawn over the opaque ones (`solid`). `size` is the width and height (w, h) of the
    picture [pixels]. `background` is red, green and blue in [0, 1].
    """
    samples = RASTER.samples
    width = size[0] * samples
    height = size[1] * samples
    image = np.full((height * width, 3), background, dtype=np.float32)
    near = np.zeros(height * width)
    sample, inverse_distance, color = _cast(solid, camera, width, height)
    image[sample] = color
    near[sample] = inverse_distance
    sample, inverse_distance, color = _cast(transparent, camera, width, height)
    front = inverse_distance > near[sample]
    image[sample[front]] += RASTER.opacity * (color[front] - image[sample[front]])
    parts = image.reshape(size[1], samples, size[0], samples, 3)
    # NumPy is several times slower with short axes inside
    shares = (parts[:, i, :, j] for i in range(samples) for j in range(samples))
    pixels = functools.reduce(np.add, shares) / samples**2
    return (FULL * np.clip(pixels, 0.0, 1.0) + 0.5).astype(np.uint8)


def _cast(
    triangles: Triangles, camera: Camera, width: int, height: int
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
    """Return indices of the samples that triangles cover, with inverse distance and colour of the
    nearest one.
    """
    local = (triangles.corners - camera.position) @ camera.frame.T
    near = 1.0 / np.maximum(-local[..., 2], RASTER.nearest)
    focal = height / 2 / np.tan(camera.angle / 2)
    x = width / 2 + focal * local[..., 0] * near
    y = height / 2 - focal * local[..., 1] * near
    # A value linear in space is, divided by its distance, linear on the screen: a x + b y + c.
    values = np.concatenate([near[..., None], _shade(triangles, camera) * near[..., None]], -1)
    screen = np.stack([x, y, np.ones_like(x)], -1)
    seen = np.abs(np.linalg.det(screen)) > RASTER.thinnest
    # weights of the corners, as functions of x, y and 1: (t, 3, 3)
    weights = np.linalg.inv(screen[seen])
    y = y[seen]
    planes = weights @ values[seen]

    # Sample centres lie at integers + 0.5; in each row a triangle covers those where no weight is
    # negative.
    owner, row = _ranges(*(_first_centre(end(y), height) for end in (_least, _most)))
    slope = weights[owner, 0]
    rest = weights[owner, 1] * (row + 0.5)[:, None] + weights[owner, 2]
    zero = -rest / np.where(slope == 0.0, 1.0, slope)
    begin = _most(np.where(slope > 0.0, zero, -np.inf))
    end = _least(np.where(slope < 0.0, zero, np.inf))
    span, column = _ranges(
        _first_centre(begin - RASTER.tie, width), _first_centre(end + RASTER.tie, width)
    )

    flat = planes[owner, 1] * (row + 0.5)[:, None] + planes[owner, 2]  # b y + c
    near = planes[owner, 0, 0][span] * (column + 0.5) + flat[span, 0]
    sample = row[span] * width + column
    nearest = np.zeros(height * width)
    np.maximum.at(nearest, sample, near)
    first = np.flatnonzero(near == nearest[sample])
    span = span[first]
    column = column[first]
    near = near[first]
    color = planes[owner[span], 0, 1:] * (column + 0.5)[:, None] + flat[span, 1:]
    return sample[first], near, color / near[:, None]


def _least(values: np.ndarray) -> np.ndarray:
    """Return the least of each row; NumPy takes several times as long along a short axis."""
    return functools.reduce(np.minimum, values.T)


def _most(values: np.ndarray) -> np.ndarray:
    """Return the greatest of each row."""
    return functools.reduce(np.maximum, values.T)


def _first_centre(place: np.ndarray, most: int) -> Int[np.ndarray, " n"]:
    """Return the index of the first sample centre at or after each place, from 0 to `most`."""
    return np.clip(np.ceil(place - 0.5), 0, most).astype(np.int64)


def _ranges(
    begin: np.ndarray, end: np.ndarray
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """List all integers in the ranges [begin, end): return the index of each one's range, and the
    integers.
    """
    counts = np.maximum(end - begin, 0)
    owner = np.repeat(np.arange(len(begin)), counts)
    start = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - (start - begin)[owner]


def _shade(triangles: Triangles, camera: Camera) -> Float[np.ndarray, "t 3 3"]:
    """Return the colours of the corners, lit by two lamps fixed to the camera."""
    key = np.array(LAMPS.key) / np.linalg.norm(LAMPS.key)
    fill = np.array(LAMPS.fill) / np.linalg.norm(LAMPS.fill)
    normal = triangles.normals @ camera.frame.T
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.maximum(length, LAMPS.least_normal)
    # a triangle has no back: seen from there, its normals are reversed
    normal = np.where(normal[..., 2].sum(1)[:, None, None] < 0.0, -normal, normal)
    light = (
        LAMPS.ambient
        + LAMPS.key_strength * np.maximum(normal @ key, 0.0)
        + LAMPS.fill_strength * np.maximum(normal @ fill, 0.0)
    )
    half = key + np.array([0.0, 0.0, 1.0])
    mirrored = np.maximum(normal @ (half / np.linalg.norm(half)), 0.0)
    shine = LAMPS.shine_strength * mirrored**LAMPS.shininess
    lit = triangles.lit[:, None]
    matt = triangles.colors * np.where(lit, light, 1.0)[..., None]
    return matt + np.where(lit, shine, 0.0)[..., None]
