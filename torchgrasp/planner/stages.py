"""The stages of one hand in the upright frame: contacts, their certificates, seeds, refined grasps, their order."""

import dataclasses
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.checks import Count, checked
from torchgrasp.errors import Status
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.cobyla import solve_as_paper
from torchgrasp.ik.contact_first import seed_costs, solve_contact_first
from torchgrasp.ik.joint import solve_fixed, solve_sliding
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.ik.obstacles import Obstacles
from torchgrasp.ik.posture_library import PostureLibrary, nearest_postures
from torchgrasp.ik.query import query_mixture
from torchgrasp.ik.ranking import (
    LEAST_ARM,
    load_arm,
    rank_by_success,
    rank_by_variance,
    rank_in_group,
    success_features,
    success_log_odds,
)
from torchgrasp.ik.refine import ITERATIONS
from torchgrasp.ik.rounds import Attempts, best_grasps, executable
from torchgrasp.plan.certify import certify
from torchgrasp.plan.problem import walls_of
from torchgrasp.plan.starts import Settled, settle_flatness
from torchgrasp.planner.choice import Offer, sorted_points
from torchgrasp.planner.story import Story
from torchgrasp.planner.task import Task
from torchgrasp.posture_model.mixture import PAPER_ENERGY
from torchgrasp.scene.occupancy import estimate_occupancy
from torchgrasp.shape.posterior import surface_deviation
from torchgrasp.shape.surface import Mesh, extract_mesh
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Certificate, ContactPlan, Contacts, Grasps, IKSeeds

TRIPLES = 250
"""Planned triples offered to the hand."""
SCENE_TRIPLES = 160
"""Triples offered in a scene, where more postures of each are tried: first grasps come in 1.5 times as long."""
OFFERED = 4
"""Rows of contacts offered for each that is tried. Those that postures of the hand nearly fit are tried: of them more
are executable, of four or five contacts twice as many (docs/fingers.md)."""
JUDGED_SEEDS, ARM_WEIGHT, NOTHING = 2, 0.3, 1e-3
"""Seeds that judge a row of contacts; weight of the log of the load's arm beside the log of the least residual; least
residual [mm2] that counts. Weights of 0.1 to 1 give as many executable grasps."""
FINE, COARSE, THICK = 0.003, 0.004, 0.04
"""Spacings [m] of the distance field. The coarse one is for things of one wall whose box has no side shorter than the
last: off by .4 to .8 mm in place of .2 to .5 (99 %), in .59 of the time. Their surface is known to some 2 mm."""
CERTAIN, ASKED = 0.004, 500
"""Standard deviation [m] of the surface below which it counts as certain, and vertices that are asked, at most."""
BURIED_DEPTH = 0.003
"""Depth [m] in obstacles, beyond that of neighbours that touch, at which something lies on a lifted surface."""


@checked
def spread_rows(plan: ContactPlan, most: Count) -> Int[Tensor, "k"]:
    """Return at most `most` successful rows, far apart, in plan order.

    >>> from torchgrasp import fit_shape, load_object, plan_contacts
    >>> plan = plan_contacts(fit_shape(load_object("jug").view), starts=20)
    >>> rows = spread_rows(plan, 3)
    >>> len(rows), bool((plan.status[rows] == Status.OK).all())
    (3, True)
    """
    rows = torch.nonzero(plan.status == Status.OK)[:, 0]
    if len(rows) <= most:
        return rows
    first = int(plan.quality[rows].argmin())
    return rows[farthest_points(sorted_points(plan.contacts[rows]), most, first=first).sort().values]


