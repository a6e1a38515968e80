"""The sizes of the planner's batches, each larger than the last, so that the first grasps come
early.
"""

from typing import NamedTuple

FIRST = 8  # contact sets that the hand tries in the first batch
TRIED = 250
TRIED_IN_SCENE = 160
"""Most contact sets that the hand tries: fewer in a scene, because there it tries more postures for
each set.
"""
OFFERED = 4  # planned rows for each row that the hand tries


class BatchSize(NamedTuple):
    """The size of one batch: the number of new initial guesses, and of contact sets that the hand
    tries.
    """

    starts: int
    tried: int


def schedule(starts: int, most: int) -> list[BatchSize]:
    """Return batches with `starts` guesses and `most` contact sets in all; a small remainder joins
    the last batch.
    """
    growth = 6  # ratio of the sizes of successive batches
    batches = list[BatchSize]()
    size = FIRST
    most = min(most, starts)
    tried = planned = 0
    while tried < most:
        size = size if most - tried >= 2 * size else most - tried
        tried += size
        further = min(starts, max(OFFERED * tried, starts * tried // most)) - planned
        batches.append(BatchSize(further, size))
        planned = planned + further
        size = growth * size
    return batches
