"""Pictures of a scene: what the camera saw of it, and the hand among its things."""

import io

import numpy as np
from jaxtyping import Float

from torchgrasp.app.report.canvas import Canvas, Direction
from torchgrasp.app.report.palette import OBJECT, TABLE, THINGS, rgb
from torchgrasp.app.report.pictures import add_contacts, to_array
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.surface import Surface
from torchgrasp.values import Grasps

POINTS = 4000
"""Points of the neighbours in a picture, at most: more would hide each other."""


def draw_depth(scene: Scene) -> bytes:
    """Draw the depth image, each thing in its colour; the target is the brightest, and unmeasured pixels are white."""
    from PIL import Image

    depth, labels = to_array(scene.image.depth), np.zeros(scene.image.depth.shape, dtype=int)
    row, column = scene.pixels.cpu().numpy().T
    labels[row, column] = scene.labels.cpu().numpy()
    seen = depth > 0
    near, far = np.quantile(depth[seen], [0.01, 0.99])
    light = 1.0 - 0.6 * np.clip((depth - near) / max(far - near, 1e-6), 0.0, 1.0)
    pixels = light[..., None] * _colors(labels)
    if scene.target is not None:
        others = (labels != scene.target)[..., None]
        pixels = np.where(others, 0.4 * pixels + 0.55, pixels)
    pixels[~seen] = 1.0
    buffer = io.BytesIO()
    Image.fromarray(np.uint8(255 * np.clip(pixels, 0.0, 1.0))).save(buffer, format="PNG")
    return buffer.getvalue()


def draw_among(scene: Scene, surface: Surface, hand: Hand, grasp: Grasps, direction: Direction) -> bytes:
    """Draw the first row's hand on the target's estimated surface, among the measured points of the other things.

    All is in an upright frame.
    """
    joints = hand.expand_joints(grasp.joints[0].double())
    solids = solids_from_hand(hand, joints, hand.tree.joint_names, grasp.obj_from_hand[0])
    vertices, canvas = to_array(surface.vertices), Canvas()
    canvas.add_mesh(vertices, surface.faces.cpu().numpy(), OBJECT, to_array(surface.normals))
    add_contacts(canvas, grasp.contacts)
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, solid.color, solid.normals)
    others = (scene.labels > 0) & ~scene.rows_of()
    points, labels = to_array(scene.points[others]), scene.labels[others].cpu().numpy()
    corners = np.concatenate([vertices, points, *(s.vertices for s in solids)])
    if len(points):
        rows = slice(None, None, -(-len(points) // POINTS))
        canvas.add_points(points[rows], _colors(labels[rows]))
    canvas.add_table(corners, None if scene.table is None else 0.0)
    return canvas.render_png(corners, direction)


def _colors(labels: np.ndarray) -> Float[np.ndarray, "*b 3"]:
    """Return the colour of each label; the table has its own."""
    palette = np.stack([rgb(name) for name in (TABLE, *THINGS)])
    return palette[np.where(labels > 0, 1 + (labels - 1) % len(THINGS), 0)]
