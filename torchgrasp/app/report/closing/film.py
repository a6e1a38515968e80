"""A film strip of a closing: stills of its moments above forces, blends, slip and motion over time, as one PNG."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchgrasp.app.report.canvas import Canvas, Direction, frame_camera
from torchgrasp.app.report.closing.moments import LOST, explain_loss, first_touches, moments_of, moved_in_hand, tick_of
from torchgrasp.app.report.closing.panels import Line, Moment, Panel, draw_panels
from torchgrasp.app.report.palette import FINGERS, INK, OBJECT, PAPER
from torchgrasp.app.report.pictures import to_array
from torchgrasp.app.report.solids import link_poses, solids_of_links
from torchgrasp.closure import ClosureResult
from torchgrasp.geometry.frames import apply
from torchgrasp.hand.hand import Hand

if TYPE_CHECKING:
    import trimesh

WIDTH, STILL = 1680, 340
"""Width of the strip and height of its stills [pixels]: 1.6 to one of the page."""
TITLE, LETTERS = 44, "abcdef"
"""Height of the title of a still [pixels], and the names that stills and plots share."""
NEAR = 0.25
"""Distance [m] of the object from its place in the hand up to which stills are framed for it: farther it is gone."""
ALARM = "#c2452d"
"""Colour of the moment at which the object was lost."""
HAND_LINE, OBJECT_LINE, SLIP_LINE, TURN_LINE = "#9aa2ac", "#b5792a", "#8a4f9e", "#c77cba"
"""Colours of the heights of hand and object, and of the motion of one in the other."""
MOST_SLIDING = 100.0
"""Upper end of the axis of sliding [mm/s]: an object that is gone slides faster."""


def draw_film(mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult, direction: Direction) -> bytes:
    """Draw a closing on the true object: the hand stands still in each picture, and the object moves in it.

    Args:
        mesh: the true object [m], in the frame of the grasp, where z is up.
        hand: that closed.
        closure: what happened.
        direction: from the object to the camera.

    >>> from torchgrasp import TrialSpec, close_hand, load_hand
    >>> from torchgrasp.data.shipped import load_object, load_shipped_grasp
    >>> jug, hand, grasp = load_object("jug"), load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> result = close_hand(grasp, hand, jug.mesh, TrialSpec("open_loop", hold_time=0.2), parts=jug.parts)
    >>> draw_film(jug.mesh, hand, result, (1.0, -1.0, 0.5))[1:4]
    b'PNG'
    """
    from PIL import Image, ImageDraw, ImageFont

    moments = moments_of(closure, _centre(mesh), hand.tips.names)
    seconds, colors = closure.time.tolist(), [ALARM if m.name == LOST else INK for m in moments]
    marks = [Moment(seconds[m.tick], *row) for m, *row in zip(moments, LETTERS, colors, strict=False)]
    plots = draw_panels(_panels(mesh, hand, closure), to_array(closure.time), marks, WIDTH)
    sheet = Image.new("RGB", (WIDTH, STILL + plots.height), PAPER)
    pen, font, width = ImageDraw.Draw(sheet), ImageFont.load_default(20), WIDTH // len(moments)
    stills = _stills(mesh, hand, closure, [m.tick for m in moments], direction, (width, STILL - TITLE))
    for k, (still, mark, moment) in enumerate(zip(stills, marks, moments, strict=True)):
        sheet.paste(Image.fromarray(still), (k * width, TITLE))
        pen.text((k * width + 14, 12), f"{mark.letter}  {mark.time:.2f} s  {moment.name}", mark.color, font)
    sheet.paste(plots, (0, STILL))
    buffer = io.BytesIO()
    sheet.save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()


def describe_film(mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult) -> str:
    """Say what the film of a closing shows: the order of touch, and when and why the object was lost.

    >>> from torchgrasp import TrialSpec, close_hand, load_hand
    >>> from torchgrasp.data.shipped import load_object, load_shipped_grasp
    >>> jug, hand, grasp = load_object("jug"), load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> result = close_hand(grasp, hand, jug.mesh, TrialSpec("open_loop", hold_time=0.2), parts=jug.parts)
    >>> describe_film(jug.mesh, hand, result).split(". ")[1]
    'The object was held'
    """
    order = ", ".join(hand.tips.names[finger] for finger in closure.contact_order) or "none"
    lost = explain_loss(closure, _centre(mesh), hand.tips.names)
    halts, attempts = closure.halts, closure.attempts
    on_its_way = f" On its way the hand touched something {_times(halts)}." if halts else ""
    again = f" The hand closed {_times(attempts)}." if attempts > 1 else ""
    end = (lost or "The object was held.") + on_its_way + again
    return f"In the order of touch: {order}. {end} Each picture is taken from the hand."


def _times(count: int) -> str:
    """Return a count in words."""
    return "once" if count == 1 else f"{count} times"


def _centre(mesh: "trimesh.Trimesh") -> torch.Tensor:
    """Return the mass centre [m]."""
    return torch.tensor(np.array(mesh.center_mass), dtype=torch.float64)


def _stills(
    mesh: "trimesh.Trimesh",
    hand: Hand,
    closure: ClosureResult,
    ticks: list[int],
    direction: Direction,
    size: tuple[int, int],
) -> list[np.ndarray]:
    """Return the pictures at some ticks, all at one scale."""
    finite = torch.nonzero(closure.joints.isfinite().all(-1) & closure.object_pose.isfinite().all(-1).all(-1))[:, 0]
    at = torch.stack([finite[finite <= tick][-1] for tick in ticks])
    links = to_array(link_poses(hand, closure.joints[at], closure.joint_names, closure.hand_pose[at]))
    vertices = torch.tensor(np.array(mesh.vertices), dtype=torch.float64)
    places = to_array(apply(closure.object_pose[at].double(), vertices))
    solids, faces = solids_of_links(hand), np.asarray(mesh.faces)
    base = to_array(closure.hand_pose[at, :3, 3])
    # The table stays, so it sinks in the pictures while the hand rises.
    table = float(apply(closure.object_pose[0].double(), vertices)[:, 2].min())
    postures = [[s.vertices @ poses[s.link, :3, :3].T + poses[s.link, :3, 3] for s in solids] for poses in links]
    inside = [place - b for place, b in zip(places, base, strict=True)]
    near = [x for x in inside if np.abs(x.mean(0) - inside[0].mean(0)).max() < NEAR]
    seen = np.concatenate([*near, *(x - b for parts, b in zip(postures, base, strict=True) for x in parts)])
    pictures = []
    for place, parts, poses, b in zip(places, postures, links, base, strict=True):
        canvas = Canvas()
        canvas.add_mesh(place, faces, OBJECT)
        for solid, points in zip(solids, parts, strict=True):
            canvas.add_mesh(points, solid.faces, solid.color, solid.normals @ poses[solid.link, :3, :3].T)
        canvas.add_table(seen + b, table)
        pictures.append(canvas.render(frame_camera(seen + b, direction, size=size), size))
    return pictures


def _panels(mesh: "trimesh.Trimesh", hand: Hand, closure: ClosureResult) -> list[Panel]:
    """Return what is shown over time: forces, blends and sliding of the fingertips, and motions."""
    trace, names = closure.trace, hand.tips.names
    order, touches = closure.contact_order, first_touches(closure)
    time, forces = to_array(closure.time), to_array(closure.forces)
    ranks = [f"{order.index(k) + 1}. {name}" if k in order else f"never: {name}" for k, name in enumerate(names)]
    distance, turn = moved_in_hand(closure, _centre(mesh))
    before = torch.arange(len(time)) < tick_of(closure, 2)
    slip, degrees = (to_array(x.masked_fill(before, torch.nan)) for x in (1e3 * distance, torch.rad2deg(turn)))
    centres = apply(closure.object_pose.double(), _centre(mesh).expand(len(time), 1, 3))[:, 0]
    moved = 1e3 * to_array(torch.linalg.vector_norm(centres - centres[0], dim=-1))
    height = 1e3 * to_array(closure.hand_pose[:, 2, 3])
    height = height - np.nanmin(height)

    def of_fingers(values: np.ndarray, labels: Sequence[str]) -> list[Line]:
        """Return a line for each finger."""
        return [Line(*row) for row in zip(values.T, FINGERS, labels, strict=False)]

    blank, blend = [""] * len(names), to_array(trace.blend)
    return [
        Panel(
            "normal force [N], in the order of touch:",
            max(1.0, 1.1 * float(np.nanmax(forces))),
            250,
            of_fingers(forces, ranks),
            [(float(time[tick]), FINGERS[finger]) for finger, tick in zip(order, touches, strict=True)],
        ),
        *[Panel("lambda: 0 by position, 1 by force", 1.0, 150, of_fingers(blend, blank))]
        * bool(np.isfinite(blend).any()),
        Panel("sliding of the fingertips [mm/s]", MOST_SLIDING, 150, of_fingers(1e3 * to_array(trace.sliding), blank)),
        Panel(
            "motion [mm]:",
            1.1 * max(20.0, *(float(np.nanmax(x, initial=0.0)) for x in (moved, height))),
            200,
            [
                Line(height, HAND_LINE, "hand above its lowest", 5.0),
                Line(moved, OBJECT_LINE, "object from its place"),
                Line(slip, SLIP_LINE, "object in the hand since pressed"),
                Line(degrees, TURN_LINE, "its turn there [deg]"),
            ],
        ),
    ]
