"""The controller of a grasp: an approach that stops at a touch, then closing, then holding.

It needs no simulator. Vectors are in the frame of the planned hand (its root link), unless said
otherwise. A tick is one period of control.
"""

import dataclasses
import functools
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.holding import GripHold
from torchgrasp.control.modes import choose_holding, make_closing
from torchgrasp.control.object_pose import Touches
from torchgrasp.control.observation_check import ObservationCheck
from torchgrasp.control.protocol import Closing, LawClosing
from torchgrasp.control.recovery import (
    PRESSING_TIME,
    GraspCheck,
    GuardedApproach,
    Reopening,
    can_guard,
)
from torchgrasp.control.reference import ClosingReference, check_plan
from torchgrasp.control.relook import check_seen_again, relocate
from torchgrasp.control.tactile import (
    EARLY,
    STILL,
    Observation,
    Targets,
    check_observation,
    silenced,
)
from torchgrasp.control.uncertainty_closing import UncertaintyClosing
from torchgrasp.foundation.base import check_device, map_tensors, settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Pose, Range
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_from_vector, turned_about
from torchgrasp.geometry.linalg import check_unit_vectors, dot
from torchgrasp.values.closing import ClosingOptions, choose_options
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import PointCloud
from torchgrasp.values.specs import (
    ROUNDING,
    ClosingMode,
    HoldingMode,
    check_limit,
    check_modes,
    default_holding,
)

Period = Annotated[float, Range(1e-5, 1.0)]
# longest time [s] of closing before the hand presses with the contacts that it has
CLOSING_TIME = 4.0


