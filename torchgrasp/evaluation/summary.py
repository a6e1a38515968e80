"""Summary of an evaluation: success rates, failures by stage, forces, times, and the calibration of
predicted success.
"""

import dataclasses
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.evaluation.intervals import Share, count_by, share_over
from torchgrasp.foundation.base import Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count, Measured

STAGES: dict[str, tuple[Status, ...]] = {
    "start": (Status.START_OVERLAP,),
    "closing": (Status.NO_CONTACT, Status.EJECTED),
    "pulling or lifting": (
        *(Status.MOVED, Status.DROPPED, Status.NOT_LIFTED),
        *(Status.SLIPPED, Status.TOO_WEAK, Status.TOO_HEAVY),
    ),
    "simulation": (Status.UNSTABLE, Status.TIMED_OUT, Status.WORKER_DIED),
}
"""The stages at which an attempt can fail, in order, with their statuses."""
QUANTILES = (0.5, 0.95)  # the median and a large value, which few exceed


@checked
@dataclasses.dataclass(frozen=True)
class ProtocolResult(Value):
    """The outcome of one trial of a grasp under a protocol; numbers that were not measured are NaN.

    `evaluate` makes it.

    Attributes:
        rank: rank of the grasp among the executable grasps of its view, those that passed all
            checks; 0 is the best.
        draw: index of the trial's random pose error (`PoseNoise`), from 0.
        passed: whether the trial passed: the object withstood all pulls, or the lift fulfilled the
            protocol's `criterion`.
        status: how the trial ended: `OK`, or why it failed.
        moved: motion [m] of the object's centre. In pulls it is the motion in the world from the
            start of the trial (`PullResult`). In a lift it is the motion relative to the hand from
            the end of the approach.
        turned: rotation [rad] of the object, counted as for `moved`.
        force: mean normal force [N] of the fingers, at the end of the closing for pulls, or at the
            end of a lift.
        overlap: depth [m] by which the hand at the planned posture penetrates the object, before
            any force. The trial's pose error is included. It is at most 0 without penetration.
        seconds: CPU time [s] of the trial, with all tries.
        slip: motion [m] of the object's centre in the hand from the end of pressing, in a lift.
        slip_angle: rotation [rad] of the object in the hand from the end of pressing, in a lift.
        predicted: predicted probability of success of the grasp.
        tries: number of grasps that were tried. `rank`, `predicted`, `overlap`, `gap_mm`,
            `deepest_mm` and `touch` are those of the first grasp. `passed`, `status` and all
            motions and forces are those of the last.
        cause: why a lift did not hold the object: the first cause below that applies. It is "" if
            the object was held, if the simulation diverged, or in pulls.
        size: number that goes with the `cause`, in the unit given below; NaN without a cause.
        gap_mm: largest gap [mm] between a fingertip and the object at the planned posture. It is
            measured before any force and without a pose error.
        deepest_mm: smallest such gap [mm]; negative if the fingertip penetrates the object.
        touch: verdict on these gaps, such as "touches" (`Touch.verdicts`); "" if unknown.

    The causes, each with its `size`:

    * "start overlap": the opened hand overlapped the object or the table. The size is the depth
      [mm].
    * "toppled": the object tilted by more than 30 degrees before the lift. The size is the tilt
      [deg].
    * "pushed away": the object moved by more than 20 mm before all fingers touched. The size is its
      motion [mm].
    * "ejected": the object moved by more than 20 mm between the last touch and the lift. The size
      is its motion [mm].
    * "shape off": a planned contact was more than 10 mm off the true surface. The size is the
      largest such distance [mm].
    * "never met": a finger never touched. The size is the distance [mm] of its planned contact from
      the true surface.
    * "too weak": the drives were at their limits, or the hand felt a load that it cannot hold. The
      size is the largest normal force [N] of a finger before the lift.
    * "dropped when pushed": the lifted object was lost under the push of the trial
      (`TrialSpec.push` or `Protocol.push`). The size is the force [N] of the push.
    * "turned": the object turned in the closed hand by more than 30 degrees, before it slid. The
      size is its largest rotation [deg].
    * "slid": the object slid in the closed hand, or hung on one finger. The size is its largest
      motion [mm] in the hand.
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
    tries: Count = 1
    cause: str = ""
    size: Measured = math.nan
    gap_mm: Measured = math.nan
    deepest_mm: Measured = math.nan
    touch: str = ""

    @property
    def held(self) -> bool:
        """Whether `status` is `OK`: the object withstood all pulls, or a lift held it.

        A lift holds an object if three conditions are met (`close_hand`). Its centre rose by at
        least half of the lift's height. At least two fingers touch it at the end. It slipped by
        less than 20 mm and 30 degrees in the closed hand.
        """
        return self.status is Status.OK


@checked
@dataclasses.dataclass(frozen=True)
class ViewScore(Value):
    """The outcome of one view of an object: its planning, and the trials of its grasps; `evaluate`
    makes it.

    Attributes:
        object: name of the object.
        view: name of the view; "" if the object's entry in the manifest is malformed.
        executable: number of planned grasps that are executable: they passed all checks.
        seconds: CPU time [s] of planning. It is 0 for grasps that were read from a file instead
            (`EvaluationSpec.planned`). It is NaN if the object's entry in the manifest is
            malformed, or if planning did not end.
        attempts: results of the trials, one for each tried grasp and each random pose error. A pose
            error displaces the hand or the object in a trial (`PoseNoise`).
        refusal: `OK` if a grasp is executable. If planning ended without one, it is the most
            frequent failure of its candidates. It is `OUT_OF_REACH` if no failure is recorded. It
            is `BAD_OBJECT` if a file is bad, or planning raised an error. It is `TIMED_OUT` or
            `WORKER_DIED` if planning did not end.
        note: details of the refusal, or "".
        family: name of a family of similar objects, or "".
        group: group of the object, such as "solid", or "".
        fingers: names of the grasping fingers, joined by commas.
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
        """The family of the object, or the object's name if it has no family.

        Confidence intervals resample these units.
        """
        return self.family or self.object


