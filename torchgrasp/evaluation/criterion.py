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
"""Least motion [m] and rotation [rad] of the object in the closed hand that count as a slip."""


@dataclasses.dataclass(frozen=True)
class Tick(Value):
    """The state of the simulation at one control tick, a period of the controller. With a leading
    axis t, it holds the states at all ticks.

    Poses and points are in the simulator's frame, whose z axis points up. j counts all joints of
    the URDF, in the order of the simulated scene. m counts neighbours: other bodies on the table.

    Attributes:
        time: time [s] since the start.
        object_pose: rigid transform (4, 4) [m] that has moved the object since the start.
        hand_pose: pose (4, 4) [m] of the hand's root link.
        neighbour_pose: rigid transforms (m, 4, 4) [m] that have moved the neighbours.
        joints: positions (j,) [rad or m] of the joints.
        targets: targets (j,) [rad or m] of the drives.
        touching: number of fingers that touch the object.
        centre: centre of mass (3,) [m] of the object.
        felt: coefficient of friction and load [N] (2,), as the controller estimates them.
        blend: weight lambda (f,) of Eq. (26) for each finger: 0 for position, 1 for force control.
        truth: true contacts of the fingertips, in the frame of the hand's root link.
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
    """Return whether an object was held in a lift: `OK`, `SLIPPED`, `DROPPED` or `NOT_LIFTED`.

    Args:
        ticks: the states at all control ticks.
        pressed: index of the tick at which the pressing ended.
        judged: number of last ticks in which the fingers must touch the object.
        lift_height: height of the lift [m].

    The object is held if three conditions are met. Its centre rose by at least half of the lift. At
    least two fingers touch it in most of the judged ticks. Since the pressing ended, it slipped in
    the hand by less than 20 mm and 30 degrees (`SLIP_DISTANCE`, `SLIP_ANGLE`).

    `SLIPPED` means that only the third condition failed. Otherwise the status is `NOT_LIFTED` if
    the centre never rose by half of the lift, and `DROPPED` if it did.
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
    """Return how far the object's centre moved [m] and the object turned [rad] between two control
    ticks, `first` and `last`.

    Both are relative to the hand's root link, or to the world if `in_hand` is False.
    """
    eye = torch.eye(4, dtype=torch.float64)
    start, end = (inverse(tick.hand_pose) if in_hand else eye for tick in (first, last))
    centres = torch.stack([first.centre, last.centre])[:, None]  # (2, 1, 3)
    centres = apply(torch.stack([start, end]), centres)[:, 0]
    turned = (start @ first.object_pose)[:3, :3].T @ (end @ last.object_pose)[:3, :3]
    return ObjectMotion(float(norm(centres[1] - centres[0])), float(rotation_angle(turned)))
