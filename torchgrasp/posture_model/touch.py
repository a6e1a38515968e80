"""How a free posture may touch: its round fingertips roll, and the contacts must be able to hold something."""

import itertools
import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.geometry.linalg import fibonacci_sphere, unit
from torchgrasp.hand.hand import Hand
from torchgrasp.specs import ContactSpec

ROLL = math.radians(25)
"""Deviation [rad] of either tilt of a contact direction: of 1904 planned grasps half are tilted by more than 30."""
BALANCES = 200
"""Directions in the three-dimensional space of internal forces that are tried: 0.25 rad apart."""


def roll_contacts(
    hand: Hand, joints: Float[Tensor, "n h"], generator: np.random.Generator
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3 3"]]:
    """Return contact points [m] and outward normals of fingertips that touch beside the middle of their pads.

    Both tilts of a contact direction from the pad's axis are normal, of deviation `ROLL`, inside the pad's cone. The
    point of a round tip follows its direction. A flat tip touches with its contact point and only tilts.
    """
    points, axes = hand.fingertips(joints)
    cone, radius = hand.tips.cone.to(axes), hand.tips.radius.to(axes)
    share, turn = torch.from_numpy(generator.random((2, len(joints), 3))).to(axes)
    angle = ROLL * torch.sqrt(-2 * torch.log1p(-share * -torch.expm1(-0.5 * (cone / ROLL) ** 2)))  # Rayleigh's law
    beside = torch.zeros_like(axes).scatter(-1, axes.abs().argmin(-1, keepdim=True), 1.0)
    first = unit(torch.linalg.cross(axes, beside))
    second, turn = torch.linalg.cross(axes, first), 2 * math.pi * turn[..., None]
    tilt = torch.cos(turn) * first + torch.sin(turn) * second
    normals = torch.cos(angle)[..., None] * axes + torch.sin(angle)[..., None] * tilt
    return points + radius[:, None] * (normals - axes), normals


def can_close(points: Float[Tensor, "n f 3"], normals: Float[Tensor, "n f 3"]) -> Bool[Tensor, "n"]:
    """Tell which contacts balance forces inside the friction cones of `ContactSpec`, Eq. (13), with three of them.

    Balanced forces of three contacts run along the triangle's sides. A grid over them finds all but narrow closures.
    `normals` point out of the fingertips, into the object.
    """
    closed = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for three in itertools.combinations(range(points.shape[1]), 3):
        rows = torch.nonzero(~closed)[:, 0]
        closed[rows] = _close_triples(points[rows][:, three], normals[rows][:, three])
    return closed


def _close_triples(points: Float[Tensor, "n 3 3"], normals: Float[Tensor, "n 3 3"]) -> Bool[Tensor, "n"]:
    """Tell which triples balance forces."""
    spread = 1 + ContactSpec().friction ** 2
    t12, t13, t23 = fibonacci_sphere(BALANCES).to(points).T
    e12, e13, e23 = (unit(points[:, j] - points[:, i]) for i, j in ((0, 1), (0, 2), (1, 2)))
    closed = torch.ones(len(points), BALANCES, dtype=torch.bool, device=points.device)
    pulls = ((e12, e13, t12, t13), (-e12, e23, t12, t23), (-e13, -e23, t13, t23))
    for inward, (a, b, ta, tb) in zip(normals.unbind(1), pulls, strict=True):
        into = (a * inward).sum(-1)[:, None] * ta + (b * inward).sum(-1)[:, None] * tb
        squared = ta**2 + tb**2 + 2 * (a * b).sum(-1)[:, None] * (ta * tb)
        closed = closed & (into > 0) & (squared <= spread * into**2)
    return closed.any(1)
