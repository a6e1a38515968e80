"""Trials in clutter: what the camera sees of a scene, a grasp with the neighbours present, and clearing a table."""

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value, check_whole
from torchgrasp.cloud.camera import INTRINSICS
from torchgrasp.cloud.render import render_depth
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.closing import GraspTrial
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.placed import PlacedScene, aim, settle
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.planner.things import ScenePlan
from torchgrasp.scene.scene import Scene
from torchgrasp.sim.scene import NEIGHBOURS, Neighbour
from torchgrasp.specs import TrialSpec
from torchgrasp.values import Grasps

MOVED = 0.02
"""Motion [m] of a neighbour's centre that counts."""
TOPPLED = math.radians(30)
"""Tilt of a neighbour's vertical axis that counts."""
TOUCHED = ("neighbour", "table", "target")
"""The columns of a `Disturbance`."""
TRIES = 2
"""Tries for each object before it is left."""

Planner = Callable[[Scene, int], ScenePlan]
"""Plans on a picture, with a seed."""


@dataclasses.dataclass(frozen=True)
class ClutterResult(Value):
    """The outcome of one grasp among neighbours.

    `moved` [m] is the largest motion of a neighbour's centre at the end, `toppled` counts neighbours that tilted by
    more than 30 degrees. `early` lists what the hand touched before a fingertip touched the target: neighbours, the
    table, or the target with another link. `push` [N s] is its impulse on neighbours. `success` was predicted.
    `motion` is that of every object. Times are CPU time.
    """

    name: str
    status: Status
    moved: float
    toppled: int
    early: tuple[str, ...]
    push: float
    success: float
    motion: Float[np.ndarray, "n 4 4"]
    plan_seconds: float = 0.0
    trial_seconds: float = 0.0

    @property
    def lifted(self) -> bool:
        """Whether the target was lifted and held."""
        return self.status is Status.OK


@dataclasses.dataclass(frozen=True)
class ClearResult(Value):
    """The tries at a scene in their order, and the names of what was left, with the last reason why.

    `plan_seconds` includes plans that gave no grasp.
    """

    names: tuple[str, ...]
    tries: tuple[ClutterResult, ...]
    left: tuple[str, ...]
    reason: str
    plan_seconds: float


def look(placed: PlacedScene, seed: int = 0, mask_error: int = 0) -> Scene:
    """Return what the virtual depth camera, with its noise, sees of a scene; object k has label k + 1.

    The table is fitted to the points; of the world only the direction of gravity is known.

    Args:
        seed: of the noise.
        mask_error: pixels by which every mask is grown, or shrunk if negative (`change_masks`).
    """
    depth, labels = render_depth(placed.meshes, placed.camera_pose, seed=seed)
    labels = change_masks(labels, mask_error)
    return Scene.from_depth(depth, INTRINSICS, placed.camera_pose, labels=labels, up=(0.0, 0.0, 1.0))


def change_masks(labels: Int[Tensor, "h w"], pixels: int) -> Int[Tensor, "h w"]:
    """Return labels whose every mask is grown by some pixels, or shrunk if negative.

    A pixel that several grown masks claim goes to the lowest label.

    >>> labels = torch.zeros(5, 5, dtype=torch.int64)
    >>> labels[2, 2] = 7
    >>> int((change_masks(labels, 1) == 7).sum()), int((change_masks(labels, -1) == 7).sum())
    (9, 0)
    """
    from scipy.ndimage import grey_dilation, grey_erosion

    check_whole("pixels", abs(pixels), 0, 50)
    if not pixels:
        return labels
    window, changed = (2 * abs(pixels) + 1,) * 2, torch.zeros_like(labels)
    for label in sorted(set(labels.unique().tolist()) - {0}, reverse=True):
        mask = (labels == label).numpy().astype(np.uint8)
        mask = grey_dilation(mask, size=window) if pixels > 0 else grey_erosion(mask, size=window)
        changed[torch.from_numpy(mask > 0)] = label
    return changed


