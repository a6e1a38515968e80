"""How a closed hand presses: with balanced forces at the sensed contacts, or by keeping its joint targets."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.plan.forces import least_friction_forces

MAX_FACTOR = 1.5  # largest factor on the forces; it bounds the force if a sensor reads too little

RAMP = 0.4  # time [s] in which the forces rise to the desired forces


class ForceHold:
    """Press with forces that are balanced at the sensed contacts; the joints stay compliant.

    One common factor regulates the sum of the forces. A loop for each finger would drift and push the object.

    Args:
        reference: plan of the closing.
        observation: observation at the end of the closing.
        start: last targets of all joints [rad].
    """

    def __init__(self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]) -> None:
        self.start, self.rest = start, observation.joints
        forces, self.strength = held_forces(reference, observation)
        self.lead = torch.einsum("cij,ci->j", observation.jacobian, forces) / reference.kp
        largest = float(torch.linalg.vector_norm(forces, dim=-1).max())
        self.most = MAX_FACTOR if reference.max_force is None else min(MAX_FACTOR, reference.max_force / largest)
        self.factor, self.time = min(1.0, self.most), 0.0
        self.senses_force = reference.sensor.kind != "binary"

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        share = min(self.time / RAMP, 1.0)
        if share == 1.0 and self.senses_force:
            self.factor = min(regulate(self.factor, observation, self.strength, period), self.most)
        return self.start + share * (self.rest + self.factor * self.lead - self.start)


class PositionHold:
    """Keep the joint targets of the closing's end; arguments as for `ForceHold`."""

    def __init__(self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]) -> None:
        self.start = start

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        return self.start


def regulate(factor: float, observation: Observation, strength: float, period: float) -> float:
    """Return the common factor of the forces a tick later: the integral of the lacking share of `strength` [N]."""
    lacking = 1 - float(observation.tactile.reading.sum()) / strength
    return min(max(factor + period * lacking, 0.5), MAX_FACTOR)


def held_forces(reference: ClosingReference, observation: Observation) -> tuple[Float[Tensor, "f 3"], float]:
    """Return forces [N] that are balanced at the sensed contacts, and the sum [N] of the normal forces with a sensor.

    The planned forces are kept if a finger does not touch or no balanced forces press.
    """
    gains, normals = reference.gains, reference.normals
    forces = gains.desired_force
    sensed = observation.tactile
    if bool(torch.isfinite(sensed.points).all()) and bool(torch.isfinite(sensed.normals).all()):
        push = -(forces * normals).sum(-1)
        preferred = push[None] if gains.force_source == "stability" else None
        balanced = least_friction_forces(sensed.points[None], sensed.normals[None], float(push.max()), preferred)[0]
        if bool(torch.isfinite(balanced).all()):
            forces, normals = balanced, sensed.normals
    return forces, float(-((forces * normals).sum(-1) * reference.alive).sum())
