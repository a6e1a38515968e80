"""Common colours of all pictures, and the canvas that collects shapes and renders them to a picture."""

import io

import numpy as np
from jaxtyping import Float, UInt8

from torchgrasp.app.report.raster import Camera, Triangles, concatenate, render

Direction = tuple[float, float, float]

FINGERS = ("#2f6db5", "#23967f", "#e0762f", "#8a4f9e", "#c23b55")
"""Colours of the fingers, in grasp order."""
AXES = ("#d62728", "#2ca02c", "#1f4fd8")
"""Colours of x, y and z of a frame."""
HAND, OBJECT, TABLE = "#a9b0ba", "#e9d7b3", "#eceae4"
"""Colours of the palm with parked fingers, of the object, and of the table."""
OBJECTS = ("#e8743b", "#3f83d9", "#57a84f", "#b65fae", "#e0b92f", "#35aaa3", "#dd6b78", "#8474c9")
"""Colours of the objects of a scene in the order of their labels, again from the first."""
PAPER, INK, GRID, ALARM = "#fcfcfa", "#22262b", "#dcdad3", "#c2452d"
"""Colours of the background, of lines with text, of grid lines, and of the moment at which an object was lost."""
SIZE = (720, 576)  # width and height of a still [pixels]: twice its size on a page of three columns


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
    ) -> None:
        """Add a mesh with one colour, or a colour for each vertex; without `normals` large bends give sharp edges."""
        corners = vertices[faces]
        bent = _sharp_normals(vertices, faces) if normals is None else normals[faces]
        shade = np.broadcast_to(rgb(color), corners.shape) if isinstance(color, str) else color[faces]
        triangles = Triangles(corners, bent, shade, np.ones(len(corners), dtype=bool))
        (self.transparent if transparent else self.solid).append(triangles)

    def add_points(self, points: Float[np.ndarray, "n 3"], colors: Float[np.ndarray, "n 3"]) -> None:
        """Add points as small balls, each in its colour."""
        from trimesh import creation

        size = 0.006 * float(np.linalg.norm(np.ptp(points, axis=0)))
        ball = creation.icosphere(subdivisions=0, radius=1.0)  # too small on the page for its faces to show
        corners = (points[:, None, None] + size * ball.vertices[ball.faces]).reshape(-1, 3, 3)
        normals = np.tile(ball.vertices[ball.faces], (len(points), 1, 1))
        shades = np.broadcast_to(np.repeat(colors, len(ball.faces), 0)[:, None], corners.shape)
        self.solid.append(Triangles(corners, normals, shades, np.ones(len(corners), dtype=bool)))

    def add_arrows(
        self,
        points: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        length: float,
        colors: tuple[str, ...],
    ) -> None:
        """Add arrows of one length [m] in unit directions, each with its colour and a small ball at its start."""
        from trimesh import creation

        head = creation.cone(radius=0.1, height=0.35, sections=8)
        head.apply_translation([0.0, 0.0, 0.65])
        upright = (
            creation.icosphere(subdivisions=1, radius=0.13),
            creation.cylinder(radius=0.035, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], sections=8),
            head,
        )
        for start, direction, color in zip(points, directions, colors, strict=True):
            side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
            side /= np.linalg.norm(side)
            axes = np.stack([side, np.cross(direction, side), direction])
            for part in upright:
                self.add_mesh(length * np.asarray(part.vertices) @ axes + start, np.asarray(part.faces), color)

    def add_table(self, corners: Float[np.ndarray, "n 3"], height: float | None) -> None:
        """Add a round table top, without shading, under `corners` at a height [m]; None: no table."""
        if height is None:
            return
        center = np.append((corners[:, :2].min(0) + corners[:, :2].max(0)) / 2, height - 1e-3)
        radius = 0.55 * float(np.linalg.norm(np.ptp(corners[:, :2], axis=0))) + 0.02
        angle = np.linspace(0.0, 2 * np.pi, 121)
        rim = center + radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
        corners = np.stack([np.broadcast_to(center, (120, 3)), rim[:-1], rim[1:]], 1)
        normals, shade = (np.broadcast_to(row, corners.shape) for row in ((0.0, 0.0, 1.0), rgb(TABLE)))
        self.solid.append(Triangles(corners, normals, shade, np.zeros(len(corners), dtype=bool)))

    def render(self, camera: Camera, size: tuple[int, int] = SIZE) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture that a camera sees, as pixels."""
        return render(concatenate(self.solid), concatenate(self.transparent), camera, size, rgb(PAPER))

    def render_png(
        self, corners: Float[np.ndarray, "n 3"], direction: Direction, bar: tuple[str, float, str] | None = None
    ) -> bytes:
        """Return a PNG that shows all `corners` [m], seen from a direction between 15 and 40 degrees above the table.

        `bar` gives the title, the largest value and the colour map of a colour bar at the bottom.
        """
        from PIL import Image

        image = Image.fromarray(self.render(frame_camera(corners, direction, 0.09 if bar else 0.0)))
        if bar:
            draw_bar(image, *bar)
        return encode_png(image)


def frame_camera(
    corners: Float[np.ndarray, "n 3"], direction: Direction, drop: float = 0.0, size: tuple[int, int] = SIZE
) -> Camera:
    """Return a camera that sees all `corners`; the fraction `drop` of the picture at the bottom stays empty."""
    angle = np.deg2rad(24.0)  # a long lens distorts little
    x, y, z = direction
    flat = float(np.hypot(x, y))
    if flat < 1e-9:
        x, y, flat = 1.0, -0.8, float(np.hypot(1.0, -0.8))
    # A camera that looks straight down, or up from below the table, shows little.
    back = np.array([x, y, np.clip(z, 0.27 * flat, 0.84 * flat)])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(back, right), back])
    local = corners @ frame.T
    middle, half = (local.min(0) + local.max(0)) / 2, np.ptp(local, axis=0) / 2
    # The nearest corners look largest, so the distance is counted from them.
    reach = max(half[1] / (1.0 - 1.5 * drop), half[0] * size[1] / size[0]) / np.tan(angle / 2)
    distance = half[2] + 1.12 * reach
    center = middle @ frame - frame[1] * drop * distance * np.tan(angle / 2)
    return Camera(center + back * distance, frame, float(angle))


def _sharp_normals(vertices: Float[np.ndarray, "v 3"], faces: np.ndarray) -> Float[np.ndarray, "f 3 3"]:
    """Return a normal for each corner of each face: the mean of adjacent faces that bend by less than 40 degrees."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    weighted = np.cross(b - a, c - a)  # its length is twice the area of the face
    flat = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-300)
    # Pair each corner with all corners at the same place, by the order of the places.
    _, place = np.unique(np.round(vertices / 1e-7).astype(np.int64), axis=0, return_inverse=True)
    at = place.reshape(-1)[faces].reshape(-1)
    order = np.argsort(at, kind="stable")
    counts = np.bincount(at)
    start = np.cumsum(counts) - counts
    corner = np.repeat(np.arange(len(at)), counts[at])
    offset = np.arange(len(corner)) - np.repeat(np.cumsum(counts[at]) - counts[at], counts[at])
    other = order[start[at[corner]] + offset]
    near = (flat[corner // 3] * flat[other // 3]).sum(1) > np.cos(np.deg2rad(40.0))
    sums = np.zeros((len(at), 3))
    np.add.at(sums, corner[near], weighted[other[near] // 3])
    return (sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)).reshape(-1, 3, 3)


def rgb(color: str) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1] of a colour "#rrggbb"."""
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


def map_colors(values: Float[np.ndarray, " n"], name: str) -> Float[np.ndarray, "n 3"]:
    """Return the colours of values in [0, 1], by a matplotlib colour map."""
    import matplotlib

    return matplotlib.colormaps[name](values)[:, :3]


def draw_bar(image: object, title: str, most: float, colors: str) -> None:
    """Draw a titled colour bar from 0 to `most` at the bottom of a picture."""
    from PIL import Image, ImageDraw, ImageFont

    assert isinstance(image, Image.Image)
    width, height = image.size
    left, right, top, bottom = width // 5, width - width // 5, height - 24, height - 10
    ramp = map_colors(np.linspace(0.0, 1.0, right - left), colors)
    strip = (255 * np.broadcast_to(ramp, (bottom - top, *ramp.shape)) + 0.5).astype(np.uint8)
    image.paste(Image.fromarray(strip), (left, top))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(20)
    for i in range(4):
        draw.text((left + i * (right - left) / 3, top - 4), f"{most * i / 3:.1f}", INK, font, anchor="ms")
    draw.text(((left + right) / 2, top - 29), title, INK, font, anchor="ms")


def encode_png(image: object) -> bytes:
    """Return a Pillow image as the bytes of a PNG."""
    from PIL import Image

    assert isinstance(image, Image.Image)
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()
