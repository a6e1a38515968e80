"""A whole grasp as a motion among obstacles: approach, closing, lift."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.hand import Hand
from torchgrasp.ik.approach import APPROACH_DISTANCE, COARSE_STEPS
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.obstacles import Obstacles
from torchgrasp.values import Grasps

CLOSING_STEPS = 6
"""Postures from pre-grasp to grasp: fingertips move some 3 mm from one to the next."""
LIFT, LIFT_STEPS = 0.1, 6
"""Length [m] of the lift, and its positions: half a finger's width apart."""


def motion_clearance(
    hand: Hand, configuration: Configuration, pregrasp: Float[Tensor, "g h"], world: CollisionWorld
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of closing and lifting hands from obstacles."""
    assert world.obstacles is not None
    up = torch.tensor([0.0, 0.0, 1.0]) if world.plane is None else world.plane.normal
    centres = torch.cat([_closing(hand, configuration, pregrasp), _lift(hand, configuration, up)], 1)
    return (world.obstacles.field.query(centres)[0] - hand.collision_spheres.radius.to(centres)).flatten(1).amin(1)


def collision_probability(
    hand: Hand, grasps: Grasps, obstacles: Obstacles, up: Float[Tensor, "3"] | None = None
) -> Float[Tensor, "g"]:
    """Return how likely each hand meets something on its approach, while it closes, and on its lift.

    Hidden voxels are full together or free together: the same unseen extent of a thing decides. So the likeliest
    voxel that a hand sweeps counts, not their number. `up` is the direction of the lift; None: z.
    """
    up = torch.tensor([0.0, 0.0, 1.0]) if up is None else up
    configuration = Configuration(grasps.joints, grasps.obj_from_hand)
    opened = _centres(hand, Configuration(grasps.pregrasp, grasps.obj_from_hand))
    back = torch.arange(1, COARSE_STEPS + 1).to(opened) * (APPROACH_DISTANCE / COARSE_STEPS)
    approach = opened[:, None] - back[:, None, None] * grasps.approach[:, None, None]
    closing, lift = _closing(hand, configuration, grasps.pregrasp), _lift(hand, configuration, up)
    centres = torch.cat([approach, closing, lift], 1)
    return obstacles.likelihood(
        centres.flatten(1, 2), hand.collision_spheres.radius.to(centres).repeat(centres.shape[1])
    )


def lift_clearance(vertices: Float[Tensor, "v 3"], obstacles: Obstacles, up: Float[Tensor, "3"] | None = None) -> float:
    """Return the least clearance [m] of a lifted surface from obstacles: far below zero if something lies on it."""
    up = torch.tensor([0.0, 0.0, 1.0]) if up is None else up
    return float(obstacles.field.query(_lifted(vertices, up))[0].min())


def _closing(hand: Hand, configuration: Configuration, pregrasp: Float[Tensor, "g h"]) -> Float[Tensor, "g k s 3"]:
    """Return the spheres' centres [m] while the hand closes, at its pre-grasp and its grasp too."""
    shares = torch.linspace(0, 1, CLOSING_STEPS).tolist()
    postures = [torch.lerp(pregrasp, configuration.joints, share) for share in shares]
    return torch.stack([_centres(hand, Configuration(x, configuration.obj_from_hand)) for x in postures], 1)


def _lift(hand: Hand, configuration: Configuration, up: Float[Tensor, "3"]) -> Float[Tensor, "g k s 3"]:
    """Return the spheres' centres [m] while the hand is lifted."""
    return _lifted(_centres(hand, configuration), up).movedim(0, 1)


def _lifted(points: Float[Tensor, "*b 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "k *b 3"]:
    """Return lifted points [m]."""
    height = torch.arange(1, LIFT_STEPS + 1).to(points) * (LIFT / LIFT_STEPS)
    return points + (height[:, None] * up.to(points)).reshape(-1, *[1] * (points.ndim - 1), 3)


def _centres(hand: Hand, configuration: Configuration) -> Float[Tensor, "g s 3"]:
    """Return the centres [m] of the hand's spheres."""
    spheres = hand.collision_spheres
    return SpatialJacobian.at(hand, configuration).points(spheres.link_index, spheres.center)
