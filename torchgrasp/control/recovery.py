"""Recovery when the object is not where the camera placed it.

An approach stops at a touch, and a hand that is about to fail reopens and closes again. A lift is
watched. Approach and reopening locate the object from touches (`Localization`) and move the palm to
it. Vectors are in the frame of the planned hand; a displacement of the palm is relative to its
planned pose.
"""

import dataclasses
import math
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import least_friction_forces, tangential_ratio
from torchgrasp.control.object_pose import Localization, Touches
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.sensing import TORQUE_NOISE
from torchgrasp.control.tactile import EARLY, Observation, check_observation, silenced, smooth
from torchgrasp.control.uncertainty_closing import PALM_SPEED
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.linalg import limit_norm, norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.distribution import Distribution

# time [s] from the end of closing until the hand counts as closed, and may be lifted: by then the
# holding mode "grip" presses with its whole reserve for an unknown weight
PRESSING_TIME = 0.9


@dataclasses.dataclass(frozen=True)
class ApproachNumbers:
    """Parameters of `GuardedApproach`, an approach that stops at a touch."""

    speed: float = 0.1
    """Largest speed [m/s] of the hand."""
    acceleration: float = 1.0
    """Acceleration and deceleration [m/s^2] of the hand."""
    back: float = 0.02
    """Distance [m] by which the hand draws back at a touch."""
    feeling: float = 0.06
    """Time [s] in which touches are averaged."""
    # a link touches where its drive feels more than the noise and the inertia
    start: float = 0.02
    """Length [m] at the start, far from the object, in which drives sense only the inertia."""
    moving: float = 0.05
    """Least speed [m/s] of the hand at which the drives' torques count: it has not just stopped."""
    noises: float = 3.0
    """Largest joint torque that counts as noise, in standard deviations of the noise."""


@dataclasses.dataclass(frozen=True)
class GraspCheckNumbers:
    """Parameters of `GraspCheck`, the check of a pressing grasp before the lift."""

    first: float = 0.1
    """Time [s] of pressing from which touches are averaged."""
    last: float = 0.3
    """Time [s] of pressing until which touches are averaged."""
    judging: float = 0.5
    """Time [s] of pressing after which the grasp is judged: the forces are those of the closing."""
    misplaced: float = 0.008
    """Largest difference [m] of two translations in a secure grasp: those of object and palm since
    the planned poses. It is twice the error of the estimated translation.
    """


@dataclasses.dataclass(frozen=True)
class OpeningTimes:
    """Times of `Reopening`, the controller that opens a hand again before another closing."""

    opening: float = 0.5
    """Time [s] in which the fingers open."""
    rest: float = 0.1
    """Time [s] for which the open hand then rests."""


@dataclasses.dataclass(frozen=True)
class LostNumbers:
    """Bounds at which a rising hand counts as having lost its object."""

    load: float = 0.2
    """Load [N] along the table's normal below which the object counts as not carried."""
    cutoff: float = 3.0
    """Cut-off frequency [Hz] of the low-pass filter of the load."""
    first: float = 0.01
    """Height [m] of the lift above which the object counts as lost if touches are missing."""
    low: float = 0.02
    """Height [m] of the lift up to which slides are summed."""
    slip: float = 0.0015
    """Distance [m] that two fingertips each slide, beyond which the hand will lose the object."""
    rise: float = 0.3
    """Largest rise [m] between two ticks: a larger one is a height above the robot's base."""


APPROACH = ApproachNumbers()
CHECK = GraspCheckNumbers()
OPENING = OpeningTimes()
LOST = LostNumbers()


def can_guard(reference: ClosingReference) -> bool:
    """Return whether the hand can stop its approach at a touch.

    It can if the plan `reference` has an approach, a table and a surface, and its fingertips are
    tactile.
    """
    needed = reference.approach, reference.table, reference.surface
    return reference.sensor.kind == "tactile" and all(x is not None for x in needed)


