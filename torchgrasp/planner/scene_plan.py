"""Planning for all objects of a scene: the objects are ranked by their best grasps."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

from torchgrasp.arm.arm import Arm
from torchgrasp.data.accept import HandLike, SceneLike, as_hand, as_scene
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, FailedRows, GraspError, Status
from torchgrasp.foundation.rules import Count, Fraction, Measured, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.plane import Plane, upright_frame
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.planner.clearing import order_to_clear
from torchgrasp.planner.explain import Funnel
from torchgrasp.planner.graspable import is_vague, judge_things, order_by_ease
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.request import Promised, Request, Where, finger_sets, is_of_call
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask, Resist
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec


@checked
@dataclasses.dataclass(frozen=True)
class ThingPlan(Value):
    """The plan of one object in a scene: its executable grasps, or the reason why there are none.

    `plan_scene` makes it.

    Attributes:
        label: label of the object in the scene.
        success: predicted probability that the best grasp holds. 0 means no grasps, NaN an unknown
            success.
        grasps: executable grasps, which passed all checks, best first; None if there are none.
        reason: sentence that says why there are no grasps; "" if there are.
        shape: the estimated shape of the object; None without grasps.
        status: why the object's image or its estimated shape (`TOO_VAGUE`) rules out a grasp. `OK`
            means that neither does: grasps may still be None.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "allegro")
    >>> ThingPlan(2, float(grasp.success[0]), grasp).success > 0.9
    True
    """

    label: int
    success: Measured
    grasps: Grasps | None = None
    reason: str = ""
    shape: ShapeGP | None = None
    status: Status = Status.OK


@checked
@dataclasses.dataclass(frozen=True)
class ScenePlan(Value):
    """The plans of all objects in a scene, the object with the greatest predicted success first.

    `plan_scene` makes it.

    Attributes:
        things: one plan for each object; objects without a grasp come last.
        clear: labels of objects to take away, in this order, so that the `target` of `plan_scene`
            has a grasp. It is empty without a target, if the target has a grasp, or if its
            `ThingPlan.status` rules one out. It is also empty if taking away up to three objects
            does not suffice.

    >>> empty = ThingPlan(1, success=0.0, reason="too flat")
    >>> ScenePlan((empty,)).best is None
    True
    """

    things: tuple[ThingPlan, ...]
    clear: tuple[int, ...] = ()

    @property
    def best(self) -> ThingPlan | None:
        """The `ThingPlan` of the object to grasp first; None if no object has a grasp.

        It is the object whose best grasp has the greatest predicted success.
        """
        return next((thing for thing in self.things if thing.grasps is not None), None)


@checked
@single_threaded
def plan_scene(
    scene: SceneLike,
    hand: HandLike,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    target: int | None = None,
    enough: Fraction = 1.0,
    fingers: Fingers | None = None,
    task: GraspTask | None = None,
    promise: Promised | None = None,
    reachable: Reachable | None = None,
    arm: Arm | None = None,
    keep: Where | None = None,
    avoid: Where | None = None,
    resist: Resist | None = None,
) -> ScenePlan:
    """Plan grasps of the objects in a scene; return a plan for each, the greatest predicted success
    first.

    Nothing is planned for an object whose image shows that it cannot be grasped. Its `Status` is
    then `FEW_PIXELS`, `OFF_TABLE`, `CUT_OFF`, `NO_DEPTH`, `TOO_LOW` or `TOO_WIDE`. The same holds
    if its estimated shape may be off by more than half the object (`TOO_VAGUE`).

    Of the other objects, tall ones near the camera with free space around them are planned first.
    Objects at the image border, or too large for a prediction of success, are planned last.

    With a `target`, only this object is planned. If it has no grasp, it is planned again without
    the objects nearest to it. `ScenePlan.clear` then lists the ones to take away.

    Args:
        scene: objects on a table, or a file of `save_scene`.
        hand: from `load_hand`, or its name or folder.
        spec: the constraints on contacts; None means `ContactSpec()`.
        starts: number of random initial guesses of the contact planner for each object.
        seed: random seed.
        target: label of the object to grasp; None means any object.
        enough: predicted success in [0, 1]. Once a grasp has it, the remaining objects are not
            planned.
        fingers: the fingers that grasp, as in `plan_grasps`. "auto" chooses for each object, and
            `torchgrasp.hand.hand_of` loads the hand of its grasps.
        task, promise, reachable, arm, keep, avoid, resist: as in `plan_grasps`.

    Raises:
        BadArgument: a scene without objects, an unknown `target`, or any other argument that
            `plan_grasps` refuses.
        BadArgument: a table of `spec` that fits no object to plan, or a wrong result of a function.
        CloudFileError: a file of a scene that is missing or malformed.
        HandFileError: there is no such hand, or its files are malformed.
        MissingExtra: numba is asked for and not installed.

    If an object alone cannot be planned, the `reason` of its plan is the text of the `GraspError`.

    >>> from torchgrasp import load_hand, load_scene
    >>> plan = plan_scene(load_scene(), load_hand("barrett"), starts=12, enough=0.5)
    >>> plan.best.success > 0.5, plan.things[-1].reason
    (True, 'not tried: another object is easy enough')
    """
    scene = as_scene(scene, "scene")
    hand = as_hand(hand, "hand")
    if not scene.things:
        raise BadArgument("scene", "no object on the table", "a scene with at least one object")
    seen = scene if target is None else scene.select(target)
    request = Request(
        seen,
        hand,
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
    )
    finger_sets(hand, fingers)  # raises for unknown fingers
    _check_table(seen, request.contact_spec.plane)
    plan = functools.partial(
        plan_grasps,
        hand=hand,
        spec=spec,
        starts=starts,
        seed=seed,
        fingers=fingers,
        task=task,
        promise=promise,
        reachable=reachable,
        arm=arm,
        keep=keep,
        avoid=avoid,
        resist=resist,
    )
    judged = judge_things(scene, hand, spec)
    if target is not None:
        return _plan_target(seen, judged[target], plan, starts)
    plans: list[ThingPlan] = []
    for label in order_by_ease(scene):
        if judged[label] is not Status.OK:
            plans.append(_judged_thing(label, judged[label]))
        elif any(thing.success >= enough for thing in plans):
            plans.append(ThingPlan(label, 0.0, reason="not tried: another object is easy enough"))
        else:
            plans.append(_plan_thing(scene.select(label), plan))
    # known success (highest first), then unknown success (NaN), then no grasp
    plans.sort(
        key=lambda x: (
            x.grasps is None,
            math.isnan(x.success),
            0.0 if math.isnan(x.success) else -x.success,
        )
    )
    return ScenePlan(tuple(plans))


def _check_table(scene: Scene, table: Plane | None) -> None:
    """Raise `BadArgument` for a given table that is under none of the objects to plan.

    With a target it is the only one of them. No error is raised without a given table.
    """
    if table is None:
        return
    labels = scene.things if scene.target is None else (scene.target,)
    wrong: BadArgument | None = None
    for label in labels:
        try:
            upright_frame(scene.cloud(label).points, scene.viewpoint, table)
            return
        except BadArgument as error:
            wrong = error
    assert wrong is not None
    raise wrong


def _plan_target(
    scene: Scene, judged: Status, plan: Callable[..., Grasps], starts: int
) -> ScenePlan:
    """Return the plan of a scene's target alone by the function `plan`, with what to take away.

    `judged` is what the image shows of the target; `starts` is the number of initial guesses.
    """
    assert scene.target is not None
    if judged is not Status.OK:
        return ScenePlan((_judged_thing(scene.target, judged),))
    thing = _plan_thing(scene, plan)
    # a shape that is too vague stays so
    if thing.grasps is not None or thing.status is not Status.OK:
        return ScenePlan((thing,))
    return ScenePlan((thing,), order_to_clear(scene, plan, starts))


def _judged_thing(label: int, judged: Status) -> ThingPlan:
    """Return the plan of an object that cannot be grasped, as its image shows."""
    return ThingPlan(label, 0.0, reason=judged.sentence, status=judged)


def _plan_thing(scene: Scene, plan: Callable[..., Grasps]) -> ThingPlan:
    """Return the plan of a scene's target object by the function `plan`, or the reason why it has
    no grasp.

    Raises an error of the call (`is_of_call`).
    """
    assert scene.target is not None
    stages: dict[str, Any] = {}

    def note(stage: str, message: str, value: Any) -> None:
        stages[stage] = value
        if stage == "shape" and is_vague(value):
            stages["vague"] = Status.TOO_VAGUE
            raise FailedRows(Status.TOO_VAGUE.sentence)

    try:
        grasps = plan(scene, observer=note)
    except GraspError as error:
        if is_of_call(error):
            raise
        return ThingPlan(
            scene.target, 0.0, reason=str(error), status=stages.get("vague", Status.OK)
        )
    good = grasps.executable
    if len(good):
        return ThingPlan(scene.target, float(good.success[0]), good, shape=stages["shape"])
    funnel = Funnel.of(stages["plan"], stages["certify"], stages["query"], grasps)
    return ThingPlan(scene.target, 0.0, reason=funnel.reason.sentence)
