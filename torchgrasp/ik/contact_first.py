"""The paper's way: the learned model's seeds move onto fixed contacts."""

from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.checks import checked
from torchgrasp.errors import Status
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.ranking import rank_in_group
from torchgrasp.ik.refine import ITERATIONS, grasp_residuals, refine, tip_targets
from torchgrasp.ik.rounds import Attempts, assign, best_first, best_grasps, executable
from torchgrasp.values import Grasps, IKSeeds

SEEDS_PER_ROUND = (2, 4)
"""Seeds refined of each unsolved triple in a round: few at first, because the best seed often succeeds."""


def seed_costs(problem: GraspProblem, seeds: IKSeeds) -> Float[Tensor, "g"]:
    """Return the sum of each seed's squared residuals [mm2], before any step."""
    costs = [seeds.energy[:0]]
    for rows in torch.arange(len(seeds), device=seeds.row.device).split(256):  # their temporaries stay in the cache
        part = seeds[rows]
        start, contacts = Configuration(part.joints, part.obj_from_hand), assign(problem.contacts, part)
        target = tip_targets(problem.hand, contacts)
        residual, _ = grasp_residuals(problem.hand, start, target, contacts.normals, problem.world, tips_touch=True)
        costs.append(residual.square().sum(1))
    return torch.cat(costs)


def rank_seeds(problem: GraspProblem, seeds: IKSeeds) -> Int[Tensor, "g"]:
    """Return each seed's rank within its triple, by its first residuals."""
    return rank_in_group(seeds.row, seed_costs(problem, seeds))


def refine_on_contacts(problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS) -> Grasps:
    """Return a checked grasp for each seed, its contacts fixed."""
    contacts, start = assign(problem.contacts, seeds), Configuration(seeds.joints, seeds.obj_from_hand)
    configuration = refine(problem.hand, start, contacts, problem.world, steps=steps)
    certificate, status = problem.certificate[seeds.row], torch.full_like(seeds.row, Status.OK)
    return check_candidates(problem, GraspCandidates(configuration, contacts, certificate, seeds.permutation, status))


@checked
def solve_contact_first(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return a checked grasp on fixed contacts for each triple that has seeds, best first.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.ik import PostureLibrary
    >>> from torchgrasp.ik import CollisionWorld, nearest_postures
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> middle = grasp.contacts.points[0].mean(0)
    >>> problem = GraspProblem(hand, grasp.contacts, grasp.certificate, CollisionWorld(), middle)
    >>> seeds = nearest_postures(PostureLibrary.of(hand, 1000), grasp.contacts, problem.world)
    >>> bool(solve_contact_first(problem, seeds).tip_error.max() < 0.002)  # [m]
    True
    """
    seeds = problem.drop_unreachable(seeds)
    attempts = Attempts(torch.ones_like(problem.certificate.closed), executable)
    attempts.refine(seeds, rank_seeds(problem, seeds), SEEDS_PER_ROUND, partial(refine_on_contacts, problem))
    return best_first(best_grasps(attempts)[0])
