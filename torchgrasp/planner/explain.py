"""Why there is no grasp, and the one change that would help most: every change is tried, not guessed."""

import dataclasses
from typing import Any

from torchgrasp.base import Value
from torchgrasp.checks import Count, Seed, checked
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.changes import Change, list_changes, more_starts
from torchgrasp.planner.fingers import expected_success
from torchgrasp.planner.funnel import Funnel
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.task import Request
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.values import PointCloud

TRIAL_STARTS = 100
"""Starts with which a change is tried: two to four seconds of a busy core."""
MOST_TRIALS = 8
"""Changes that are tried at most, those that prevent most losses first."""
BESIDE, RELEVANT = 0.2, 0.25
"""Weight of what a stage lost for other reasons than a change prevents: a row names one of the constraints it fails.
And the share of the greatest sum of weights from which on a change is tried."""
SOLVED = 0.8
"""Expected success (`expected_success`) with which a change leaves little for others to add."""


@dataclasses.dataclass(frozen=True)
class Trial(Value):
    """What one change gave: the executable grasps, and the `expected_success` of the best ones.

    `choice` tells whether a user can choose the change; else it is a fact of the world.

    >>> funnel = Funnel(())
    >>> print(Trial("with friction 0.8", choice=False, executable=2, expected=1.7, funnel=funnel))
    with friction 0.8: 2 executable grasps
    """

    words: str
    choice: bool
    executable: int
    expected: float
    funnel: Funnel

    def __str__(self) -> str:
        """Return the change and what it gave."""
        return f"{self.words}: {self.executable or 'no'} executable grasp{'s' * (self.executable != 1)}"


@dataclasses.dataclass(frozen=True)
class Explanation(Value):
    """Where the grasps were lost, and what single changes gave, the most helpful first; `starts` were tried of each.

    `str` is the whole answer: a line for each stage, and the best change in a sentence.

    >>> from torchgrasp.planner import Losses
    >>> funnel = Funnel((Losses("grasps", "postures", 40, {Status.TABLE_COLLISION: 40}),))
    >>> lower = Trial("if the table were 20 mm lower", choice=True, executable=9, expected=7.5, funnel=funnel)
    >>> print(Explanation(50, funnel, (lower,)))
    grasps: 0 of 40 postures (40 table_collision)
    What would help most (1 change tried): if the table were 20 mm lower: 9 executable grasps, from 50 starts.
    """

    starts: int
    funnel: Funnel
    trials: tuple[Trial, ...]

    @property
    def best(self) -> Trial | None:
        """The change that helped most; None if none did."""
        return next((trial for trial in self.trials if trial.executable), None)

    @property
    def advice(self) -> str:
        """The change that helped most, and the best one that the user can choose; or where most is lost."""
        if self.funnel.executable:
            return f"There is a grasp: {self.funnel.executable} of {self.starts} starts ended in an executable one."
        tried = f"{len(self.trials)} change{'s' * (len(self.trials) != 1)} tried"
        helpful = [trial for trial in self.trials if trial.executable]
        if not helpful:
            lost = f"most {self.funnel.worst.things} are lost because {self.funnel.reason.sentence}"
            return f"No single change helps ({tried}): {lost}."
        chosen = next((trial for trial in helpful if trial.choice), helpful[0])
        second = f"; {chosen}" if chosen is not helpful[0] else ""
        return f"What would help most ({tried}): {helpful[0]}{second}, from {self.starts} starts."

    def __str__(self) -> str:
        """Return the stages and the advice."""
        return f"{self.funnel}\n{self.advice}"


@checked
def explain_empty(
    cloud: PointCloud | Scene,
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    **options: Any,
) -> Explanation:
    """Tell why `plan_grasps` found no executable grasp, and which single change would give some.

    Single changes are planned with at the same seed: other fingers, another shipped hand, wider limits of contacts,
    higher friction, no table, no neighbours, a free arm. Where none of them helps, more starts are. Eight changes are
    tried at most, with 100 starts each, those first that prevent most of what was lost. The rest is left out once the
    20 best grasps of a change that the user can choose are likely to succeed.

    Args:
        cloud, hand, spec, starts, seed: as of `plan_grasps`.
        options: its further ones. The `observer` is told of each change as "change", with its `Trial`.

    Returns:
        The explanation; `print` shows it.

    Raises:
        BadArgument: as of `plan_grasps`.

    >>> from torchgrasp import load_hand, load_object
    >>> spec = ContactSpec(friction=0.0, table=0.0)
    >>> explanation = explain_empty(load_object("cylinder").view, load_hand("barrett"), spec, starts=20)
    >>> explanation.best.words
    'if the friction were 0.4 instead of 0'
    """
    request = Request(cloud, hand, spec, starts, seed, **options)
    observer, few = request.observer, dataclasses.replace(request, starts=min(starts, TRIAL_STARTS))
    funnel, _, shape = try_request(few)
    changes = [] if funnel.executable else order_changes(list_changes(few), funnel)[:MOST_TRIALS]
    trials = list[Trial]()

    def tell(change: Change) -> None:
        """Try a change, and tell the observer."""
        known = shape if request.shape is None and not change.refit else request.shape
        found, expected, _ = try_request(dataclasses.replace(change.request, shape=known))
        trials.append(Trial(change.words, change.choice, found.executable, expected, found))
        observer("change", str(trials[-1]), trials[-1])

    for change in changes:
        solved = [trial.choice for trial in trials if trial.expected >= SOLVED]
        if not any(choice or not change.choice for choice in solved):
            tell(change)
    if not funnel.executable and not any(trial.executable for trial in trials):
        tell(more_starts(request))
    trials.sort(
        key=lambda trial: (-round(trial.expected, 1), -bool(trial.executable), not trial.choice, -trial.expected)
    )
    return Explanation(few.starts, funnel, tuple(trials))


def order_changes(changes: list[Change], funnel: Funnel) -> list[Change]:
    """Return the changes that could prevent much of what was lost, those that prevent most first."""
    contacts = frozenset(status for status in Status if status < Status.OUT_OF_REACH)
    weight = dict[int, float]()
    for k, change in enumerate(changes):
        beside = frozenset[Status]()
        if change.cures & contacts:
            beside |= contacts
        if change.cures - contacts:
            beside |= frozenset(Status) - contacts
        weight[k] = (1 - BESIDE) * funnel.share(change.cures) + BESIDE * funnel.share(beside)
    least = RELEVANT * max(weight.values(), default=0.0)
    return [changes[k] for k in sorted(weight, key=lambda k: -weight[k]) if 0 < weight[k] >= least]


def try_request(request: Request) -> tuple[Funnel, float, ShapeGP]:
    """Plan; return the funnel, the expected success and the estimated shape."""
    told = dict[str, Any]()
    quiet = dataclasses.replace(request, observer=lambda stage, message, value: told.update({stage: value}))
    grasps = plan_grasps(**vars(quiet))
    return Funnel.of(told["plan"], told["certify"], told["query"], grasps), expected_success(grasps), told["shape"]
