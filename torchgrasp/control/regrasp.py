"""The tries of a robot at one object. Where a lift fails, the hand opens and withdraws, and another
grasp comes next.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.control.controller import GraspController, Period
from torchgrasp.control.recovery import LiftCheck, Reopening
from torchgrasp.control.reference import check_surface
from torchgrasp.control.smooth import smooth_step
from torchgrasp.control.tactile import Observation, Targets, check_observation
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Pose, Range
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.success.loads import log_odds_about
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps


@dataclasses.dataclass(frozen=True)
class RegraspNumbers:
    """Parameters by which another grasp is chosen after a failed one."""

    gap: float = 0.015
    """Mean distance [m] between the contacts of two grasps above which they count as different."""
    turn: float = math.radians(30)
    """Angle [rad] between the approaches of two grasps above which they count as different."""
    share: float = 0.35
    """Share of the object's mass that may be concentrated at one surface point."""
    withdrawal: float = 0.6
    """Time [s] in which the opened hand withdraws, and the object rests."""
    same: float = 1e-3
    """Largest difference [m, 1] between the poses of a grasp and of its controller: rounding."""
    places: int = 64
    """Least number of surface points at which this mass is assumed in turn; fewer if the surface
    has fewer.
    """


REGRASP = RegraspNumbers()


@checked
def next_grasp(
    grasps: Grasps, tried: Sequence[int], surface: SignedDistanceField | None = None
) -> int:
    """Return the index in `grasps` of the grasp that most likely holds, after those with indices
    `tried` failed.

    Only executable grasps count whose approach or contacts differ from the tried ones
    (`list_others`). `surface` is the estimated surface of the object, in the frame of the grasps.
    With it, a failure shifts the likely centre of mass, and so the chances of the others. The first
    of the other grasps is returned in three cases: `surface` is None, the grasps have no table, or
    they are not ranked by success. Raises `BadArgument` if no other grasp is left, or if the
    surface is over 50 mm off the contacts.
    """
    _check_surface(grasps, surface)
    others = list_others(grasps, tried)
    if not len(others):
        raise BadArgument("tried", list(tried), "fewer grasps, so that another one is left to try")
    if surface is None or grasps.table is None or grasps.meta.get("ranking") != "success":
        return int(others[0])
    return int(others[_chances(grasps, grasps.table, surface, tried)[others].argmax()])


@checked
def list_others(grasps: Grasps, tried: Sequence[int]) -> Int[Tensor, "k"]:
    """Return the indices (k,) in `grasps` of the executable grasps that differ from each grasp with
    an index in `tried`.

    A grasp is executable if its `status` is `OK`. Two grasps differ if their approaches are more
    than 30 degrees apart (`REGRASP.turn`). They also differ if the mean distance of their contacts
    is more than 15 mm (`REGRASP.gap`).
    """
    approach = grasps.approach
    points = grasps.contacts.points.double()
    gaps = norm(points[:, None] - points[list(tried)]).mean(-1)  # (g, t)
    differs = (gaps > REGRASP.gap) | (approach @ approach[list(tried)].T < math.cos(REGRASP.turn))
    return flatnonzero(differs.all(-1) & (grasps.status == Status.OK))


def _check_surface(grasps: Grasps, surface: SignedDistanceField | None) -> None:
    """Raise `BadArgument` for a surface that is not at the contacts of the grasps."""
    if surface is not None and len(grasps):
        points = grasps.contacts.points.to(surface.values.device, torch.float64)
        check_surface("surface", surface, points)


def _check_started(controller: GraspController, grasp: Grasps) -> None:
    """Raise `BadArgument` for a controller of another grasp: its fingers would close elsewhere."""
    pose = controller.planned.obj_from_hand
    off = float((grasp.obj_from_hand[0].to(pose) - pose).abs().max())
    if off > REGRASP.same:
        found = f"a controller of a grasp with another pose, off by {off:.2g}"
        raise BadArgument("start", found, "a new controller of the grasp that `start` gets")


