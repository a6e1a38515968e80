"""Rows that keep sliding contacts on flat surface: how the bend around a contact changes as it moves."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.plan.normal_variation import RING_RADIUS
from torchgrasp.plan.problem import Shape, triple_jet
from torchgrasp.plan.wrench import cone_edges, tangents

GUIDE_POINTS = 4
"""Points of the ring that guide; `bend` judges on more."""
INSIDE = 0.95
"""Share of the largest bend that is asked for, since the points judged lie between these."""


@dataclasses.dataclass(frozen=True)
class FlatnessConstraint(Batch):
    """Rows <= 0 for flat surface around the contacts, linear about the points `at` where they were evaluated.

    The ring costs as much as several steps of a solver, so its rows are evaluated rarely.
    """

    value: Float[Tensor, "b k"]
    by_points: Float[Tensor, "b k 9"]
    at: Float[Tensor, "b 3 3"]

    def rows(self, points: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b k"]:
        """Return the rows at points near those of the evaluation."""
        return self.value + (self.by_points @ (points - self.at).flatten(1)[..., None])[..., 0]


def flatness_constraint(shape: Shape, points: Float[Tensor, "b 3 3"], flatness: float) -> FlatnessConstraint:
    """Evaluate the chord |n - n_k| of the normals at a contact and on its ring, less that of the angle `flatness`.

    Rows are lengths: chords times the ring's radius.

    Args:
        shape: the estimated object.
        points: contacts, normalised.
        flatness: the largest bend [rad].
    """
    jet, radius = triple_jet(shape, points), RING_RADIUS / float(shape.scale)
    identity = torch.eye(3, dtype=points.dtype, device=points.device)
    # A cone of friction 1 without its axis is a ring of unit tangents, which turn with the normal.
    around = cone_edges(jet.normals, tangents(points, jet.normals), 1.0, GUIDE_POINTS) + jet.normals[:, :, None]
    around, normal, turn = around.transpose(1, 2), jet.normals[:, None], jet.normal_jacobian[:, None]
    place = points[:, None] + radius * around  # (b, k, 3, 3)
    place_by_point = identity - radius * normal[..., :, None] * (around[..., None, :] @ turn)
    there = triple_jet(shape, place.flatten(0, 1))
    difference = there.normals.view_as(place) - normal
    chord = torch.linalg.vector_norm(difference, dim=-1)
    direction = difference / torch.where(chord == 0, 1.0, chord)[..., None]
    change = there.normal_jacobian.view(*place.shape, 3) @ place_by_point - turn
    slope = (direction[..., None, :] @ change)[..., 0, :]
    by_points = torch.einsum("bkij,il->bkilj", radius * slope, identity).flatten(3).flatten(1, 2)
    value = radius * (chord - 2 * math.sin(INSIDE * flatness / 2)).flatten(1)
    return FlatnessConstraint(value, by_points, points)
