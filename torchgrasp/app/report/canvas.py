"""Common colours of all pictures, and a canvas for the shapes of a picture."""

import dataclasses
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from torchgrasp.app.report.raster import (
    FULL,
    Camera,
    Color,
    Direction,
    Triangles,
    concatenate,
    render,
)
from torchgrasp.export.other_formats import largest_std
from torchgrasp.foundation.lazy import Image, ImageDraw, ImageFont, matplotlib, trimesh
from torchgrasp.geometry.frames import to_array
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.shape.surface import Surface

Points = Float[np.ndarray, "n 3"]  # points [m], or colours in [0, 1]
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
"""Colours of the background, of lines with text, and of grid lines. The last is for the moment at
which an object was lost.
"""
SIZE = (720, 576)  # width and height of a still [pixels]: twice its size on a page of three columns


@dataclasses.dataclass(frozen=True)
class MarkShapes:
    """Sizes of points, arrows and the table in a picture, chosen by eye."""

    # radius of a point, as a share of the diagonal of the box around all points
    point_radius: float = 0.006
    # parts of an arrow, in lengths of the arrow; the shaft ends inside the head
    head_radius: float = 0.1  # radius of the head, a cone
    head_length: float = 0.35  # length of the head
    head_start: float = 0.65  # distance of the head's base from the arrow's start
    shaft_radius: float = 0.035  # radius of the shaft, a cylinder
    shaft_length: float = 0.75  # length of the shaft
    ball_radius: float = 0.13  # radius of the ball at the arrow's start
    arrow_sections: int = 8  # number of sides of head and shaft
    # radius of the table top, as a share of the diagonal of all corners seen from above
    table_radius: float = 0.55
    # length [m] added to this radius, so that a small object has a table, too
    table_rim: float = 0.02
    table_sections: int = 120  # number of corners of the round table top
    table_thickness: float = 1e-4  # thickness of the table top [m]
    # Depths [m] below the true height of the table: the object hides shadows, and shadows hide the
    # table.
    table_depth: float = 1e-3  # depth of the table
    shadow_depth: float = 5e-4  # depth of the shadows


@dataclasses.dataclass(frozen=True)
class Framing:
    """Numbers that place a camera so that it shows a set of points."""

    angle: float = 24.0  # vertical field of view [degrees]: a long lens distorts little
    # straight down, or up from below the table, a camera shows little
    lowest: float = 0.27  # least rise of the direction for each metre along the ground
    highest: float = 0.84  # greatest rise of the direction for each metre along the ground
    # distance of the camera, divided by the least one at which all points are in view
    margin: float = 1.12
    # length of the horizontal part of a direction below which it counts as vertical
    level: float = 1e-9
    # x and y that replace those of a vertical direction
    fallback: tuple[float, float] = (1.0, -0.8)
    bar_drop: float = 0.09  # share of the picture that stays empty below for a colour bar
    # height that the points lose to the empty share of the picture, over this share. They lose the
    # share below, and half of it above.
    squeeze: float = 1.5


@dataclasses.dataclass(frozen=True)
class BarLayout:
    """Layout of a colour bar at the bottom of a picture [pixels]."""

    side: int = 5  # width of the picture, divided by the free width on each side of the bar
    top: int = 24  # upper end of the strip, from the bottom of the picture
    bottom: int = 10  # lower end of the strip, from the bottom of the picture
    font: int = 20  # size of numbers and title
    labels: int = 4  # count of the numbers above the strip
    label_rise: int = 4  # height of these numbers above the strip
    title_rise: int = 29  # height of the title above the strip


MARKS = MarkShapes()
FRAMING = Framing()
BAR = BarLayout()
SMOOTH_BEND = 40.0  # faces that bend by less [degrees] look like one smooth surface
PNG_LEVEL = 4  # of compression: higher is slower and hardly smaller


