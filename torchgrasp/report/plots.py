"""Plots of a closure over time as PNGs, by matplotlib without window or global state."""

import io
from typing import Any

import numpy as np
import torch

from torchgrasp.frames import inverse, rotation_angle
from torchgrasp.report.palette import FINGERS, GRID, INK, PAPER
from torchgrasp.values import ClosureResult


def plot_forces(closure: ClosureResult, finger_names: tuple[str, ...]) -> bytes:
    """Plot the normal force of each fingertip [N] over time [s]."""
    time = closure.time.cpu().numpy()
    figure, axes = _figure()
    for forces, name, color in zip(closure.forces.T.cpu().numpy(), finger_names, FINGERS, strict=True):
        axes.plot(time, forces, color=color, linewidth=1.6, label=name)
    axes.set_ylabel("normal force [N]")
    axes.set_ylim(0.0, max(1.0, 1.15 * float(closure.forces.max())))
    axes.legend(frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    return _png(figure)


def plot_motion(closure: ClosureResult) -> bytes:
    """Plot the rise of object and hand [mm], and the object's rotation in the hand."""
    time = closure.time.cpu().numpy()
    hand_from_object = inverse(closure.hand_pose) @ closure.object_pose
    since_start = inverse(hand_from_object[:1]) @ hand_from_object
    turned = torch.rad2deg(rotation_angle(since_start[..., :3, :3])).cpu().numpy()
    figure, axes = _figure()
    for pose, name, color in ((closure.hand_pose, "hand", "#7c8591"), (closure.object_pose, "object", "#b5792a")):
        rise = 1e3 * (pose[:, 2, 3] - pose[0, 2, 3]).cpu().numpy()
        axes.plot(time, rise, color=color, linewidth=1.8, label=f"{name}: height above its start [mm]")
    axes.set_ylabel("height [mm]")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.35 * (high - low))  # room for the legend
    right = axes.twinx()
    right.plot(time, turned, color="#8a4f9e", linewidth=1.3, linestyle="--", label="object: turn in the hand [deg]")
    right.set_ylabel("turn [deg]", color="#8a4f9e")
    right.set_ylim(0.0, max(5.0, 1.5 * float(np.max(turned))))
    right.spines[["top", "left"]].set_visible(False)
    lines = [*axes.get_lines(), *right.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], frameon=False, loc="upper left")
    return _png(figure)


def _figure() -> tuple[Any, Any]:
    """Return a figure and its axes over time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), dpi=140, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(facecolor=PAPER)
    axes.set_xlabel("time [s]", color=INK)
    axes.grid(color=GRID, linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
    return figure, axes


def _png(figure: Any) -> bytes:
    """Return a figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
