"""The picture of a scene: which pixels the library considers support, objects and obstacles."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from torchgrasp.app.report.canvas import GRID, INK, OBJECTS, PAPER, encode_png, rgb
from torchgrasp.app.report.raster import FULL
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.lazy import Image, ImageDraw, ImageFont, ndimage
from torchgrasp.geometry.linalg import norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.plane_fit import assume_noise
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.scene import Scene

KINDS = {
    "not measured": "#0b0c0e",
    "not on the support": "#c9cbce",
    "support, in squares of 10 cm": "#cde8dc",
    "another possible support": "#e6d8f0",
    "obstacle": "#82878f",
}
"""Colours of the pixels that are on no object, by their words in the legend."""
UNMEASURED, ELSEWHERE, SUPPORT, OTHER_SUPPORT, OBSTACLE = range(len(KINDS))
"""Indices of the kinds."""


@dataclasses.dataclass(frozen=True)
class SceneInk:
    """Parameters of the shading of a scene's pixels, chosen by eye; factors darken a colour."""

    size: int = 1200  # longer side of the picture [pixels]
    hatches: int = 160  # number of stripes over the width, on obstacles
    hatch: float = 0.8  # factor on the colour of every other stripe
    flat: float = 0.6  # least brightness of what is on no object: relief matters most on objects
    cell: float = 0.1  # side of the squares drawn on the support [m]
    line: float = 0.25  # share of the colour that lines between squares lose
    line_width: float = 1.2  # width of these lines [pixels]
    # greatest width of a pixel, as a share of a square, with lines: lines of smaller squares would
    # run together
    widest_pixel: float = 0.3
    # side [pixels] of the square within which a label spreads over missing pixels, so that they
    # have no rim
    gap: int = 5
    rim: int = 3  # width of the dark rim of an object [pixels]
    rim_factor: float = 0.5  # factor on the colour of this rim
    # side [pixels] of the square that widens the target to its white rim, which lies outside of it:
    # else it would hide a thin target
    target_rim: int = 7
    # greatest distance of the pixels of a support from it, in standard deviations of the noise
    noise: float = 3.0
    blur: float = 1.5  # standard deviation [pixels] that smooths the depth before its slopes
    nearest: float = 1e-3  # least depth [m]
    least: float = 1e-6  # least weight, slope and range, so that nothing is divided by 0
    # vector (right, down, ahead) of the camera: with the unit vector that points up added, it
    # points to the lamp
    lamp: tuple[float, float, float] = (-0.5, 0.0, -0.8)
    ambient: float = 0.45  # brightness without the lamp
    lit: float = 0.65  # brightness that the lamp adds at most
    haze: float = 0.15  # share of the brightness that the farthest pixels lose
    outliers: tuple[float, float] = (0.01, 0.99)  # quantiles of depth between which haze grows


@dataclasses.dataclass(frozen=True)
class SceneText:
    """Layout of the numbers on objects and of the legend below a scene's picture.

    Sizes and positions are in pixels, except where a field says otherwise.
    """

    font: int = 24  # size of the legend's text, and least size of a number on an object
    number: float = 1.1  # size of a number, in radii of the largest circle in its object
    largest_number: int = 54  # largest size of a number
    stroke: int = 3  # width of the dark rim of a number
    row: int = 40  # height of a line of the legend
    swatch: int = 28  # width of the colour beside a text
    swatch_top: int = 8  # upper end of the colour, in its row
    swatch_bottom: int = 32  # lower end of the colour, in its row
    round: int = 5  # radius of its corners
    text: int = 40  # left end of the text, from the left end of the colour
    left: int = 16  # left end of the first column
    gutter: int = 70  # width that a column needs beside its widest text
    margin: int = 12  # margin above and below all lines of the legend
    most_objects: int = 12  # greatest number of objects that the legend names
    # least share of the pixels that a kind, such as obstacles, has in order to be in the legend
    least_share: float = 0.002
    # quantile of the heights of an object's points that counts as its top: few are outliers
    top: float = 0.98


INKS = SceneInk()
TEXT = SceneText()


@checked
def draw_scene(scene: Scene, path: Path | str) -> Path:
    """Write a picture of a scene, as its camera saw it, as a PNG file; return the path.

    It shows the support plane, the numbered objects, obstacles, unmeasured pixels and a legend.

    Args:
        scene: the scene, a depth image in which table and objects were found.
        path: the file to write.

    Raises `OutputError` if the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import load_scene
    >>> draw_scene(load_scene(), Path(tempfile.mkdtemp(), "scene.png")).read_bytes()[1:4]
    b'PNG'
    """
    return write_file(path, encode_scene(scene))


