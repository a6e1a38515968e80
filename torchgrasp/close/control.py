"""A grasp from the first motion of the fingers to the last of the hold: one state machine, without a simulator."""

from jaxtyping import Float
from torch import Tensor

from torchgrasp.close.belief import Belief
from torchgrasp.close.closings import Closing, FixedClosing, OpenLoop, Stopping
from torchgrasp.close.hold import Squeeze, Stay
from torchgrasp.close.impedance import Impedance
from torchgrasp.close.sight import Plant, Sight
from torchgrasp.errors import BadArgument
from torchgrasp.specs import ClosingMode, HoldingMode
from torchgrasp.values import ClosingGains

CLOSINGS = {"open_loop": OpenLoop, "position": Stopping, "fixed": FixedClosing, "uncertainty": Closing}
HOLDINGS = {"squeeze": Squeeze, "impedance": Impedance, "stay": Stay}

CLOSING_TIME = 4.0
"""Longest time [s] that closing may take before the hand presses with what it has."""

PRESSING_TIME = 0.5
"""Time [s] between the end of closing and the moment at which the hand counts as closed: the forces build up."""


def check_modes(closing: str, holding: str, belief: object = None) -> None:
    """Refuse an unknown closing or holding, and a belief for a closing that does not follow the law (Eq. 25)."""
    for name, value, table in (("closing", closing, CLOSINGS), ("holding", holding, HOLDINGS)):
        if value not in table:
            raise BadArgument(name, repr(value), f"one of {', '.join(table)}")
    if belief is not None and not issubclass(CLOSINGS[closing], Closing):
        raise BadArgument("belief", f"one for {closing!r}", "None, or a closing under the law")


class GraspController:
    """Close a hand and hold what it grasped: what a robot knows at a tick goes in, joint targets come out.

    A closing brings the fingers to the object until it is done or `CLOSING_TIME` is over; then a holding presses.
    `closed` turns true `PRESSING_TIME` later: now the hand may be lifted, while it is stepped on. The open loop ends
    with its squeeze, which it keeps, and is closed at once. Every tick costs the same fraction of a millisecond.

    Args:
        plant: what is known of the hand and the grasp (`plant_from_hand`).
        gains: of the law, with targets and desired forces (`closing_gains`).
        closing: one of `CLOSINGS`.
        holding: one of `HOLDINGS`.
        belief: lets touches revise the shape and the contacts of the fingers in the air, under the law (Eq. 25).

    Raises:
        BadArgument: an unknown closing or holding, or a belief for a closing that does not follow the law.

    A hand that is driven at 200 Hz; here joints follow at once and the object yields by 1 mm for 2 N:

    >>> from torchgrasp import ContactSpec, closing_gains, load_hand, load_object, plan_grasps
    >>> from torchgrasp.close.sensor import Press, sense, untouched
    >>> from torchgrasp.close.sight import plant_from_hand, sight_from_joints
    >>> hand = load_hand("allegro")
    >>> grasp = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=20)[0]
    >>> plant, gains = plant_from_hand(hand, grasp), closing_gains(grasp, hand)
    >>> controller, touch, joints = GraspController(plant, gains), untouched(), grasp.pregrasp[0].double()
    >>> while not controller.closed:
    ...     points = hand.tip_centres(joints) - plant.radius[:, None] * plant.normals
    ...     push = 2e3 * ((gains.target - points) * plant.normals).sum(-1).clamp_min(0.0)
    ...     press = Press(push, -push[:, None] * plant.normals, points, plant.normals)
    ...     touch = sense(touch, press, plant.normals, plant.radius, 1 / 200)
    ...     joints = controller.step(sight_from_joints(hand, joints, touch), 1 / 200)[list(plant.actuated)]
    >>> bool(touch.contact.all())
    True
    """

    def __init__(
        self,
        plant: Plant,
        gains: ClosingGains,
        closing: ClosingMode = "uncertainty",
        holding: HoldingMode = "squeeze",
        belief: Belief | None = None,
    ) -> None:
        check_modes(closing, holding, belief)
        self.plant, self.gains = plant, gains
        kind = CLOSINGS[closing]
        self.closing = kind(plant, gains, belief) if issubclass(kind, Closing) else kind(plant, gains)
        self._holding, self.hold = HOLDINGS[holding], None
        self.targets = plant.expand(plant.pregrasp)
        self.time, self.pressed = 0.0, 0.0

    @property
    def closed(self) -> bool:
        """Whether the hand has closed as far as it will, and pressed: it may be lifted."""
        if isinstance(self.closing, OpenLoop):
            return self.closing.done
        return self.pressed >= PRESSING_TIME - 1e-9

    def step(self, sight: Sight, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints [rad] for the next tick.

        Args:
            sight: what is known now.
            period: until the next tick [s].
        """
        over = self.closing.done or self.time >= CLOSING_TIME
        if self.hold is None and over and not isinstance(self.closing, OpenLoop):
            self.hold = self._holding(self.plant, self.gains, sight, self.targets)
        if self.hold is None:
            self.time += period
            self.targets = self.closing(sight, period)
        else:
            self.pressed += period
            self.targets = self.hold(sight, period)
        return self.targets