class Canvas:
    """A collection of shapes in one frame [m] that is rendered to a picture; its z axis is drawn
    upwards.
    """

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

        `vertices` [m] have the vertex `normals`, of any length and either sign. If these are None,
        edges where faces bend by more than 40 degrees (`SMOOTH_BEND`) look sharp. `faces` (t, 3)
        are indices of three vertices. With `lit` False the mesh gets no shading. A `transparent`
        mesh shows the opaque ones behind it.
        """
        corners = vertices[faces]
        bent = sharp_normals(vertices, faces) if normals is None else normals[faces]
        shade = (
            np.broadcast_to(rgb(color), corners.shape) if isinstance(color, str) else color[faces]
        )
        triangles = Triangles(corners, bent, shade, np.full(len(corners), lit))
        (self.transparent if transparent else self.solid).append(triangles)

    def add_points(self, points: Points, colors: Points) -> None:
        """Add points (n, 3) [m] as small balls, whose size is a share of the points' extent.

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

        `points` (n, 3) [m] are the starts of the arrows, and `directions` (n, 3) unit vectors along
        them. `colors` are n texts "#rrggbb".
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
        """Add an unshaded round table top below the shapes; a `table` of None adds nothing.

        `corners` (n, 3) [m] are points that the picture must show. The table top reaches a little
        beyond their extent in x and y, and has the same centre. The `table` is level: its height z
        [m], or a plane. If the plane ends at an edge, the table top ends there. The `shadows` are
        meshes, by vertices (v, 3) [m] and faces (t, 3). Their outlines darken the table straight
        below them.
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
        """Return the bytes of a PNG of the shapes, with all points `corners` (n, 3) [m] in view.

        `direction` (x, y, z), of any length, points to the camera. `bar` holds title, largest value
        and matplotlib's name of the colours of a colour bar below the picture. None means no bar.
        """
        camera = frame_camera(corners, direction, FRAMING.bar_drop if bar else 0.0)
        image = Image.fromarray(self.render(camera))
        if bar:
            draw_bar(image, *bar)
        return encode_png(image)


def frame_camera(
    corners: Points, direction: Direction, drop: float = 0.0, size: tuple[int, int] = SIZE
) -> Camera:
    """Return a camera that sees all points `corners` (n, 3) [m] from a direction, with z up.

    `direction` (x, y, z), of any length, points from the points to the camera. If it does not rise
    by 0.27 to 0.84 m (`FRAMING`) for each metre along the ground, it is changed. The lowest
    fraction `drop` of the picture stays empty. `size` is the width and height of the picture
    [pixels].
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
    """Return a unit normal for each of the three corners of each of f faces, for shading.

    Edges where faces bend by more than 40 degrees (`SMOOTH_BEND`) look sharp, others smooth.
    `faces` (f, 3) are indices of three vertices; `vertices` are in metres.
    """
    mesh = trimesh.Trimesh(vertices, faces)
    smooth = trimesh.graph.smooth_shade(mesh, np.deg2rad(SMOOTH_BEND), facet_minarea=None)
    # the surface was split at its sharp edges, which changed the order of the faces
    order = np.concatenate(smooth.metadata["original_components"])
    normals = np.empty((len(faces), 3, 3))
    normals[order] = smooth.vertex_normals[smooth.faces]
    return normals


def rgb(color: str) -> Color:
    """Return the red, green and blue parts, each in [0, 1], of a colour written as "#rrggbb"."""
    red, green, blue = (x / FULL for x in bytes.fromhex(color[1:]))
    return red, green, blue


def map_colors(values: Float[np.ndarray, " n"], name: str) -> Points:
    """Return the colours (n, 3) that a colour map gives to `values` (n,) in [0, 1].

    They are red, green and blue in [0, 1]. `name` is the name of a colour map of matplotlib.
    """
    return matplotlib.colormaps[name](values)[:, :3]


def color_std(surface: Surface) -> tuple[Points, float]:
    """Return the colours (v, 3) of a surface's standard deviations, and the value of the last
    colour [m].

    The colours are red, green and blue in [0, 1], one for each vertex. The value of the last one is
    `largest_std(surface)`; all greater ones have the same colour.
    """
    most = largest_std(surface)
    return map_colors(to_array(surface.std_m) / most, "viridis"), most


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
    """Return a Pillow image as the bytes of a PNG file."""
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=PNG_LEVEL)
    return buffer.getvalue()


def encode_figure(figure: Any) -> bytes:
    """Return a matplotlib figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
