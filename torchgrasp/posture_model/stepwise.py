"""EM on growing random subsets: most steps see few rows, and the last steps see all rows (Eqs.
19-20).

The fit to a subset is the start at the next subset, which contains the first and is twice as large.
Fits that grow by one component each give a criterion for every number of components. Stepwise EM of
minibatches (Cappe and Moulines 2009, https://doi.org/10.1111/j.1467-9868.2009.00698.x) was tried,
too: it found less likely mixtures in the same time.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.posture_model.em import (
    DataRows,
    Fit,
    FitProgress,
    expectation,
    expectation_maximisation,
    maximisation,
)


@dataclasses.dataclass(frozen=True)
class Subsets:
    """Nested random subsets of the rows of all processes; the processes do not change what a subset
    contains.

    `sizes` are the numbers of rows. The last is the number of all rows, every other is half of the
    next.
    """

    shard: DataRows
    sizes: tuple[int, ...]
    place: Int[Tensor, "n"] | None = (
        None  # of each row of this process in the random order of all rows
    )

    @staticmethod
    def of(shard: DataRows, smallest: int | None, seed: int) -> "Subsets":
        """Draw subsets of at least `smallest` rows; None, or more than half of the rows, leaves
        only all rows.
        """
        n = shard.count()
        sizes = tuple(
            size for size in halves(n)[::-1] if smallest is not None and size >= smallest
        ) or (n,)
        if len(sizes) == 1:
            return Subsets(shard, sizes)
        place = torch.randperm(n, generator=torch.Generator().manual_seed(seed), device="cpu")
        return Subsets(
            shard, sizes, place.split(shard.lengths().tolist())[shard.rank].to(shard.rows.device)
        )

    def take(self, size: int) -> DataRows:
        """Return the rows of this process in the subset of so many rows."""
        if self.place is None or size == self.sizes[-1]:
            return self.shard
        return dataclasses.replace(self.shard, rows=self.shard.rows[self.place < size])


def halves(n: int) -> list[int]:
    """Return n, n / 2, n / 4 and so on, rounded down, to 1."""
    return [n >> k for k in range(n.bit_length())]


def fit_subsets(
    subsets: Subsets,
    sizes: Sequence[int],
    start: FitProgress,
    iterations: int,
    tolerance: float,
    regularisation: float,
    observer: Callable[[FitProgress], None] = lambda progress: None,
) -> Fit:
    """Fit a mixture by EM to the subsets of these sizes in turn; the other arguments are those of
    EM.

    `iterations` bounds the steps on all subsets together. The last log-likelihood is that of the
    last subset.
    """
    for size in sizes[:-1]:
        part = subsets.take(size)
        start = _next(
            expectation_maximisation(part, start, iterations, tolerance, regularisation, observer)
        )
    return expectation_maximisation(
        subsets.take(sizes[-1]), start, iterations, tolerance, regularisation, observer
    )


def likeliest_fit(
    subsets: Subsets,
    starts: list[FitProgress],
    iterations: int,
    tolerance: float,
    regularisation: float,
) -> FitProgress:
    """Fit each start to the smaller subsets; return the state of the likeliest fit."""
    # times the first subset: on fewer rows, the likeliest fit is often not the likeliest on all
    # rows
    enough = 8
    sizes = [
        size for size in subsets.sizes[:-1] if size <= enough * subsets.sizes[0]
    ] or subsets.sizes
    if len(starts) == 1:
        return starts[0]
    fits = [
        fit_subsets(subsets, sizes, start, iterations, tolerance, regularisation)
        for start in starts
    ]
    return _next(max(fits, key=lambda fit: float(fit.log_likelihood[-1])))


def growing_fits(
    shard: DataRows, start: FitProgress, iterations: int, tolerance: float, regularisation: float
) -> Iterator[Fit]:
    """Yield fits without end, each of one component more; each starts from the last, its heaviest
    component split.
    """
    while True:
        yield (fit := expectation_maximisation(shard, start, iterations, tolerance, regularisation))
        sums, _ = expectation(shard, fit.components)
        sums = torch.cat(
            [sums, torch.zeros_like(sums[:1])]
        )  # a component without rows takes half of the heaviest
        components, split = maximisation(
            sums, shard.count(), regularisation, fit.reseeded.new_zeros(len(sums))
        )
        start = FitProgress(components, torch.zeros_like(split), fit.log_likelihood[:0])


def _next(fit: Fit) -> FitProgress:
    """Return the state in which the next subset begins: the likelihood of its rows is not yet
    known.
    """
    return FitProgress(
        fit.components, fit.reseeded, fit.log_likelihood[:-1], jumped=True, rows=fit.rows
    )
