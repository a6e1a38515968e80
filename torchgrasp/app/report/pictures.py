"""Stills of a run as PNGs."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.canvas import Canvas, Direction, map_colors
from torchgrasp.app.report.palette import FINGERS, OBJECT
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.shape.surface import Surface
from torchgrasp.values import Contacts, Grasps, PointCloud

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
