"""Common colours of all pictures, and a canvas that renders its triangles to pixels in NumPy,
without OpenGL.
"""

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from torchgrasp.foundation.lazy import Image, ImageDraw, ImageFont, matplotlib, trimesh

Points = Float[np.ndarray, "n 3"]
Color = tuple[float, float, float]
Direction = tuple[float, float, float]
FINGERS = (
    "#2f6db5",
    "#23967f",
    "#e0762f",
    "#8a4f9e",
    "#c23b55",
)  # colours of the fingers, in grasp order
AXES = ("#d62728", "#2ca02c", "#1f4fd8")  # colours of x, y and z of a frame
HAND = "#a9b0ba"
OBJECT = "#e9d7b3"
TABLE = "#eceae4"
SHADOW = "#c9c6bd"
"""Colours of the palm with parked fingers, of the object, of the table, and of shadows on the
table.
"""
OBJECTS = ("#e8743b", "#3f83d9", "#57a84f", "#b65fae", "#e0b92f", "#35aaa3", "#dd6b78", "#8474c9")
"""Colours of the objects of a scene in the order of their labels; after the last colour the first
follows.
"""
PAPER = "#fcfcfa"
INK = "#22262b"
GRID = "#dcdad3"
ALARM = "#c2452d"
"""Colours of the background, of lines with text, of grid lines, and of the moment at which an
object was lost.
"""
SIZE = (720, 576)  # width and height of a still [pixels]: twice its size on a page of three columns


class Triangles(NamedTuple):
    """Triangles by their corners [m], with a normal and a colour in [0, 1] at each; unlit triangles
    get no shading.
    """

    corners: Float[np.ndarray, "t 3 3"]
    normals: Float[np.ndarray, "t 3 3"]
    colors: Float[np.ndarray, "t 3 3"]
    lit: Bool[np.ndarray, " t"]


class Camera(NamedTuple):
    """A pinhole camera: the rows of `frame` are right, up and back; `angle` is the vertical field
    of view [rad].
    """

    position: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]
    angle: float


