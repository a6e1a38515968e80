"""Rounds of refinement: first a triple's best seeds, one of which often succeeds, then more of the unsolved."""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.base import Batch, join, map_tensors
from torchgrasp.errors import Status
from torchgrasp.ik.ranking import lexical_order, rank_in_group
from torchgrasp.values import Contacts, Grasps, IKSeeds

Result = TypeVar("Result", bound=Batch)


def assign(contacts: Contacts, seeds: IKSeeds) -> Contacts:
    """Return each seed's contacts in the order of the fingers."""
    return map_tensors(lambda x: x[seeds.row[:, None], seeds.permutation], contacts)


class Attempts(Generic[Result]):
    """The results of all refined seeds, and the `unsolved` triples; `solves` tells which results solve theirs."""

    def __init__(self, unsolved: Bool[Tensor, "b"], solves: Callable[[Result], Bool[Tensor, "k"]]):
        self.unsolved, self.solves = unsolved, solves
        self.results: list[Result] = []
        self.rows: list[Tensor] = []

    def add(self, results: Result, row: Int[Tensor, "k"]) -> None:
        """Add results of the triples `row`."""
        self.results.append(results)
        self.rows.append(row)
        self.unsolved = self.unsolved.index_fill(0, row[self.solves(results)], False)

    def choose(self, seeds: IKSeeds, rank: Int[Tensor, "g"], first: int, count: int) -> IKSeeds:
        """Return `count` seeds of each unsolved triple, from the one of rank `first` on."""
        return seeds[(rank >= first) & (rank < first + count) & self.unsolved[seeds.row]]

    def refine(
        self, seeds: IKSeeds, rank: Int[Tensor, "g"], counts: Sequence[int], refine: Callable[[IKSeeds], Result]
    ) -> None:
        """Refine the next `counts[k]` seeds of each unsolved triple in round k, in the order of `rank`."""
        first = 0
        for count in counts:
            chosen = self.choose(seeds, rank, first, count)
            first += count
            if len(chosen) or not self.results:
                self.add(refine(chosen), chosen.row)

    def best(self, keys: Callable[[Result], tuple[Tensor, ...]]) -> tuple[Result, Int[Tensor, "t"]]:
        """Return the first result of each triple by `lexical_order` of the keys, and its triple."""
        results, row = join(self.results), torch.cat(self.rows)
        first = rank_in_group(row, *keys(results)) == 0
        return results[first], row[first]


def executable(grasps: Grasps) -> Bool[Tensor, "g"]:
    """Tell which grasps passed every check."""
    return grasps.status == Status.OK


def best_grasps(attempts: Attempts[Grasps]) -> tuple[Grasps, Int[Tensor, "t"]]:
    """Return a success of each triple, else a failure of certified contacts, else any; and its triple."""

    def keys(grasps: Grasps) -> tuple[Tensor, Tensor]:
        failed = ~executable(grasps)
        return failed.int() + (failed & (grasps.status < Status.OUT_OF_REACH)).int(), -grasps.score

    return attempts.best(keys)


def best_first(grasps: Grasps) -> Grasps:
    """Return executable grasps first, those of a high score first."""
    return grasps[lexical_order((~executable(grasps)).int(), -grasps.score)]
