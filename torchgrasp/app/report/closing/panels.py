"""Lines over time as pixels: a library of plots takes half a second to load, more than all stills of a page."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from torchgrasp.app.report.palette import GRID, INK, PAPER

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

LEFT, RIGHT, TOP, BOTTOM = 84.0, 24.0, 32.0, 16.0
"""Margins of a panel [pixels]: room for numbers, for its title above, and for the gap below."""
HEAD, FOOT = 26.0, 24.0
"""Heights of the letters above all panels and of the seconds below [pixels]."""
SHARP = 2
"""Samples of a pixel along each axis: enough for smooth lines."""
LETTER = 18
"""Height of letters [pixels]: a page shows them at two thirds."""


class Line(NamedTuple):
    """A line of a panel; without a name the legend leaves it out."""

    values: Float[np.ndarray, " t"]
    color: str
    name: str = ""
    width: float = 2.0


class Panel(NamedTuple):
    """Lines over one time, from 0 to the `top` of their axis; `height` in pixels, `marks` are triangles at times."""

    title: str
    top: float
    height: int
    lines: Sequence[Line]
    marks: Sequence[tuple[float, str]] = ()


class Moment(NamedTuple):
    """A time [s] that all panels show by an upright line, with a letter above."""

    time: float
    letter: str
    color: str


def steps(top: float, most: int) -> list[float]:
    """Return round numbers from 0 to a top, at most so many steps.

    >>> steps(4.6, 5), steps(0.35, 4)
    ([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.1, 0.2, 0.3])
    """
    size = 10.0 ** math.floor(math.log10(top / most))
    step = next(k * size for k in (1, 2, 5, 10) if top / (k * size) <= most * (1 + 1e-9))
    return [round(k * step, 9) for k in range(int(top / step * (1 + 1e-9)) + 1)]


def draw_panels(
    panels: Sequence[Panel], time: Float[np.ndarray, " t"], moments: Sequence[Moment], width: int
) -> "Image":
    """Draw panels one below the other over the same time [s], in a picture of so many pixels across.

    Lines are cut at the ends of their axes, and broken where they are not finite.
    """
    from PIL import Image, ImageDraw, ImageFont

    begin, span = float(time[0]), max(float(time[-1] - time[0]), 0.1)
    scale = (width - LEFT - RIGHT) / span
    seconds = [begin + second for second in steps(span, 10)]
    bottoms = np.cumsum([panel.height for panel in panels]) + HEAD - BOTTOM
    sheet = Image.new("RGB", (SHARP * width, round(SHARP * (bottoms[-1] + BOTTOM + FOOT))), PAPER)
    pen = ImageDraw.Draw(sheet)
    for panel, low in zip(panels, bottoms.tolist(), strict=True):
        _draw_panel(pen, panel, LEFT + scale * (time - begin), low)
        for second in seconds:
            x = LEFT + scale * (second - begin)
            _line(pen, [(x, low), (x, low + 5)], INK, 1.0)
        for at, _, color in moments:
            x = LEFT + scale * (at - begin)
            _line(pen, [(x, low - panel.height + TOP + BOTTOM), (x, low)], color, 1.0 if color == INK else 2.5)
        for at, color in panel.marks:
            x = LEFT + scale * (at - begin)
            corners = [(x - 8, low + 6), (x, low - 9), (x + 8, low + 6)]
            pen.polygon([(SHARP * a, SHARP * b) for a, b in corners], color)

    picture, font = sheet.reduce(SHARP), ImageFont.load_default(LETTER)
    writer = ImageDraw.Draw(picture)
    for at, letter, color in moments:
        writer.text((LEFT + scale * (at - begin), HEAD), letter, color, font, anchor="ms")
    for second in seconds:
        text = f"{second:g} s" if second == seconds[-1] else f"{second:g}"
        writer.text((LEFT + scale * (second - begin), bottoms[-1] + 10), text, INK, font, anchor="mt")
    for panel, low in zip(panels, bottoms.tolist(), strict=True):
        for value in steps(panel.top, 4):
            y = low - value / panel.top * (panel.height - TOP - BOTTOM)
            writer.text((LEFT - 10, y), f"{value:g}", INK, font, anchor="rm")
        x = float(LEFT)
        for text, color in [(panel.title, INK), *((line.name, line.color) for line in panel.lines if line.name)]:
            writer.text((x, low - panel.height + BOTTOM + TOP - 10), text, color, font, anchor="ls")
            x += 28 + font.getlength(text)
    return picture


def _draw_panel(pen: "ImageDraw", panel: Panel, columns: Float[np.ndarray, " t"], low: float) -> None:
    """Draw the grid, the axes and the lines of a panel above its lowest row."""
    scale, right = (panel.height - TOP - BOTTOM) / panel.top, float(pen.im.size[0]) / SHARP - RIGHT
    for value in steps(panel.top, 4):
        _line(pen, [(LEFT, low - scale * value), (right, low - scale * value)], GRID, 1.0)
    for line in panel.lines:
        rows = low - scale * np.clip(line.values, 0.0, panel.top)
        finite = np.isfinite(rows)
        edges = np.flatnonzero(np.diff(finite, prepend=False, append=False))
        for first, last in edges.reshape(-1, 2):
            _line(pen, list(zip(columns[first:last], rows[first:last], strict=True)), line.color, line.width)
    _line(pen, [(LEFT, low - scale * panel.top), (LEFT, low), (right, low)], INK, 1.2)


def _line(pen: "ImageDraw", points: Sequence[tuple[float, float]], color: str, width: float) -> None:
    """Draw a line through points [pixels]."""
    pen.line([(SHARP * float(x), SHARP * float(y)) for x, y in points], color, round(SHARP * width), joint="curve")
