"""The straight path of the opened hand to its pre-grasp, clear of object and table."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.sdf import SignedDistanceField

APPROACH_DISTANCE = 0.1
"""Length [m] of the straight path: about a hand's depth."""
TILT = math.radians(45)
"""Angle [rad] of the tilted directions to the hand's approach axis: halfway to sideways."""
TILTED_DIRECTIONS = 8
"""Tilted directions around the axis, one every 45 degrees."""
COARSE_STEPS = 8
"""Positions on each path for the choice, half a finger's width apart."""
FINE_STEPS = 16
"""Positions on the chosen path. Between two of them a corner of the object is less than 1 mm deeper in a link."""
NODE_ERROR = 1.2
"""Spacings by which `query` may lie below `nearest_node`: a cell's other nodes are on average 1.12 from the nearest."""


def find_approach(
    hand: Hand, opened: Configuration, world: CollisionWorld
) -> tuple[Float[Tensor, "g 3"], Float[Tensor, "g"]]:
    """Return a direction of approach for each pre-grasp, and the least clearance [m] of its path.

    Candidates are the hand's approach axis, tilted directions and, above a table, straight down. The field's nearest
    nodes rank their paths to 3 mm. The first path of non-negative interpolated clearance is taken, else the clearest.
    """
    spheres = hand.collision_spheres
    centres = SpatialJacobian.at(hand, opened).points(spheres.link_index, spheres.center)
    radius, candidates = spheres.radius.to(centres), approach_directions(hand, opened, world.table)
    paths = (_path(centres, direction, COARSE_STEPS) for direction in candidates.unbind(1))
    coarse = torch.stack([_clearance(path, radius, world, exact=False) for path in paths], 1)
    order = torch.argsort(coarse, dim=1, descending=True, stable=True)
    chosen, clearance = candidates[:, 0].clone(), torch.full_like(coarse[:, 0], -math.inf)
    for choice in order.unbind(1):
        touching = torch.nonzero(clearance < 0)[:, 0]
        direction = candidates[touching, choice[touching]]
        exact = _clearance(_path(centres[touching], direction, FINE_STEPS), radius, world, exact=True)
        better = exact > clearance[touching]
        chosen[touching[better]], clearance[touching[better]] = direction[better], exact[better]
    return chosen, clearance


def approach_directions(hand: Hand, opened: Configuration, table: float | None) -> Float[Tensor, "g k 3"]:
    """Return the candidate directions in the object's frame."""
    pose = opened.obj_from_hand
    axis = hand.approach.to(pose)
    axis = axis / torch.linalg.vector_norm(axis)
    first = torch.linalg.cross(axis, torch.eye(3).to(axis)[axis.abs().argmin()])
    first = first / torch.linalg.vector_norm(first)
    second = torch.linalg.cross(axis, first)
    angle = torch.arange(TILTED_DIRECTIONS).to(axis)[:, None] * (2 * math.pi / TILTED_DIRECTIONS)
    tilted = math.cos(TILT) * axis + math.sin(TILT) * (torch.cos(angle) * first + torch.sin(angle) * second)
    directions = rotate(pose, torch.cat([axis[None], tilted]).expand(len(pose), -1, -1))
    if table is None:
        return directions
    down = torch.tensor([0.0, 0.0, -1.0]).to(pose).expand(len(pose), 1, 3)
    return torch.cat([directions, down], 1)


def _path(centres: Float[Tensor, "g s 3"], direction: Float[Tensor, "g 3"], steps: int) -> Float[Tensor, "g p s 3"]:
    """Return the spheres' centres along the path, without the pre-grasp itself."""
    back = torch.arange(1, steps + 1).to(centres) * (APPROACH_DISTANCE / steps)
    return centres[:, None] - back[:, None, None] * direction[:, None, None]


def _clearance(
    path: Float[Tensor, "g p s 3"], radius: Float[Tensor, " s"], world: CollisionWorld, exact: bool
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of spheres along a path, interpolated or by the nearest nodes."""
    least = torch.full_like(path[:, 0, 0, 0], math.inf)
    if world.field is not None:
        coarse = (world.field.nearest_node(path) - radius).flatten(1)
        least = _exact_least(path, radius, coarse, world.field) if exact else coarse.amin(1)
    if world.table is not None:
        least = torch.minimum(least, (path[..., 2] - radius).flatten(1).amin(1) - world.table)
    return least


def _exact_least(
    path: Float[Tensor, "g p s 3"],
    radius: Float[Tensor, " s"],
    coarse: Float[Tensor, "g n"],
    field: SignedDistanceField,
) -> Float[Tensor, "g"]:
    """Return the least interpolated clearance [m]; only spheres that may have it are queried."""
    points, radii = path.flatten(1, 2), radius.repeat(path.shape[1])
    first = coarse.argmin(1)
    least = field.query(points[torch.arange(len(points), device=path.device), first])[0] - radii[first]
    row, sphere = torch.nonzero(coarse < least[:, None] + NODE_ERROR * field.spacing, as_tuple=True)
    return least.scatter_reduce(0, row, field.query(points[row, sphere])[0] - radii[sphere], "amin")