@dataclasses.dataclass(frozen=True)
class Bench:
    """A task and what its stages share, each built when it is first needed."""

    task: Task

    @cached_property
    def settled(self) -> Settled:
        """The spec with the radius within which contacts are flat, and candidates of contacts."""
        return settle_flatness(self.task.shape, self.task.spec, self.task.seed)

    @property
    def spec(self) -> ContactSpec:
        """The spec with the radius within which contacts are flat."""
        return self.settled.spec

    @cached_property
    def surface(self) -> Mesh:
        """The estimated surface."""
        return extract_mesh(self.task.shape)

    @property
    def certain(self) -> float:
        """The share of the surface that is known to `CERTAIN`."""
        shape, vertices = self.task.shape, self.surface.vertices
        jet = shape.jet(shape.normalise(vertices[:: len(vertices) // ASKED + 1]))
        std_m = shape.std_factor * shape.scale * surface_deviation(jet.variance, jet.gradient)
        return float((std_m < CERTAIN).double().mean())

    @cached_property
    def obstacles(self) -> Obstacles | None:
        """What may stand in the way of the hand in a scene."""
        scene = self.task.scene
        if scene is None or scene.target is None:
            return None
        return Obstacles.of(estimate_occupancy(scene, scene.target), hard=not self.spec.contact_allowed)

    @cached_property
    def world(self) -> CollisionWorld:
        """What links must not touch."""
        vertices, faces = self.surface.vertices, self.surface.faces
        thick = float((vertices.amax(0) - vertices.amin(0)).min()) > THICK and len(walls_of(self.task.shape)) == 1
        field = field_from_surface(vertices, faces, COARSE if thick else FINE)
        return CollisionWorld(field, self.spec.plane, self.obstacles)

    @cached_property
    def library(self) -> PostureLibrary:
        """Random postures of the hand."""
        return PostureLibrary.of(self.task.hand, seed=self.task.seed)

    @cached_property
    def buried(self) -> bool:
        """Tell whether the lifted surface runs into obstacles, deeper than it touches them where it stands."""
        if self.obstacles is None or not self.obstacles.hard:
            return False
        standing = float(self.obstacles.field.query(self.surface.vertices)[0].min())
        return lift_clearance(self.surface.vertices, self.obstacles) < min(standing, 0.0) - BURIED_DEPTH

    @property
    def tried(self) -> int:
        """How many rows of contacts the hand tries at most."""
        return TRIPLES if self.task.scene is None else SCENE_TRIPLES

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The centre [m] of the estimated surface."""
        return self.surface.vertices.mean(0)

    def find(self, plan: ContactPlan, most: int, story: Story) -> Offer:
        """Return closed contacts of which the hand may try so many, with seeds.

        They are far apart; in the paper all, the most certain first.
        """
        task = self.task
        story.note("plan", plan)
        if task.mode != "paper" or task.ranking != "variance":
            rows = spread_rows(plan, most * (OFFERED if task.mode == "joint" else 1))
        else:
            rows, variance = torch.nonzero(plan.status == Status.OK)[:, 0], plan.contacts.variance
            assert variance is not None
            rows = rows[torch.argsort(variance[rows].sum(1), stable=True)]
        contacts = plan.contacts[rows]
        certificate = certify(contacts, self.spec)
        contacts, certificate = contacts[certificate.closed], certificate[certificate.closed]
        story.note("certify", certificate, len(rows))
        offer = Offer(contacts, certificate, self.seeds(contacts))
        story.note("query", offer.seeds)
        return offer

    def problem(self, contacts: Contacts, certificate: Certificate) -> GraspProblem:
        """Return the problem of reaching closed contacts."""
        return GraspProblem(self.task.hand, contacts, certificate, self.world, self.center, self.task.reachable)

    def seeds(self, contacts: Contacts) -> IKSeeds:
        """Return postures near closed contacts."""
        task = self.task
        if task.mixture is None:
            return nearest_postures(self.library, contacts, self.world, reachable=task.reachable)
        mixture = task.mixture.to(task.shape.device)
        if task.mode == "paper":
            return query_mixture(task.hand, contacts, mixture, n_seeds=1, max_energy=PAPER_ENERGY)
        return query_mixture(task.hand, contacts, mixture)

    def costs(self, offer: Offer) -> Float[Tensor, "b"]:
        """Return the costs of trying contacts: how far their best seeds are from a grasp, how far the load is."""
        contacts, certificate, seeds = offer
        first = seeds[rank_in_group(seeds.row) < JUDGED_SEEDS]
        residual = seed_costs(self.problem(contacts, certificate), first)
        least = torch.full((len(contacts),), torch.inf, dtype=residual.dtype, device=residual.device)
        least = least.scatter_reduce(0, first.row, residual, "amin")
        return least.clamp_min(NOTHING).log() + ARM_WEIGHT * (load_arm(contacts.points, self.center) + LEAST_ARM).log()

    def solve(self, offer: Offer) -> Grasps:
        """Return checked grasps by contact first, a row for each row of contacts that has seeds."""
        solver = solve_as_paper if self.task.mode == "paper" else solve_contact_first
        return self._bury(solver(self.problem(offer.contacts, offer.certificate), offer.seeds))

    def touch(self, offer: Offer, steps: int = ITERATIONS) -> tuple[Grasps, Offer, Grasps]:
        """Return grasps on the contacts as they are; the contacts where none is, and their best failures."""
        problem = self.problem(offer.contacts, offer.certificate)
        offer = offer._replace(seeds=problem.drop_unreachable(offer.seeds))
        grasps, row = best_grasps(solve_fixed(problem, offer.seeds, steps))
        solved = executable(grasps)
        return self._bury(grasps[solved]), offer.select(row[~solved]), grasps[~solved]

    def slide(self, offer: Offer, failed: Grasps) -> Grasps:
        """Return grasps where contacts slide, or else the best failure of each row."""
        attempts = Attempts(torch.ones_like(offer.certificate.closed), executable)
        attempts.add(failed, torch.arange(len(failed), device=failed.status.device))
        problem = self.problem(offer.contacts, offer.certificate)
        solve_sliding(problem, offer.seeds, self.task.shape, self.spec, attempts)
        return self._bury(best_grasps(attempts)[0])

    def _bury(self, solved: Grasps) -> Grasps:
        """Return grasps of a thing that cannot be lifted as buried."""
        if not self.buried:
            return solved
        buried = torch.where(solved.status == Status.OK, int(Status.BURIED), solved.status)
        return dataclasses.replace(solved, status=buried)

    def rank(self, solved: Grasps) -> Grasps:
        """Return grasps in the order of the task's ranking, scored by the log-odds of success."""
        task, good = self.task, solved[solved.status == Status.OK]
        features = success_features(task.hand, task.shape, good, self.center, self.spec.friction, task.seed)
        log_odds = success_log_odds(features, task.hand.name)
        if self.obstacles is not None:
            free = 1 - collision_probability(task.hand, good, self.obstacles).to(log_odds)
            log_odds = torch.logit(torch.sigmoid(log_odds) * free, eps=1e-6)
        ranked = rank_by_success(solved, log_odds)
        return ranked if task.ranking == "success" else rank_by_variance(ranked)
