"""How much the surface bends around a contact: the angle to the normals on a ring of a fingertip's size."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.linalg import unit
from torchgrasp.plan.problem import Shape
from torchgrasp.plan.solver import project
from torchgrasp.plan.wrench import cone_edges, tangents

RING_RADIUS = 0.008
"""Radius [m] of the ring around a contact; a fingertip's radius is 12 mm."""

RING_POINTS = 8
"""Points of the ring on which a plan is judged."""


def normal_variation(
    shape: Shape, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]
) -> Float[Tensor, "b 3"]:
    """Return the largest angle [rad] between the normal of a contact and those on the ring, moved onto the surface."""
    # A cone of friction 1 without its axis is a ring of unit tangents.
    around = cone_edges(normals, tangents(points, normals), 1.0, RING_POINTS) + normals[:, :, None]
    place = points[:, :, None] + RING_RADIUS / float(shape.scale) * around
    _, gradient = shape.mean_and_gradient(project(shape, place.flatten(1, 2), steps=1).flatten(0, 1))
    there = unit(gradient).unflatten(0, place.shape[:3])
    here = normals[:, :, None].expand_as(there)
    sine = torch.linalg.vector_norm(torch.linalg.cross(here, there), dim=-1)
    return torch.atan2(sine, (here * there).sum(-1)).amax(-1)
