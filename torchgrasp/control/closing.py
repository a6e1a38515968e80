"""How the fingers come to the object: in open loop, under the law (Eq. 25), or as the paper's position baseline.

Each turns what a robot knows at a tick (`Observation`) into joint targets and says when it is `done`.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.adaptive.belief import Belief
from torchgrasp.control.closing_law import POSITION_FLOOR, POSITION_RATE, blend, joint_step, tip_velocity
from torchgrasp.control.observation import ControlModel, Observation
from torchgrasp.values import ClosingGains

POSE_TIME = 0.4
"""Time [s] from pre-grasp to grasp in open loop, and as much from grasp to squeeze."""

WAITING_FORCE = 0.3
"""Force [N] with which a finger that touches waits for the others: less than the table's friction on a light object."""

PATIENCE = 1.5
"""Time [s] for which the first finger waits for the last before the hand presses with those that touch."""

SETTLED = 0.1
"""Time [s] for which all fingers must feel contact before the hand presses."""

STOP_FORCE = 0.5
"""Force [N] at which a finger of the position baseline stops (Sec. 6.5)."""

AIM_DEPTH = 0.02
"""How far [m] behind its planned contact a finger of the position baseline aims, to touch what is not where it was
believed to be."""

STOP_DISTANCE = 1e-3
"""Distance [m] from its target at which a finger of the position baseline stops."""

INTEGRAL_RATE = 2.0
"""Integral gain [1/s^2] of the position baseline."""

IMPATIENCE = 0.25
"""Time [s] of waiting for a late finger in which its drives may press harder by as much as they may at first."""

LEAD = 0.04
"""Largest lead [rad] of a joint's target over the joint while closing: a link that meets the object unfelt, elsewhere
than at the fingertip, presses with no more than kp times this."""


class OpenLoopClosing:
    """Pre-grasp, grasp and squeeze one after the other, whatever is felt: what others replay."""

    def __init__(self, model: ControlModel, gains: ClosingGains) -> None:
        self.poses = torch.stack([model.expand(pose) for pose in (model.pregrasp, model.joints, model.squeeze)])
        self.time, self.done = 0.0, False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        progress = min(self.time / POSE_TIME, 2.0)
        self.done = self.time >= 2 * POSE_TIME - 0.5 * period
        first = min(int(progress), 1)
        return torch.lerp(self.poses[first], self.poses[first + 1], progress - first)


class UncertaintyClosing:
    """The uncertainty-aware controller (Eqs. 25-28), with fingers that wait for each other.

    A finger in the air searches for its desired force, beyond the planned contact, too: along the normal Eq. (26)
    tolerates a position error, and here it tolerates any as soon as the contact is passed. Before the first touch the
    fingers keep pace, so that they arrive together. One that feels contact is force-controlled whatever its
    position error (its blend is 1): a calibrated shape is still wrong now and then, and Eq. (26) would press on
    towards the planned point. It waits with `WAITING_FORCE`, so that the object stays where it is, until all touch or
    `PATIENCE` is over. The full forces are left to the holding: raised by three separate loops they would not balance
    on the way, and a cylinder of 0.1 kg moves by 8 mm instead of 4 mm. With a `belief` a touch that surprises moves the
    contacts of the others.
    """

    def __init__(self, model: ControlModel, gains: ClosingGains, belief: Belief | None = None) -> None:
        self.model, self.gains, self.belief = model, gains, belief
        self.target = model.pregrasp
        self.waiting = self.settled = 0.0
        self.done = False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        if self.belief is not None:
            self.model, self.gains = self.belief.revise(observation, self.model, self.gains)
        model, gains = self.model, self.gains
        self.waiting = self.waiting + period if bool(observation.contact.any()) else 0.0
        self.settled = self.settled + period if bool(observation.contact.all()) else 0.0
        self.done = self.settled >= SETTLED or self.waiting >= PATIENCE
        wished = torch.where(observation.contact, WAITING_FORCE, -(gains.desired_force * model.normals).sum(-1))
        error = gains.target - (observation.tips - model.radius[:, None] * model.normals)
        ahead = -(error * model.normals).sum(-1)  # how far the planned contact still lies ahead of each fingertip
        error = error + ahead.clamp_max(0.0)[:, None] * model.normals
        share = torch.where(observation.contact, 1.0, blend(error, gains.covariance))
        force_error = -(wished - observation.reading)[:, None] * model.normals
        velocity = tip_velocity(error, force_error, share, gains.position_gain, gains.force_gain)
        velocity = velocity * self._pace(ahead, observation.contact)[:, None]
        step = joint_step(observation.jacobian @ model.coupling, velocity, period, model.joints - self.target)
        actuated = observation.joints[list(model.actuated)]
        lead = LEAD * (1 + self.waiting / IMPATIENCE)
        target = torch.minimum(torch.maximum(self.target + step, actuated - lead), actuated + lead)
        self.target = torch.minimum(torch.maximum(target, model.lower), model.upper)
        return model.expand(self.target)

    def _pace(self, ahead: Float[Tensor, "3"], contact: Bool[Tensor, "3"]) -> Float[Tensor, "3"]:
        """Return the share of its speed that each finger may go, so that those in the air arrive together."""
        if bool(contact.any()):
            return torch.ones_like(ahead)
        left = ahead.clamp_min(0.0) + POSITION_FLOOR
        return left / left.max()


