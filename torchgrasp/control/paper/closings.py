"""Baseline closing controllers (the paper's law, Eqs. 25-28, position control, open loop), and an
impedance hold.
"""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import grasp_map, internal_forces
from torchgrasp.control.holding import RAMP, held_forces, regulate
from torchgrasp.control.law import (
    MAX_SPEED,
    POSITION_RATE,
    blend,
    damped_inverse,
    joint_step,
    tip_velocity,
)
from torchgrasp.control.paper.stability import StabilityModel, lengths_of, state_of
from torchgrasp.control.protocol import POSE_TIME, SETTLED, Settled, strongest_lead
from torchgrasp.control.reference import ClosingReference, next_target
from torchgrasp.control.tactile import STILL, Observation, smooth
from torchgrasp.foundation.checks import checked
from torchgrasp.geometry.frames import degenerate, rigid, virtual_frame
from torchgrasp.geometry.linalg import dot, limit_norm, matvec, norm
from torchgrasp.hand.drives import coupled_stiffness

STOP_FORCE = 0.5  # force [N] at which the position controller stops a finger (Sec. 6.5).
# stiffness of the virtual frame [N/m, N m/rad]
TRANSLATION_STIFFNESS = 1200.0
ROTATION_STIFFNESS = 4.0
GRASP_STIFFNESS = 100.0  # stiffness [N/m] of the spring along each side of the fingertips' triangle


@dataclasses.dataclass(frozen=True)
class PositionNumbers:
    """Parameters of `PositionClosing`, a baseline whose gains the paper does not print."""

    depth: float = 0.02
    """Distance [m] of a fingertip's goal behind the planned contact, inside the object."""
    arrived: float = 1e-3
    """Distance [m] from the goal at which a finger stops."""
    integral: float = 2.0
    """Integral gain [1/s^2] on the position error."""


@dataclasses.dataclass(frozen=True)
class UnstableNumbers:
    """Parameters of the response of `Impedance` to an unstable grasp."""

    odds: float = 3.0
    """Odds p / (1 - p) of stability above which a grasp counts as stable."""
    cutoff: float = 2.0
    """Cut-off frequency [Hz] of the low-pass filter of the readings that are judged."""
    wait: float = 0.3
    """Delay [s] from the end of the forces' rise until the low-passed readings are judged."""
    raised: float = 2.0
    """Factor by which the forces of an unstable grasp grow in the end."""
    rate: float = 8.0
    """Rate [1/s] at which forces and stiffness approach their new values."""


POSITION = PositionNumbers()
UNSTABLE = UnstableNumbers()


class PaperClosing:
    """The paper's control law, Eqs. (25)-(28): position control far from the contacts, force
    control near them.

    It is d theta = J^-1 [(1 - lambda) K_P (x_d - x_c) + lambda C_F (f_d - f_c)]. Here theta are the
    joints, and J is the fingertips' Jacobian. The letters x and f are positions and forces of the
    fingertips, desired (d) and sensed (c). The gains K_P and C_F are those of
    `ClosingReference.as_printed`. A damped inverse replaces J^-1; speed is bounded. No joint target
    is so far ahead of its joint that the drive would exceed its torque limit. The closing ends when
    all fingers touch, and two conditions hold. The share of force control (lambda, Eq. 26) is at
    least 0.5 in each finger. The forces have been steady for 0.1 s (`SETTLED`).
    """

    palm = STILL  # displacement (3,) [m] of the palm from its planned pose: none
    feels = True  # sensor readings change the targets

    def __init__(self, reference: ClosingReference) -> None:
        self.reference = reference.as_printed()
        self.target = reference.pregrasp
        self.lead = strongest_lead(reference)
        self.share = torch.zeros_like(reference.normals[:, 0])
        self.settled = Settled(reference)

    @property
    def done(self) -> bool:
        """Whether the closing has ended."""
        return self.settled.time >= SETTLED

    def press(self) -> "PaperClosing":
        """Return the closing controller itself: the paper's law presses from the start."""
        return self

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        reference = self.reference
        gains = reference.gains
        normals = reference.normals
        error = gains.target - reference.contact_points(observation.tips)
        self.share = blend(error, gains.covariance)
        self.settled.update(observation, observation.tactile.contact, self.share, period)
        desired = -dot(gains.desired_force, normals)
        force_error = -(desired - observation.tactile.reading)[:, None] * normals
        velocity = tip_velocity(
            error, force_error, self.share, gains.position_gain, gains.force_gain, together=True
        )
        self.target = next_target(reference, self.target, velocity, observation, self.lead, period)
        return reference.expand(self.target)


