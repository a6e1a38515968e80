"""The controller of a grasp, from the approach to the end of the hold; it needs no simulator."""

import functools
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_device, settle
from torchgrasp.checks import Range, checked
from torchgrasp.control.closing import PALM_REACH, LawClosing, OpenLoopClosing
from torchgrasp.control.holding.grip import GripHold
from torchgrasp.control.modes import Closing, Step, check_modes, choose_holding, make_closing
from torchgrasp.control.observation import Observation
from torchgrasp.control.recovery.approach import GuardedApproach, can_guard
from torchgrasp.control.recovery.retry import PressCheck, Reopening
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import ControllerState, Part, gather, go_on, pack, unpack
from torchgrasp.control.tactile import no_contact
from torchgrasp.control.targets import Targets
from torchgrasp.errors import BadArgument, Status
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ClosingMode, ClosingPart, HoldingMode, check_sensor, closes_again, moves_palm

Tick = Annotated[float, Range(1e-5, 1.0)]
"""Time [s] from one tick to the next: drives are asked at 10 Hz to 1 kHz, and time does not go back."""

CLOSING_TIME = 4.0
"""Longest time [s] of closing before the hand presses with what it has: a fingertip travels 0.16 m in it."""

PRESSING_TIME = 0.5
"""Time [s] from the end of closing until the hand counts as closed: the forces have risen (`RAMP`)."""

IN_THE_AIR, PHASES = "in the air", {"guard": "approaching", "reopening": "opening", "hold": "pressing"}
"""What a controller is at: its fingers close, or it has one of these parts."""

STAGE, COUNTED = (*PHASES, "check"), ("time", "pressed", "attempts", "halts")
"""Attributes of a controller: parts that are there in some phases, and numbers of its own."""

ATTEMPTS = 2
"""Most times that a hand closes (`PressCheck`)."""


