"""Sums over attempts: shares, failures by stage, forces and times."""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from torchgrasp.base import Value
from torchgrasp.errors import Status

STAGES: dict[str, tuple[Status, ...]] = {
    "start": (Status.START_OVERLAP,),
    "closing": (Status.NO_CONTACT, Status.EJECTED),
    "pulling or lifting": (Status.MOVED, Status.DROPPED, Status.NOT_LIFTED, Status.TOO_WEAK),
    "simulation": (Status.UNSTABLE, Status.TIMED_OUT, Status.WORKER_DIED),
}
"""The stages at which an attempt can fail, in order, with their statuses."""

Share = tuple[float, float, float, int]
"""A share, the ends of its 95 % Wilson interval, and the total."""


@dataclasses.dataclass(frozen=True)
class ProtocolResult(Value):
    """The outcome of the grasp of a `rank` under a `draw` of pose errors; NaN: not measured.

    The object moved by `moved` [m] and `turned` [rad], in a lift relative to the hand. `force` [N] is the fingers' mean
    normal force, `overlap` [m] the depth of the grasp pose in the object, `seconds` CPU time.
    """

    rank: int
    draw: int
    passed: bool
    status: Status
    moved: float = math.nan
    turned: float = math.nan
    force: float = math.nan
    overlap: float = math.nan
    seconds: float = math.nan


@dataclasses.dataclass(frozen=True)
class ViewScore(Value):
    """The outcome of a view with `executable` planned grasps.

    Without any, `refusal` is the commonest reason; `note` may say more. `seconds` is the CPU time of planning.
    """

    object: str
    view: str
    executable: int
    seconds: float
    attempts: tuple[ProtocolResult, ...] = ()
    refusal: Status = Status.OK
    note: str = ""


def summarise(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the numbers of an evaluation by name.

    "gsr" is the share of attempts that passed, "top1" that of the best-ranked grasps; a view without grasps fails in
    every draw. "objects" is the share of objects with a success. "refused" counts views without a grasp, "failures" the
    reasons of each stage. "force_n", "overlap_mm", "plan_cpu_s" (of a view) and "trial_cpu_s" are means.
    """
    attempts = [attempt for score in scores for attempt in score.attempts]
    spent = [*(score.seconds for score in scores), *(a.seconds for a in attempts)]
    names = sorted({score.object for score in scores})
    by_object = {name: _shares([score for score in scores if score.object == name]) for name in names}
    passed = sum(row["gsr"][0] > 0 for row in by_object.values())
    reasons_of = {"planning": Counter(s.refusal.name for s in scores if not s.attempts)}
    for stage, reasons in STAGES.items():
        reasons_of[stage] = Counter(a.status.name for a in attempts if not a.passed and a.status in reasons)
    return {
        **_shares(scores),
        "objects": share(passed, len(names)),
        "failures": {stage: dict(counts.most_common()) for stage, counts in reasons_of.items() if counts},
        "force_n": _mean(a.force for a in attempts),
        "overlap_mm": _mean(1e3 * a.overlap for a in attempts),
        "overlap_mm_max": max((1e3 * a.overlap for a in attempts if not math.isnan(a.overlap)), default=None),
        "plan_cpu_s": _mean(score.seconds for score in scores),
        "trial_cpu_s": _mean(a.seconds for a in attempts),
        "cpu_s": sum(x for x in spent if not math.isnan(x)),
        "by_object": by_object,
    }


def share(count: int, total: int) -> Share:
    """Return a count as a share of a total.

    >>> [round(x, 2) for x in share(9, 10)]
    [0.9, 0.6, 0.98, 10]
    """
    from scipy.stats import binomtest

    if not total:
        return 0.0, 0.0, 1.0, 0
    interval = binomtest(count, total).proportion_ci(method="wilson")
    return count / total, float(interval.low), float(interval.high), total


def _shares(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return shares and counts of some views."""
    attempts = [attempt for score in scores for attempt in score.attempts]
    best = [attempt for attempt in attempts if attempt.rank == 0]
    draws = 1 + max((attempt.draw for attempt in attempts), default=0)
    refused = sum(not score.attempts for score in scores)
    return {
        "gsr": share(sum(a.passed for a in attempts), len(attempts)),
        "top1": share(sum(a.passed for a in best), len(best) + refused * draws),
        "refused": refused,
        "executable": sum(score.executable for score in scores),
    }


def _mean(values: Iterable[float]) -> float | None:
    """Return the mean of the known values, or None."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else None