def _chances(
    grasps: Grasps, table: Plane, surface: SignedDistanceField, tried: Sequence[int]
) -> Float[Tensor, "g"]:
    """Return each grasp's probability of success given that the tried ones failed; 0 if it is
    unknown.

    A share of the mass may be at any point of the surface, which may explain the failures.
    """
    shell = (surface.values.abs() < surface.spacing).nonzero().double()
    some = shell[:: max(1, len(shell) // REGRASP.places)]
    places = surface.origin.double() + surface.spacing * some  # (p, 3)
    middle = places.mean(0)
    centers = torch.cat([middle[None], middle + REGRASP.share * (places - middle)])
    friction = Distribution.parse(grasps.meta["friction"]).mean
    log_odds = log_odds_about(grasps, centers, friction, (-table.normal).tolist())  # (g, p + 1)
    weight = torch.sigmoid(-log_odds[list(tried)]).prod(0)
    return (torch.sigmoid(log_odds) @ weight / weight.sum()).where(grasps.success > 0, 0.0)


class GraspTry:
    """One try to lift an object with one of several grasps; `next` is the robot's next try.

    The robot goes through these steps:

    1. Move the hand to `obj_from_hand`, and call `controller.step` until `controller.closed`. Each
      call is a tick, a period of the controller.
    2. Lift the hand. Go on calling `controller.step`, then `fails`, at each tick.
    3. If the lift fails, lower the hand, send the targets of `withdraw`, and go on with `next`.

    Args:
        grasps: the grasps in the order of preference.
        start: function that returns the `GraspController` of a single grasp.
        surface: estimated surface of the object (`surface_field`), by which the next grasp is
            chosen. It is in the frame of the grasps, that of the planned cloud. None if it is
            unknown.
        tried: indices of the grasps that were tried. The last one is the grasp of this try.
        moved: motion (4, 4) [m] of the object since the grasps were planned; None means no motion.

    Attributes:
        row: index of the grasp of this try.
        controller: the controller of this grasp.
        moved: motion (4, 4) [m] of the object since the grasps were planned, as far as it is known.
            It is a rigid transform in the frame of the grasps. The `controller` works in a frame
            that moves with the object. Transform a cloud for `relook` by the inverse of `moved`.

    Raises `BadArgument` if `tried` is empty, or an index in it is none of the grasps. Raises it if
    the grasp of this try failed a check of the planner, or if the surface is over 50 mm off the
    contacts. Raises it for a `start` whose controller is of another grasp.
    """

    @checked
    def __init__(
        self,
        grasps: Grasps,
        start: Callable[[Grasps], GraspController],
        surface: SignedDistanceField | None = None,
        tried: Sequence[int] = (0,),
        moved: Pose | None = None,
    ) -> None:
        if not tried or not all(0 <= row < len(grasps) for row in tried):
            raise BadArgument("tried", list(tried), f"rows of the {len(grasps)} grasps")
        status = Status(int(grasps.status[tried[-1]]))
        if status is not Status.OK:
            found = f"grasp {tried[-1]}, which failed: {status.sentence}"
            raise BadArgument("tried", found, "rows of executable grasps")
        _check_surface(grasps, surface)
        self.grasps = grasps
        self.start = start
        self.surface = surface
        self.tried = tuple(tried)
        self.row = self.tried[-1]
        self.moved = (
            torch.eye(4, dtype=torch.float64) if moved is None else moved.cpu().double().clone()
        )
        self.controller = start(grasps[self.row])
        _check_started(self.controller, grasps[self.row])
        self.check = LiftCheck(self.controller.reference)

    @property
    def obj_from_hand(self) -> Float[Tensor, "4 4"]:
        """The pose (4, 4) [m] of the closing hand's root link, in the frame of the planned cloud.

        It is the planned pose of the hand, moved with the object (`moved`).
        """
        return self.moved @ self.grasps.obj_from_hand[self.row].to(self.moved)

    @property
    def others(self) -> Int[Tensor, "k"]:
        """The indices (k,) of the grasps that are left to try.

        An executable grasp is left if it differs from each tried grasp. Two grasps differ if their
        approaches are more than 30 degrees apart (`REGRASP.turn`). They also differ if the mean
        distance of their contacts is more than 15 mm (`REGRASP.gap`).
        """
        return list_others(self.grasps, self.tried)

    @property
    def lost(self) -> bool:
        """Whether the hand detected in the lift that it loses the object. Fewer than two fingertips
        then touch, and carry less than 0.2 N, or two have slid by 1.5 mm (`LiftCheck`).
        """
        return self.check.lost

    @property
    def failed(self) -> bool:
        """Whether the lift has failed: the object is lost (`lost`), or too heavy for the hand
        (`controller.status`).
        """
        return self.lost or self.controller.status is Status.TOO_HEAVY

    @checked
    def fails(
        self, observation: Observation, height: Annotated[float, Range(-1.0, 10.0)], period: Period
    ) -> bool:
        """Return whether the lift has failed and must end: the hand loses the object, or the object
        is too heavy for it. Call it at the end of each tick, a period of the controller.

        The hand loses the object in two cases (`LiftCheck`). From a height of 10 mm on, fewer than
        two fingertips touch, and all together carry less than 0.2 N. Or two fingertips have each
        slid by more than 1.5 mm before the height was 20 mm. The object is too heavy if the
        fingertips measure more load than the hand can hold (`GraspController.status`).

        Args:
            observation: what the hand measures at the end of the tick (`observe`).
            height: height [m] of the hand above its position at the start of the lift.
            period: length [s] of the tick, 1e-5 to 1.

        Raises `BadArgument` for an observation of another hand, a period out of range, a height
        outside [-1, 10] m, or a rise by over 0.3 m in a tick.
        """
        self.check(observation, height, period)
        return self.failed

    @checked
    def withdraw(
        self, observation: Observation, period: Period, length: Annotated[float, Range(0.0, 1.0)]
    ) -> "Withdrawal":
        """Return an iterable of the `Targets` of each tick in which the lowered hand opens and
        withdraws.

        The fingers open first. Then the hand moves straight back against its approach.
        `Targets.left` [m] is how far it has moved, from 0 to `length`. In the end it waits for as
        long as it moved. The attribute `speed` [m/s] of the result is the hand's speed at the
        latest of these targets.

        Args:
            observation: the last observation, which shows where the fingers begin.
            period: length [s] of a tick, 1e-5 to 1.
            length: distance [m] by which the hand withdraws against its approach, at most 1.

        Raises `BadArgument` for an observation of another hand, or a period or a length out of
        range.
        """
        check_observation(self.controller.reference.hand, observation)
        return Withdrawal(self.controller, observation, period, length)

    def next(self) -> "GraspTry | None":
        """Return the next try, at the object where it is now expected; None if no grasp is left.

        Its grasp is the one of `others` that most likely holds, given that the tried grasps failed.
        Without a `surface` it is simply the first of `others`. The same holds for grasps that were
        planned without a table or not ranked by success.

        What this try has measured is in `meta` of the next try's `grasps`, as texts of a
        `Distribution`. `meta["friction"]` is `controller.friction`. It is set if the grasps were
        planned for a distribution of friction, and if `controller.friction` excludes 0.
        `meta["mass"]` [kg] is `controller.mass`, and is set if the object was too heavy.
        """
        if not len(self.others):
            return None
        grasps = self._informed()
        row = next_grasp(grasps, self.tried, self.surface)
        moved = self.moved @ self.controller.object_motion
        return GraspTry(grasps, self.start, self.surface, (*self.tried, row), moved)

    def _informed(self) -> Grasps:
        """Return the grasps, with what the try has shown of friction and mass."""
        controller = self.controller
        meta = dict[str, str]()
        left = controller.friction
        # a controller accepts no friction of 0
        if left is not None and left.least > 0.0:
            if isinstance(controller.reference.friction, Distribution):
                meta["friction"] = str(left)
        # a hand that loses the object does not feel its whole weight
        if controller.mass is not None and controller.status is Status.TOO_HEAVY:
            meta["mass"] = str(controller.mass)
        return dataclasses.replace(self.grasps, meta=self.grasps.meta | meta)


class Withdrawal:
    """The targets of each tick in which a hand opens, withdraws against its approach, and waits
    until the object rests.

    Iteration yields them in turn. `speed` [m/s] is the speed of the withdrawing hand at the latest
    of these targets.

    Args:
        controller: the controller of the grasp that failed.
        observation: what the hand measures now.
        period: time [s] between two ticks.
        length: distance [m] by which the hand withdraws.
    """

    def __init__(
        self, controller: GraspController, observation: Observation, period: float, length: float
    ) -> None:
        reference = controller.reference
        palm = controller.targets.palm
        here = torch.zeros(6, dtype=torch.float64)
        joints = observation.joints.clone()  # the robot may read into one buffer
        self.opening = Reopening(reference, here, joints, palm, palm + reference.rise, reach=0.0)
        self.period = period
        self.length = length
        self.speed = 0.0

    def __iter__(self) -> Iterator[Targets]:
        """Yield the targets of the ticks in turn."""
        opening = self.opening
        while not opening.done:
            joints = opening(self.period)
            yield Targets(joints, opening.palm).copied()
        ticks = max(1, round(REGRASP.withdrawal / self.period))
        for k in range(2 * ticks):
            share, rate = smooth_step(min((k + 1) / ticks, 1.0))
            self.speed = self.length * rate / (ticks * self.period)
            yield Targets(opening.opened, opening.palm, self.length * share).copied()
