"""Figs. 9 to 12 of the paper: contacts that hands take, in more than one way and with more than one hand."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from PIL import Image
from torch import Tensor

from paper.sheet import render_tile, save_sheet
from torchgrasp import (
    Contacts,
    ContactSpec,
    Grasps,
    Hand,
    Status,
    certify,
    fit_shape,
    list_objects,
    load_hand,
    load_mixture,
    load_object,
    plan_contacts,
    plan_grasps,
)
from torchgrasp.app.report.canvas import AXES, FINGERS, OBJECT, Canvas, Direction
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.app.report.stills import facing
from torchgrasp.geometry.frames import virtual_frame
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.attempts import rank_seeds, refine_on_contacts
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.planner.contacts import spread_rows
from torchgrasp.shape.surface import Surface, extract_surface

SPEC = ContactSpec(table=0.0)
TRIPLES, SEEDS, TRIED = 80, 6, 16
"""Certified triples of each object, seeds of the learned model for each assignment, and how many are refined."""
TILE = (450, 360)
"""Width and height of one picture [pixels]."""
APART = 0.1
"""Hands whose bases are nearer [m] are seen from the side of the first one's fingers."""
NORMAL, FRAME = 0.035, 0.03
"""Lengths of the contacts' normals and of the virtual frame [m]."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """Grasps of one hand on one object that passed every check, the contact triple of each, and who planned them."""

    chain: str
    hand: Hand
    surface: Surface
    grasps: Grasps
    row: Int[Tensor, "g"]


def grasps(out: Path, starts: int = 300, seed: int = 0) -> None:
    """Draw Figs. 9 to 12 with the project's objects: the hands on the shapes that one side of each object gives.

    fig9.png: one contact triple by two postures of the same hand. fig10.png: one triple by both hands. fig11.png and
    fig12.png: grasps of the Barrett and of the Allegro hand, those of the paper's own chain first where it has any.
    Every grasp drawn has passed every check.

    Args:
        out: folder of the pictures; it is made where it does not exist.
        starts: of the contact planner.
        seed: of every draw.
    """
    torch.set_num_threads(1)
    taken = {name: take(name, starts, seed) for name in list_objects()}
    for name, hands in taken.items():
        counts = [f"{len(t.grasps)} {t.hand.name} grasps of {len(t.row.unique())} triples" for t in hands]
        print(f"{name:10}{', '.join(counts)}")
    pairs = [found for hands in taken.values() for t in hands if (found := unlike_pair(t)) is not None]
    widest = sorted(pairs, key=lambda pair: -pair[3])[:2]
    save([[(t, one), (t, two)] for t, one, two, _ in widest], out / "fig9.png")
    save([found for hands in taken.values() if (found := shared_triple(*hands))][:2], out / "fig10.png")
    for k, number in ((1, 11), (0, 12)):
        papers = [take_as_paper(name, hands[k].hand, starts, seed) for name, hands in taken.items()]
        shown = [t for t in (*papers, *(hands[k] for hands in taken.values())) if len(t.grasps)]
        print(f"fig{number}: the paper's chain has {', '.join(str(len(t.grasps)) for t in papers)} grasps")
        save([[(t, 0 if t.chain else int(t.grasps.score.argmax()))] for t in shown], out / f"fig{number}.png")


def take_as_paper(name: str, hand: Hand, starts: int, seed: int) -> Taken:
    """Return the grasps of the paper's chain, those of least variance first."""
    view, spec = load_object(name).view, ContactSpec.paper(table=SPEC.table)
    shape = fit_shape(view, support="paper", seed=seed)
    planned = plan_grasps(view, hand, spec, starts, seed, mode="paper", shape=shape)
    good = planned[planned.status == Status.OK]
    return Taken("the paper's chain, ", hand, extract_surface(shape), good, torch.arange(len(good)))


