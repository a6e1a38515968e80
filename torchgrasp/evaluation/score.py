"""What attempts sum up to: shares with their intervals, reasons of failure by stage, forces and times."""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from torchgrasp.base import Value
from torchgrasp.errors import Status
from torchgrasp.evaluation.attempt import ProtocolResult

STAGES: dict[str, tuple[Status, ...]] = {
    "start": (Status.START_OVERLAP,),
    "closing": (Status.NO_CONTACT, Status.EJECTED),
    "pulling or lifting": (Status.MOVED, Status.DROPPED, Status.NOT_LIFTED, Status.TOO_WEAK),
    "simulation": (Status.UNSTABLE, Status.TIMED_OUT, Status.WORKER_DIED),
}
"""Where an attempt can fail, in the order of time, by what it then is called."""

Share = tuple[float, float, float, int]
"""A share, the ends of its 95 % Wilson interval, and of how many it is one."""


@dataclasses.dataclass(frozen=True)
class ViewScore(Value):
    """What became of the grasps of one view of one object.

    `executable` counts the grasps that the planner offered; where it offered none `refusal` is the commonest reason, or
    what ended planning, and `note` may say more. `seconds` is the CPU time of planning.
    """

    object: str
    view: str
    executable: int
    seconds: float
    attempts: tuple[ProtocolResult, ...] = ()
    refusal: Status = Status.OK
    note: str = ""


def summarise(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return what a table shows, by name.

    "gsr" is the share of all attempts that passed, "top1" that among the best-ranked grasps (a view without any counts
    as one failure for each drawn error), "objects" the share of objects with a success. "refused" counts the views
    without a grasp and "failures" the attempts without success, by stage and reason. "force_n" and "overlap_mm" are
    means, "overlap_mm_max" is the deepest, "plan_cpu_s" is for a view and "trial_cpu_s" for an attempt. "by_object"
    holds the first four for each object.
    """
    every = [attempt for score in scores for attempt in score.attempts]
    spent = [*(score.seconds for score in scores), *(a.seconds for a in every)]
    names = sorted({score.object for score in scores})
    by_object = {name: _shares([score for score in scores if score.object == name]) for name in names}
    won = sum(row["gsr"][0] > 0 for row in by_object.values())
    return {
        **_shares(scores),
        "objects": share(won, len(names)),
        "failures": failures(scores),
        "force_n": _mean(a.force for a in every),
        "overlap_mm": _mean(1e3 * a.overlap for a in every),
        "overlap_mm_max": max((1e3 * a.overlap for a in every if not math.isnan(a.overlap)), default=None),
        "plan_cpu_s": _mean(score.seconds for score in scores),
        "trial_cpu_s": _mean(a.seconds for a in every),
        "cpu_s": sum(x for x in spent if not math.isnan(x)),
        "by_object": by_object,
    }


def failures(scores: Sequence[ViewScore]) -> dict[str, dict[str, int]]:
    """Count for each stage the reasons of failure, by their names; stages without any are left out."""
    found = {"planning": Counter(s.refusal.name for s in scores if not s.attempts)}
    every = [attempt.status for score in scores for attempt in score.attempts if not attempt.passed]
    for stage, reasons in STAGES.items():
        found[stage] = Counter(status.name for status in every if status in reasons)
    return {stage: dict(counts.most_common()) for stage, counts in found.items() if counts}


def share(count: int, total: int) -> Share:
    """Return a share, its 95 % Wilson interval, and of how many it is one.

    >>> [round(x, 2) for x in share(9, 10)]
    [0.9, 0.6, 0.98, 10]
    """
    from scipy.stats import binomtest

    if not total:
        return 0.0, 0.0, 1.0, 0
    interval = binomtest(count, total).proportion_ci(method="wilson")
    return count / total, float(interval.low), float(interval.high), total


def _shares(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the shares of some views, and how many grasps they have."""
    every = [attempt for score in scores for attempt in score.attempts]
    best = [attempt for attempt in every if attempt.rank == 0]
    draws = 1 + max((attempt.draw for attempt in every), default=0)
    refused = sum(not score.attempts for score in scores)
    return {
        "gsr": share(sum(a.passed for a in every), len(every)),
        "top1": share(sum(a.passed for a in best), len(best) + refused * draws),
        "refused": refused,
        "executable": sum(score.executable for score in scores),
    }


def _mean(values: Iterable[float]) -> float | None:
    """Return the mean of what is known, or None of nothing."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else None