class Canvas:
    """A collection of shapes that is rendered to one picture."""

    def __init__(self) -> None:
        self.solid: list[Triangles] = []
        self.transparent: list[Triangles] = []

    def add_mesh(
        self,
        vertices: Float[np.ndarray, "v 3"],
        faces: np.ndarray,
        color: str | Float[np.ndarray, "v 3"],
        normals: Float[np.ndarray, "v 3"] | None = None,
        transparent: bool = False,
        lit: bool = True,
    ) -> None:
        """Add a mesh with one colour, or a colour for each vertex; without `normals`, strong bends
        look sharp.
        """
        corners = vertices[faces]
        bent = sharp_normals(vertices, faces) if normals is None else normals[faces]
        shade = (
            np.broadcast_to(rgb(color), corners.shape) if isinstance(color, str) else color[faces]
        )
        triangles = Triangles(corners, bent, shade, np.full(len(corners), lit))
        (self.transparent if transparent else self.solid).append(triangles)

    def add_points(self, points: Points, colors: Points) -> None:
        """Add points as small balls, each in its colour."""
        ball = trimesh.creation.icosphere(
            subdivisions=0, radius=0.006 * float(np.linalg.norm(np.ptp(points, axis=0)))
        )
        # too small on the page for its faces to show
        n = len(points)
        k = len(ball.vertices)
        faces = (k * np.arange(n)[:, None, None] + ball.faces).reshape(-1, 3)
        vertices = (points[:, None] + ball.vertices).reshape(-1, 3)
        self.add_mesh(vertices, faces, np.repeat(colors, k, 0), np.tile(ball.vertices, (n, 1)))

    def add_arrows(
        self, points: Points, directions: Points, length: float, colors: tuple[str, ...]
    ) -> None:
        """Add arrows of one length [m] in unit directions, each with its colour and a small ball at
        its start.
        """
        head = trimesh.creation.cone(radius=0.1, height=0.35, sections=8)
        head.apply_translation([0.0, 0.0, 0.65])
        shaft = trimesh.creation.cylinder(
            radius=0.035, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], sections=8
        )
        for start, direction, color in zip(points, directions, colors, strict=True):
            turn = np.asarray(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], direction))[:3, :3]
            for part in (trimesh.creation.icosphere(subdivisions=1, radius=0.13), shaft, head):
                self.add_mesh(length * part.vertices @ turn.T + start, part.faces, color)

    def add_table(
        self,
        corners: Points,
        height: float | None,
        shadows: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    ) -> None:
        """Add an unshaded round table top at `height` [m], centred on `corners` in x and y. None
        adds nothing.

        The `shadows` are meshes, by vertices and faces, whose outlines darken the table straight
        below them.
        """
        if height is None:
            return
        radius = 0.55 * float(np.linalg.norm(np.ptp(corners[:, :2], axis=0))) + 0.02
        top = trimesh.creation.cylinder(radius, 1e-4, sections=120)
        center = np.append((corners[:, :2].min(0) + corners[:, :2].max(0)) / 2, height - 1e-3)
        self.add_mesh(top.vertices + center, top.faces, TABLE, lit=False)
        for vertices, faces in shadows:
            flat = np.column_stack([vertices[:, :2], np.full(len(vertices), height - 5e-4)])
            self.add_mesh(flat, faces, SHADOW, np.tile([0.0, 0.0, 1.0], (len(flat), 1)), lit=False)

    def render(self, camera: Camera, size: tuple[int, int] = SIZE) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture that a camera sees, as pixels."""
        return render(
            concatenate(self.solid), concatenate(self.transparent), camera, size, rgb(PAPER)
        )

    def render_png(
        self, corners: Points, direction: Direction, bar: tuple[str, float, str] | None = None
    ) -> bytes:
        """Return a PNG that shows all `corners` [m]; `bar` is title, largest value and colour map
        of a bar below.
        """
        image = Image.fromarray(self.render(frame_camera(corners, direction, 0.09 if bar else 0.0)))
        if bar:
            draw_bar(image, *bar)
        return encode_png(image)


def frame_camera(
    corners: Points, direction: Direction, drop: float = 0.0, size: tuple[int, int] = SIZE
) -> Camera:
    """Return a camera in `direction` that sees all `corners`; the lowest fraction `drop` of its
    picture stays empty.
    """
    angle = np.deg2rad(24.0)  # a long lens distorts little
    x, y, z = direction
    flat = float(np.hypot(x, y))
    if flat < 1e-9:
        x = 1.0
        y = -0.8
        flat = float(np.hypot(1.0, -0.8))
    # A camera that looks straight down, or up from below the table, shows little.
    back = np.array([x, y, np.clip(z, 0.27 * flat, 0.84 * flat)])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(back, right), back])
    local = corners @ frame.T
    middle = (local.min(0) + local.max(0)) / 2
    half = np.ptp(local, axis=0) / 2
    # The nearest corners look largest, so the distance is counted from them.
    reach = max(half[1] / (1.0 - 1.5 * drop), half[0] * size[1] / size[0]) / np.tan(angle / 2)
    distance = half[2] + 1.12 * reach
    center = middle @ frame - frame[1] * drop * distance * np.tan(angle / 2)
    return Camera(center + back * distance, frame, float(angle))


def sharp_normals(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray
) -> Float[np.ndarray, "f 3 3"]:
    """Return a normal for each corner of each face; faces that bend by less than 40 degrees are one
    smooth surface.
    """
    smooth = trimesh.graph.smooth_shade(
        trimesh.Trimesh(vertices, faces), np.deg2rad(40.0), facet_minarea=None
    )
    normals = np.empty((len(faces), 3, 3))
    normals[np.concatenate(smooth.metadata["original_components"])] = smooth.vertex_normals[
        smooth.faces
    ]
    return normals


def concatenate(parts: list[Triangles]) -> Triangles:
    """Join several sets of triangles, or none, into one set."""
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
    """Return the pixels of a picture of opaque triangles; over them lies the nearest layer of
    transparent triangles.
    """
    samples = 2  # samples of a pixel along each axis; the mean of the samples gives smooth edges
    width = size[0] * samples
    height = size[1] * samples
    image = np.tile(np.array(background, dtype=np.float32), (height * width, 1))
    near = np.zeros(height * width)
    sample, inverse_distance, color = _cast(solid, camera, width, height)
    image[sample] = color
    near[sample] = inverse_distance
    sample, inverse_distance, color = _cast(transparent, camera, width, height)
    front = inverse_distance > near[sample]
    image[sample[front]] += 0.5 * (color[front] - image[sample[front]])
    pixels = image.reshape(size[1], samples, size[0], samples, 3).mean((1, 3))
    return (255.0 * np.clip(pixels, 0.0, 1.0) + 0.5).astype(np.uint8)


def _cast(
    triangles: Triangles, camera: Camera, width: int, height: int
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
    """Return indices of the samples that triangles cover, with inverse distance and colour of the
    nearest one.
    """
    local = (triangles.corners - camera.position) @ camera.frame.T
    near = 1.0 / np.maximum(-local[..., 2], 1e-6)  # the scene is framed in front of the camera
    focal = height / 2 / np.tan(camera.angle / 2)
    x = width / 2 + focal * local[..., 0] * near
    y = height / 2 - focal * local[..., 1] * near
    # A value that is linear in space is, divided by its distance, linear on the screen: a x + b y +
    # c.
    values = np.concatenate([near[..., None], _shade(triangles, camera) * near[..., None]], -1)
    screen = np.stack([x, y, np.ones_like(x)], -1)
    seen = np.abs(np.linalg.det(screen)) > 1e-9  # a triangle seen from its edge covers nothing
    # of the corners, as functions of x, y and 1
    weights = np.linalg.inv(screen[seen])
    y = y[seen]
    planes = weights @ values[seen]

    # Sample centres lie at integers + 0.5; in each row a triangle covers those where no weight is
    # negative.
    owner, row = _ranges(
        *(np.clip(np.ceil(end - 0.5), 0, height).astype(np.int64) for end in (y.min(1), y.max(1)))
    )
    slope = weights[owner, 0]
    rest = weights[owner, 1] * (row + 0.5)[:, None] + weights[owner, 2]
    zero = -rest / np.where(slope == 0.0, 1.0, slope)
    begin = np.where(slope > 0.0, zero, -np.inf).max(1)
    end = np.where(slope < 0.0, zero, np.inf).min(1)
    # triangles that share an edge both cover a centre on it, so that no crack is left between them
    tie = 1e-6
    begin, end = (
        np.clip(np.ceil(e - 0.5), 0, width).astype(np.int64) for e in (begin - tie, end + tie)
    )
    span, column = _ranges(begin, end)

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
    # chosen by eye, as are the lamps
    ambient = 0.52
    key_strength = 0.50
    fill_strength = 0.22
    shine_strength = 0.08
    key, fill = (
        np.array(lamp) / np.linalg.norm(lamp) for lamp in ((-0.45, 0.65, 0.62), (0.70, 0.10, 0.60))
    )
    normal = triangles.normals @ camera.frame.T
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    normal = np.where(normal[..., 2].sum(1)[:, None, None] < 0.0, -normal, normal)
    half = key + np.array([0.0, 0.0, 1.0])
    light = (
        ambient
        + key_strength * np.maximum(normal @ key, 0.0)
        + fill_strength * np.maximum(normal @ fill, 0.0)
    )
    shine = shine_strength * np.maximum(normal @ (half / np.linalg.norm(half)), 0.0) ** 40
    lit = triangles.lit[:, None]
    return (
        triangles.colors * np.where(lit, light, 1.0)[..., None]
        + np.where(lit, shine, 0.0)[..., None]
    )


def rgb(color: str) -> Color:
    """Return the red, green and blue parts, each in [0, 1], of a colour written as "#rrggbb"."""
    red, green, blue = (x / 255 for x in bytes.fromhex(color[1:]))
    return red, green, blue


def map_colors(values: Float[np.ndarray, " n"], name: str) -> Points:
    """Return the colours that the matplotlib colour map `name` gives to values in [0, 1]."""
    return matplotlib.colormaps[name](values)[:, :3]


def color_std(std_m: Float[np.ndarray, " n"]) -> tuple[Points, float]:
    """Return the colours of standard deviations [m], and the one that has the last colour: all but
    a hundredth.
    """
    most = max(float(np.quantile(std_m, 0.99)), 1e-6) if len(std_m) else 1e-6
    return map_colors(std_m / most, "viridis"), most


def draw_bar(image: Any, title: str, most: float, colors: str) -> None:
    """Draw a titled colour bar from 0 to `most` at the bottom of a picture."""
    width, height = image.size
    left = width // 5
    right = width - width // 5
    top = height - 24
    bottom = height - 10
    ramp = map_colors(np.linspace(0.0, 1.0, right - left), colors)
    strip = (255 * np.broadcast_to(ramp, (bottom - top, *ramp.shape)) + 0.5).astype(np.uint8)
    image.paste(Image.fromarray(strip), (left, top))
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(20)
    for i in range(4):
        draw.text(
            (left + i * (right - left) / 3, top - 4), f"{most * i / 3:.1f}", INK, font, anchor="ms"
        )
    draw.text(((left + right) / 2, top - 29), title, INK, font, anchor="ms")


def encode_png(image: Any) -> bytes:
    """Return the bytes of a PNG of a Pillow image."""
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()


def encode_figure(figure: Any) -> bytes:
    """Return the bytes of a PNG of a matplotlib figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
