"""The controller of a drag: the hand presses on an object from above, moves it along, and lets go.

It needs no simulator. Vectors are in the frame of the planned hand (its root link).
"""

import dataclasses
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.sensing import WAITING_FORCE
from torchgrasp.control.smooth import smooth_step
from torchgrasp.control.tactile import Observation, TactileState, Targets, check_observation
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.linalg import limit_norm, norm
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.drag_plan import DragPlan

Phase = Literal["down", "drag", "up", "done"]
"""What a dragging hand does: it comes down and presses, moves along, rises, or has ended."""


@dataclasses.dataclass(frozen=True)
class DragControlNumbers:
    """Parameters of the controller of a drag."""

    agree: float = 1e-3
    """Greatest distance [m] between a plan's contact points (`feet`) and the lowest points of the
    fingertips. Beyond it, the plan is that of another hand.
    """
    height: float = 0.05
    """Height [m] above its planned pose at which the hand starts and ends. The plan's path is
    checked for collisions from this height.
    """
    fastest: float = 0.05
    """Greatest speed [m/s] of the palm on its way down."""
    near: float = 0.01
    """Height [m] above the planned pose below which the palm comes down slowly: the object may be
    higher than planned.
    """
    gain: float = 0.003
    """Speed [m/s] of the palm for each newton that the pressing force is off."""
    touching: float = 0.01
    """Greatest speed [m/s] of the palm while it presses."""
    pressed: float = 0.9
    """Share of the wanted pressing force above which the hand begins to move along."""
    felt: float = 0.4
    """Sum of the fingertips' normal forces [N] above which they count as touching. It is three
    standard deviations of the noise of two fingertips.
    """
    below: float = 0.005
    """Depth [m] under the table to which the fingertips are sent: the table may be lower than
    planned.
    """
    deepest: float = 0.03
    """Depth [m] below the planned pose at which a hand that presses too little gives up."""
    patience: float = 3.0
    """Time [s] of pressing after which the hand gives up."""
    lost: float = 0.2
    """Time [s] without a force on the fingertips, during the drag, after which the object counts as
    lost.
    """
    speed: float = 0.06
    """Mean speed [m/s] of the drag: friction is then far above inertia."""
    lag: float = 0.02
    """Greatest lag [m] of the fingertips behind the palm that the palm makes up for."""
    catching: float = 0.03
    """Greatest speed [m/s] at which the palm makes up for this lag."""
    rise: float = 0.1
    """Mean speed [m/s] at which the hand rises."""


DRAGGING = DragControlNumbers()


