"""The values of closing a hand: gains before, and what happened after. The other values are in `torchgrasp.values`."""

import dataclasses
from typing import Annotated, NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import ANY, Measured, checked
from torchgrasp.errors import Status


@checked
@dataclasses.dataclass(frozen=True)
class ClosingGains(Value):
    """Gains of the closing controller for each finger, in the frame of the hand (Eqs. 26-28).

    `force_source` is "analytic", or "stability" if the stability model chose among the balanced forces.

    >>> from torchgrasp import closing_gains, load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> gains = closing_gains(load_shipped_grasp("jug", "allegro"), load_hand("allegro"))
    >>> gains.desired_force.norm(dim=-1).round(decimals=1)  # [N] of each finger
    tensor([2.8000, 1.2000, 4.0000], dtype=torch.float64)
    """

    target: Float[Tensor, "f 3"]
    covariance: Float[Tensor, "f 3 3"]
    position_gain: Float[Tensor, "f 3"]
    force_gain: Float[Tensor, "f 3"]
    desired_force: Float[Tensor, "f 3"]
    force_source: str = "analytic"


class ObjectMotion(NamedTuple):
    """Motion of an object in the hand: `distance` [m] of its centre, and the `angle` [rad] of its rotation.

    >>> slip = ObjectMotion(distance=0.004, angle=0.1)
    >>> f"{1000 * slip.distance:g} mm, {57.3 * slip.angle:.0f} degrees"
    '4 mm, 6 degrees'
    """

    distance: float
    angle: float


@checked
@dataclasses.dataclass(frozen=True)
class Disturbance(Value):
    """What a trial did to all but its object.

    The three columns are neighbours, table, and the object by links other than the fingers'. `first_touch` [s] is when
    the hand first touched each, infinite if never. `impulse` [N s] is the sum of its normal impulses, `force` [N] the
    largest mean normal force of a control tick. `early` tells whether that was before a fingertip touched the object.
    `neighbour_pose` is the motion of each of m neighbours from its start.
    """

    first_touch: Annotated[Float[Tensor, "3"], ANY]
    impulse: Float[Tensor, "3"]
    force: Float[Tensor, "3"]
    early: Bool[Tensor, "3"]
    neighbour_pose: Float[Tensor, "t m 4 4"]


@checked
@dataclasses.dataclass(frozen=True)
class ClosingTrace(Value):
    """What the fingertips truly did at every tick, and what the controller made of it; all in the hand's frame.

    `forces` [N] act on the object, friction included, at `points` [m] with outward `normals`, NaN without contact.
    `sliding` [m/s] is the speed of each tip along the surface, `blend` lambda of Eq. (26), NaN without the law.
    `friction` is what the hand believes, `load` [N] what it feels, NaN before the holding "grip".
    """

    forces: Annotated[Float[Tensor, "t f 3"], ANY]
    points: Annotated[Float[Tensor, "t f 3"], ANY]
    normals: Annotated[Float[Tensor, "t f 3"], ANY]
    sliding: Annotated[Float[Tensor, "t f"], ANY]
    blend: Annotated[Float[Tensor, "t f"], ANY]
    friction: Annotated[Float[Tensor, "t"], ANY]
    load: Annotated[Float[Tensor, "t"], ANY]


@checked
@dataclasses.dataclass(frozen=True)
class ClosureResult(Value):
    """What happened when the hand closed on the true object.

    `time` [s] counts control ticks. `forces` [N] is the normal force of each fingertip. `object_pose` and `hand_pose`
    are the frames of object and hand in the world. `joints` has every joint of the URDF, in the order of `joint_names`.
    `contact_order` lists the fingers by their first touch. `object_motion` is the motion of the object in the hand
    from the pre-grasp to the end; `slip` is its part since the hand pressed. Two motions are in the world: `pushed` is
    from the pre-grasp until all fingers have touched, or the closing ended, `before_lift` from the start until the hand
    rises. `unbalanced` is then the sum of the fingertips' forces over the sum of their sizes. What a trial did not
    reach is NaN. `start_overlap` [m] is the depth of the
    opened hand in object or table at the start. `held` tells whether the object is up with the hand at the end and
    slipped little; `seconds` is wall time. Poses are in the frame of the grasp. `phases` [s] are the times at which the
    hand had arrived, all fingers had touched, and the hand had pressed; NaN if it never did. `stops` counts how often
    the hand stopped on its way because it touched something, `attempts` how often it closed.
    """

    held: bool
    status: Status
    time: Float[Tensor, "t"]
    forces: Annotated[Float[Tensor, "t f"], ANY]
    object_pose: Annotated[Float[Tensor, "t 4 4"], ANY]
    hand_pose: Annotated[Float[Tensor, "t 4 4"], ANY]
    joints: Annotated[Float[Tensor, "t j"], ANY]
    joint_names: tuple[str, ...]
    contact_order: tuple[int, ...]
    object_motion: ObjectMotion
    pushed: ObjectMotion
    before_lift: ObjectMotion
    unbalanced: Measured
    slip: ObjectMotion
    start_overlap: Measured
    disturbance: Disturbance
    trace: ClosingTrace
    phases: Annotated[Float[Tensor, "3"], ANY]
    stops: int
    attempts: int
    seconds: float
