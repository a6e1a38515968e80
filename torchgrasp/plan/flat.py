"""How much the surface bends around a contact: the angle to the normals on a ring of a fingertip's size."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.linalg import unit
from torchgrasp.plan.problem import Shape, TripleJet
from torchgrasp.plan.wrench import cone_edges, tangents

RING_RADIUS = 0.008
"""Radius [m] of the ring around a contact; a fingertip's radius is 12 mm."""

RING_POINTS = 8
"""Points of the ring on which a plan is judged."""

GUIDE_POINTS = 4
"""Points of the ring that guide the planner on its way."""


def ring(
    shape: Shape,
    points: Float[Tensor, "b 3 3"],
    normals: Float[Tensor, "b 3 3"],
    tangent: Float[Tensor, "b 3 3"],
    count: int,
) -> tuple[Float[Tensor, "b 3 k 3"], Float[Tensor, "b 3 k 3"]]:
    """Return points at `RING_RADIUS` in the tangent plane of each contact, and the unit directions to them."""
    # A cone of friction 1 without its axis is a ring of unit tangents.
    around = cone_edges(normals, tangent, 1.0, count) + normals[:, :, None]
    return points[:, :, None] + RING_RADIUS / float(shape.scale) * around, around


def bend(shape: Shape, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3"]:
    """Return the largest angle [rad] between the normal of a contact and those on the ring, moved onto the surface.

    The normals at the moved points are those of the second order from the points on the ring.
    """
    place, _ = ring(shape, points, normals, tangents(points, normals), RING_POINTS)
    x = place.flatten(0, 2)
    jet = shape.jet(x)
    squared = (jet.gradient * jet.gradient).sum(-1, keepdim=True)
    move = -jet.distance[:, None] / squared * jet.gradient  # a Newton step, of which the Hessian tells the turn
    there = unit(jet.gradient + (jet.hessian @ move[..., None])[..., 0]).unflatten(0, place.shape[:3])
    here = normals[:, :, None].expand_as(there)
    sine = torch.linalg.vector_norm(torch.linalg.cross(here, there), dim=-1)
    return torch.atan2(sine, (here * there).sum(-1)).amax(-1)


@dataclasses.dataclass(frozen=True)
class BendGuide(Batch):
    """Rows <= 0 for flat surface around the contacts, linear about the points where they were evaluated.

    The ring costs as much as several steps of the planner, so its rows are evaluated rarely.
    """

    value: Float[Tensor, "b k"]
    by_points: Float[Tensor, "b k 9"]
    at: Float[Tensor, "b 3 3"]

    def rows(self, points: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b k"]:
        """Return the rows at points near those of the evaluation."""
        return self.value + (self.by_points @ (points - self.at).flatten(1)[..., None])[..., 0]


def bend_guide(
    shape: Shape, points: Float[Tensor, "b 3 3"], tangent: Float[Tensor, "b 3 3"], jet: TripleJet, flatness: float
) -> BendGuide:
    """Evaluate the chord |n - n_k| of the normals at a contact and on its ring, less that of the angle `flatness`.

    Rows are lengths: chords times the ring's radius. The ring starts at the unit
    `tangent` of each contact and is carried along with it.
    """
    normals = jet.normals
    place, around = ring(shape, points, normals, tangent, GUIDE_POINTS)
    there = shape.jet(place.flatten(0, 2))
    identity = torch.eye(3, dtype=points.dtype, device=points.device)

    def turn(gradient: Tensor, hessian: Tensor) -> tuple[Tensor, Tensor]:
        """Return the unit normal and its derivative by the point."""
        length = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
        n = gradient / length
        return n, (identity - n[..., :, None] * n[..., None, :]) @ hessian / length[..., None]

    normal, normal_by_point = turn(jet.gradient[:, :, None], jet.hessian[:, :, None])  # (b, 3, 1, ..)
    other, other_by_place = (t.unflatten(0, place.shape[:3]) for t in turn(there.gradient, there.hessian))
    radius = RING_RADIUS / float(shape.scale)
    place_by_point = identity - radius * normal[..., :, None] * (around[..., None, :] @ normal_by_point)
    difference = other - normal
    chord = torch.linalg.vector_norm(difference, dim=-1)
    direction = difference / torch.where(chord == 0, 1.0, chord)[..., None]
    slope = (direction[..., None, :] @ (other_by_place @ place_by_point - normal_by_point))[..., 0, :]  # (b, 3, k, 3)
    by_points = torch.einsum("bikj,il->bkilj", radius * slope, identity).flatten(3).flatten(1, 2)
    value = radius * (chord - 2 * math.sin(0.95 * flatness / 2)).mT.flatten(1)
    return BendGuide(value, by_points, points)
