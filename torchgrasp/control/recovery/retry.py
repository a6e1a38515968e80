"""Closing once more: whether what the fingers feel may be lifted, and where the palm goes if not.

A hand that presses knows most of what a lift would show. Where a finger feels nothing, where the contacts cannot be
balanced within friction, or where the object lies far from where the hand closed, it opens and closes again.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.observation import Observation
from torchgrasp.control.recovery.localization import Localization, Touches
from torchgrasp.control.recovery.palm import next_palm, palm_goal
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import Part
from torchgrasp.plan.internal_forces import least_friction_forces, tangential_ratio

FEELING, FELT = 0.1, 0.3
"""Times [s] from the beginning of the pressing between which contacts are averaged: 20 samples of their normals."""

FRICTION = 0.6
"""Tangent of the forces that balance, from which contacts are not lifted: what household things have on rubber."""

ASIDE = 0.008
"""Distance [m] of the object from where the hand closed, from which it closes again: twice the error of
`Localization`."""

OPENING, RESTING = 0.5, 0.1
"""Times [s] in which the fingers open, before the palm moves, and in which all then comes to rest."""


class PressCheck(Part):
    """What a pressing hand feels, and what follows: `judged` tells that it is known whether the grasp is `secure`.

    `displacement` is that of the object [m, rad] by what was touched. Without an estimated surface it is `believed`.

    Args:
        reference: of the closing.
        believed: displacement of the object as the closing believes it.
        palm: displacement of the palm [m].
        last: whether there is no further attempt: then every grasp counts as secure.
    """

    def __init__(
        self, reference: ClosingReference, believed: Float[Tensor, "6"], palm: Float[Tensor, "3"], last: bool
    ) -> None:
        self.palm, self.displacement = palm, believed
        self.touches = Touches(reference)
        self.search = None if reference.surface is None or reference.table is None else Localization(reference)
        self.judged = self.secure = last

    def __call__(self, observation: Observation, pressed: float, end: float) -> None:
        """Feel, then search, and judge `end` [s] after the pressing began."""
        if self.judged or pressed < FEELING:
            return
        if pressed < FELT:
            self.touches.add(observation, self.palm)
        elif self.search is not None and not self.search.done and bool(self.touches.felt.any()):
            self.search(self.touches)
            self.displacement = self.search.displacement
        elif pressed >= end:
            self.touches.contact = observation.tactile.contact
            self.judged, self.secure = True, self._is_secure()

    def _is_secure(self) -> bool:
        """Tell whether all fingers touch, within friction, where the hand closed."""
        touches = self.touches
        if not bool((touches.contact | ~touches.known).all()):
            return False
        if float(torch.linalg.vector_norm(self.displacement[:3] - self.palm)) > ASIDE:
            return False
        if not bool(touches.felt.all()):
            return True  # some fingertips tell no places: there is nothing more to judge by
        points, normals = touches.means()
        ratio = tangential_ratio(least_friction_forces(points, normals), normals)
        return bool((ratio <= FRICTION).all())  # NaN, where nothing balances, is not


class Reopening(Part):
    """Open the hand and bring its palm to where the object is: `done` when the hand may close again.

    Args:
        reference: of the closing.
        displacement: of the object [m, rad].
        joints: targets of all joints at the beginning [rad].
        palm: displacement of the palm then [m].
        reach: farthest displacement of the palm [m]; 0 for an arm that does not yield.
    """

    def __init__(
        self,
        reference: ClosingReference,
        displacement: Float[Tensor, "6"],
        joints: Float[Tensor, " j"],
        palm: Float[Tensor, "3"],
        reach: float,
    ) -> None:
        self.displacement, self.start, self.opened = displacement, joints, reference.expand(reference.pregrasp)
        self.palm, self.time = palm, 0.0
        self.goal = palm_goal(displacement[:3], reference.table, reach) if reach else palm

    @property
    def done(self) -> bool:
        """Whether the hand is open, where the palm goes, and at rest."""
        return self.time >= OPENING + RESTING

    def __call__(self, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick; first the fingers open, then the palm moves."""
        if self.time >= OPENING and not torch.equal(self.palm, self.goal):
            self.palm = next_palm(self.palm, self.goal, period)
        else:
            self.time += period
        return torch.lerp(self.start, self.opened, min(self.time / OPENING, 1.0))