class PositionClosing:
    """The paper's baseline (Table 7): a PI position controller for each fingertip. It stops a
    finger at a force of 0.5 N (`STOP_FORCE`).

    The goal is `depth` [m] behind the planned contact, inside the object. With the paper's depth of
    0 a finger may stop before it touches. A finger also stops within 1 mm of its goal, and `done`
    is true when all have stopped.
    """

    palm = STILL  # displacement (3,) [m] of the palm from its planned pose: none
    feels = True  # sensor readings change the targets

    def __init__(self, reference: ClosingReference, depth: float = POSITION.depth) -> None:
        self.reference = reference
        self.aim = reference.gains.target - depth * reference.normals
        self.target = reference.pregrasp
        self.integral = torch.zeros_like(self.aim)
        self.stopped = torch.zeros_like(self.aim[:, 0], dtype=torch.bool)
        self.done = False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        reference = self.reference
        error = self.aim - reference.contact_points(observation.tips)
        arrived = norm(error) < POSITION.arrived
        self.stopped = self.stopped | arrived | (observation.tactile.reading >= STOP_FORCE)
        self.done = bool(self.stopped.all())
        self.integral = self.integral + period * error
        demand = POSITION_RATE * error + POSITION.integral * self.integral
        velocity = torch.where(self.stopped[:, None], 0.0, limit_norm(demand, MAX_SPEED))
        step = joint_step(observation.jacobian @ reference.hand.actuated.coupling, velocity, period)
        self.target = reference.clamp(self.target + step)
        return reference.expand(self.target)