def encode_scene(scene: Scene) -> bytes:
    """Return a picture of a scene, as its camera saw it, as the bytes of a PNG file.

    It shows the support plane, the numbered objects, obstacles, unmeasured pixels and a legend.
    """
    kinds, labels = sort_pixels(scene)
    h, w = labels.shape
    palette = np.stack([rgb(color) for color in (*KINDS.values(), *OBJECTS)])
    color = palette[np.where(labels > 0, len(KINDS) + (labels - 1) % len(OBJECTS), kinds)]
    row, column = np.mgrid[:h, :w]
    bare = labels == 0
    # obstacles are hatched
    striped = (row + column) // max(2, w // INKS.hatches) % 2 == 0
    color[bare & (kinds == OBSTACLE) & striped] *= INKS.hatch
    light = _light(scene)
    color *= np.where(labels > 0, light, INKS.flat + (1 - INKS.flat) * light)[..., None]
    if scene.table is not None:
        squares = np.where(bare & (kinds == SUPPORT), _squares(scene.image, scene.table), 0.0)
        color *= 1 - INKS.line * squares[..., None]
    # single missing pixels have no rim
    whole = np.where(kinds != UNMEASURED, labels, ndimage.maximum_filter(labels, INKS.gap))
    color[_rim(whole, INKS.rim) & (labels > 0)] *= INKS.rim_factor
    color[bare & (kinds == UNMEASURED)] = rgb(KINDS["not measured"])
    if scene.target is not None:
        color[_rim(whole == scene.target, INKS.target_rim) & (labels != scene.target)] = 1.0
    scale = INKS.size / max(h, w)
    picture = Image.fromarray(np.uint8(FULL * color.clip(0, 1)))
    picture = picture.resize((round(w * scale), round(h * scale)), Image.Resampling.BICUBIC)
    _number(picture, labels, scale)
    return encode_png(_with_legend(picture, scene, kinds))


def sort_pixels(scene: Scene) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """Return two images (h, w) of a scene's depth image: the kind of each pixel, and its object's
    label.

    The kinds are 0 not measured, 1 not on the support, 2 support, 3 another possible support, and 4
    obstacle. The support is the plane on which the objects stand. The label is 0 on no object; the
    kinds count only there.
    """
    image = scene.image
    labels = scene.pixel_labels.cpu().numpy()
    points = image.points()
    measured = image.depth.numpy() > 0
    kinds = measured.astype(int)
    noise = assume_noise(points.reshape(-1, 3), scene.viewpoint).reshape(labels.shape).numpy()
    near = INKS.noise * noise
    if scene.table is not None:
        height = scene.table.height(points).numpy()
        kinds[measured & (height > near) & (labels == 0)] = OBSTACLE
        # the table stands last: where planes meet, its colour wins
        others = [(other, OTHER_SUPPORT) for other in scene.others[::-1]]
        for plane, kind in (*others, (scene.table, SUPPORT)):
            kinds[measured & (np.abs(plane.height(points).numpy()) < near)] = kind
    return kinds, labels


def _squares(image: DepthImage, table: Plane) -> Float[np.ndarray, "h w"]:
    """Return for each pixel how well it lies on the lines of a 10 cm grid in the table plane.
    Results are in [0, 1].
    """
    # where the rays of all pixels meet the table: (h, w, 3)
    camera = image.obj_from_camera[:3, 3].double()
    normal = table.normal.double()
    rays = image.rays()
    reach = -table.height(camera) / (rays @ normal).clamp(max=-INKS.least)
    place = camera + reach[..., None] * rays
    across = image.obj_from_camera[:3, 0].double()
    x = unit(across - (across @ normal) * normal)
    lines = np.zeros(tuple(image.depth.shape))
    for axis in (x, torch.linalg.cross(normal, x)):
        cells = ((place @ axis) / INKS.cell).numpy()
        pixel = np.hypot(*np.gradient(cells)).clip(INKS.least)  # its size in cells
        gap = np.abs(cells - np.round(cells)) / pixel
        line = (INKS.line_width - gap).clip(0, 1)
        lines = np.maximum(lines, np.where(pixel < INKS.widest_pixel, line, 0.0))
    return lines


