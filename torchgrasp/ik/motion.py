"""Clearance of a grasp's motion: the straight approach of the opened hand, the closing and the
lift.

g counts hands, s their collision spheres. A clearance is negative if there is a collision.
"""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import flatnonzero, row_numbers, spread
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.rules import Poses
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import across, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import (
    CollisionWorld,
    Obstacles,
    is_world_fused,
    level,
    table_clearance,
)
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.values.planning import Grasps

APPROACH_DISTANCE = 0.1  # length [m] of the straight approach: about the depth of a hand
# positions on each candidate path, and on a chosen path
COARSE_STEPS = 8
FINE_STEPS = 16
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32, device="cpu")


@dataclasses.dataclass(frozen=True)
class MotionNumbers:
    """Parameters of the motion of a grasp: pose of the opened hand, approaches and lift."""

    gap: float = 0.001
    """Clearance [m] from the table to which the opened hand is raised, if it would be in the table.
    """
    most: float = 0.03
    """Greatest height [m] by which the opened hand is raised above its pose."""
    tilt: float = math.radians(45)
    """Angle [rad] between the tilted approaches and the hand's own approach axis."""
    tilted: int = 8
    """Number of tilted approaches, at equal angles about this axis."""
    nodes: float = 1.2
    """Largest error of a clearance at the nearest grid node, in grid spacings."""
    closing_steps: int = 6
    """Number of postures of the closing hand that are checked."""
    lift_steps: int = 6
    """Number of heights of the lift that are checked."""
    lift: float = 0.1
    """Height [m] of the lift."""


MOTION = MotionNumbers()


def find_approach(
    hand: Hand, opened: Configuration, world: CollisionWorld
) -> tuple[Float[Tensor, "g 3"], Float[Tensor, "g"]]:
    """Return a unit direction of a straight approach for each opened hand, then the least clearance
    [m] on its path.

    Candidate directions are tried by falling approximate clearance. The first direction without a
    collision is chosen; if there is none, the direction of the largest clearance. Directions are in
    the object's frame, along the motion of the hand. The path is 0.1 m long (`APPROACH_DISTANCE`).
    """
    spheres = hand.collision_spheres
    centres = _centres(hand, opened)
    radius = spheres.radius.to(centres)
    candidates = approach_directions(hand, opened, world.plane)
    tried = [_clearance(centres, radius, d, world, exact=False) for d in candidates.unbind(1)]
    coarse = torch.stack(tried, 1)
    chosen = candidates[:, 0].clone()
    clearance = torch.full_like(coarse[:, 0], -math.inf)
    for choice in torch.argsort(coarse, dim=1, descending=True, stable=True).unbind(1):
        touching = flatnonzero(clearance < 0)
        if not len(touching):
            break
        direction = candidates[touching, choice[touching]]
        exact = _clearance(centres[touching], radius, direction, world.rows(touching), exact=True)
        better = exact > clearance[touching]
        chosen[touching] = torch.where(better[:, None], direction, chosen[touching])
        clearance[touching] = torch.where(better, exact, clearance[touching])
    return chosen, clearance


@checked
def opened_pose(
    hand: Hand,
    joints: Float[Tensor, "g h"],
    obj_from_hand: Poses,
    table: Plane | None,
) -> Float[Tensor, "g 4 4"]:
    """Return the poses (g, 4, 4) [m] at which g opened hands end their approach and begin to close.

    The pose is that of the grasp, unless an opened link would be in the table: coupled fingers can
    move towards the table as they open. Then the pose is raised along the table's normal, until the
    links are 1 mm (`MOTION.gap`) above the table. A hand that would have to rise by more than 30 mm
    (`MOTION.most`) is not raised.

    Args:
        hand: the hand.
        joints: joints (g, h) [rad or m] of the opened hands, such as `Grasps.pregrasp`.
        obj_from_hand: poses (g, 4, 4) [m] of the grasps in the object's frame.
        table: the table in the object's frame; None means that no hand is raised.

    Raises `BadArgument` for poses that are not rigid.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> opened = opened_pose(hand, grasp.pregrasp, grasp.obj_from_hand, grasp.table)
    >>> torch.equal(opened, grasp.obj_from_hand)
    True
    """
    if table is None:
        return obj_from_hand
    gap = MOTION.gap
    centres = apply(obj_from_hand, hand.sphere_centres(joints))
    radius = hand.collision_spheres.radius.to(centres)
    lowest = (level(centres, table) - table.offset - radius).amin(1)
    needed = gap - lowest
    rise = torch.where((lowest < 0) & (needed <= MOTION.most), needed, 0.0)
    pose = obj_from_hand.clone()
    pose[:, :3, 3] += rise[:, None] * table.normal.to(pose)
    return pose


