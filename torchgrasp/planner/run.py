"""The plan of one request: its batches, joined or one by one; of several sets of fingers the best
set's.
"""

import dataclasses
import math
import time
from collections.abc import Iterator
from typing import Any

import torch

from torchgrasp.foundation.base import count_status
from torchgrasp.foundation.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.batches import plan_hand, rank_together
from torchgrasp.planner.problem import Problem, settle_hand
from torchgrasp.planner.report import describe
from torchgrasp.planner.request import Request
from torchgrasp.values.planning import Grasps

# best grasps of a set of fingers by which the set is judged: the number that an evaluation tries of
# a view
BEST = 20


def plan_request(request: Request) -> Grasps:
    """Plan all batches; return their executable grasps, best first, and then the failed grasps."""
    return finish(request, list(_plan_batches(request)))


def stream_request(request: Request) -> Iterator[Grasps]:
    """Plan in batches; yield the executable grasps of each batch that has any, the best grasp
    first.
    """
    batches = list[Grasps]()
    for grasps in _plan_batches(request):
        batches.append(grasps)
        good = grasps[grasps.status == Status.OK]
        if len(good):
            yield good
    finish(request, batches)


def finish(request: Request, batches: list[Grasps]) -> Grasps:
    """Rank the grasps of all batches together, report them to the observer, and return them."""
    grasps = rank_together(batches, request.order)
    request.tell(
        "refine", f"{len(grasps)} refined: {describe(count_status(grasps.status))}", grasps
    )
    return grasps


def _plan_batches(request: Request) -> Iterator[Grasps]:
    """Yield the grasps of each batch in the frame of the request; several sets of fingers give a
    single batch.
    """
    deadline = math.inf if request.time_budget is None else time.monotonic() + request.time_budget
    hands = request.hands
    problem = Problem.of(request, hands[0])
    if len(hands) == 1:
        for grasps in plan_hand(problem, deadline):
            yield problem.give_back(grasps)
    else:
        yield _plan_sets(problem, hands, deadline)


def _plan_sets(problem: Problem, hands: tuple[Hand, ...], deadline: float) -> Grasps:
    """Return the grasps of the set of fingers whose expected success is greatest.

    All sets share the remaining time. The observer is called with "fingers" after each set, then
    with the stages of the best set.
    """
    best = None
    asked = problem.request
    for left, hand in zip(range(len(hands), 0, -1), hands, strict=True):
        stages = list[tuple[str, str, Any]]()
        request = dataclasses.replace(problem.request, observer=lambda *stage: stages.append(stage))  # noqa: B023
        problem = problem.replace(
            "flat", "drawn", request=request, hand=settle_hand(hand, problem.shape.device)
        )
        now = time.monotonic()
        batches = list(plan_hand(problem, now + (deadline - now) / left))
        grasps = problem.give_back(rank_together(batches, problem.request.order))
        expected = expected_success(grasps)
        count = int((grasps.status == Status.OK).sum())
        asked.tell(
            "fingers",
            f"{', '.join(hand.finger_names)}: {count} executable, {expected:.0%} expected",
            grasps,
        )
        if best is None or expected > best[0]:
            best = expected, grasps, stages
    assert best is not None
    for stage in best[2]:
        asked.tell(*stage)
    return best[1]


def expected_success(grasps: Grasps, best: int = BEST) -> float:
    """Return the mean predicted success of the `best` best executable grasps; 0 for each grasp that
    is missing.
    """
    likely = torch.where(grasps.status == Status.OK, torch.sigmoid(grasps.score), 0.0)
    return float(likely.sort(descending=True).values[:best].sum()) / best
