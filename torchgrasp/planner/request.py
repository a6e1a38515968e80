"""The request: the checked arguments of `plan_grasps`."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Annotated, Any

from torchgrasp.arm.arm import Arm
from torchgrasp.cloud.agreement import check_where
from torchgrasp.contacts.region import Region, combine
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, GraspError, MissingExtra
from torchgrasp.foundation.fused import are_on
from torchgrasp.foundation.rules import Count, Range, Seed
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.hand.load import with_fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask, Resist
from torchgrasp.values.planning import PointCloud
from torchgrasp.values.specs import ContactSpec, Mode, Ranking

Budget = Annotated[float, Range(1e-3, math.inf)]
"""A time budget [s]."""
Promised = Annotated[float, Range(0.5, 0.99)]
"""A promised share of held grasps."""
Observer = Callable[[str, str, Any], None]
"""Function that is called after each stage with the stage's name, a line of text, and the stage's
result.
"""


Where = Callable[..., Any]
"""A `Region`, or a function that returns the signed distance [m] of points (n, 3) [m], negative
inside.
"""
FUNCTIONS = frozenset({"keep", "avoid", "spec.region", "reachable"})
"""Names, in errors, of the caller's functions: what they return shows only while planning."""


@checked
@dataclasses.dataclass(frozen=True)
class Request:
    """The checked arguments of one call of `plan_grasps`, which explains them in full.

    Args:
        cloud: the cloud [m], or the scene, with the object.
        hand: the hand.
        spec: the constraints on contacts; None means those of the mode.
        starts: number of random initial guesses.
        seed: random seed.
        fingers: the fingers that grasp; None means those of `hand`.
        mode: how planned contacts become grasps.
        ranking: criterion by which grasps are ordered; None means that of the mode.
        task: what the grasps must do; None means `GraspTask()`.
        promise: share of the executable grasps that must hold; None means no promise.
        shape: the object's shape, if it is known; None means that it is estimated.
        observer: function that is called after each stage; None means no call.
        reachable: function that says which hand poses an arm reaches; None means all of them.
        arm: the arm that carries the hand; None means no arm.
        keep: region in which all contacts lie; None means anywhere.
        avoid: region in which no contact lies; None means none.
        resist: loads that the contacts must resist; None means none.
        time_budget: wall time [s] after which no batch begins; None means no limit.
    """

    cloud: PointCloud | Scene
    hand: Hand
    spec: ContactSpec | None = None
    starts: Count = 1000
    seed: Seed = 0
    fingers: Fingers | None = None
    mode: Mode = "joint"
    ranking: Ranking | None = None
    task: GraspTask | None = None
    promise: Promised | None = None
    shape: ShapeGP | None = None
    observer: Observer | None = None
    reachable: Reachable | None = None
    arm: Arm | None = None
    keep: Where | None = None
    avoid: Where | None = None
    resist: Resist | None = None
    time_budget: Budget | None = None

    def __post_init__(self) -> None:
        """Raise `BadArgument` for arguments that contradict each other.

        These are an arm of another hand, no load to resist, and a `keep` off the object. A
        `promise` (the share of returned grasps that hold) contradicts a displaced object. The
        warning `NoEffect` tells of a box or mesh that changes nothing. One to avoid is off the
        object, or one to keep to holds all of it. Raises `MissingExtra` if compiled loops are asked
        for without numba.
        """
        are_on()
        if self.arm is not None and self.arm.hand_sha256 != self.hand.source.sha256:
            raise BadArgument(
                "arm",
                "an arm with another hand",
                f"one that load_arm gave for the {self.hand.name} hand",
            )
        if isinstance(self.resist, tuple) and not self.resist:
            raise BadArgument("resist", "no load", "at least one, or None")
        for name in ("keep", "avoid"):
            region = getattr(self, name)
            if isinstance(region, Region) and region.placed:
                check_where(name, region, self._seen)
        if self.promise is not None and self.grasp_task.displaced:
            raise BadArgument("promise", f"{self.promise:g} for a displaced object", "None")

    def deadline(self) -> float:
        """Return the time of `time.monotonic` [s] after which no batch begins, if planning begins
        now; infinite without a budget.
        """
        return math.inf if self.time_budget is None else time.monotonic() + self.time_budget

    def tell(self, stage: str, message: str, value: Any) -> None:
        """Report a stage to the observer, if there is one.

        `stage` is its name, `message` a line of text, and `value` its result.
        """
        if self.observer is not None:
            self.observer(stage, message, value)

    @property
    def _seen(self) -> PointCloud:
        """All points that the camera saw."""
        points = self.cloud.points
        eye = self.cloud.viewpoint
        return PointCloud(points, viewpoint=None if eye is None else eye.to(points))

    @property
    def contact_spec(self) -> ContactSpec:
        """The constraints on contacts, with the regions of `keep` and `avoid`.

        Without a given `spec` they are `ContactSpec()`, in mode "paper" `ContactSpec.paper()`.
        """
        spec = self.spec or (ContactSpec.paper() if self.mode == "paper" else ContactSpec())
        if self.keep is None and self.avoid is None:
            return spec
        return dataclasses.replace(spec, region=combine(self.keep, self.avoid, spec.region))

    @property
    def order(self) -> Ranking:
        """The criterion that ranks the grasps: greatest predicted "success" or least "variance".

        Without a given `ranking` it is "success", in mode "paper" "variance".
        """
        return self.ranking or ("variance" if self.mode == "paper" else "success")

    @property
    def grasp_task(self) -> GraspTask:
        """The task for which success is predicted, by default `GraspTask()`."""
        return GraspTask() if self.task is None else self.task

    @property
    def hands(self) -> tuple[Hand, ...]:
        """The hands of the plan, one for each set of fingers that may grasp."""
        return finger_sets(self.hand, self.fingers, self.mode)


def is_of_call(error: GraspError) -> bool:
    """Return whether an `error` of planning is one of the call, which no other cloud would mend.

    It tells of a package that is not installed, or of a function of the caller that returns what
    it may not.
    """
    if isinstance(error, BadArgument):
        return error.argument in FUNCTIONS
    return isinstance(error, MissingExtra)


def finger_sets(hand: Hand, fingers: Fingers | None, mode: Mode = "joint") -> tuple[Hand, ...]:
    """Return one hand for each set of fingers to plan with.

    `fingers` "auto" gives all sets that the hand declares, and a name or number gives that set.
    None gives the hand as it is. Raises `BadArgument` for fingers that the hand does not have. In a
    mode other than "joint", it is raised for more than three fingers, or "auto", too.
    """
    if fingers == "auto":
        if mode != "joint":
            raise BadArgument("fingers", f"'auto' in mode {mode!r}", "mode 'joint'")
        if "finger sets" not in hand.derived:
            found = (hand, *(with_fingers(hand, option) for option in hand.source.options))
            distinct = {one.finger_names: one for one in reversed(found)}
            hand.derived["finger sets"] = tuple(distinct.values())[::-1]
        return hand.derived["finger sets"]
    chosen = hand if fingers is None else with_fingers(hand, fingers)
    if mode != "joint":
        chosen.require_three("mode", repr(mode))
    return (chosen,)
