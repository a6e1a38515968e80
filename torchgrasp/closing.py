"""The values of closing a hand: gains before, and what happened after. The other values are in `torchgrasp.values`."""

import dataclasses
from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import Status


@dataclasses.dataclass(frozen=True)
class ClosingGains(Value):
    """Gains of the closing controller for each finger, in the frame of the hand (Eqs. 26-28).

    `force_source` is "analytic", or "stability" if the stability model chose among the balanced forces.
    """

    target: Float[Tensor, "f 3"]
    covariance: Float[Tensor, "f 3 3"]
    position_gain: Float[Tensor, "f 3"]
    force_gain: Float[Tensor, "f 3"]
    desired_force: Float[Tensor, "f 3"]
    force_source: str = "analytic"


class ObjectMotion(NamedTuple):
    """Motion of an object in the hand: `distance` [m] of its centre, and the `angle` [rad] of its rotation."""

    distance: float
    angle: float


@dataclasses.dataclass(frozen=True)
class Disturbance(Value):
    """What a trial did to all but its object.

    The three columns are neighbours, table, and the object by links other than the fingers'. `first_touch` [s] is when
    the hand first touched each, infinite if never. `impulse` [N s] is the sum of its normal impulses, `force` [N] the
    largest mean normal force of a control tick. `early` tells whether that was before a fingertip touched the object.
    `neighbour_pose` is the motion of each of m neighbours from its start.
    """

    first_touch: Float[Tensor, "3"]
    impulse: Float[Tensor, "3"]
    force: Float[Tensor, "3"]
    early: Bool[Tensor, "3"]
    neighbour_pose: Float[Tensor, "t m 4 4"]


@dataclasses.dataclass(frozen=True)
class ClosureResult(Value):
    """What happened when the hand closed on the true object.

    `time` [s] counts control ticks. `forces` [N] is the normal force of each fingertip. `object_pose` and `hand_pose`
    are the frames of object and hand in the world. `joints` has every joint of the URDF, in the order of `joint_names`.
    `contact_order` lists the fingers by their first touch. `object_motion` is the motion of the object in the hand
    from the pre-grasp to the end. `pushed` is its part until all fingers have touched, or the closing ended; `slip` is
    its part since the hand pressed; both are NaN if the trial ended before. `start_overlap` [m] is the depth of the
    opened hand in object or table at the start. `held` tells whether the object is up with the hand at the end and
    slipped little; `seconds` is wall time. Poses are in the frame of the grasp.
    """

    held: bool
    status: Status
    time: Float[Tensor, "t"]
    forces: Float[Tensor, "t f"]
    object_pose: Float[Tensor, "t 4 4"]
    hand_pose: Float[Tensor, "t 4 4"]
    joints: Float[Tensor, "t j"]
    joint_names: tuple[str, ...]
    contact_order: tuple[int, ...]
    object_motion: ObjectMotion
    pushed: ObjectMotion
    slip: ObjectMotion
    start_overlap: float
    disturbance: Disturbance
    seconds: float
