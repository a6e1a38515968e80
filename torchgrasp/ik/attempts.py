"""Attempts to put the hand on fixed contacts: first the best seeds of each row, then more seeds of unsolved rows."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch, join, map_tensors
from torchgrasp.checks import checked
from torchgrasp.errors import Status
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.ranking import lexical_order, rank_in_group
from torchgrasp.ik.refine import ITERATIONS, grasp_residuals, refine, tip_targets
from torchgrasp.values import Contacts, Grasps, IKSeeds

Result = TypeVar("Result", bound=Batch)


def assign(contacts: Contacts, seeds: IKSeeds) -> Contacts:
    """Return each seed's contacts in the order of the fingers."""
    return map_tensors(lambda x: x[seeds.row[:, None], seeds.permutation], contacts)


class Attempts(Generic[Result]):
    """The results of all refined seeds, and the `unsolved` rows of contacts.

    `solves` returns which results solve their rows.
    """

    def __init__(self, unsolved: Bool[Tensor, "b"], solves: Callable[[Result], Bool[Tensor, "k"]]):
        self.unsolved, self.solves = unsolved, solves
        self.results, self.rows = list[Result](), list[Tensor]()

    def add(self, results: Result, row: Int[Tensor, "k"]) -> None:
        """Add results with the numbers of their rows."""
        self.results.append(results)
        self.rows.append(row)
        self.unsolved = self.unsolved.index_fill(0, row[self.solves(results)], False)

    def choose(self, seeds: IKSeeds, rank: Int[Tensor, "g"], first: int, count: int) -> IKSeeds:
        """Return `count` seeds of each unsolved row, from rank `first` on."""
        return seeds[(rank >= first) & (rank < first + count) & self.unsolved[seeds.row]]

    def refine(
        self, seeds: IKSeeds, rank: Int[Tensor, "g"], counts: Sequence[int], refine: Callable[[IKSeeds], Result]
    ) -> None:
        """Refine the next `counts[k]` seeds of each unsolved row in round k, in the order of `rank`."""
        first = 0
        for count in counts:
            chosen = self.choose(seeds, rank, first, count)
            first += count
            if len(chosen) or not self.results:
                self.add(refine(chosen), chosen.row)

    def best(self, keys: Callable[[Result], tuple[Tensor, ...]]) -> tuple[Result, Int[Tensor, "t"]]:
        """Return the first result of each row by `lexical_order` of the keys, and its row."""
        results, row = join(self.results), torch.cat(self.rows)
        first = rank_in_group(row, *keys(results)) == 0
        return results[first], row[first]


def executable(grasps: Grasps) -> Bool[Tensor, "g"]:
    """Return which grasps passed every check."""
    return grasps.status == Status.OK


def best_grasps(attempts: Attempts[Grasps]) -> tuple[Grasps, Int[Tensor, "t"]]:
    """Return the best grasp of each row, and its row: a success, else a failure of certified contacts, else any."""

    def keys(grasps: Grasps) -> tuple[Tensor, Tensor]:
        failed = ~executable(grasps)
        return failed.int() + (failed & (grasps.status < Status.OUT_OF_REACH)).int(), -grasps.score

    return attempts.best(keys)


def best_first(grasps: Grasps) -> Grasps:
    """Return executable grasps first, then by score."""
    return grasps[lexical_order((~executable(grasps)).int(), -grasps.score)]


def refine_on_contacts(problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS) -> Grasps:
    """Return a checked grasp on fixed contacts for each seed."""
    contacts, start = assign(problem.contacts, seeds), Configuration(seeds.joints, seeds.obj_from_hand)
    configuration = refine(problem.hand, start, contacts, problem.world, steps=steps)
    certificate, status = problem.certificate[seeds.row], torch.full_like(seeds.row, Status.OK)
    return check_candidates(problem, GraspCandidates(configuration, contacts, certificate, seeds.permutation, status))


def try_best_seeds(problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS) -> Attempts[Grasps]:
    """Return attempts with the first two seeds of each row."""
    attempts = Attempts(torch.ones_like(problem.certificate.closed), executable)
    attempts.refine(seeds, rank_in_group(seeds.row), (2,), partial(refine_on_contacts, problem, steps=steps))
    return attempts


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
    """Return each seed's rank within its row, by `seed_costs`."""
    return rank_in_group(seeds.row, seed_costs(problem, seeds))


@checked
def solve_contact_first(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return a checked grasp on fixed contacts for each row with seeds, best first; six seeds of a row are tried."""
    seeds = problem.drop_unreachable(seeds)
    attempts = Attempts(torch.ones_like(problem.certificate.closed), executable)
    attempts.refine(seeds, rank_seeds(problem, seeds), (2, 4), partial(refine_on_contacts, problem))
    return best_first(best_grasps(attempts)[0])
