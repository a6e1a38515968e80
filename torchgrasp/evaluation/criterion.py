"""The criterion of a lift: whether an object was held, judged by its motion and the touching
fingers.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.control import TipContact
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.frames import apply, inverse, rotation_angle
from torchgrasp.geometry.linalg import norm
from torchgrasp.values.closing import ObjectMotion

SLIP_DISTANCE = 0.02
SLIP_ANGLE = math.radians(30)
"""Motion [m, rad] of the object in the closed hand that counts as slipped."""


@dataclasses.dataclass(frozen=True)
class Tick(Value):
    """The state of the simulation at one control tick; with a leading axis, the states at all
    ticks.

    `touching` is the number of fingers on the object, `centre` [m] its centre of mass. `felt` holds
    the controller's estimates of friction and load [N], `truth` the true contacts.
    """

    time: Float[Tensor, "*t"]
    object_pose: Float[Tensor, "*t 4 4"]
    hand_pose: Float[Tensor, "*t 4 4"]
    neighbour_pose: Float[Tensor, "*t m 4 4"]
    joints: Float[Tensor, "*t j"]
    targets: Float[Tensor, "*t j"]
    touching: Int[Tensor, "*t"]
    centre: Float[Tensor, "*t 3"]
    felt: Float[Tensor, "*t 2"]
    blend: Float[Tensor, "*t f"]
    truth: TipContact


def judge_lift(ticks: Sequence[Tick], pressed: int, judged: int, lift_height: float) -> Status:
    """Return whether an object was held in a lift of some height [m]: `OK`, `SLIPPED`, `DROPPED` or
    `NOT_LIFTED`.

    It is held if its centre rose by half of the lift, two fingers touch it in most of the last
    `judged` ticks, and it slipped less than the limits since the tick `pressed`.
    """
    half = 0.5 * lift_height
    rise = [float(tick.centre[2] - ticks[0].centre[2]) for tick in ticks]
    gripped = [bool(tick.touching >= 2) for tick in ticks[-judged:]]
    if rise[-1] >= half and sum(gripped) > 0.5 * len(gripped):
        slip = motion_between(ticks[pressed], ticks[-1])
        still = slip.distance < SLIP_DISTANCE and slip.angle < SLIP_ANGLE
        return Status.OK if still else Status.SLIPPED
    return Status.DROPPED if max(rise) >= half else Status.NOT_LIFTED


def motion_between(first: Tick, last: Tick, in_hand: bool = True) -> ObjectMotion:
    """Return the motion of the object's centre and its rotation between two ticks, relative to the
    hand or world.
    """
    eye = torch.eye(4, dtype=torch.float64)
    start, end = (inverse(tick.hand_pose) if in_hand else eye for tick in (first, last))
    centres = torch.stack([first.centre, last.centre])[:, None]  # (2, 1, 3)
    centres = apply(torch.stack([start, end]), centres)[:, 0]
    turned = (start @ first.object_pose)[:3, :3].T @ (end @ last.object_pose)[:3, :3]
    return ObjectMotion(float(norm(centres[1] - centres[0])), float(rotation_angle(turned)))
