"""Where the object is, as touches tell it: by how much it is displaced from where the grasp was planned.

Near each contact the object is its planned tangent plane. A fingertip that touches measures where this plane is, along
its normal, as uncertain as the shape is there (Sigma_cov). One that touches nothing where the plane should be bounds
it. The displacement is the likeliest one, given how far objects usually are from where they were seen.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import Part
from torchgrasp.geometry.linalg import unit

SPREAD, HEIGHT_SPREAD = 0.01, 0.001
"""Standard deviations [m] of the object's place: along the table, or in every direction without one; across the table.
A tracker or a hand-eye calibration is off by as much; objects do not float."""

TURN, TILT = 0.09, 0.01
"""Standard deviations [rad] of its rotation: about the table's normal, or about any axis without one; about others."""

FARTHEST = 0.025
"""A finger in the air bounds the object's place by no more than this [m]: farther on it has missed the object."""


class Placement(Part):
    """The belief of the object's displacement, in the hand's frame before its palm moved.

    Args:
        reference: of the closing.
        expected: displacement [m, rad] before anything is touched; None: the object is where it was seen.
    """

    def __init__(self, reference: ClosingReference, expected: Float[Tensor, "6"] | None = None) -> None:
        gains, normals = reference.gains, reference.normals
        self.target, self.normals, self.alive = gains.target, normals, reference.alive
        self.arms = gains.target - gains.target.mean(0)
        self.rows = torch.cat([normals, torch.linalg.cross(self.arms, normals)], -1)
        self.weight = 1 / torch.einsum("fi,fij,fj->f", normals, gains.covariance, normals)
        eye = torch.eye(3, dtype=normals.dtype)
        place, turn = eye / SPREAD**2, eye / TURN**2
        if reference.table is not None:
            up = unit(reference.table.normal)
            across = up[:, None] * up
            place = place + across * (HEIGHT_SPREAD**-2 - SPREAD**-2)
            turn = eye / TILT**2 + across * (TURN**-2 - TILT**-2)
        self.prior = torch.block_diag(place, turn)
        self.expected = torch.zeros_like(self.prior[0]) if expected is None else expected

    def displacement(self, points: Float[Tensor, "f 3"], touching: Bool[Tensor, "f"]) -> Float[Tensor, "6"]:
        """Return the likeliest displacement of the contacts' centre [m] and rotation about it [rad].

        Args:
            points: of the fingertips, those that touch first [m].
            touching: which of them touch, as their sensors tell.
        """
        off = ((points - self.target) * self.normals).sum(-1)
        beyond = (off - self.rows @ self.expected).clamp_min(-FARTHEST)
        touching = touching & self.alive
        active, found = touching, self.expected
        for _ in range(len(off)):
            weight = self.weight * active
            found = self.expected + torch.linalg.solve(
                self.prior + self.rows.T @ (weight[:, None] * self.rows), self.rows.T @ (weight * beyond)
            )
            missed = touching | active | (self.alive & (off < self.rows @ found))
            if torch.equal(missed, active):
                break
            active = missed
        return found

    def moved(self, displacement: Float[Tensor, "6"]) -> Float[Tensor, "f 3"]:
        """Return the contacts of the displaced object [m]."""
        shift, turn = displacement[:3], displacement[3:]
        return self.target + shift + torch.linalg.cross(turn.expand_as(self.arms), self.arms)