def _light(scene: Scene) -> Float[np.ndarray, "h w"]:
    """Return the brightness of each pixel: higher for faces towards the sky and the camera, lower
    far away.
    """
    depth = scene.image.depth.double().numpy()
    seen = scene.image.depth.numpy() > 0
    # unmeasured pixels have no weight in the mean
    smooth = ndimage.gaussian_filter(depth, INKS.blur)
    weight = ndimage.gaussian_filter(seen.astype(float), INKS.blur)
    smooth = np.where(weight > 0, smooth / weight.clip(INKS.least), 1.0).clip(INKS.nearest)
    focal = float(scene.image.intrinsics[0, 0])
    down, right = (slope * focal / smooth for slope in np.gradient(smooth))
    sky = np.array([0.0, -1.0, 0.0])
    if scene.table is not None:
        camera_from_obj = scene.image.obj_from_camera[:3, :3].double().T
        sky = (camera_from_obj @ scene.table.normal.double()).numpy()
    lamp = sky + np.array(INKS.lamp)
    lamp /= np.linalg.norm(lamp)
    facing = (lamp[0] * right + lamp[1] * down - lamp[2]) / np.sqrt(1 + right**2 + down**2)
    near, far = np.quantile(depth[seen], INKS.outliers)
    distant = ((depth - near) / max(far - near, INKS.least)).clip(0, 1)
    return (INKS.ambient + INKS.lit * facing.clip(0.0, 1.0)) * (1 - INKS.haze * distant)


def _rim(labels: np.ndarray, width: int) -> Bool[np.ndarray, "h w"]:
    """Return a mask of the pixels with another label in the square of side `width` around them."""
    whole = labels.astype(int)
    return ndimage.maximum_filter(whole, width) != ndimage.minimum_filter(whole, width)


def _number(picture: Any, labels: Int[np.ndarray, "h w"], scale: float) -> None:
    """Write the label of each object into the picture, at the object's widest place."""
    pen = ImageDraw.Draw(picture)
    for label in np.unique(labels[labels > 0]).tolist():
        row, column = np.nonzero(labels == label)
        top = int(row.min())
        left = int(column.min())
        body = np.pad(labels[top : row.max() + 1, left : column.max() + 1] == label, 1)
        inside = np.asarray(ndimage.distance_transform_edt(body))
        row, column = divmod(int(inside.argmax()), inside.shape[1])
        place = (scale * (left + column - 0.5), scale * (top + row - 0.5))
        size = np.clip(TEXT.number * scale * inside.max(), TEXT.font, TEXT.largest_number)
        font = ImageFont.load_default(float(size))
        rim = {"stroke_width": TEXT.stroke, "stroke_fill": INK}
        pen.text(place, str(label), "white", font, anchor="mm", **rim)


def _with_legend(picture: Any, scene: Scene, kinds: Int[np.ndarray, "h w"]) -> Any:
    """Return the picture with a legend below it: kinds of pixels, then height and distance of each
    object.
    """
    shares = [(kinds == k).mean() for k in range(len(KINDS))]
    entries = [
        entry
        for entry, share in zip(KINDS.items(), shares, strict=True)
        if share > TEXT.least_share
    ][::-1]
    for label in scene.things[: TEXT.most_objects]:
        entries.append((_describe(scene, label), OBJECTS[(label - 1) % len(OBJECTS)]))
    more = len(scene.things) - TEXT.most_objects
    if more > 0:
        entries.append((f"and {more} more objects", PAPER))
    font = ImageFont.load_default(TEXT.font)
    column_width = TEXT.gutter + max(int(font.getlength(words)) for words, _ in entries)
    # columns are filled from above, as many as fit beside each other
    rows = math.ceil(len(entries) / max(1, picture.width // column_width))
    height = picture.height + TEXT.row * rows + 2 * TEXT.margin
    sheet = Image.new("RGB", (picture.width, height), PAPER)
    sheet.paste(picture, (0, 0))
    pen = ImageDraw.Draw(sheet)
    for k, (words, color) in enumerate(entries):
        x = TEXT.left + k // rows * column_width
        y = picture.height + TEXT.margin + k % rows * TEXT.row
        swatch = (x, y + TEXT.swatch_top, x + TEXT.swatch, y + TEXT.swatch_bottom)
        pen.rounded_rectangle(swatch, TEXT.round, color, GRID)
        pen.text((x + TEXT.text, y + TEXT.row // 2), words, INK, font, anchor="lm")
    return sheet


def _describe(scene: Scene, label: int) -> str:
    """Return the legend text of an object: its label, height, and distance from the camera."""
    points = scene.points[scene.rows_of(label)].double()
    distance = float(norm(points - scene.viewpoint).median())
    high = ""
    if scene.table is not None:
        top = 1e3 * float(scene.table.height(points).quantile(TEXT.top))
        high = f"{top:.0f} mm high, "
    target = " (target)" if label == scene.target else ""
    return f"{label}{target}: {high}{distance:.2f} m away"
