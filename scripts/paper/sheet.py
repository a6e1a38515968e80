"""Pictures of equal size on one sheet, which the figures share."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from torchgrasp.app.report.canvas import INK, PAPER, Canvas, draw_bar, encode_png
from torchgrasp.app.report.raster import Direction
from torchgrasp.files import write_file

Tile = tuple[int, int]
"""Width and height of a picture [pixels]."""


def render_tile(canvas: Canvas, corners: np.ndarray, eye: Direction, tile: Tile) -> Image.Image:
    """Return the picture of a canvas in the size `tile`, (width, height) [pixels].

    It is scaled to the tile's height and cut at its sides. `corners` (n, 3) [m] must be in it, and
    `eye` is the direction to the viewer.
    """
    picture = Image.open(io.BytesIO(canvas.render_png(corners, eye)))
    width = round(picture.width * tile[1] / picture.height)
    left = (width - tile[0]) // 2
    return picture.resize((width, tile[1]), Image.Resampling.LANCZOS).crop(
        (left, 0, left + tile[0], tile[1])
    )


def save_sheet(
    path: Path,
    rows: Sequence[Sequence[Image.Image]],
    captions: dict[tuple[int, int], str],
    most_std_mm: float | None = None,
) -> None:
    """Write rows of pictures as one image, with captions by (row, column), and print the path.

    `most_std_mm` is the end [mm] of a colour bar of the standard deviation; None means no bar.
    """
    wide, high = rows[0][0].size if rows else (1, 1)
    top, bottom = (30, 80) if most_std_mm else (0, 0)
    sheet = Image.new(
        "RGB",
        (wide * max(map(len, rows), default=1), max(high * len(rows), 1) + top + bottom),
        PAPER,
    )
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            sheet.paste(picture, (column * wide, row * high + top))
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(20)
    for (row, column), text in captions.items():
        pen.text((column * wide + 12, row * high + 10), text, INK, font)
    if most_std_mm:
        draw_bar(sheet, "standard deviation of the surface [mm]", most_std_mm, "viridis")
    print(write_file(path, encode_png(sheet)))
