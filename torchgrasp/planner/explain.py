"""Why there is no grasp: where the stages lose grasps, and which single change would help most.

Every change is tried by planning with it.
"""

import dataclasses
import math
import time
from typing import Any

from jaxtyping import Int
from torch import Tensor

from torchgrasp.arm.arm import Arm
from torchgrasp.data.accept import HandLike, SeenLike, as_hand, as_seen
from torchgrasp.foundation.base import Value, count_status
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.planner.changes import Change, list_changes, more_starts
from torchgrasp.planner.objects import Objects, ShapedObject, find_model, pose
from torchgrasp.planner.planner import plan_object
from torchgrasp.planner.ranking import expected_success, rank_together
from torchgrasp.planner.request import Budget, Observer, Promised, Request, Where
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask, Resist
from torchgrasp.values.planning import Certificate, ContactPlan, Grasps, IKSeeds
from torchgrasp.values.specs import ContactSpec, Mode, Ranking


@dataclasses.dataclass(frozen=True)
class ExplainNumbers:
    """Bounds on the work of explaining why a plan has no grasp, and weights of changes to try."""

    trials: int = 8
    """Greatest number of changes that are tried."""
    starts: int = 20
    """Number of initial guesses with which a change is tried: one takes about a second."""
    more: int = 4
    """Factor by which more initial guesses are tried as a change, for requests of few guesses."""
    postures: int = 500
    """Number of postures in the library: more take seconds for a hand that often meets itself."""
    judged: int = 5
    """Divisor: a plan of n initial guesses is judged by its best n / `judged` grasps."""
    enough: float = 0.8
    """Expected success from which on a change is good enough to end the search."""
    beside: float = 0.2
    """Weight, in [0, 1], of those failures of a stage that a change does not prevent. A failed set
    reports only one of its failures, so the change may help there, too.
    """
    least: float = 0.25
    """Least weight of a change that is tried, as a share of the greatest weight."""


EXPLAIN = ExplainNumbers()


@dataclasses.dataclass(frozen=True)
class Losses(Value):
    """How many candidates for a grasp one planning stage lost, and for which reasons.

    A candidate is an initial guess, a contact set or a hand posture, by the stage.

    Args:
        stage: name of the stage.
        things: word for the candidates that the stage was given, such as "contacts".
        given: number of candidates that the stage was given.
        lost: number of lost candidates for each reason, the most frequent reason first.
    """

    stage: str
    things: str
    given: int
    lost: dict[Status, int]

    @property
    def kept(self) -> int:
        """The number of candidates that the stage was given and did not lose."""
        return self.given - sum(self.lost.values())

    @property
    def reasons(self) -> str:
        """The reasons of the losses with their counts, as one line of text."""
        return ", ".join(f"{n} {status.name.lower()}" for status, n in self.lost.items())

    def __str__(self) -> str:
        return (
            f"{self.stage}: {self.kept} of {self.given} {self.things}"
            + f" ({self.reasons})" * bool(self.lost)
        )


@dataclasses.dataclass(frozen=True)
class Funnel(Value):
    """The losses of each planning stage, from random initial guesses to executable grasps.

    `stages` are in the order of planning. Stage "contacts" turns initial guesses into contact sets.
    Stage "postures" loses the contact sets that no hand posture comes near. The hand tries the most
    promising of the others. Stage "grasps" turns them into executable grasps; each failure is
    counted for the check that its best posture fails.
    """

    stages: tuple[Losses, ...]

    @classmethod
    @checked
    def of(cls, plan: ContactPlan, closed: Certificate, seeds: IKSeeds, grasps: Grasps) -> "Funnel":
        """Return the losses of the three stages, counted in the results of planning.

        `plan` holds the planned contact sets, and `closed` the certificates of those with force
        closure. `seeds` holds the initial hand postures for these, and `grasps` the checked grasps.
        """
        far = len(closed) - len(seeds.row.unique())
        stages = (
            Losses("contacts", "starts", len(plan), _failures(plan.status)),
            Losses(
                "postures", "contacts", far + len(grasps), {Status.OUT_OF_REACH: far} if far else {}
            ),
            Losses("grasps", "postures", len(grasps), _failures(grasps.status)),
        )
        return cls(stages)

    @property
    def executable(self) -> int:
        """The number of executable grasps, which passed all checks."""
        return self.stages[-1].kept

    @property
    def worst(self) -> Losses:
        """The first stage that lost everything, or else the stage that lost the largest share."""
        empty = next((stage for stage in self.stages if stage.given and not stage.kept), None)
        return empty or max(self.stages, key=lambda stage: 1 - stage.kept / max(stage.given, 1))

    @property
    def reason(self) -> Status:
        """The most frequent reason for the losses of the stage `worst`; `Status.OK` if it lost
        nothing.
        """
        return next(iter(self.worst.lost), Status.OK)

    @checked
    def share(self, reasons: frozenset[Status]) -> float:
        """Return the share of candidates that each stage lost for the given `reasons`, summed over
        the stages.

        The share is that of the candidates which the stage was given. A sum may exceed 1.
        """
        shares = (
            n / stage.given
            for stage in self.stages
            for status, n in stage.lost.items()
            if status in reasons
        )
        return sum(shares, 0.0)

    def __str__(self) -> str:
        return "\n".join(str(stage) for stage in self.stages if stage.given)


