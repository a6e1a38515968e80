"""Clearances of links from the object, the table, obstacles and each other."""

import dataclasses
import math
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value, settle
from torchgrasp.border import checked
from torchgrasp.hand.collision_spheres import CollisionSpheres
from torchgrasp.ik.configuration import SpatialJacobian, wrench_of
from torchgrasp.ik.obstacles import Obstacles
from torchgrasp.ik.sdf import SignedDistanceField
from torchgrasp.optim import Residuals
from torchgrasp.plane import Plane, as_plane

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


def hinge(clearance: Float[Tensor, "g k"], jacobian: Float[Tensor, "g k d"], margin: float) -> Residuals:
    """Return max(0, margin - clearance) [mm] and its derivative."""
    active = (clearance < margin).to(clearance)
    return active * (margin - clearance) / MILLIMETRE, -active[..., None] * jacobian / MILLIMETRE


def least(clearance: Float[Tensor, "g s"]) -> tuple[Int[Tensor, "g 1"], Int[Tensor, "g k"]]:
    """Return rows and columns of the least clearances of each row."""
    index = clearance.topk(min(HINGES, clearance.shape[1]), dim=1, largest=False, sorted=False).indices
    return torch.arange(len(index), device=index.device)[:, None], index


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


def clearance_hinges(spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool) -> Residuals:
    """Return hinges on the least clearances of the links from each other, the object, obstacles and the table."""
    hinges, spheres = [self_hinges(spatial)], spatial.hand.collision_spheres
    centres = spatial.points(spheres.link_index, spheres.center)
    radius = spheres.radius.to(centres)
    for field in world.fields:
        coarse = field.nearest_node(centres) - radius
        if tips_touch and field is world.field:
            coarse = torch.where(spheres.touching, math.inf, coarse)
        row, index = least(coarse)
        nearest = centres[row, index]
        distance, gradient = field.query(nearest)
        clearance = distance - radius[index] + torch.where(torch.isinf(coarse[row, index]), 1.0, 0.0)
        jacobian = spatial.jacobian(wrench_of(nearest, gradient), spheres.link_index[index])
        hinges.append(hinge(clearance, jacobian, CLEARANCE))
    if world.plane is not None:
        height = along(centres, world.plane) - radius - world.plane.offset
        if tips_touch:  # their contacts decide how low they are
            height = height + CLEARANCE * spheres.touching
        row, index = least(height)
        up = world.plane.normal.to(centres).expand(*index.shape, 3)
        jacobian = spatial.jacobian(wrench_of(centres[row, index], up), spheres.link_index[index])
        hinges.append(hinge(height[row, index], jacobian, CLEARANCE))
    residuals, jacobians = zip(*hinges, strict=True)
    return torch.cat(residuals, 1), torch.cat(jacobians, 1)


def self_hinges(spatial: SpatialJacobian) -> Residuals:
    """Return hinges on the links' least clearances from each other."""
    pairs, frames = spatial.hand.self_collision, spatial.obj_from_link[:, :, :3].permute(2, 3, 1, 0).contiguous()
    separation = pairs.separations(frames, SELF_CLEARANCE).T
    row, index = least(separation)
    separation = separation[row, index]
    close = torch.nonzero(separation < SELF_CLEARANCE, as_tuple=True)  # the hinges of the others are flat
    wrench = separation.new_zeros(*index.shape, 6)
    wrench[close] = pairs.wrenches(frames, index[close], close[0]).T
    first, second = pairs.link[pairs.pairs[index]].unbind(-1)
    return hinge(separation, spatial.jacobian(wrench, second) - spatial.jacobian(wrench, first), SELF_CLEARANCE)


def link_clearance(
    spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool
) -> tuple[Float[Tensor, "g"], Float[Tensor, "g"], Float[Tensor, "g"]]:
    """Return the least clearances [m]: links (no touching tips) from object, tips from object, all from table."""
    spheres = spatial.hand.collision_spheres
    centres = spatial.points(spheres.link_index, spheres.center)
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
    centres = spatial.points(spheres.link_index, spheres.center)
    if world.obstacles is None:
        return torch.full_like(centres[:, 0, 0], math.inf)
    return (world.obstacles.field.query(centres)[0] - spheres.radius.to(centres)).amin(1)