class GuardedApproach:
    """Controller that moves the opened hand to its pre-grasp, and stops it when a finger touches
    (guarded move).

    Fingertips sense a touch, and the drives of the joints sense touches of other links. At a touch
    the hand draws back at once, so that it pushes the object little. It averages its touch
    readings, locates the object, moves its palm sideways and goes on. After the last allowed stop
    the hand ignores touches.

    `left` [m] is the remaining length of the approach, and `stops` the number of stops. `palm` (3,)
    [m] is the palm's displacement from its planned path. `displacement` (6,) holds the object's
    translation [m] and rotation vector [rad] at the last touch. Both are in the planned hand's
    frame.

    Args:
        reference: the closing plan, with an approach, a table and a surface.
        options: options of the closing.
        length: distance [m] of the hand from its pre-grasp at the start.
        felt: list to which the touches of each stop (`Touches`) are appended.
        after: the `Reopening` of a hand that has closed before. The hand then starts at its
            pre-grasp, and retreats first. None means that it has not closed yet.
    """

    def __init__(
        self,
        reference: ClosingReference,
        options: ClosingOptions,
        length: float,
        felt: list[Touches],
        after: "Reopening | None" = None,
    ) -> None:
        assert reference.approach is not None
        self.reference = reference
        self.options = options
        self.length = length
        self.direction = reference.approach
        self.left = length
        self.speed = 0.0
        self.retreat = 0.0
        self.stops = 0
        self.palm = reference.rise
        self.goal = reference.rise
        self.displacement = torch.zeros(6, dtype=torch.float64)
        self.time = 0.0
        self.feeling = False
        self.rest = None
        self.inertia = torch.zeros_like(reference.kp)
        if after is not None:
            self.left = 0.0
            self.palm = after.palm
            self._turn_to(after.displacement)
        self.felt = felt
        self.search = Localization(reference, ())

    @property
    def done(self) -> bool:
        """Whether the hand has reached its pre-grasp."""
        return self.left <= 0.0

    def __call__(self, observation: Observation, period: float) -> None:
        """Update `left` and `palm` for the next tick, `period` [s] later."""
        if self.feeling:
            self._feel(observation, period)
        if self.left < self.retreat:
            self.speed = min(self.speed + APPROACH.acceleration * period, APPROACH.speed)
            self.left = min(self.left + self.speed * period, self.retreat)
            if self.left >= self.retreat:
                self.speed = 0.0
                self.retreat = 0.0
        elif not self.feeling and not torch.equal(self.palm, self.goal):
            self.palm = next_palm(self.palm, self.goal, period)
        elif not self.feeling:
            self._advance(observation, period)

    def _advance(self, observation: Observation, period: float) -> None:
        """Move on towards the pre-grasp, or stop at a touch of a fingertip or of another link."""
        links = self._touching_links(observation)
        touches = bool(observation.tactile.contact.any()) or len(links)
        if touches and self.stops < self.options.stops:
            # draw back at once
            self.speed = APPROACH.speed
            self.time = 0.0
            self.feeling = True
            self.retreat = min(self.left + APPROACH.back, self.length)
            self.felt.append(Touches(self.reference, links, kept=True))
            self.search = Localization(self.reference, self.felt)
            self.felt[-1].add(observation, self._displaced())
        else:
            change = APPROACH.acceleration * period
            # the speed from which the hand just stops in time
            braking = math.sqrt(2 * APPROACH.acceleration * self.left)
            self.speed = min(self.speed + change, APPROACH.speed, max(braking, change))
            self.left = max(self.left - self.speed * period, 0.0)

    def _displaced(self) -> Float[Tensor, "3"]:
        """Return the palm's displacement [m] from its planned pre-grasp."""
        return self.palm - self.left * self.direction

    def _touching_links(self, observation: Observation) -> Float[Tensor, "m 4"]:
        """Return spheres of links of which one touches, judged by the drives: centres and radii
        [m].

        There are none if no link touches.
        """
        hand = self.reference.hand
        joints = observation.joints
        self.rest = joints if self.rest is None else self.rest
        pushes = (self.reference.kp * (joints - self.rest)).abs()
        if self.length - self.left < APPROACH.start:
            self.inertia = torch.maximum(self.inertia, pushes)
        excess = pushes - self.inertia - APPROACH.noises * TORQUE_NOISE  # (j,) [N m]
        spheres = hand.collision_spheres
        if self.speed < APPROACH.moving or (excess <= 0.0).all():
            return torch.zeros(0, 4, dtype=torch.float64)
        # a link beyond the most blocked joint touches
        moved = hand.tree.moves[:, excess.argmax()][spheres.link_index] > 0
        centres = hand.sphere_centres(self.reference.pick(joints))[moved]
        centres = centres + self.palm - self.left * self.direction
        return torch.cat([centres, spheres.radius.double()[moved, None]], -1)

    def _feel(self, observation: Observation, period: float) -> None:
        """Average the touch readings, then locate the object, then choose the palm's new goal: one
        stage per call.
        """
        last = self.felt[-1]
        if self.time < APPROACH.feeling:
            self.time += period
            last.add(observation, self._displaced())
        elif not self.search.done and (last.felt.any() or len(last.links)):
            self.search()
        else:
            self.feeling = False
            self.stops = self.stops + 1
            if self.search.done:
                self._turn_to(self.search.displacement)

    def _turn_to(self, displacement: Float[Tensor, "6"]) -> None:
        """Let the palm follow a `displacement` [m, rad] of the object, after a retreat as long as
        the palm's way.
        """
        self.displacement = displacement
        shift = palm_goal(displacement[:3], self.reference.table, self.options.palm_reach)
        self.goal = self.reference.rise + shift
        way = float(norm(self.goal - self.palm))
        self.retreat = max(self.retreat, min(self.left + way, self.length))


