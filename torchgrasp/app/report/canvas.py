"""Common colours of all pictures, and a canvas that renders its triangles to pixels in NumPy,
without OpenGL.
"""

import dataclasses
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from torchgrasp.foundation.lazy import Image, ImageDraw, ImageFont, matplotlib, trimesh
from torchgrasp.geometry.plane import Plane, as_plane

Points = Float[np.ndarray, "n 3"]  # points [m], or colours in [0, 1]
Color = tuple[float, float, float]  # red, green and blue in [0, 1]
Direction = tuple[float, float, float]  # (x, y, z) of any length
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
FULL = 255  # largest value of a colour part in a byte


@dataclasses.dataclass(frozen=True)
class MarkShapes:
    """Sizes of points, arrows and the table in a picture, chosen by eye."""

    point_radius: float = 0.006  # share of the diagonal of all points
    # parts of an arrow, in lengths of the arrow; the shaft ends inside the head
    head_radius: float = 0.1  # radius of the head, a cone
    head_length: float = 0.35  # length of the head
    head_start: float = 0.65  # distance of the head's base from the arrow's start
    shaft_radius: float = 0.035  # radius of the shaft, a cylinder
    shaft_length: float = 0.75  # length of the shaft
    ball_radius: float = 0.13  # radius of the ball at the arrow's start
    arrow_sections: int = 8  # sides of head and shaft
    table_radius: float = 0.55  # share of the diagonal of all corners seen from above
    table_rim: float = 0.02  # added to the radius [m], so that a small object has a table, too
    table_sections: int = 120  # corners of the round table top
    table_thickness: float = 1e-4  # thickness of the table top [m]
    # depths below the true height [m]: the object hides shadows, and shadows hide the table
    table_depth: float = 1e-3  # depth of the table
    shadow_depth: float = 5e-4  # depth of the shadows


@dataclasses.dataclass(frozen=True)
class Framing:
    """Numbers that place a camera so that it shows a set of points."""

    angle: float = 24.0  # vertical field of view [degrees]: a long lens distorts little
    # straight down, or up from below the table, a camera shows little
    lowest: float = 0.27  # least rise of the direction for each metre along the ground
    highest: float = 0.84  # greatest rise of the direction for each metre along the ground
    margin: float = 1.12  # distance beyond the nearest at which all corners are in view
    level: float = 1e-9  # a direction with less of x and y [m] is vertical
    fallback: tuple[float, float] = (1.0, -0.8)  # x and y instead of a vertical direction
    bar_drop: float = 0.09  # share of the picture that stays empty below for a colour bar
    squeeze: float = 1.5  # loss of height for each empty share: the share, and half of it above


@dataclasses.dataclass(frozen=True)
class RasterNumbers:
    """Parameters of the rendering of triangles to pixels."""

    samples: int = 2  # number of samples along each axis of a pixel; their mean gives smooth edges
    opacity: float = 0.5  # opacity of transparent triangles, in [0, 1]
    nearest: float = 1e-6  # least distance from the camera [m]; the scene is framed in front of it
    thinnest: float = 1e-9  # twice the least area [pixels]: seen from its edge, a triangle is thin
    # Triangles that share an edge both cover a centre within this distance [pixels] of it, so that
    # no crack is left between them.
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


@dataclasses.dataclass(frozen=True)
class BarLayout:
    """Layout of a colour bar at the bottom of a picture [pixels]."""

    side: int = 5  # width of the picture over the free width on each side of the bar
    top: int = 24  # upper end of the strip, from the bottom of the picture
    bottom: int = 10  # lower end of the strip, from the bottom of the picture
    font: int = 20  # size of numbers and title
    labels: int = 4  # count of the numbers above the strip
    label_rise: int = 4  # height of these numbers above the strip
    title_rise: int = 29  # height of the title above the strip


