#!/usr/bin/env python
"""Draw the pictures of docs/concepts.md: a slice through a band of uncertainty, and contacts with
and without closure.

python scripts/concepts.py [--out docs]
"""

import math
from pathlib import Path

import matplotlib
import numpy as np
import torch
import tyro

from torchgrasp import Contacts, ContactSpec, certify, fit_shape, load_object

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

HEIGHT = 0.07
"""Height [m] of the slice through the jug: its belly and its handle."""
INK = "#1f2933"
GREY = "#9aa5b1"
SEEN = "#d64545"
TRUE = "#147d64"
"""Colours of lines, of what stands back, of what the camera saw and of the true outline."""


def draw_band(path: Path) -> None:
    """Draw the surface that is estimated at one height, its bands, the true outline and what was
    seen there.
    """
    jug = load_object("jug")
    shape = fit_shape(jug.view, table=0.0)
    x, y = np.meshgrid(np.linspace(-0.1, 0.06, 161), np.linspace(-0.06, 0.06, 121))
    points = torch.tensor(np.stack([x, y, np.full_like(x, HEIGHT)], -1))
    inside = shape.contains(points)
    distance = torch.full(inside.shape, torch.nan, dtype=torch.float64)
    distance[inside] = shape.predict(points[inside]).distance
    figure, axes = plt.subplots(figsize=(6.4, 4.2), dpi=110, layout="constrained")
    outline = axes.contour(1e3 * x, 1e3 * y, distance, levels=[0], colors=[INK], linewidths=1.6)
    for line in outline.allsegs[0]:
        at = torch.tensor(np.c_[1e-3 * line, np.full(len(line), HEIGHT)])
        found = shape.predict(at)
        for width, color in ((3, "#fff3c4"), (2, "#fadb5f"), (1, "#f7c948")):
            off = width * found.std_m[:, None] * found.normal
            band = 1e3 * torch.cat([at + off, (at - off).flip(0)])[:, :2]
            axes.fill(*band.T, color=color, linewidth=0, zorder=0.5 - 0.1 * width)
    for width, color in ((1, "#f7c948"), (2, "#fadb5f"), (3, "#fff3c4")):
        axes.fill([], [], color=color, label=f"within {width} std_m")
    section = jug.mesh.section([0, 0, 1], [0, 0, HEIGHT])
    assert section is not None
    for line in section.discrete:
        axes.plot(*(1e3 * line[:, :2].T), color=TRUE, linewidth=1.3, linestyle="--")
    near = jug.view.points[(jug.view.points[:, 2] - HEIGHT).abs() < 0.004]
    axes.scatter(*(1e3 * near[:, :2].T), s=9, color=SEEN, zorder=3)
    axes.plot([], [], color=INK, label="estimated surface")
    axes.plot([], [], color=TRUE, linestyle="--", label="true surface, which no planner sees")
    axes.scatter([], [], s=9, color=SEEN, label="what the camera saw")
    axes.legend(frameon=False, loc="upper left", fontsize=8, ncols=2)
    axes.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]", ylim=(-60, 85))
    figure.savefig(path)
    plt.close(figure)


def draw_contacts(axes: Axes, degrees: tuple[float, ...]) -> None:
    """Draw three contacts on a tin from above with their friction cones, and what the certificate
    says of them.
    """
    radius = 0.033
    spec = ContactSpec(friction=0.8)
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)[None]
    proof = certify(Contacts(radius * normals, normals), spec)
    axes.add_patch(plt.Circle((0, 0), 1e3 * radius, fill=False, color=INK, linewidth=1.6))
    for friction, color in ((spec.friction, "#fff3c4"), (spec.planned_friction, "#f7c948")):
        half = math.degrees(math.atan(friction))
        for turn in degrees:
            at = (
                1e3
                * radius
                * np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn))])
            )
            axes.add_patch(
                matplotlib.patches.Wedge(at, 24, turn + 180 - half, turn + 180 + half, color=color)
            )
    for turn in degrees:
        at = 1e3 * radius * np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn))])
        axes.annotate(
            "",
            at * 0.55,
            at * 1.45,
            arrowprops={"arrowstyle": "-|>", "color": SEEN, "linewidth": 1.6},
        )
    said = (
        "closed: any push is resisted"
        if bool(proof.closed)
        else "not closed: it is pushed out downwards"
    )
    axes.set_title(f"{said}\nmargin {float(proof.margin):+.3f}", fontsize=9)
    axes.set(aspect="equal", xlim=(-55, 55), ylim=(-55, 55), xticks=[], yticks=[])
    axes.set_frame_on(False)


def draw_certificates(path: Path) -> None:
    """Draw contacts that close, and contacts that do not."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 3.4), dpi=110, layout="constrained")
    draw_contacts(left, (30.0, 150.0, 270.0))
    draw_contacts(right, (30.0, 90.0, 150.0))
    figure.savefig(path)
    plt.close(figure)


def main(out: Path = Path(__file__).parents[1] / "docs") -> None:
    """Draw the pictures.

    Args:
        out: folder to write.
    """
    torch.set_num_threads(1)
    draw_band(out / "concepts_band.png")
    draw_certificates(out / "concepts_certificate.png")


if __name__ == "__main__":
    tyro.cli(main)
