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

RAMPS = {
    "viridis": "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c 1fa088 28ae80 3fbc73 5ec962 84d44b "
    "addc30 d8e219 fde725",
    "cividis": "00224e 002e6a 1a386f 32436d 434e6c 535a6d 61656f 6f7073 7d7c78 8c8878 9b9476 aba072 bcae6c cdbb63 "
    "dec958 f0d846 fee838",
}
"""Colours from 0 to 1 in equal steps, of the maps of these names, both CC0: within 0.05 of them, and matplotlib, which
has them whole, takes 0.2 s to load."""


def rgb(color: str) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1].

    >>> rgb("#ff0033")
    (1.0, 0.0, 0.2)
    """
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
