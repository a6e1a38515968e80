"""The stages of one hand in the upright frame: contacts, their certificates, seeds, refined grasps, their order."""

import dataclasses
from functools import cached_property

import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.errors import Status
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.cobyla import solve_as_paper
from torchgrasp.ik.contact_first import solve_contact_first
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.ik.obstacles import Obstacles
from torchgrasp.ik.posture_library import PostureLibrary, keep_nearest, nearest_postures
from torchgrasp.ik.query import query_mixture
from torchgrasp.ik.ranking import rank_by_success, rank_by_variance, success_features, success_log_odds
from torchgrasp.ik.sdf import field_from_surface
from torchgrasp.linalg import farthest_points
from torchgrasp.pipeline.task import Task
from torchgrasp.plan.certify import certify
from torchgrasp.plan.starts import settle_flatness
from torchgrasp.posture_model.mixture import PAPER_ENERGY
from torchgrasp.scene.occupancy import estimate_occupancy
from torchgrasp.shape.surface import Surface, extract_surface
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Certificate, ContactPlan, Contacts, Grasps, IKSeeds

TRIPLES = 250
"""Planned triples offered to the hand."""
SCENE_TRIPLES = 160
"""Triples offered in a scene, where more postures of each are tried: first grasps come in 1.5 times as long."""
OFFERED = 4
"""Rows of four or five contacts offered for each that is tried: the nearest to postures of the hand. Few are in reach,
and of the nearest twice as many (docs/fingers.md)."""
BURIED_DEPTH = 0.003
"""Depth [m] in obstacles, beyond that of neighbours that touch, at which something lies on a lifted surface."""


def spread_rows(plan: ContactPlan, most: int) -> Int[Tensor, "k"]:
    """Return at most `most` successful rows, far apart, in plan order."""
    rows = torch.nonzero(plan.status == Status.OK)[:, 0]
    if len(rows) <= most:
        return rows
    points = plan.contacts.points[rows]
    order = torch.argsort(points[..., 2], dim=1, stable=True)  # contacts in another order are the same triple
    points = points.gather(1, order[..., None].expand(-1, -1, 3)).flatten(1)
    chosen = farthest_points(points, most, first=int(plan.quality[rows].argmin()))
    return rows[chosen.sort().values]


@dataclasses.dataclass(frozen=True)
class Bench:
    """A task and what its stages share, each built when it is first needed."""

    task: Task

    @cached_property
    def spec(self) -> ContactSpec:
        """The spec with the radius within which contacts are flat."""
        return settle_flatness(self.task.shape, self.task.spec, self.task.seed)

    @cached_property
    def surface(self) -> Surface:
        """The estimated surface."""
        return extract_surface(self.task.shape)

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
        field = field_from_surface(self.surface.vertices, self.surface.faces)
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

    def offer(self, plan: ContactPlan) -> tuple[Contacts, Certificate]:
        """Return contacts for the hand to try and their certificates, closed or not.

        They are far apart; in the paper all, the most certain first.
        """
        if self.task.mode != "paper" or self.task.ranking != "variance":
            rows = spread_rows(plan, self.tried * (1 if len(self.task.hand.tips) == 3 else OFFERED))
        else:
            rows, variance = torch.nonzero(plan.status == Status.OK)[:, 0], plan.contacts.variance
            assert variance is not None
            rows = rows[torch.argsort(variance[rows].sum(1), stable=True)]
        contacts = plan.contacts[rows]
        return contacts, certify(contacts, self.spec)

    def seeds(self, contacts: Contacts) -> IKSeeds:
        """Return postures near closed contacts."""
        task = self.task
        if task.mixture is None:
            near = nearest_postures(self.library, contacts, self.world, reachable=task.reachable)
            return keep_nearest(near, self.tried)
        mixture = task.mixture.to(task.shape.device)
        if task.mode == "paper":
            return query_mixture(task.hand, contacts, mixture, n_seeds=1, max_energy=PAPER_ENERGY)
        return query_mixture(task.hand, contacts, mixture)

    def solve(self, contacts: Contacts, certificate: Certificate, seeds: IKSeeds) -> Grasps:
        """Return checked grasps from seeds on closed contacts."""
        task, center = self.task, self.surface.vertices.mean(0)
        problem = GraspProblem(task.hand, contacts, certificate, self.world, center, task.reachable)
        if task.mode == "joint":
            solved = solve_joint(problem, seeds, task.shape, self.spec)
        else:
            solved = (solve_as_paper if task.mode == "paper" else solve_contact_first)(problem, seeds)
        if not self.buried:
            return solved
        return dataclasses.replace(
            solved, status=torch.where(solved.status == Status.OK, int(Status.BURIED), solved.status)
        )

    def rank(self, solved: Grasps) -> Grasps:
        """Return grasps in the order of the task's ranking, scored by the log-odds of success."""
        task, good = self.task, solved[solved.status == Status.OK]
        center = self.surface.vertices.mean(0)
        features = success_features(task.hand, task.shape, good, center, self.spec.friction, task.seed)
        log_odds = success_log_odds(features, task.hand.name)
        if self.obstacles is not None:
            free = 1 - collision_probability(task.hand, good, self.obstacles).to(log_odds)
            log_odds = torch.logit(torch.sigmoid(log_odds) * free, eps=1e-6)
        ranked = rank_by_success(solved, log_odds)
        return ranked if task.ranking == "success" else rank_by_variance(ranked)
