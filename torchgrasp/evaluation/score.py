"""Sums over attempts: shares, failures by stage, forces and times."""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import torch

from torchgrasp.base import Value
from torchgrasp.checks import Measured, checked
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.calibration import judge
from torchgrasp.evaluation.intervals import Share, count_by, share_over
from torchgrasp.values import Grasps

STAGES: dict[str, tuple[Status, ...]] = {
    "start": (Status.START_OVERLAP,),
    "closing": (Status.NO_CONTACT, Status.EJECTED),
    "pulling or lifting": (
        Status.MOVED,
        Status.DROPPED,
        Status.NOT_LIFTED,
        Status.SLIPPED,
        Status.TOO_WEAK,
        Status.TOO_HEAVY,
    ),
    "simulation": (Status.UNSTABLE, Status.TIMED_OUT, Status.WORKER_DIED),
}
"""The stages at which an attempt can fail, in order, with their statuses."""


@checked
@dataclasses.dataclass(frozen=True)
class ProtocolResult(Value):
    """The outcome of the grasp of a `rank` under a `draw` of pose errors; NaN: not measured.

    The object moved by `moved` [m] and `turned` [rad], in a lift relative to the hand. `force` [N] is the fingers' mean
    normal force, `overlap` [m] the depth of the grasp pose in the object, `seconds` CPU time. In a lift the object
    slipped by `slip` [m] and `slip_angle` [rad] since the hand pressed. `predicted` is the grasp's predicted success.

    >>> ProtocolResult(rank=0, draw=0, passed=True, status=Status.OK, predicted=0.9).predicted
    0.9
    """

    rank: int
    draw: int
    passed: bool
    status: Status
    moved: Measured = math.nan
    turned: Measured = math.nan
    force: Measured = math.nan
    overlap: Measured = math.nan
    seconds: Measured = math.nan
    slip: Measured = math.nan
    slip_angle: Measured = math.nan
    predicted: Measured = math.nan


@checked
@dataclasses.dataclass(frozen=True)
class ViewScore(Value):
    """The outcome of a view with `executable` planned grasps.

    Without any, `refusal` is the commonest reason; `note` may say more. `seconds` is the CPU time of planning. `family`
    and `group` are the object's (`torchgrasp.data`), "" where unknown. `fingers` are those that grasp.

    >>> ViewScore("mug", "view0", executable=0, seconds=4.0, refusal=Status.OUT_OF_REACH, family="cup").unit
    'cup'
    """

    object: str
    view: str
    executable: int
    seconds: Measured
    attempts: tuple[ProtocolResult, ...] = ()
    refusal: Status = Status.OK
    note: str = ""
    family: str = ""
    group: str = ""
    fingers: str = ""

    @property
    def unit(self) -> str:
        """Return what is resampled for intervals: the family, or the object without one."""
        return self.family or self.object