class GraspCheck:
    """Check of a pressing grasp before the lift: `judged` becomes true when the result is known.

    `secure` then says whether to lift. All fingers with a working sensor must touch. The palm must
    have followed the object to within 8 mm (`CHECK.misplaced`). If all contact points are known,
    balanced forces must exist within the planned friction cones. Of a distribution of friction, the
    mean counts. `displacement` (6,) holds the object's translation [m] and rotation vector [rad] in
    the planned hand's frame. It is the displacement that the closing estimated. If the plan has a
    table and a surface, it is estimated anew from all touches.

    Args:
        reference: the closing plan.
        displacement: displacement (6,) of the object that the closing estimated.
        palm: displacement (3,) [m] of the palm from its planned pose.
        last: whether this is the last attempt, in which every grasp counts as secure.
        felt: all touches so far. The last ones are those of the closing; those of the pressing hand
            replace them.
    """

    def __init__(
        self,
        reference: ClosingReference,
        displacement: Float[Tensor, "6"],
        palm: Float[Tensor, "3"],
        last: bool,
        felt: list[Touches],
    ) -> None:
        self.reference = reference
        self.palm = palm
        self.displacement = displacement
        self.touches = Touches(reference)
        self.felt = felt
        self.known = reference.surface is not None and reference.table is not None
        self.search: Localization | None = None
        self.judged = last
        self.secure = last

    def __call__(self, observation: Observation, pressed: float) -> None:
        """Average the touches, locate the object, and judge the grasp when `pressed` reaches 0.5 s
        (`CHECK.judging`).
        """
        if self.judged or pressed < CHECK.first:
            return
        if pressed < CHECK.last:
            self.touches.add(observation, self.palm)
        elif self.known and not (self.search and self.search.done):
            if self.search is None:
                if self.touches.felt.any():
                    self.felt[-1] = self.touches
                self.search = Localization(self.reference, self.felt)
            self.search()
            self.displacement = self.search.displacement
        elif pressed >= CHECK.judging - EARLY:
            self.touches.contact = observation.tactile.contact
            self.judged = True
            self.secure = self._is_secure()

    def _is_secure(self) -> bool:
        """Return whether all fingers touch, planned friction lets forces balance, and the palm has
        followed.
        """
        touches = self.touches
        if not (touches.contact | ~touches.known).all():
            return False
        if float(norm(self.displacement[:3] - self.palm)) > CHECK.misplaced:
            return False
        if not touches.felt.all():
            # without all places of contacts the forces cannot be judged
            return True
        points, normals = touches.means()
        ratio = tangential_ratio(least_friction_forces(points, normals), normals)
        # false for NaN, where no forces balance
        return bool((ratio <= Distribution.of(self.reference.friction).mean).all())


