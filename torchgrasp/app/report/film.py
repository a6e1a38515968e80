"""A film strip of a simulated closing as one PNG: pictures of its key moments above plots over
time.
"""

import dataclasses
from typing import Any

import numpy as np
import torch

from torchgrasp.app.report import canvas as paint
from torchgrasp.app.report.closing_moments import (
    Moment,
    explain_loss,
    first_touches,
    mass_centre,
    moments_of,
    moved_from_place,
)
from torchgrasp.app.report.closing_pictures import draw_ticks, finite_ticks
from torchgrasp.app.report.raster import Direction
from torchgrasp.evaluation.causes import moved_in_hand, tick_of
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import to_array
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.values.closing import ClosureResult


@dataclasses.dataclass(frozen=True)
class FilmLayout:
    """Layout of a film strip: stills, and plots below them.

    Lengths are in [pixels] and sizes of fonts in [points], unless it is said otherwise.
    """

    dpi: int = 100  # resolution [pixels per inch]
    width: int = 1680  # width of the strip
    still: int = 340  # height of a still with its title
    title: int = 44  # height of this title
    title_left: float = 0.04  # place of the title, as a share of the still's width
    font: int = 14  # size of titles and letters
    small_font: int = 12  # size of the titles of many stills, so that they fit
    many: int = 6  # number of stills from which on the small font is used
    tall_plot: int = 200  # height of a plot with a legend
    plot: int = 110  # height of a plot without a legend
    plot_gap: int = 50  # gap above each plot, for its title
    plots_top: int = 62  # gap between stills and plots, for the letters of the moments
    plots_bottom: int = 60  # gap below the plots, for the axis of time
    bottom: int = 76  # height in addition to stills, plots and their gaps
    left: float = 0.05  # left end of the plots, as a share of the width
    right: float = 0.985  # right end of the plots, as a share of the width
    letter_rise: int = 30  # height of a letter above the first plot [points]
    touch: int = 12  # size of the mark at a finger's first touch [points]


@dataclasses.dataclass(frozen=True)
class PlotStyle:
    """Style of the plots in a film strip, and the least upper ends of their axes.

    Lengths and sizes of fonts are in [points], unless it is said otherwise.
    """

    font: int = 13  # size of titles and of the texts of axes
    title_gap: int = 9  # gap between a title and its plot
    ticks: int = 3  # greatest number of intervals of the vertical axis
    line: float = 1.8  # width of a line
    wide: float = 4.0  # width of the line of the hand's height, which a held object's would cover
    handle: float = 1.2  # length of a line in the legend, in font sizes
    legend_top: float = 0.96  # lower end of the legend, as a share of the plot's height
    room: float = 1.1  # upper end of an axis, divided by the largest value that it shows
    least_time: float = 0.1  # least upper end of the axis of time [s]
    least_force: float = 1.0  # least upper end of the axis of forces [N]
    least_motion: float = 20.0  # least upper end of the axis of motions [mm]
    # greatest upper end of the axis of sliding [mm/s]: a lost object slides faster
    most_sliding: float = 100.0


FILM = FilmLayout()
PLOTS = PlotStyle()
LETTERS = "abcdefgh"  # names of the moments in stills and plots
HAND_HEIGHT = "hand above its lowest"  # name of the line
MOTION_COLORS = {
    HAND_HEIGHT: "#9aa2ac",
    "object from its place": "#b5792a",
    "object in the hand since pressed": "#8a4f9e",
    "its turn in the hand [deg]": "#c77cba",
}
"""Colours of the lines of the plot of motion, by name."""


