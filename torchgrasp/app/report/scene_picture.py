"""The picture of a scene: which pixels the library considers support, objects and obstacles."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from torchgrasp.app.report.canvas import GRID, INK, OBJECTS, PAPER, encode_png, rgb
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.lazy import Image, ImageDraw, ImageFont, ndimage
from torchgrasp.geometry.linalg import unit
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


@checked
def draw_scene(scene: Scene, path: Path | str) -> Path:
    """Write a picture of a scene as PNG: the support, numbered objects, obstacles, unmeasured
    pixels and a legend.

    Raises `OutputError` if the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import load_scene
    >>> draw_scene(load_scene(), Path(tempfile.mkdtemp(), "scene.png")).read_bytes()[1:4]
    b'PNG'
    """
    return write_file(path, encode_scene(scene))


def encode_scene(scene: Scene) -> bytes:
    """Return the picture of a scene as PNG, as `draw_scene` writes it."""
    kinds, labels = sort_pixels(scene)
    h, w = labels.shape
    palette = np.stack([rgb(color) for color in (*KINDS.values(), *OBJECTS)])
    color = palette[np.where(labels > 0, len(KINDS) + (labels - 1) % len(OBJECTS), kinds)]
    row, column = np.mgrid[:h, :w]
    color[(labels == 0) & (kinds == 4) & ((row + column) // max(2, w // 160) % 2 == 0)] *= (
        0.8  # hatched
    )
    light = _light(scene)
    color *= np.where(labels > 0, light, 0.6 + 0.4 * light)[
        ..., None
    ]  # relief matters most on objects
    if scene.table is not None:
        color *= (
            1
            - 0.25
            * np.where((labels == 0) & (kinds == 2), _squares(scene.image, scene.table), 0.0)[
                ..., None
            ]
        )
    whole = np.where(
        kinds > 0, labels, ndimage.maximum_filter(labels, 5)
    )  # single missing pixels have no rim
    color[_rim(whole, 3) & (labels > 0)] *= 0.5
    color[(labels == 0) & (kinds == 0)] = rgb(KINDS["not measured"])
    if scene.target is not None:
        color[_rim(whole == scene.target, 5)] = 1.0
    scale = 1200 / max(h, w)
    picture = Image.fromarray(np.uint8(255 * color.clip(0, 1)))
    picture = picture.resize((round(w * scale), round(h * scale)), Image.Resampling.BICUBIC)
    _number(picture, labels, scale)
    return encode_png(_with_legend(picture, scene, kinds))


def sort_pixels(scene: Scene) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """Return each pixel's index in `KINDS` and its object's label. The index counts only where the
    label is 0.
    """
    image = scene.image
    labels = scene.pixel_labels.cpu().numpy()
    points = image.points()
    measured = image.depth.numpy() > 0
    kinds = measured.astype(int)
    near = 3 * assume_noise(points.reshape(-1, 3), scene.viewpoint).reshape(labels.shape).numpy()
    if scene.table is not None:
        height = scene.table.height(points).numpy()
        kinds[measured & (height > near) & (labels == 0)] = 4
        for plane, kind in (*((other, 3) for other in scene.others[::-1]), (scene.table, 2)):
            kinds[measured & (np.abs(plane.height(points).numpy()) < near)] = kind
    return kinds, labels


def _squares(image: DepthImage, table: Plane) -> Float[np.ndarray, "h w"]:
    """Return for each pixel, in [0, 1], how well it lies on the lines of a 10 cm grid in the table
    plane.
    """
    flat = DepthImage(
        torch.ones_like(image.depth), image.intrinsics, image.obj_from_camera
    ).points()
    camera = image.obj_from_camera[:3, 3].double()
    normal = table.normal.double()
    rays = flat - camera
    reach = -table.height(camera) / (rays @ normal).clamp(max=-1e-6)
    place = camera + reach[..., None] * rays
    across = image.obj_from_camera[:3, 0].double()
    x = unit(across - (across @ normal) * normal)
    lines = np.zeros(tuple(image.depth.shape))
    for axis in (x, torch.linalg.cross(normal, x)):
        cells = ((place @ axis) / 0.1).numpy()
        pixel = np.hypot(*np.gradient(cells)).clip(1e-6)  # its size in cells
        gap = np.abs(cells - np.round(cells)) / pixel
        lines = np.maximum(lines, np.where(pixel < 0.3, (1.2 - gap).clip(0, 1), 0.0))
    return lines


def _light(scene: Scene) -> Float[np.ndarray, "h w"]:
    """Return the brightness of each pixel: higher for faces towards the sky and the camera, lower
    far away.
    """
    depth = scene.image.depth.double().numpy()
    seen = scene.image.depth.numpy() > 0
    smooth = ndimage.gaussian_filter(depth, 1.5)
    weight = ndimage.gaussian_filter(seen.astype(float), 1.5)
    smooth = np.where(weight > 0, smooth / weight.clip(1e-6), 1.0).clip(1e-3)
    down, right = (
        slope * float(scene.image.intrinsics[0, 0]) / smooth for slope in np.gradient(smooth)
    )
    sky = np.array([0.0, -1.0, 0.0])
    if scene.table is not None:
        sky = (scene.image.obj_from_camera[:3, :3].double().T @ scene.table.normal.double()).numpy()
    lamp = sky + np.array([-0.5, 0.0, -0.8])
    lamp /= np.linalg.norm(lamp)
    facing = (lamp[0] * right + lamp[1] * down - lamp[2]) / np.sqrt(1 + right**2 + down**2)
    near, far = np.quantile(depth[seen], [0.01, 0.99])
    distant = ((depth - near) / max(far - near, 1e-6)).clip(0, 1)
    return (0.45 + 0.65 * facing.clip(0.0, 1.0)) * (1 - 0.15 * distant)


def _rim(labels: np.ndarray, width: int) -> Bool[np.ndarray, "h w"]:
    """Return a mask of the pixels with another label in the square of `width` pixels around them."""
    whole = labels.astype(int)
    return ndimage.maximum_filter(whole, width) != ndimage.minimum_filter(whole, width)


def _number(picture: object, labels: Int[np.ndarray, "h w"], scale: float) -> None:
    """Write the label of each object into the picture, at the object's widest place."""
    assert isinstance(picture, Image.Image)
    pen = ImageDraw.Draw(picture)
    for label in np.unique(labels[labels > 0]).tolist():
        row, column = np.nonzero(labels == label)
        top = int(row.min())
        left = int(column.min())
        body = np.pad(labels[top : row.max() + 1, left : column.max() + 1] == label, 1)
        inside = np.asarray(ndimage.distance_transform_edt(body))
        row, column = divmod(int(inside.argmax()), inside.shape[1])
        place = (scale * (left + column - 0.5), scale * (top + row - 0.5))
        font = ImageFont.load_default(float(np.clip(1.1 * scale * inside.max(), 24, 54)))
        pen.text(place, str(label), "white", font, anchor="mm", stroke_width=3, stroke_fill=INK)


