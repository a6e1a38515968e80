"""The clearance of hands on their paths (`torchgrasp.ik.motion`) as one compiled loop."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled
from torchgrasp.geometry.fused_grid import look_up
from torchgrasp.geometry.fused_vectors import add, scale
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.fused_world import coarse_clearance, world_parts


@compiled
def _sweep(parts, centres, direction, step, nodes, coarse, least):
    """Write the least clearance of each hand on its path, as `_clearance` of `motion`."""
    steps, spheres = coarse.shape
    for g in range(len(centres)):
        least[g] = math.inf
        for part in parts:
            if part.kind == 0:
                continue
            near = math.inf
            first = scale(centres[g, 0], 1.0)
            own = 0
            for k in range(steps):
                for s in range(spheres):
                    p = add(centres[g, s], direction[g], -step * (k + 1))
                    coarse[k, s] = coarse_clearance(part, p) + part.grown[s]
                    if coarse[k, s] < near:
                        near = coarse[k, s]
                        first = p
                        own = s
            if nodes > 0.0 and part.kind == 2:
                near = look_up(part, first)[0] + part.grown[own]
                within = near + nodes * part.spacing
                for k in range(steps):
                    for s in range(spheres):
                        if coarse[k, s] < within:
                            p = add(centres[g, s], direction[g], -step * (k + 1))
                            near = min(near, look_up(part, p)[0] + part.grown[s])
            least[g] = min(least[g], near)


def sweep(
    centres: Float[Tensor, "g s 3"],
    radius: Float[Tensor, "s"],
    direction: Float[Tensor, "g 3"],
    world: CollisionWorld,
    steps: int,
    step: float,
    nodes: float,
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of g hands from the `world` on their straight approaches.

    A hand is checked at `steps` positions, each `step` [m] farther back against its unit
    `direction`. `centres` [m] are those of its s collision spheres at the end of the approach, and
    `radius` [m] their radii. The distance of a sphere from a grid's object is first taken at the
    nearest node. `nodes` is the largest error of this distance, in grid spacings. For spheres that
    may be the nearest, the distance is then interpolated. If `nodes` is 0, no distance is.
    """
    parts = world_parts(radius, torch.zeros_like(radius, dtype=torch.bool), world)
    least = torch.empty_like(centres[:, 0, 0])
    coarse = np.empty((steps, len(radius)))
    _sweep(parts, array(centres), array(direction), step, nodes, coarse, least.numpy())
    return least
