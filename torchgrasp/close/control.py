"""Controllers of a trial: closing under the law (Eq. 25), the paper's position baseline, and the squeeze that lifts.

Each turns what a robot would know at a tick (`Sight`: encoders and tactile fingertips) into joint targets.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.close.force import balanced_forces
from torchgrasp.close.law import POSITION_RATE, blend, joint_step, tip_velocity
from torchgrasp.values import ClosingGains, Value

WAITING_FORCE = 0.3
"""Force [N] with which a finger that touches waits for the others: less than the table's friction on a light object."""

PATIENCE = 1.5
"""Time [s] for which the first finger waits for the last before the hand presses with those that touch."""

RAMP = 0.4
"""Time [s] in which the forces rise from `WAITING_FORCE` to the desired ones."""

SETTLED = 0.1
"""Time [s] for which the forces must stay near the desired ones to count as settled; three times it is the limit."""

STOP_FORCE = 0.5
"""Force [N] at which a finger of the position baseline stops (Sec. 6.5)."""

STOP_DISTANCE = 1e-3
"""Distance [m] from its target at which a finger of the position baseline stops."""

INTEGRAL_RATE = 2.0
"""Integral gain [1/s^2] of the position baseline."""

LEAD = 0.05
"""Lead [rad] of a joint's target over the joint that is always allowed; more only for the torque of the force."""


@dataclasses.dataclass(frozen=True)
class Plant(Value):
    """What the controllers know of the hand: every joint of the URDF is `coupling @ actuated + offset`.

    `actuated` picks the actuated joints out of all; `kp` [N m/rad] belongs to all; `lower` and `upper` [rad] are the
    limits of the actuated ones; `radius` [m] of the round fingertips (0: the contact point itself is the tip);
    `normals` are the planned outward contact normals in the hand's frame.
    """

    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, "j"]
    actuated: tuple[int, ...]
    kp: Float[Tensor, "j"]
    lower: Float[Tensor, "h"]
    upper: Float[Tensor, "h"]
    radius: Float[Tensor, "3"]
    normals: Float[Tensor, "3 3"]
    joints: Float[Tensor, "h"]
    pregrasp: Float[Tensor, "h"]

    def expand(self, actuated: Float[Tensor, "h"]) -> Float[Tensor, "j"]:
        """Return all joints of the URDF."""
        return self.coupling @ actuated + self.offset


@dataclasses.dataclass(frozen=True)
class Sight(Value):
    """What a robot knows at a tick, in the hand's frame: all joints, fingertip centres and Jacobian, touch.

    `points` [m] and outward `normals` are the sensed contacts, NaN where nothing touches.
    """

    joints: Float[Tensor, "j"]
    tips: Float[Tensor, "3 3"]
    jacobian: Float[Tensor, "3 3 j"]
    reading: Float[Tensor, "3"]
    contact: Bool[Tensor, "3"]
    points: Float[Tensor, "3 3"]
    normals: Float[Tensor, "3 3"]


class Closing:
    """The uncertainty-aware controller (Eqs. 25-28), with fingers that wait for each other.

    A finger that feels contact is force-controlled whatever its position error (its blend is 1): a calibrated shape is
    still wrong now and then, and Eq. (26) would press on towards the planned point. It waits with `WAITING_FORCE`
    until all touch, or `PATIENCE` is over; then the forces rise together.
    """

    def __init__(self, plant: Plant, gains: ClosingGains) -> None:
        self.plant, self.gains = plant, gains
        self.target = plant.pregrasp
        self.pressing = self.waiting = self.settled = 0.0
        self.done = False
        self.strength = -(gains.desired_force * plant.normals).sum(-1)

    def __call__(self, sight: Sight, period: float) -> Float[Tensor, "j"]:
        """Return the targets of all joints for the next tick."""
        plant, gains = self.plant, self.gains
        wished = self._wished(sight, period)
        error = gains.target - (sight.tips - plant.radius[:, None] * plant.normals)
        share = torch.where(sight.contact, 1.0, blend(error, gains.covariance))
        force_error = -(wished - sight.reading)[:, None] * plant.normals
        velocity = tip_velocity(error, force_error, share, gains.position_gain, gains.force_gain)
        jacobian = sight.jacobian @ plant.coupling
        actuated = sight.joints[list(plant.actuated)]
        step = joint_step(jacobian, velocity, period, plant.joints - self.target)
        lead = LEAD + 1.5 * joint_torque(jacobian, self.strength[:, None] * plant.normals).abs() / self._kp()
        target = torch.minimum(torch.maximum(self.target + step, actuated - lead), actuated + lead)
        self.target = torch.minimum(torch.maximum(target, plant.lower), plant.upper)
        return plant.expand(self.target)

    def _kp(self) -> Float[Tensor, "h"]:
        """Return the stiffness that each actuated coordinate feels, its coupled joints included."""
        return (self.plant.coupling**2 * self.plant.kp[:, None]).sum(0)

    def _wished(self, sight: Sight, period: float) -> Float[Tensor, "3"]:
        """Return the normal force that each finger should exert now [N], and advance the phases."""
        if self.pressing == 0.0:
            self.waiting = self.waiting + period if bool(sight.contact.any()) else 0.0
            if not bool(sight.contact.all()) and self.waiting < PATIENCE:
                return torch.where(sight.contact, WAITING_FORCE, self.strength)
        self.pressing += period
        share = min(self.pressing / RAMP, 1.0)
        if share == 1.0:
            near = (sight.reading - self.strength).abs() < 0.15 * self.strength.max()
            self.settled = self.settled + period if bool((near | ~sight.contact).all()) else 0.0
            self.done = self.settled >= SETTLED or self.pressing >= RAMP + 3 * SETTLED
        return WAITING_FORCE + share * (self.strength - WAITING_FORCE)


