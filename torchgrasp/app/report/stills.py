"""Pictures as PNGs: of a cloud, an estimated surface, contacts, a grasp, a scene and a hand.

A direction (x, y, z) points from what is shown to the camera; its length does not matter. All
pictures but those of a hand alone are in a frame where z is up.
"""

import dataclasses
import io

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report import canvas as paint
from torchgrasp.app.report.raster import Direction
from torchgrasp.app.report.solids import PARKED, Solid, finger_of_links, solids_from_hand
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.lazy import Image
from torchgrasp.geometry.frames import to_array
from torchgrasp.geometry.linalg import dot, norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.surface import Surface
from torchgrasp.values.planning import Contacts, Grasps, PointCloud


@dataclasses.dataclass(frozen=True)
class StillLayout:
    """Limits and sizes of what stills show."""

    # greatest number of points of a cloud that are drawn: more would hide each other
    most_points: int = 3000
    # least divisor [m] of the heights that give colours: a flat cloud has one colour
    least_height: float = 1e-12
    most_others: int = 4000  # greatest number of points of all neighbours that are drawn
    contact_arrow: float = 0.045  # length of an arrow at a contact [m]: about a fingertip
    tip_arrow: float = 0.03  # length of the arrow at a pad of a hand without grasp [m]
    palm_axis: float = 0.6  # length of the axes, as a share of the diagonal of the palm
    unknown_view: Direction = (1.0, -0.8, 0.6)  # direction to the viewer if the camera is unknown
    grasp_rise: float = 0.4  # rise of the view of a grasp, for each metre along the ground


@dataclasses.dataclass(frozen=True)
class HandSheet:
    """Layout of the picture of a hand: four stills, and below them the ranges of the joints."""

    eye: Direction = (1.0, -0.9, 0.5)  # direction to the camera, in the hand's frame
    aside: float = 110.0  # rotation of the direction to the camera in the second view [degrees]
    width: float = 13.5  # width of the picture [inches]
    height: float = 10.8  # height of the stills [inches]
    row: float = 0.3  # height for each joint [inches]
    dpi: int = 100  # resolution [pixels per inch]
    font: int = 14  # size of the titles [points]
    bar: float = 0.4  # height of the bar of a joint, in rows
    margin: float = 0.02  # margin beside the widest range, as a share of it
    mark: int = 16  # length of the mark of the posture [points]
    mark_width: int = 3  # width of this mark [points]


STILLS = StillLayout()
SHEET = HandSheet()
APART = 10.0  # facing pads that is worth 0.1 m less between the tips and their middle
FREE = 10.0  # a posture without collision is better than any with one


def draw_cloud(cloud: PointCloud, table: Plane | float | None = None) -> bytes:
    """Return the bytes of a PNG of a cloud as its camera sees it, coloured by height.

    The cloud is in a frame where z is up. `table` is the level table in this frame, or its height z
    [m]; None means no table.
    """
    points = _thinned(to_array(cloud.points), STILLS.most_points)
    height = points[:, 2] - points[:, 2].min()
    share = height / max(float(height.max()), STILLS.least_height)
    canvas = paint.Canvas()
    canvas.add_points(points, paint.map_colors(share, "cividis"))
    canvas.add_table(points, table)
    return canvas.render_png(points, view_of(cloud))


def draw_surface(
    surface: Surface, direction: Direction, table: Plane | float | None = None
) -> bytes:
    """Return the bytes of a PNG of the estimated surface, coloured by its standard deviation [mm].

    The surface is in a frame where z is up. `direction` (x, y, z), of any length, points to the
    camera. `table` is the level table, or its height z [m]; None means no table.
    """
    vertices, faces, normals = mesh_arrays(surface)
    colors, most = paint.color_std(surface)
    canvas = paint.Canvas()
    canvas.add_mesh(vertices, faces, colors, normals)
    canvas.add_table(vertices, table)
    bar = "standard deviation of the surface [mm]", 1e3 * most, "viridis"
    return canvas.render_png(vertices, direction, bar=bar)