class DragController:
    """Controller that drags an object with a hand. Each `step` maps an `Observation` to `Targets`.

    The joints keep their posture. The palm starts 50 mm (`DRAGGING.height`) above its planned pose.
    It comes down until the fingertips press with the planned force. Then it moves along by the
    planned displacement, and rises. An arm must keep the palm at `Targets.palm`. The sensors of the
    pressing fingers must measure forces.

    Friction bends the fingers, so that the tips lag behind the palm and drift sideways. The palm
    makes up for this along the table, so that the tips go where the plan wants them. It undoes this
    while it rises, so that the fingers do not pull the object along.

    Args:
        plan: the drag, from `plan_edge_grasps`.
        hand: the hand of the plan.

    Attributes:
        phase: what the hand does ("down", "drag", "up"), or "done".
        status: `OK`, or `NO_CONTACT` for a hand that could not press, or lost the object on the way.
            It then rises at once.

    Raises `BadArgument` for a plan of another hand, without a pressing finger or a positive force,
    or without a displacement.
    """

    @checked
    def __init__(self, plan: DragPlan, hand: Hand) -> None:
        if len(plan.joints) != hand.dof or len(plan.presses) != len(hand.tips):
            found = f"{len(plan.joints)} joints, {len(plan.presses)} fingertips"
            raise BadArgument("plan", found, f"{hand.dof} and {len(hand.tips)}, as the hand has")
        plan = plan.to("cpu", torch.float64)
        if not plan.presses.any():
            raise BadArgument("plan", "no finger that presses", "one or two")
        if not plan.force > 0.0:
            raise BadArgument("plan", f"a force of {plan.force:g} N", "a positive one")
        if not plan.displacement.any():
            raise BadArgument("plan", "no displacement", "one along the table")
        turn = plan.obj_from_hand[:3, :3]
        self.plan = plan
        self.hand = hand
        self.up = plan.table.normal @ turn
        self.way = plan.displacement @ turn
        self.presses = plan.presses
        hand = hand.to("cpu", torch.float64)
        self.joints = hand.expand_joints(plan.joints)
        self.tips = hand.tip_centres(plan.joints)
        radius = hand.tips.radius[:, None]
        off = norm(apply(plan.obj_from_hand, self.tips) - radius * plan.table.normal - plan.feet)
        if not (off < DRAGGING.agree)[plan.presses].all():
            found = "a plan whose feet are not below the fingertips of this hand"
            raise BadArgument("plan", found, "a plan of this hand")
        # the height of the palm at which the tips are in the table
        foot = float(plan.table.height(plan.feet[plan.presses]).min())
        self.lowest = max(-DRAGGING.deepest, -foot - DRAGGING.below)
        self.phase: Phase = "down"
        self.status = Status.OK
        self.height = DRAGGING.height
        self.share = 0.0
        self.lag = torch.zeros_like(self.way)
        self.time = 0.0
        self.missing = 0.0
        self.straighten = 0.0

    @property
    def targets(self) -> Targets:
        """The present `Targets` of joints and palm, in new tensors that the receiver may change."""
        palm = self.height * self.up + smooth_step(self.share)[0] * self.way + self.lag
        return Targets(self.joints, palm).copied()

    @checked
    def step(self, observation: Observation, period: Annotated[float, Range(1e-5, 1.0)]) -> Targets:
        """Return the targets of joints and palm for the next control tick, the time until the next
        call.

        Args:
            observation: what the hand measures now.
            period: time [s] until the next control tick, 1e-5 to 1.

        Raises `BadArgument` for a period outside 1e-5 to 1 s, an observation of another hand, and
        readings of `feel_flags`, which have no forces.
        """
        check_observation(self.hand, observation)
        self._check_forces(observation.tactile)
        reading = observation.tactile.reading.where(self.presses, 0.0)
        force = float(reading.sum())
        if self.phase == "down":
            self._press(force, period)
        elif self.phase == "drag":
            self._move(observation.tips, force, period)
        elif self.phase == "up":
            self.lag = self.lag - limit_norm(self.lag, self.straighten * period)
            self.height += DRAGGING.rise * period
            if self.height >= DRAGGING.height:
                self.phase = "done"
        return self.targets

    def _check_forces(self, tactile: TactileState) -> None:
        """Raise `BadArgument` for readings of fingertips that sense only whether they touch."""
        flags = tactile.contact & (tactile.reading == WAITING_FORCE)
        if (flags & (tactile.forces == 0.0).all(-1)).any():
            found = "those of `feel_flags`, which have no forces"
            raise BadArgument("observation.tactile", found, "readings of forces, in newtons")

    def _press(self, force: float, period: float) -> None:
        """Come down, and press with the planned force; give up if nothing is there."""
        touching = force > DRAGGING.felt
        self.time += period * touching
        self.height += self._speed(force, touching) * period
        if force >= DRAGGING.pressed * self.plan.force:
            self.phase = "drag"
            self.time = 0.0
        else:
            lowest = -DRAGGING.deepest if touching else self.lowest
            self._give_up(self.height < lowest or self.time > DRAGGING.patience)

    def _give_up(self, failed: bool) -> None:
        """Rise at once if the drag has failed."""
        if failed:
            self.status = Status.NO_CONTACT
            self.phase = "up"

    def _move(self, tips: Float[Tensor, "f 3"], force: float, period: float) -> None:
        """Move along by a smooth step, with the planned force; give up if the object is lost."""
        bent = (tips - self.tips)[self.presses].mean(0)
        depth = float(bent @ self.up)
        behind = depth * self.up - bent
        more = limit_norm(behind - self.lag, DRAGGING.catching * period)
        self.lag = limit_norm(self.lag + more, DRAGGING.lag)
        self.time += period
        self.share = min(self.time * DRAGGING.speed / float(norm(self.way)), 1.0)
        self.height += self._speed(force, True) * period
        self.missing = 0.0 if force > DRAGGING.felt else self.missing + period
        # while the hand rises, all bends shrink at one rate, and so do the forces: the object stays
        size = float(norm(self.lag))
        self.straighten = DRAGGING.rise * size / max(depth, size, DRAGGING.agree)
        if self.share >= 1.0:
            self.phase = "up"
        self._give_up(self.missing > DRAGGING.lost or self.height < -DRAGGING.deepest)

    def _speed(self, force: float, touching: bool) -> float:
        """Return the palm's vertical speed [m/s]: in proportion to the force that is missing."""
        if not touching:
            near = self.height < DRAGGING.near
            return -(DRAGGING.touching if near else DRAGGING.fastest)
        speed = DRAGGING.gain * (force - self.plan.force)
        return max(-DRAGGING.touching, min(speed, DRAGGING.touching))