MARKS = MarkShapes()
FRAMING = Framing()
RASTER = RasterNumbers()
LAMPS = Lamps()
BAR = BarLayout()
SMOOTH_BEND = 40.0  # faces that bend by less [degrees] look like one smooth surface
STD_QUANTILE = 0.99  # of the standard deviations that a colour map spans: few outliers
LEAST_STD = 1e-6  # least span of a colour map of standard deviations [m]
PNG_LEVEL = 4  # of compression: higher is slower and hardly smaller


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
        """Add a mesh with one colour "#rrggbb", or with a colour in [0, 1] for each vertex.

        `vertices` [m] have the vertex `normals`; without them, edges with a strong bend look sharp.
        `faces` (t, 3) are indices of three vertices. With `lit` False the mesh gets no shading. A
        `transparent` mesh shows the opaque ones behind it.
        """
        corners = vertices[faces]
        bent = sharp_normals(vertices, faces) if normals is None else normals[faces]
        shade = (
            np.broadcast_to(rgb(color), corners.shape) if isinstance(color, str) else color[faces]
        )
        triangles = Triangles(corners, bent, shade, np.full(len(corners), lit))
        (self.transparent if transparent else self.solid).append(triangles)

    def add_points(self, points: Points, colors: Points) -> None:
        """Add points (n, 3) [m] as small balls.

        `colors` (n, 3) are red, green and blue in [0, 1].
        """
        # so small on the page that the faces of the balls do not show
        radius = MARKS.point_radius * float(np.linalg.norm(np.ptp(points, axis=0)))
        ball = trimesh.creation.icosphere(subdivisions=0, radius=radius)
        n = len(points)
        k = len(ball.vertices)
        faces = (k * np.arange(n)[:, None, None] + ball.faces).reshape(-1, 3)
        vertices = (points[:, None] + ball.vertices).reshape(-1, 3)
        self.add_mesh(vertices, faces, np.repeat(colors, k, 0), np.tile(ball.vertices, (n, 1)))

    def add_arrows(
        self, points: Points, directions: Points, length: float, colors: tuple[str, ...]
    ) -> None:
        """Add n arrows of one `length` [m], each with a small ball at its start.

        `points` (n, 3) [m] are the starts, `directions` (n, 3) unit vectors, and `colors` n texts
        "#rrggbb".
        """
        sections = MARKS.arrow_sections
        head = trimesh.creation.cone(
            radius=MARKS.head_radius, height=MARKS.head_length, sections=sections
        )
        head.apply_translation([0.0, 0.0, MARKS.head_start])
        shaft = trimesh.creation.cylinder(
            radius=MARKS.shaft_radius,
            segment=[[0.0, 0.0, 0.0], [0.0, 0.0, MARKS.shaft_length]],
            sections=sections,
        )
        ball = trimesh.creation.icosphere(subdivisions=1, radius=MARKS.ball_radius)
        for start, direction, color in zip(points, directions, colors, strict=True):
            turn = np.asarray(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], direction))[:3, :3]
            for part in (ball, shaft, head):
                self.add_mesh(length * part.vertices @ turn.T + start, part.faces, color)

    def add_table(
        self,
        corners: Points,
        table: Plane | float | None,
        shadows: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    ) -> None:
        """Add an unshaded round table top; without a table nothing is added.

        The `table` is level: its height z [m], or a plane. It is cut off at its edge. Its centre is
        that of `corners` (n, 3) [m] in x and y. The `shadows` are meshes, by vertices (v, 3) [m]
        and faces (t, 3), whose outlines darken the table straight below them.
        """
        plane = as_plane(table)
        if plane is None:
            return
        height = plane.offset
        across = corners[:, :2]
        radius = MARKS.table_radius * float(np.linalg.norm(np.ptp(across, axis=0)))
        top = trimesh.creation.cylinder(
            radius + MARKS.table_rim, MARKS.table_thickness, sections=MARKS.table_sections
        )
        center = np.append((across.min(0) + across.max(0)) / 2, height - MARKS.table_depth)
        vertices, faces = _cut_off(top.vertices + center, top.faces, plane.edge)
        self.add_mesh(vertices, faces, TABLE, lit=False)
        for vertices, faces in shadows:
            level = np.full(len(vertices), height - MARKS.shadow_depth)
            flat, faces = _cut_off(np.column_stack([vertices[:, :2], level]), faces, plane.edge)
            up = np.tile([0.0, 0.0, 1.0], (len(flat), 1))
            self.add_mesh(flat, faces, SHADOW, up, lit=False)

    def render(self, camera: Camera, size: tuple[int, int] = SIZE) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture that a camera sees, as red, green and blue of h x w pixels.

        `size` is (w, h) [pixels].
        """
        return render(
            concatenate(self.solid), concatenate(self.transparent), camera, size, rgb(PAPER)
        )

    def render_png(
        self, corners: Points, direction: Direction, bar: tuple[str, float, str] | None = None
    ) -> bytes:
        """Return a PNG that shows all `corners` (n, 3) [m].

        `direction` points to the camera. `bar` holds title, largest value and colour map of a
        colour bar below the picture; None means no bar.
        """
        camera = frame_camera(corners, direction, FRAMING.bar_drop if bar else 0.0)
        image = Image.fromarray(self.render(camera))
        if bar:
            draw_bar(image, *bar)
        return encode_png(image)


def frame_camera(
    corners: Points, direction: Direction, drop: float = 0.0, size: tuple[int, int] = SIZE
) -> Camera:
    """Return a camera in `direction` that sees all `corners` (n, 3) [m], with z up.

    Its slope is limited by `FRAMING`. The lowest fraction `drop` of its picture stays empty; `size`
    is the width and height of the picture [pixels].
    """
    tangent = np.tan(np.deg2rad(FRAMING.angle) / 2)
    x, y, z = direction
    flat = float(np.hypot(x, y))
    if flat < FRAMING.level:
        x, y = FRAMING.fallback
        flat = float(np.hypot(x, y))
    back = np.array([x, y, np.clip(z, FRAMING.lowest * flat, FRAMING.highest * flat)])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(back, right), back])
    local = corners @ frame.T
    middle = (local.min(0) + local.max(0)) / 2
    half = np.ptp(local, axis=0) / 2
    # The nearest corners look largest, so the distance is counted from them.
    high = half[1] / (1.0 - FRAMING.squeeze * drop)
    wide = half[0] * size[1] / size[0]
    distance = half[2] + FRAMING.margin * (max(high, wide) / tangent)
    center = middle @ frame - frame[1] * drop * distance * tangent
    return Camera(center + back * distance, frame, float(np.deg2rad(FRAMING.angle)))


def _cut_off(
    vertices: Points, faces: np.ndarray, edge: Plane | None
) -> tuple[Float[np.ndarray, "v 3"], np.ndarray]:
    """Return vertices (v, 3) [m] and faces (t, 3) of the part of a mesh that is behind an edge."""
    if edge is None:
        return vertices, faces
    inward = -np.array(edge.normal.tolist())
    on = -edge.offset * inward
    kept, left, *_ = trimesh.intersections.slice_faces_plane(vertices, faces, inward, on)
    return kept, left


def sharp_normals(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray
) -> Float[np.ndarray, "f 3 3"]:
    """Return a unit normal for each corner of each face; only edges with a strong bend look sharp.

    `faces` (f, 3) are indices of three vertices; `vertices` are in metres.
    """
    mesh = trimesh.Trimesh(vertices, faces)
    smooth = trimesh.graph.smooth_shade(mesh, np.deg2rad(SMOOTH_BEND), facet_minarea=None)
    # the surface was split at its sharp edges, which changed the order of the faces
    order = np.concatenate(smooth.metadata["original_components"])
    normals = np.empty((len(faces), 3, 3))
    normals[order] = smooth.vertex_normals[smooth.faces]
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
    """Return the pixels of a picture of opaque and transparent triangles.

    They are shown as the `camera` sees them. Of the transparent triangles, only the nearest layer
    is drawn over the opaque ones (`solid`). `size` is the width and height (w, h) [pixels];
    `background` is red, green and blue in [0, 1].
    """
    samples = RASTER.samples
    width = size[0] * samples
    height = size[1] * samples
    image = np.tile(np.array(background, dtype=np.float32), (height * width, 1))
    near = np.zeros(height * width)
    sample, inverse_distance, color = _cast(solid, camera, width, height)
    image[sample] = color
    near[sample] = inverse_distance
    sample, inverse_distance, color = _cast(transparent, camera, width, height)
    front = inverse_distance > near[sample]
    image[sample[front]] += RASTER.opacity * (color[front] - image[sample[front]])
    pixels = image.reshape(size[1], samples, size[0], samples, 3).mean((1, 3))
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
    # A value that is linear in space is, divided by its distance, linear on the screen:
    # a x + b y + c.
    values = np.concatenate([near[..., None], _shade(triangles, camera) * near[..., None]], -1)
    screen = np.stack([x, y, np.ones_like(x)], -1)
    seen = np.abs(np.linalg.det(screen)) > RASTER.thinnest
    # weights of the corners, as functions of x, y and 1: (t, 3, 3)
    weights = np.linalg.inv(screen[seen])
    y = y[seen]
    planes = weights @ values[seen]

    # Sample centres lie at integers + 0.5; in each row a triangle covers those where no weight is
    # negative.
    owner, row = _ranges(*(_first_centre(end, height) for end in (y.min(1), y.max(1))))
    slope = weights[owner, 0]
    rest = weights[owner, 1] * (row + 0.5)[:, None] + weights[owner, 2]
    zero = -rest / np.where(slope == 0.0, 1.0, slope)
    begin = np.where(slope > 0.0, zero, -np.inf).max(1)
    end = np.where(slope < 0.0, zero, np.inf).min(1)
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


def rgb(color: str) -> Color:
    """Return the red, green and blue parts, each in [0, 1], of a colour written as "#rrggbb"."""
    red, green, blue = (x / FULL for x in bytes.fromhex(color[1:]))
    return red, green, blue


def map_colors(values: Float[np.ndarray, " n"], name: str) -> Points:
    """Return red, green and blue (n, 3), in [0, 1], of `values` in [0, 1].

    `name` is the name of a colour map of matplotlib.
    """
    return matplotlib.colormaps[name](values)[:, :3]


def color_std(std_m: Float[np.ndarray, " n"]) -> tuple[Points, float]:
    """Return the colours (n, 3) of standard deviations [m], and the value of the last colour [m].

    That value is the 99 % quantile; all greater ones have the same colour.
    """
    highest = float(np.quantile(std_m, STD_QUANTILE)) if len(std_m) else 0.0
    most = max(highest, LEAST_STD)
    return map_colors(std_m / most, "viridis"), most


def draw_bar(image: Any, title: str, most: float, colors: str) -> None:
    """Draw a titled colour bar from 0 to `most` at the bottom of a Pillow image.

    `colors` is the name of a colour map of matplotlib; `most` has the unit that the title names.
    """
    width, height = image.size
    left = width // BAR.side
    right = width - left
    top = height - BAR.top
    bottom = height - BAR.bottom
    ramp = map_colors(np.linspace(0.0, 1.0, right - left), colors)
    strip = (FULL * np.broadcast_to(ramp, (bottom - top, *ramp.shape)) + 0.5).astype(np.uint8)
    image.paste(Image.fromarray(strip), (left, top))
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(BAR.font)
    gaps = BAR.labels - 1
    for i in range(BAR.labels):
        place = (left + i * (right - left) / gaps, top - BAR.label_rise)
        draw.text(place, f"{most * i / gaps:.1f}", INK, font, anchor="ms")
    draw.text(((left + right) / 2, top - BAR.title_rise), title, INK, font, anchor="ms")


def encode_png(image: Any) -> bytes:
    """Return the bytes of a PNG of a Pillow image."""
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=PNG_LEVEL)
    return buffer.getvalue()


def encode_figure(figure: Any) -> bytes:
    """Return the bytes of a PNG of a matplotlib figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
