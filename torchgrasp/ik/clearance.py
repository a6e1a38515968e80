"""What the links of a hand must stay clear of: the object, the table, and each other."""

import dataclasses
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.hand.collision_spheres import CollisionSpheres
from torchgrasp.ik.configuration import SpatialJacobian, wrench_of
from torchgrasp.ik.sdf import SignedDistanceField
from torchgrasp.optim import Residuals

MILLIMETRE = 1e-3
CLEARANCE = 4 * MILLIMETRE
"""Clearance [m] that the links are asked to keep of the object and the table; `check` accepts any above zero."""
SELF_CLEARANCE = 1 * MILLIMETRE
"""Clearance [m] that the links are asked to keep of each other."""
WORST = 8
"""How many of the least clearances of each kind enter one step; the others are larger."""


@dataclasses.dataclass(frozen=True)
class CollisionWorld(Value):
    """What the links must not touch: the object's `field` and the height [m] of the `table`, None without one."""

    field: SignedDistanceField | None = None
    table: float | None = None


def hinge(clearance: Float[Tensor, "g k"], jacobian: Float[Tensor, "g k d"], margin: float) -> Residuals:
    """Return max(0, margin - clearance) [mm] and its derivative."""
    active = (clearance < margin).to(clearance)
    return active * (margin - clearance) / MILLIMETRE, -active[..., None] * jacobian / MILLIMETRE


def least(clearance: Float[Tensor, "g s"]) -> Int[Tensor, "g k"]:
    """Return where the `WORST` least clearances of each row are."""
    return clearance.topk(min(WORST, clearance.shape[1]), dim=1, largest=False, sorted=False).indices


def collision_cost(
    centres: Float[Tensor, "*b s 3"], cover: CollisionSpheres, world: CollisionWorld
) -> Float[Tensor, "*b"]:
    """Return the sum of squares [mm2] of what a touching hand's spheres lack of clearance, by the nearest node."""
    radius = cover.radius.to(centres)
    lack = centres.new_zeros(centres.shape[:-2])
    if world.field is not None:
        object_lack = (CLEARANCE + radius - world.field.nearest(centres)) * ~cover.touching
        lack = lack + object_lack.clamp_min(0).square().sum(-1)
    if world.table is not None:
        table_lack = world.table + CLEARANCE * ~cover.touching + radius - centres[..., 2]
        lack = lack + table_lack.clamp_min(0).square().sum(-1)
    return lack / MILLIMETRE**2


def clearance_rows(jacobians: SpatialJacobian, world: CollisionWorld, tips_touch: bool) -> Residuals:
    """Return hinges on the least clearances from the object, from the table and between the links."""
    found = [self_rows(jacobians)]
    if world.field is not None:
        found.append(object_rows(jacobians, world.field, tips_touch))
    if world.table is not None:
        found.append(table_rows(jacobians, world.table, tips_touch))
    residuals, by_hand = zip(*found, strict=True)
    return torch.cat(residuals, 1), torch.cat(by_hand, 1)


def object_rows(jacobians: SpatialJacobian, field: SignedDistanceField, tips_touch: bool) -> Residuals:
    """Return hinges on the least clearances of the links' spheres from the object."""
    cover = jacobians.hand.collision_spheres
    centres = jacobians.points(cover.link_index, cover.center)
    radius = cover.radius.to(centres)
    rough = field.nearest(centres) - radius
    if tips_touch:
        rough = torch.where(cover.touching, math.inf, rough)
    index = least(rough)
    at = torch.arange(len(centres), device=centres.device)[:, None]
    near = centres[at, index]
    distance, gradient = field.query(near)
    clearance = distance - radius[index] + torch.where(torch.isinf(rough[at, index]), 1.0, 0.0)
    return hinge(clearance, jacobians.jacobian(wrench_of(near, gradient), cover.link_index[index]), CLEARANCE)


def table_rows(jacobians: SpatialJacobian, table: float, tips_touch: bool) -> Residuals:
    """Return hinges on the least clearances of the links' spheres from the table."""
    cover = jacobians.hand.collision_spheres
    centres = jacobians.points(cover.link_index, cover.center)
    above = centres[..., 2] - cover.radius.to(centres) - table
    if tips_touch:  # such a tip is where its contact is
        above = above + CLEARANCE * cover.touching
    index = least(above)
    at = torch.arange(len(centres), device=centres.device)[:, None]
    up = torch.tensor([0.0, 0.0, 1.0]).to(centres).expand(*index.shape, 3)
    jacobian = jacobians.jacobian(wrench_of(centres[at, index], up), cover.link_index[index])
    return hinge(above[at, index], jacobian, CLEARANCE)


def self_rows(jacobians: SpatialJacobian) -> Residuals:
    """Return hinges on the least clearances of the links from each other."""
    itself, frames = jacobians.hand.self_collision, jacobians.obj_from_link[:, :, :3].permute(2, 3, 1, 0).contiguous()
    between = itself.separations(frames, SELF_CLEARANCE).T
    index = least(between)
    at = torch.arange(len(index), device=index.device)[:, None].expand_as(index)
    between = between[at, index]
    close = between < SELF_CLEARANCE  # the others' hinges are flat
    apart = between.new_zeros(*index.shape, 6)
    apart[close] = itself.wrenches(frames, index[close], at[close]).T
    first, second = itself.link[itself.pairs[index]].unbind(-1)
    return hinge(between, jacobians.jacobian(apart, second) - jacobians.jacobian(apart, first), SELF_CLEARANCE)


def link_clearance(
    jacobians: SpatialJacobian, world: CollisionWorld, tips_touch: bool
) -> tuple[Float[Tensor, "g"], Float[Tensor, "g"], Float[Tensor, "g"]]:
    """Return the least clearance [m] of the links from the object, of the tips from it, and of both from the table.

    Where the tips are meant to touch, they count in the second figure alone. What is not there is infinitely far.
    """
    cover = jacobians.hand.collision_spheres
    centres = jacobians.points(cover.link_index, cover.center)
    radius = cover.radius.to(centres)
    free = torch.full_like(centres[..., 0], math.inf)
    if world.field is not None:
        free = world.field.query(centres)[0] - radius
    touches = cover.touching
    tips = free[:, touches].amin(1)
    links = free[:, ~touches].amin(1) if tips_touch else free.amin(1)
    if world.table is None:
        table = torch.full_like(tips, math.inf)
    else:
        table = (centres[..., 2] - radius).amin(1) - world.table
    return links, tips, table
