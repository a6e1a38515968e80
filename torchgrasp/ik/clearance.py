"""Clearances of links from the object, the table, obstacles and each other."""

import dataclasses
import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, settle
from torchgrasp.checks import checked
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.collision_shapes import CollisionSpheres
from torchgrasp.ik.configuration import Rows, SpatialJacobian
from torchgrasp.ik.obstacles import Obstacles

MILLIMETRE = 1e-3
"""Unit of all residuals [m]: it makes lengths as large as angles times their weights."""
CLEARANCE = 4 * MILLIMETRE
"""Clearance [m] that refinement asks of links and object or table; the checks accept any above zero."""
SELF_CLEARANCE = 1 * MILLIMETRE
"""Clearance [m] that refinement asks between links, whose shapes are exact."""
HINGES = 8
"""How many of the least clearances of each kind enter one step; the others are larger."""


@checked
@dataclasses.dataclass(frozen=True)
class CollisionWorld(Value):
    """The object's signed distance field, the table as a plane or a height [m] along z, and obstacles, if any.

    Raises:
        BadArgument: a table that is neither.

    >>> CollisionWorld(table=0.02).plane.offset
    0.02
    """

    field: SignedDistanceField | None = None
    table: Plane | float | None = None
    obstacles: Obstacles | None = None

    def __post_init__(self) -> None:
        """Check the table once, where the value is made."""
        as_plane(self.table)

    @cached_property
    def plane(self) -> Plane | None:
        """The table as a plane, on the device of the fields."""
        plane = as_plane(self.table)
        return plane if plane is None or not self.fields else settle(plane, self.fields[0].origin.device)

    @property
    def fields(self) -> tuple[SignedDistanceField, ...]:
        """The distance fields of object and obstacles, if any."""
        return tuple(x for x in (self.field, self.obstacles and self.obstacles.field) if x is not None)

    @property
    def alone(self) -> "CollisionWorld":
        """The same world without obstacles."""
        return dataclasses.replace(self, obstacles=None)

    @property
    def guarded(self) -> bool:
        """Tell whether there are obstacles that links may not touch."""
        return self.obstacles is not None and self.obstacles.hard


def along(points: Float[Tensor, "*b 3"], plane: Plane) -> Float[Tensor, "*b"]:
    """Return the coordinates [m] of points along a plane's normal."""
    x, y, z = plane.components
    if (x, y, z) == (0.0, 0.0, 1.0):  # the usual table costs nothing
        return points[..., 2]
    return points[..., 0] * x + points[..., 1] * y + points[..., 2] * z


def collision_cost(
    centres: Float[Tensor, "*b s 3"], spheres: CollisionSpheres, world: CollisionWorld
) -> Float[Tensor, "*b"]:
    """Return the squared clearance deficits [mm2] of a touching hand."""
    radius, cost = spheres.radius.to(centres), centres.new_zeros(centres.shape[:-2])
    if world.field is not None:
        deficit = (CLEARANCE + radius - world.field.nearest_node(centres)) * ~spheres.touching
        cost = cost + deficit.clamp_min(0).square().sum(-1)
    if world.obstacles is not None:
        deficit = CLEARANCE + radius - world.obstacles.field.nearest_node(centres)
        cost = cost + deficit.clamp_min(0).square().sum(-1)
    if world.plane is not None:
        deficit = world.plane.offset + CLEARANCE * ~spheres.touching + radius - along(centres, world.plane)
        cost = cost + deficit.clamp_min(0).square().sum(-1)
    return cost / MILLIMETRE**2


def clearance_rows(spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool) -> list[Rows]:
    """Return hinges on the least clearances of the links from each other, the object, obstacles and the table."""
    return [self_rows(spatial), *sphere_rows(spatial, world, tips_touch)]


def self_rows(spatial: SpatialJacobian) -> Rows:
    """Return hinges on the links' least clearances from each other."""
    pairs, moves = spatial.hand.self_collision, spatial.hand.motion.moves
    separation, number, wrench = pairs.pushes(spatial.obj_from_link, SELF_CLEARANCE)
    separation, index = separation.T.topk(min(HINGES, len(pairs.pairs)), dim=1, largest=False, sorted=False)
    wrench = wrench.T[number.T.gather(1, index)] / -MILLIMETRE
    first, second = moves[pairs.link[pairs.pairs]].to(wrench).unbind(1)
    return Rows((SELF_CLEARANCE - separation).clamp_min(0) / MILLIMETRE, wrench, (second - first)[index])


def sphere_rows(spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool) -> list[Rows]:
    """Return hinges on the least clearances of the links' spheres from each of object, obstacles and table."""
    spheres, motion, centres = spatial.hand.collision_spheres, spatial.hand.motion, spatial.sphere_centres
    radius, found = spheres.radius.to(centres), []
    for field in world.fields:
        coarse = field.nearest_node(centres) - radius
        if tips_touch and field is world.field:
            coarse = torch.where(spheres.touching, math.inf, coarse)
        found.append(coarse)
    if world.plane is not None:
        height = along(centres, world.plane) - radius - world.plane.offset
        found.append(
            height + CLEARANCE * spheres.touching if tips_touch else height
        )  # contacts decide how low tips are
    if not found:
        return []
    coarse, index = torch.stack(found, 1).topk(min(HINGES, len(radius)), dim=2, largest=False, sorted=False)
    points = centres[torch.arange(len(centres), device=centres.device)[:, None, None], index]
    clearance, direction = [], []
    for k, field in enumerate(world.fields):
        distance, gradient = field.query(points[:, k])
        clearance.append(distance - radius[index[:, k]] + torch.where(torch.isinf(coarse[:, k]), 1.0, 0.0))
        direction.append(gradient)
    if world.plane is not None:
        clearance.append(coarse[:, -1])
        direction.append(world.plane.normal.to(centres).expand_as(points[:, -1]))
    clearance, direction = torch.cat(clearance, 1), torch.cat(direction, 1)
    direction = direction * ((clearance < CLEARANCE).to(centres) / -MILLIMETRE)[..., None]
    wrench = torch.cat([direction, torch.linalg.cross(points.flatten(1, 2), direction)], -1)
    moves = motion.moves[spheres.link_index].to(centres)[index.flatten(1)]
    return [Rows((CLEARANCE - clearance).clamp_min(0) / MILLIMETRE, wrench, moves)]


def link_clearance(
    spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool
) -> tuple[Float[Tensor, "g"], Float[Tensor, "g"], Float[Tensor, "g"]]:
    """Return the least clearances [m]: links (no touching tips) from object, tips from object, all from table."""
    spheres = spatial.hand.collision_spheres
    centres = spatial.sphere_centres
    radius = spheres.radius.to(centres)
    clearance = torch.full_like(centres[..., 0], math.inf)
    if world.field is not None:
        clearance = world.field.query(centres)[0] - radius
    tips = clearance[:, spheres.touching].amin(1)
    links = clearance[:, ~spheres.touching].amin(1) if tips_touch else clearance.amin(1)
    if world.plane is None:
        return links, tips, torch.full_like(tips, math.inf)
    return links, tips, (along(centres, world.plane) - radius).amin(1) - world.plane.offset


def obstacle_clearance(spatial: SpatialJacobian, world: CollisionWorld) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of all links, fingertips too, from obstacles; infinite without any."""
    spheres = spatial.hand.collision_spheres
    centres = spatial.sphere_centres
    if world.obstacles is None:
        return torch.full_like(centres[:, 0, 0], math.inf)
    return (world.obstacles.field.query(centres)[0] - spheres.radius.to(centres)).amin(1)
