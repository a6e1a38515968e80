"""The collision world, and clearances of a hand's links: from object, table, obstacles and each
other.

Positions [m] are in the object's frame. g counts hands, s their collision spheres.
"""

import dataclasses
import math
from functools import cached_property
from typing import Annotated, TypeGuard

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, row_numbers, settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.lazy import ndimage
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.geometry.signed_distance import DistanceField, SignedDistanceField
from torchgrasp.hand.collision_shapes import CollisionSpheres
from torchgrasp.ik.configuration import ResidualRows, SpatialJacobian
from torchgrasp.scene.occupancy import Occupancy

MILLIMETRE = 1e-3  # unit [m] of all residuals
CLEARANCE = 4 * MILLIMETRE  # clearance [m] of links from object and table that refinement aims at
SELF_CLEARANCE = 1 * MILLIMETRE  # the same between links, whose shapes are exact
HINGES = 8  # number of least clearances of each kind that enter one step
LEVELS = (0.1, 0.5, 0.8)  # probabilities of occupancy whose regions are told apart


@checked
@dataclasses.dataclass(frozen=True)
class Obstacles(Value):
    """Regions of a scene that are probably occupied, as grids of distances; `Obstacles.of` makes
    them.

    The grids are in the frame of the `Occupancy`, which must be that of the object.

    Attributes:
        field: signed distances [m] from the region that counts as occupied, negative inside.
        distances: distances (k, x, y, z) [m] at the nodes of `field`, one grid for each of the
            `levels`. They are from the region that is occupied with at least this probability, and
            0 inside it.
        levels: k probabilities (k,), ascending.
        hard: whether links must not touch the occupied region. Otherwise a collision only lowers
            the predicted success.

    >>> from torchgrasp import load_scene
    >>> from torchgrasp.scene import estimate_occupancy
    >>> Obstacles.of(estimate_occupancy(load_scene(), 1)).levels.tolist()
    [0.1, 0.3, 0.5, 0.8]
    """

    field: SignedDistanceField
    distances: Float[Tensor, "k x y z"]
    levels: Float[Tensor, "k"]
    hard: bool = True

    @classmethod
    @checked
    def of(
        cls, occupancy: Occupancy, full: Annotated[float, Range(0.01, 1.0)] = 0.3, hard: bool = True
    ) -> "Obstacles | None":
        """Return the obstacles of an occupancy grid; None if all its voxels are probably free.

        A voxel is probably free if its probability of occupancy is below 0.1, and below `full`.

        Args:
            occupancy: the grid, from `estimate_occupancy`.
            full: probability from which a voxel counts as occupied, in [0.01, 1].
            hard: whether links must not touch occupied voxels. Otherwise a collision only lowers
                the predicted success.

        Raises `BadArgument` for a `full` out of range.
        """
        # SciPy's distances
        device = occupancy.origin.device
        occupancy = settle(occupancy, torch.device("cpu"))
        probability = occupancy.probability
        levels = sorted({*LEVELS, full})
        if not (probability >= levels[0]).any():
            return None
        distances = torch.stack(
            [distance_to(probability >= level, occupancy.spacing) for level in levels]
        )
        outside = distances[levels.index(full)]
        inside = distance_to(probability < full, occupancy.spacing)
        field = SignedDistanceField(occupancy.origin.double(), occupancy.spacing, outside - inside)
        return cls(field, distances.float(), real(levels), hard).to(device)

    @checked
    def likelihood(
        self, centres: Float[Tensor, "*b s 3"], radius: Float[Tensor, "s"]
    ) -> Float[Tensor, "*b"]:
        """Return the probability (*b,) with which each set of s spheres touches something occupied.

        The region of a level L is where the probability of occupancy is at least L. If the spheres
        touch this region, but not that of the next level M, the result is (L + M) / 2. After the
        last level, M is 1. The result is 0 if no region is touched. b stands for any batch axes.

        Args:
            centres: centres (*b, s, 3) [m] of the spheres, in the frame of `field`.
            radius: radius (s,) [m] of each sphere.
        """
        met = centres.new_zeros(centres.shape[:-2])
        levels = [*self.levels.tolist(), 1.0]
        for low, high, values in zip(levels, levels[1:], self.distances, strict=False):
            hit = dataclasses.replace(self.field, values=values).nearest_node(centres) < radius
            met = torch.where(hit.any(-1), (low + high) / 2, met)
        return met


def distance_to(region: Bool[Tensor, "x y z"], spacing: float) -> Float[Tensor, "x y z"]:
    """Return the distance [m] of each voxel's centre from a `region` of voxels: 0 inside it.

    `spacing` [m] is the edge of a voxel. For an empty region the distance is larger than the grid.
    """
    if not region.any():
        far = spacing * sum(region.shape)
        return torch.full(region.shape, far, dtype=torch.float64, device="cpu")
    steps = torch.from_numpy(np.asarray(ndimage.distance_transform_edt(~region.numpy())))
    return (spacing * (steps - 0.5)).clamp_min(0.0)


