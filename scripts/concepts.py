#!/usr/bin/env python
"""Draw the pictures of docs/concepts.md and docs/edge.md. They show a slice through a band of
uncertainty, contacts with and without closure, and a drag.

python scripts/concepts.py [--out docs]
"""

import math
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
import trimesh
import tyro

from torchgrasp import (
    Contacts,
    ContactSpec,
    Plane,
    certify,
    fit_shape,
    load_hand,
    load_object,
    plan_edge_grasps,
)
from torchgrasp.app.report.canvas import OBJECT, Canvas, frame_camera
from torchgrasp.app.report.raster import Camera
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.app.report.stills import add_solids
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.geometry.frames import rigid

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Wedge

HEIGHT = 0.07
"""Height [m] of the slice through the jug: its belly and its handle."""
INK = "#1f2933"
SEEN = "#d64545"
TRUE = "#147d64"
"""Colours of lines, of what the camera saw and of the true outline."""
ARROW = {"arrowstyle": "-|>", "linewidth": 1.6}
FRICTION = 0.8
"""Arrows of all pictures; friction of the contacts that close, and of those that do not."""


def draw_band(path: Path) -> None:
    """Draw a slice through the estimated shape of the jug, and write the picture to `path`.

    It shows the estimated surface at one height with its bands of uncertainty. It also shows the
    true outline, and the points that the camera saw there.
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
    """Draw three contacts on a tin seen from above, with their friction cones, on `axes`.

    `degrees` are the directions of the contacts from the tin's middle. The title says whether the
    contacts are certified to close.
    """
    radius = 0.033
    spec = ContactSpec(friction=FRICTION)
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)[None]
    proof = certify(Contacts(radius * normals, normals), spec)
    axes.add_patch(Circle((0, 0), 1e3 * radius, fill=False, color=INK, linewidth=1.6))
    places = (1e3 * radius * normals[0, :, :2]).tolist()
    for friction, color in ((FRICTION, "#fff3c4"), (spec.planned_friction, "#f7c948")):
        half = math.degrees(math.atan(friction))
        for (x, y), turn in zip(places, degrees, strict=True):
            axes.add_patch(Wedge((x, y), 24, turn + 180 - half, turn + 180 + half, color=color))
    for x, y in places:
        start = (0.55 * x, 0.55 * y)
        axes.annotate("", start, (1.45 * x, 1.45 * y), arrowprops=ARROW | {"color": SEEN})
    said = "not closed: it is pushed out downwards"
    if bool(proof.closed):
        said = "closed: any push is resisted"
    axes.set_title(f"{said}\nmargin {float(proof.margin):+.3f}", fontsize=9)
    axes.set(aspect="equal", xlim=(-55, 55), ylim=(-55, 55), xticks=[], yticks=[])
    axes.set_frame_on(False)


def draw_certificates(path: Path) -> None:
    """Draw contacts that are certified to close beside contacts that are not; write the picture."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 3.4), dpi=110, layout="constrained")
    draw_contacts(left, (30.0, 150.0, 270.0))
    draw_contacts(right, (30.0, 90.0, 150.0))
    figure.savefig(path)
    plt.close(figure)


SLAB = "#b4c0cc"
"""Colour of the table in the picture of a drag."""

SHOT = (960, 660)
"""Width and height [pixels] of a picture of a drag."""
FRONT = np.array([0.0, -0.055, 0.0])
"""Place [m] of the arrow of the drag: in front of the box."""


class Panel(NamedTuple):
    """One picture of a drag.

    `joints` (h,) [rad or m] and `pose` (4, 4) [m] are the hand's. `moved` (3,) [m] is the
    displacement of the object so far.
    """

    title: str
    joints: torch.Tensor
    pose: torch.Tensor
    moved: np.ndarray


def draw_drag(path: Path) -> None:
    """Draw in three pictures how a hand drags a low box over a table's edge and pinches it."""
    box = trimesh.creation.box([0.12, 0.06, 0.01]).apply_translation([0.0, 0.0, 0.005])
    cloud = partial_view(box, look_at(-135.0, 40.0, target=box))
    hand = load_hand("barrett")
    x = torch.tensor([1.0, 0.0, 0.0])
    spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.15 * x, x))
    plan = plan_edge_grasps(cloud, hand, spec, starts=100)
    drag = plan.drag
    grasp = plan.grasps.best
    assert drag is not None
    shift = rigid(torch.eye(3, dtype=torch.float64), drag.displacement)
    way = drag.displacement.numpy()
    panels = (
        Panel("1. press from above", drag.joints, drag.obj_from_hand, 0 * way),
        Panel("2. drag it over the edge", drag.joints, shift @ drag.obj_from_hand, way),
        Panel("3. pinch what hangs over", grasp.joints[0], grasp.obj_from_hand[0], way),
    )
    slab = trimesh.creation.box([0.27, 0.16, 0.02]).apply_translation([0.015, 0.0, -0.01])
    hands = [
        solids_from_hand(hand, hand.expand_joints(x.joints), hand.tree.joint_names, x.pose)
        for x in panels
    ]
    corners = np.concatenate([slab.vertices, *(s.vertices for solids in hands for s in solids)])
    camera = frame_camera(corners, (0.3, -1.0, 0.1), size=SHOT)
    begin, end = project(np.stack([0 * way, way]) + FRONT, camera).tolist()
    shots = []
    for panel, solids in zip(panels, hands, strict=True):
        canvas = Canvas()
        canvas.add_mesh(slab.vertices, slab.faces, SLAB)
        canvas.add_mesh(box.vertices + panel.moved, box.faces, OBJECT)
        if panel.moved.any():
            canvas.add_mesh(box.vertices, box.faces, OBJECT, transparent=True)
        add_solids(canvas, solids)
        shots.append(canvas.render(camera, SHOT))
    # all three are cut to what any of them shows
    drawn = np.any(np.stack(shots) != shots[0][0, 0], axis=(0, 3))
    left, *_, right = np.flatnonzero(drawn.any(0))
    top, *_, bottom = np.flatnonzero(drawn.any(1))
    figure, all_axes = plt.subplots(1, 3, figsize=(10.0, 2.0), dpi=110, layout="constrained")
    for axes, panel, shot in zip(all_axes, panels, shots, strict=True):
        axes.imshow(shot)
        axes.set(xlim=(left, right), ylim=(bottom, top))
        if panel.title.startswith("2"):
            axes.annotate("", end, begin, arrowprops=ARROW)
        axes.set_title(panel.title, fontsize=11, color=INK)
        axes.set_axis_off()
    figure.savefig(path, pil_kwargs={"quality": 88})
    plt.close(figure)


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the pixels (column, row), (n, 2), of points (n, 3) [m] in a picture of size `SHOT`."""
    right, up, back = camera.frame @ (points - camera.position).T
    scale = SHOT[1] / (2 * math.tan(camera.angle / 2))
    return np.stack([SHOT[0] / 2 - scale * right / back, SHOT[1] / 2 + scale * up / back], -1)


def main(out: Path = Path(__file__).parents[1] / "docs") -> None:
    """Draw the pictures of docs/concepts.md and docs/edge.md.

    Args:
        out: folder of the pictures.
    """
    torch.set_num_threads(1)
    draw_band(out / "concepts_band.png")
    draw_certificates(out / "concepts_certificate.png")
    draw_drag(out / "edge.jpg")


if __name__ == "__main__":
    tyro.cli(main)
