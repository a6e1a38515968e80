"""Contacts, pose and joints solved together: contacts slide to where the hand reaches them.

Contact-first planning loses triples that the hand reaches only through the object, the table or itself. Here the
contact problem (Eqs. 10-13 and the margins of `ContactSpec`) and the hand's residuals are one least-squares problem.
Its unknowns are pose, joints, contacts and tensions. The contacts are certified anew.
"""

import dataclasses
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, clearance_hinges
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.contact_first import refine_on_contacts
from torchgrasp.ik.ranking import rank_in_group
from torchgrasp.ik.refine import PAD_WEIGHT, TIP_WEIGHT, tip_residuals, tip_targets
from torchgrasp.ik.rounds import Attempts, assign, best_grasps, executable
from torchgrasp.optim import LeastSquares, Residuals, levenberg_marquardt
from torchgrasp.plan.certify import certify
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.flatness import FlatnessConstraint, flatness_constraint
from torchgrasp.plan.problem import ContactProblem, Shape, TripleJet, triple_jet
from torchgrasp.plan.solver import normalise_tensions, project
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts, Grasps, IKSeeds

FIXED_SEEDS, SLIDING_SEEDS = (2,), (2, 6)
"""Seeds refined of each unsolved triple in a round: first on fixed contacts, which costs little, then sliding."""
STAGES, STEPS = 3, 8
"""Stages of so many steps; each stage begins by linearising the constraint of flat surface, which costs most."""
PROJECTIONS = 3
"""Newton steps that bring the contacts onto the surface at the end; the solver leaves them within 0.1 mm."""


@dataclasses.dataclass(frozen=True)
class JointState(Batch):
    """Hands, their normalised contacts, and the tensions of the balance (`forces_from_tensions`)."""

    configuration: Configuration
    points: Float[Tensor, "g 3 3"]
    tension: Float[Tensor, "g 3"]

    def integrate(self, hand: Hand, step: Float[Tensor, "g d"]) -> "JointState":
        """Return the state after a step of all unknowns."""
        by_hand, by_points, by_tension = step.split([6 + hand.dof, 9, 3], 1)
        points = self.points + by_points.unflatten(1, (3, 3))
        tension = normalise_tensions(points, self.tension + by_tension)
        return JointState(self.configuration.integrate(hand, by_hand), points, tension)


