"""One picture of a hand: pads, the palm's frame, joint limits."""

import io
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.canvas import Canvas, Direction
from torchgrasp.app.report.palette import AXES, FINGERS, GRID, HAND, INK, PAPER
from torchgrasp.app.report.pictures import rotated
from torchgrasp.app.report.solids import PARKED, finger_of_links, solids_from_hand
from torchgrasp.geometry.linalg import unit
from torchgrasp.hand.hand import Hand

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont, ImageFont

TILE = (675, 540)
"""Width and height of one of the four views [pixels]."""
BAR = 30
"""Height of the line of one joint [pixels]: room for its name."""
NORMAL = 0.03
"""Length of the arrows along the pads' normals [m], about a fingertip's."""
FRAME = 0.6
"""Length of the palm's axes over the palm's diagonal: they reach out of it."""


def opposed_posture(hand: Hand, joints: Float[Tensor, "n h"]) -> Float[Tensor, "h"]:
    """Return the posture, free of self-collision if any is, whose pads best face their middle."""
    points, normals = hand.fingertips(joints)
    inward = points.mean(1, keepdim=True) - points
    facing = (normals * unit(inward)).sum(-1).amin(1) - 10.0 * torch.linalg.vector_norm(inward, dim=-1).amax(1)
    return joints[(facing + (hand.self_clearance(joints) > 0).to(facing) * 10.0).argmax()]


def draw_hand(hand: Hand, joints: Float[Tensor, "h"]) -> bytes:
    """Draw a hand at a posture from two sides, at both ends of its limits, and the limits; return a PNG.

    An arrow on each fingertip is its normal. The palm's x, y and z are red, green and blue.
    """
    from PIL import Image, ImageDraw, ImageFont

    font, eye = ImageFont.load_default(20), (1.0, -0.9, 0.5)
    views = [
        ("a posture with the pads face to face", joints, eye),
        ("the same from another side", joints, rotated(eye, 110.0)),
        ("every joint at its lower limit", hand.lower.to(joints), eye),
        ("every joint at its upper limit", hand.upper.to(joints), eye),
    ]
    width, height = TILE
    sheet = Image.new("RGB", (2 * width, 2 * height + BAR * (hand.dof + 2)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for k, (title, posture, direction) in enumerate(views):
        picture = Image.open(io.BytesIO(draw_posture(hand, posture, direction)))
        x, y = k % 2 * width, k // 2 * height
        sheet.paste(picture.resize(TILE, Image.Resampling.LANCZOS), (x, y))
        pen.text((x + 16, y + 12), title, INK, font)
    _draw_limits(pen, font, hand, joints, 2 * height + BAR // 2)
    buffer = io.BytesIO()
    sheet.save(buffer, format="PNG")
    return buffer.getvalue()


def draw_posture(hand: Hand, joints: Float[Tensor, "h"], eye: Direction) -> bytes:
    """Draw the hand in the palm's frame as a PNG."""
    solids = solids_from_hand(hand, hand.expand_joints(joints), hand.tree.joint_names, torch.eye(4).to(joints))
    points, normals = (x.cpu().numpy() for x in hand.fingertips(joints[None].double()))
    canvas = Canvas()
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, solid.color, solid.normals)
    canvas.add_arrows(points[0], normals[0], NORMAL, FINGERS[: len(hand.tips)])
    frame = FRAME * float(np.linalg.norm(np.ptp(solids[0].vertices, axis=0)))
    canvas.add_arrows(np.zeros((3, 3)), np.eye(3), frame, AXES)
    corners = [points[0], points[0] + NORMAL * normals[0], frame * np.eye(3), *(s.vertices for s in solids)]
    return canvas.render_png(np.concatenate(corners), eye)


def _draw_limits(
    pen: "ImageDraw", font: "ImageFont | FreeTypeFont", hand: Hand, joints: Float[Tensor, "h"], top: int
) -> None:
    """Draw the range of each joint in degrees, with the posture as a mark."""
    low, high = float(hand.lower.min()), float(hand.upper.max())
    left, right = 380, 2 * TILE[0] - 260
    pen.text((16, top), "joint [degrees], the posture as a mark", INK, font)
    finger_of_link = finger_of_links(hand)
    finger_of_joint = [finger_of_link[hand.tree.link_names[k]] for k in hand.tree.child.tolist()]
    for k, (name, moves) in enumerate(zip(hand.joint_names, hand.actuated.coupling.T, strict=True)):
        moved = {finger_of_joint[j] for j in torch.nonzero(moves)[:, 0].tolist()}
        finger = moved.pop() if len(moved) == 1 else PARKED  # that of no finger moves several
        y, ends = top + BAR * (k + 1), [float(hand.lower[k]), float(hand.upper[k])]
        first, last, at = (left + (right - left) * (q - low) / (high - low) for q in (*ends, float(joints[k])))
        pen.text((16, y), name[:34], INK, font)
        pen.line([(left, y + 12), (right, y + 12)], GRID, 1)
        pen.rounded_rectangle([first, y + 6, last, y + 18], 5, HAND if finger == PARKED else FINGERS[finger])
        pen.line([(at, y), (at, y + 24)], INK, 3)
        pen.text((right + 20, y), " to ".join(f"{np.rad2deg(e):.0f}" for e in ends), INK, font)