class Reopening:
    """Controller that opens the hand and moves its palm to the displaced object; `done` says when
    it may close again.

    The fingers leave the object at the same time, because their targets start at the measured
    joints. Meanwhile the palm returns to where the open hand touched nothing. Then it follows the
    object. `palm` (3,) [m] is the palm's present displacement from its planned pose.

    Args:
        reference: the closing plan.
        displacement: displacement of the object in the planned hand's frame: translation [m],
            then rotation vector [rad].
        joints: measured positions [rad] of all joints.
        palm: displacement (3,) [m] of the closed hand's palm from its planned pose.
        begun: displacement (3,) [m] of the palm at which the closing started.
        reach: largest displacement [m] of the palm along the table; 0 means that the palm stays at
            `begun`.
    """

    def __init__(
        self,
        reference: ClosingReference,
        displacement: Float[Tensor, "6"],
        joints: Float[Tensor, " j"],
        palm: Float[Tensor, "3"],
        begun: Float[Tensor, "3"],
        reach: float,
    ) -> None:
        self.displacement = displacement
        self.start = joints
        self.opened = reference.expand(reference.pregrasp)
        self.palm = palm
        self.closed = palm
        self.begun = begun
        self.time = 0.0
        self.goal = begun
        if reach:
            self.goal = reference.rise + palm_goal(displacement[:3], reference.table, reach)

    @property
    def done(self) -> bool:
        """Whether the hand is open and at rest."""
        return self.time >= OPENING.opening + OPENING.rest

    def __call__(self, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later: the fingers
        open, then the palm moves.
        """
        opens = self.time < OPENING.opening
        if opens or torch.equal(self.palm, self.goal):
            self.time += period
        else:
            self.palm = next_palm(self.palm, self.goal, period)
        share = min(self.time / OPENING.opening, 1.0)
        if opens:
            self.palm = torch.lerp(self.closed, self.begun, share)
        return torch.lerp(self.start, self.opened, share)


class LiftCheck:
    """Check whether a closed hand that rises loses the object.

    A tick is one period of the controller. Call the check at the end of each tick of the lift; the
    call returns `lost`. It takes three arguments. The first is an `Observation`. The second is the
    height [m] of the hand above its position at the start of the lift. The third is the tick's
    length [s].

    `lost` becomes true, and stays so, at the first of two events (bounds: `LOST`):

    * The hand has risen by at least 10 mm, and two things hold together. Fewer than two fingertips
      touch. All fingertips together carry a low-passed load below 0.2 N along the table's normal.
    * Two fingertips have each slid by more than 1.5 mm in total, before the hand was 20 mm high.

    Without a table, or with binary sensors, the load is unknown and counts as 0. Fingertips with
    broken sensors count as touching.

    Args:
        reference: the closing plan of the grasp (`ClosingReference.from_grasp`).

    Attributes:
        lost: whether the object is lost, or surely will be.

    Raises `BadArgument` if the plan's sensor names an unknown finger as dead.
    """

    @checked
    def __init__(self, reference: ClosingReference) -> None:
        self.hand = reference.hand
        self.alive = reference.alive
        self.whole = bool(self.alive.all())  # whether all sensors work
        self.height = 0.0  # at the last tick [m]
        self.lost = False
        self.load = 0.0
        self.slid = torch.zeros(len(self.alive), dtype=torch.float64)  # by each fingertip [m]
        self.table = None if reference.sensor.kind == "binary" else reference.table

    @checked
    def __call__(
        self,
        observation: Observation,
        height: Annotated[float, Range(-1.0, 10.0)],
        period: Annotated[float, Range(1e-5, 1.0)],
    ) -> bool:
        """Return whether the object is lost (`lost`) at the end of a tick of the lift.

        Args:
            observation: what the hand measures at the end of the tick (`observe`).
            height: height [m] of the hand above its position at the start of the lift, -1 to 10.
            period: length [s] of the tick, 1e-5 to 1.

        Raises `BadArgument` for an observation of another hand, a number out of range, and a rise
        by over 0.3 m in a tick. The first tick counts from 0.
        """
        check_observation(self.hand, observation)
        if height - self.height > LOST.rise:
            found = f"{height:g} m, {height - self.height:g} m above that of the last tick"
            raise BadArgument("height", found, "the height in metres above the start of the lift")
        self.height = height
        tactile = observation.tactile
        if not self.whole:
            tactile = silenced(tactile, self.alive)
        if height <= LOST.low:
            self.slid = self.slid + period * tactile.sliding
        if self.table is not None:
            load = float((tactile.forces @ self.table.normal.double()).sum())
            self.load = smooth(self.load, load, LOST.cutoff, period)
        touching = int((tactile.contact | ~self.alive).sum())
        slack = touching < 2 and self.load < LOST.load
        slides = float(self.slid.sort().values[-2]) > LOST.slip
        self.lost = self.lost or (slack and height >= LOST.first) or slides
        return self.lost


def palm_goal(shift: Float[Tensor, "3"], table: Plane | None, reach: float) -> Float[Tensor, "3"]:
    """Return the palm's displacement (3,) [m] that follows the `shift` (3,) [m] of an object along
    the `table`.

    It is the part of the shift along the table, shortened to at most `reach` [m]. With `table` None
    it is not projected on the table. All vectors are in the frame of the planned hand.
    """
    if table is not None:
        up = unit(table.normal)
        shift = shift - (shift @ up) * up
    return limit_norm(shift, reach)


def next_palm(
    palm: Float[Tensor, "3"], goal: Float[Tensor, "3"], period: float
) -> Float[Tensor, "3"]:
    """Return the palm's displacement (3,) [m] a time of `period` [s] later, on a straight line to
    its `goal` (3,) [m].

    The palm moves at 0.04 m/s (`PALM_SPEED`), and stops at the goal.
    """
    way = goal - palm
    longest = PALM_SPEED * period
    if float(norm(way)) <= longest:
        return goal
    return palm + limit_norm(way, longest)
