"""A low box near the edge of its table, one view of it, and plans to drag it to the edge, made once."""

import functools
from typing import NamedTuple

import torch

from tests.make import box, load_hand, real
from torchgrasp import ContactSpec, Plane
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.geometry.linalg import unit
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.edge import EdgePlan, plan_edge_grasps

SIZE = 0.12, 0.06, 0.01
"""Lengths [m] of the box, which stands on z = 0 at the origin."""
BOX = box(SIZE)
VIEW = partial_view(BOX, look_at(60.0, 35.0, target=BOX), seed=1).to(torch.float64)
OUTWARD = unit(real([1.0, 0.2, 0.0]))
DISTANCE = 0.127
"""Distance [m] of the box's centre from the edge."""
FRICTION = 0.6
TABLE_FRICTION = 0.2
MASS = 0.25
"""The mass [kg] of `GraspTask()`."""


def ending(distance: float) -> Plane:
    """The table with its edge at a distance [m] from the box's centre."""
    return Plane.horizontal(0.0).ending(distance * OUTWARD, OUTWARD)


class Dragged(NamedTuple):
    """A hand, and its plan for the box."""

    hand: Hand
    plan: EdgePlan


@functools.cache
def dragged(name: str) -> Dragged:
    """The plan of a hand."""
    hand = load_hand(name)
    spec = ContactSpec(FRICTION, table=ending(DISTANCE))
    plan = plan_edge_grasps(VIEW, hand, spec, starts=32, table_friction=TABLE_FRICTION)
    return Dragged(hand, plan)