class GraspController:
    """Close a hand and hold the object: observations in, `Targets` out, all on the CPU.

    A closing brings the fingers to the object, then a holding presses. `closed` turns true `PRESSING_TIME` later:
    then the hand may be lifted, with further steps. The open loop keeps its squeeze. On a table that the reference
    knows, a hand that feels no grasp to lift opens again instead, and closes where touches say that the object is.

    With an `approach` the controller begins before the pre-grasp. While it is `approaching` the arm brings the opened
    hand to where `Targets.left` says. Where a fingertip touches, the hand stops, draws back and goes to where the touch
    says that the object is (`GuardedApproach`); `halts` counts how often.

    Args:
        reference: what the hand follows.
        closing, holding: as in `TrialSpec`.
        belief: the shape that the grasp was planned on, which touches revise under the law (Eq. 25); None: they do not.
        without: parts that the closing leaves out, as in `TrialSpec`.
        approach: length [m] of the approach that is still before the hand; 0: it is at its pre-grasp.

    Raises:
        BadArgument: unknown names; a belief, parts or "law" for a closing that has none; "impedance" for more than
            three fingertips; a closing or holding that needs what the sensor does not tell.
        BadArgument: an approach without the part "guard", or whose touches would tell nothing (`can_guard`).

    A hand that is driven at 200 Hz; here joints follow at once and the object yields by 1 mm for 2 N:

    >>> from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
    >>> from torchgrasp.control import ClosingReference, TipContact, measure, no_contact, observe
    >>> hand = load_hand("allegro")
    >>> grasp = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=20)[0]
    >>> reference = ClosingReference.from_grasp(hand, grasp)
    >>> controller, tactile, joints = GraspController(reference), no_contact(), reference.pregrasp
    >>> normals, radius = reference.normals, hand.tips.radius.double()
    >>> while not controller.closed:
    ...     points = reference.contact_points(hand.tip_centres(joints))
    ...     push = 2e3 * ((reference.gains.target - points) * normals).sum(-1).clamp_min(0.0)
    ...     contact = TipContact(push, -push[:, None] * normals, points, normals)
    ...     tactile = measure(tactile, contact, normals, radius, 1 / 200)
    ...     joints = reference.pick(controller.step(observe(hand, joints, tactile), 1 / 200).joints)
    >>> bool(tactile.contact.all())
    True
    """

    @checked
    def __init__(
        self,
        reference: ClosingReference,
        closing: ClosingMode = "uncertainty",
        holding: HoldingMode = "force",
        belief: ShapeGP | None = None,
        without: tuple[ClosingPart, ...] = (),
        approach: Annotated[float, Range(0.0, 1.0)] = 0.0,
    ) -> None:
        check_modes(closing, holding, belief, without)
        check_sensor(reference.sensor, closing, holding)
        if approach and not can_guard(reference, closing, without):
            allowed = "0 without the part 'guard', or without a table, a surface and a direction in the reference"
            raise BadArgument("approach", approach, allowed)
        self.modes = (
            f"closing {closing}, holding {holding}, without {', '.join(without) or 'nothing'}, {approach:g} m off"
        )
        self.reference = reference = settle(reference, torch.device("cpu"))
        self.length, self.halts = approach, 0
        self.guard = self._guard()
        self._close = functools.partial(make_closing, reference, closing, belief, without)
        self._choose, self._law = functools.partial(choose_holding, mode=holding), holding == "law"
        self._begin(self._close())
        self.targets = Targets(reference.expand(reference.pregrasp), left=approach)
        self.most = ATTEMPTS if closes_again(closing, without) and reference.table is not None else 1
        self.attempts, self._reach = 1, PALM_REACH if moves_palm(closing, without) else 0.0

    def _guard(self) -> GuardedApproach | None:
        """Return what brings the hand along its approach; None: it has none."""
        return GuardedApproach(self.reference, self.length) if self.length else None

    @property
    def approaching(self) -> bool:
        """Whether the hand is still on its way to the pre-grasp."""
        return self.guard is not None

    def _begin(self, closing: Closing) -> None:
        """Begin to close."""
        self.closing, self.hold, self.check, self.reopening = closing, None, None, None
        self._hold = self._choose(closing)
        self.time, self.pressed = 0.0, 0.0

    @property
    def closed(self) -> bool:
        """Whether the hand has closed and pressed: it may be lifted."""
        if isinstance(self.closing, OpenLoopClosing):
            return self.closing.done
        return self.pressed >= PRESSING_TIME - 1e-9 and (self.check is None or self.check.secure)

    @property
    def status(self) -> Status:
        """`OK`, or `TOO_HEAVY` once the holding "grip" feels more than the hand can hold: put the object down."""
        return self.hold.status if isinstance(self.hold, GripHold) else Status.OK

    @property
    def blend(self) -> Float[Tensor, " f"]:
        """Lambda of each finger (Eq. 26) at the last tick; NaN before it and without the law."""
        nothing = torch.full_like(self.reference.normals[:, 0], torch.nan)
        acts = self.hold is None and self.reopening is None and self.time > 0.0
        return self.closing.share if acts and isinstance(self.closing, LawClosing) else nothing

    @checked
    def step(self, observation: Observation, period: Tick) -> Targets:
        """Return the targets of joints and palm for the next tick, a period [s] later.

        In the tick in which the closing ends its targets stay: the holding's forces are sought instead.

        Raises:
            BadArgument: an observation of another hand, or on another device than the CPU; a period outside `Tick`.
        """
        shape = len(self.reference.normals), 3, len(self.targets.joints)
        found = tuple(observation.jacobian.shape)
        if found != shape or observation.tactile.reading.shape != shape[:1]:
            raise BadArgument("observation", f"fingertips, 3 and joints {found}", f"those of the hand, {shape}")
        check_device("observation", observation.joints.device, "the controller", self.targets.joints.device)
        if self.guard is not None:
            self.targets = self._approach(self.guard, observation, period)
            return self.targets
        if self.reopening is not None:
            self.targets = self._reopen(self.reopening, period)
            return self.targets
        over = self.closing.done or self.time >= CLOSING_TIME
        if self.hold is None and over and not isinstance(self.closing, OpenLoopClosing):
            self.hold, joints = self._hold(self.reference, observation, self.targets.joints), self.targets.joints
            self.check = self._check()
        elif self.hold is None:
            self.time += period
            joints = self.closing(observation, period)
        else:
            self.pressed += period
            joints = self.hold(observation, period)
        self.targets = Targets(joints, self.closing.palm)
        self._judge(observation)
        return self.targets

    def _approach(self, guard: GuardedApproach, observation: Observation, period: float) -> Targets:
        """Return the targets of the approaching hand; at its end expect the object where it was touched."""
        guard(observation, period)
        if guard.done:
            self.guard, self.halts = None, round(guard.halts)
            if self.halts and isinstance(self.closing, LawClosing):
                self.closing.begin_at(guard.displacement, guard.palm)
        return Targets(self.targets.joints, guard.palm, guard.left)

    def _check(self) -> PressCheck | None:
        """Return what judges the pressing hand; None: the closing has no further attempt in any case."""
        if self.most == 1 or not isinstance(self.closing, LawClosing):
            return None
        last = self.attempts >= self.most
        return PressCheck(self.reference, self.closing.believed, self.closing.palm, last)

    def _judge(self, observation: Observation) -> None:
        """Open the hand again once it is known that a lift would fail."""
        if self.check is None:
            return
        self.check(observation, self.pressed, PRESSING_TIME - 1e-9)
        if self.check.judged and not self.check.secure:
            self.reopening = self._reopening(self.check.displacement)
            self.hold, self.check, self.pressed = None, None, 0.0

    def _reopening(self, displacement: Float[Tensor, "6"]) -> Reopening:
        """Return what opens the hand from where it is, and follows a displacement of the object [m, rad]."""
        return Reopening(self.reference, displacement, self.targets.joints, self.targets.palm, self._reach)

    def _reopen(self, reopening: Reopening, period: float) -> Targets:
        """Return the targets of the opening hand; at its end begin to close once more."""
        targets = Targets(reopening(period), reopening.palm)
        if reopening.done:
            closing = self._close()
            assert isinstance(closing, LawClosing)
            self._begin(closing.begin_at(reopening.displacement, reopening.palm))
            self.attempts += 1
        return targets

    @checked
    def state(self) -> ControllerState:
        """Return what changes from tick to tick, to be saved: `restore` goes on from it.

        Raises:
            BadArgument: a controller with a belief, whose shape is none of its numbers.
        """
        if isinstance(self.closing, LawClosing) and self.closing.revise is not None:
            raise BadArgument("state", "that of a controller with a belief", "that of one without")
        parts = self._parts({name: getattr(self, name) for name in STAGE})
        return pack(f"{self.modes}, {self._phase}", self._numbers(parts))

    @checked
    def restore(self, state: ControllerState) -> None:
        """Go on from a state as the controller of it would have: the same observations give the same bits.

        The controller has to be made of the same grasp and modes.

        Raises:
            BadArgument: the state of another hand or of other modes, or one that was changed.

        >>> from torchgrasp import load_hand, load_object, plan_grasps
        >>> from torchgrasp.control import ClosingReference, no_contact, observe
        >>> hand = load_hand("allegro")
        >>> grasp = plan_grasps(load_object("cylinder").view, hand, starts=20)[0]
        >>> reference = ClosingReference.from_grasp(hand, grasp)
        >>> one, other, seen = GraspController(reference), GraspController(reference), None
        >>> for _ in range(3):
        ...     targets = one.step(observe(hand, reference.pregrasp, no_contact()), 0.01)
        >>> other.restore(one.state())
        >>> bool((other.targets.joints == targets.joints).all())
        True
        """
        phases = (x for x in PHASES.values() if state.layout.startswith(f"{self.modes}, {x}"))
        phase = next(phases, IN_THE_AIR)
        stage: dict[str, Any] = dict.fromkeys(STAGE)
        if phase == PHASES["guard"]:
            stage["guard"] = self._guard()
        elif phase == PHASES["hold"]:
            stage["hold"], stage["check"] = self._blank(), self._check()
        elif phase == PHASES["reopening"]:
            stage["reopening"] = self._reopening(torch.zeros(6, dtype=torch.float64))
        parts = self._parts(stage)
        numbers = unpack(f"{self.modes}, {phase}", self._numbers(parts), state)
        if numbers is None:
            raise BadArgument("state", state.layout[:80], f"one of {self.modes}, {phase}, and of this hand's fingers")
        self.time, self.pressed, attempts, halts = (float(numbers[f"controller.{name}"]) for name in COUNTED)
        self.attempts, self.halts = round(attempts), round(halts)
        joints, palm, left = (numbers[f"controller.{name}"] for name in Targets._fields)
        self.targets = Targets(joints, palm, float(left))
        for name, part in stage.items():
            setattr(self, name, part)
        for name, part in parts.items():
            go_on(part, name, numbers)

    def _blank(self) -> Step:
        """Return the holding as after touching nothing."""
        if self._law:
            return self.closing
        reference = self.reference
        target, joints = reference.gains.target, self.targets.joints
        jacobian = torch.zeros(*target.shape, len(joints), dtype=torch.float64)
        return self._hold(reference, Observation(joints, target, jacobian, no_contact(fingers=len(target))), joints)

    @property
    def _phase(self) -> str:
        """The phase in words."""
        return next((phase for part, phase in PHASES.items() if getattr(self, part) is not None), IN_THE_AIR)

    def _parts(self, stage: dict[str, Any]) -> dict[str, Part]:
        """Return the parts whose numbers are the controller's, by name; a law that goes on is no second one."""
        found = {name: x for name, x in stage.items() if isinstance(x, Part) and x is not self.closing}
        return {"closing": self.closing, **found}

    def _numbers(self, parts: dict[str, Part]) -> dict[str, Tensor]:
        """Return every number of the controller and of parts of it."""
        mine = {name: getattr(self, name) for name in COUNTED} | self.targets._asdict()
        return gather(mine, parts)