def draw_film(
    mesh: "trimesh.Trimesh",
    hand: Hand,
    closure: ClosureResult,
    direction: Direction,
    edge: Plane | None = None,
) -> bytes:
    """Return the bytes of a PNG of a simulated closing: pictures of its main moments in a row, over
    plots against time.

    `closure` holds the record that is plotted. `mesh` is the true object [m] in the frame of the
    grasp, where z is up. `direction` (x, y, z), of any length, points from the object to the
    camera. A level table is drawn below the object. It ends at the vertical plane `edge`, whose
    normal points away from the table; None means no end.
    """
    from matplotlib.figure import Figure

    moments = moments_of(closure, mass_centre(mesh), hand.tips.names)
    plots = _list_plots(mesh, hand, closure)
    heights = [FILM.tall_plot if title.endswith(":") else FILM.plot for title, *_ in plots]
    height = FILM.still + sum(heights) + FILM.plot_gap * len(plots) + FILM.bottom
    size = FILM.width / FILM.dpi, height / FILM.dpi
    figure = Figure(size, dpi=FILM.dpi, facecolor=paint.PAPER)

    # of a simulation that diverged, the last state before
    finite = finite_ticks(closure)
    ticks = [int(finite[finite <= moment.tick][-1]) for moment in moments]
    table = dataclasses.replace(Plane.horizontal(0.0), edge=edge)
    count = len(moments)
    still_size = FILM.width // count, FILM.still - FILM.title
    stills = draw_ticks(mesh, hand, closure, ticks, range(count), direction, table, still_size)
    times = [float(closure.time[moment.tick]) for moment in moments]
    _add_stills(figure, height, list(stills), moments, times)

    figure.subplots_adjust(
        FILM.left,
        FILM.plots_bottom / height,
        FILM.right,
        1 - (FILM.still + FILM.plots_top) / height,
        hspace=FILM.plot_gap / float(np.mean(heights)),
    )
    axes = figure.subplots(len(plots), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    time = to_array(closure.time)
    for axis, plot in zip(axes, plots, strict=True):
        _draw_plot(axis, time, *plot)
    for finger, tick in zip(closure.contact_order, first_touches(closure), strict=True):
        color = paint.FINGERS[finger]
        # in front of the axis, which is drawn in layer 2
        look = {"color": color, "markersize": FILM.touch, "clip_on": False, "zorder": 3}
        axes[0].plot(time[tick], 0.0, "^", **look)
    _mark_moments(axes, moments, times)
    axes[-1].set_xlabel("time [s]", fontsize=PLOTS.font, color=paint.INK)
    return paint.encode_figure(figure)


def _add_stills(
    figure: Any,
    height: int,
    stills: list[np.ndarray],
    moments: list[Moment],
    times: list[float],
) -> None:
    """Add stills with their titles in a row at the top of a figure of a height [pixels].

    `times` [s] are those of the `moments`.
    """
    count = len(stills)
    font = FILM.font if count < FILM.many else FILM.small_font
    bottom = 1 - FILM.still / height
    shown = (FILM.still - FILM.title) / height
    for k, (still, moment, time) in enumerate(zip(stills, moments, times, strict=True)):
        axis = figure.add_axes((k / count, bottom, 1 / count, shown))
        axis.imshow(still, aspect="auto")
        axis.set_axis_off()
        title = f"{LETTERS[k]}  {time:.2f} s  {moment.name}"
        axis.set_title(title, loc="left", x=FILM.title_left, color=moment.color, fontsize=font)


def _mark_moments(axes: Any, moments: list[Moment], times: list[float]) -> None:
    """Draw a line through all plots at the time [s] of each moment, with a letter above it."""
    for letter, moment, time in zip(LETTERS, moments, times, strict=False):
        color = moment.color
        wide = 2 if color == paint.ALARM else 1
        for axis in axes:
            axis.axvline(time, color=color, linewidth=wide, clip_on=False)
        axes[0].annotate(
            letter,
            (time, 1.0),
            xycoords=axes[0].get_xaxis_transform(),
            xytext=(0, FILM.letter_rise),
            textcoords="offset points",
            ha="center",
            color=color,
            fontsize=FILM.font,
        )


def describe_film(mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult) -> str:
    """Return the caption of a film strip: the order of touch, and when and why the object was lost.

    The text also says how often the hand touched something on its way, and how often it closed.
    `mesh` is the true object [m] in the frame of the grasp, where z is up. `closure` is the record
    of the simulated closing.
    """

    def times(count: int) -> str:
        return "once" if count == 1 else f"{count} times"

    order = ", ".join(hand.tips.names[finger] for finger in closure.contact_order) or "none"
    lost = explain_loss(closure, mass_centre(mesh), hand.tips.names)
    stops = closure.stops
    attempts = closure.attempts
    on_its_way = f" On its way the hand touched something {times(stops)}." if stops else ""
    again = f" The hand closed {times(attempts)}." if attempts > 1 else ""
    end = (lost or "The object was held.") + on_its_way + again
    return f"In the order of touch: {order}. {end}"


def _draw_plot(axis: Any, time: np.ndarray, title: str, top: float, lines: list[Any]) -> None:
    """Draw lines over time in one plot from 0 to `top`. A legend is drawn if the title ends with a
    colon.
    """
    end = max(time[-1], time[0] + PLOTS.least_time)
    axis.set(xlim=(time[0], end), ylim=(0.0, top), facecolor=paint.PAPER)
    axis.set_title(title, loc="left", color=paint.INK, fontsize=PLOTS.font, pad=PLOTS.title_gap)
    axis.grid(axis="y", color=paint.GRID)
    axis.locator_params(axis="y", nbins=PLOTS.ticks)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=PLOTS.font, labelcolor=paint.INK, color=paint.INK)
    for values, color, label in lines:
        wide = PLOTS.wide if label == HAND_HEIGHT else PLOTS.line
        axis.plot(time, values, color=color, label=label, linewidth=wide)
    if title.endswith(":"):
        axis.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, PLOTS.legend_top),
            ncols=len(lines),
            borderaxespad=0.0,
            labelcolor="linecolor",
            fontsize=PLOTS.font,
            handlelength=PLOTS.handle,
            frameon=False,
        )


