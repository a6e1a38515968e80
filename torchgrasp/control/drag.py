"""The controller of a drag: the hand presses on an object from above, moves it along, and lets go.

It needs no simulator. Vectors are in the frame of the planned hand (its root link).
"""

import dataclasses
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.regrasp import smooth_step
from torchgrasp.control.tactile import Observation, Targets
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.linalg import norm
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.edge import DragPlan

Phase = Literal["down", "drag", "up", "done"]
"""What a dragging hand does: it comes down and presses, moves along, rises, or has ended."""


@dataclasses.dataclass(frozen=True)
class DragControlNumbers:
    """Parameters of the controller of a drag."""

    height: float = 0.05
    """Height [m] above the object at which the hand starts and ends: that of its checked path."""
    fastest: float = 0.05
    """Greatest speed [m/s] of the palm on its way down."""
    near: float = 0.01
    """Height [m] from which the palm comes down slowly: the object may be higher than planned."""
    gain: float = 0.003
    """Speed [m/s] of the palm for each newton that the pressing force is off."""
    touching: float = 0.01
    """Greatest speed [m/s] of the palm while it presses."""
    pressed: float = 0.9
    """Share of the wanted force from which the hand moves along."""
    deepest: float = 0.03
    """Depth [m] below the planned pose at which a hand that has not pressed yet gives up."""
    patience: float = 3.0
    """Time [s] of pressing after which the hand gives up."""
    speed: float = 0.06
    """Mean speed [m/s] of the drag: friction is then far above inertia."""
    lag: float = 0.02
    """Greatest lag [m] of the tips behind the palm that the palm makes up for."""
    rise: float = 0.1
    """Mean speed [m/s] at which the hand rises."""


DRAGGING = DragControlNumbers()


class DragController:
    """Controller that drags an object with a hand. Each `step` maps an `Observation` to `Targets`.

    The joints keep their posture. The palm starts 50 mm (`DRAGGING.height`) above its planned pose
    and comes down until the fingertips press with the planned force. Then it moves along by the
    planned displacement, and rises. An arm must keep the palm at `Targets.palm`.

    Args:
        plan: the drag, from `plan_edge_grasps`.
        hand: the hand of the plan.

    Attributes:
        phase: what the hand does ("down", "drag", "up"), or "done".
        status: `OK`, or `NO_CONTACT` for a hand that could not press. It then rises at once.
        targets: the present targets, those of the last `step`.

    Raises `BadArgument` for a plan of another hand.
    """

    @checked
    def __init__(self, plan: DragPlan, hand: Hand) -> None:
        if len(plan.joints) != hand.dof or len(plan.presses) != len(hand.tips):
            found = f"{len(plan.joints)} joints, {len(plan.presses)} fingertips"
            raise BadArgument("plan", found, f"{hand.dof} and {len(hand.tips)}, as the hand has")
        turn = plan.obj_from_hand[:3, :3].double()
        self.plan = plan
        self.up = plan.table.normal.double() @ turn
        self.way = plan.displacement.double() @ turn
        self.presses: Bool[Tensor, f] = plan.presses
        self.joints = hand.to("cpu", torch.float64).expand_joints(plan.joints.double())
        self.phase: Phase = "down"
        self.status = Status.OK
        self.height = DRAGGING.height
        self.share = 0.0
        self.lag = 0.0
        self.time = 0.0
        self.began: Float[Tensor, "f 3"] | None = None
        self.targets = self._targets()

    @checked
    def step(self, observation: Observation, period: Annotated[float, Range(1e-5, 1.0)]) -> Targets:
        """Return the targets of joints and palm for the next tick.

        Args:
            observation: what the hand measures now.
            period: time [s] until the next tick.
        """
        reading = observation.tactile.reading.where(self.presses, 0.0)
        force = float(reading.sum())
        if self.phase == "down":
            self._press(force, period)
        elif self.phase == "drag":
            self._move(observation.tips, force, period)
        elif self.phase == "up":
            self.height += DRAGGING.rise * period
            if self.height >= DRAGGING.height:
                self.phase = "done"
        self.targets = self._targets()
        return self.targets

    def _press(self, force: float, period: float) -> None:
        """Come down, and press with the planned force; give up if nothing is there."""
        touching = force > 0.0
        self.time += period * touching
        self.height += self._speed(force, touching) * period
        if force >= DRAGGING.pressed * self.plan.force:
            self.phase = "drag"
            self.time = 0.0
        elif self.height < -DRAGGING.deepest or self.time > DRAGGING.patience:
            self.status = Status.NO_CONTACT
            self.phase = "up"

    def _move(self, tips: Float[Tensor, "f 3"], force: float, period: float) -> None:
        """Move along by a smooth step, with the planned force.

        Friction bends the fingers back, so that the tips lag behind the palm, which goes farther.
        """
        length = float(norm(self.way))
        if self.began is None:
            self.began = tips
        behind = (self.began - tips)[self.presses].mean(0) @ self.way / length
        self.lag = min(max(float(behind), 0.0), DRAGGING.lag)
        self.time += period
        self.share = min(self.time * DRAGGING.speed / length, 1.0)
        self.height += self._speed(force, True) * period
        if self.share >= 1.0:
            self.phase = "up"

    def _speed(self, force: float, touching: bool) -> float:
        """Return the palm's vertical speed [m/s]: in proportion to the force that is missing."""
        if not touching:
            near = self.height < DRAGGING.near
            return -(DRAGGING.touching if near else DRAGGING.fastest)
        speed = DRAGGING.gain * (force - self.plan.force)
        return max(-DRAGGING.touching, min(speed, DRAGGING.touching))

    def _targets(self) -> Targets:
        """Return the targets of all joints, and of the palm at its present height and share."""
        length = norm(self.way)
        along = smooth_step(self.share)[0] * length + self.lag
        palm = self.height * self.up + along * self.way / length
        return Targets(self.joints, palm)
