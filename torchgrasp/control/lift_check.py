"""Feel during a lift whether the object stays behind."""

from typing import Annotated

from torchgrasp.checks import Range, checked
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import Observation, low_pass


class LiftCheck:
    """Feel while a closed hand rises whether it has lost the object; `lost` then stays true.

    The object is lost if fewer than two fingertips touch, and these carry hardly any load along the table's normal.
    Only touches count for binary sensors, or without a table. Broken sensors count as touching.

    Args:
        reference: the closing plan.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.control import no_contact, observe
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand = load_hand("allegro")
    >>> reference = ClosingReference.from_grasp(hand, load_shipped_grasp("jug", "allegro"))
    >>> check, nothing = LiftCheck(reference), observe(hand, reference.joints, no_contact())
    >>> check(nothing, height=0.005, period=0.01), check(nothing, height=0.02, period=0.01)
    (False, True)
    """

    @checked
    def __init__(self, reference: ClosingReference) -> None:
        self.alive, self.lost, self.load = reference.alive, False, 0.0
        self.table = None if reference.sensor.kind == "binary" else reference.table

    @checked
    def __call__(self, observation: Observation, height: float, period: Annotated[float, Range(1e-5, 1.0)]) -> bool:
        """Return `lost` at the end of a tick of `period` [s], in which the hand has risen to `height` [m]."""
        least, first = 0.2, 0.01  # load [N], and height [m] from which the hand is judged
        tactile = observation.tactile
        if self.table is not None:
            load = float((tactile.forces @ self.table.normal.double()).sum())
            self.load += low_pass(3.0, period) * (load - self.load)
        slack = int((tactile.contact | ~self.alive).sum()) < 2 and self.load < least
        self.lost = self.lost or (slack and height >= first)
        return self.lost
