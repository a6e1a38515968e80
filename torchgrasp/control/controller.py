"""A grasp from the first motion of the fingers to the last of the hold: one state machine, without a simulator."""

from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.adaptive.belief import Belief
from torchgrasp.control.adaptive.impedance import Impedance
from torchgrasp.control.closing import FixedGainClosing, OpenLoopClosing, PositionClosing, UncertaintyClosing
from torchgrasp.control.holding import ForceHold, PositionHold
from torchgrasp.control.observation import ControlModel, Observation
from torchgrasp.errors import BadArgument
from torchgrasp.specs import ClosingMode, HoldingMode
from torchgrasp.values import ClosingGains

CLOSINGS = {
    "open_loop": OpenLoopClosing,
    "position": PositionClosing,
    "fixed": FixedGainClosing,
    "uncertainty": UncertaintyClosing,
}
HOLDINGS = {"force": ForceHold, "impedance": Impedance, "position": PositionHold}

CLOSING_TIME = 4.0
"""Longest time [s] that closing may take before the hand presses with what it has."""

PRESSING_TIME = 0.5
"""Time [s] between the end of closing and the moment at which the hand counts as closed: the forces build up."""


def check_modes(closing: str, holding: str, belief: object = None) -> None:
    """Refuse an unknown closing or holding, and a belief for a closing that does not follow the law (Eq. 25)."""
    for name, value, table in (("closing", closing, CLOSINGS), ("holding", holding, HOLDINGS)):
        if value not in table:
            raise BadArgument(name, repr(value), f"one of {', '.join(table)}")
    if belief is not None and not issubclass(CLOSINGS[closing], UncertaintyClosing):
        raise BadArgument("belief", f"one for {closing!r}", "None, or a closing under the law")


class GraspController:
    """Close a hand and hold what it grasped: what a robot knows at a tick goes in, joint targets come out.

    A closing brings the fingers to the object until it is done or `CLOSING_TIME` is over; then a holding presses.
    `closed` turns true `PRESSING_TIME` later: now the hand may be lifted, while it is stepped on. The open loop ends
    with its squeeze, which it keeps, and is closed at once. Every tick costs the same fraction of a millisecond.

    Args:
        plant: what is known of the hand and the grasp (`model_from_hand`).
        gains: of the law, with targets and desired forces (`closing_gains`).
        closing: one of `CLOSINGS`.
        holding: one of `HOLDINGS`.
        belief: lets touches revise the shape and the contacts of the fingers in the air, under the law (Eq. 25).

    Raises:
        BadArgument: an unknown closing or holding, or a belief for a closing that does not follow the law.

    A hand that is driven at 200 Hz; here joints follow at once and the object yields by 1 mm for 2 N:

    >>> from torchgrasp import ContactSpec, closing_gains, load_hand, load_object, plan_grasps
    >>> from torchgrasp.control.tactile import TipContact, measure, no_contact
    >>> from torchgrasp.control.observation import model_from_hand, observe
    >>> hand = load_hand("allegro")
    >>> grasp = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=20)[0]
    >>> model, gains = model_from_hand(hand, grasp), closing_gains(grasp, hand)
    >>> controller, tactile, joints = GraspController(model, gains), no_contact(), grasp.pregrasp[0].double()
    >>> while not controller.closed:
    ...     points = hand.tip_centres(joints) - model.radius[:, None] * model.normals
    ...     push = 2e3 * ((gains.target - points) * model.normals).sum(-1).clamp_min(0.0)
    ...     press = TipContact(push, -push[:, None] * model.normals, points, model.normals)
    ...     tactile = measure(tactile, press, model.normals, model.radius, 1 / 200)
    ...     joints = controller.step(observe(hand, joints, tactile), 1 / 200)[list(model.actuated)]
    >>> bool(tactile.contact.all())
    True
    """

    def __init__(
        self,
        model: ControlModel,
        gains: ClosingGains,
        closing: ClosingMode = "uncertainty",
        holding: HoldingMode = "force",
        belief: Belief | None = None,
    ) -> None:
        check_modes(closing, holding, belief)
        self.model, self.gains = model, gains
        kind = CLOSINGS[closing]
        self.closing = kind(model, gains, belief) if issubclass(kind, UncertaintyClosing) else kind(model, gains)
        self._holding, self.hold = HOLDINGS[holding], None
        self.targets = model.expand(model.pregrasp)
        self.time, self.pressed = 0.0, 0.0

    @property
    def closed(self) -> bool:
        """Whether the hand has closed as far as it will, and pressed: it may be lifted."""
        if isinstance(self.closing, OpenLoopClosing):
            return self.closing.done
        return self.pressed >= PRESSING_TIME - 1e-9

    def step(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints [rad] for the next tick.

        Args:
            sight: what is known now.
            period: until the next tick [s].
        """
        over = self.closing.done or self.time >= CLOSING_TIME
        if self.hold is None and over and not isinstance(self.closing, OpenLoopClosing):
            self.hold = self._holding(self.model, self.gains, observation, self.targets)
        if self.hold is None:
            self.time += period
            self.targets = self.closing(observation, period)
        else:
            self.pressed += period
            self.targets = self.hold(observation, period)
        return self.targets
