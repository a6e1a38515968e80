"""Which objects of a scene to take away first, so that its target can be grasped."""

import dataclasses
import functools
from collections.abc import Callable

from torchgrasp.foundation.errors import GraspError, Status
from torchgrasp.planner.changes import near_target
from torchgrasp.planner.request import is_of_call
from torchgrasp.scene.removal import take_away
from torchgrasp.scene.scene import Scene
from torchgrasp.values.planning import Grasps


@dataclasses.dataclass(frozen=True)
class ClearingNumbers:
    """Bounds on the search for objects to take away, so that the target can be grasped."""

    compared: int = 4
    """Greatest number of objects near the target of which the removal is tried in a step. They are
    the nearest: others are seldom in the way.
    """
    starts: int = 60
    """Greatest number of initial guesses with which each of these removals is planned. Few suffice,
    as only the numbers of executable grasps are compared.
    """
    removed: int = 3
    """Greatest number of objects that are taken away in all: after more, a new image is due."""


CLEARING = ClearingNumbers()


def order_to_clear(scene: Scene, plan: Callable[..., Grasps], starts: int) -> tuple[int, ...]:
    """Return labels of the objects to take away, in order, until the target has a grasp.

    In each step the four objects nearest to the target are compared. The one is taken away without
    which the target has the most executable grasps, else the nearest. The result is empty if no
    object is within 0.15 m, or if taking away three objects does not suffice.

    Args:
        scene: the scene, with its target.
        plan: function of a scene and the keyword `starts`, a number of initial guesses. It returns
            the grasps of the scene's target.
        starts: number of initial guesses; at most 60 (`CLEARING.starts`) are used.
    """
    plan = functools.partial(plan, starts=min(starts, CLEARING.starts))
    order = list[int]()
    while len(order) < CLEARING.removed:
        near = near_target(scene)[: CLEARING.compared]
        if not near:
            break
        without = {label: take_away(scene, label) for label in near}
        counts = {label: count_grasps(plan, one) for label, one in without.items()}
        # of equal ones the first is taken, which is the nearest
        best = max(near, key=lambda label: counts[label])
        order.append(best)
        scene = without[best]
        if counts[best]:
            return tuple(order)
    return ()


def count_grasps(plan: Callable[..., Grasps], scene: Scene) -> int:
    """Return the number of executable grasps that the function `plan` finds for a scene's target.

    The number is 0 if `plan` raises a `GraspError`, unless the error is one of the call
    (`is_of_call`).
    """
    try:
        return int((plan(scene).status == Status.OK).sum())
    except GraspError as error:
        if is_of_call(error):
            raise
        return 0