@checked
@dataclasses.dataclass(frozen=True)
class CollisionWorld(Value):
    """What the links of a hand must not touch, in the frame of the object. A part that is None does
    not exist.

    Args:
        field: signed distances [m] from the object, negative inside. If all hands of a batch have
            the same object, it is a `SignedDistanceField`, as `surface_field` makes it. If each
            hand has its own object, as in the planner, it is a
            `torchgrasp.geometry.field_batch.FieldBatch`.
        table: the table's plane, or its height [m] along z.
        obstacles: other bodies of a scene.

    Raises `BadArgument` for a table that is neither a plane nor a height.

    >>> CollisionWorld(table=0.02).plane.offset
    0.02
    """

    field: DistanceField | None = None
    table: Plane | float | None = None
    obstacles: Obstacles | None = None

    def __post_init__(self) -> None:
        as_plane(self.table)

    @cached_property
    def plane(self) -> Plane | None:
        """The table as a plane, on the device of the distance fields; None without a table."""
        plane = as_plane(self.table)
        if plane is None or not self.fields:
            return plane
        return settle(plane, self.fields[0].nodes.device)

    @property
    def fields(self) -> tuple[DistanceField, ...]:
        """The distance fields that exist: that of the object, then that of the obstacles."""
        return tuple(
            x for x in (self.field, self.obstacles and self.obstacles.field) if x is not None
        )

    @property
    def alone(self) -> "CollisionWorld":
        """The same world without its obstacles: only the object and the table."""
        return dataclasses.replace(self, obstacles=None)

    @checked
    def rows(self, index: Int[Tensor, "k"]) -> "CollisionWorld":
        """Return the world of some hands of a batch: those with the indices `index` (k,), in this
        order.

        A world of one object for all hands is returned unchanged.
        """
        if self.field is None or isinstance(self.field, SignedDistanceField):
            return self
        return dataclasses.replace(self, field=self.field.rows(index))

    @property
    def guarded(self) -> bool:
        """Whether there are obstacles, and links must not touch them (`Obstacles.hard`)."""
        return self.obstacles is not None and self.obstacles.hard


def is_world_fused(world: CollisionWorld | None, *tensors: Tensor) -> TypeGuard[CollisionWorld]:
    """Return whether compiled loops can compute clearances of hands from a `world`.

    They can with one object for all hands, a table without edge, and `tensors` in float64 on the
    CPU. Without a world (None) they cannot.
    """
    if world is None or not is_fused(*tensors):
        return False
    fields = [isinstance(x, SignedDistanceField) and is_fused(x.nodes) for x in world.fields]
    return all(fields) and (world.plane is None or world.plane.edge is None)


def level(points: Float[Tensor, "*b 3"], table: Plane) -> Float[Tensor, "*b"]:
    """Return the clearance [m] of each of `points` [m] from a `table`, plus the table's offset.

    Points and table are in one frame, and the offset is the plane's distance from its origin. So
    without an edge the results are coordinates along the table's normal. With an edge, a clearance
    is the height above the table or the distance beyond the edge, whichever is greater. `*b` stands
    for any leading axes.
    """
    height = points @ table.normal.to(points)
    if table.edge is None:
        return height
    return torch.maximum(height, table.offset + table.edge.height(points))


def away(points: Float[Tensor, "*b 3"], table: Plane) -> Float[Tensor, "*b 3"]:
    """Return the unit direction in which the clearance of each of `points` [m] from a `table`
    grows: its gradient (*b, 3).

    Points and directions are in the frame of the table. It is the table's normal. Where a point is
    farther beyond the table's edge than above the table, it is the edge's outward normal.
    """
    normal = table.normal.to(points).expand_as(points)
    if table.edge is None:
        return normal
    nearer = table.edge.height(points) > table.height(points)
    return torch.where(nearer[..., None], table.edge.normal.to(points), normal)


def table_clearance(
    centres: Float[Tensor, "*b s 3"], radius: Float[Tensor, "s"], table: Plane
) -> Float[Tensor, "*b"]:
    """Return the least clearance (*b,) [m] of s spheres from a `table`, negative if one is in the
    table.

    `centres` [m] are in the table's frame, and `radius` [m] holds the spheres' radii. `*b` stands
    for any leading axes.
    """
    return (level(centres, table) - radius).amin(-1) - table.offset


def collision_cost(
    centres: Float[Tensor, "*b s 3"], spheres: CollisionSpheres, world: CollisionWorld
) -> Float[Tensor, "*b"]:
    """Return the collision cost (*b,) [mm2] of each hand: the sum of the squared amounts by which
    clearances are below 4 mm (`CLEARANCE`).

    The clearances are those of the hand's spheres from object, obstacles and table, by the nearest
    grid nodes. Fingertips may touch the object and the table. `*b` stands for any leading axes.
    `centres` [m] are those of the hand's `spheres`, in the object's frame.
    """
    radius = spheres.radius.to(centres)
    cost = centres.new_zeros(centres.shape[:-2])
    for field in world.fields:
        deficit = CLEARANCE + radius - field.nearest_node(centres)
        if field is world.field:
            deficit *= ~spheres.touching
        cost = cost + deficit.clamp_min_(0).square_().sum(-1)
    if world.plane is not None:
        wanted = world.plane.offset + CLEARANCE * ~spheres.touching + radius
        deficit = wanted - level(centres, world.plane)
        cost = cost + deficit.clamp_min_(0).square_().sum(-1)
    return cost / MILLIMETRE**2