def _list_plots(
    mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult
) -> list[tuple[str, float, list[Any]]]:
    """Return title, upper end of the axis, and lines of each plot in the film strip."""
    trace = closure.trace
    names = hand.tips.names
    order = closure.contact_order
    ranks = [
        f"{order.index(k) + 1}. {name}" if k in order else f"never: {name}"
        for k, name in enumerate(names)
    ]
    centre = mass_centre(mesh)
    distance, turn = moved_in_hand(closure, centre)
    before = torch.arange(len(closure.time)) < tick_of(closure, 2)
    slip = to_array((1e3 * distance).masked_fill(before, torch.nan))
    degrees = to_array(torch.rad2deg(turn).masked_fill(before, torch.nan))
    moved = 1e3 * to_array(moved_from_place(closure, centre))
    height = 1e3 * to_array(closure.hand_pose[:, 2, 3])
    height = height - np.nanmin(height)
    forces = to_array(closure.forces)
    blend = to_array(trace.blend)
    sliding = 1e3 * to_array(trace.sliding)

    def of_fingers(values: np.ndarray) -> list[Any]:
        return list(zip(values.T, paint.FINGERS, ranks, strict=False))

    strongest = max(PLOTS.least_force, PLOTS.room * float(np.nanmax(forces)))
    plots = [("normal force [N], in the order of touch:", strongest, of_fingers(forces))]
    # a closing by position alone has no blend
    if np.isfinite(blend).any():
        plots.append(("lambda: 0 by position, 1 by force", 1.0, of_fingers(blend)))
    plots.append(("sliding of the fingertips [mm/s]", PLOTS.most_sliding, of_fingers(sliding)))
    farthest = max(PLOTS.least_motion, *(float(np.nanmax(x, initial=0.0)) for x in (moved, height)))
    values = zip((height, moved, slip, degrees), MOTION_COLORS.items(), strict=True)
    lines = [(line, color, label) for line, (label, color) in values]
    plots.append(("motion [mm]:", PLOTS.room * farthest, lines))
    return plots
