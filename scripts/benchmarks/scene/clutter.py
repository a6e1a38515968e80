"""Grasps among neighbours, in simulation: objects are dropped, seen, planned on and lifted, one or
all of them.
"""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.common import Options, Row, bench
from benchmarks.scene.drop import PlacedScene, aim, drop, settle
from torchgrasp import Scene, plan_scene
from torchgrasp.cloud.camera import INTRINSICS, render_depth
from torchgrasp.evaluation import GraspTrial, Share, Truth
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of, load_hand
from torchgrasp.planner import ScenePlan
from torchgrasp.sim.scene_spec import Neighbour
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec, TrialSpec

TRIES = 2
"""Tries for each object."""

Planner = Callable[[Scene, int], ScenePlan]
"""Plans on an image, with a seed."""


@dataclasses.dataclass(frozen=True)
class Clutter:
    """Scenes of `count` objects, one grasp each, or as many as `clear` the table.

    `mask_error` grows every mask by pixels, or shrinks it if negative.
    """

    objects: Path | None
    hand: str = "allegro"
    count: tuple[int, int] = (5, 8)
    mask_error: int = 0
    clear: bool = False
    starts: int = 1000
    enough: float = 0.9
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Try:
    """The outcome of one grasp among neighbours.

    `moved` [m] is the largest motion of a neighbour's centre, `toppled` counts neighbours tilted by
    more than 30 degrees. `early` lists what the hand touched before a fingertip touched the target.
    `motion` is of every object.
    """

    name: str
    status: Status
    moved: float
    toppled: int
    early: tuple[str, ...]
    motion: Float[np.ndarray, "n 4 4"] = dataclasses.field(repr=False)


@dataclasses.dataclass(frozen=True)
class SceneScore:
    """The tries at a scene in their order, the names of the objects left, and why no more was
    tried.
    """

    names: tuple[str, ...]
    tries: tuple[Try, ...] = ()
    left: tuple[str, ...] = ()
    reason: str = ""
    plan_seconds: float = 0.0


@bench("scene/clutter")
def clutter(o: Options) -> list[Row]:
    """Lift the easiest object of dropped scenes, with exact masks and with masks of 4 pixels more
    or less.
    """
    objects = o.objects[0] if o.objects else None
    asked = [
        Clutter(objects, hand, mask_error=k, starts=o.starts, seed=o.seed)
        for hand in o.hands
        for k in (0, 4, -4)
    ]
    return [row for one in asked for row in bench_clutter(one, o.times(20), o.workers)]


@bench("scene/clear")
def clear(o: Options) -> list[Row]:
    """Lift all objects of dropped scenes, one after another."""
    objects = o.objects[0] if o.objects else None
    asked = [Clutter(objects, hand, clear=True, starts=o.starts, seed=o.seed) for hand in o.hands]
    return [row for one in asked for row in bench_clutter(one, o.times(20), o.workers)]


def bench_clutter(asked: Clutter, scenes: int, workers: int) -> list[Row]:
    """Drop scenes, plan on an image of each, execute the easiest grasp, and sum up."""
    load_hand(asked.hand)
    scores = []
    for k, found in enumerate(
        run_tasks(run_scene, [(asked, k) for k in range(scenes)], workers, 1800.0)
    ):
        score = SceneScore((), reason=found.sentence) if isinstance(found, Status) else found
        tried = (
            ", ".join(f"{one.name} {one.status.name.lower()}" for one in score.tries)
            or score.reason
        )
        print(
            f"{k:5} {sum(one.status is Status.OK for one in score.tries)}/{len(score.names)} {tried}",
            flush=True,
        )
        scores.append(score)
    what = f"scenes of {asked.count[0]} to {asked.count[1]} objects, masks {asked.mask_error:+d} px, {asked.hand}"
    numbers = summarise_scenes(scores)
    shares = {name: x for name, x in numbers.items() if isinstance(x, Share)}
    if not asked.clear:
        shares = {name: x for name, x in shares.items() if "cleared" not in name}
    return [
        Row(f"{name}, {what}", "-", format_share(x, "scenes"), None, numbers)
        for name, x in shares.items()
    ]


def run_scene(asked: Clutter, index: int) -> SceneScore:
    """Drop one scene and lift from it."""
    hand = load_hand(asked.hand)
    seed = int(np.random.SeedSequence((asked.seed, index)).generate_state(1)[0])
    trial = TrialSpec()

    def plan(scene: Scene, seed: int) -> ScenePlan:
        return plan_scene(
            scene,
            hand,
            ContactSpec(friction=trial.friction),
            asked.starts,
            seed,
            enough=asked.enough,
        )

    placed = drop(asked.objects, asked.count, seed)
    most = None if asked.clear else 1
    return clear_scene(placed, hand, plan, trial, seed, mask_error=asked.mask_error, most=most)


def summarise_scenes(scores: Sequence[SceneScore]) -> dict[str, Any]:
    """Return shares with intervals over scenes, counts of failures, and the mean CPU seconds of
    planning.

    "lifted" and "planned" are of scenes and their first try, "moved" (a neighbour by more than 20
    mm), "toppled" and "early" of all tries, "cleared" of all objects.
    """

    def share(outcomes: Callable[[SceneScore], list[bool]]) -> Share:
        return share_over(
            count_by((str(k), x) for k, score in enumerate(scores) for x in outcomes(score))
        )

    def taken(score: SceneScore) -> int:
        return sum(one.status is Status.OK for one in score.tries)

    failures = Counter(
        one.status.name for score in scores for one in score.tries if one.status is not Status.OK
    )
    failures["NO_GRASP"] += sum(not score.tries for score in scores)
    return {
        "lifted at the first try": share(
            lambda score: [bool(score.tries) and score.tries[0].status is Status.OK]
        ),
        "planned": share(lambda score: [bool(score.tries)]),
        "moved a neighbour": share(lambda score: [one.moved > 0.02 for one in score.tries]),
        "toppled a neighbour": share(lambda score: [one.toppled > 0 for one in score.tries]),
        "early": share(
            lambda score: [bool({"neighbour", "table"} & {*one.early}) for one in score.tries]
        ),
        "cleared": share(lambda score: [k < taken(score) for k in range(len(score.names))]),
        "tables cleared": share(lambda score: [bool(score.names) and not score.left]),
        "failures": dict(failures.most_common()),
        "plan_cpu_s": sum(score.plan_seconds for score in scores) / max(len(scores), 1),
    }


