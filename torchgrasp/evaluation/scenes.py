"""Campaigns in clutter: scenes are dropped, seen, planned on and executed by workers, then summed up."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.base import Value, check_number, check_whole
from torchgrasp.errors import Status
from torchgrasp.evaluation.clutter import MOVED, ClutterResult, clear_scene
from torchgrasp.evaluation.intervals import Share, count_by, share_over
from torchgrasp.evaluation.placed import drop, object_names
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.hand.load import load_hand
from torchgrasp.jobs import run_tasks
from torchgrasp.planner.things import ScenePlan, plan_scene
from torchgrasp.scene.scene import Scene
from torchgrasp.specs import ContactSpec, TrialSpec

LIMIT = 1800.0
"""Wall time [s] after which a scene is ended: many times the usual."""


@dataclasses.dataclass(frozen=True)
class ClutterSpec(Value):
    """What is asked in clutter: scenes of `count` objects, one grasp each, or as many as clear the table.

    `mask_error` grows every mask by pixels, or shrinks it if negative. `starts` are the contact planner's for each
    object. `enough` is the predicted success from which on no further object is planned. `fingers` is "auto" for the
    likeliest set of fingers for each object; None: the hand's own.
    """

    count: tuple[int, int] = (5, 8)
    mask_error: int = 0
    clear: bool = False
    starts: int = 1000
    enough: float = 0.9
    trial: TrialSpec = dataclasses.field(default_factory=TrialSpec)
    seed: int = 0
    fingers: Fingers | None = None

    def __post_init__(self) -> None:
        check_whole("count", self.count[0], 1, 20)
        check_whole("count", self.count[1], self.count[0], 20)
        check_whole("mask_error", self.mask_error, -20, 20)
        check_number("enough", self.enough, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class SceneScore(Value):
    """The outcome of a scene of some objects: the tries in their order, what was `left`, and why no more was tried.

    A `failure` of the process itself is not OK. `plan_seconds` is CPU time of all plans.
    """

    index: int
    names: tuple[str, ...]
    tries: tuple[ClutterResult, ...] = ()
    left: tuple[str, ...] = ()
    reason: str = ""
    failure: Status = Status.OK
    plan_seconds: float = 0.0


def evaluate_scenes(
    objects: Path | None, hand: Hand, scenes: int, spec: ClutterSpec | None = None, *, workers: int = 0
) -> Generator[SceneScore, None, None]:
    """Drop scenes, plan on one view of each, execute the easiest grasp, and yield the scores.

    The planner sees depth and masks only. With `spec.clear` it goes on until the table is clear.

    Args:
        objects: as in `drop`.
        scenes: how many; each has a seed of its own.
        spec: None: `ClutterSpec()`.
        workers: processes (`run_tasks`); the scores do not depend on their number.

    Raises:
        BadArgument: no objects or no scenes.
        MissingExtra: the simulator, or pebble for workers, is not installed.
    """
    check_whole("scenes", scenes, 1, 1_000_000)
    object_names(objects)
    spec = ClutterSpec() if spec is None else spec
    tasks = [(objects, hand.source, spec, index) for index in range(scenes)]
    results = run_tasks(_try_scene, tasks, workers, LIMIT)
    return (SceneScore(k, (), failure=x) if isinstance(x, Status) else x for k, x in enumerate(results))


def _try_scene(objects: Path | None, source: HandSource, spec: ClutterSpec, index: int) -> SceneScore:
    """Run one scene."""
    hand = load_hand(source.urdf_path.parent, source.option)
    seed = int(np.random.SeedSequence((spec.seed, index)).generate_state(1)[0])
    planner = functools.partial(_plan, hand=hand, spec=spec)
    placed, most = drop(objects, spec.count, seed), None if spec.clear else 1
    done = clear_scene(placed, hand, planner, spec.trial, seed, mask_error=spec.mask_error, most=most)
    return SceneScore(index, done.names, done.tries, done.left, done.reason, Status.OK, done.plan_seconds)


def _plan(scene: Scene, seed: int, hand: Hand, spec: ClutterSpec) -> ScenePlan:
    """Plan on a picture."""
    contacts = ContactSpec(friction=spec.trial.friction)
    return plan_scene(scene, hand, contacts, spec.starts, seed, fingers=spec.fingers, enough=spec.enough)


def summarise_scenes(scores: Sequence[SceneScore]) -> dict[str, Any]:
    """Return the numbers of a campaign in clutter by name.

    "lifted" is the share of scenes whose first try lifted its target; a scene without a grasp counts as failed.
    "planned" is the share of scenes with a grasp. "moved" (a neighbour by more than 20 mm), "toppled" and "early" (the
    hand touched a neighbour or the table before a finger the target) are shares of all tries. "cleared" is the share of
    all objects that were taken, "tries_per_object" the tries for each. "failures" counts statuses of the tries. Times
    are mean CPU seconds, of a scene's plans and of a trial. Intervals are over scenes.
    """
    tries = [one for score in scores for one in score.tries]
    taken = sum(one.lifted for one in tries)
    failures = Counter(one.status.name for one in tries if not one.lifted)
    failures.update(score.failure.name for score in scores if score.failure is not Status.OK)
    failures["NO_GRASP"] += sum(not score.tries and score.failure is Status.OK for score in scores)
    return {
        "lifted": _share(scores, lambda score: [bool(score.tries) and score.tries[0].lifted]),
        "planned": _share(scores, lambda score: [bool(score.tries)]),
        "moved": _share(scores, lambda score: [one.moved > MOVED for one in score.tries]),
        "toppled": _share(scores, lambda score: [one.toppled > 0 for one in score.tries]),
        "early": _share(scores, lambda score: [bool({"neighbour", "table"} & {*one.early}) for one in score.tries]),
        "cleared": _share(scores, _taken),
        "tables_cleared": _share(scores, lambda score: [bool(score.names) and not score.left]),
        "tries_per_object": len(tries) / taken if taken else None,
        "failures": {name: n for name, n in failures.most_common() if n},
        "plan_cpu_s": sum(score.plan_seconds for score in scores) / max(len(scores), 1),
        "trial_cpu_s": sum(one.trial_seconds for one in tries) / max(len(tries), 1),
    }


def _share(scores: Sequence[SceneScore], outcomes: Callable[[SceneScore], list[bool]]) -> Share:
    """Return the share of true outcomes, with its interval over scenes."""
    return share_over(count_by((str(score.index), outcome) for score in scores for outcome in outcomes(score)))


def _taken(score: SceneScore) -> list[bool]:
    """Tell as many times as objects were taken that one was, and for the others that it was not."""
    taken = sum(one.lifted for one in score.tries)
    return [k < taken for k in range(len(score.names))]


def scene_record(score: SceneScore) -> dict[str, Any]:
    """Return a score for a JSON file, without the motions."""
    tries = [{k: v for k, v in dataclasses.asdict(one).items() if k != "motion"} for one in score.tries]
    return dataclasses.asdict(dataclasses.replace(score, tries=())) | {"tries": tries}