@checked
def summarise(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the figures of an evaluation by name, given the `scores` that `evaluate` yields.

    Success rates are `Share` values. Their 95 % intervals resample families of objects.

    * "gsr": grasp success rate, the share of trials that passed.
    * "top1": share of trials of best-ranked grasps that passed. A view without a trial counts as
      failed, once for each random pose error (`PoseNoise.draws`).
    * "objects": share of objects with at least one trial that passed.
    * "refused": number of views without a trial.
    * "executable": number of executable grasps, those that passed all checks of the planner.
    * "by_object", "by_group": dicts of the five figures above for each object and each group.
    * "tries": list of the numbers of trials that passed with the first grasp, with the second
      grasp, and so on.
    * "failures": the number of each status by stage: planning, start, closing, pulling or lifting,
      simulation.
    * "causes": for each `ProtocolResult.cause` its "count" and the counts "by_group". "median" is
      that of `ProtocolResult.size`, in the unit of the cause, or NaN.
    * "fingers": numbers of views with an executable grasp, by the grasping fingers.
    * "force_n" [N], "overlap_mm" [mm], "plan_cpu_s" [s], "trial_cpu_s" [s]: means, or None without
      values.
    * "overlap_mm_max": largest overlap [mm], or None. "cpu_s": total CPU time [s].
    * "slip_mm" [mm], "slip_deg" [deg]: (median, 95 % quantile) over the trials that passed, or
      None.
    * "gap_mm" [mm]: (median, 95 % quantile) of each trial's largest gap before any force, or None.
    * "touch": number of each verdict on these gaps (`measure_touch`).
    * "success": how well predicted success fits the outcomes, or None without predictions.
      "predicted" and "passed" are means. "brier" is the mean squared error. "skill" is 1 for
      perfect predictions, and 0 for a constant prediction, the mean. "auc" is the area under the
      ROC curve. "skill" and "auc" are NaN if all trials passed, or none. "bins" are calibration
      bins of width 0.1. A bin holds the predictions from `low` to `high`. Its `predicted` is their
      mean, and `passed` the `Share` of their trials that passed. "error" is the expected
      calibration error over these bins.

    >>> held = ProtocolResult(0, 0, True, Status.OK, predicted=0.9)
    >>> lost = ViewScore("pen", "view0", 0, 3.0, refusal=Status.OUT_OF_REACH)
    >>> found = summarise([ViewScore("jug", "view0", 40, 4.0, (held,)), lost])
    >>> found["gsr"].value, found["top1"].value, found["refused"]
    (1.0, 0.5, 1)
    """
    attempts = [attempt for score in scores for attempt in score.attempts]
    passed = [attempt for attempt in attempts if attempt.passed]
    overlaps = [1e3 * attempt.overlap for attempt in attempts]  # [mm]
    spent = [*(score.seconds for score in scores), *(attempt.seconds for attempt in attempts)]
    objects = sorted({score.object for score in scores})
    groups = sorted({score.group for score in scores if score.group})
    return {
        **_shares(scores),
        "tries": _count_tries(attempts),
        "failures": _count_failures(scores, attempts),
        "causes": _count_causes(scores),
        "fingers": _count(score.fingers for score in scores if score.executable),
        "force_n": _mean(attempt.force for attempt in attempts),
        "overlap_mm": _mean(overlaps),
        "overlap_mm_max": max(_known(overlaps), default=None),
        "slip_mm": _quantiles(1e3 * attempt.slip for attempt in passed),
        "slip_deg": _quantiles(math.degrees(attempt.slip_angle) for attempt in passed),
        "gap_mm": _quantiles(attempt.gap_mm for attempt in attempts),
        "touch": _count(attempt.touch for attempt in attempts if attempt.touch),
        "plan_cpu_s": _mean(score.seconds for score in scores),
        "trial_cpu_s": _mean(attempt.seconds for attempt in attempts),
        "cpu_s": sum(_known(spent)),
        "success": _judge_predicted(scores),
        "by_object": {x: _shares([s for s in scores if s.object == x]) for x in objects},
        "by_group": {x: _shares([s for s in scores if s.group == x]) for x in groups},
    }


def _count_tries(attempts: Sequence[ProtocolResult]) -> list[int]:
    """Return how many trials passed with the first grasp, with the second grasp, and so on."""
    most = max((attempt.tries for attempt in attempts), default=1)
    passed = Counter(attempt.tries for attempt in attempts if attempt.passed)
    return [passed[k] for k in range(1, most + 1)]


def _count_failures(
    scores: Sequence[ViewScore], attempts: Sequence[ProtocolResult]
) -> dict[str, dict[str, int]]:
    """Return the numbers of each status by the stage of the failure, without empty stages."""
    refused = (score.refusal.name for score in scores if score.refusal is not Status.OK)
    found = {"planning": _count(refused)}
    for stage, reasons in STAGES.items():
        failed = (a for a in attempts if not a.passed and a.status in reasons)
        found[stage] = _count(attempt.status.name for attempt in failed)
    return {stage: counts for stage, counts in found.items() if counts}


def _judge_predicted(scores: Sequence[ViewScore]) -> "dict[str, float | list[Bin]] | None":
    """Return how well the predictions of success fit the outcomes; None without predictions."""
    tried = [(score.unit, attempt) for score in scores for attempt in score.attempts]
    known = [(unit, attempt) for unit, attempt in tried if not math.isnan(attempt.predicted)]
    if not known:
        return None
    predicted = torch.tensor([attempt.predicted for _, attempt in known], dtype=torch.float64)
    passed = torch.tensor([attempt.passed for _, attempt in known], dtype=torch.bool)
    return judge(predicted, passed, [unit for unit, _ in known])


def _count_causes(scores: Sequence[ViewScore]) -> dict[str, dict[str, Any]]:
    """Return for each cause of objects not held its count, counts by group, and median size; the
    commonest first.
    """
    lost = [(a.cause, score.group, a.size) for score in scores for a in score.attempts if a.cause]
    found = {}
    for cause, count in _count(name for name, _, _ in lost).items():
        groups = _count(group for name, group, _ in lost if name == cause)
        sizes = _known(size for name, _, size in lost if name == cause)
        middle = statistics.median(sizes) if sizes else math.nan
        found[cause] = {"count": count, "by_group": groups, "median": middle}
    return found


def _shares(scores: Sequence[ViewScore]) -> dict[str, Share | int]:
    """Return success rates over some views, the number of views without any grasp, and that of
    executable grasps.
    """
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


def _count(values: Iterable[str]) -> dict[str, int]:
    """Return how often each value occurs, the most frequent first."""
    return dict(Counter(values).most_common())


def _known(values: Iterable[float]) -> list[float]:
    """Return the values that are not NaN."""
    return [value for value in values if not math.isnan(value)]


def _quantiles(values: Iterable[float]) -> tuple[float, float] | None:
    """Return the median and the 95 % quantile of the values that are not NaN; None if there are
    none.
    """
    known = torch.tensor(_known(values), dtype=torch.float64)
    if not len(known):
        return None
    median, most = known.quantile(torch.tensor(QUANTILES, dtype=torch.float64)).tolist()
    return median, most


def _mean(values: Iterable[float]) -> float | None:
    """Return the mean of the values that are not NaN; None if there are none."""
    known = _known(values)
    return sum(known) / len(known) if known else None


class Bin(NamedTuple):
    """A calibration bin: the trials of grasps whose predicted success is in [low, high).

    The last bin also holds predictions of 1.

    Attributes:
        low: least predicted success of the bin.
        high: upper bound of the predicted success of the bin.
        predicted: mean predicted success over the trials in the bin.
        passed: success rate of these trials.
    """

    low: float
    high: float
    predicted: float
    passed: Share


def judge(
    predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"], units: Sequence[str]
) -> dict[str, float | list[Bin]]:
    """Return calibration measures, by name, of n predicted probabilities of success, given whether
    the n trials passed.

    * "predicted", "passed": means of `predicted` (n,) and of `passed` (n,).
    * "brier": mean squared error of the predictions.
    * "skill": 1 for perfect predictions, and 0 for always predicting the mean.
    * "auc": area under the ROC curve.
    * "bins": list of `Bin`, each for an interval of width 0.1 of the prediction.
    * "error": expected calibration error over these bins.

    "skill" and "auc" are NaN if all trials passed, or none. `units` has n names, such as the families of the
    objects. Trials with the same name count as dependent in the bins' confidence intervals.
    """
    outcome = passed.to(predicted)
    brier = float((predicted - outcome).square().mean())
    rate = outcome.mean()
    bins = _bins(predicted, passed, units)
    off = sum(abs(x.predicted - x.passed.value) * x.passed.total for x in bins)
    return {
        "predicted": float(predicted.mean()),
        "passed": float(rate),
        "brier": brier,
        "skill": 1 - brier / float(rate * (1 - rate)) if 0 < rate < 1 else math.nan,
        "auc": _area_under_curve(predicted, passed),
        "error": off / len(passed) if bins else math.nan,
        "bins": bins,
    }


def _bins(
    predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"], units: Sequence[str]
) -> list[Bin]:
    """Return calibration bins of width 0.1 of the predicted probability, without the empty ones."""
    at = (predicted * 10).long().clamp(0, 9)
    bins = []
    for k in at.unique().tolist():
        rows: list[int] = flatnonzero(at == k).tolist()
        counts = count_by((units[row], bool(passed[row])) for row in rows)
        bins.append(Bin(k / 10, (k + 1) / 10, float(predicted[rows].mean()), share_over(counts)))
    return bins


def _area_under_curve(predicted: Float[Tensor, "n"], passed: Bool[Tensor, "n"]) -> float:
    """Return the area under the ROC curve: how often a passed trial had a higher prediction than a
    failed one.
    """
    good = predicted[passed]
    bad = predicted[~passed].sort().values
    if not len(good) or not len(bad):
        return math.nan
    below = torch.searchsorted(bad, good)
    upto = torch.searchsorted(bad, good, right=True)
    return float((below + upto).double().mean()) / 2 / len(bad)