def _failures(status: Int[Tensor, "b"]) -> dict[Status, int]:
    """Return how often each status but OK occurs in `status`, as a dict with the most frequent
    first.
    """
    return {name: n for name, n in count_status(status).items() if name is not Status.OK}


@dataclasses.dataclass(frozen=True)
class Trial(Value):
    """The result of planning with one change.

    Args:
        words: description of the change.
        choice: whether the user can make the change; otherwise it is a change of the world, such as
            a higher friction.
        executable: number of executable grasps.
        expected: mean predicted success, in [0, 1], of the best grasps (`expected_success`).
        funnel: losses of the planning stages.
        more: whether the change is more initial guesses, whose number is in `words`.
    """

    words: str
    choice: bool
    executable: int
    expected: float
    funnel: Funnel
    more: bool = False

    def __str__(self) -> str:
        return f"{self.words}: {self.executable or 'no'} executable grasp{'s' * (self.executable != 1)}"


@dataclasses.dataclass(frozen=True)
class Explanation(Value):
    """Why planning found no executable grasp, one that passes all checks: which stage lost the
    candidates, and which single change would help.

    `explain_empty` returns it. `print(explanation)` shows one line for each planning stage, and the
    `advice`.

    Attributes:
        starts: number of initial guesses of each plan, the plan without a change and those with
            one. A plan whose change is more guesses has the number that its `words` name.
        funnel: how many candidates each planning stage lost, and why, without a change. Its field
            `stages` has an entry for "contacts", "postures" and "grasps", in this order. An entry
            has the name `stage` and the word `things` for its candidates. `given` is how many
            candidates came to the stage, and `kept` how many it kept. The dict `lost` has the
            number lost for each `Status`.
        trials: the result of planning with each change, the most helpful first. Its `words`
            describe the change, and `choice` is whether the user can make it. `executable` is the
            number of executable grasps. `expected` is the mean predicted success, in [0, 1], of the
            best of them. `funnel` has the losses.
        left: number of further changes that were not tried, to bound the work.

    >>> funnel = Funnel((Losses("grasps", "postures", 40, {Status.TABLE_COLLISION: 40}),))
    >>> words = "if the table were 20 mm lower"
    >>> lower = Trial(words, choice=True, executable=9, expected=0.75, funnel=funnel)
    >>> print(Explanation(50, funnel, (lower,)))
    grasps: 0 of 40 postures (40 table_collision)
    What would help most (1 change tried): if the table were 20 mm lower: 9 executable grasps, from 50 starts.
    """

    starts: int
    funnel: Funnel
    trials: tuple[Trial, ...]
    left: int = 0

    @property
    def best(self) -> Trial | None:
        """The most helpful change; None if no tried change gives a grasp.

        Its `words` describe the change, and `executable` is the number of grasps that passed all
        checks with it. `expected` is the mean predicted success, in [0, 1], of the best of them.
        """
        return next((trial for trial in self.trials if trial.executable), None)

    @property
    def advice(self) -> str:
        """A sentence for the user on what would help most.

        It names the most helpful change. The user may be unable to make this change, such as a
        higher friction. Then the sentence also names the most helpful change among those that the
        user can make. If no change helps, it tells of the stage that loses most candidates: the
        word for the candidates (`things`), and the reason. If there is a grasp after all, it says
        so.
        """
        if self.funnel.executable:
            return f"There is a grasp: {self.funnel.executable} of {self.starts} starts ended in an executable one."
        listed = len(self.trials) + self.left
        tried = (
            f"{len(self.trials)} of " * bool(self.left)
            + f"{listed} change{'s' * (listed != 1)} tried"
        )
        helpful = [trial for trial in self.trials if trial.executable]
        if not helpful:
            lost = f"most {self.funnel.worst.things} are lost because {self.funnel.reason.sentence}"
            return f"No single change helps ({tried}): {lost}."
        chosen = next((trial for trial in helpful if trial.choice), helpful[0])
        second = f"; {chosen}" if chosen is not helpful[0] else ""
        # a change to more guesses names their number itself
        number = "" if helpful[0].more else f", from {self.starts} starts"
        return f"What would help most ({tried}): {helpful[0]}{second}{number}."

    def __str__(self) -> str:
        return f"{self.funnel}\n{self.advice}"