def run_scene_trial(
    placed: PlacedScene, label: int, grasp: Grasps, hand: Hand, spec: TrialSpec | None = None, seed: int = 0
) -> ClutterResult:
    """Execute a grasp of one object of a scene, with all others present.

    Args:
        label: of the target, from 1.
        grasp: one row, in the world frame.
        spec: of the trial; neighbours weigh as the target does.
        seed: of the tactile noise.

    Raises:
        BadArgument: no such label; else as `close_hand`.
    """
    check_whole("label", label, 1, len(placed))
    started, k = time.process_time(), label - 1
    others = [i for i in range(len(placed)) if i != k]
    around = [Neighbour(placed.meshes[i], placed.parts[i]) for i in others]
    table = Plane.horizontal(0.0)
    trial = GraspTrial(hand, grasp, placed.meshes[k], seed, parts=placed.parts[k], table=table, neighbours=around)
    closure = lift_grasp(trial, spec)
    motion = torch.zeros(len(placed), 4, 4, dtype=torch.float64)
    motion[others], motion[k] = closure.disturbance.neighbour_pose[-1], closure.object_pose[-1]
    centres = torch.from_numpy(placed.centres())[others]
    shift = (motion[others, :3, :3] @ centres[..., None])[..., 0] + motion[others, :3, 3] - centres
    up = motion[others, 2, 2].clamp(-1.0, 1.0)
    return ClutterResult(
        name=placed.names[k],
        status=closure.status,
        moved=float(torch.linalg.vector_norm(shift, dim=-1).max()) if others else 0.0,
        toppled=int((torch.arccos(up) > TOPPLED).sum()),
        early=tuple(name for name, early in zip(TOUCHED, closure.disturbance.early, strict=True) if early),
        push=float(closure.disturbance.impulse[NEIGHBOURS]),
        success=float(grasp.success[0]),
        motion=motion.numpy(),
        trial_seconds=time.process_time() - started,
    )


def clear_scene(
    placed: PlacedScene,
    hand: Hand,
    planner: Planner,
    spec: TrialSpec | None = None,
    seed: int = 0,
    *,
    mask_error: int = 0,
    most: int | None = None,
) -> ClearResult:
    """Lift the objects of a scene one after another, each time the easiest, with a new view after each try.

    A lifted object is taken away; the others come to rest. An object is tried twice at most. It ends when nothing can
    be grasped.

    Args:
        planner: gives ranked grasps of what is seen (`plan_scene`).
        spec: of each trial; None: `TrialSpec()`.
        seed: of views, plans and trials.
        mask_error: as in `look`.
        most: tries in all; None: two for each object.
    """
    names, left, failed = placed.names, list(range(len(placed))), [0] * len(placed)
    tries: list[ClutterResult] = []
    spent, reason = 0.0, ""
    generator = torch.Generator().manual_seed(seed)
    most = TRIES * len(placed) if most is None else most
    while left and len(tries) < most:
        started = time.process_time()
        try:
            plan = planner(look(placed, seed + len(tries), mask_error), seed + len(tries))
        except BadArgument as error:  # nothing is seen any more, or no table is found around a flat thing
            reason = str(error)
            break
        finally:
            seconds = time.process_time() - started
            spent += seconds
        ready = [
            (thing.label, thing.grasps)
            for thing in plan.things
            if thing.grasps is not None and failed[left[thing.label - 1]] < TRIES
        ]
        if not ready:
            reason = "; ".join(dict.fromkeys(thing.reason for thing in plan.things if thing.reason))
            break
        label, grasps = ready[0]
        grasping = hand_of(grasps, hand) if grasps.meta else hand  # a planner of one's own may name no fingers
        result = run_scene_trial(placed, label, grasps[0], grasping, spec, seed + len(tries))
        tries.append(dataclasses.replace(result, plan_seconds=seconds))
        keep = [i for i in range(len(placed)) if not (result.lifted and i == label - 1)]
        failed[left[label - 1]] += 1
        left = [left[i] for i in keep]
        if left and len(tries) < most:
            motion = torch.from_numpy(result.motion)
            stays = torch.eye(4, dtype=torch.float64).expand_as(motion)
            placed = settle(placed, stays if result.status is Status.UNSTABLE else motion, keep)
            placed = aim(placed, generator) or placed
    return ClearResult(names, tuple(tries), tuple(names[i] for i in left), reason, spent)
