"""Waves: few starts are planned and tried at first, then ever more, so that the first grasps come early."""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from torchgrasp.base import join
from torchgrasp.errors import Status
from torchgrasp.ik.ranking import lexical_order, rank_by_variance
from torchgrasp.plan.solve import plan_in_turn
from torchgrasp.plan.starts import check_starts
from torchgrasp.planner.choice import Offer, Untried, join_offers
from torchgrasp.planner.fingers import ignore
from torchgrasp.planner.stages import CERTAIN, OFFERED, Bench
from torchgrasp.planner.story import Story
from torchgrasp.planner.task import Task
from torchgrasp.specs import Ranking
from torchgrasp.values import Grasps

FIRST, GROWTH = 8, 6
"""Rows of contacts that the hand tries in the first wave, and how many times as many in the next. A wave costs what
some 30 rows do beside its own: two waves more made the whole call a fifth longer. After the second 56 rows have been
tried: most objects have fifty grasps then."""
HASTY = 8
"""Most steps of a hand in the first wave. Nine in ten of the seeds of the Allegro hand that succeed are done after six.
Twenty further steps of few rows cost as many calls as those of all. The second wave tries the rest again."""


class Wave(NamedTuple):
    """Numbers of further starts, and of rows of contacts that the hand tries."""

    starts: int
    tried: int


def schedule(starts: int, most: int) -> list[Wave]:
    """Return the waves in which `starts` are planned and `most` rows tried; a smaller rest joins the last wave.

    >>> [tuple(wave) for wave in schedule(1000, 250)]
    [(32, 8), (192, 48), (776, 194)]
    >>> [tuple(wave) for wave in schedule(300, 160)]
    [(32, 8), (192, 48), (76, 104)]
    """
    waves, size, most = list[Wave](), FIRST, min(most, starts)
    tried = planned = 0
    while tried < most:
        size = size if most - tried >= 2 * size else most - tried
        tried += size
        further = min(starts, max(OFFERED * tried, starts * tried // most)) - planned
        waves.append(Wave(further, size))
        planned, size = planned + further, GROWTH * size
    return waves


class Trials:
    """The grasps of all waves. Contacts slide in the last one for all rows that need it: a wave costs its own calls.

    In a wave without a grasp they slide at once. What the first wave did not solve in few steps is tried again in the
    second.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.hurried, self.waiting = list[tuple[Offer, Grasps]](), list[tuple[Offer, Grasps]]()
        self.first = True

    def take(self, offer: Offer, last: bool) -> Grasps:
        """Return the grasps of further contacts, and of those that waited if they are tried now."""
        if self.bench.task.mode != "joint":
            return self.bench.solve(offer)
        first, self.first = self.first, False
        if first and not last:
            solved, rest, failed = self.bench.touch(offer, HASTY)
            if len(solved):
                self.hurried.append((rest, failed))
                return solved
        offer = join_offers([*(rest for rest, _ in self.hurried), offer])
        self.hurried.clear()
        solved, rest, failed = self.bench.touch(offer)
        self.waiting.append((rest, failed))
        if len(solved) and not last:
            return solved
        offers, failures = zip(*self.waiting, strict=True)
        self.waiting.clear()
        return join([solved, self.bench.slide(join_offers(offers), join(failures))])

    def give_up(self) -> list[Grasps]:
        """Return the failures of all that waits."""
        return [failed for _, failed in (*self.hurried, *self.waiting)]


def plan_waves(task: Task, deadline: float) -> Iterator[Grasps]:
    """Yield the grasps of each wave, the executable ones first, in the upright frame; `meta` counts the starts so far.

    No wave begins after `deadline`, of `time.monotonic`.
    """
    check_starts(task.shape, task.spec, task.starts, task.seed)
    bench, untried, shape = Bench(task), Untried(), task.shape
    if task.observer is not ignore:
        text = f"{len(shape.x)} points, {bench.certain:.0%} of the surface certain to {1e3 * CERTAIN:g} mm"
        task.observer("shape", text, shape)
    waves = schedule(task.starts, bench.tried) if task.mode == "joint" else [Wave(task.starts, bench.tried)]
    sizes = [wave.starts for wave in waves if wave.starts]
    plans = plan_in_turn(shape, bench.settled, sizes, task.seed)
    story, planned = Story(task.observer, len(waves), len(sizes), bench.spec.planned_friction), 0
    trials = Trials(bench)
    for number, wave in enumerate(waves, start=1):
        offer = bench.find(next(plans), wave.tried, story) if wave.starts else None
        planned += wave.starts
        if task.mode == "joint":
            if offer is not None:
                untried.add(offer, bench.costs(offer))
            offer = untried.take(wave.tried)
        assert offer is not None
        grasps = bench.rank(trials.take(offer, last=number == len(waves)))
        late = time.monotonic() >= deadline
        if late:
            grasps = join([grasps, *trials.give_up()])
        story.end_wave(grasps)
        if late:
            story.stop()
        yield dataclasses.replace(grasps, meta={"starts": str(planned)})
        if late:
            return


def rank_together(waves: Sequence[Grasps], ranking: Ranking) -> Grasps:
    """Return the grasps of all waves, the executable ones first, with the metadata of the last."""
    grasps = join(waves)
    ranked = grasps[lexical_order((grasps.status != Status.OK).int(), -grasps.score)]
    ranked = ranked if ranking == "success" else rank_by_variance(ranked)
    return dataclasses.replace(ranked, meta=waves[-1].meta)
