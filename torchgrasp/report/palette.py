"""The colours that pictures, plots and the page share."""

FINGERS = ("#2f6db5", "#23967f", "#e0762f")
"""The three fingers, in grasp order."""

HAND = "#a9b0ba"
"""The palm and parked fingers."""

OBJECT = "#e9d7b3"
"""The object."""

TABLE = "#eceae4"
"""The table."""

INK = "#22262b"
"""Lines and letters."""

PAPER = "#fcfcfa"
"""What is drawn on."""

GRID = "#dcdad3"
"""Grid lines."""


def rgb(color: str) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1].

    >>> rgb("#ff0033")
    (1.0, 0.0, 0.2)
    """
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


AXES = ("#d62728", "#2ca02c", "#1f4fd8")
"""Colours of a frame's x, y and z."""
