"""Stills and plots of a run as PNGs."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.closing import ClosureResult
from torchgrasp.frames import apply, inverse, rotation_angle
from torchgrasp.hand.hand import Hand
from torchgrasp.report.canvas import Canvas, Direction, map_colors
from torchgrasp.report.palette import FINGERS, GRID, INK, OBJECT, PAPER
from torchgrasp.report.solids import solids_from_hand
from torchgrasp.shape.surface import Surface
from torchgrasp.values import Contacts, Grasps, PointCloud

if TYPE_CHECKING:
    import trimesh

ARROW = 0.045
"""Length of the arrows along normals [m]: twice a fingertip's."""


def draw_cloud(cloud: PointCloud, table: float | None = None) -> bytes:
    """Draw a cloud from its camera, coloured by height."""
    points = to_array(cloud.points)
    points = points[:: -(-len(points) // 3000)]  # more would hide each other
    canvas = Canvas()
    height = points[:, 2] - points[:, 2].min()
    canvas.add_points(points, map_colors(height / max(float(height.max()), 1e-12), "cividis"))
    canvas.add_table(points, table)
    return canvas.render_png(points, view_of(cloud))


def draw_surface(surface: Surface, direction: Direction, table: float | None = None) -> bytes:
    """Draw the estimated surface, coloured by its standard deviation [mm]."""
    vertices, std_mm = to_array(surface.vertices), 1e3 * to_array(surface.std_m)
    most = max(float(np.quantile(std_mm, 0.99)), 1e-3)
    canvas = Canvas()
    faces, colors = surface.faces.cpu().numpy(), map_colors(std_mm / most, "viridis")
    canvas.add_mesh(vertices, faces, colors, to_array(surface.normals))
    canvas.add_table(vertices, table)
    return canvas.render_png(vertices, direction, bar=("standard deviation of the surface [mm]", most, "viridis"))


def draw_contacts(surface: Surface, contacts: Contacts, direction: Direction, table: float | None = None) -> bytes:
    """Draw the first row's contacts with normals on the estimated surface."""
    vertices = to_array(surface.vertices)
    canvas = Canvas()
    canvas.add_mesh(vertices, surface.faces.cpu().numpy(), OBJECT, to_array(surface.normals), transparent=True)
    add_contacts(canvas, contacts)
    canvas.add_table(vertices, table)
    return canvas.render_png(vertices, direction)


def add_contacts(canvas: Canvas, contacts: Contacts) -> None:
    """Add an arrow along the normal of each of the first row's contacts, in the colour of its finger."""
    points, normals = to_array(contacts.points[0]), to_array(contacts.normals[0])
    canvas.add_arrows(points, normals, ARROW, FINGERS[: len(points)])


def draw_grasp(surface: Surface, hand: Hand, grasp: Grasps, direction: Direction, table: float | None = None) -> bytes:
    """Draw the first row's hand on the estimated surface."""
    joints = hand.expand_joints(grasp.joints[0].double())
    solids = solids_from_hand(hand, joints, hand.tree.joint_names, grasp.obj_from_hand[0])
    vertices = to_array(surface.vertices)
    canvas = Canvas()
    canvas.add_mesh(vertices, surface.faces.cpu().numpy(), OBJECT, to_array(surface.normals))
    add_contacts(canvas, grasp.contacts)
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, solid.color, solid.normals)
    corners = np.concatenate([vertices, *(s.vertices for s in solids)])
    canvas.add_table(corners, table)
    return canvas.render_png(corners, direction)


def draw_tick(mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult, tick: int, direction: Direction) -> bytes:
    """Draw the true object and the hand at the first (0) or the last (-1) tick; both pictures share their frame."""
    local = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    places = {t: apply(closure.object_pose[t].double(), local).numpy() for t in (0, -1)}
    names = closure.joint_names
    postures = {t: solids_from_hand(hand, closure.joints[t], names, closure.hand_pose[t]) for t in (0, -1)}
    canvas = Canvas()
    canvas.add_mesh(places[tick], np.asarray(mesh.faces), OBJECT)
    for solid in postures[tick]:
        canvas.add_mesh(solid.vertices, solid.faces, solid.color, solid.normals)
    corners = np.concatenate([*places.values(), *(s.vertices for solids in postures.values() for s in solids)])
    canvas.add_table(corners, float(places[0][:, 2].min()))
    return canvas.render_png(corners, direction)


def plot_forces(closure: ClosureResult, finger_names: tuple[str, ...]) -> bytes:
    """Plot the normal force of each fingertip [N] over time [s]."""
    time = closure.time.cpu().numpy()
    figure, axes = _figure()
    for forces, name, color in zip(closure.forces.T.cpu().numpy(), finger_names, FINGERS, strict=False):
        axes.plot(time, forces, color=color, linewidth=1.6, label=name)
    axes.set_ylabel("normal force [N]")
    axes.set_ylim(0.0, max(1.0, 1.15 * float(closure.forces.max())))
    axes.legend(frameon=False, ncols=len(finger_names), loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
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


def view_of(cloud: PointCloud) -> Direction:
    """Return the direction from a cloud to its camera, if known."""
    first = cloud.split_views()[0].viewpoint
    if first is None:
        return (1.0, -0.8, 0.6)
    x, y, z = (first - cloud.points.mean(0)).tolist()
    return (x, y, z)


def facing(grasp: Grasps) -> Direction:
    """Return a direction across the first row's horizontal pressing, away from the palm: it shows all fingers."""
    normals = grasp.contacts.normals[0, :, :2].detach().cpu().double()
    press = torch.linalg.eigh(normals.T @ normals).eigenvectors[:, 1]
    across = torch.stack([-press[1], press[0]])
    from_palm = grasp.contacts.points[0].mean(0).cpu().double() - grasp.obj_from_hand[0, :3, 3].cpu().double()
    x, y = (across if float(across @ from_palm[:2]) >= 0.0 else -across).tolist()
    return (x, y, 0.4)


def rotated(direction: Direction, degrees: float) -> Direction:
    """Return a direction rotated about z.

    >>> [round(x, 3) for x in rotated((1.0, 0.0, 0.5), 90.0)]
    [0.0, 1.0, 0.5]
    """
    x, y, z = direction
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return (float(c * x - s * y), float(s * x + c * y), z)


def to_array(value: Float[Tensor, "*b"]) -> np.ndarray:
    """Return a tensor as an array of doubles."""
    return value.detach().cpu().double().numpy()
