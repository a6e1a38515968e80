"""Closings to compare with: the paper's control law (Eqs. 25-28), its position controller, and the open loop."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.law import POSITION_RATE, blend, joint_step, tip_velocity
from torchgrasp.control.observation import STILL, Observation
from torchgrasp.control.reference import ClosingReference, next_target
from torchgrasp.control.tactile import NOISE

SETTLED = 0.1  # time [s] for which a closing's end must hold before the closing is done

POSE_TIME = 0.4  # time [s] from pre-grasp to grasp in open loop, and again from grasp to squeeze

STOP_FORCE = 0.5  # force [N] at which the position controller stops a finger (Sec. 6.5).


class PaperClosing:
    """The paper's control law as written, and what it needs to run: a damped inverse and limits of gain and speed.

    A target leads its joint by no more than the drive can exert. The closing ends when all fingers touch, each blend
    (Eq. 26) is at least 0.5, and the forces have been steady for `SETTLED` seconds.
    """

    palm = STILL

    def __init__(self, reference: ClosingReference) -> None:
        self.reference, self.target = reference, reference.pregrasp
        self.lead = strongest_lead(reference)
        self.share = torch.zeros_like(reference.normals[:, 0])
        self.settled = Settled(reference)

    @property
    def done(self) -> bool:
        """Whether the closing has ended."""
        return self.settled.time >= SETTLED

    def press(self) -> "PaperClosing":
        """Return the closing itself: it presses from the start."""
        return self

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        reference, gains, normals = self.reference, self.reference.gains, self.reference.normals
        error = gains.target - reference.contact_points(observation.tips)
        self.share = blend(error, gains.covariance)
        self.settled.update(observation, observation.tactile.contact, self.share, period)
        desired = -(gains.desired_force * normals).sum(-1)
        force_error = -(desired - observation.tactile.reading)[:, None] * normals
        velocity = tip_velocity(error, force_error, self.share, gains.position_gain, gains.force_gain, together=True)
        self.target = next_target(reference, self.target, velocity, observation, self.lead, period)
        return reference.expand(self.target)


class Settled:
    """The `time` [s] for which all fingers have touched, where they should be, with steady forces."""

    def __init__(self, reference: ClosingReference) -> None:
        self.time, self.steady = 0.0, torch.zeros_like(reference.normals[:, 0])

    def update(
        self,
        observation: Observation,
        touching: Bool[Tensor, "f"],
        share: Float[Tensor, "f"],
        period: float,
        pressing: bool = True,
    ) -> None:
        """Count a tick; without `pressing` the touches alone count."""
        average = observation.tactile.average
        settled = bool(touching.all())
        if pressing:
            settled = settled and bool((share >= 0.5).all() & ((average - self.steady).abs() < NOISE).all())
        self.time = self.time + period if settled else 0.0
        if not settled:
            self.steady = average


def strongest_lead(reference: ClosingReference) -> Float[Tensor, " h"]:
    """Return the lead [rad] of each actuated joint's target at which its drive exerts its largest torque."""
    hand = reference.hand
    effort = torch.tensor([hand.actuators[name].effort for name in hand.tree.joint_names], dtype=torch.float64)
    leads = (effort / reference.kp)[:, None] / hand.actuated.coupling.abs()  # infinite where nothing is driven
    return leads.amin(0)


class PositionClosing:
    """The paper's baseline (Table 7): a PI position controller per fingertip that stops at `STOP_FORCE`.

    It aims at a `depth` [m] behind the contacts. The paper's depth is 0: a finger may stop before it touches.
    """

    palm = STILL

    def __init__(self, reference: ClosingReference, depth: float = 0.02) -> None:
        self.reference = reference
        self.aim = reference.gains.target - depth * reference.normals
        self.target = reference.pregrasp
        self.integral = torch.zeros_like(self.aim)
        self.stopped = torch.zeros_like(self.aim[:, 0], dtype=torch.bool)
        self.done = False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        reference, stop_distance, integral_rate = self.reference, 1e-3, 2.0  # [m], [1/s^2]
        error = self.aim - reference.contact_points(observation.tips)
        arrived = torch.linalg.vector_norm(error, dim=-1) < stop_distance
        self.stopped = self.stopped | arrived | (observation.tactile.reading >= STOP_FORCE)
        self.done = bool(self.stopped.all())
        self.integral = self.integral + period * error
        demand = POSITION_RATE * error + integral_rate * self.integral
        gain, position_only = torch.ones_like(demand), torch.zeros_like(demand[:, 0])
        velocity = tip_velocity(demand, torch.zeros_like(demand), position_only, gain, gain)
        velocity = torch.where(self.stopped[:, None], 0.0, velocity)
        step = joint_step(observation.jacobian @ reference.hand.actuated.coupling, velocity, period)
        self.target = reference.clamp(self.target + step)
        return reference.expand(self.target)


class OpenLoopClosing:
    """Move from pre-grasp to grasp to squeeze and ignore all sensors."""

    palm = STILL

    def __init__(self, reference: ClosingReference) -> None:
        self.reference = reference
        poses = (reference.pregrasp, reference.joints, reference.squeeze)
        self.poses = torch.stack([reference.expand(pose) for pose in poses])
        self.time, self.done = 0.0, False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        progress = min(self.time / POSE_TIME, 2.0)
        self.done = self.time >= 2 * POSE_TIME - 0.5 * period
        first = min(int(progress), 1)
        return torch.lerp(self.poses[first], self.poses[first + 1], progress - first)
