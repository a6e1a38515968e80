"""Stills of a run, drawn off-screen with pyvista and returned as the bytes of PNG files; lengths in metres, z up."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import apply
from torchgrasp.hand.hand import Hand
from torchgrasp.report.solids import PARKED, solids_from_hand
from torchgrasp.shape.surface import Surface
from torchgrasp.values import ClosureResult, Contacts, Grasps, PointCloud

FINGERS = ("#2f6db5", "#23967f", "#e0762f")
"""Colours of the three fingers, in grasp order; plots and pictures share them."""

HAND = "#a9b0ba"
"""Colour of the palm and of parked fingers."""

OBJECT = "#e6d3ad"
"""Colour of the object."""

TABLE = "#eceae4"
"""Colour of the table."""

INK = "#22262b"
"""Colour of lines and letters."""

VIEW_ANGLE = 24.0
"""Vertical angle of view of the camera [deg]."""

SIZE = (900, 720)
"""Width and height of a still [pixels]."""

Direction = tuple[float, float, float]


def draw_cloud(cloud: PointCloud, table: float | None = None) -> bytes:
    """Draw the points that the camera saw, from where it saw them, coloured by height."""
    points = cloud.points.detach().cpu().double().numpy()
    with _canvas() as canvas:
        cells = canvas.add_points(points, scalars=points[:, 2], cmap="cividis", point_size=16, show_scalar_bar=False)
        cells.prop.render_points_as_spheres = True
        _add_table(canvas, points, table)
        return _shoot(canvas, points, view_of(cloud))


def draw_surface(surface: Surface, direction: Direction, table: float | None = None) -> bytes:
    """Draw the estimated surface, coloured by its standard deviation [mm]."""
    vertices, mesh = _mesh(surface.vertices, surface.faces)
    std_mm = 1e3 * surface.std_m.detach().cpu().double().numpy()
    with _canvas() as canvas:
        bar = {"title": " ", "color": INK, "label_font_size": 20, "n_labels": 4, "fmt": "%.1f"}
        bar |= {"width": 0.56, "height": 0.07, "position_x": 0.22, "position_y": 0.015}
        text = "standard deviation of the surface [mm]"
        canvas.add_text(text, position=(0.27, 0.1), color=INK, viewport=True, font_size=11)
        limits = (0.0, max(float(np.quantile(std_mm, 0.99)), 1e-3))
        canvas.add_mesh(mesh, scalars=std_mm, cmap="viridis", clim=limits, smooth_shading=True, scalar_bar_args=bar)
        _add_table(canvas, vertices, table)
        return _shoot(canvas, vertices, direction, drop=0.035)


def draw_contacts(surface: Surface, contacts: Contacts, direction: Direction, table: float | None = None) -> bytes:
    """Draw the three contacts of the first row and their outward normals on the estimated surface."""
    vertices, mesh = _mesh(surface.vertices, surface.faces)
    with _canvas() as canvas:
        canvas.add_mesh(mesh, color=OBJECT, smooth_shading=True, opacity=0.55)
        _add_contacts(canvas, contacts)
        _add_table(canvas, vertices, table)
        return _shoot(canvas, vertices, direction)


def draw_grasp(surface: Surface, hand: Hand, grasp: Grasps, direction: Direction, table: float | None = None) -> bytes:
    """Draw the hand of the first row on the estimated surface, one colour a finger."""
    vertices, mesh = _mesh(surface.vertices, surface.faces)
    joints = hand.expand_joints(grasp.joints[0].double())
    solids = solids_from_hand(hand, joints, hand.urdf_joint_names, grasp.obj_from_hand[0])
    with _canvas() as canvas:
        canvas.add_mesh(mesh, color=OBJECT, smooth_shading=True)
        _add_contacts(canvas, grasp.contacts)
        corners = np.concatenate([vertices, _add_solids(canvas, solids)])
        _add_table(canvas, corners, table)
        return _shoot(canvas, corners, direction)


def draw_tick(
    mesh: Any, hand: Hand, closure: ClosureResult, tick: int, direction: Direction, ticks: Sequence[int] = (0, -1)
) -> bytes:
    """Draw the true object and the hand at one tick of a closure, framed so that the pictures of `ticks` match.

    Args:
        mesh: the true object, a trimesh [m].
        hand: the hand that closed.
        closure: the record of the trial.
        tick: which tick; negative counts from the end.
        direction: from where it is seen.
        ticks: all ticks that share the frame.
    """
    local = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    places = [apply(closure.object_pose[t].double(), local).numpy() for t in ticks]
    now, body = _mesh(apply(closure.object_pose[tick].double(), local), torch.from_numpy(np.array(mesh.faces)))
    table = float(apply(closure.object_pose[0].double(), local)[:, 2].min())
    solids = [solids_from_hand(hand, closure.joints[t], closure.joint_names, closure.hand_pose[t]) for t in ticks]
    mine = solids_from_hand(hand, closure.joints[tick], closure.joint_names, closure.hand_pose[tick])
    with _canvas() as canvas:
        canvas.add_mesh(body, color=OBJECT, smooth_shading=True, split_sharp_edges=True, feature_angle=40)
        _add_solids(canvas, mine)
        corners = np.concatenate([now, *places, *(s.vertices for posture in solids for s in posture)])
        _add_table(canvas, corners, table)
        return _shoot(canvas, corners, direction)


def view_of(cloud: PointCloud) -> Direction:
    """Return the direction from the cloud to its camera, or a default that looks down from the front."""
    if cloud.viewpoint is None:
        return (1.0, -0.8, 0.6)
    x, y, z = (cloud.viewpoint - cloud.points.mean(0)).tolist()
    return (x, y, z)


def facing(grasp: Grasps) -> Direction:
    """Return a direction from which the first row shows its fingers on both sides of the object, not behind the palm.

    It is square to the horizontal direction along which the contacts press, on the side away from the palm.
    """
    normals = grasp.contacts.normals[0, :, :2].detach().cpu().double()
    press = torch.linalg.eigh(normals.T @ normals).eigenvectors[:, 1]
    across = torch.stack([-press[1], press[0]])
    from_palm = grasp.contacts.points[0].mean(0).cpu().double() - grasp.obj_from_hand[0, :3, 3].cpu().double()
    x, y = (across if float(across @ from_palm[:2]) >= 0.0 else -across).tolist()
    return (x, y, 0.4)


def turned(direction: Direction, degrees: float) -> Direction:
    """Return a direction turned about z.

    >>> [round(x, 3) for x in turned((1.0, 0.0, 0.5), 90.0)]
    [0.0, 1.0, 0.5]
    """
    x, y, z = direction
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return (float(c * x - s * y), float(s * x + c * y), z)


@contextlib.contextmanager
def _canvas() -> Iterator[Any]:
    """Open an off-screen plotter on a light background and close it again; VTK's words about a missing screen are lost.

    Without a screen VTK falls back to software and says so on the file descriptor of stderr.
    """
    with _quiet():
        import pyvista

        canvas: Any = pyvista.Plotter(off_screen=True, window_size=list(SIZE), lighting="three lights")
        canvas.set_background("#fcfcfa")
        try:
            yield canvas
        finally:
            canvas.close()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Send what C++ code writes to stderr to nowhere."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _mesh(vertices: Float[Tensor, "v 3"], faces: Tensor) -> tuple[np.ndarray, Any]:
    """Return the vertices and a pyvista mesh."""
    import pyvista

    corners = vertices.detach().cpu().double().numpy()
    return corners, pyvista.make_tri_mesh(corners, faces.cpu().numpy())


def _add_solids(canvas: Any, solids: Sequence[Any]) -> np.ndarray:
    """Add the hand's solids, one colour a finger; return their corners."""
    import pyvista

    for solid in solids:
        color = HAND if solid.finger == PARKED else FINGERS[solid.finger]
        mesh = pyvista.make_tri_mesh(solid.vertices, solid.faces)
        canvas.add_mesh(mesh, color=color, smooth_shading=True, split_sharp_edges=True, feature_angle=35)
    return np.concatenate([s.vertices for s in solids])