@checked
def summarise(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the numbers of an evaluation by name.

    "gsr" is the share of attempts that passed; views without a grasp are not in it. "top1" is that of the best-ranked
    grasps: a view without grasps fails in every draw. "objects" is the share of objects with a success. Their intervals
    are over families (`share_over`). "by_object" and "by_group" have the same of parts. "refused" counts views without
    a grasp, "failures" the reasons of each stage, "fingers" the views by the fingers that grasp. "force_n",
    "overlap_mm", "plan_cpu_s" (of a view) and "trial_cpu_s" are means. "slip_mm" and "slip_deg" are the median and the
    95 % quantile over the grasps that held. "success" judges the predictions
    (`torchgrasp.evaluation.calibration.judge`); None without any.

    >>> held = ProtocolResult(0, 0, True, Status.OK, predicted=0.9)
    >>> lost = ViewScore("pen", "view0", 0, 3.0, refusal=Status.OUT_OF_REACH)
    >>> found = summarise([ViewScore("jug", "view0", 40, 4.0, (held,)), lost])
    >>> found["gsr"].value, found["top1"].value, found["refused"]
    (1.0, 0.5, 1)
    """
    attempts = [attempt for score in scores for attempt in score.attempts]
    spent = [*(score.seconds for score in scores), *(a.seconds for a in attempts)]
    names = sorted({score.object for score in scores})
    by_object = {name: _shares([score for score in scores if score.object == name]) for name in names}
    groups = sorted({score.group for score in scores if score.group})
    reasons_of = {"planning": Counter(s.refusal.name for s in scores if s.refusal is not Status.OK)}
    for stage, reasons in STAGES.items():
        reasons_of[stage] = Counter(a.status.name for a in attempts if not a.passed and a.status in reasons)
    return {
        **_shares(scores),
        "failures": {stage: dict(counts.most_common()) for stage, counts in reasons_of.items() if counts},
        "fingers": dict(Counter(score.fingers for score in scores if score.executable).most_common()),
        "force_n": _mean(a.force for a in attempts),
        "overlap_mm": _mean(1e3 * a.overlap for a in attempts),
        "overlap_mm_max": max((1e3 * a.overlap for a in attempts if not math.isnan(a.overlap)), default=None),
        "slip_mm": _quantiles(1e3 * a.slip for a in attempts if a.passed),
        "slip_deg": _quantiles(math.degrees(a.slip_angle) for a in attempts if a.passed),
        "plan_cpu_s": _mean(score.seconds for score in scores),
        "trial_cpu_s": _mean(a.seconds for a in attempts),
        "cpu_s": sum(x for x in spent if not math.isnan(x)),
        "success": _judge_predictions(scores),
        "by_object": by_object,
        "by_group": {name: _shares([score for score in scores if score.group == name]) for name in groups},
    }


def _shares(scores: Sequence[ViewScore]) -> dict[str, Share | int]:
    """Return shares and counts of some views."""
    draws = 1 + max((attempt.draw for score in scores for attempt in score.attempts), default=0)
    tried = [(score.unit, attempt) for score in scores for attempt in score.attempts]
    best = [(unit, attempt.passed) for unit, attempt in tried if attempt.rank == 0]
    refused = [(score.unit, False) for score in scores if not score.attempts]
    unit_of = {score.object: score.unit for score in scores}
    lifted = {score.object for score in scores if any(attempt.passed for attempt in score.attempts)}
    return {
        "gsr": share_over(count_by((unit, attempt.passed) for unit, attempt in tried)),
        "top1": share_over(count_by(best + refused * draws)),
        "objects": share_over(count_by((unit, name in lifted) for name, unit in unit_of.items())),
        "refused": len(refused),
        "executable": sum(score.executable for score in scores),
    }


def _judge_predictions(scores: Sequence[ViewScore]) -> dict[str, Any] | None:
    """Return how true predicted success was, or None where nothing was predicted."""
    known = [(score.unit, a) for score in scores for a in score.attempts if not math.isnan(a.predicted)]
    if not known:
        return None
    predicted = torch.tensor([attempt.predicted for _, attempt in known], dtype=torch.float64)
    return judge(predicted, torch.tensor([attempt.passed for _, attempt in known]), [unit for unit, _ in known])


def _quantiles(values: Iterable[float]) -> tuple[float, float] | None:
    """Return the median and the 95 % quantile of the known values, or None."""
    known = torch.tensor([value for value in values if not math.isnan(value)], dtype=torch.float64)
    if not len(known):
        return None
    median, most = known.quantile(torch.tensor([0.5, 0.95], dtype=torch.float64)).tolist()
    return median, most


def _mean(values: Iterable[float]) -> float | None:
    """Return the mean of the known values, or None."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else None


@checked
def most_certain_first(contact_order: Sequence[int], grasp: Grasps) -> bool:
    """Return whether the finger on the most certain contact was the first to touch, as Sec. 5 expects of Eq. (27).

    Args:
        contact_order: fingers by their first touch (`ClosureResult`); without any the answer is no.
        grasp: one row; of equally certain fingers any may be the first.

    Raises:
        BadArgument: not exactly one row, or contacts without `std_m`.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> order = grasp.contacts.require_std()[0].argsort().tolist()
    >>> most_certain_first(order, grasp), most_certain_first(order[::-1], grasp)
    (True, False)
    """
    if len(grasp) != 1:
        raise BadArgument("grasp", f"{len(grasp)} rows", "exactly one: index the grasps, as in grasps[0]")
    std_m = grasp.contacts.require_std()[0]
    return len(contact_order) > 0 and bool(std_m[contact_order[0]] == std_m.min())
