"""A closed hand is pulled at harder and harder: what its fingertips felt meanwhile, and when it lost the object."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.control.closing import UncertaintyClosing
from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.frames import rotation_angle
from torchgrasp.sim.hand import SimulatedHand
from torchgrasp.sim.open import open_scene
from torchgrasp.sim.scene import SceneSpec

if TYPE_CHECKING:
    import trimesh

Holding = Callable[[Observation, float], Float[Tensor, " j"]]
"""What holds a grasped object: joint targets from what the robot knows and the period [s]."""

CLOSING_TIME, PRESSING_TIME = 2.5, 0.5
"""Longest time [s] that closing may take, and the time in which the forces build up before anything pulls."""

MASS = 0.1
"""Of the object [kg]; nothing pulls at it but the disturbance."""

LOST = 0.03
"""Motion [m] of the object's centre in the hand from which on it is lost."""

SAMPLING = 0.1
"""Time [s] between two samples, over which the fingertips' readings are averaged."""

_Row = tuple[Tensor, Tensor, Tensor, float, float, float]
"""Tips, readings, springs, pull, motion and turn at a moment."""


@dataclasses.dataclass(frozen=True)
class Pull(Value):
    """A force on the object along a direction of the world, rising by `rate` [N/s] to `most` [N], for `seconds`."""

    direction: Float[Tensor, "3"]
    rate: float
    most: float
    seconds: float


@dataclasses.dataclass(frozen=True)
class Disturbed(Value):
    """What happened to a grasp: a row every `SAMPLING` seconds since the end of the closing, the last when it was lost.

    Args:
        tips: centres of the fingertips in the hand's frame [m].
        forces: normal forces that the fingertips report [N], averaged.
        springs: stiffness of the grasp [N/m].
        pulled: the force that pulls at the object [N]; 0 while the hand builds up its forces.
        moved: how far the object's centre has moved in the hand since the pull began [m].
        turned: how far the object has turned since then [rad].
        overlap: whether the hand overlapped the object before it closed: then there are no rows.
    """

    tips: Float[Tensor, "t 3 3"]
    forces: Float[Tensor, "t 3"]
    springs: Float[Tensor, "t 3"]
    pulled: Float[Tensor, "t"]
    moved: Float[Tensor, "t"]
    turned: Float[Tensor, "t"]
    overlap: bool

    @property
    def lost(self) -> bool:
        """Whether the object was lost."""
        return self.overlap or float(self.moved[-1]) > LOST


def disturb_grasp(
    reference: ClosingReference,
    mesh: "trimesh.Trimesh",
    parts: "list[trimesh.Trimesh]",
    holding: Callable[[ClosingReference, Observation, Float[Tensor, " j"]], Holding],
    pull: Pull,
    friction: float = 0.8,
    error: Float[Tensor, "4 4"] | None = None,
    seed: int = 0,
) -> Disturbed:
    """Close a hand on a floating object, hold it, and pull at it, in a fresh simulation without gravity.

    Args:
        reference: of the hand and its grasp.
        mesh: the true object [m].
        parts: its convex parts.
        holding: makes what holds the object once it is grasped: `Squeeze`, `Impedance`.
        pull: the disturbance.
        friction: of every contact.
        error: where the hand really stands in its planned frame.
        seed: of the noise of the fingertips.
    """
    hand, planned = reference.hand, reference.obj_from_hand
    stands = planned if error is None else planned @ error
    start = {name: float(q) for name, q in hand.expand(reference.pregrasp).items()}
    scene = open_scene(
        SceneSpec(
            hand.urdf_path, stands.numpy(), start, hand.actuators, tuple(hand.tip_links), mesh, parts, MASS, friction,
            gravity=0.0, travel=0.0, table=False,
        )
    )  # fmt: skip
    rows: list[_Row] = []
    if not scene.penetration() <= 1e-3:
        return _record(rows, overlap=True)
    robot = SimulatedHand(scene, reference, 100.0, torch.Generator().manual_seed(seed))
    reference = robot.reference
    targets = reference.model.expand(reference.pregrasp)
    observation, closing = robot.tick(targets), UncertaintyClosing(reference)
    for _ in range(robot.ticks(CLOSING_TIME)):
        targets = closing(observation, robot.period)
        observation = robot.tick(targets)
        if closing.done:
            break
    hold = holding(reference, observation, targets)
    readings, every, before = torch.zeros(3, dtype=torch.float64), robot.ticks(SAMPLING), scene.object_pose()
    pressing = robot.ticks(PRESSING_TIME)
    for k in range(pressing + robot.ticks(pull.seconds)):
        if k == pressing:
            before = scene.object_pose()
        force = min(max((k - pressing + 1) * robot.period * pull.rate, 0.0), pull.most)
        scene.pull(force * pull.direction.numpy())
        observation = robot.tick(hold(observation, robot.period))
        readings = readings + observation.reading / every
        now = scene.object_pose()
        if not np.isfinite(now).all():
            break
        centre = np.append(scene.centre, 1.0)
        moved = float(np.linalg.norm((now @ centre - before @ centre)[:3]))
        if (k + 1) % every == 0 or moved > LOST:
            turned = float(rotation_angle(torch.from_numpy(before[:3, :3].T @ now[:3, :3])))
            springs = getattr(hold, "springs", torch.full((3,), torch.nan, dtype=torch.float64))
            rows.append((observation.tips, readings, springs, force, moved, turned))
            readings = torch.zeros_like(readings)
            if moved > LOST:
                break
    return _record(rows, overlap=False)


def _record(rows: list[_Row], overlap: bool) -> Disturbed:
    """Return the rows of a disturbance as a value."""
    none = torch.zeros(0, 3, dtype=torch.float64)
    numbers = torch.tensor([row[3:] for row in rows], dtype=torch.float64).reshape(-1, 3)
    return Disturbed(
        tips=torch.stack([row[0] for row in rows]) if rows else torch.zeros(0, 3, 3, dtype=torch.float64),
        forces=torch.stack([row[1] for row in rows]) if rows else none,
        springs=torch.stack([row[2] for row in rows]) if rows else none,
        pulled=numbers[:, 0],
        moved=numbers[:, 1],
        turned=numbers[:, 2],
        overlap=overlap,
    )
