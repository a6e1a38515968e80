"""Controllers of a trial: closing under the law (Eq. 25), the paper's position baseline, and the squeeze that lifts.

Each turns what a robot would know at a tick (`Sight`: encoders and tactile fingertips) into joint targets.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.close.force import balanced_forces
from torchgrasp.close.law import POSITION_RATE, blend, joint_step, tip_velocity
from torchgrasp.values import ClosingGains

WAITING_FORCE = 0.3
"""Force [N] with which a finger that touches waits for the others: less than the table's friction on a light object."""

PATIENCE = 1.5
"""Time [s] for which the first finger waits for the last before the hand presses with those that touch."""

SETTLED = 0.1
"""Time [s] for which all fingers must feel contact before the hand presses."""

RAMP = 0.4
"""Time [s] in which the squeeze rises to the desired forces."""

STOP_FORCE = 0.5
"""Force [N] at which a finger of the position baseline stops (Sec. 6.5)."""

STOP_DISTANCE = 1e-3
"""Distance [m] from its target at which a finger of the position baseline stops."""

INTEGRAL_RATE = 2.0
"""Integral gain [1/s^2] of the position baseline."""

LEAD = 0.04
"""Largest lead [rad] of a joint's target over the joint while closing: a link that meets the object unfelt, elsewhere
than at the fingertip, presses with no more than kp times this."""


@dataclasses.dataclass(frozen=True)
class Plant(Value):
    """What the controllers know of the hand: every joint of the URDF is `coupling @ actuated + offset`.

    `actuated` picks the actuated joints out of all; `kp` [N m/rad] belongs to all; `lower` and `upper` [rad] are the
    limits of the actuated ones; `radius` [m] of the round fingertips (0: the contact point itself is the tip);
    `normals` are the planned outward contact normals in the hand's frame; `joints` and `pregrasp` the planned posture
    and the opened one [rad].
    """

    coupling: Float[Tensor, "j h"]
    offset: Float[Tensor, " j"]
    actuated: tuple[int, ...]
    kp: Float[Tensor, " j"]
    lower: Float[Tensor, " h"]
    upper: Float[Tensor, " h"]
    radius: Float[Tensor, "3"]
    normals: Float[Tensor, "3 3"]
    joints: Float[Tensor, " h"]
    pregrasp: Float[Tensor, " h"]

    def expand(self, actuated: Float[Tensor, " h"]) -> Float[Tensor, " j"]:
        """Return all joints of the URDF."""
        return self.coupling @ actuated + self.offset


@dataclasses.dataclass(frozen=True)
class Sight(Value):
    """What a robot knows at a tick, in the hand's frame: all joints, fingertip centres and Jacobian, touch.

    `points` [m] and outward `normals` are the sensed contacts, NaN where nothing touches. They are the simulator's own,
    without the noise that a real fingertip has (1 to 2 mm).
    """

    joints: Float[Tensor, " j"]
    tips: Float[Tensor, "3 3"]
    jacobian: Float[Tensor, "3 3 j"]
    reading: Float[Tensor, "3"]
    contact: Bool[Tensor, "3"]
    points: Float[Tensor, "3 3"]
    normals: Float[Tensor, "3 3"]


class Closing:
    """The uncertainty-aware controller (Eqs. 25-28), with fingers that wait for each other.

    A finger in the air searches for its desired force. One that feels contact is force-controlled whatever its
    position error (its blend is 1): a calibrated shape is still wrong now and then, and Eq. (26) would press on
    towards the planned point. It waits with `WAITING_FORCE`, so that the object stays where it is, until all touch or
    `PATIENCE` is over. The full forces are left to `Squeeze`: raised by three separate loops they would not balance on
    the way, and a cylinder of 0.1 kg moves by 8 mm instead of 4 mm.
    """

    def __init__(self, plant: Plant, gains: ClosingGains) -> None:
        self.plant, self.gains = plant, gains
        self.target = plant.pregrasp
        self.waiting = self.settled = 0.0
        self.done = False
        self.strength = -(gains.desired_force * plant.normals).sum(-1)

    def __call__(self, sight: Sight, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        plant, gains = self.plant, self.gains
        self.waiting = self.waiting + period if bool(sight.contact.any()) else 0.0
        self.settled = self.settled + period if bool(sight.contact.all()) else 0.0
        self.done = self.settled >= SETTLED or self.waiting >= PATIENCE
        wished = torch.where(sight.contact, WAITING_FORCE, self.strength)
        error = gains.target - (sight.tips - plant.radius[:, None] * plant.normals)
        share = torch.where(sight.contact, 1.0, blend(error, gains.covariance))
        force_error = -(wished - sight.reading)[:, None] * plant.normals
        velocity = tip_velocity(error, force_error, share, gains.position_gain, gains.force_gain)
        step = joint_step(sight.jacobian @ plant.coupling, velocity, period, plant.joints - self.target)
        actuated = sight.joints[list(plant.actuated)]
        target = torch.minimum(torch.maximum(self.target + step, actuated - LEAD), actuated + LEAD)
        self.target = torch.minimum(torch.maximum(target, plant.lower), plant.upper)
        return plant.expand(self.target)


class Stopping:
    """The paper's baseline: an isotropic PI position controller per fingertip that stops at `STOP_FORCE` (Table 7)."""

    def __init__(self, plant: Plant, gains: ClosingGains) -> None:
        self.plant, self.gains = plant, gains
        self.target = plant.pregrasp
        self.integral = torch.zeros_like(gains.target)
        self.stopped = torch.zeros(3, dtype=torch.bool)
        self.done = False

    def __call__(self, sight: Sight, period: float) -> Float[Tensor, " j"]:
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

    The forces rise together and are balanced anew for the contacts that were really made. One common factor keeps
    their sum at what was asked for. A force loop of its own for each finger would drift: the surplus of three slightly
    unbalanced integrators pushes the object along.
    """

    def __init__(self, plant: Plant, gains: ClosingGains, sight: Sight, start: Float[Tensor, " j"]) -> None:
        self.plant, self.start, self.still = plant, start, sight.joints
        forces, self.strength = held_forces(plant, gains, sight)
        self.lead = torch.einsum("cij,ci->j", sight.jacobian, forces) / plant.kp
        self.factor, self.time = 1.0, 0.0

    def __call__(self, sight: Sight, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        share = min(self.time / RAMP, 1.0)
        if share == 1.0:
            lacking = 1 - float(sight.reading.sum()) / self.strength
            self.factor = min(max(self.factor + period * lacking, 0.5), 1.5)
        return self.start + share * (self.still + self.factor * self.lead - self.start)


def held_forces(plant: Plant, gains: ClosingGains, sight: Sight) -> tuple[Float[Tensor, "3 3"], float]:
    """Return forces on the object [N] that are balanced for the contacts that were really made, and their normal sum.

    The planned forces are kept unless all three fingers touch and some balanced set presses at their contacts.
    """
    forces, normals = gains.desired_force, plant.normals
    if bool(torch.isfinite(sight.points).all()) and bool(torch.isfinite(sight.normals).all()):
        strongest = float((-(forces * normals).sum(-1)).max())
        balanced = balanced_forces(sight.points[None], sight.normals[None], strongest)[0]
        if bool(torch.isfinite(balanced).all()):
            forces, normals = balanced, sight.normals
    return forces, float(-(forces * normals).sum())