class FixedGainClosing(UncertaintyClosing):
    """`UncertaintyClosing` with the same gains for every contact and direction: what the uncertainty's weights are measured by."""

    def __init__(self, model: ControlModel, gains: ClosingGains, belief: Belief | None = None) -> None:
        same = torch.eye(3, dtype=gains.covariance.dtype).expand(3, 3, 3)
        isotropic = dataclasses.replace(
            gains,
            covariance=POSITION_FLOOR**2 * same,
            position_gain=torch.full_like(gains.position_gain, POSITION_RATE),
            force_gain=gains.force_gain.amax(-1, keepdim=True).expand(3, 3),
        )
        super().__init__(model, isotropic, belief)


class PositionClosing:
    """The paper's baseline: an isotropic PI position controller per fingertip that stops at `STOP_FORCE` (Table 7).

    It is tuned: of 48 lifts of uncertain grasps of four scanned objects none held when the fingers aimed at the planned
    contacts, where 28 ended before some finger touched, 14 when they aimed 5 mm behind them, 16 at 10 mm and 18 at
    `AIM_DEPTH`. When the squeeze follows, 44 to 45 hold with any. The integral helps (9 against 6 of 56 grasps).
    """

    def __init__(self, model: ControlModel, gains: ClosingGains) -> None:
        self.model = model
        self.aim = gains.target - AIM_DEPTH * model.normals
        self.target = model.pregrasp
        self.integral = torch.zeros_like(gains.target)
        self.stopped = torch.zeros(3, dtype=torch.bool)
        self.done = False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        model = self.model
        error = self.aim - (observation.tips - model.radius[:, None] * model.normals)
        arrived = torch.linalg.vector_norm(error, dim=-1) < STOP_DISTANCE
        self.stopped = self.stopped | arrived | (observation.reading >= STOP_FORCE)
        self.done = bool(self.stopped.all())
        self.integral = self.integral + period * error
        demand = POSITION_RATE * error + INTEGRAL_RATE * self.integral
        gain, free = torch.ones_like(demand), torch.zeros(3, dtype=demand.dtype)
        velocity = tip_velocity(demand, torch.zeros_like(demand), free, gain, gain)
        velocity = torch.where(self.stopped[:, None], 0.0, velocity)
        step = joint_step(observation.jacobian @ model.coupling, velocity, period)
        self.target = torch.minimum(torch.maximum(self.target + step, model.lower), model.upper)
        return model.expand(self.target)
