"""EM on growing random subsets: most steps use few rows, and the last steps all rows (Eqs. 19-20).

A row is one sample. The fit to a subset is the start at the next subset. This contains the first
and is twice as large. Fits that grow by one component each give a criterion for every number of
components. Stepwise EM of minibatches (Cappe and Moulines 2009,
https://doi.org/10.1111/j.1467-9868.2009.00698.x) was tried, too. It found less likely mixtures in
the same time.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.posture_model.em import (
    DataRows,
    EmRule,
    Fit,
    FitProgress,
    expectation,
    expectation_maximisation,
    maximisation,
)

ENOUGH = 8
"""Size of the greatest subset on which starts are compared, over that of the smallest. On too few
rows, the likeliest fit is often not the likeliest on all rows.
"""


@dataclasses.dataclass(frozen=True)
class Subsets:
    """Nested random subsets of the samples (data rows) of all processes of a fit together.

    What a subset contains does not depend on the number of processes.
    """

    shard: DataRows  # all samples of this process
    # number of samples of each subset, ascending: the last is that of all samples, every other is
    # half of the next, rounded down
    sizes: tuple[int, ...]
    # index of each sample of this process in the random order of all samples; a subset holds the
    # first of this order. None means that all samples are the only subset.
    place: Int[Tensor, "n"] | None = None

    @staticmethod
    def of(shard: DataRows, smallest: int | None, seed: int) -> "Subsets":
        """Draw nested random subsets, of at least `smallest` rows, from the rows of all processes.

        If `smallest` is None, or more than half of all rows, the only subset is that of all rows.
        `shard` holds the rows of this process, and `seed` draws the subsets.
        """
        n = shard.count()
        least = n if smallest is None else smallest
        sizes = tuple(size for size in halves(n)[::-1] if size >= least) or (n,)
        if len(sizes) == 1:
            return Subsets(shard, sizes)
        place = torch.randperm(n, generator=torch.Generator().manual_seed(seed), device="cpu")
        own = place.split(shard.lengths().tolist())[shard.rank]
        return Subsets(shard, sizes, own.to(shard.rows.device))

    def take(self, size: int) -> DataRows:
        """Return the rows of this process that belong to the subset of `size` rows.

        `size` is one of `sizes`; it counts the rows of all processes.
        """
        if self.place is None or size == self.sizes[-1]:
            return self.shard
        return dataclasses.replace(self.shard, rows=self.shard.rows[self.place < size])


def halves(n: int) -> list[int]:
    """Return the whole numbers n, n / 2, n / 4 and so on down to 1, each rounded down."""
    return [n >> k for k in range(n.bit_length())]


def fit_subsets(
    subsets: Subsets,
    sizes: Sequence[int],
    start: FitProgress,
    rule: EmRule,
    observer: Callable[[FitProgress], None] = lambda progress: None,
) -> Fit:
    """Fit a mixture by EM to the subsets of the given `sizes`, one after another; return the fit to
    the last one.

    `start` is the state before the first step, and `observer` is called with the state after each
    step. `rule` says when the fit to a subset ends, and bounds the steps on all subsets together.
    The last log-likelihood is that of the last subset.
    """
    for size in sizes[:-1]:
        fit = expectation_maximisation(subsets.take(size), start, rule, observer)
        # The next step sees other rows.
        start = dataclasses.replace(fit.resumed(), jumped=True)
    return expectation_maximisation(subsets.take(sizes[-1]), start, rule, observer)


def fit_smallest(subsets: Subsets, start: FitProgress, rule: EmRule) -> Fit:
    """Fit a mixture by EM to the smallest subsets, one after another; the fit to all rows can go on
    from the result.

    These subsets have at most eight times (`ENOUGH`) as many rows as the smallest one. If all rows
    are the only subset, they are used. `start` is the state before the first step, and `rule` says
    when the fit to a subset ends.
    """
    most = ENOUGH * subsets.sizes[0]
    sizes = [size for size in subsets.sizes[:-1] if size <= most] or subsets.sizes
    return dataclasses.replace(fit_subsets(subsets, sizes, start, rule), jumped=True)


def growing_fits(shard: DataRows, start: FitProgress, rule: EmRule) -> Iterator[Fit]:
    """Yield fits by EM to the data of all processes, without end, each with one component more.

    `shard` holds the data rows of this process. The first fit begins at `start`. Each later fit
    starts from the one before, with its component of greatest weight split in two. `rule` says when
    a fit ends.
    """
    n = shard.count()
    while True:
        fit = expectation_maximisation(shard, start, rule)
        yield fit
        sums, _ = expectation(shard, fit.components)
        # A component without rows takes half of the heaviest.
        sums = torch.cat([sums, torch.zeros_like(sums[:1])])
        never = fit.reseeded.new_zeros(len(sums))
        components, _ = maximisation(sums, n, rule.regularisation, never)
        start = FitProgress(components, never, fit.log_likelihood[:0])
