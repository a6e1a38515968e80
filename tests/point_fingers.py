"""Three point fingers that slide along x, y and z around a pinched block: what tests of the
controllers start from.
"""

import dataclasses
from collections.abc import Iterator

import torch

from tests.make import real
from torchgrasp import ClosingReference, GraspController
from torchgrasp.control import Observation, Targets, TipContact, measure, no_contact
from torchgrasp.control.law import surface_covariance
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.fingers import ActuatedJoints
from torchgrasp.hand.load import load_hand
from torchgrasp.values.closing import ClosingGains

PERIOD = 0.01
FREE = torch.zeros(3, dtype=torch.bool)
TOUCHING = torch.ones(3, dtype=torch.bool)


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
    """Joint 3 i + k moves finger i along axis k; a shipped hand lends what the controllers do not
    read.
    """
    coupling = torch.eye(9).double() if coupling is None else coupling
    h = coupling.shape[1]
    ones = torch.ones(h).double()
    zero = torch.zeros(h).double()
    names = tuple(f"slide_{k}" for k in range(9))
    hand = load_hand("barrett")
    spheres = hand.collision_spheres
    hand = dataclasses.replace(
        hand,
        actuators=dict.fromkeys(names, next(iter(hand.actuators.values()))),
        actuated=ActuatedJoints(names[:h], -ones, ones, coupling, torch.zeros(9).double()),
        tree=dataclasses.replace(hand.tree, joint_names=names),
        tips=dataclasses.replace(hand.tips, radius=real([0.01, 0.01, 0.01])),
        collision_spheres=dataclasses.replace(spheres, center=spheres.center + 10.0),  # far away
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
        distance_variance=torch.full((3,), 0.004**2).double(),
    )


def on_table(**changes) -> ClosingReference:
    """The reference of an object on a table whose normal is the hand's y axis."""
    return dataclasses.replace(reference(), **({"table": Plane(real([0, 1, 0]), -0.1)} | changes))


def close_on_block(
    controller: GraspController, seconds: float, off: float = 0.01, away: float = 0.0
) -> Iterator[tuple[Observation, Targets]]:
    """Close on a stiff block `away` [m] along x of its place; the joints follow and slide the tips
    from `off` [m].
    """
    joints = torch.zeros(9).double()
    palm = torch.zeros(3).double()
    tactile = no_contact()
    shift = real([away, 0, 0])
    for _ in range(round(seconds / PERIOD)):
        points = TARGET + off * NORMALS + joints.reshape(3, 3)
        push = 2e3 * -((points + palm - TARGET - shift) * NORMALS).sum(-1).clamp_max(
            0.0
        )  # of 2 kN/m
        contact = TipContact(push, -push[:, None] * NORMALS, points, NORMALS)
        tactile = measure(tactile, contact, NORMALS, real([0.01] * 3), PERIOD)
        seen = dataclasses.replace(
            observation(joints=joints), tips=points + 0.01 * NORMALS, tactile=tactile
        )
        targets = controller.step(seen, PERIOD)
        joints = targets.joints
        palm = targets.palm
        yield seen, targets


def observation(
    off: float = 0.02, reading=(0.0, 0.0, 0.0), contact=FREE, joints=None
) -> Observation:
    """Tips `off` metres away from their contacts along the normals; sensed contacts are the planned
    ones.
    """
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
    return Observation(
        joints, TARGET + (0.01 + off) * NORMALS, torch.eye(9).double().reshape(3, 3, 9), tactile
    )