class OpenLoopClosing:
    """Closing controller without sensors: the joints move from the pre-grasp to the grasp, then to
    the squeeze. The squeeze is joint targets beyond the grasp, with which the fingers press.
    """

    palm = STILL  # displacement (3,) [m] of the palm from its planned pose: none
    feels = False  # no sensor reading changes the targets

    def __init__(self, reference: ClosingReference) -> None:
        self.reference = reference
        poses = (reference.pregrasp, reference.joints, reference.squeeze)
        self.poses = torch.stack([reference.expand(pose) for pose in poses])
        self.time = 0.0
        self.done = False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        return self.advance(period)

    def advance(self, period: float) -> Float[Tensor, "*n j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later.

        j counts all joints of the URDF. The targets are (j,) for one hand. They are (n, j) if the
        attribute `poses` holds the postures (3, n, j) [rad] of n hands: pre-grasp, grasp and
        squeeze.
        """
        self.time += period
        progress = min(self.time / POSE_TIME, 2.0)
        self.done = self.time >= 2 * POSE_TIME - 0.5 * period
        first = min(int(progress), 1)
        return torch.lerp(self.poses[first], self.poses[first + 1], progress - first)


def restoring_wrench(
    hand_from_vf: Float[Tensor, "*b 4 4"], rest: Float[Tensor, "*b 4 4"]
) -> Float[Tensor, "*b 6"]:
    """Return the wrench (*b, 6) of a spring that pulls the frame of three fingertips back to its
    `rest` pose: force [N], then torque [N m].

    `hand_from_vf` [m] is the pose of the virtual frame of three fingertips. This frame has its
    origin at their centroid (Eq. 18 of the paper). Poses, force and torque are in the hand's frame.
    `*b` stands for any leading axes. The torque is about that centroid, and grows with the sine of
    the rotation error.
    """
    axes = hand_from_vf[..., :3, :3].mT
    desired = rest[..., :3, :3].mT
    error = 0.5 * torch.linalg.cross(axes, desired).sum(-2)
    force = TRANSLATION_STIFFNESS * (rest[..., :3, 3] - hand_from_vf[..., :3, 3])
    return torch.cat([force, ROTATION_STIFFNESS * error], -1)


def shared_forces(
    points: Float[Tensor, "*b 3 3"], wrench: Float[Tensor, "*b 6"], most: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 3 3"]:
    """Return the smallest fingertip forces [N] that exert a `wrench` [N, N m] about the centroid of
    the `points` [m].

    `points` are the contact points of three fingertips. Points, forces and wrench are in one frame.
    `*b` stands for any leading axes. All forces are scaled down by one factor if one would exceed
    `most` [N].
    """
    shared = matvec(torch.linalg.pinv(grasp_map(points)), wrench)
    forces = shared.unflatten(-1, (3, 3))
    largest = norm(forces).amax(-1)
    return forces * (most / torch.maximum(largest, most))[..., None, None]


def spring_forces(
    points: Float[Tensor, "*b 3 3"],
    lengths: Float[Tensor, "*b 3"],
    stiffness: Float[Tensor, "*b 3"],
) -> Float[Tensor, "*b 3 3"]:
    """Return the forces [N] that springs along the sides of their triangle exert on three
    fingertips.

    The forces are in the frame of `points` [m], the centres of the fingertips. `lengths` [m] are
    the rest lengths of the sides (0, 1), (1, 2) and (2, 0), and `stiffness` [N/m] is that of each
    spring. `*b` stands for any leading axes.
    """
    tension = stiffness * (side_lengths(points) - lengths)
    return torch.einsum("...k,...kci->...ci", tension, internal_forces(points))


def side_lengths(points: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the lengths (*b, 3) [m] of the sides of the triangle of three `points` [m].

    The sides are (0, 1), (1, 2) and (2, 0). `*b` stands for any leading axes.
    """
    return norm(points.roll(-1, dims=-2) - points)


class Impedance:
    """Hold controller with virtual springs that keep three fingertips together and in place
    (object-level impedance).

    The joint targets are q + J^T f / kp for fingertip forces f. At rest f are the desired forces,
    balanced at the sensed contacts. Joint motions that leave the fingertips at rest are suppressed.

    Args:
        reference: the closing plan.
        observation: the observation at the end of the closing.
        start: targets (j,) [rad] of all joints of the URDF at the end of the closing.
        springs: stiffness [N/m] of the springs along the sides of the triangle of fingertips; None
            means 100 N/m (`GRASP_STIFFNESS`).
        stability: model that judges the grasp; if it is unstable, forces and stiffness are raised
            and stay so. None means no judgement.
    """

    def __init__(
        self,
        reference: ClosingReference,
        observation: Observation,
        start: Float[Tensor, " j"],
        springs: Float[Tensor, "3"] | None = None,
        stability: StabilityModel | None = None,
    ) -> None:
        self.reference = reference
        self.stability = stability
        self.coupling = reference.hand.actuated.coupling
        if springs is None:
            springs = torch.full((3,), GRASP_STIFFNESS).to(observation.tips)
        self.springs = springs
        self.stiffness = coupled_stiffness(reference.hand, reference.kp)
        forces, self.strength = held_forces(reference, observation)
        self.frame = rigid(torch.eye(3).to(observation.tips), observation.tips.mean(0))
        self.rest = self._frame(observation.tips)
        self.lengths = side_lengths(observation.tips)
        self.desired = forces @ self.rest[:3, :3]  # in the virtual frame
        self.posture = self._actuated(observation.joints)
        self.lead = self._actuated(start) - self.posture
        self.factor = 1.0
        self.raised = 1.0
        self.time = 0.0
        self.reading = observation.tactile.reading

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        self.time += period
        share = min(self.time / RAMP, 1.0)
        self.reading = smooth(self.reading, observation.tactile.reading, UNSTABLE.cutoff, period)
        if share == 1.0:
            self.factor = regulate(self.factor, observation, self.raised * self.strength, period)
            self._adapt(observation, period)
        posture = self._actuated(observation.joints)
        jacobian = (observation.jacobian @ self.coupling).flatten(0, 1)
        lead = jacobian.T @ self.forces(observation.tips).flatten() / self.stiffness
        drift = self.posture - posture
        drift = drift - damped_inverse(jacobian) @ (jacobian @ drift)
        return self.reference.expand(posture + drift + self.lead + share * (lead - self.lead))

    def _adapt(self, observation: Observation, period: float) -> None:
        """If the grasp is unstable, raise its forces; move its stiffness to that of stable grasps
        as wide as it.
        """
        if self.stability is None or self.time < RAMP + UNSTABLE.wait:
            return
        state = state_of(self.springs, lengths_of(observation.tips), self.reading)
        if float(self.stability.log_odds(state)) > math.log(UNSTABLE.odds):
            return
        preferred = self.stability.preferred_forces(observation.tips)
        share = min(UNSTABLE.rate * period, 1.0)
        self.raised += share * (UNSTABLE.raised - self.raised)
        self.springs = self.springs * (preferred.springs / self.springs) ** share

    @checked
    def forces(self, tips: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
        """Return the desired forces (3, 3) [N] of the fingertips on the object, given their centres
        `tips` [m].

        They are the balanced forces, turned with the triangle of fingertips, plus those of the
        virtual springs. Forces and `tips` are in the hand's frame.
        """
        frame = self._frame(tips)
        desired = self.raised * self.factor * self.desired @ frame[:3, :3].T
        most = norm(desired).amax()  # the wrench lifts no finger
        springs = spring_forces(tips, self.lengths, self.springs)
        return desired + springs + shared_forces(tips, restoring_wrench(frame, self.rest), most)

    def _frame(self, tips: Float[Tensor, "3 3"]) -> Float[Tensor, "4 4"]:
        """Return the frame of the triangle of fingertips [m], or the last valid frame if the tips
        are on a line.
        """
        if not degenerate(tips):
            self.frame = virtual_frame(tips)
        return self.frame

    def _actuated(self, joints: Float[Tensor, " j"]) -> Float[Tensor, " h"]:
        """Return the actuated joints [rad] that best explain the positions `joints` [rad] of all
        joints, weighted by stiffness.
        """
        weighted = self.coupling * self.reference.kp[:, None]
        return weighted.T @ (joints - self.reference.hand.actuated.offset) / self.stiffness
