"""Which thing of a scene to take first: the things ranked by their best grasps, with reasons for those without."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from torchgrasp.base import Value
from torchgrasp.checks import Count, Fraction, Seed, checked
from torchgrasp.errors import BadArgument, GraspError, Status
from torchgrasp.geometry.plane import upright_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.planner.fingers import finger_sets
from torchgrasp.planner.funnel import Funnel
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Grasps

ROOM, HEIGHT = 0.06, 0.08
"""Gap [m] to the nearest neighbour and height [m] above the table beyond which more makes nothing easier: a finger's
width on both sides, a finger's length."""
COLUMN, COVER = 0.01, 5.0
"""Side [m] of the columns in which one thing may lie above another, and the weight of their share: of a fifth, no room
at all is left."""


@checked
@dataclasses.dataclass(frozen=True)
class ThingPlan(Value):
    """The executable grasps of one thing, best first, or the reason why there are none.

    `success` is the predicted one of the best grasp, 0 without. `shape` is the estimated one, if it was planned on.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "allegro")
    >>> ThingPlan(2, float(grasp.success[0]), grasp).success > 0.9
    True
    """

    label: int
    success: float
    grasps: Grasps | None = None
    reason: str = ""
    shape: ShapeGP | None = None


@checked
@dataclasses.dataclass(frozen=True)
class ScenePlan(Value):
    """The things of a scene, the likeliest success first; then those without a grasp, and those not tried.

    >>> empty = ThingPlan(1, success=0.0, reason="too flat")
    >>> ScenePlan((empty,)).best is None
    True
    """

    things: tuple[ThingPlan, ...]

    @property
    def best(self) -> ThingPlan | None:
        """The thing to take first; None if no thing has a grasp."""
        return next((thing for thing in self.things if thing.grasps is not None), None)


@checked
def plan_scene(
    scene: Scene,
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    fingers: Fingers | None = None,
    enough: Fraction = 1.0,
    reachable: Reachable | None = None,
) -> ScenePlan:
    """Plan grasps of the things of a scene, and rank the things by predicted success.

    Things with room around them and height above the table are planned first.

    Args:
        scene: things on a table.
        hand: from `load_hand`.
        spec: the constraints on contacts; None: `ContactSpec()`.
        starts: random starts of the contact planner for each thing.
        seed: of every random draw.
        fingers: see `plan_grasps`; with "auto" each thing has its own. `hand_of(grasps, hand)` has those of grasps.
        enough: predicted success of a grasp from which on no further thing is planned; 1: all are.
        reachable: see `plan_grasps`.

    Raises:
        BadArgument: a scene without things, or an argument of the wrong type or range.

    >>> from torchgrasp import load_hand, load_scene
    >>> plan = plan_scene(load_scene(), load_hand("barrett"), starts=30, enough=0.5)
    >>> plan.best.success > 0.5, plan.things[-1].reason
    (True, 'not tried: another thing is easy enough')
    """
    if not scene.things:
        raise BadArgument("scene", "no thing on the table", "a scene with at least one thing")
    finger_sets(hand, fingers)  # refuses unknown ones
    plan = functools.partial(
        plan_grasps, hand=hand, spec=spec, starts=starts, seed=seed, fingers=fingers, reachable=reachable
    )
    plans: list[ThingPlan] = []
    for label in order_by_ease(scene):
        if any(thing.success >= enough for thing in plans):
            plans.append(ThingPlan(label, 0.0, reason="not tried: another thing is easy enough"))
            continue
        plans.append(_plan_thing(dataclasses.replace(scene, target=label), plan))
    return ScenePlan(tuple(sorted(plans, key=lambda thing: -thing.success)))


def _plan_thing(scene: Scene, plan: Callable[..., Grasps]) -> ThingPlan:
    """Plan grasps of a scene's target."""
    assert scene.target is not None
    stages: dict[str, Any] = {}

    def note(stage: str, message: str, value: object) -> None:
        stages[stage] = value

    try:
        grasps = plan(scene, observer=note)
    except GraspError as error:
        return ThingPlan(scene.target, 0.0, reason=str(error))
    good = grasps[grasps.status == Status.OK]
    if len(good):
        return ThingPlan(scene.target, float(good.success[0]), good, shape=stages["shape"])
    funnel = Funnel.of(stages["plan"], stages["certify"], stages["query"], grasps)
    return ThingPlan(scene.target, 0.0, reason=funnel.reason.sentence)


def order_by_ease(scene: Scene) -> list[int]:
    """Return the labels of a scene's things, the easiest first by a glance.

    Easy is what stands high, has room around it, and has nothing above it.
    """
    from scipy.spatial import KDTree

    upright = scene.to_upright(upright_frame(scene.points, scene.viewpoint, scene.table))
    points, labels, ease = upright.points.cpu().numpy(), upright.labels.cpu().numpy(), {}
    column = np.unique(np.floor(points[:, :2] / COLUMN), axis=0, return_inverse=True)[1].reshape(-1)
    for label in scene.things:
        own, others = points[labels == label], (labels > 0) & (labels != label)
        room = KDTree(points[others]).query(own)[0].min() if others.any() else ROOM
        top = np.full(column.max() + 1, np.inf)
        np.minimum.at(top, column[labels == label], own[:, 2])
        above = np.unique(column[others & (points[:, 2] > top[column] + COLUMN)])
        covered = len(above) / len(np.unique(column[labels == label]))
        height = np.quantile(own[:, 2], 0.95) if scene.table is not None else HEIGHT
        ease[label] = min(room / ROOM, 1.0) + min(height / HEIGHT, 1.0) - min(COVER * covered, 1.0)
    return sorted(ease, key=lambda label: -ease[label])