@dataclasses.dataclass(frozen=True)
class JointProblem:
    """A hand, the estimated object, its contact problem, and the world.

    `flatness` is the largest variation of the normal [rad] around a contact; None: any.
    """

    hand: Hand
    shape: Shape
    contact_problem: ContactProblem
    world: CollisionWorld
    flatness: float | None

    def residuals(self, state: JointState, flat: FlatnessConstraint | None) -> Residuals:
        """Return the residuals [mm], and their Jacobian by all unknowns."""
        hand, shape = self.hand, self.shape
        jet, spatial = triple_jet(shape, state.points), SpatialJacobian.at(hand, state.configuration)
        contacts = Contacts(shape.metres(state.points), jet.normals)
        tips, tips_by_hand = tip_residuals(spatial, tip_targets(hand, contacts), jet.normals)
        links, links_by_hand = clearance_hinges(spatial, self.world, tips_touch=True)
        tips_by_points = self._tips_by_points(spatial, jet, tips[:, 9:] > 0)
        contact, contact_by_x = self._contact_residuals(state, jet, flat)

        h, touch, free = tips_by_hand.shape[2], tips.shape[1], tips.shape[1] + links.shape[1]
        residual = torch.cat([tips, links, contact], 1)
        jacobian = residual.new_zeros(*residual.shape, h + 12)
        jacobian[:, :touch, :h], jacobian[:, touch:free, :h] = tips_by_hand, links_by_hand
        jacobian[:, :touch, h : h + 9], jacobian[:, free:, h:] = tips_by_points, contact_by_x
        return residual, jacobian

    def _tips_by_points(
        self, spatial: SpatialJacobian, jet: TripleJet, outside: Bool[Tensor, "g 3"]
    ) -> Float[Tensor, "g 12 9"]:
        """Return the derivative of the tip residuals by the contacts; pads count `outside` their cones.

        A sliding contact carries its tip's target along and rotates the normal under the pad.
        """
        hand, normals, normal_jacobian = self.hand, jet.normals, jet.normal_jacobian
        identity = torch.eye(3).to(normals)
        target = float(self.shape.scale) * identity + hand.tips.radius.to(normals)[:, None, None] * normal_jacobian
        pads = spatial.directions(hand.tips.index, hand.tips.normal)
        tilt = (pads[..., None, :] @ normal_jacobian)[..., 0, :] * outside[..., None]
        tips = torch.einsum("gixy,ij->gixjy", target, identity).flatten(3).flatten(1, 2)
        tilts = torch.einsum("giy,ij->gijy", tilt, identity).flatten(2)
        return torch.cat([-TIP_WEIGHT / MILLIMETRE * tips, PAD_WEIGHT * tilts], 1)

    def _contact_residuals(self, state: JointState, jet: TripleJet, flat: FlatnessConstraint | None) -> Residuals:
        """Return residuals [mm] of the contact problem, zero where bounds hold."""
        rows = self.contact_problem.constraints(state.points, state.tension, jet)
        violated = (rows.bounds > 0).to(rows.bounds)
        residuals = [rows.surface, violated * rows.bounds]
        jacobians = [rows.surface_by_x, violated[..., None] * rows.bounds_by_x]
        if flat is not None:
            variation = flat.values(state.points)
            violated = (variation > 0).to(variation)
            by_points = violated[..., None] * flat.by_points
            residuals.append(violated * variation)
            jacobians.append(torch.cat([by_points, torch.zeros_like(by_points[..., :3])], 2))
        unit_length = float(self.shape.scale) / MILLIMETRE
        return unit_length * torch.cat(residuals, 1), unit_length * torch.cat(jacobians, 1)

    def solve(self, state: JointState) -> JointState:
        """Return hands and contacts that satisfy all constraints, as far as each row allows."""
        for _ in range(STAGES):
            flat = None if self.flatness is None else flatness_constraint(self.shape, state.points, self.flatness)

            def evaluate(
                state: JointState, rows: Int[Tensor, "a"], flat: FlatnessConstraint | None = flat
            ) -> Residuals:
                return self.residuals(state, None if flat is None else flat[rows])

            sliding = LeastSquares(evaluate, lambda x, step: x.integrate(self.hand, step))
            state = levenberg_marquardt(sliding, state, STEPS)
        return state


def solve_joint(problem: GraspProblem, seeds: IKSeeds, shape: Shape, spec: ContactSpec) -> Grasps:
    """Return a checked grasp for each triple that has seeds, best first; contacts slide where they must.

    The seeds of a triple are tried in their order. Slid contacts are projected on the surface and certified anew. A
    failure has a planning Status where its contacts failed.
    """
    contact_problem = ContactProblem.of(shape, spec)
    joint_problem = JointProblem(problem.hand, shape, contact_problem, problem.world, spec.flatness)

    def refine_sliding(seeds: IKSeeds) -> Grasps:
        """Return a checked grasp for each seed, with sliding contacts."""
        points = shape.normalise(assign(problem.contacts, seeds).points)
        start = Configuration(seeds.joints, seeds.obj_from_hand)
        tension = normalise_tensions(points, points.new_ones(len(points), 3))
        state = joint_problem.solve(JointState(start, points, tension))
        plan = check_feasibility(shape, spec, project(shape, state.points, PROJECTIONS))
        certificate = certify(plan.contacts, spec)
        candidates = GraspCandidates(state.configuration, plan.contacts, certificate, seeds.permutation, plan.status)
        return check_candidates(problem, candidates)

    attempts, rank = Attempts(torch.ones_like(problem.certificate.closed), executable), rank_in_group(seeds.row)
    attempts.refine(seeds, rank, FIXED_SEEDS, partial(refine_on_contacts, problem))
    attempts.refine(seeds, rank, SLIDING_SEEDS, refine_sliding)
    return best_grasps(attempts)