def draw_contacts(
    surface: Surface, contacts: Contacts, direction: Direction, table: Plane | float | None = None
) -> bytes:
    """Return the bytes of a PNG of the contacts of the first grasp, with normals, on the estimated
    surface.

    All are in one frame where z is up. `direction` (x, y, z), of any length, points to the camera.
    `table` is the level table, or its height z [m]; None means no table.
    """
    canvas = paint.Canvas()
    vertices = _add_object(canvas, surface, transparent=True)
    ends = _add_contacts(canvas, contacts)
    canvas.add_table(vertices, table)
    return canvas.render_png(np.concatenate([vertices, ends]), direction)


def draw_grasp(
    surface: Surface | None,
    hand: Hand,
    grasp: Grasps,
    direction: Direction,
    table: Plane | float | None = None,
) -> bytes:
    """Return the bytes of a PNG of the hand at the first grasp on the estimated surface, with its
    contacts.

    All are in one frame where z is up. A `surface` of None shows only hand and contacts.
    `direction` (x, y, z), of any length, points to the camera. `table` is the level table, or its
    height z [m]; None means no table.
    """
    canvas, corners = _grasp(surface, hand, grasp)
    canvas.add_table(corners, table)
    return canvas.render_png(corners, direction)


def draw_among(
    scene: Scene, surface: Surface, hand: Hand, grasp: Grasps, direction: Direction
) -> bytes:
    """Return the bytes of a PNG of the hand at the first grasp on its object, among other objects.

    The grasped object is shown by its estimated `surface`, the others by their measured points. All
    are in one frame where z is up, with the table at z = 0. `direction` (x, y, z), of any length,
    points to the camera.
    """
    canvas, corners = _grasp(surface, hand, grasp)
    others = (scene.labels > 0) & ~scene.rows_of()
    points = to_array(scene.points[others])
    labels = scene.labels[others].cpu().numpy()
    corners = np.concatenate([corners, points])
    if len(points):
        palette = np.stack([paint.rgb(name) for name in paint.OBJECTS])
        colors = palette[(labels - 1) % len(palette)]
        most = STILLS.most_others
        canvas.add_points(_thinned(points, most), _thinned(colors, most))
    canvas.add_table(corners, None if scene.table is None else 0.0)
    return canvas.render_png(corners, direction)


def draw_hand(hand: Hand, joints: Float[Tensor, "h"]) -> bytes:
    """Return the bytes of a PNG of a hand at a posture and at its joint limits, with all ranges.

    `joints` (h,) [rad] is the posture of the h actuated joints. Arrows show the normals of the
    fingertip pads and the axes of the hand's frame.
    """
    from matplotlib.figure import Figure

    views = [
        ("a posture with the pads face to face", joints, SHEET.eye),
        ("the same from another side", joints, rotated(SHEET.eye, SHEET.aside)),
        ("every joint at its lower limit", hand.lower.to(joints), SHEET.eye),
        ("every joint at its upper limit", hand.upper.to(joints), SHEET.eye),
    ]
    bars = SHEET.row * (hand.dof + 2)  # height of the ranges with their title [inches]
    size = SHEET.width, SHEET.height + bars
    figure = Figure(size, dpi=SHEET.dpi, facecolor=paint.PAPER, layout="constrained")
    heights = SHEET.height, bars
    stills, ranges = figure.subfigures(2, 1, squeeze=False, height_ratios=heights).flat
    for axis, (title, posture, direction) in zip(stills.subplots(2, 2).flat, views, strict=True):
        axis.imshow(Image.open(io.BytesIO(draw_posture(hand, posture, direction))))
        axis.set_title(title, loc="left", color=paint.INK, fontsize=SHEET.font)
        axis.set_axis_off()
    low, high, at = (np.rad2deg(to_array(x)) for x in (hand.lower, hand.upper, joints))
    axis = ranges.subplots()
    axis.barh(hand.joint_names, high - low, SHEET.bar, low, color=_joint_colors(hand))
    axis.plot(
        at,
        hand.joint_names,
        "|",
        color=paint.INK,
        markersize=SHEET.mark,
        markeredgewidth=SHEET.mark_width,
    )
    axis.set_xlabel("ranges of the joints [degrees], the posture as a mark", color=paint.INK)
    axis.invert_yaxis()
    axis.grid(axis="x", color=paint.GRID)
    axis.use_sticky_edges = False  # else a bar's lower end gets no margin
    axis.margins(x=SHEET.margin)
    axis.set(axisbelow=True, facecolor=paint.PAPER)
    axis.spines[:].set_visible(False)
    return paint.encode_figure(figure)