def _add_contacts(canvas: Any, contacts: Contacts) -> None:
    """Add the contacts of the first row as balls with arrows along the outward normals."""
    import pyvista

    points = contacts.points[0].detach().cpu().double().numpy()
    normals = contacts.normals[0].detach().cpu().double().numpy()
    for color, point, normal in zip(FINGERS, points, normals, strict=True):
        canvas.add_mesh(pyvista.Sphere(radius=0.004, center=point), color=color, smooth_shading=True)
        arrow = pyvista.Arrow(
            start=point, direction=normal, tip_length=0.3, tip_radius=0.07, shaft_radius=0.028, scale=0.045
        )
        canvas.add_mesh(arrow, color=color, smooth_shading=True)


def _add_table(canvas: Any, corners: np.ndarray, table: float | None) -> None:
    """Add a round table top under what is drawn."""
    import pyvista

    if table is None:
        return
    center = (corners.min(0) + corners.max(0)) / 2
    radius = 0.55 * float(np.linalg.norm(np.ptp(corners[:, :2], axis=0))) + 0.02
    middle = (center[0], center[1], table - 1e-3)
    top = pyvista.Disc(center=middle, inner=0.0, outer=radius, normal=(0, 0, 1), c_res=96)
    canvas.add_mesh(top, color=TABLE, lighting=False)


def _shoot(canvas: Any, corners: np.ndarray, direction: Direction, drop: float = 0.0) -> bytes:
    """Frame `corners` from a direction, slightly from above, and return the PNG; `drop` leaves room at the bottom."""
    from PIL import Image

    x, y, z = direction
    flat = float(np.hypot(x, y))
    if flat < 1e-9:
        x, y, flat = 1.0, -0.8, float(np.hypot(1.0, -0.8))
    # A camera that looks straight down, or up from below the table, shows little: keep 15 to 40 degrees of height.
    ahead = np.array([x, y, np.clip(z, 0.27 * flat, 0.84 * flat)])
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0.0, 0.0, 1.0], ahead)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(ahead, right), ahead])
    seen = corners @ frame.T
    middle, half = (seen.min(0) + seen.max(0)) / 2, np.ptp(seen, axis=0) / 2
    # The nearest corners look largest, so the distance is counted from them.
    reach = max(half[1], half[0] * SIZE[1] / SIZE[0]) / np.tan(np.deg2rad(VIEW_ANGLE / 2))
    center = middle @ frame
    canvas.camera.position = center + ahead * (half[2] + 1.12 * reach)
    canvas.camera.focal_point = center - frame[1] * drop * reach
    canvas.camera.up = (0.0, 0.0, 1.0)
    canvas.camera.view_angle = VIEW_ANGLE
    canvas.reset_camera_clipping_range()
    canvas.enable_anti_aliasing("ssaa")
    pixels = canvas.screenshot(None, return_img=True)
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(pixels)).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
