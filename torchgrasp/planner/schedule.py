"""The sizes of the planner's batches, each larger than the last: the first grasps come early."""

import dataclasses
from typing import NamedTuple

from torchgrasp.values.specs import Mode


@dataclasses.dataclass(frozen=True)
class ScheduleNumbers:
    """Parameters by which the contact sets of a plan are split into batches."""

    first: int = 8
    """Number of contact sets that the hand tries in the first batch."""
    growth: int = 6
    """Ratio of the sizes of successive batches."""
    tried: int = 250
    """Greatest number of contact sets that the hand tries in a plan."""
    tried_in_scene: int = 160
    """Greatest number of contact sets that the hand tries in a plan of a scene. They are fewer,
    because it tries more postures for each set there.
    """
    offered: int = 4
    """Number of planned contact sets for each one that the hand tries."""


SCHEDULE = ScheduleNumbers()


class BatchSize(NamedTuple):
    """The size of one batch of a plan; a plan has several, one after the other."""

    starts: int  # number of new initial guesses of the contact planner in the batch
    tried: int  # number of contact sets that the hand tries in the batch


def batch_sizes(mode: Mode, starts: int, crowded: bool) -> list[BatchSize]:
    """Return the sizes of the batches of a plan with `starts` initial guesses.

    A `mode` other than "joint" has one batch. `crowded` says whether the object is in a scene. In
    all batches the hand tries at most 250 contact sets, in a scene at most 160 (`SCHEDULE`).
    """
    most = SCHEDULE.tried_in_scene if crowded else SCHEDULE.tried
    return schedule(starts, most) if mode == "joint" else [BatchSize(starts, most)]


def schedule(starts: int, most: int) -> list[BatchSize]:
    """Return the sizes of batches with `starts` initial guesses in all.

    In all of them the hand tries `most` contact sets, or `starts` if that is less. Each batch is
    six times (`SCHEDULE.growth`) as large as the one before. A small remainder joins the last
    batch.
    """
    batches = list[BatchSize]()
    size = SCHEDULE.first
    most = min(most, starts)
    tried = 0
    planned = 0
    while tried < most:
        size = size if most - tried >= 2 * size else most - tried
        tried += size
        wanted = max(SCHEDULE.offered * tried, starts * tried // most)
        further = min(starts, wanted) - planned
        batches.append(BatchSize(further, size))
        planned += further
        size *= SCHEDULE.growth
    return batches