def draw_posture(hand: Hand, joints: Float[Tensor, "h"], eye: Direction) -> bytes:
    """Return the bytes of a PNG of a hand at a posture, with fingertip normals and its axes.

    `joints` (h,) [rad] are the positions of the h actuated joints. `eye` (x, y, z), of any length,
    is the direction to the camera, in the hand's frame.
    """
    solids = solids_from_hand(
        hand, hand.expand_joints(joints), hand.tree.joint_names, torch.eye(4).to(joints)
    )
    points, normals = (x.cpu().numpy() for x in hand.fingertips(joints[None].double()))
    arrow = STILLS.tip_arrow
    axis = STILLS.palm_axis * float(np.linalg.norm(np.ptp(solids[0].vertices, axis=0)))
    canvas = paint.Canvas()
    add_solids(canvas, solids)
    canvas.add_arrows(points[0], normals[0], arrow, paint.FINGERS[: len(hand.tips)])
    canvas.add_arrows(np.zeros((3, 3)), np.eye(3), axis, paint.AXES)
    corners = [
        points[0],
        points[0] + arrow * normals[0],
        axis * np.eye(3),
        *(s.vertices for s in solids),
    ]
    return canvas.render_png(np.concatenate(corners), eye)


def opposed_posture(hand: Hand, joints: Float[Tensor, "n h"]) -> Float[Tensor, "h"]:
    """Return the posture (h,) in which the fingertip pads face each other best.

    It is one of the n postures `joints` (n, h) of the h actuated joints [rad]. It is one without
    self-collision if there is any. Best is the highest score: the cosine between the normal of the
    worst pad and the direction to the tips' centroid. From it, 1 is taken off for each 100 mm of
    the greatest distance of a tip from the centroid.
    """
    points, normals = hand.fingertips(joints)
    inward = points.mean(1, keepdim=True) - points
    # the worst finger counts: how well its pad faces the others, and how far away it is
    facing = dot(normals, unit(inward)).amin(1)
    apart = norm(inward).amax(1)
    score = facing - APART * apart
    free = hand.self_clearance(joints) > 0
    return joints[(score + free.to(score) * FREE).argmax()]


def view_of(cloud: PointCloud) -> Direction:
    """Return the vector (x, y, z) [m] from the centroid of a cloud to its first camera.

    If the camera is unknown, it is a fixed direction from the front, (1, -0.8, 0.6).
    """
    first = cloud.split_views()[0].viewpoint
    if first is None:
        return STILLS.unknown_view
    x, y, z = (first - cloud.points.mean(0)).tolist()
    return (x, y, z)


