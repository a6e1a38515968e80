"""A film strip of a simulated closing as one PNG: pictures of its key moments above plots over
time.
"""

from typing import Any

import numpy as np
import torch

from torchgrasp.app.report import canvas as paint
from torchgrasp.app.report.canvas import Direction
from torchgrasp.app.report.run_data import explain_loss, first_touches, moments_of
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.app.report.stills import add_solids, to_array
from torchgrasp.evaluation.causes import moved_in_hand, tick_of
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import apply
from torchgrasp.hand.hand import Hand
from torchgrasp.values.closing import ClosureResult

WIDTH = 1680
STILL = 340
TITLE = 44
"""Width of the strip, height of its stills with titles, and height of a title [pixels]."""
LETTERS = "abcdefgh"  # names of the moments in stills and plots


def draw_film(
    mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult, direction: Direction
) -> bytes:
    """Return a PNG of the film strip of a closing; `mesh` is the true object [m] in the frame of
    the grasp.
    """
    from matplotlib.figure import Figure

    moments = moments_of(closure, _centre(mesh), hand.tips.names)
    plots = _list_plots(mesh, hand, closure)
    time = to_array(closure.time)
    count = len(moments)
    heights = [200 if title.endswith(":") else 110 for title, *_ in plots]
    height = STILL + sum(heights) + 50 * len(plots) + 76
    figure = Figure((WIDTH / 100, height / 100), dpi=100, facecolor=paint.PAPER)
    stills = _draw_stills(mesh, hand, closure, [m.tick for m in moments], direction)
    for k, (still, moment) in enumerate(zip(stills, moments, strict=True)):
        axis = figure.add_axes((k / count, 1 - STILL / height, 1 / count, (STILL - TITLE) / height))
        axis.imshow(still, aspect="auto")
        axis.set_axis_off()
        title = f"{LETTERS[k]}  {float(closure.time[moment.tick]):.2f} s  {moment.name}"
        axis.set_title(
            title, loc="left", x=0.04, color=moment.color, fontsize=14 if count < 6 else 12
        )

    figure.subplots_adjust(
        0.05, 60 / height, 0.985, 1 - (STILL + 62) / height, hspace=50 / float(np.mean(heights))
    )
    axes = figure.subplots(len(plots), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axis, plot in zip(axes, plots, strict=True):
        _draw_plot(axis, time, *plot)
    for finger, tick in zip(closure.contact_order, first_touches(closure), strict=True):
        axes[0].plot(
            time[tick],
            0.0,
            "^",
            color=paint.FINGERS[finger],
            markersize=12,
            clip_on=False,
            zorder=3,
        )
    for letter, moment in zip(LETTERS, moments, strict=False):
        at = float(closure.time[moment.tick])
        color = moment.color
        for axis in axes:
            axis.axvline(at, color=color, linewidth=2 if color == paint.ALARM else 1, clip_on=False)
        place = {"xy": (at, 1.0), "xycoords": axes[0].get_xaxis_transform(), "ha": "center"}
        axes[0].annotate(
            letter, xytext=(0, 30), textcoords="offset points", color=color, fontsize=14, **place
        )
    axes[-1].set_xlabel("time [s]", fontsize=13, color=paint.INK)
    return paint.encode_figure(figure)


def describe_film(mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult) -> str:
    """Return the caption of a film strip: the order of touch, and when and why the object was lost."""

    def times(count: int) -> str:
        return "once" if count == 1 else f"{count} times"

    order = ", ".join(hand.tips.names[finger] for finger in closure.contact_order) or "none"
    lost = explain_loss(closure, _centre(mesh), hand.tips.names)
    stops = closure.stops
    attempts = closure.attempts
    on_its_way = f" On its way the hand touched something {times(stops)}." if stops else ""
    again = f" The hand closed {times(attempts)}." if attempts > 1 else ""
    end = (lost or "The object was held.") + on_its_way + again
    return f"In the order of touch: {order}. {end}"


def _centre(mesh: "trimesh.Trimesh") -> torch.Tensor:
    return torch.tensor(np.array(mesh.center_mass), dtype=torch.float64)


def _draw_stills(
    mesh: "trimesh.Trimesh",
    hand: Hand,
    closure: ClosureResult,
    ticks: list[int],
    direction: Direction,
) -> list[np.ndarray]:
    """Return pictures of the hand and the object at the given ticks, all at the same scale."""
    finite = torch.nonzero(
        closure.joints.isfinite().all(-1) & closure.object_pose.isfinite().all(-1).all(-1)
    )[:, 0]
    at = torch.stack([finite[finite <= tick][-1] for tick in ticks])
    vertices = torch.tensor(np.array(mesh.vertices), dtype=torch.float64)
    faces = np.asarray(mesh.faces)
    places = to_array(apply(closure.object_pose[at].double(), vertices))
    hands = [
        solids_from_hand(hand, closure.joints[t], closure.joint_names, closure.hand_pose[t])
        for t in at
    ]
    table = float(apply(closure.object_pose[0].double(), vertices)[:, 2].min())
    near = [
        x for x in places if np.abs(x - places[0]).mean(0).max() < 0.25
    ]  # a lost object is not framed
    seen = np.concatenate([*near, *(s.vertices for solids in hands for s in solids)])
    size = WIDTH // len(ticks), STILL - TITLE
    # it stands still: the lift is seen
    camera = paint.frame_camera(seen, direction, size=size)
    pictures = []
    for place, solids in zip(places, hands, strict=True):
        canvas = paint.Canvas()
        canvas.add_table(seen, table, [(place, faces), *((s.vertices, s.faces) for s in solids)])
        canvas.add_mesh(place, faces, paint.OBJECT)
        add_solids(canvas, solids)
        pictures.append(canvas.render(camera, size))
    return pictures


def _draw_plot(axis: Any, time: np.ndarray, title: str, top: float, lines: list[Any]) -> None:
    """Draw lines over time in one plot from 0 to `top`, with a legend if the title ends with a
    colon.
    """
    axis.set(xlim=(time[0], max(time[-1], time[0] + 0.1)), ylim=(0.0, top), facecolor=paint.PAPER)
    axis.set_title(title, loc="left", color=paint.INK, fontsize=13, pad=9)
    axis.grid(axis="y", color=paint.GRID)
    axis.locator_params(axis="y", nbins=3)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=13, labelcolor=paint.INK, color=paint.INK)
    for values, color, label in lines:
        wide = (
            4.0 if label == "hand above its lowest" else 1.8
        )  # a held object would cover this line
        axis.plot(time, values, color=color, label=label, linewidth=wide)
    if title.endswith(":"):
        style = {"labelcolor": "linecolor", "fontsize": 13, "handlelength": 1.2, "frameon": False}
        axis.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 0.96),
            ncols=len(lines),
            borderaxespad=0.0,
            **style,
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
    distance, turn = moved_in_hand(closure, _centre(mesh))
    before = torch.arange(len(closure.time)) < tick_of(closure, 2)
    slip, degrees = (
        to_array(x.masked_fill(before, torch.nan)) for x in (1e3 * distance, torch.rad2deg(turn))
    )
    centres = apply(closure.object_pose.double(), _centre(mesh).expand(len(closure.time), 1, 3))[
        :, 0
    ]
    moved = 1e3 * to_array(torch.linalg.vector_norm(centres - centres[0], dim=-1))
    height = 1e3 * to_array(closure.hand_pose[:, 2, 3])
    height = height - np.nanmin(height)
    forces = to_array(closure.forces)
    blend = to_array(trace.blend)
    sliding = 1e3 * to_array(trace.sliding)

    def of_fingers(values: np.ndarray) -> list[Any]:
        return list(zip(values.T, paint.FINGERS, ranks, strict=False))

    return [
        (
            "normal force [N], in the order of touch:",
            max(1.0, 1.1 * float(np.nanmax(forces))),
            of_fingers(forces),
        ),
        *[("lambda: 0 by position, 1 by force", 1.0, of_fingers(blend))]
        * bool(np.isfinite(blend).any()),
        (
            "sliding of the fingertips [mm/s]",
            100.0,
            of_fingers(sliding),
        ),  # a lost object slides faster
        (
            "motion [mm]:",
            1.1 * max(20.0, *(float(np.nanmax(x, initial=0.0)) for x in (moved, height))),
            [
                (height, "#9aa2ac", "hand above its lowest"),
                (moved, "#b5792a", "object from its place"),
                (slip, "#8a4f9e", "object in the hand since pressed"),
                (degrees, "#c77cba", "its turn in the hand [deg]"),
            ],
        ),
    ]