@checked
@single_threaded
def explain_empty(
    cloud: SeenLike,
    hand: HandLike,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    fingers: Fingers | None = None,
    task: GraspTask | None = None,
    promise: Promised | None = None,
    reachable: Reachable | None = None,
    arm: Arm | None = None,
    keep: Where | None = None,
    avoid: Where | None = None,
    resist: Resist | None = None,
    mode: Mode = "joint",
    ranking: Ranking | None = None,
    time_budget: Budget | None = None,
    shape: ShapeGP | None = None,
    observer: Observer | None = None,
) -> Explanation:
    """Return why `plan_grasps` found no executable grasp, and which single change would give
    grasps.

    An executable grasp is one that passed all checks. Each change is tried by planning with it. The
    changes are:

    * no `keep`, `avoid` or `resist`;
    * other fingers, another shipped hand, or the `mode` "joint";
    * wider limits of contacts, or a higher friction;
    * no table, or a table at the lowest point if none was given;
    * no neighbours, or neighbours that may be pushed;
    * an arm that reaches every pose.

    The search ends at a change that the user can make and that gives grasps with a high predicted
    success. If a grasp is found without a change, no change is tried.

    Without a `time_budget`, numbers bound the work (`EXPLAIN`), so a seed always gives the same
    explanation:

    * A plan has at most 20 initial guesses, and a library of 500 postures.
    * If no contact set is found, the most relaxed constraints are tried, too.
    * At most 8 changes are tried, fewer with "auto" fingers. First come those that could prevent
      the most losses.
    * If no change helps and `starts` is at most 80, a last plan has four times `starts` guesses.

    Args:
        cloud: the cloud or scene, as in `plan_grasps`.
        hand: the hand, as in `plan_grasps`.
        spec: the constraints on contacts, as in `plan_grasps`.
        starts: number of random initial guesses. At most 20 are used, except in the last plan
            described above.
        seed: random seed.
        fingers, task, promise, reachable, arm, keep, avoid, resist, mode, ranking, shape: as in
            `plan_grasps`.
        time_budget: wall time [s] after which no change is begun; None means no limit.
        observer: function that is called with a name, a line of text and a value. First the name is
            "funnel", and the value holds the losses of the plan without a change. Then the name is
            "change", and the value is the result of each change.

    Raises `BadArgument` for a wrong argument or a bad cloud, and `HandFileError` for a bad hand, as
    `plan_grasps` does.

    >>> from torchgrasp import load_hand, load_object
    >>> spec = ContactSpec(friction=0.0, table=0.0)
    >>> cloud, hand = load_object("cylinder").view, load_hand("barrett")
    >>> explanation = explain_empty(cloud, hand, spec, starts=6)
    >>> explanation.best.words
    'if the friction were 0.4 instead of 0'
    """
    numbers = EXPLAIN
    request = Request(
        as_seen(cloud, "cloud"),
        as_hand(hand, "hand"),
        spec,
        starts,
        seed,
        fingers=fingers,
        task=task,
        promise=promise,
        reachable=reachable,
        arm=arm,
        keep=keep,
        avoid=avoid,
        resist=resist,
        mode=mode,
        ranking=ranking,
        time_budget=time_budget,
        shape=shape,
        observer=observer,
    )
    deadline = request.deadline()
    few = dataclasses.replace(request, starts=min(starts, numbers.starts))
    funnel, _, objects = try_request(few, first=request.tell)
    trials = list[Trial]()
    left = 0
    # each set of fingers needs a library of postures
    plans = numbers.trials - 2 * (len(few.hands) - 1)
    changes = [] if funnel.executable else order_changes(list_changes(few), funnel)
    for change in changes:
        good = [x for x in trials if x.expected >= numbers.enough]
        if any(x.choice >= change.choice for x in good):
            continue  # little is left for this change
        plans -= len(change.request.hands)
        if (plans < 0 and trials) or time.monotonic() >= deadline:
            left += 1
            continue
        trials.append(_try_change(change, None if change.refit else objects, request.tell))
    # more starts, only if no change helps
    if not funnel.executable and not any(x.executable for x in trials):
        if starts <= numbers.more * numbers.starts and time.monotonic() < deadline:
            more = more_starts(request, numbers.more)
            trials.append(_try_change(more, objects, request.tell))
        else:
            left += 1
    trials.sort(
        key=lambda trial: (
            -round(trial.expected, 1),
            -bool(trial.executable),
            not trial.choice,
            -trial.expected,
        )
    )
    return Explanation(few.starts, funnel, tuple(trials), left)