def look(placed: PlacedScene, seed: int = 0, mask_error: int = 0) -> Scene:
    """Return a noisy depth image of a scene with true masks; object k has label k + 1."""
    depth, labels = render_depth(placed.meshes, placed.camera_pose, seed=seed)
    labels = change_masks(labels, mask_error)
    return Scene.from_depth(
        depth, INTRINSICS, placed.camera_pose, labels=labels, up=(0.0, 0.0, 1.0)
    )


def change_masks(labels: Int[Tensor, "h w"], pixels: int) -> Int[Tensor, "h w"]:
    """Return labels whose every mask is grown by some pixels, or shrunk; the lowest label wins a
    pixel.
    """
    from scipy.ndimage import grey_dilation, grey_erosion

    if not pixels:
        return labels
    window = (2 * abs(pixels) + 1,) * 2
    changed = torch.zeros_like(labels)
    for label in sorted(set(labels.unique().tolist()) - {0}, reverse=True):
        mask = (labels == label).numpy().astype(np.uint8)
        mask = grey_dilation(mask, size=window) if pixels > 0 else grey_erosion(mask, size=window)
        changed[torch.from_numpy(mask > 0)] = label
    return changed


def run_scene_trial(
    placed: PlacedScene, label: int, grasp: Grasps, hand: Hand, spec: TrialSpec, seed: int = 0
) -> Try:
    """Execute a grasp of the object with a label, with all other objects present and as heavy as
    the target.
    """
    k = label - 1
    others = [i for i in range(len(placed)) if i != k]
    around = [Neighbour(placed.meshes[i], placed.parts[i]) for i in others]
    truth = Truth(placed.meshes[k], placed.parts[k], table=Plane.horizontal(0.0), neighbours=around)
    trial = GraspTrial(hand, grasp, truth, seed)
    closure = lift_grasp(trial, spec)
    motion = torch.zeros(len(placed), 4, 4, dtype=torch.float64)
    motion[others] = closure.disturbance.neighbour_pose[-1]
    motion[k] = closure.object_pose[-1]
    centres = torch.from_numpy(placed.centres())[others]
    shift = (motion[others, :3, :3] @ centres[..., None])[..., 0] + motion[others, :3, 3] - centres
    up = motion[others, 2, 2].clamp(-1.0, 1.0)
    touched = zip(("neighbour", "table", "target"), closure.disturbance.early, strict=True)
    return Try(
        name=placed.names[k],
        status=closure.status,
        moved=float(torch.linalg.vector_norm(shift, dim=-1).max()) if others else 0.0,
        toppled=int((torch.arccos(up) > math.radians(30)).sum()),
        early=tuple(name for name, early in touched if early),
        motion=motion.numpy(),
    )


def clear_scene(
    placed: PlacedScene,
    hand: Hand,
    planner: Planner,
    spec: TrialSpec,
    seed: int = 0,
    *,
    mask_error: int = 0,
    most: int | None = None,
) -> SceneScore:
    """Lift the easiest object of a scene and look again, until no grasp is left or after `most`
    tries.
    """
    names = placed.names
    left = list(range(len(placed)))
    failed = [0] * len(placed)
    tries: list[Try] = []
    spent = 0.0
    reason = ""
    generator = torch.Generator().manual_seed(seed)
    most = TRIES * len(placed) if most is None else most
    while left and len(tries) < most:
        started = time.process_time()
        try:
            plan = planner(look(placed, seed + len(tries), mask_error), seed + len(tries))
        except BadArgument as error:  # no object is seen, or no table is found around a flat object
            reason = str(error)
            break
        finally:
            spent += time.process_time() - started
        open_things = [x for x in plan.things if failed[left[x.label - 1]] < TRIES]
        ready = [(x.label, x.grasps) for x in open_things if x.grasps is not None]
        if not ready:
            reason = "; ".join(dict.fromkeys(thing.reason for thing in plan.things if thing.reason))
            break
        label, grasps = ready[0]
        grasping = hand_of(grasps, hand) if grasps.meta else hand
        result = run_scene_trial(placed, label, grasps[0], grasping, spec, seed + len(tries))
        tries.append(result)
        keep = [
            i for i in range(len(placed)) if not (result.status is Status.OK and i == label - 1)
        ]
        failed[left[label - 1]] += 1
        left = [left[i] for i in keep]
        if left and len(tries) < most:
            placed = _look_again(placed, result, keep, generator)
    return SceneScore(names, tuple(tries), tuple(names[i] for i in left), reason, spent)


def _look_again(
    placed: PlacedScene, result: Try, keep: Sequence[int], generator: torch.Generator
) -> PlacedScene:
    """Return the objects that are left, at rest after a try, before another camera."""
    motion = torch.from_numpy(result.motion)
    rest = torch.eye(4, dtype=torch.float64).expand_as(motion)
    placed = settle(placed, rest if result.status is Status.UNSTABLE else motion, keep)
    return aim(placed, generator) or placed
