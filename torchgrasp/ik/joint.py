"""Contacts, hand pose and joints solved together: the contacts slide on the surface until the hand
reaches them.

One least-squares problem has two parts. They are the contact problem (Eqs. 10-13 of the paper, with
the margins of `ContactSpec`) and the hand's residuals. Its unknowns are pose, joints, contact
points and tensions. A tension, without unit, is the size of the pull between two contacts; the
pulls give the contact forces. Contact points are normalised: in the shape's frame and unit of
length. g counts grasps, f fingertips.
"""

import dataclasses
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.contacts.certify import certify
from torchgrasp.contacts.descent import equal_tensions, normalise_tensions, project
from torchgrasp.contacts.feasibility import (
    FlatnessConstraint,
    check_feasibility,
    flatness_constraint,
)
from torchgrasp.contacts.problem import (
    ContactProblem,
    ShapeLike,
    rows_of,
    triple_jet,
    triple_mean_jet,
)
from torchgrasp.foundation.base import (
    Batch,
    at_once,
    flatnonzero,
    rank_in_group,
    row_numbers,
    spread,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import dot, eye_like
from torchgrasp.geometry.optim import LeastSquares, Residuals, levenberg_marquardt
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.attempts import Attempts, assign, best_first, best_grasps, try_best_seeds
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.refine import HAND_STEP, TIP_WEIGHT, grasp_residuals, tip_targets
from torchgrasp.shape.estimate import SurfaceJet
from torchgrasp.values.planning import Contacts, Grasps, IKSeeds
from torchgrasp.values.specs import ContactSpec

CONTACT_WEIGHT = 2.0  # weight of a millimetre of the contact problem: contacts have no margins


class SlidingStage(NamedTuple):
    """A stage of the solver that optimises hand posture and contacts together."""

    steps: int  # greatest number of solver steps in the stage
    flat: bool  # whether contacts must be where the surface is flat
    hopeless: float  # cost [mm2] from which on a grasp is given up after the stage


@dataclasses.dataclass(frozen=True)
class SlidingNumbers:
    """Parameters of the optimisation of hand posture and contacts together."""

    seeds: int = 2
    """Number of initial guesses of a contact set that are tried: more find few other grasps."""
    rows: int = 512
    """Number of initial guesses that are optimised at a time on a CPU."""
    most_rows: int = 2**15
    """Largest such number on an accelerator: the Jacobians of more do not fit into its memory."""
    projections: int = 3
    """Number of steps at the end that move the contacts onto the surface."""


SLIDING = SlidingNumbers()
STAGES = (
    SlidingStage(5, False, 1e5),
    SlidingStage(6, True, 1e4),
    SlidingStage(7, True, 500.0),
    SlidingStage(8, True, 50.0),
)


@dataclasses.dataclass(frozen=True)
class JointState(Batch):
    """The unknowns of the optimisation of hand posture and contacts together, for g grasps of f
    contacts.

    Points and variances are in normalised units of the shape.
    """

    configuration: Configuration  # poses of the hand and positions of its actuated joints
    points: Float[Tensor, "g f 3"]  # contact points, normalised
    # tension (no unit) of each of the k pairs of contacts, which pull each other with the force
    # tension times distance
    tension: Float[Tensor, "g k"]
    # variance of the surface's signed distance at the points, in squared normalised units
    variance: Float[Tensor, "g f"]
    # gradient of this variance, by which it is extrapolated linearly [normalised units]
    variance_gradient: Float[Tensor, "g f 3"]

    def integrate(self, hand: Hand, step: Float[Tensor, "g d"]) -> "JointState":
        """Return the states of g grasps after a `step` (g, d) of all unknowns.

        The d columns are changes of the hand pose (6), the joints, the contact points (3 f)
        and the tensions. The change of the pose is a translation [m] and a rotation vector [rad] in
        the hand's axes. Joints are in rad, or in metres if they slide. Points are normalised, and
        tensions have no unit.
        """
        by_hand, by_points, by_tension = step.split(
            [6 + hand.dof, self.points[0].numel(), self.tension.shape[1]], 1
        )
        motion = by_points.unflatten(1, self.points.shape[1:])
        points = self.points + motion
        variance = self.variance + dot(self.variance_gradient, motion)
        tension = normalise_tensions(points, self.tension + by_tension)
        moved = self.configuration.integrate(hand, by_hand)
        return JointState(moved, points, tension, variance, self.variance_gradient)


@dataclasses.dataclass(frozen=True)
class JointProblem:
    """The least-squares problem of hand posture and contacts together, for a batch of grasps.

    Its unknowns are a `JointState`: hand pose, joints, contact points and tensions.
    """

    hand: Hand  # the hand
    shape: ShapeLike  # the estimated shape, or a batch of one for each grasp
    contact_problem: ContactProblem  # the constraints on the contacts, in normalised units
    world: CollisionWorld  # what the hand must not touch

    def rows(self, index: Int[Tensor, "k"]) -> "JointProblem":
        """Return the problem of some grasps of the batch: those with the indices `index` (k,), in
        this order.
        """
        shape = rows_of(self.shape, index)
        contact_problem = self.contact_problem.rows(index)
        return JointProblem(self.hand, shape, contact_problem, self.world.rows(index))

    def residuals(self, state: JointState, flat: FlatnessConstraint | None) -> Residuals:
        """Return all weighted residuals (g, k) of a `state`, then their Jacobian (g, k, d).

        First are the residuals of the hand (`grasp_residuals`). They are lengths [mm] and weighted
        errors of the cosines between pads and surface. Then follow the constraints on the contacts,
        times 2 (`CONTACT_WEIGHT`) and the shape's scale [mm]. k counts residuals, and d unknowns.
        The Jacobian is by hand pose (6), joints, contacts and tensions. `flat` is the constraint
        that contacts are on flat surface; None leaves it out.
        """
        hand = self.hand
        shape = self.shape
        # the variance is that at the start of the stage, extrapolated
        mean = triple_mean_jet(shape, state.points)
        slope = state.variance_gradient
        jet = SurfaceJet(**vars(mean), variance=state.variance, variance_gradient=slope)
        contacts = Contacts(shape.metres(state.points), jet.normals)
        target = tip_targets(hand, contacts)
        of_hand, by_hand = grasp_residuals(
            hand, state.configuration, target, jet.normals, self.world, tips_touch=True
        )
        tips_by_points = self._tips_by_points(state.configuration, jet, by_hand)
        contact, contact_by_x = self._contact_residuals(state, jet, flat)

        # hand and contacts meet only in the tips
        rows = by_hand.shape[1]
        h = by_hand.shape[2]
        points = tips_by_points.shape[2]
        residual = torch.cat([of_hand, contact], 1)
        jacobian = residual.new_zeros(*residual.shape, h + contact_by_x.shape[2])
        jacobian[:, :rows, :h] = by_hand
        jacobian[:, rows:, h:] = contact_by_x
        jacobian[:, : tips_by_points.shape[1], h : h + points] = tips_by_points
        return residual, jacobian

    def _tips_by_points(
        self,
        configuration: Configuration,
        jet: SurfaceJet,
        by_hand: Float[Tensor, "g k h"],
    ) -> Float[Tensor, "g tips points"]:
        """Return the derivatives of the 4 f tip residuals by the 3 f coordinates of contact points.

        `by_hand` holds those of all residuals by pose and joints.
        """
        tips = self.hand.tips
        count = len(tips)
        normals = jet.normals
        normal_jacobian = jet.normal_jacobian
        identity, own = (eye_like(k, normals) for k in (3, count))
        rolled = tips.radius.to(normals)[:, None, None] * normal_jacobian
        target = spread(self.shape.scale, rolled) * identity + rolled
        # a turn of the hand changes the cosine of pad p and normal n by p x n, and n x (p x n) is
        # the part of p in the tangent plane, in which normals turn; both are 0 inside the cone
        turn = by_hand[:, 3 * count : 4 * count, 3:6] @ configuration.obj_from_hand[:, :3, :3].mT
        along = torch.linalg.cross(normals, turn)
        tilt = (along[..., None, :] @ normal_jacobian)[..., 0, :]
        moves = torch.einsum("gixy,ij->gixjy", target, own).flatten(3).flatten(1, 2)
        tilts = torch.einsum("giy,ij->gijy", tilt, own).flatten(2)
        return torch.cat([-TIP_WEIGHT / MILLIMETRE * moves, tilts], 1)

    def _contact_residuals(
        self, state: JointState, jet: SurfaceJet, flat: FlatnessConstraint | None
    ) -> Residuals:
        """Return the residuals [mm] of the contacts alone, then their Jacobian; a satisfied
        inequality gives 0.
        """
        rows = self.contact_problem.constraints(state.points, state.tension, jet)
        bounds = rows.bounds
        bounds_by_x = rows.bounds_by_x
        if flat is not None:
            bounds = torch.cat([bounds, flat.values(state.points)], 1)
            by_tension = flat.by_points.new_zeros(*flat.by_points.shape[:2], state.tension.shape[1])
            bounds_by_x = torch.cat([bounds_by_x, torch.cat([flat.by_points, by_tension], 2)], 1)
        violated = (bounds > 0).to(bounds)
        residual = torch.cat([rows.surface, violated * bounds], 1)
        jacobian = torch.cat([rows.surface_by_x, violated[..., None] * bounds_by_x], 1)
        weight = CONTACT_WEIGHT * (self.shape.scale / MILLIMETRE)
        return spread(weight, residual) * residual, spread(weight, jacobian) * jacobian

    def solve(
        self, configuration: Configuration, points: Float[Tensor, "g f 3"]
    ) -> tuple[Configuration, Float[Tensor, "k f 3"], Int[Tensor, "k"]]:
        """Return the hands, then the normalised contacts (k, f, 3), of the k grasps that are not
        given up. Return also their indices (k,) among the g grasps at the start.

        `configuration` holds the g hands at the start, and `points` their normalised contacts. The
        least-squares problem is solved in four stages (`STAGES`). After them, grasps whose cost is
        not below 1e5, 1e4, 500 and 50 mm2 are given up (`SlidingStage.hopeless`).
        """
        own = self
        largest = self.contact_problem.spec.flatness
        rows = row_numbers(points)
        tension = equal_tensions(points)
        for stage in STAGES:
            flat = None
            jet = triple_jet(own.shape, points)
            state = JointState(configuration, points, tension, jet.variance, jet.variance_gradient)
            if stage.flat and largest is not None:
                flat = flatness_constraint(own.shape, points, largest, own.contact_problem.ring)
            sliding = LeastSquares(
                lambda x, at, flat=flat, own=own: own.rows(at).residuals(
                    x, None if flat is None else flat[at]
                ),
                lambda x, step: x.integrate(self.hand, step),
                largest=HAND_STEP,
            )
            state, cost = levenberg_marquardt(sliding, state, stage.steps)
            # what is hopeless leaves the batch
            kept = flatnonzero(cost < stage.hopeless)
            configuration = state.configuration[kept]
            points = state.points[kept]
            tension = state.tension[kept]
            rows = rows[kept]
            own = own.rows(kept)
            if not len(rows):
                break
        return configuration, points, rows


def solve_sliding(
    joint_problem: JointProblem, problem: GraspProblem, seeds: IKSeeds, attempts: Attempts[Grasps]
) -> None:
    """Optimise hand and contacts together for each unsolved contact set of `attempts`.

    The checked grasps are added to `attempts`. A grasp is left out if its final cost is 50 mm2 or
    more. It is left out earlier if the cost exceeds larger bounds (`JointProblem.solve`).

    Args:
        joint_problem: the least-squares problem of hand and contacts, for each contact set.
        problem: the contact sets, from whose contacts the optimisation starts, and the checks.
        seeds: initial hand postures, of which the first two of each set (`SLIDING.seeds`) are
            tried.
        attempts: the results so far.
    """
    chosen = attempts.choose(seeds, rank_in_group(seeds.row), 0, SLIDING.seeds)
    size = min(at_once(chosen.row, SLIDING.rows), SLIDING.most_rows)
    for first in range(0, len(chosen), size):
        part = chosen[first : first + size]
        own = joint_problem.rows(part.row)
        points = own.shape.normalise(assign(problem.contacts, part).points)
        start = Configuration(part.joints, part.obj_from_hand)
        configuration, points, left = own.solve(start, points)
        kept = part[left]
        own = own.rows(left)
        # The solver leaves contacts near the surface, not on it.
        on_surface = project(own.shape, points, SLIDING.projections)
        plan = check_feasibility(own.shape, own.contact_problem, on_surface)
        certificate = certify(plan.contacts, own.contact_problem.spec)
        candidates = GraspCandidates(
            configuration, plan.contacts, certificate, kept.permutation, plan.status
        )
        attempts.add(check_candidates(problem.rows(kept.row), candidates), kept.row)


@checked
def solve_joint(
    problem: GraspProblem, seeds: IKSeeds, shape: ShapeLike, spec: ContactSpec
) -> Grasps:
    """Return the best checked grasp for each contact set that has initial guesses; contacts may
    move with the hand.

    The first two guesses of a set are tried, at first with fixed contacts. If both grasps fail a
    check, posture and contacts are solved for together. The contacts then slide along the surface
    of the `shape`. The moved contacts are checked for force closure again (`certify`).
    If they violate a constraint on contacts, the grasp has the `Status` of this constraint, as in
    `ContactPlan`.

    In the result, executable grasps come first: they passed all checks. Others follow. Within both,
    a higher `score` comes first. This score is a geometric quality, at most 0 and without unit. It
    is not the log-odds of success that `plan_grasps` gives, so the result's `success` has no
    meaning.

    Args:
        problem: hand, b contact sets and surroundings.
        seeds: initial guesses, from `nearest_postures`. Those that an arm cannot reach
            (`GraspProblem.reachable`) are left out.
        shape: the object's shape, from `fit_shape`, in the frame of the contacts.
        spec: constraints on sliding contacts, such as friction and table.

    Raises `BadArgument` for guesses of another hand, or of other contact sets.

    >>> from torchgrasp import fit_shape, load_hand, load_object
    >>> from torchgrasp.ik import CollisionWorld, PostureLibrary, nearest_postures
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> given = (hand, grasp.contacts, grasp.certificate, CollisionWorld())
    >>> problem = GraspProblem(*given, torch.zeros(3).double())
    >>> seeds = nearest_postures(PostureLibrary.of(hand, 1000), grasp.contacts, problem.world)
    >>> solve_joint(problem, seeds, fit_shape(load_object("jug").view), ContactSpec()).status
    tensor([0])
    """
    _check_seeds(problem, seeds)
    seeds = problem.drop_unreachable(seeds)
    attempts = try_best_seeds(problem, seeds)
    joint_problem = JointProblem(problem.hand, shape, ContactProblem.of(shape, spec), problem.world)
    solve_sliding(joint_problem, problem, seeds, attempts)
    return best_first(best_grasps(attempts)[0])


def _check_seeds(problem: GraspProblem, seeds: IKSeeds) -> None:
    """Raise `BadArgument` for initial guesses of another hand, or of other contact sets."""
    sets, fingers = problem.contacts.points.shape[:2]
    found = seeds.joints.shape[1], seeds.permutation.shape[1]
    own = problem.hand.dof, fingers
    if found != own:
        joints, tips = found
        allowed = f"guesses of {own[0]} joints and {own[1]} fingertips, as the hand has"
        raise BadArgument("seeds", f"guesses of {joints} joints and {tips} fingertips", allowed)
    strange = (seeds.row < 0) | (seeds.row >= sets)
    if strange.any():
        row = int(seeds.row[strange][0])
        raise BadArgument("seeds", f"a guess for contact set {row}", f"sets from 0 to {sets - 1}")
