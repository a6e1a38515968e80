"""Where the opened hand can come from: straight to its pre-grasp, clear of the object and the table all the way."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import rotate
from torchgrasp.hand.clear import Surroundings
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.motion import Posture, Screws

DISTANCE = 0.1
"""Length [m] of the straight way on which nothing may be touched."""
PLACES = 8
"""How many places on the way are looked at, evenly spaced: half a finger's width apart."""
TILT = math.radians(45)
"""Angle [rad] between the hand's own approach axis and the other directions that are tried."""
AROUND = 8
"""How many tilted directions are tried."""


def find_approach(
    opened: Posture, hand: Hand, surroundings: Surroundings
) -> tuple[Float[Tensor, "g 3"], Float[Tensor, "g"]]:
    """Return the direction of each hand's way to where it stands with the most clearance, and that clearance [m].

    Tried are the hand's approach axis, directions tilted from it all around and, where there is a table, straight down.
    The clearance is the least of all links along the way, of the object and of the table; infinite without both.

    Args:
        opened: g pre-grasps.
        hand: the hand.
        surroundings: the estimated object and the table.
    """
    cover = hand.collision_spheres
    centres = Screws.at(opened, hand).points(cover.link_index, cover.center)
    candidates = _directions(opened, hand, surroundings.table)
    back = torch.arange(1, PLACES + 1).to(centres) * (DISTANCE / PLACES)
    clearances = []
    for direction in candidates.unbind(1):
        way = centres[:, None] - back[:, None, None] * direction[:, None, None]
        clearances.append(_clearance(way, cover.radius.to(centres), surroundings))
    clearance, best = torch.stack(clearances, 1).max(1)
    return candidates[torch.arange(len(best), device=best.device), best], clearance


def _directions(opened: Posture, hand: Hand, table: float | None) -> Float[Tensor, "g k 3"]:
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


def _clearance(
    way: Float[Tensor, "g p s 3"], radius: Float[Tensor, " s"], surroundings: Surroundings
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of spheres along a way; of the object to 3 mm, by the field's nearest node."""
    least = torch.full_like(way[:, 0, 0, 0], math.inf)
    if surroundings.field is not None:
        least = torch.minimum(least, (surroundings.field.nearest(way) - radius).flatten(1).amin(1))
    if surroundings.table is not None:
        least = torch.minimum(least, (way[..., 2] - radius).flatten(1).amin(1) - surroundings.table)
    return least