def approach_directions(
    hand: Hand, opened: Configuration, table: Plane | None
) -> Float[Tensor, "g k 3"]:
    """Return k unit candidate directions of each hand's approach, in the object's frame.

    They are the hand's approach axis, 8 directions at 45 degrees to it, and down onto the `table`.
    None means no table, and leaves out the last one.
    """
    pose = opened.obj_from_hand
    axis = unit(hand.approach.to(pose))
    first, second = across(axis)
    number = torch.arange(MOTION.tilted, device="cpu").to(axis)[:, None]
    angle = number * (2 * math.pi / MOTION.tilted)
    sideways = torch.cos(angle) * first + torch.sin(angle) * second
    tilted = math.cos(MOTION.tilt) * axis + math.sin(MOTION.tilt) * sideways  # (k, 3)
    every = torch.cat([axis[None], tilted])
    directions = rotate(pose, every.expand(len(pose), -1, -1))
    if table is None:
        return directions
    # Minus alone would make negative zeros.
    down = (0.0 - table.normal.to(pose)).expand(len(pose), 1, 3)
    return torch.cat([directions, down], 1)


def _clearance(
    centres: Float[Tensor, "g s 3"],
    radius: Float[Tensor, "s"],
    direction: Float[Tensor, "g 3"],
    world: CollisionWorld,
    exact: bool,
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of a hand's spheres on its approach path, `exact` or by the
    nearest grid nodes.
    """
    steps = FINE_STEPS if exact else COARSE_STEPS
    if is_world_fused(world, centres, direction):
        from torchgrasp.ik import fused_path  # it imports numba

        step = APPROACH_DISTANCE / steps
        nodes = MOTION.nodes if exact else 0.0
        return fused_path.sweep(centres, radius, direction, world, steps, step, nodes)
    path = _approach(centres, direction, steps).flatten(1, 2)
    radius = radius.repeat(steps)
    least = torch.full_like(path[:, 0, 0], math.inf)
    for field in world.fields:
        coarse = field.nearest_node(path) - radius
        near, first = coarse.min(1)
        # Only spheres that may have the least clearance are interpolated.
        if exact:
            near = field.query(path[row_numbers(path), first])[0] - radius[first]
            within = near[:, None] + MOTION.nodes * spread(field.spacing, coarse)
            row, sphere = torch.nonzero(coarse < within, as_tuple=True)
            closer = field.rows(row).query(path[row, sphere])[0] - radius[sphere]
            near = near.scatter_reduce(0, row, closer, "amin")
        least = torch.minimum(least, near)
    if world.plane is not None:
        least = torch.minimum(least, table_clearance(path, radius, world.plane))
    return least


def _approach(
    centres: Float[Tensor, "g s 3"], direction: Float[Tensor, "g 3"], steps: int
) -> Float[Tensor, "g k s 3"]:
    """Return the centres [m] of a hand's spheres at k equal steps back along its approach."""
    step = torch.arange(1, steps + 1, device=centres.device).to(centres)
    back = step * (APPROACH_DISTANCE / steps)
    return centres[:, None] - back[:, None, None] * direction[:, None, None]


def motion_clearance(
    hand: Hand, closed: Configuration, opened: Configuration, world: CollisionWorld
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of each hand from obstacles while the hand closes and is
    lifted.

    The lift is along the table's normal, or along z without a table. The `world` must have
    obstacles. `closed` and `opened` are the configurations of the grasp and of the opened hand.
    """
    assert world.obstacles is not None
    up = UP if world.plane is None else world.plane.normal
    centres = torch.cat([_closing(hand, opened, closed), _lift(hand, closed, up)], 1)
    gap = world.obstacles.field.query(centres)[0] - hand.collision_spheres.radius.to(centres)
    return gap.flatten(1).amin(1)


@checked
def collision_probability(
    hand: Hand, grasps: Grasps, obstacles: Obstacles, table: Plane | None
) -> Float[Tensor, "g"]:
    """Return the probability in [0, 1], for each of g grasps, that its hand hits one of the
    `obstacles`.

    The hand approaches opened, closes, and is lifted along the table's normal, or along z without a
    table. The probability is the largest occupancy probability of the voxels that it sweeps. Hidden
    voxels behind one object are occupied or free together. The approach ends in the pose of
    `opened_pose`, which is raised where the hand would be in the `table`. None means no table.
    """
    closed = Configuration(grasps.joints, grasps.obj_from_hand)
    raised = opened_pose(hand, grasps.pregrasp, grasps.obj_from_hand, table)
    opened = Configuration(grasps.pregrasp, raised)
    approach = _approach(_centres(hand, opened), grasps.approach, COARSE_STEPS)
    up = UP if table is None else table.normal
    centres = torch.cat([approach, _closing(hand, opened, closed), _lift(hand, closed, up)], 1)
    radius = hand.collision_spheres.radius.to(centres).repeat(centres.shape[1])
    return obstacles.likelihood(centres.flatten(1, 2), radius)


@checked
def lift_clearance(vertices: Float[Tensor, "v 3"], obstacles: Obstacles) -> float:
    """Return the least clearance [m] of the lifted object from obstacles; far below 0 if an
    obstacle is on it.

    `vertices` [m] are those of the object, in the frame of the obstacles. The object is lifted
    along z by 0.1 m (`MOTION.lift`). Without vertices the clearance is infinite.
    """
    if not len(vertices):
        return math.inf
    return float(obstacles.field.query(_lifted(vertices, UP))[0].min())


def _closing(hand: Hand, opened: Configuration, closed: Configuration) -> Float[Tensor, "g k s 3"]:
    """Return the centres [m] of the collision spheres while a hand closes and goes down, at k equal
    steps.
    """
    # Equal rotations of each joint.
    shares = torch.linspace(0, 1, MOTION.closing_steps, dtype=torch.float32, device="cpu").tolist()
    ends = (opened.joints, closed.joints)
    poses = (opened.obj_from_hand, closed.obj_from_hand)
    postures = [
        Configuration(torch.lerp(*ends, share), torch.lerp(*poses, share)) for share in shares
    ]
    return torch.stack([_centres(hand, posture) for posture in postures], 1)


def _lift(
    hand: Hand, configuration: Configuration, up: Float[Tensor, "3"]
) -> Float[Tensor, "g k s 3"]:
    """Return the centres [m] of the collision spheres at k heights while the hand is lifted along
    `up`.
    """
    return _lifted(_centres(hand, configuration), up).movedim(0, 1)


def _lifted(points: Float[Tensor, "*b 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "k *b 3"]:
    """Return points [m] at k heights of a lift along `up`."""
    count = MOTION.lift_steps
    height = torch.arange(1, count + 1, device="cpu").to(points) * (MOTION.lift / count)
    rise = height[:, None] * up.to(points)
    return points + rise.reshape(-1, *[1] * (points.ndim - 1), 3)


def _centres(hand: Hand, configuration: Configuration) -> Float[Tensor, "g s 3"]:
    """Return the centres [m] of the hand's collision spheres in the object's frame."""
    return SpatialJacobian.at(hand, configuration).sphere_centres
