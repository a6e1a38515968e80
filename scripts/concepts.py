#!/usr/bin/env python
"""Draw the pictures of docs/concepts.md, docs/uncertainty.md and docs/edge.md: a slice through a band
of uncertainty, contacts with and without closure, what each uncertainty costs, and a drag.

python scripts/concepts.py [--out docs]
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
import trimesh
import tyro

from torchgrasp import (
    CarriedWeight,
    Contacts,
    ContactSpec,
    Distribution,
    Plane,
    certify,
    critical_friction,
    fit_shape,
    hold_probability,
    load_hand,
    load_object,
    plan_edge_grasps,
)
from torchgrasp.app.report.canvas import OBJECT, Canvas, frame_camera
from torchgrasp.app.report.raster import Camera
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.app.report.stills import add_solids
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.contacts.critical import least_balance
from torchgrasp.contacts.form_closure import centre_and_radius, with_torque
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.geometry.frames import rigid
from torchgrasp.geometry.linalg import dot, unit

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

HEIGHT = 0.07
"""Height [m] of the slice through the jug: its belly and its handle."""
INK = "#1f2933"
SEEN = "#d64545"
TRUE = "#147d64"
"""Colours of lines, of what the camera saw and of the true outline."""


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


SLAB = "#b4c0cc"
"""Colour of the table in the picture of a drag."""

SHOT = (960, 660)
"""Width and height [pixels] of a picture of a drag."""
FRONT = np.array([0.0, -0.055, 0.0])
"""Place [m] of the arrow of the drag: in front of the box."""


class Panel(NamedTuple):
    """A picture of a drag: its title, the hand's joints and pose, and how far the object is [m]."""

    title: str
    joints: torch.Tensor
    pose: torch.Tensor
    moved: np.ndarray