def _try_change(change: Change, known: Objects | None, tell: Observer) -> Trial:
    """Return the result of planning with a change, on the objects `known` if given, and report it
    to the observer.
    """
    funnel, expected, _ = try_request(change.request, known)
    trial = Trial(
        change.words, change.choice, funnel.executable, expected, funnel, more=change.more
    )
    tell("change", str(trial), trial)
    return trial


def order_changes(changes: list[Change], funnel: Funnel) -> list[Change]:
    """Return the changes that could prevent the most losses, the most helpful first.

    Changes whose weight is less than a quarter (`EXPLAIN.least`) of the greatest are left out. In
    the weight, a change counts fully for the failures that it prevents. It counts one fifth for
    other failures of the same stage. The reason is that a failed contact set reports only one of
    its failures. `funnel` holds the losses without a change.
    """
    contacts = frozenset(status for status in Status if status < Status.OUT_OF_REACH)
    weight = dict[int, float]()
    for k, change in enumerate(changes):
        beside = frozenset[Status]()
        if change.cures & contacts:
            beside |= contacts
        if change.cures - contacts:
            beside |= frozenset(Status) - contacts
        own = (1 - EXPLAIN.beside) * funnel.share(change.cures)
        weight[k] = own + EXPLAIN.beside * funnel.share(beside)
    least = EXPLAIN.least * max(weight.values(), default=0.0)
    ordered = sorted(weight, key=lambda k: -weight[k])
    return [changes[k] for k in ordered if 0 < weight[k] >= least]


def try_request(
    request: Request,
    known: Objects | None = None,
    first: Observer | None = None,
) -> tuple[Funnel, float, Objects]:
    """Plan a request with a small library of postures; return (losses, expected success, object).

    The losses are how many candidates each planning stage lost. The expected success, in [0, 1], is
    the mean predicted success of the best n / 5 grasps from n initial guesses (`EXPLAIN.judged`).
    A missing grasp counts as 0. If no contact set is found, the most relaxed constraints are tried,
    too.

    The request may allow several sets of grasping fingers. Each set then gets an equal share of the
    initial guesses; losses and success are those of the best set. The returned object is prepared
    for the last set (`pose`).

    Args:
        request: the arguments of the plan.
        known: the object of an earlier plan, whose shape and model are used again; None estimates
            the shape.
        first: function that is called with "funnel", a line of text and the losses of the first
            plan. None means no call.
    """
    told = dict[str, Any]()
    hands = request.hands
    starts = max(request.starts // len(hands), 1)
    share = dataclasses.replace(
        request, starts=starts, observer=lambda stage, _, value: told.update({stage: value})
    )
    model = find_model(share) if known is None else known.model
    object_ = ShapedObject.of(share) if known is None else known.each[0]
    found = list[tuple[Funnel, float]]()
    best = max(starts // EXPLAIN.judged, 1)
    objects = known
    for hand in hands:
        objects = pose(object_, share, hand, model, postures=EXPLAIN.postures)
        relaxed = list(objects.relaxed_specs())[-1:]
        for spec in (None, *relaxed):
            tried = objects if spec is None else objects.relaxed(spec)
            grasps = rank_together(list(plan_object(tried, math.inf)), request.order)
            funnel = Funnel.of(told["plan"], told["certify"], told["query"], grasps)
            if not found and first is not None:
                first("funnel", str(funnel.worst), funnel)
            found.append((funnel, expected_success(grasps, best)))
            if funnel.stages[0].kept:
                break
    assert objects is not None
    funnel, expected = max(found, key=lambda pair: (pair[1], pair[0].executable))
    return funnel, expected, objects
