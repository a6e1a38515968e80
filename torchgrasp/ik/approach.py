"""The straight path of the opened hand to its pre-grasp, clear of object, table and obstacles."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import CollisionWorld, along
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.linalg import unit
from torchgrasp.plane import Plane

APPROACH_DISTANCE = 0.1
"""Length [m] of the straight path: about a hand's depth."""
TILT, TILTED_DIRECTIONS = math.radians(45), 8
"""Angle [rad] of the tilted directions to the hand's approach axis, halfway to sideways; one every 45 degrees."""
COARSE_STEPS, FINE_STEPS = 8, 16
"""Positions on every path, half a finger's width apart, and on a chosen one: corners stay within 1 mm of a link."""
NODE_ERROR = 1.2
"""Spacings by which `query` may lie below `nearest_node`: a cell's other nodes are on average 1.12 from the nearest."""


def find_approach(
    hand: Hand, opened: Configuration, world: CollisionWorld
) -> tuple[Float[Tensor, "g 3"], Float[Tensor, "g"]]:
    """Return a direction of approach for each pre-grasp, and the least clearance [m] of its path.

    Candidates are the hand's approach axis, tilted directions and, above a table, straight down on it. The field's
    nearest nodes rank their paths to 3 mm. The first path of non-negative interpolated clearance is taken, else the
    clearest.
    """
    spheres = hand.collision_spheres
    centres = SpatialJacobian.at(hand, opened).points(spheres.link_index, spheres.center)
    radius, candidates = spheres.radius.to(centres), approach_directions(hand, opened, world.plane)
    coarse = torch.stack([_clearance(centres, radius, d, world, exact=False) for d in candidates.unbind(1)], 1)
    chosen, clearance = candidates[:, 0].clone(), torch.full_like(coarse[:, 0], -math.inf)
    for choice in torch.argsort(coarse, dim=1, descending=True, stable=True).unbind(1):
        touching = torch.nonzero(clearance < 0)[:, 0]
        direction = candidates[touching, choice[touching]]
        exact = _clearance(centres[touching], radius, direction, world, exact=True)
        better = exact > clearance[touching]
        chosen[touching[better]], clearance[touching[better]] = direction[better], exact[better]
    return chosen, clearance


def approach_directions(hand: Hand, opened: Configuration, table: Plane | None) -> Float[Tensor, "g k 3"]:
    """Return the candidate directions in the object's frame."""
    pose = opened.obj_from_hand
    axis = unit(hand.approach.to(pose))
    first = unit(torch.linalg.cross(axis, torch.eye(3).to(axis)[axis.abs().argmin()]))
    second = torch.linalg.cross(axis, first)
    angle = torch.arange(TILTED_DIRECTIONS).to(axis)[:, None] * (2 * math.pi / TILTED_DIRECTIONS)
    tilted = math.cos(TILT) * axis + math.sin(TILT) * (torch.cos(angle) * first + torch.sin(angle) * second)
    directions = rotate(pose, torch.cat([axis[None], tilted]).expand(len(pose), -1, -1))
    if table is None:
        return directions
    down = (0.0 - table.normal.to(pose)).expand(len(pose), 1, 3)  # minus alone would make negative zeros
    return torch.cat([directions, down], 1)


def _clearance(
    centres: Float[Tensor, "g s 3"],
    radius: Float[Tensor, "s"],
    direction: Float[Tensor, "g 3"],
    world: CollisionWorld,
    exact: bool,
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of spheres along a path to the pre-grasp, interpolated or by the nearest nodes."""
    steps = FINE_STEPS if exact else COARSE_STEPS
    back = torch.arange(1, steps + 1).to(centres) * (APPROACH_DISTANCE / steps)
    path = (centres[:, None] - back[:, None, None] * direction[:, None, None]).flatten(1, 2)
    radius, least = radius.repeat(steps), torch.full_like(path[:, 0, 0], math.inf)
    for field in world.fields:
        coarse = field.nearest_node(path) - radius
        near, first = coarse.min(1)
        if exact:  # only spheres that may have the least clearance are interpolated
            near = field.query(path[torch.arange(len(path), device=path.device), first])[0] - radius[first]
            row, sphere = torch.nonzero(coarse < near[:, None] + NODE_ERROR * field.spacing, as_tuple=True)
            near = near.scatter_reduce(0, row, field.query(path[row, sphere])[0] - radius[sphere], "amin")
        least = torch.minimum(least, near)
    if world.plane is not None:
        least = torch.minimum(least, (along(path, world.plane) - radius).amin(1) - world.plane.offset)
    return least
