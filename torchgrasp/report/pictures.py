"""Stills of a run as the bytes of PNG files; lengths in metres, z up."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import apply
from torchgrasp.hand.hand import Hand
from torchgrasp.report.canvas import Canvas
from torchgrasp.report.palette import FINGERS, HAND, OBJECT, TABLE
from torchgrasp.report.solids import PARKED, Solid, solids_from_hand
from torchgrasp.shape.surface import Surface
from torchgrasp.values import ClosureResult, Contacts, Grasps, PointCloud

if TYPE_CHECKING:
    import trimesh

Direction = tuple[float, float, float]

MOST_POINTS = 3000
"""How many points of a cloud are drawn."""


def draw_cloud(cloud: PointCloud, table: float | None = None) -> bytes:
    """Draw the points that the camera saw, from where it saw them, coloured by height."""
    points = _array(cloud.points)
    points = points[:: -(-len(points) // MOST_POINTS)]
    canvas = Canvas()
    canvas.add_points(points, points[:, 2], "cividis")
    _add_table(canvas, points, table)
    return canvas.render_png(points, view_of(cloud))


def draw_surface(surface: Surface, direction: Direction, table: float | None = None) -> bytes:
    """Draw the estimated surface, coloured by its standard deviation [mm]."""
    vertices, std_mm = _array(surface.vertices), 1e3 * _array(surface.std_m)
    most = max(float(np.quantile(std_mm, 0.99)), 1e-3)
    canvas = Canvas()
    canvas.add_values(vertices, surface.faces.cpu().numpy(), _array(surface.normals), std_mm, most, "viridis")
    _add_table(canvas, vertices, table)
    return canvas.render_png(vertices, direction, bar=("standard deviation of the surface [mm]", most, "viridis"))


def draw_contacts(surface: Surface, contacts: Contacts, direction: Direction, table: float | None = None) -> bytes:
    """Draw the three contacts of the first row and their outward normals on the estimated surface."""
    vertices = _array(surface.vertices)
    canvas = Canvas()
    canvas.add_mesh(vertices, surface.faces.cpu().numpy(), OBJECT, _array(surface.normals), transparent=True)
    _add_contacts(canvas, contacts)
    _add_table(canvas, vertices, table)
    return canvas.render_png(vertices, direction)


def draw_grasp(surface: Surface, hand: Hand, grasp: Grasps, direction: Direction, table: float | None = None) -> bytes:
    """Draw the hand of the first row on the estimated surface, one colour a finger."""
    joints = hand.expand_joints(grasp.joints[0].double())
    solids = solids_from_hand(hand, joints, hand.tree.joint_names, grasp.obj_from_hand[0])
    vertices = _array(surface.vertices)
    canvas = Canvas()
    canvas.add_mesh(vertices, surface.faces.cpu().numpy(), OBJECT, _array(surface.normals))
    _add_contacts(canvas, grasp.contacts)
    _add_solids(canvas, solids)
    corners = np.concatenate([vertices, *(s.vertices for s in solids)])
    _add_table(canvas, corners, table)
    return canvas.render_png(corners, direction)


def draw_tick(
    mesh: "trimesh.Trimesh",
    hand: Hand,
    closure: ClosureResult,
    tick: int,
    direction: Direction,
    ticks: Sequence[int] = (0, -1),
) -> bytes:
    """Draw the true object and the hand at one tick of a closure, framed so that the pictures of `ticks` match.

    Args:
        mesh: the true object [m].
        hand: the hand that closed.
        closure: the record of the trial.
        tick: which tick; negative counts from the end.
        direction: from where it is seen.
        ticks: all ticks that share the frame.
    """
    local = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    places = {t: apply(closure.object_pose[t].double(), local).numpy() for t in (tick, *ticks)}
    postures = {
        t: solids_from_hand(hand, closure.joints[t], closure.joint_names, closure.hand_pose[t]) for t in (tick, *ticks)
    }
    canvas = Canvas()
    canvas.add_mesh(places[tick], np.asarray(mesh.faces), OBJECT)
    _add_solids(canvas, postures[tick])
    corners = np.concatenate([*places.values(), *(s.vertices for solids in postures.values() for s in solids)])
    _add_table(canvas, corners, float(places[ticks[0]][:, 2].min()))
    return canvas.render_png(corners, direction)


def view_of(cloud: PointCloud) -> Direction:
    """Return the direction from the cloud to its camera, or a default that looks down from the front."""
    first = cloud.split_views()[0].viewpoint
    if first is None:
        return (1.0, -0.8, 0.6)
    x, y, z = (first - cloud.points.mean(0)).tolist()
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


def _array(value: Float[Tensor, "*b"]) -> np.ndarray:
    """Return a tensor as an array of doubles."""
    return value.detach().cpu().double().numpy()


def _add_solids(canvas: Canvas, solids: Sequence[Solid]) -> None:
    """Add the hand's solids, one colour a finger."""
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, HAND if solid.finger == PARKED else FINGERS[solid.finger])


def _add_contacts(canvas: Canvas, contacts: Contacts) -> None:
    """Add the contacts of the first row as balls with arrows along the outward normals."""
    from trimesh import creation
    from trimesh.geometry import align_vectors

    ball = creation.icosphere(subdivisions=2, radius=0.004)
    shaft = creation.cylinder(0.0013, segment=[(0.0, 0.0, 0.0), (0.0, 0.0, 0.034)], sections=20)
    head = creation.cone(0.0034, 0.012, sections=24).apply_translation((0.0, 0.0, 0.033))
    for color, point, normal in zip(FINGERS, _array(contacts.points[0]), _array(contacts.normals[0]), strict=True):
        turn = np.asarray(align_vectors((0.0, 0.0, 1.0), normal))[:3, :3]
        for part in (ball, shaft, head):
            canvas.add_mesh(part.vertices @ turn.T + point, np.asarray(part.faces), color)


def _add_table(canvas: Canvas, corners: np.ndarray, table: float | None) -> None:
    """Add a round table top under what is drawn."""
    if table is None:
        return
    x, y = (corners[:, :2].min(0) + corners[:, :2].max(0)) / 2
    radius = 0.55 * float(np.linalg.norm(np.ptp(corners[:, :2], axis=0))) + 0.02
    canvas.add_disc((float(x), float(y), table - 1e-3), radius, TABLE)
