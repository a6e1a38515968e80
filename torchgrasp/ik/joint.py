"""Contacts, hand pose and joints solved together: the contacts slide to where this hand can take them.

Contact-first planning (`plan_contacts`, then `realise`) loses triples that the hand reaches only through the object,
the table or itself. Here the contact problem's rows (Eqs. 10-13 and the margins of `ContactSpec`) and the hand's rows
(tips, pads, clearances) are one least-squares problem in the contacts, the tensions, the pose and the joints. Being
flat and above the table stays with the contacts wherever they slide; their certificate is made anew.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, clearance_rows
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.contact_first import assign, check_grasps, rank_in_group, refine_in_rounds, refinement_on_contacts
from torchgrasp.ik.refine import PAD_WEIGHT, TIP_WEIGHT, tip_rows, tip_targets
from torchgrasp.optim import Residuals, levenberg_marquardt
from torchgrasp.plan.certify import certify
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.flatness import FlatnessConstraint, flatness_constraint
from torchgrasp.plan.problem import ContactProblem, Shape, TripleJet, triple_jet
from torchgrasp.plan.solver import normalise_tensions, project, start_state
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Certificate, Contacts, Grasps, IKSeeds

STILL, SLIDING = 2, (2, 6)
"""How many guesses of each triple are tried on the contacts as they are; then, in rounds, how many more slide."""
STAGES, STEPS = 3, 8
"""Stages of so many iterations; the rows for flat surface are evaluated at the start of each."""
PROJECTION = 3
"""Newton steps that bring the contacts onto the surface at the end; the solver leaves them within 0.1 mm."""


@dataclasses.dataclass(frozen=True)
class JointState(Batch):
    """A hand and the contacts of its fingers, normalised, with the tensions of their balance (`balanced_forces`)."""

    posture: Configuration
    points: Float[Tensor, "g 3 3"]
    tension: Float[Tensor, "g 3"]

    def moved(self, step: Float[Tensor, "g d"], hand: Hand) -> "JointState":
        """Return the state after a step: pose and joints, then points, then tensions."""
        by_hand, by_points, by_tension = step.split([6 + hand.dof, 9, 3], 1)
        points = self.points + by_points.unflatten(1, (3, 3))
        return JointState(
            self.posture.moved(by_hand, hand), points, normalise_tensions(points, self.tension + by_tension)
        )


def contacts_at(shape: Shape, points: Float[Tensor, "g 3 3"], jet: TripleJet) -> Contacts:
    """Return contacts at normalised points [m]."""
    std = shape.std_factor * shape.scale * jet.variance.sqrt()
    return Contacts(shape.metres(points), jet.normals, jet.variance, std)


def joint_residuals(
    state: JointState,
    hand: Hand,
    shape: Shape,
    problem: ContactProblem,
    world: CollisionWorld,
    flat: FlatnessConstraint | None,
) -> Residuals:
    """Return the residuals, in millimetres and what weighs as much, and the Jacobian by pose, joints, points, tensions.

    Args:
        state: g hands with their contacts.
        hand: the hand.
        shape: the estimated object.
        problem: what the contacts must satisfy.
        surroundings: what the links must not touch.
        flat: rows for flat surface, linear about where they were evaluated.
    """
    jet, jacobians = triple_jet(shape, state.points), SpatialJacobian.at(state.posture, hand)
    contacts = contacts_at(shape, state.points, jet)
    tips, tips_by_hand = tip_rows(jacobians, tip_targets(hand, contacts), jet.normals)
    links, links_by_hand = clearance_rows(jacobians, world, tips_touch=True)

    # A contact that slides by dx carries the tip's wanted centre along, and turns the normal under the pad.
    scale, normals = float(shape.scale), jet.normals
    identity, turn = torch.eye(3).to(normals), jet.turn
    wanted = scale * identity + hand.tip_radius.to(normals)[:, None, None] * turn
    pads = jacobians.directions(hand.tips.index, hand.tips.normal)
    tilt = (pads[..., None, :] @ turn)[..., 0, :] * (tips[:, 9:] > 0)[..., None]
    apart = torch.einsum("gixy,ij->gixjy", wanted, identity).flatten(3).flatten(1, 2)
    tilted = torch.einsum("giy,ij->gijy", tilt, identity).flatten(2)
    tips_by_points = torch.cat([-TIP_WEIGHT / MILLIMETRE * apart, PAD_WEIGHT * tilted], 1)

    rows, unit_length = problem.rows(state.points, state.tension, jet), scale / MILLIMETRE
    on = (rows.bounds > 0).to(normals)
    contact = torch.cat([rows.surface, on * rows.bounds], 1)
    by_x = torch.cat([rows.surface_by_x, on[..., None] * rows.bounds_by_x], 1)
    if flat is not None:
        bend = flat.rows(state.points)
        bends = (bend > 0).to(normals)
        contact = torch.cat([contact, bends * bend], 1)
        by_points = bends[..., None] * flat.by_points
        by_x = torch.cat([by_x, torch.cat([by_points, torch.zeros_like(by_points[..., :3])], 2)], 1)

    h, touch = tips_by_hand.shape[2], tips.shape[1]
    free = touch + links.shape[1]
    residual = torch.cat([tips, links, unit_length * contact], 1)
    jacobian = residual.new_zeros(*residual.shape, h + 12)
    jacobian[:, :touch, :h], jacobian[:, touch:free, :h] = tips_by_hand, links_by_hand
    jacobian[:, :touch, h : h + 9], jacobian[:, free:, h:] = tips_by_points, unit_length * by_x
    return residual, jacobian


def slide_contacts(
    posture: Configuration,
    points: Float[Tensor, "g 3 3"],
    hand: Hand,
    shape: Shape,
    problem: ContactProblem,
    world: CollisionWorld,
    flatness: float | None,
) -> JointState:
    """Return hands and contacts that satisfy everything at once, as far as each row allows.

    Args:
        posture: starting pose and joints, g rows.
        points: the contacts' normalised starts; finger i takes contact i.
        hand: the hand.
        shape: the estimated object.
        problem: what the contacts must satisfy.
        surroundings: what the links must not touch.
        flatness: largest bend [rad] of the surface around a contact; None: any.
    """
    state = JointState(posture, points, start_state(shape, points).tension)
    for _ in range(STAGES):
        flat = None if flatness is None else flatness_constraint(shape, state.points, flatness)

        def evaluate(state: JointState, at: Int[Tensor, "a"], flat: FlatnessConstraint | None = flat) -> Residuals:
            near = None if flat is None else flat[at]
            return joint_residuals(state, hand, shape, problem, world, near)

        state = levenberg_marquardt(state, evaluate, lambda state, step: state.moved(step, hand), STEPS)
    return state


def solve_joint(
    seeds: IKSeeds,
    hand: Hand,
    contacts: Contacts,
    certificate: Certificate,
    world: CollisionWorld,
    center: Float[Tensor, "3"],
    shape: Shape,
    spec: ContactSpec,
) -> Grasps:
    """Solve contacts, pose and joints together from guesses; like `realise`, but with contacts free to slide.

    Every triple is tried as it is first, which costs little; where that fails, its contacts slide with the hand.

    Args:
        guess: where the hand begins, best first within a row; `seeds.row` points into `contacts`.
        hand: the hand.
        contacts: where the contacts begin, with their `certificate`.
        certificate: one row for each of the contacts.
        surroundings: the estimated object's field and the table.
        center: estimated centre of the object [m]; grasps around it rank higher.
        shape: the estimated object.
        spec: what the contacts must satisfy.

    Returns:
        Ranked grasps with the contacts that they ended on, projected on the surface and certified anew. Of a triple
        that gave none, one failure with its Status: a planning one where the contacts themselves failed.
    """
    problem = ContactProblem.of(shape, spec)

    def sliding(seeds: IKSeeds) -> Grasps:
        first = assign(contacts, seeds).points
        posture = Configuration(seeds.joints, seeds.obj_from_hand)
        ended = slide_contacts(posture, shape.normalise(first), hand, shape, problem, world, spec.flatness)
        found = check_feasibility(shape, spec, project(shape, ended.points, PROJECTION))
        proof = certify(found.contacts, spec)
        order = seeds.permutation
        return check_grasps(ended.posture, found.contacts, proof, found.status, order, hand, world, center)

    still = refinement_on_contacts(hand, contacts, certificate, world, center)
    rank = rank_in_group(torch.zeros_like(seeds.energy), seeds.row)  # in their own order
    rounds = [(STILL, still), *((count, sliding) for count in SLIDING)]
    return refine_in_rounds(seeds, rank, len(contacts), rounds)
