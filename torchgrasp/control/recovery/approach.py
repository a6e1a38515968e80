"""The guarded approach: a hand that touches something on its way stops, and goes to where the object is.

An open hand that runs into an object topples it or pushes it away, farther than any closing can follow. A guarded move
stops at the first touch. The touch and the fingertips in the air tell where the object is (`Localization`); the hand
draws back, moves its palm aside and goes on.
"""

import math

import torch

from torchgrasp.control.closing import PALM_REACH
from torchgrasp.control.observation import Observation
from torchgrasp.control.recovery.localization import Localization, Touches
from torchgrasp.control.recovery.palm import next_palm, palm_goal
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import Part
from torchgrasp.control.targets import STILL
from torchgrasp.specs import guards_approach

SPEED, CAREFUL, ACCELERATION = 0.2, 0.08, 1.0
"""Largest speed [m/s] of the palm along its approach, that after it touched something, and the rate [m/s^2] at which it
changes, except for a stop. A touch is known 20 ms after it happened: 4 mm later. A hand that is slow from the start
pushes longer with links that feel nothing, and topples more (docs/closing.md)."""

HALTS, FEELING, BACK = 3, 0.06, 0.02
"""How often the hand stops, the time [s] for which a touch is averaged, and the way [m] that the hand draws back then:
a fingertip's width."""


def can_guard(reference: ClosingReference, closing: str, without: tuple[str, ...]) -> bool:
    """Return whether a closing stops at touches, and these tell where the object is.

    They do by their places, on a known table and surface.
    """
    known = reference.approach is not None and reference.table is not None and reference.surface is not None
    return guards_approach(closing, without) and known and reference.sensor.kind == "tactile"


class GuardedApproach(Part):
    """Bring the opened hand straight to its pre-grasp, and stop where it touches something.

    `left` [m] is the rest of the approach, `palm` [m] the palm's displacement from it, `halts` how often it stopped.
    `displacement` [m, rad] is that of the object, as the last touch tells it. After `HALTS` stops the hand goes on
    whatever it feels.

    Args:
        reference: of the closing, which `can_guard`.
        length: of the approach [m].
    """

    def __init__(self, reference: ClosingReference, length: float) -> None:
        assert reference.approach is not None
        self.reference, self.length, self.direction = reference, length, reference.approach
        self.left, self.speed, self.retreat, self.halts = length, 0.0, 0.0, 0.0
        self.palm, self.goal, self.displacement = STILL, STILL, torch.zeros(6, dtype=torch.float64)
        self.felt, self.feeling = 0.0, False
        self.touches, self.search = Touches(reference), Localization(reference)

    @property
    def done(self) -> bool:
        """Whether the hand is at its pre-grasp."""
        return self.left <= 0.0

    def __call__(self, observation: Observation, period: float) -> None:
        """Choose `left` and `palm` for the next tick."""
        if self.feeling:
            self._feel(observation, period)
        elif self.left < self.retreat:
            self.speed = min(self.speed + ACCELERATION * period, SPEED)
            self.left = min(self.left + self.speed * period, self.retreat)
            if self.left >= self.retreat:
                self.speed = self.retreat = 0.0
        elif not torch.equal(self.palm, self.goal):
            self.palm = next_palm(self.palm, self.goal, period)
        elif self.halts < HALTS and bool(observation.tactile.contact.any()):
            self.speed, self.felt, self.feeling = 0.0, 0.0, True
            self.touches, self.search = Touches(self.reference), Localization(self.reference)
        else:
            braking = math.sqrt(2 * ACCELERATION * self.left)  # the speed from which the hand just stops in time
            fastest = CAREFUL if self.halts else SPEED
            self.speed = min(self.speed + ACCELERATION * period, fastest, max(braking, ACCELERATION * period))
            self.left = max(self.left - self.speed * period, 0.0)

    def _feel(self, observation: Observation, period: float) -> None:
        """Average the touch, then search for the object; at the end choose how the hand goes on."""
        if self.felt < FEELING:
            self.felt += period
            self.touches.add(observation, self.palm - self.left * self.direction)
        elif not self.search.done and bool(self.touches.felt.any()):
            self.search(self.touches)
        else:
            self.feeling, self.halts = False, self.halts + 1.0
            if self.search.done:
                self.displacement = self.search.displacement
                self.goal = palm_goal(self.displacement[:3], self.reference.table, PALM_REACH)
            self.retreat = min(self.left + BACK, self.length)
