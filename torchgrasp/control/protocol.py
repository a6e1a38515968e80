"""The interface of all closing controllers, and the test by which a closing has settled.

f counts fingertips, h actuated joints, and j all joints of the URDF.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import NOISE, Observation
from torchgrasp.hand.drives import strongest_leads

SETTLED = 0.1  # time [s] for which a closing's end must hold before the closing is done
POSE_TIME = 0.4  # time [s] from pre-grasp to grasp in open loop, and again from grasp to squeeze
Step = Callable[[Observation, float], Float[Tensor, " j"]]
"""Function of an observation and the time [s] to the next tick, which returns the targets [rad] of
all joints.
"""


@runtime_checkable
class Closing(Protocol):
    """The interface of a controller that closes the fingers of a hand on an object.

    Call it at each control tick with an `Observation` and the time [s] to the next tick. It returns
    the targets (j,) [rad or m] of all j joints of the URDF.
    """

    @property
    def palm(self) -> Float[Tensor, "3"]:
        """Displacement (3,) [m] of the palm from its planned pose, in the hand's frame."""
        ...

    @property
    def done(self) -> bool:
        """Whether the closing has ended, so that the hand can press."""
        ...

    @property
    def feels(self) -> bool:
        """Whether sensor readings change the targets.

        If not, the last targets already press on the object, and no hold controller follows.
        """
        ...

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets (j,) [rad or m] of all joints of the URDF until the next tick.

        Args:
            observation: what the hand measures now.
            period: time [s] to the next tick.
        """
        ...


@runtime_checkable
class LawClosing(Closing, Protocol):
    """The interface of a closing controller whose control law can also press on the object
    afterwards.

    The law mixes position control and force control of each finger.
    """

    @property
    def share(self) -> Float[Tensor, "f"]:
        """Each finger's share of force control (f,), from 0 to 1."""
        ...

    def press(self) -> Step:
        """Return the function by which the same control law presses after the closing.

        Call it at each control tick with an `Observation` and the time [s] to the next tick. It
        returns the targets (j,) [rad or m] of all joints.
        """
        ...


class Settled:
    """A timer of how long a closing has settled: `time` [s] counts while all fingers touch.

    If `update` is called with `pressing`, the fingers must also be under force control, with steady
    forces.

    Args:
        reference: the closing plan, which gives the number of fingers.
    """

    def __init__(self, reference: ClosingReference) -> None:
        self.time = 0.0
        self.steady = torch.zeros_like(reference.normals[:, 0])

    def update(
        self,
        observation: Observation,
        touching: Bool[Tensor, "f"],
        share: Float[Tensor, "f"],
        period: float,
        pressing: bool = True,
    ) -> None:
        """Add a control period of `period` [s] to `time` if the closing is settled; otherwise set
        `time` to 0.

        It is settled if all fingers touch. With `pressing`, each must also have a `share` of force
        control of at least 0.5, and a steady force. A force is steady if its average
        (`TactileState.average`) changed by at most 0.1 N (`NOISE`). The change counts from the last
        tick that was not settled. `touching` marks the fingers that touch. f counts fingers.
        """
        average = observation.tactile.average
        settled = bool(touching.all())
        if pressing:
            steady = ((average - self.steady).abs() < NOISE).all()
            settled = settled and bool((share >= 0.5).all() & steady)
        self.time = self.time + period if settled else 0.0
        if not settled:
            self.steady = average


def strongest_lead(reference: ClosingReference) -> Float[Tensor, " h"]:
    """Return, for each of h actuated joints, the target minus position [rad] at which its drive
    exerts its largest torque.
    """
    return strongest_leads(reference.hand, reference.kp)