def take(name: str, starts: int, seed: int) -> tuple[Taken, Taken]:
    """Return the grasps of the Allegro and the Barrett hand on one object, from the learned models' seeds."""
    shape = fit_shape(load_object(name).view, seed=seed, table=SPEC.table)
    surface = extract_surface(shape)
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), SPEC.plane)
    plan = plan_contacts(shape, SPEC, starts, seed)
    contacts = plan.contacts[spread_rows(plan, TRIPLES)]
    certificate = certify(contacts, SPEC)
    contacts, certificate = contacts[certificate.closed], certificate[certificate.closed]
    found = []
    for hand in (load_hand("allegro"), load_hand("barrett")):
        problem = GraspProblem(hand, contacts, certificate, world, surface.vertices.mean(0))
        seeds = query_mixture(hand, contacts, load_mixture(hand.name), SEEDS)
        seeds = seeds[rank_seeds(problem, seeds) < TRIED]
        refined = refine_on_contacts(problem, seeds)
        good = refined.status == Status.OK
        found.append(Taken("", hand, surface, refined[good], seeds.row[good]))
    return found[0], found[1]


def unlike_pair(taken: Taken) -> tuple[Taken, int, int, float] | None:
    """Return the two grasps of one triple whose hands point apart the most, and the angle between them [rad]."""
    same = (taken.row[:, None] == taken.row).triu(1)
    if not bool(same.any()):
        return None
    approach = taken.grasps.obj_from_hand[:, :3, :3] @ taken.hand.approach
    angle = torch.where(same, torch.acos((approach @ approach.T).clamp(-1, 1)), -1.0)
    one, two = divmod(int(angle.argmax()), len(angle))
    return taken, one, two, float(angle[one, two])


def shared_triple(first: Taken, second: Taken) -> list[tuple[Taken, int]]:
    """Return one grasp of each hand on a triple that both take, the one of the best score."""
    both = [row for row in first.row.unique().tolist() if row in second.row]

    def best(taken: Taken, row: int) -> int:
        return int(torch.where(taken.row == row, taken.grasps.score, -torch.inf).argmax())

    choices = [(t, best(t, row)) for row in both for t in (first, second)]
    scores = np.array([float(t.grasps.score[index]) for t, index in choices]).reshape(-1, 2).sum(1)
    return choices[2 * int(scores.argmax()) :][:2] if len(scores) else []


def save(rows: list[list[tuple[Taken, int]]], path: Path) -> None:
    """Draw grasps, those of one contact triple in a row and from one eye, else two in a row."""
    shown, captions = [(*one, eye_of(row)) for row in rows for one in row], {}
    for k, (taken, index, _) in enumerate(shown):
        worst = 1e3 * float(taken.grasps.tip_error[index].max())
        captions[divmod(k, 2)] = f"{taken.chain}{taken.hand.name}, tips within {worst:.2f} mm"
    pictures = [draw(*one) for one in shown]
    save_sheet(path, [pictures[k : k + 2] for k in range(0, len(pictures), 2)], captions)


def eye_of(row: list[tuple[Taken, int]]) -> Direction:
    """Return the direction from which a grasp is seen well, or two whose hands are apart: square to their distance."""
    poses = [taken.grasps.obj_from_hand[index, :2, 3] for taken, index in row]
    x, y = (poses[0] - poses[-1]).tolist()
    if np.hypot(x, y) < APART:
        return facing(row[0][0].grasps[row[0][1]])
    return (-y, x, 0.4 * float(np.hypot(x, y)))


def draw(taken: Taken, index: int, eye: Direction) -> Image.Image:
    """Draw one grasp with its contacts, their normals and their virtual frame on the estimated surface."""
    hand, grasp, surface = taken.hand, taken.grasps[index], taken.surface
    canvas, contacts = Canvas(), grasp.contacts
    vertices = surface.vertices.numpy()
    canvas.add_mesh(vertices, surface.faces.numpy(), OBJECT, surface.normals.numpy(), transparent=True)
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
