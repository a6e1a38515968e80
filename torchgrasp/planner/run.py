"""The plan of one request: all batches together, or one by one. With several sets of fingers, the
best set's plan counts.
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Iterator
from typing import Any

import torch

from torchgrasp.foundation.base import count_status
from torchgrasp.foundation.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.objects import Objects, ShapedObject, find_model, pose, pose_request
from torchgrasp.planner.planner import plan_object
from torchgrasp.planner.ranking import expected_success, rank_together
from torchgrasp.planner.report import describe
from torchgrasp.planner.request import Request
from torchgrasp.values.planning import Grasps

LIKELY = 0.5
"""Predicted success of a best grasp at which constraints are not relaxed."""


def plan_request(request: Request) -> Grasps:
    """Return the grasps of a request: the executable ones, best first, and then the failed ones.

    They are in the caller's frame, that of the request's cloud.
    """
    return finish(request, list(_plan_batches(request)))


def plan_shaped(object_: ShapedObject, request: Request) -> Grasps:
    """Return the grasps of a request on an object whose shape is estimated already.

    Executable grasps come first, best first. They are in the caller's frame. The table is that of
    `object_`. Of several sets of fingers the first is used.
    """
    objects = pose(object_, request, request.hands[0], find_model(request))
    batches = [objects.give_back(grasps) for grasps in plan_hand(objects, math.inf)]
    return finish(request, batches)


def stream_request(request: Request) -> Iterator[Grasps]:
    """Yield the executable grasps of each batch, best first, as soon as the batch ends.

    A batch is planned from some of the initial guesses; one without executable grasps is left out.
    All are in the caller's frame, that of the request's cloud.
    """
    batches = list[Grasps]()
    for grasps in _plan_batches(request):
        batches.append(grasps)
        good = grasps.executable
        if len(good):
            yield good
    finish(request, batches)


def finish(request: Request, batches: list[Grasps]) -> Grasps:
    """Return the grasps of all batches, ranked together, the executable ones first.

    They are reported to the request's observer, as the stage "refine".
    """
    grasps = rank_together(batches, request.order)
    counts = describe(count_status(grasps.status))
    request.tell("refine", f"{len(grasps)} refined: {counts}", grasps)
    return grasps


def plan_hand(objects: Objects, deadline: float) -> Iterator[Grasps]:
    """Yield the grasps of the one object in `objects`, batch by batch of initial guesses.

    They are in the object's upright frame. If no grasp has a predicted success above 0.5
    (`LIKELY`), further batches are planned with relaxed constraints (`relax`). No batch begins
    after `deadline` [s], a time of `time.monotonic`.
    """
    yield from relax(objects, plan_object(objects, deadline), deadline)


def relax(objects: Objects, batches: Iterator[Grasps], deadline: float) -> Iterator[Grasps]:
    """Yield batches of grasps of a single object; if no grasp is likely to hold, plan also with
    relaxed constraints.

    The grasps are in the object's upright frame. Likely is a predicted success above 0.5
    (`LIKELY`). The surface at a contact must be flat within a radius, the largest of four that the
    object allows (`FLAT_RADII`). This can leave few contacts. With relaxed constraints
    (`ContactSpec.relaxed`) the hand may begin above its pose, too, and go down while it closes
    (`opened_pose`). Failed batches at the end of a search are yielded only for the last
    constraints. For earlier constraints, no batch after the last one with an executable grasp is
    yielded. `batches` are those of the first constraints. After `deadline` [s], a time of
    `time.monotonic`, constraints are no longer relaxed. Nor are they for an object that cannot be
    lifted out of its surroundings (`Objects.buried`).
    """
    failed = list[Grasps]()
    best = 0.0
    relaxed = (plan_object(objects.relaxed(spec), deadline) for spec in objects.relaxed_specs())
    for attempt in itertools.chain([batches], relaxed):
        failed.clear()
        for grasps in attempt:
            failed.append(grasps)
            good = grasps.executable
            if len(good):
                best = max(best, float(torch.sigmoid(good.score).max()))
                yield from failed
                failed.clear()
        if best > LIKELY or objects.buried or time.monotonic() >= deadline:
            break
    yield from failed


def _plan_batches(request: Request) -> Iterator[Grasps]:
    """Yield the grasps of each batch in the request's frame; several sets of fingers give one
    batch.
    """
    deadline = request.deadline()
    hands = request.hands
    if len(hands) == 1:
        objects = pose_request(request, hands[0])
        for grasps in plan_hand(objects, deadline):
            yield objects.give_back(grasps)
    else:
        yield _plan_sets(request, hands, deadline)


def _plan_sets(asked: Request, hands: tuple[Hand, ...], deadline: float) -> Grasps:
    """Return the grasps of the set of fingers whose expected success is greatest.

    All sets share the object and the remaining time. The observer is called with "fingers" after
    each set, then with the stages of the best set.
    """
    model = find_model(asked)
    object_ = ShapedObject.of(asked)
    best: tuple[float, Grasps, list[tuple[str, str, Any]]] | None = None
    for left, hand in zip(range(len(hands), 0, -1), hands, strict=True):
        stages = list[tuple[str, str, Any]]()
        # the stages are heard at once, so the list is the loop's own
        request = dataclasses.replace(asked, observer=lambda *stage: stages.append(stage))  # noqa: B023
        own = pose(object_, request, hand, model)
        now = time.monotonic()
        batches = list(plan_hand(own, now + (deadline - now) / left))
        grasps = own.give_back(rank_together(batches, asked.order))
        expected = expected_success(grasps)
        count = int((grasps.status == Status.OK).sum())
        names = ", ".join(hand.finger_names)
        asked.tell("fingers", f"{names}: {count} executable, {expected:.0%} expected", grasps)
        if best is None or expected > best[0]:
            best = expected, grasps, stages
    assert best is not None
    _, grasps, stages = best
    for stage in stages:
        asked.tell(*stage)
    return grasps
