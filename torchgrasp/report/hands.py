"""One picture of a hand: pads, the frame of the palm, and the limits of its joints."""

import io
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.hand import Hand
from torchgrasp.linalg import unit
from torchgrasp.report.canvas import SIZE, Canvas
from torchgrasp.report.palette import AXES, FINGERS, GRID, HAND, INK, PAPER
from torchgrasp.report.pictures import Direction, turned
from torchgrasp.report.solids import PARKED, finger_of_links, solids_from_hand

TILE = (SIZE[0] * 3 // 4, SIZE[1] * 3 // 4)
"""Width and height of one of the four views [pixels]."""
BAR = 30
"""Height of the line of one joint [pixels]."""
NORMAL = 0.03
"""Length of the pads' normals [m]."""
FRAME = 0.6
"""Length of the palm's axes over the diagonal of the palm: they reach out of it."""
EYE = (1.0, -0.9, 0.5)
"""From where the hand is seen."""


def opposed_posture(hand: Hand, joints: Float[Tensor, "n h"]) -> Float[Tensor, "h"]:
    """Return the posture, of those free of self-collision, whose pads face the middle of the fingertips most.

    Args:
        hand: the hand.
        joints: postures; where none is free, all of them compete.
    """
    points, normals = hand.fingertips(joints)
    toward = points.mean(1, keepdim=True) - points
    facing = (normals * unit(toward)).sum(-1).amin(1) - 10.0 * torch.linalg.vector_norm(toward, dim=-1).amax(1)
    return joints[(facing + (hand.self_clearance(joints) > 0).to(facing) * 10.0).argmax()]


def draw_hand(hand: Hand, joints: Float[Tensor, "h"]) -> bytes:
    """Draw a hand at a posture from two sides and at both ends of its limits, and under it the limits; return a PNG.

    An arrow on each fingertip is its contact with the pad's normal; red, green and blue are x, y and z of the palm.
    """
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(20)
    views = [
        ("a posture with the pads face to face", joints, EYE),
        ("the same from another side", joints, turned(EYE, 110.0)),
        ("every joint at its lower limit", hand.lower.to(joints), EYE),
        ("every joint at its upper limit", hand.upper.to(joints), EYE),
    ]
    width, height = TILE
    sheet = Image.new("RGB", (2 * width, 2 * height + BAR * (hand.dof + 2)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for k, (title, posture, eye) in enumerate(views):
        picture = Image.open(io.BytesIO(draw_posture(hand, posture, eye)))
        corner = (k % 2 * width, k // 2 * height)
        sheet.paste(picture.resize(TILE, Image.Resampling.LANCZOS), corner)
        pen.text((corner[0] + 16, corner[1] + 12), title, INK, font)
    _draw_limits(pen, hand, joints, 2 * height + BAR // 2, font)
    buffer = io.BytesIO()
    sheet.save(buffer, format="PNG")
    return buffer.getvalue()


def draw_posture(hand: Hand, joints: Float[Tensor, "h"], eye: Direction) -> bytes:
    """Draw the hand in the frame of its palm, with its pads and that frame, as a PNG."""
    solids = solids_from_hand(hand, hand.expand_joints(joints), hand.tree.joint_names, torch.eye(4).to(joints))
    points, normals = (x.cpu().numpy() for x in hand.fingertips(joints[None].double()))
    canvas = Canvas()
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, HAND if solid.finger == PARKED else FINGERS[solid.finger])
    for color, point, normal in zip(FINGERS, points[0], normals[0], strict=True):
        canvas.add_arrows(point[None], normal[None], NORMAL, color)
    frame = FRAME * float(np.linalg.norm(np.ptp(solids[0].vertices, axis=0)))
    for color, axis in zip(AXES, np.eye(3), strict=True):
        canvas.add_arrows(np.zeros((1, 3)), axis[None], frame, color)
    corners = [points[0], points[0] + NORMAL * normals[0], frame * np.eye(3), *(s.vertices for s in solids)]
    return canvas.render_png(np.concatenate(corners), eye)


def _draw_limits(pen: object, hand: Hand, joints: Float[Tensor, "h"], top: int, font: object) -> None:
    """Draw the range of each joint in degrees on one scale, with the posture as a mark."""
    from PIL import ImageDraw, ImageFont

    assert isinstance(pen, ImageDraw.ImageDraw)
    assert isinstance(font, ImageFont.ImageFont | ImageFont.FreeTypeFont)
    low, high = float(hand.lower.min()), float(hand.upper.max())
    left, right = 380, 2 * TILE[0] - 260

    def across(value: float) -> float:
        return left + (right - left) * (value - low) / (high - low)

    owner = _fingers_of_joints(hand)
    pen.text((16, top), "joint [degrees], the posture as a mark", INK, font)
    for k, name in enumerate(hand.joint_names):
        y = top + BAR * (k + 1)
        color = FINGERS[owner[k]] if owner[k] != PARKED else HAND
        ends = [float(hand.lower[k]), float(hand.upper[k])]
        pen.text((16, y), name[:34], INK, font)
        pen.line([(left, y + 12), (right, y + 12)], GRID, 1)
        pen.rounded_rectangle([across(ends[0]), y + 6, across(ends[1]), y + 18], 5, color)
        at = across(float(joints[k]))
        pen.line([(at, y), (at, y + 24)], INK, 3)
        pen.text((right + 20, y), " to ".join(f"{np.rad2deg(e):.0f}" for e in ends), INK, font)


def _fingers_of_joints(hand: Hand) -> Sequence[int]:
    """Return the finger of each actuated joint, `PARKED` for one that moves several."""
    fingers = finger_of_links(hand)
    found = []
    for k in range(hand.dof):
        moved = {
            fingers[hand.tree.link_names[int(hand.tree.child[j])]]
            for j in torch.nonzero(hand.actuated.coupling[:, k])[:, 0].tolist()
        }
        found.append(moved.pop() if len(moved) == 1 else PARKED)
    return found
