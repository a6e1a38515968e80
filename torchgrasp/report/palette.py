"""The colours that pictures, plots and pages share."""

FINGERS = ("#2f6db5", "#23967f", "#e0762f", "#8a4f9e", "#c23b55")
"""The fingers, in grasp order; a hand has three to five."""

AXES = ("#d62728", "#2ca02c", "#1f4fd8")
"""A frame's x, y and z."""

HAND = "#a9b0ba"
"""The palm and parked fingers."""

OBJECT, TABLE = "#e9d7b3", "#eceae4"
"""Sand and grey."""

THINGS = ("#d98f5c", "#6f9fd8", "#7fb77e", "#c77cba", "#d8c25a", "#6bbdb7", "#e08a8a", "#9a8fd1")
"""The things of a scene, in the order of their labels, again from the first."""

PAPER, INK, GRID = "#fcfcfa", "#22262b", "#dcdad3"
"""The background, lines with letters, and grid lines."""


def rgb(color: str) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1].

    >>> rgb("#ff0033")
    (1.0, 0.0, 0.2)
    """
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
