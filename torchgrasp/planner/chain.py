"""A request, planned: all of its waves together, or one after the other."""

import time
from collections.abc import Iterator

from torchgrasp.base import count_status
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.fingers import Observer, plan_sets
from torchgrasp.planner.story import describe
from torchgrasp.planner.task import Request, Work
from torchgrasp.planner.waves import plan_waves, rank_together
from torchgrasp.values import Grasps


def plan_request(request: Request) -> Grasps:
    """Return the grasps of all waves, best first, then those that failed."""
    work = Work.of(request)
    return _end(work, request, list(_waves(work)))


def stream_request(request: Request) -> Iterator[Grasps]:
    """Yield the executable grasps of each wave that has any, best first."""
    work, waves = Work.of(request), list[Grasps]()
    for grasps in _waves(work):
        waves.append(grasps)
        good = grasps[grasps.status == Status.OK]
        if len(good):
            yield good
    _end(work, request, waves)


def _waves(work: Work) -> Iterator[Grasps]:
    """Yield the grasps of each wave in the given frame; where several sets of fingers are compared, one wave."""

    def plan(hand: Hand, observer: Observer, left: int) -> Grasps:
        now = time.monotonic()
        waves = plan_waves(work.task.of(hand, observer), now + (work.deadline - now) / left)
        return rank_together(list(waves), work.task.ranking)

    only, *others = work.hands
    if others:
        hand, grasps = plan_sets(work.hands, plan, work.task.observer)
        yield work.give_back(grasps, hand)
    else:
        for grasps in plan_waves(work.task.of(only, work.task.observer), work.deadline):
            yield work.give_back(grasps, only)


def _end(work: Work, request: Request, waves: list[Grasps]) -> Grasps:
    """Return the grasps of all waves together, and tell of them."""
    grasps = rank_together(waves, work.task.ranking)
    request.observer("refine", f"{len(grasps)} refined: {describe(count_status(grasps.status))}", grasps)
    return grasps