def _with_legend(picture: object, scene: Scene, kinds: Int[np.ndarray, "h w"]) -> object:
    """Return the picture with a legend below it: kinds of pixels, then height and distance of each
    object.
    """
    assert isinstance(picture, Image.Image)
    shown = [
        (name, color)
        for k, (name, color) in enumerate(KINDS.items())
        if (kinds == k).mean() > 0.002
    ]
    entries = [
        *shown[::-1],
        *((_describe(scene, k), OBJECTS[(k - 1) % len(OBJECTS)]) for k in scene.things[:12]),
    ]
    if len(scene.things) > 12:
        entries.append((f"and {len(scene.things) - 12} more objects", PAPER))
    font = ImageFont.load_default(24)
    row_height = 40
    column_width = 70 + max(int(font.getlength(words)) for words, _ in entries)
    rows = -(-len(entries) // max(1, picture.width // column_width))
    sheet = Image.new("RGB", (picture.width, picture.height + row_height * rows + 24), PAPER)
    sheet.paste(picture, (0, 0))
    pen = ImageDraw.Draw(sheet)
    for k, (words, color) in enumerate(entries):
        x = 16 + k // rows * column_width
        y = picture.height + 12 + k % rows * row_height
        pen.rounded_rectangle((x, y + 8, x + 28, y + 32), 5, color, GRID)
        pen.text((x + 40, y + 20), words, INK, font, anchor="lm")
    return sheet


def _describe(scene: Scene, label: int) -> str:
    """Return the legend text of an object: its label, its height, and its distance from the camera."""
    points = scene.points[scene.rows_of(label)].double()
    distance = float((points - scene.viewpoint).norm(dim=-1).median())
    high = (
        ""
        if scene.table is None
        else f"{1e3 * float(scene.table.height(points).quantile(0.98)):.0f} mm high, "
    )
    return f"{label}{' (target)' * (label == scene.target)}: {high}{distance:.2f} m away"