class Stopping:
    """The paper's baseline: an isotropic PI position controller per fingertip that stops at `STOP_FORCE` (Table 7)."""

    def __init__(self, plant: Plant, gains: ClosingGains) -> None:
        self.plant, self.gains = plant, gains
        self.target = plant.pregrasp
        self.integral = torch.zeros_like(gains.target)
        self.stopped = torch.zeros(3, dtype=torch.bool)
        self.done = False

    def __call__(self, sight: Sight, period: float) -> Float[Tensor, "j"]:
        """Return the targets of all joints for the next tick."""
        plant = self.plant
        error = self.gains.target - (sight.tips - plant.radius[:, None] * plant.normals)
        arrived = torch.linalg.vector_norm(error, dim=-1) < STOP_DISTANCE
        self.stopped = self.stopped | arrived | (sight.reading >= STOP_FORCE)
        self.done = bool(self.stopped.all())
        self.integral = self.integral + period * error
        demand = POSITION_RATE * error + INTEGRAL_RATE * self.integral
        gain, free = torch.ones_like(demand), torch.zeros(3, dtype=demand.dtype)
        velocity = tip_velocity(demand, torch.zeros_like(demand), free, gain, gain)
        velocity = torch.where(self.stopped[:, None], 0.0, velocity)
        step = joint_step(sight.jacobian @ plant.coupling, velocity, period)
        self.target = torch.minimum(torch.maximum(self.target + step, plant.lower), plant.upper)
        return plant.expand(self.target)


class Squeeze:
    """Hold what is grasped: joints stay compliant about where they are and press with balanced forces, J^T f / kp.

    The forces are balanced anew for the contacts that were really made, and one common factor keeps their sum at what
    was asked for. A force loop of its own for each finger would drift: the surplus of three slightly unbalanced
    integrators pushes the object along.
    """

    def __init__(self, plant: Plant, gains: ClosingGains, sight: Sight, start: Float[Tensor, "j"]) -> None:
        self.plant, self.start, self.still = plant, start, sight.joints
        self.forces = held_forces(plant, gains, sight)
        self.lead = joint_torque(sight.jacobian, self.forces) / plant.kp
        self.strength = torch.linalg.vector_norm(self.forces, dim=-1).sum()
        self.factor, self.time = 1.0, 0.0

    def __call__(self, sight: Sight, period: float) -> Float[Tensor, "j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        share = min(self.time / RAMP, 1.0)
        if share == 1.0:
            lacking = float(1 - sight.reading.sum() / self.strength)
            self.factor = min(max(self.factor + period * lacking, 0.5), 1.5)
        return self.start + share * (self.still + self.factor * self.lead - self.start)


def joint_torque(jacobian: Float[Tensor, "3 3 k"], forces: Float[Tensor, "3 3"]) -> Float[Tensor, "k"]:
    """Return J^T f [N m], summed over the fingertips."""
    return torch.einsum("cik,ci->k", jacobian, forces)


def held_forces(plant: Plant, gains: ClosingGains, sight: Sight) -> Float[Tensor, "3 3"]:
    """Return forces on the object [N] that are balanced for the contacts that were really made.

    Two contacts press along the line between them. Where no balance exists the planned forces are kept, for the
    fingers that touch.
    """
    strongest = float(torch.linalg.vector_norm(gains.desired_force, dim=-1).max())
    touching = torch.isfinite(sight.points).all(-1) & torch.isfinite(sight.normals).all(-1)
    forces = torch.where(touching[:, None], gains.desired_force, 0.0)
    if bool(touching.all()):
        balanced = balanced_forces(sight.points[None], sight.normals[None], strongest)[0]
        if bool(torch.isfinite(balanced).all()):
            return balanced
    elif int(touching.sum()) == 2:
        first, second = torch.nonzero(touching)[:, 0].tolist()
        line = sight.points[second] - sight.points[first]
        line = strongest * line / torch.linalg.vector_norm(line)
        if float(line @ sight.normals[first]) < 0 < float(line @ sight.normals[second]):
            forces = forces.clone()
            forces[first], forces[second] = line, -line
    return forces
