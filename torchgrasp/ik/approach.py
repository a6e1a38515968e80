"""Where the opened hand can come from: straight to its pre-grasp, clear of the object and the table all the way."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.sdf import SignedDistanceField

DISTANCE = 0.1
"""Length [m] of the straight way on which nothing may be touched."""
TILT = math.radians(45)
"""Angle [rad] between the hand's own approach axis and the other directions that are tried."""
AROUND = 8
"""How many tilted directions are tried."""
PLACES = 8
"""How many places on each way are looked at to choose one, evenly spaced: half a finger's width apart."""
FINE_PLACES = 16
"""How many on the chosen way are looked at to tell whether it is free: between two of them a corner of the object
comes less than 1 mm deeper into a link than at them."""
SLACK = 1.2
"""How many spacings of the field its `query` may be below its `nearest`: in the middle of a cell, where all eight nodes
weigh alike, the others are 1.12 spacings from the nearest on average."""


def find_approach(
    opened: Configuration, hand: Hand, world: CollisionWorld
) -> tuple[Float[Tensor, "g 3"], Float[Tensor, "g"]]:
    """Return the direction of a way for each hand to where it stands, and how clear [m] of everything that way is.

    Tried are the hand's approach axis, directions tilted from it all around and, where there is a table, straight down.
    They are ranked by their clearance to 3 mm, from the field's nearest nodes. Taken is the first whose clearance by
    the field's interpolation is not negative or, where all touch, the one that has the most.
    The clearance is the least of all links along the way, of the object and of the table; infinite without both.

    Args:
        opened: g pre-grasps.
        hand: the hand.
        surroundings: the estimated object and the table.
    """
    cover = hand.collision_spheres
    centres = SpatialJacobian.at(opened, hand).points(cover.link_index, cover.center)
    radius, candidates = cover.radius.to(centres), _directions(opened, hand, world.table)
    ways = (_way(centres, direction, PLACES) for direction in candidates.unbind(1))
    rough = torch.stack([_clearance(way, radius, world, exact=False) for way in ways], 1)
    order = torch.argsort(rough, dim=1, descending=True, stable=True)
    chosen, clearance = candidates[:, 0].clone(), torch.full_like(rough[:, 0], -math.inf)
    for choice in order.unbind(1):
        touching = torch.nonzero(clearance < 0)[:, 0]
        direction = candidates[touching, choice[touching]]
        found = _clearance(_way(centres[touching], direction, FINE_PLACES), radius, world, exact=True)
        better = found > clearance[touching]
        chosen[touching[better]], clearance[touching[better]] = direction[better], found[better]
    return chosen, clearance


def _directions(opened: Configuration, hand: Hand, table: float | None) -> Float[Tensor, "g k 3"]:
    """Return the directions of travel that are tried, in the object's frame."""
    pose = opened.obj_from_hand
    axis = hand.approach.to(pose)
    axis = axis / torch.linalg.vector_norm(axis)
    across = torch.eye(3).to(axis)[axis.abs().argmin()]
    first = torch.linalg.cross(axis, across)
    first = first / torch.linalg.vector_norm(first)
    second = torch.linalg.cross(axis, first)
    angle = torch.arange(AROUND).to(axis)[:, None] * (2 * math.pi / AROUND)
    tilted = math.cos(TILT) * axis + math.sin(TILT) * (torch.cos(angle) * first + torch.sin(angle) * second)
    found = rotate(pose, torch.cat([axis[None], tilted]).expand(len(pose), -1, -1))
    if table is None:
        return found
    down = torch.tensor([0.0, 0.0, -1.0]).to(pose).expand(len(pose), 1, 3)
    return torch.cat([found, down], 1)


def _way(centres: Float[Tensor, "g s 3"], direction: Float[Tensor, "g 3"], places: int) -> Float[Tensor, "g p s 3"]:
    """Return where the spheres are at places along the way, the last of which, where they stand, is left out."""
    back = torch.arange(1, places + 1).to(centres) * (DISTANCE / places)
    return centres[:, None] - back[:, None, None] * direction[:, None, None]


def _clearance(
    way: Float[Tensor, "g p s 3"], radius: Float[Tensor, " s"], world: CollisionWorld, exact: bool
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of spheres along a way; of the object by the field's interpolation or nodes."""
    least = torch.full_like(way[:, 0, 0, 0], math.inf)
    if world.field is not None:
        rough = (world.field.nearest(way) - radius).flatten(1)
        least = _exact_least(way, radius, rough, world.field) if exact else rough.amin(1)
    if world.table is not None:
        least = torch.minimum(least, (way[..., 2] - radius).flatten(1).amin(1) - world.table)
    return least


def _exact_least(
    way: Float[Tensor, "g p s 3"], radius: Float[Tensor, " s"], rough: Float[Tensor, "g n"], field: SignedDistanceField
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] by the field's interpolation, which only the spheres that may have it need."""
    points, radii = way.flatten(1, 2), radius.repeat(way.shape[1])
    first = rough.argmin(1)
    least = field.query(points[torch.arange(len(points), device=way.device), first])[0] - radii[first]
    row, at = torch.nonzero(rough < least[:, None] + SLACK * field.spacing, as_tuple=True)
    return least.scatter_reduce(0, row, field.query(points[row, at])[0] - radii[at], "amin")
