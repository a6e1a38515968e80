"""The drives of a hand's joints: stiffness and torque of each, and with the joints coupled to it."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.hand import Actuator, Hand


def stiff_drives(hand: Hand, kp: float | None) -> dict[str, Actuator]:
    """Return the drive of each joint by its name; `kp` [N m/rad], if given, replaces the stiffness
    of all.
    """
    if kp is None:
        return hand.actuators
    return {name: drive._replace(kp=kp) for name, drive in hand.actuators.items()}


def drive_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, " j"]:
    """Return the drive stiffness [N m/rad] of each joint of the URDF: `kp` if given, else the
    hand's own.
    """
    drives = stiff_drives(hand, kp)
    kps = [drives[name].kp for name in hand.tree.joint_names]
    return torch.tensor(kps, dtype=torch.float64, device="cpu")


def drive_efforts(hand: Hand) -> Float[Tensor, " j"]:
    """Return the largest torque [N m] of the drive of each joint of the URDF."""
    efforts = [hand.actuators[name].effort for name in hand.tree.joint_names]
    return torch.tensor(efforts, dtype=torch.float64, device="cpu")


def joint_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, "h"]:
    """Return the stiffness [N m/rad] of each actuated joint, together with the joints coupled to
    it.

    `kp` [N m/rad], if given, replaces the stiffness of every drive.
    """
    return coupled_stiffness(hand, drive_stiffness(hand, kp))


def coupled_stiffness(hand: Hand, drives: Float[Tensor, " j"]) -> Float[Tensor, "h"]:
    """Return the stiffness [N m/rad] of each actuated joint, together with the joints coupled to
    it.

    `drives` [N m/rad] are the stiffnesses of the drives of all joints of the URDF.
    """
    coupling = hand.actuated.coupling
    return (coupling**2 * drives.to(coupling)[:, None]).sum(0)