class GraspController:
    """Controller that closes a hand on an object and holds it. Each `step` maps an `Observation` to
    `Targets`, on the CPU. A tick is the time between two steps.

    A closing controller brings the fingers to the object, then a hold controller presses. After
    pressing for 0.9 s (`PRESSING_TIME`), `closed` becomes true. The hand may then be lifted, but
    `step` must still be called at each tick.

    If the plan has a table and `options` allow several attempts, the grasp is judged before the
    lift. If it seems too weak to lift the object, the hand opens. It locates the object from its
    touches and closes again.

    With `approach` > 0 the opened hand starts away from its pre-grasp, the pose from which the
    fingers close. While `approaching`, a robot arm must keep the hand `Targets.left` [m] short of
    the pre-grasp, along `reference.approach`. A new view of the object (`relook`) moves this path.

    Args:
        reference: the closing plan (`ClosingReference.from_grasp`).
        closing: the closing mode, such as "uncertainty" or "paper"; `TrialSpec` explains all.
        holding: the holding mode, such as "grip" or "force"; `TrialSpec` explains all. None means
            "grip", or "force" where the closing mode or the sensors do not allow "grip". The
            sensors are those of the plan, `reference.sensor`.
        options: options of the closing. None means `ClosingOptions()`, or all off for a mode
            without options.
        approach: remaining length [m] of the approach; 0 means that the hand is at its pre-grasp.

    Attributes:
        reference: the closing plan, moved by `relook` to the object as a new view showed it.
        attempts: number of closings so far, with the present one.
        stops: how often the approach stopped at an unexpected touch.

    Raises `BadArgument` for:

    * unknown modes;
    * options or the holding "law" for a closing mode that does not allow them;
    * the closing "paper" with a plan whose `distance_variance` is None;
    * "impedance" for more than three fingertips;
    * modes that need more than the fingertip sensors measure (`reference.sensor`);
    * a `reference.sensor` that names an unknown finger as one with a dead sensor;
    * an approach whose options allow no stops;
    * an approach whose plan lacks a direction, a table, a surface or tactile fingertips;
    * a `max_force` of the plan that the modes do not keep;
    * a plan whose table or surface is in another frame;
    * a plan whose normals or approach are no unit vectors;
    * a plan without one positive stiffness for each joint of the URDF.
    """

    @checked
    def __init__(
        self,
        reference: ClosingReference,
        closing: ClosingMode = "uncertainty",
        holding: HoldingMode | None = None,
        options: ClosingOptions | None = None,
        approach: Annotated[float, Range(0.0, 1.0)] = 0.0,
    ) -> None:
        self.options = choose_options(closing, options)
        holding = holding or default_holding(reference.sensor, closing)
        check_modes(reference.sensor, closing, holding)
        check_limit(reference.max_force, closing, holding)
        check_plan(reference)
        self._check_force(reference, closing, holding)
        if approach and not (self.options.stops and can_guard(reference)):
            lacking = "stops, or without a table, a surface and a direction in the reference"
            raise BadArgument("approach", approach, f"0 without {lacking}")
        self._make_hold = choose_holding(reference.hand, holding)
        self.mode: ClosingMode = closing
        self.path = STILL  # displacement [m] of the palm's path by a new view
        self.planned = settle(reference, torch.device("cpu"))
        self.whole = bool(self.planned.alive.all())  # whether all sensors work
        self.check_seen = ObservationCheck(self.planned)
        self._prepare(self.planned, approach)

    def _check_force(
        self, reference: ClosingReference, closing: ClosingMode, holding: HoldingMode
    ) -> None:
        """Raise `BadArgument` if the hand would press harder than the plan's `max_force`.

        A hand that waits presses in the holds "force" and "grip" alone, which keep to the limit.
        """
        if reference.max_force is None:
            return
        stops = self.options.wait or closing in ("position", "paper_position")
        if stops and holding != "law":
            return
        most = float((-dot(reference.gains.desired_force, reference.normals)).max())
        if most > reference.max_force * (1 + ROUNDING):
            found = f"{reference.max_force:g}, with a desired force of {most:g} N"
            allowed = "a plan with less force: `ClosingReference.from_grasp(force=...)`"
            raise BadArgument("reference.max_force", found, allowed)

    def _prepare(self, reference: ClosingReference, approach: float) -> None:
        """Start with a plan: first its approach of length `approach` [m], if that is not 0, and
        then its closing.
        """
        self.reference = reference
        self.attempts = 0
        self.stops = 0
        self.length = approach
        # whether the grasp is judged before the lift
        self.judges = self.options.attempts > 1 and reference.table is not None
        # at each stop, and in each closing that is judged
        self.felt = list[Touches]()
        self.guard = None
        if approach:
            self.guard = GuardedApproach(reference, self.options, approach, self.felt)
        self._make_closing = functools.partial(make_closing, reference, self.mode, self.options)
        self._begin(self._make_closing())
        opened = reference.expand(reference.pregrasp)
        self._sent = Targets(opened, self.path + reference.rise, approach)

    def _begin(self, closing: Closing) -> None:
        """Start a new attempt to close the hand, controlled by `closing`, and count it."""
        self.closing = closing
        self.hold = None
        self.check = None
        self.reopening = None
        self.time = 0.0
        self.pressed = 0.0
        self.attempts += 1

    @property
    def targets(self) -> Targets:
        """The present `Targets`: those that the last `step` returned.

        Before the first step they are those of the opened hand at the start of its approach or
        closing. The tensors are new, so the receiver may change them.
        """
        return self._sent.copied()

    @property
    def approaching(self) -> bool:
        """Whether the opened hand is still on its way to the pre-grasp, the pose from which the
        fingers close.
        """
        return self.guard is not None

    @property
    def closed(self) -> bool:
        """Whether the hand has closed and pressed for 0.9 s (`PRESSING_TIME`), so that it may be
        lifted.

        The grasp must also seem strong enough to lift the object. This condition counts only if the
        plan has a table and another attempt is allowed (`ClosingOptions.attempts`). In the closing
        mode "open_loop" it is true at the end of the motion.
        """
        if not self.closing.feels:
            return self.closing.done
        return self.pressed >= PRESSING_TIME - EARLY and (self.check is None or self.check.secure)

    @property
    def status(self) -> Status:
        """Whether the hand can hold the object: `OK`, or `TOO_HEAVY`.

        `TOO_HEAVY` means that the holding mode "grip" (the argument `holding`) measures more load
        than the hand can hold. The hand should then set the object down. In other modes the status
        is always `OK`.
        """
        return self.hold.status if isinstance(self.hold, GripHold) else Status.OK

    @property
    def friction(self) -> Distribution | None:
        """The coefficient of friction as far as it is known: that of the plan, within bounds from
        the touches.

        A fingertip that sticks bounds the coefficient below; one that slides bounds it above. If
        the plan's coefficients are all out of bounds, the bounds alone count. None unless the hand
        holds in the mode "grip" (the argument `holding`).

        For example, a plan has a friction of 0.3 to 0.8. A fingertip that sticks with a tangential
        force of half its normal force leaves 0.5 to 0.8, apart from noise.
        """
        return self.hold.friction.posterior if isinstance(self.hold, GripHold) else None

    @property
    def mass(self) -> Distribution | None:
        """The `Distribution` of the object's mass [kg], from the load that the fingertips measure.

        None unless the hand holds in the mode "grip" (the argument `holding`) and its load is
        steady. If the object is too heavy for the hand (`status`), the distribution begins at the
        mass that was carried. It ends at 10 kg (`WEIGHT.most`).
        """
        return self.hold.mass if isinstance(self.hold, GripHold) else None

    @property
    def blend(self) -> Float[Tensor, " f"]:
        """The share of force control (f,) of each finger at the last `step`: 0 means position
        control alone, 1 force control alone. It is lambda in Eq. (26) of the paper.

        It is NaN while the control law of Eq. (25) does not command the fingers. This is always so
        in closing modes without this law. In modes with it, this is so before the first step, in
        the hold, and while the hand opens again.
        """
        acts = self.hold is None and self.reopening is None and self.time > 0.0
        if acts and isinstance(self.closing, LawClosing):
            return self.closing.share
        return torch.full_like(self.reference.normals[:, 0], torch.nan)

    @property
    def displacement(self) -> Float[Tensor, "4 4"]:
        """The displacement (4, 4) [m] of the object, as estimated from the touches.

        It is a rigid transform from the planned to the present object. Its frame is that of the
        hand's root link at the planned pose. It is the identity before any touch, and until the end
        of the first approach. It is always so if the pose is not estimated
        (`ClosingOptions.pose_estimate`).
        """
        closing = self.closing
        if not isinstance(closing, UncertaintyClosing):
            return torch.eye(4, dtype=torch.float64)
        centre = self.reference.gains.target.mean(0)
        shift = closing.displacement[:3]
        rotation = rotation_from_vector(closing.displacement[3:])
        return turned_about(rotation, centre, shift)

    @property
    def object_motion(self) -> Float[Tensor, "4 4"]:
        """The motion (4, 4) [m] of the object since the plan, estimated from a new view (`relook`)
        and from touches.

        It is a rigid transform from the planned to the present object. Its frame is that of the
        planned cloud.
        """
        straight = torch.eye(3, dtype=torch.float64)
        placed = self.planned.obj_from_hand @ rigid(straight, self.path)
        return placed @ self.displacement @ inverse(self.reference.obj_from_hand)

    @checked
    def relook(self, cloud: PointCloud) -> None:
        """Shift the approach, the straight path to the pre-grasp, to the object as a new view shows
        it.

        Call it before the first `step`. Then move the hand to where the shifted approach begins.
        `targets.palm` (3,) [m] of this controller is now the hand's displacement from the start of
        the planned approach. The displacement is in the frame of the hand's root link at the
        planned pose. The palm does not rotate: the contacts of a turned object are found by touch.

        `cloud` holds points [m] of the object alone, in the frame of the planned cloud. Raises
        `BadArgument` if the hand has no approach, or has begun it. Raises it for a cloud whose
        median point is over 50 mm off the surface, wherever the object stands.
        """
        moved = self.locate(cloud)
        assert self.planned.surface is not None
        check_seen_again(self.planned.surface, cloud, moved)
        self.follow(moved)

    @checked
    def locate(self, cloud: PointCloud) -> Float[Tensor, "4 4"]:
        """Return the motion (4, 4) [m] of the object along its table, as a new view shows it.

        It is a rigid transform from the planned to the present object, in the frame of the planned
        cloud. `cloud` holds points [m] of the object alone, in this frame. Raises `BadArgument` if
        the hand has no approach, or has begun it.
        """
        reference = self.planned
        self._check_begun()
        assert reference.surface is not None and reference.table is not None
        return relocate(reference.surface, cloud, reference.table.moved(reference.obj_from_hand))

    def _check_begun(self) -> None:
        """Raise `BadArgument` if the hand has no approach, or has begun it."""
        if self.guard is None or self.guard.left < self.guard.length:
            found = "a view of the object after the start of the approach"
            raise BadArgument("cloud", found, "one before it")

    @checked
    def follow(self, moved: Pose) -> None:
        """Shift the approach to an object that has `moved`, as `relook` does.

        `moved` (4, 4) [m] is the motion of the object since the plan, in the frame of the planned
        cloud. Raises `BadArgument` if the hand has no approach, or has begun it.
        """
        reference = self.planned
        self._check_begun()
        assert self.guard is not None
        # the object's motion in the hand's frame; the palm follows its shift alone
        moved = moved.to("cpu", torch.float64)
        in_hand = inverse(reference.obj_from_hand) @ moved @ reference.obj_from_hand
        centre = reference.gains.target.mean(0)
        self.path = apply(in_hand, centre[None])[0] - centre
        shifted = rigid(torch.eye(3, dtype=torch.float64), self.path)
        pose = reference.obj_from_hand @ inverse(in_hand) @ shifted
        self._prepare(dataclasses.replace(reference, obj_from_hand=pose), self.guard.length)

    @checked
    def step(self, observation: Observation, period: Period) -> Targets:
        """Return the targets of joints and palm for the next tick, the time until the next call.

        In the tick in which the closing ends, the targets do not change: this tick only prepares
        the hold.

        Args:
            observation: what the hand measures now (`observe`), on the CPU.
            period: time [s] until the next tick, 1e-5 to 1.

        Raises `BadArgument` for an observation of another hand or on another device, or a period
        out of range. Raises it for an `up` that is no unit vector. For an observation that
        `observe` made, raises it also for:

        * a joint that jumps between two ticks;
        * a joint over 0.8 rad outside its way from pre-grasp to grasp, where the closing begins;
        * an `up` over 0.5 rad off the table's normal before the hand holds;
        * a normal force below -1 N, times `SensorModel.noise` if this is above 1;
        * a normal force above 1000 N, as one in millinewtons;
        * a fingertip that touches with a force that pulls at the object;
        * its contact point over 0.1 m from its centre, as in another frame or unit;
        * its normal that is no unit vector, or points into the object;
        * tactile fingertips that touch for 0.5 s without a contact point;
        * torques by which all fingertips pull for 0.3 s while they close, by 5 N together.
        """
        check_observation(self.reference.hand, observation)
        device = self._sent.joints.device
        check_device("observation", observation.joints.device, "the controller", device)
        if observation.up is not None:
            check_unit_vectors("observation.up", observation.up)
        # what is remembered must stay: a robot may read its sensors into the same memory
        observation = map_tensors(torch.clone, observation)
        if not self.whole:
            tactile = silenced(observation.tactile, self.reference.alive)
            observation = dataclasses.replace(observation, tactile=tactile)
        if observation.hand:
            closes = self.guard is None and self.reopening is None
            self.check_seen(observation, period, closes, self.hold is not None)
        if self.guard is not None:
            self._sent = self._approach(self.guard, observation, period)
        elif self.reopening is not None:
            self._sent = self._reopen(self.reopening, period)
        else:
            joints = self._close_or_hold(observation, period)
            self._sent = Targets(joints, self.path + self.closing.palm)
            self._judge(observation)
        return self.targets

    def _approach(self, guard: GuardedApproach, observation: Observation, period: float) -> Targets:
        """Return the targets during the approach; at its end, give the closing the object pose
        found by touch.
        """
        guard(observation, period)
        if guard.done:
            self.guard = None
            self.stops = self.stops + guard.stops
            located = guard.stops or self.attempts > 1
            if located and isinstance(self.closing, UncertaintyClosing):
                self.closing.begin_at(guard.displacement, guard.palm)
        return Targets(self._sent.joints, self.path + guard.palm, guard.left)

    def _close_or_hold(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the joint targets of the closing controller, or of the hold controller once
        closing has ended.
        """
        closing = self.closing
        if self.hold is not None:
            self.pressed += period
            judging = self.check is not None and not self.check.judged
            if judging and isinstance(closing, UncertaintyClosing):
                if not closing.touched.all():
                    # without a finger that opposes them, pressing ones push the object away
                    return self._sent.joints
            return self.hold(observation, period)
        over = closing.done or self.time >= CLOSING_TIME
        if over and closing.feels:
            self._begin_hold(observation)
            return self._sent.joints
        if self.judges:
            if self.time == 0.0:
                self.felt.append(Touches(self.reference, kept=True))
            self.felt[-1].add(observation, closing.palm)
        self.time += period
        return closing(observation, period)

    def _begin_hold(self, observation: Observation) -> None:
        """Make the hold controller, and the check of the grasp if it is judged before the lift."""
        closing = self.closing
        if self._make_hold is None:
            assert isinstance(closing, LawClosing)
            self.hold = closing.press()
        else:
            self.hold = self._make_hold(self.reference, observation, self._sent.joints)
        if self.judges:
            assert isinstance(closing, UncertaintyClosing)
            last = self.attempts >= self.options.attempts
            self.check = GraspCheck(
                self.reference, closing.displacement, closing.palm, last, self.felt
            )

    def _judge(self, observation: Observation) -> None:
        """Start to reopen the hand if the check of the pressing grasp found that a lift would
        fail.
        """
        if self.check is None:
            return
        self.check(observation, self.pressed)
        if self.check.judged and not self.check.secure:
            assert isinstance(self.closing, UncertaintyClosing)
            # a hand with an approach moves its palm in the next one
            reach = 0.0 if self.length else self.options.palm_reach
            palm = self.closing.palm
            begun = self.closing.begun
            touches = bool(observation.tactile.contact.any())
            if touches and not self.reference.rise.any():
                begun = palm
            self.reopening = Reopening(
                self.reference, self.check.displacement, observation.joints, palm, begun, reach
            )
            self.hold = None
            self.check = None
            self.pressed = 0.0

    def _reopen(self, reopening: Reopening, period: float) -> Targets:
        """Return the targets of the opening hand; once it is open, start the next approach or the
        next closing.
        """
        targets = Targets(reopening(period), self.path + reopening.palm)
        if reopening.done:
            closing = self._make_closing()
            assert isinstance(closing, UncertaintyClosing)
            self._begin(closing.begin_at(reopening.displacement, reopening.palm))
            if self.length:
                self.guard = GuardedApproach(
                    self.reference, self.options, self.length, self.felt, reopening
                )
        return targets