def facing(grasp: Grasps) -> Direction:
    """Return a direction (x, y, z) to a camera from which all fingers of the first grasp are
    visible.

    It is horizontally across the contact normals, raised by 0.4 (`STILLS.grasp_rise`) of its
    horizontal part. The grasp is in a frame where z is up.
    """
    normals = grasp.contacts.normals[0, :, :2].detach().cpu().double()
    press = torch.linalg.eigh(normals.T @ normals).eigenvectors[:, 1]
    across = torch.stack([-press[1], press[0]])
    middle = grasp.contacts.points[0].mean(0).cpu().double()
    from_palm = middle - grasp.obj_from_hand[0, :3, 3].cpu().double()
    # of both sides, the one on which the palm does not hide the contacts
    x, y = (across if float(across @ from_palm[:2]) >= 0.0 else -across).tolist()
    return (x, y, STILLS.grasp_rise)


def rotated(direction: Direction, degrees: float) -> Direction:
    """Return a direction (x, y, z), rotated about the z axis by an angle [degrees] from x to y."""
    x, y, z = direction
    c = np.cos(np.deg2rad(degrees))
    s = np.sin(np.deg2rad(degrees))
    return (float(c * x - s * y), float(s * x + c * y), z)


def mesh_arrays(surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices, faces and vertex normals of an estimated surface.

    Vertices (v, 3) are in metres, and normals (v, 3) are outward unit vectors. Faces (t, 3) hold
    indices of three vertices.
    """
    return to_array(surface.vertices), surface.faces.cpu().numpy(), to_array(surface.normals)


def _grasp(
    surface: Surface | None, hand: Hand, grasp: Grasps
) -> tuple[paint.Canvas, Float[np.ndarray, "n 3"]]:
    """Return a canvas with the surface and the first grasp's hand and contacts. Return also the
    points that must be in view.
    """
    joints = hand.expand_joints(grasp.joints[0].double())
    solids = solids_from_hand(hand, joints, hand.tree.joint_names, grasp.obj_from_hand[0])
    canvas = paint.Canvas()
    vertices = to_array(grasp.contacts.points[0])
    if surface is not None:
        vertices = _add_object(canvas, surface)
    _add_contacts(canvas, grasp.contacts)
    add_solids(canvas, solids)
    return canvas, np.concatenate([vertices, *(s.vertices for s in solids)])


def _add_object(
    canvas: paint.Canvas, surface: Surface, transparent: bool = False
) -> Float[np.ndarray, "n 3"]:
    """Add the estimated surface in the colour of an object; return its vertices."""
    vertices, faces, normals = mesh_arrays(surface)
    canvas.add_mesh(vertices, faces, paint.OBJECT, normals, transparent=transparent)
    return vertices


def _add_contacts(canvas: paint.Canvas, contacts: Contacts) -> Float[np.ndarray, "f 3"]:
    """Add an arrow along the normal of each contact of the first grasp, in the colour of its
    finger; return the ends of the arrows [m].
    """
    points = to_array(contacts.points[0])
    normals = to_array(contacts.normals[0])
    canvas.add_arrows(points, normals, STILLS.contact_arrow, paint.FINGERS[: len(points)])
    return points + STILLS.contact_arrow * normals


def add_solids(canvas: paint.Canvas, solids: list[Solid]) -> None:
    """Add the meshes of a hand's links to a canvas, each in the colour of its finger.

    The `solids` [m] must be in the frame of the canvas, not in those of their links.
    """
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, solid.color, solid.normals)


def _joint_colors(hand: Hand) -> list[str]:
    """Return the colour of each actuated joint: the colour of its finger, or the palm if it moves
    several fingers.
    """
    finger_of_link = finger_of_links(hand)
    finger_of_joint = [finger_of_link[hand.tree.link_names[k]] for k in hand.tree.child.tolist()]
    moved = [
        {finger_of_joint[j] for j in flatnonzero(row != 0).tolist()}
        for row in hand.actuated.coupling.T
    ]
    colors = {PARKED: paint.HAND, **dict(enumerate(paint.FINGERS))}
    return [colors[min(fingers)] if len(fingers) == 1 else paint.HAND for fingers in moved]


def _thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """Return every k-th row, with the least k that leaves at most `most` rows."""
    return rows[:: -(-len(rows) // most)]
