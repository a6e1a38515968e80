"""Three point fingers that slide along x, y and z around a pinched block: what tests of the controllers start from."""

import dataclasses

import torch

from torchgrasp.closure import ClosingGains
from torchgrasp.control import ClosingReference, Observation, no_contact
from torchgrasp.control.law import surface_covariance
from torchgrasp.hand.fingers import ActuatedJoints
from torchgrasp.hand.load import load_hand

PERIOD = 0.01
FREE, TOUCHING = torch.zeros(3, dtype=torch.bool), torch.ones(3, dtype=torch.bool)


def real(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


NORMALS = real([[1, 0, 0], [1, 0, 0], [-1, 0, 0]])
TARGET = real([[0.03, 0, 0.02], [0.03, 0, -0.02], [-0.03, 0, 0]])
GAINS = ClosingGains(
    target=TARGET,
    covariance=surface_covariance(NORMALS, torch.full((3,), 0.004).double()),
    position_gain=torch.full((3, 3), 4.0).double(),
    force_gain=torch.full((3, 3), 0.01).double(),
    desired_force=-NORMALS * real([[2.0], [2.0], [4.0]]),
)


def reference(coupling: torch.Tensor | None = None) -> ClosingReference:
    """Joint 3 i + k moves finger i along axis k; a shipped hand lends what the controllers do not read."""
    coupling = torch.eye(9).double() if coupling is None else coupling
    h = coupling.shape[1]
    ones, zero, names = torch.ones(h).double(), torch.zeros(h).double(), tuple(f"slide_{k}" for k in range(9))
    hand = load_hand("barrett")
    hand = dataclasses.replace(
        hand,
        actuators=dict.fromkeys(names, next(iter(hand.actuators.values()))),
        actuated=ActuatedJoints(names[:h], -ones, ones, coupling, torch.zeros(9).double()),
        tree=dataclasses.replace(hand.tree, joint_names=names),
        tips=dataclasses.replace(hand.tips, radius=real([0.01, 0.01, 0.01])),
    )
    return ClosingReference(
        hand=hand,
        kp=torch.full((9,), 2.0).double(),
        obj_from_hand=torch.eye(4).double(),
        pregrasp=zero,
        joints=zero,
        squeeze=zero + 0.02,
        normals=NORMALS,
        gains=GAINS,
    )


def observation(off: float = 0.02, reading=(0.0, 0.0, 0.0), contact=FREE, joints=None) -> Observation:
    """Tips `off` metres away from their contacts along the normals; sensed contacts are the planned ones."""
    touched = contact[:, None]
    tactile = dataclasses.replace(
        no_contact(),
        reading=real(reading),
        forces=-real(reading)[:, None] * NORMALS,
        contact=contact,
        points=torch.where(touched, TARGET, torch.nan),
        normals=torch.where(touched, NORMALS, torch.nan),
    )
    joints = torch.zeros(9).double() if joints is None else joints
    return Observation(joints, TARGET + (0.01 + off) * NORMALS, torch.eye(9).double().reshape(3, 3, 9), tactile)