def clearance_rows(
    spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool
) -> list[ResidualRows]:
    """Return two groups of residuals (g, k) [mm]: by how much the smallest clearances of g hands
    are below the wanted ones.

    The first group is of clearances between links, of which 1 mm (`SELF_CLEARANCE`) is wanted. The
    second is of those from object, obstacles and table, of which 4 mm (`CLEARANCE`) is wanted. It
    is missing for an empty world. A larger clearance gives 0. The 8 (`HINGES`) smallest clearances
    of each kind enter. `spatial` holds the kinematics of the hands. With `tips_touch` the
    fingertips may touch the object and the table.
    """
    pairs = spatial.hand.self_collision
    moves = spatial.hand.motion.moves
    # the pairs of links that are nearest to each other
    separation, number, wrench = pairs.pushes(spatial.obj_from_link, SELF_CLEARANCE)
    count = min(HINGES, len(pairs.pairs))
    separation, index = separation.T.topk(count, dim=1, largest=False, sorted=False)
    wrench = wrench.T[number.T.gather(1, index)] / -MILLIMETRE
    first, second = moves[pairs.link[pairs.pairs]].to(wrench).unbind(1)
    lack = (SELF_CLEARANCE - separation).clamp_min(0) / MILLIMETRE
    between = ResidualRows(lack, wrench, (second - first)[index])
    return [between, *sphere_rows(spatial, world, tips_touch)]


def sphere_rows(
    spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool
) -> list[ResidualRows]:
    """Return one group of residuals (g, k) [mm]: by how much clearances from object, obstacles and
    table are below 4 mm (`CLEARANCE`).

    The list is empty for an empty world. A larger clearance gives 0. The 8 (`HINGES`) smallest
    clearances of each of g hands from each of the three enter. `spatial` holds the kinematics of
    the hands. With `tips_touch` the fingertips may touch the object and the table.
    """
    spheres = spatial.hand.collision_spheres
    motion = spatial.hand.motion
    centres = spatial.sphere_centres
    radius = spheres.radius.to(centres)
    # approximate clearances of all spheres from each part of the world tell which ones count
    found = []
    for field in world.fields:
        coarse = field.nearest_node(centres) - radius
        if tips_touch and field is world.field:
            coarse = torch.where(spheres.touching, math.inf, coarse)
        found.append(coarse)
    if world.plane is not None:
        height = level(centres, world.plane) - radius - world.plane.offset
        # contacts tell how low tips are
        if tips_touch:
            height = torch.where(spheres.touching, height + CLEARANCE, height)
        found.append(height)
    if not found:
        return []
    count = min(HINGES, len(radius))
    coarse, index = torch.stack(found, 1).topk(count, dim=2, largest=False, sorted=False)
    points = centres[row_numbers(centres)[:, None, None], index]  # (g, parts, k, 3)
    # exact clearances of these, and the directions in which they grow
    clearance = []
    direction = []
    for k, field in enumerate(world.fields):
        distance, gradient = field.query(points[:, k])
        left_out = torch.isinf(coarse[:, k]).to(distance)
        clearance.append(distance - radius[index[:, k]] + left_out)
        direction.append(gradient)
    if world.plane is not None:
        clearance.append(coarse[:, -1])
        direction.append(away(points[:, -1], world.plane))
    clearance = torch.cat(clearance, 1)
    direction = torch.cat(direction, 1)
    direction = direction * ((clearance < CLEARANCE).to(centres) / -MILLIMETRE)[..., None]
    torque = torch.linalg.cross(points.flatten(1, 2), direction)
    wrench = torch.cat([direction, torque], -1)
    moves = motion.moves[spheres.link_index].to(centres)[index.flatten(1)]
    return [ResidualRows((CLEARANCE - clearance).clamp_min(0) / MILLIMETRE, wrench, moves)]


def link_clearance(
    spatial: SpatialJacobian, world: CollisionWorld, tips_touch: bool
) -> list[Float[Tensor, "g"]]:
    """Return three least clearances (g,) [m] of each of g hands: of links from the object, of tips
    from the object, of all links from the table.

    With `tips_touch`, the first one leaves out the tips. Without an object the first two are
    infinite, without a table the third. `spatial` holds the kinematics of the hands.
    """
    spheres = spatial.hand.collision_spheres
    centres = spatial.sphere_centres
    radius = spheres.radius.to(centres)
    clearance = torch.full_like(centres[..., 0], math.inf)
    if world.field is not None:
        clearance = world.field.query(centres)[0] - radius
    tips = clearance[:, spheres.touching].amin(1)
    links = clearance[:, ~spheres.touching].amin(1) if tips_touch else clearance.amin(1)
    if world.plane is None:
        return [links, tips, torch.full_like(tips, math.inf)]
    return [links, tips, table_clearance(centres, radius, world.plane)]
