"""Tactile localization: where the object is, by what a closed hand touches and by the surface that it was planned on.

A fingertip that touches tells a point of the surface and the normal there; one in the air is outside of the surface.
The object is where these are likeliest, moved along its table and turned about the table's normal. `Placement` knows
tangent planes alone, which do not tell how far an object is off along its own surface.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import Part
from torchgrasp.geometry.frames import apply, rotation_from_vector
from torchgrasp.geometry.linalg import unit

FARTHEST, PITCH = 0.032, 0.004
"""Largest displacement along each axis [m] that is tried, and the distance between two: the surface's own error."""

TURNS, FINER = (-0.24, -0.12, 0.0, 0.12, 0.24), (-0.06, 0.0, 0.06)
"""Turns [rad] that are tried, and those around the best of them."""

FINEST = 0.001
"""Distance [m] between displacements around the best one: finer than the surface is known."""

SPREAD, TURN = 0.02, 0.15
"""Standard deviations of the displacement along each axis [m] and of the turn [rad]: nearly twice those of `Placement`,
since fingers that touched have pushed."""

SURFACE_STD, NORMAL_STD = 0.004, 0.3
"""Standard deviations of a touched point's distance from the estimated surface [m], and of each component of its
normal: 17 degrees, of the sensor and of the surface."""

GAP = 0.001
"""Least distance [m] between the surface and a fingertip in the air: a nearer one touches."""

NOWHERE = 1e9
"""Cost before anything was tried: more than that of any place, and finite, so that a state can be saved."""

WORST = 20.0
"""Most that one point or normal may speak against a place: a surface that is wrong there is no proof."""


class Touches(Part):
    """What the fingertips of a closed hand tell on average, in the hand's frame before its palm moved.

    `known` are fingertips that tell whether they touch, `felt` those that tell a place of their contact.
    """

    def __init__(self, reference: ClosingReference) -> None:
        self.points, self.normals = torch.zeros(2, *reference.normals.shape, dtype=torch.float64)
        self.count = torch.zeros(len(reference.normals), dtype=torch.float64)
        self.tips, self.known = reference.gains.target, reference.alive
        self.contact = torch.zeros_like(self.known)

    def add(self, observation: Observation, palm: Float[Tensor, "3"]) -> None:
        """Take one observation into the average."""
        sensed = observation.tactile
        told = torch.isfinite(sensed.points).all(-1) & torch.isfinite(sensed.normals).all(-1) & sensed.contact
        self.points = self.points + torch.where(told[:, None], sensed.points + palm, 0.0)
        self.normals = self.normals + torch.where(told[:, None], sensed.normals, 0.0)
        self.count = self.count + told
        self.tips, self.contact = observation.tips + palm, sensed.contact

    @property
    def felt(self) -> Bool[Tensor, "f"]:
        """Which fingertips told the place of a contact that they still have."""
        return self.contact & (self.count > 0)

    def means(self) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
        """Return mean points [m] and normals of the contacts; zero where none was felt."""
        return self.points / self.count.clamp_min(1.0)[:, None], unit(self.normals)


class Localization(Part):
    """The search for the likeliest displacement: one turn of the object a call, so that no tick takes long.

    `displacement` is that of the contacts' centre [m] and the rotation about it [rad], as of `Placement`.
    """

    def __init__(self, reference: ClosingReference) -> None:
        assert reference.surface is not None and reference.table is not None
        self.surface, self.obj_from_hand = reference.surface, reference.obj_from_hand.double()
        self.center, self.radius = reference.gains.target.mean(0), reference.hand.tips.radius.double()
        self.up = unit(reference.table.normal.double())
        across = torch.eye(3, dtype=torch.float64)[int(self.up.abs().argmin())]
        first = unit(torch.linalg.cross(self.up, across))
        self.axes = torch.stack([first, torch.linalg.cross(self.up, first)])
        self.steps, self.cost = 0.0, NOWHERE
        self.shift, self.turn = torch.zeros(2, dtype=torch.float64), 0.0
        self.middle, self.facing = self.shift, self.turn

    @property
    def done(self) -> bool:
        """Whether all turns were tried."""
        return self.steps >= len(TURNS) + len(FINER)

    @property
    def displacement(self) -> Float[Tensor, "6"]:
        """The likeliest displacement so far [m, rad]."""
        return torch.cat([self.shift @ self.axes, self.turn * self.up])

    def __call__(self, touches: Touches) -> None:
        """Try one more turn; at last those near the best one."""
        step = round(self.steps)
        if step == len(TURNS):
            self.middle, self.facing = self.shift, self.turn
        if step < len(TURNS):
            shifts, turn = _square(FARTHEST, PITCH), TURNS[step]
        else:
            shifts, turn = self.middle + _square(PITCH - FINEST, FINEST), self.facing + FINER[step - len(TURNS)]
        costs = self._costs(touches, shifts, turn)
        best = int(costs.argmin())
        if float(costs[best]) < self.cost:
            self.cost, self.shift, self.turn = float(costs[best]), shifts[best].clone(), turn
        self.steps += 1.0

    def _costs(self, touches: Touches, shifts: Float[Tensor, "m 2"], turn: float) -> Float[Tensor, "m"]:
        """Return the negative logarithms of the likelihoods of displacements."""
        felt, (points, normals) = touches.felt, touches.means()
        rotation = rotation_from_vector(turn * self.up)
        there = torch.where(felt[:, None], points, touches.tips) - self.center
        before = (there - (shifts @ self.axes)[:, None]) @ rotation + self.center
        distance, gradient = self.surface.query(apply(self.obj_from_hand, before))
        outward = unit(gradient @ self.obj_from_hand[:3, :3] @ rotation.T)
        place = (distance / SURFACE_STD).square().clamp_max(2 * WORST)
        facing = ((outward - normals) / NORMAL_STD).square().sum(-1)
        inside = ((self.radius + GAP - distance).clamp_min(0.0) / SURFACE_STD).square().clamp_max(2 * WORST)
        told = torch.where(felt, place + facing, torch.where(touches.contact | ~touches.known, 0.0, inside)).sum(-1)
        return 0.5 * (told + (shifts / SPREAD).square().sum(-1) + (turn / TURN) ** 2)


def _square(half: float, pitch: float) -> Float[Tensor, "m 2"]:
    """Return points of a square, so far to each side, at a pitch."""
    line = torch.arange(-round(half / pitch), round(half / pitch) + 1, dtype=torch.float64) * pitch
    return torch.cartesian_prod(line, line)
