"""Stiffness of position-controlled joints, and compliance of fingertips."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.hand import Hand


def drive_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, " j"]:
    """Return the stiffness [N m/rad] of every joint of the URDF; `kp` None: its own."""
    kps = [hand.actuators[name].kp if kp is None else kp for name in hand.tree.joint_names]
    return torch.tensor(kps, dtype=torch.float64)


def actuated_stiffness(coupling: Float[Tensor, "j h"], kp: Float[Tensor, " j"]) -> Float[Tensor, "h"]:
    """Return the stiffness [N m/rad] of each actuated joint, coupled joints included.

    >>> actuated_stiffness(torch.tensor([[1.0], [0.5]]), torch.tensor([4.0, 4.0]))
    tensor([5.])
    """
    return (coupling**2 * kp[:, None]).sum(0)


def joint_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, "h"]:
    """Return a hand's `actuated_stiffness`, all drives with `kp` [N m/rad]; None: its own."""
    coupling = hand.actuated.coupling
    return actuated_stiffness(coupling, drive_stiffness(hand, kp).to(coupling))


def tip_compliance(
    jacobian: Float[Tensor, "*b f 3 h"], normals: Float[Tensor, "*b f 3"], stiffness: Float[Tensor, "h"]
) -> Float[Tensor, "*b f"]:
    """Return the compliance [m/N] of each fingertip along its normal, by joint stiffness [N m/rad]."""
    along = torch.einsum("...cih,...ci->...ch", jacobian, normals)
    return (along**2 / stiffness).sum(-1)
