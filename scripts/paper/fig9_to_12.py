"""Figs. 9 to 12 of the paper. Contacts that hands take, in more than one way and with more than one
hand.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from paper.sheet import render_tile, save_sheet
from torchgrasp import (
    Contacts,
    ContactSpec,
    Grasps,
    Hand,
    list_objects,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.app.report.canvas import AXES, FINGERS, OBJECT, Canvas
from torchgrasp.app.report.raster import Direction
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.app.report.stills import facing
from torchgrasp.geometry.frames import virtual_frame
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.attempts import solve_as_paper
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.posture_model.mixture import PAPER_ENERGY, load_mixture
from torchgrasp.shape.surface import Surface, extract_surface

SPEC = ContactSpec.paper(table=0.0)
TILE = (450, 360)
"""Width and height of one picture [pixels]."""
SHOWN = 3
"""Grasps of each object in Figs. 11 and 12."""
APART = 0.1
"""Hands whose bases are nearer [m] are seen from the side of the first one's fingers."""
NORMAL = 0.035
FRAME = 0.03
"""Lengths of the contacts' normals and of the virtual frame [m]."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """Grasps of one hand on one object that passed every check of mode "paper", and the estimated
    surface.
    """

    hand: Hand
    surface: Surface
    grasps: Grasps


def grasps(out: Path, starts: int = 1000, seed: int = 0, only: tuple[str, ...] = ()) -> None:
    """Draw Figs. 9 to 12 with the project's objects. The hands are on the shapes that one side of
    each object gives.

    fig9.png: one contact triple by two postures of the same hand. fig10.png: one triple by both
    hands. fig11.png and fig12.png: grasps of the Barrett and of the Allegro hand. All are planned
    by `plan_grasps(mode="paper")`, and have passed every check.

    Args:
        out: folder of the pictures; it is made where it does not exist.
        starts: of the contact planner.
        seed: of every draw.
        only: names of objects; by default all of the project's.
    """
    torch.set_num_threads(1)
    hands = load_hand("allegro"), load_hand("barrett")
    taken = [[take(name, hand, starts, seed) for hand in hands] for name in only or list_objects()]
    for name, both in zip(only or list_objects(), taken, strict=True):
        print(f"{name:10}{', '.join(f'{len(t.grasps)} {t.hand.name} grasps' for t in both)}")
    pairs = [found for both in taken for t in both if (found := unlike_pair(t)) is not None]
    widest = sorted(pairs, key=lambda pair: -pair[3])[:2]
    save([[(t, one), (t, two)] for t, one, two, _ in widest], out / "fig9.png")
    triples = [shared_triple(allegro, barrett.hand) for allegro, barrett in taken]
    save([triple for triple in triples if triple][:2], out / "fig10.png")
    for k, number in ((1, 11), (0, 12)):
        shown = [both[k] for both in taken]
        rows = [[(x, index)] for x in shown for index in range(min(SHOWN, len(x.grasps)))]
        save(rows, out / f"fig{number}.png")


def take(name: str, hand: Hand, starts: int, seed: int) -> Taken:
    """Plan grasps of a hand on a shipped object in mode "paper", and return the executable ones.

    Those whose contacts have the least variance come first.
    """
    stages = dict[str, Any]()

    def note(stage: str, _: str, value: Any) -> None:
        stages[stage] = value

    view = load_object(name).view
    planned = plan_grasps(view, hand, SPEC, starts, seed, mode="paper", observer=note)
    return Taken(hand, extract_surface(stages["shape"]), planned.executable)


def unlike_pair(taken: Taken) -> tuple[Taken, int, int, float] | None:
    """Return the two grasps of one contact triple whose hands point apart the most.

    The result is (taken, first, second, angle): indices into `taken.grasps`, and the angle [rad]
    between both approaches. It is None if no two grasps have the same triple.
    """
    center = taken.grasps.contacts.points.mean(1)
    same = (torch.linalg.vector_norm(center[:, None] - center, dim=-1) < 1e-6).triu(1)
    if not bool(same.any()):
        return None
    approach = taken.grasps.obj_from_hand[:, :3, :3] @ taken.hand.approach
    angle = torch.where(same, torch.acos((approach @ approach.T).clamp(-1, 1)), -1.0)
    one, two = divmod(int(angle.argmax()), len(angle))
    return taken, one, two, float(angle[one, two])


def shared_triple(first: Taken, other: Hand) -> list[tuple[Taken, int]]:
    """Return a grasp of each hand on one contact triple, as pairs of grasps and index.

    The `other` hand is tried on the triples that the first hand takes. The list is empty if it
    reaches none.
    """
    surface = first.surface
    contacts = first.grasps.contacts
    if not len(contacts):
        return []
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), SPEC.plane)
    centre = surface.vertices.mean(0)
    problem = GraspProblem(other, contacts, first.grasps.certificate, world, centre)
    mixture = load_mixture(other.urdf_path.parent / "paper.safetensors")
    seeds = query_mixture(other, contacts, mixture, n_seeds=1, max_energy=PAPER_ENERGY)
    tried = solve_as_paper(problem, seeds)
    good = tried.executable
    if not len(good):
        return []
    apart = contacts.points.mean(1) - good.contacts.points[0].mean(0)
    gap = torch.linalg.vector_norm(apart, dim=-1)
    return [(first, int(gap.argmin())), (Taken(other, surface, good), 0)]


def save(rows: list[list[tuple[Taken, int]]], path: Path) -> None:
    """Draw grasps, two side by side, and write the sheet to `path`.

    A row has one grasp, or two of one contact triple, which are seen from one direction.
    """
    shown = [(*one, eye_of(row)) for row in rows for one in row]
    captions = {}
    for k, (taken, index, _) in enumerate(shown):
        worst = 1e3 * float(taken.grasps.tip_error[index].max())
        captions[divmod(k, 2)] = f"{taken.hand.name}, tips within {worst:.1f} mm"
    pictures = [draw(*one) for one in shown]
    save_sheet(path, [pictures[k : k + 2] for k in range(0, len(pictures), 2)], captions)


def eye_of(row: list[tuple[Taken, int]]) -> Direction:
    """Return the direction to the viewer from which the grasps of a row are seen well.

    Two hands that are apart are seen from across the line between them.
    """
    poses = [taken.grasps.obj_from_hand[index, :2, 3] for taken, index in row]
    x, y = (poses[0] - poses[-1]).tolist()
    if np.hypot(x, y) < APART:
        return facing(row[0][0].grasps[row[0][1]])
    return (-y, x, 0.4 * float(np.hypot(x, y)))


def draw(taken: Taken, index: int, eye: Direction) -> Image.Image:
    """Return a picture of grasp `index` on the estimated surface, seen from the direction `eye`.

    It shows the hand, the contacts' normals, and the virtual frame of the contacts.
    """
    hand = taken.hand
    grasp = taken.grasps[index]
    surface = taken.surface
    canvas = Canvas()
    contacts = grasp.contacts
    vertices = surface.vertices.numpy()
    normals = surface.normals.numpy()
    canvas.add_mesh(vertices, surface.faces.numpy(), OBJECT, normals, transparent=True)
    joints = hand.expand_joints(grasp.joints[0])
    solids = solids_from_hand(hand, joints, hand.tree.joint_names, grasp.obj_from_hand[0])
    for solid in solids:
        canvas.add_mesh(solid.vertices, solid.faces, solid.color)
    _add_frame(canvas, contacts)
    corners = np.concatenate([vertices, *(s.vertices for s in solids)])
    return render_tile(canvas, corners, eye, TILE)


def _add_frame(canvas: Canvas, contacts: Contacts) -> None:
    """Add the normals of a triple and its virtual frame."""
    canvas.add_arrows(contacts.points[0].numpy(), contacts.normals[0].numpy(), NORMAL, FINGERS[:3])
    frame = virtual_frame(contacts.points[0]).numpy()
    canvas.add_arrows(np.tile(frame[:3, 3], (3, 1)), frame[:3, :3].T, FRAME, AXES)
