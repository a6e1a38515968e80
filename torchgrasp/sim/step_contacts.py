"""What fingers and object do to each other in a step of a simulator."""

import dataclasses
from typing import Annotated

import numpy as np

from torchgrasp.checks import Count, Range, checked
from torchgrasp.errors import BadArgument


@dataclasses.dataclass(frozen=True)
class StepContacts:
    """True contacts of f fingers with the object, summed over a step.

    Args:
        impulse: normal impulse on the object (f, 3) [N s]; friction is not in it.
        moment: contact points weighted by the size of their impulse (f, 3) [N s m].
        weight: sum of these sizes (f,) [N s]; `moment / weight` is the mean contact point.
        finger: which fingers touch (f,), by the tip or by the link that carries it.
        force: of each fingertip on the object (f, 3) [N], friction included.
        stray: sums of normal impulses (3,) [N s] of the hand on neighbours, on the table, and of links other than the
            fingers' on the object.

    >>> tick, step = StepContacts.none(), StepContacts.none()
    >>> step.add(1, np.array([0.0, 0.0, 0.02]), 0.02, np.array([0.0, 0.0, 0.1]))
    >>> tick.accumulate(step, count=5)
    >>> tick.impulse[1], (tick.moment[1] / tick.weight[1]).round(3)
    (array([0.  , 0.  , 0.02]), array([0. , 0. , 0.1]))
    """

    impulse: np.ndarray
    moment: np.ndarray
    weight: np.ndarray
    finger: np.ndarray
    force: np.ndarray
    stray: np.ndarray

    @classmethod
    @checked
    def none(cls, fingers: Annotated[int, Range(1, 1000)] = 3) -> "StepContacts":
        """Return sums to add contacts to."""
        impulse, moment, force = np.zeros((3, fingers, 3))
        return cls(impulse, moment, np.zeros(fingers), np.zeros(fingers, dtype=bool), force, np.zeros(3))

    @checked
    def add(self, finger: Annotated[int, Range(0, 1000)], impulse: np.ndarray, size: float, point: np.ndarray) -> None:
        """Add a contact of a fingertip by impulse [N s], its size, and place [m]."""
        if finger >= len(self.weight):
            raise BadArgument("finger", finger, f"one of {len(self.weight)}")
        check_vector("impulse", impulse)
        check_vector("point", point)
        self.impulse[finger] += impulse
        self.moment[finger] += size * point
        self.weight[finger] += size

    @checked
    def accumulate(self, step: "StepContacts", count: Count) -> None:
        """Add one of `count` steps: impulses are summed, forces are averaged."""
        np.add(self.impulse, step.impulse, out=self.impulse)
        np.add(self.moment, step.moment, out=self.moment)
        np.add(self.weight, step.weight, out=self.weight)
        np.add(self.force, step.force / count, out=self.force)


def check_vector(name: str, vector: np.ndarray) -> None:
    """Refuse an array of another shape than (3,), or of what is no number."""
    if vector.shape != (3,) or vector.dtype.kind not in "iuf":
        raise BadArgument(name, f"shape {vector.shape} of {vector.dtype}", "shape (3,) of numbers")
