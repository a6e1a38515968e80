"""The drives of a hand's joints: stiffness and torque of each, and with the joints coupled to it."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.hand import Actuator, Hand


def stiff_drives(hand: Hand, kp: float | None) -> dict[str, Actuator]:
    """Return the drive of each movable joint of the URDF by the joint's name, with the stiffness
    `kp`.

    `kp` [N m/rad, or N/m for sliding joints] replaces the stiffness of all drives. None keeps the
    hand's own.
    """
    if kp is None:
        return hand.actuators
    return {name: drive._replace(kp=kp) for name, drive in hand.actuators.items()}


def drive_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, " j"]:
    """Return the drive stiffness [N m/rad, or N/m for sliding joints] of each movable joint of the
    URDF.

    It is `kp` for all joints; None means the hand's own. The j joints are in the order of
    `Hand.tree.joint_names`.
    """
    drives = stiff_drives(hand, kp)
    kps = [drives[name].kp for name in hand.tree.joint_names]
    return torch.tensor(kps, dtype=torch.float64, device="cpu")


def drive_efforts(hand: Hand) -> Float[Tensor, " j"]:
    """Return the largest torque [N m] of the drive of each of the j movable joints of the URDF.

    They are in the order of `Hand.tree.joint_names`. For a sliding joint it is a force [N].
    """
    efforts = [hand.actuators[name].effort for name in hand.tree.joint_names]
    return torch.tensor(efforts, dtype=torch.float64, device="cpu")


def strongest_leads(hand: Hand, drives: Float[Tensor, " j"]) -> Float[Tensor, " h"]:
    """Return, for each of h actuated joints, the target minus position [rad] at which a drive that
    moves with it exerts its largest torque.

    `drives` (j,) [N m/rad] are the stiffnesses of the drives of all j movable joints of the URDF.
    """
    # infinite where nothing is driven: (j, h)
    leads = (drive_efforts(hand) / drives)[:, None] / hand.actuated.coupling.abs()
    return leads.amin(0)


def joint_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, "h"]:
    """Return the stiffness (h,) [N m/rad] of each of h actuated joints, together with the joints
    coupled to it.

    It is the sum of the stiffnesses of their drives, each times its squared coupling ratio. `kp` [N
    m/rad] replaces the stiffness of every drive; None means the hand's own. For sliding joints
    units are [N/m].
    """
    return coupled_stiffness(hand, drive_stiffness(hand, kp))


def coupled_stiffness(hand: Hand, drives: Float[Tensor, " j"]) -> Float[Tensor, "h"]:
    """Return the stiffness (h,) [N m/rad] of each of h actuated joints, together with the joints
    coupled to it.

    `drives` (j,) [N m/rad] are the stiffnesses of the drives of all j movable joints of the URDF.
    The result is the sum of those that move with the actuated joint, each times its squared
    coupling ratio. For sliding joints units are [N/m].
    """
    coupling = hand.actuated.coupling
    return (coupling**2 * drives.to(coupling)[:, None]).sum(0)
