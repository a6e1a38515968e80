"""What grasps are planned from: the arguments as given, and all of them in the upright frame of table and camera."""

import dataclasses
import math
import time
from typing import Annotated, Any, TypedDict

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Count, Range, Seed, checked
from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.errors import BadArgument
from torchgrasp.files import sha256
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import move, round_upright, upright_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.planner.fingers import Observer, finger_sets, ignore
from torchgrasp.planner.provenance import metadata
from torchgrasp.posture_model.mixture import GraspMixture, load_mixture, mixture_path
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.fit import FitOptions, fit_upright
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec, Mode, Ranking
from torchgrasp.values import Grasps, PointCloud

LEAST_BUDGET = 1e-3
"""Least time budget [s]: the first wave takes hundreds of times as long anyway."""
Budget = Annotated[float, Range(LEAST_BUDGET, math.inf)]
"""A time budget [s]."""
TARGET_POINTS = 1000
"""Points taken of a scene's target: local quadrics of as many span a centimetre, ten times a camera's noise."""


class PlanOptions(TypedDict, total=False):
    """The further arguments of `plan_grasps`, which explains them.

    >>> options: PlanOptions = {"fingers": 4, "ranking": "success"}  # plan_grasps(cloud, hand, **options)
    >>> sorted(options)
    ['fingers', 'ranking']
    """

    fingers: Fingers | None
    mode: Mode
    ranking: Ranking | None
    shape: ShapeGP | None
    observer: Observer
    reachable: Reachable | None


@checked
@dataclasses.dataclass(frozen=True)
class Request:
    """The arguments of `plan_grasps`, which explains them; here they are checked."""

    cloud: PointCloud | Scene
    hand: Hand
    spec: ContactSpec | None = None
    starts: Count = 1000
    seed: Seed = 0
    fingers: Fingers | None = None
    mode: Mode = "joint"
    ranking: Ranking | None = None
    shape: ShapeGP | None = None
    observer: Observer = ignore
    reachable: Reachable | None = None
    time_budget: Budget | None = None


@dataclasses.dataclass(frozen=True)
class Task:
    """What grasps of one hand are planned from, in the upright frame."""

    hand: Hand
    shape: ShapeGP
    spec: ContactSpec
    starts: int
    seed: int
    mode: Mode
    ranking: Ranking
    mixture: GraspMixture | None
    scene: Scene | None
    reachable: Reachable | None
    observer: Observer

    def of(self, hand: Hand, observer: Observer) -> "Task":
        """Return the task of a hand with its fingertips."""
        spec = dataclasses.replace(self.spec.for_fingertips(float(hand.tips.radius.max())), fingertips=len(hand.tips))
        return dataclasses.replace(self, hand=hand.to(self.shape.device), spec=spec, observer=observer)


@dataclasses.dataclass(frozen=True)
class Work:
    """A task, the `hands` that may do it, each a set of fingers, and the way back to the given frame.

    `cloud` and `spec` are those of the given frame; `mixture_sha256` is "none" where no learned model is asked. No wave
    begins after `deadline`, of `time.monotonic`.
    """

    task: Task
    hands: tuple[Hand, ...]
    cloud: PointCloud
    spec: ContactSpec
    obj_from_upright: Float[Tensor, "4 4"]
    mixture_sha256: str
    deadline: float

    @classmethod
    def of(cls, request: Request) -> "Work":
        """Prepare what a request asks for: the hands, the cloud in the upright frame, and its shape."""
        deadline = math.inf if request.time_budget is None else time.monotonic() + request.time_budget
        as_paper = request.mode == "paper"
        spec = (ContactSpec.paper() if as_paper else ContactSpec()) if request.spec is None else request.spec
        hands, cloud, scene = finger_sets(request.hand, request.fingers, request.mode), request.cloud, None
        if isinstance(cloud, Scene):
            scene, cloud = cloud, take_target(cloud, request.seed)
            spec = dataclasses.replace(spec, table=scene.table if spec.table is None else spec.table)
        cloud = remove_duplicates(cloud)
        mixture, mixture_sha256 = None, "none"
        if request.mode != "joint":
            path = mixture_path(request.hand.urdf_path.parent)
            mixture, mixture_sha256 = load_mixture(path), sha256(path)
        frame = upright_frame(cloud.points, cloud.viewpoint, spec.plane)
        level, reachable, observer = None if spec.table is None else 0.0, request.reachable, request.observer

        def tell(stage: str, message: str, value: Any) -> None:
            observer(stage, message, moved(value, frame))

        if request.shape is None:
            support = "paper" if as_paper else "camera"
            shape = fit_upright(round_upright(cloud, frame), request.seed, level, FitOptions(support=support))
        else:
            shape = request.shape.moved(inverse(frame))
        task = Task(
            request.hand,
            shape,
            dataclasses.replace(spec, table=level),
            request.starts,
            request.seed,
            request.mode,
            request.ranking or ("variance" if as_paper else "success"),
            mixture,
            None if scene is None else scene.to_upright(frame),
            None if reachable is None else lambda poses: reachable(frame.to(poses) @ poses),
            ignore if observer is ignore else tell,
        )
        return cls(task, hands, cloud, spec, frame, mixture_sha256, deadline)

    def give_back(self, grasps: Grasps, hand: Hand) -> Grasps:
        """Return grasps of a hand in the given frame, with their origin."""
        meta = {
            "mode": self.task.mode,
            "ranking": self.task.ranking,
            "mixture_sha256": self.mixture_sha256,
            "seed": str(self.task.seed),
        }
        meta = grasps.meta | metadata(self.cloud, hand, self.spec) | meta
        return dataclasses.replace(moved(grasps, self.obj_from_upright), meta=meta)


def moved(value: Any, obj_from_upright: Float[Tensor, "4 4"]) -> Any:
    """Return a result in the given frame."""
    return value.moved(obj_from_upright) if isinstance(value, ShapeGP) else move(value, obj_from_upright)


@checked
def take_target(scene: Scene, seed: Seed) -> PointCloud:
    """Return the cloud of a scene's target, random `TARGET_POINTS` of its points at most.

    Raises:
        BadArgument: no target, or a label that no thing has.
        TooFewPoints: fewer than 4 points.

    >>> from torchgrasp import load_scene
    >>> len(take_target(load_scene().select(2), seed=0)) <= TARGET_POINTS
    True
    """
    if scene.target not in scene.things:
        raise BadArgument("target", scene.target, f"one of the labels {list(scene.things)}: scene.select(label)")
    cloud, generator = scene.cloud(), torch.Generator().manual_seed(seed)
    rows = torch.randperm(len(cloud), generator=generator)[:TARGET_POINTS].sort().values
    return cloud.select(rows.to(cloud.points.device))
