"""How a closed hand presses: with balanced forces at the contacts that were really made."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.observation import ControlModel, Observation
from torchgrasp.plan.internal_forces import least_friction_forces
from torchgrasp.values import ClosingGains

RAMP = 0.4
"""Time [s] in which the squeeze rises to the desired forces."""


class ForceHold:
    """Hold what is grasped: joints stay compliant about where they are and press with balanced forces, J^T f / kp.

    The forces rise together and are balanced anew for the contacts that were really made. One common factor keeps
    their sum at what was asked for. A force loop of its own for each finger would drift: the surplus of three slightly
    unbalanced integrators pushes the object along.
    """

    def __init__(
        self, model: ControlModel, gains: ClosingGains, observation: Observation, start: Float[Tensor, " j"]
    ) -> None:
        self.model, self.start, self.still = model, start, observation.joints
        forces, self.strength = held_forces(model, gains, observation)
        self.lead = torch.einsum("cij,ci->j", observation.jacobian, forces) / model.kp
        self.factor, self.time = 1.0, 0.0

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        share = min(self.time / RAMP, 1.0)
        if share == 1.0:
            lacking = 1 - float(observation.reading.sum()) / self.strength
            self.factor = min(max(self.factor + period * lacking, 0.5), 1.5)
        return self.start + share * (self.still + self.factor * self.lead - self.start)


class PositionHold:
    """Keep the joints' targets where closing left them: a hand that stops at a force lifts with that force."""

    def __init__(
        self, model: ControlModel, gains: ClosingGains, observation: Observation, start: Float[Tensor, " j"]
    ) -> None:
        self.start = start

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        return self.start


def held_forces(
    model: ControlModel, gains: ClosingGains, observation: Observation
) -> tuple[Float[Tensor, "3 3"], float]:
    """Return forces on the object [N] that are balanced for the contacts that were really made, and their normal sum.

    The planned forces are kept unless all three fingers touch and some balanced set presses at their contacts.
    """
    forces, normals = gains.desired_force, model.normals
    if bool(torch.isfinite(observation.points).all()) and bool(torch.isfinite(observation.normals).all()):
        push = -(forces * normals).sum(-1)
        wish = push[None] if gains.force_source == "learned" else None
        balanced = least_friction_forces(observation.points[None], observation.normals[None], float(push.max()), wish)[
            0
        ]
        if bool(torch.isfinite(balanced).all()):
            forces, normals = balanced, observation.normals
    return forces, float(-(forces * normals).sum())
