"""The clutch of Barrett's fingers: one whose inner link is stopped closes on with its outer link alone."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.observation import ControlModel


class Breakaway:
    """Lets go of an inner link once the torque at its joint exceeds a threshold, until the finger is opened again.

    One motor turns the inner link by q and, geared, the outer link by ratio x q against it. While the clutch holds the
    inner link back, all of the motor's further turn dq goes into the outer link, by (1 + ratio) dq. Coupled joints
    that turn as fast as their source are no such finger: they stay coupled.

    Args:
        plant: the hand.
        torque: at the inner joint [N m], by which its drive presses on what stops it.
    """

    def __init__(self, model: ControlModel, torque: float) -> None:
        ratio = model.coupling.clone()
        ratio[list(model.actuated)] = 0.0
        self.outer, motors = torch.nonzero((ratio > 0) & (ratio < 1), as_tuple=True)
        self.inner = torch.tensor(model.actuated)[motors]
        self.lead = torque / model.kp[self.inner]
        self.held = torch.full_like(self.lead, torch.inf)

    def __call__(self, targets: Float[Tensor, " j"], joints: Float[Tensor, " j"]) -> Float[Tensor, " j"]:
        """Return the targets [rad] that the motors really drive the joints to.

        Args:
            targets: of all joints, coupled.
            joints: where they are.
        """
        asked = targets[self.inner]
        self.held = torch.where(asked < self.held, torch.inf, self.held)
        stopped = asked - joints[self.inner] > self.lead
        self.held = torch.where(stopped & torch.isinf(self.held), asked, self.held)
        surplus = (asked - self.held).clamp_min(0.0)
        driven = targets.clone()
        driven[self.inner] -= surplus
        driven[self.outer] += surplus
        return driven