def draw_drag(path: Path) -> None:
    """Draw how a hand drags a low box over the edge of a table and pinches it there."""
    box = trimesh.creation.box([0.12, 0.06, 0.01]).apply_translation([0.0, 0.0, 0.005])
    cloud = partial_view(box, look_at(-135.0, 40.0, target=box))
    hand = load_hand("barrett")
    x = torch.tensor([1.0, 0.0, 0.0])
    spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.15 * x, x))
    plan = plan_edge_grasps(cloud, hand, spec, starts=100)
    drag, grasp = plan.drag, plan.grasps.best
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
    begin, end = project(np.stack([0 * way, way]) + FRONT, camera)
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
            axes.annotate("", end, begin, arrowprops={"arrowstyle": "-|>", "linewidth": 1.6})
        axes.set_title(panel.title, fontsize=11, color=INK)
        axes.set_axis_off()
    figure.savefig(path, pil_kwargs={"quality": 88})
    plt.close(figure)


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the pixels (n, 2) of points (n, 3) [m] in a picture of the size `SHOT`."""
    right, up, back = camera.frame @ (points - camera.position).T
    scale = SHOT[1] / (2 * math.tan(camera.angle / 2))
    return np.stack([SHOT[0] / 2 - scale * right / back, SHOT[1] / 2 + scale * up / back], -1)


LAW = Distribution.between(0.1, 0.6)
"""Friction in the pictures of other uncertainties."""
DRAWN = 4000
"""Random draws for each dot."""


class Source(NamedTuple):
    """An uncertainty: its name on the axis, its sizes, the probability in closed form, and frictions
    that random draws of it need.
    """

    axis: str
    scale: float
    sizes: tuple[float, ...]
    predicted: Callable[[float], torch.Tensor]
    drawn: Callable[[float], torch.Tensor]


def draw_sources(path: Path) -> None:
    """Draw the probability that the contacts of a shipped grasp close, over the size of each
    uncertainty: in closed form, and by random draws.
    """
    figure, all_axes = plt.subplots(2, 3, figsize=(9.0, 5.0), dpi=110, layout="constrained")
    for axes, source in zip(all_axes.flat, list_sources(), strict=True):
        low, high = source.sizes[0], source.sizes[-1]
        fine = np.linspace(low, high, 31)
        predicted = [float(source.predicted(x)) for x in fine]
        axes.plot(source.scale * fine, predicted, color=INK, label="hold_probability")
        shares = [float((1 - LAW.cdf(source.drawn(x))).mean()) for x in source.sizes]
        label = f"{DRAWN} random draws"
        sizes = source.scale * np.array(source.sizes)
        axes.scatter(sizes, shares, color=SEEN, s=16, zorder=3, label=label)
        axes.set(xlabel=source.axis, ylim=(0.5, 1.02))
    for axes in all_axes[:, 0]:
        axes.set_ylabel("probability")
    all_axes[0, 0].legend(frameon=False, loc="lower left", fontsize=8)
    figure.savefig(path)
    plt.close(figure)


def list_sources() -> list[Source]:
    """Return the sources of uncertainty at the contacts of the jug's shipped Barrett grasp."""
    contacts = load_shipped_grasp("jug", "barrett").contacts
    contacts = Contacts(contacts.points.double(), contacts.normals.double())
    points, normals = contacts.points, contacts.normals
    generator = torch.Generator().manual_seed(0)
    three = torch.randn(2, DRAWN, 1, 3, generator=generator, dtype=torch.float64)
    each = torch.randn(2, DRAWN, *points.shape[1:], generator=generator, dtype=torch.float64)
    arms = points - points.mean(1, keepdim=True)

    def along(v: torch.Tensor) -> torch.Tensor:
        return v - dot(v, normals, keepdim=True) * normals

    def moved(v: torch.Tensor) -> torch.Tensor:
        return critical_friction(points + along(v), normals.expand_as(v))

    def turned(v: torch.Tensor) -> torch.Tensor:
        return critical_friction(points.expand_as(v), unit(normals + along(v)))

    weight = CarriedWeight(0.25, points[0].mean(0), press=5.0)

    def heavier(width: float) -> torch.Tensor:
        mass = Distribution.between(0.25 - width / 2, 0.25 + width / 2) if width else 0.25
        return hold_probability(contacts, LAW, weight=dataclasses.replace(weight, mass=mass))

    def weighed(width: float) -> torch.Tensor:
        mass = 0.25 + width * (torch.rand(DRAWN, generator=generator, dtype=torch.float64) - 0.5)
        centre, radius = centre_and_radius(points)
        force = torch.zeros(DRAWN, 3, dtype=torch.float64)
        force[:, 2] = -9.81 * mass / weight.press
        load = with_torque(force, ((weight.center - centre[:, 0]) / radius[:, 0]).expand(DRAWN, 3))
        many, outward = (x.expand(DRAWN, -1, -1) for x in (points, normals))
        rows, balance = least_balance(many, outward, load)
        needed = torch.full((DRAWN,), torch.inf, dtype=torch.float64)
        return needed.index_put((rows,), balance.friction)

    millimetres = (0.0, 0.002, 0.004, 0.006, 0.008)
    angles = (0.0, 0.03, 0.06, 0.09, 0.12)
    degrees = math.degrees(1.0)
    return [
        *list_friction(contacts),
        Source(
            "finger placement: std [mm]",
            1e3,
            millimetres,
            lambda x: hold_probability(contacts, LAW, placement=x),
            lambda x: moved(x * each[0]),
        ),
        Source(
            "normals: std [deg]",
            degrees,
            angles,
            lambda x: hold_probability(contacts, LAW, tilt=x),
            lambda x: turned(x * each[1]),
        ),
        Source(
            "object's place: std [mm]",
            1e3,
            millimetres,
            lambda x: hold_probability(contacts, LAW, shift=x),
            lambda x: moved((x * three[0]).expand_as(each[0])),
        ),
        Source(
            "object's rotation: std [deg]",
            degrees,
            angles,
            lambda x: hold_probability(contacts, LAW, turn=x),
            lambda x: moved(torch.linalg.cross((x * three[1]).expand_as(each[0]), arms)),
        ),
        Source("mass around 0.25 kg: width [kg]", 1.0, (0.0, 0.1, 0.2, 0.3, 0.4), heavier, weighed),
    ]


def list_friction(contacts: Contacts) -> list[Source]:
    """Return the source friction: intervals around the mean of `LAW`."""
    needed = critical_friction(contacts.points, contacts.normals)
    uniform = torch.rand(DRAWN, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def law(width: float) -> Distribution:
        return Distribution.between(LAW.mean - width / 2, LAW.mean + width / 2)

    def drawn(width: float) -> torch.Tensor:
        """Return frictions that hold in `LAW` as often as the drawn ones exceed what is needed."""
        held = LAW.mean + width * (uniform - 0.5) > needed
        return torch.where(held, 0.0, torch.inf)

    widths = (0.01, 0.2, 0.4, 0.6, 0.7)
    axis = f"friction around {LAW.mean:g}: width"
    return [Source(axis, 1.0, widths, lambda x: hold_probability(contacts, law(x)), drawn)]


def main(out: Path = Path(__file__).parents[1] / "docs") -> None:
    """Draw the pictures.

    Args:
        out: folder to write.
    """
    torch.set_num_threads(1)
    draw_band(out / "concepts_band.png")
    draw_certificates(out / "concepts_certificate.png")
    draw_sources(out / "uncertainty_sources.png")
    draw_drag(out / "edge.jpg")


if __name__ == "__main__":
    tyro.cli(main)
