"""Grasp solvers on fixed contacts, which refine initial guesses (seeds) in rounds.

b counts contact sets (one contact for each fingertip), g seeds or grasps.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import (
    Batch,
    at_once,
    join,
    lexical_order,
    map_tensors,
    rank_in_group,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.ik.candidates import (
    PAPER_TOLERANCE,
    GraspCandidates,
    GraspProblem,
    check_candidates,
)
from torchgrasp.ik.cobyla import COBYLA, refine_by_cobyla
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.refine import ITERATIONS, grasp_residuals, refine, tip_targets
from torchgrasp.values.planning import Contacts, Grasps, IKSeeds

Result = TypeVar("Result", bound=Batch)
ROWS = 256  # seeds whose costs are computed at a time, which bounds the memory


def assign(contacts: Contacts, seeds: IKSeeds) -> Contacts:
    """Return the contact set of each initial guess, with its contacts reordered so that contact i
    belongs to finger i.

    `contacts` are all sets; `seeds.row` holds the index of each guess's set among them.
    """
    return map_tensors(lambda x: x[seeds.row[:, None], seeds.permutation], contacts)


class Attempts(Generic[Result]):
    """A record of a grasp solver: the results of all refined initial guesses so far, and which
    contact sets still lack a good one.

    `unsolved` (b,) is the mask of these contact sets. `results` lists the added groups of results,
    each of them a batch such as `Grasps`. For each group, `rows` holds the index (k,) of each
    result's contact set.

    Args:
        unsolved: mask (b,) of the contact sets to solve at the start.
        solves: function of a group of k results, which returns a mask (k,) of the good ones.
    """

    def __init__(self, unsolved: Bool[Tensor, "b"], solves: Callable[[Result], Bool[Tensor, "k"]]):
        self.unsolved = unsolved
        self.solves = solves
        self.results = list[Result]()
        self.rows = list[Tensor]()

    def add(self, results: Result, row: Int[Tensor, "k"]) -> None:
        """Add a group of k `results`, of which `row` (k,) holds the indices of the contact sets.

        The contact sets of good results are no longer in `unsolved`.
        """
        self.results.append(results)
        self.rows.append(row)
        self.unsolved = self.unsolved.index_fill(0, row[self.solves(results)], False)

    def choose(self, seeds: IKSeeds, rank: Int[Tensor, "g"], first: int, count: int) -> IKSeeds:
        """Return the initial guesses of unsolved contact sets whose `rank` is from `first` to
        `first + count - 1`.

        `rank` (g,) is the rank of each of the g guesses, from 0, among those of its contact set.
        """
        return seeds[(rank >= first) & (rank < first + count) & self.unsolved[seeds.row]]

    def refine(
        self,
        seeds: IKSeeds,
        rank: Int[Tensor, "g"],
        counts: Sequence[int],
        refine: Callable[[IKSeeds], Result],
    ) -> None:
        """In round k, refine the next `counts[k]` initial guesses of each unsolved contact set, and
        add the results.

        `rank` is the rank of each guess, from 0, among those of its contact set. `refine` returns
        one result for each of the guesses that it is given.
        """
        first = 0
        for count in counts:
            chosen = self.choose(seeds, rank, first, count)
            first += count
            if len(chosen) or not self.results:
                self.add(refine(chosen), chosen.row)

    def best(self, keys: Callable[[Result], tuple[Tensor, ...]]) -> tuple[Result, Int[Tensor, "t"]]:
        """Return the best result of each of the t contact sets with results, then the indices (t,)
        of these sets.

        `keys` is a function of k results, which returns tensors (k,) by which they are compared.
        The best result has the least first key; in a tie the next key decides.
        """
        results = join(self.results)
        row = torch.cat(self.rows)
        first = rank_in_group(row, *keys(results)) == 0
        return results[first], row[first]


def is_executable(grasps: Grasps) -> Bool[Tensor, "g"]:
    """Return a mask (g,) of the grasps that passed every check: their `status` is `Status.OK`."""
    return grasps.status == Status.OK


def best_grasps(
    attempts: Attempts[Grasps],
    worth: Callable[[Grasps], Float[Tensor, "k"]] = lambda grasps: grasps.score,
) -> tuple[Grasps, Int[Tensor, "t"]]:
    """Return the best grasp of each of the t contact sets with grasps in `attempts`, then their
    indices (t,).

    An executable grasp, which passed all checks, is best. Next is a failed grasp whose contacts
    violate no constraint, then any other. In a tie the grasp of higher `worth` is better. `worth`
    is a function of k grasps that returns numbers (k,), by default the `score`.
    """

    def keys(grasps: Grasps) -> tuple[Tensor, Tensor]:
        failed = ~is_executable(grasps)
        bad_contacts = failed & (grasps.status < Status.OUT_OF_REACH)
        return failed.int() + bad_contacts.int(), -worth(grasps)

    return attempts.best(keys)


def best_first(grasps: Grasps) -> Grasps:
    """Return the `grasps` sorted: executable ones (`Status.OK`) before failed ones, both by
    decreasing score.
    """
    return grasps[lexical_order((~is_executable(grasps)).int(), -grasps.score)]


def refine_on_contacts(
    problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS, cobyla: bool = False
) -> Grasps:
    """Return a checked grasp for each initial guess, refined until its fingertips are on its fixed
    contacts.

    `problem` holds the contact sets, and `seeds.row` the index of each guess's set. A grasp's
    `status` is that of the first check that it fails, or `OK`. The solver takes at most `steps`
    Levenberg-Marquardt steps. With `cobyla`, the paper's solver and checks replace it, and `steps`
    is not used.
    """
    contacts = assign(problem.contacts, seeds)
    start = Configuration(seeds.joints, seeds.obj_from_hand)
    own = problem.rows(seeds.row)
    solve = refine_by_cobyla if cobyla else partial(refine, steps=steps)
    configuration = solve(problem.hand, start, contacts, own.world)
    status = torch.full_like(seeds.row, Status.OK)
    candidates = GraspCandidates(
        configuration, contacts, own.certificate, seeds.permutation, status
    )
    if cobyla:
        return check_candidates(own, candidates, rolling=False, tolerance=PAPER_TOLERANCE)
    return check_candidates(own, candidates)


def try_best_seeds(
    problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS
) -> Attempts[Grasps]:
    """Return the checked grasps of the first two initial guesses of each contact set.

    Each guess is refined on its fixed contacts by at most `steps` solver steps.
    """
    attempts = Attempts(torch.ones_like(problem.certificate.closed), is_executable)
    attempts.refine(
        seeds, rank_in_group(seeds.row), (2,), partial(refine_on_contacts, problem, steps=steps)
    )
    return attempts


def seed_costs(problem: GraspProblem, seeds: IKSeeds) -> Float[Tensor, "g"]:
    """Return the cost [mm2] of each initial guess before refinement: the sum of its squared
    residuals.

    These are the `grasp_residuals`: weighted errors of tip positions, pad directions and
    clearances.
    """
    costs = [seeds.energy[:0]]
    size = at_once(seeds.row, ROWS)
    for first in range(0, len(seeds), size):
        part = seeds[first : first + size]
        start = Configuration(part.joints, part.obj_from_hand)
        contacts = assign(problem.contacts, part)
        target = tip_targets(problem.hand, contacts)
        world = problem.world.rows(part.row)
        residual, _ = grasp_residuals(
            problem.hand, start, target, contacts.normals, world, tips_touch=True
        )
        costs.append(residual.square().sum(1))
    return torch.cat(costs)


@checked
def solve_contact_first(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return a checked grasp on fixed contacts for each contact set with initial guesses (`seeds`),
    best grasp first.

    Guesses whose hand pose an arm cannot reach are left out. The two guesses of each set with the
    least cost (`seed_costs`) are refined. If both fail a check, the next four are refined.
    """
    seeds = problem.drop_unreachable(seeds)
    attempts = Attempts(torch.ones_like(problem.certificate.closed), is_executable)
    rank = rank_in_group(seeds.row, seed_costs(problem, seeds))
    attempts.refine(seeds, rank, (2, 4), partial(refine_on_contacts, problem))
    return best_first(best_grasps(attempts)[0])


def solve_as_paper(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return the checked grasps of the paper's solver (COBYLA), one for each initial guess that was
    tried, best first.

    The guesses are tried ten at a time, in the order of their contact sets. This ends when 10
    grasps have passed all checks, or 300 guesses were tried.
    """
    seeds = problem.drop_unreachable(seeds)
    tried = list[Grasps]()
    step = COBYLA.together
    for first in range(0, max(min(len(seeds), COBYLA.seeds), 1), step):
        tried.append(refine_on_contacts(problem, seeds[first : first + step], cobyla=True))
        if int(is_executable(join(tried)).sum()) >= COBYLA.grasps:
            break
    return best_first(join(tried))
