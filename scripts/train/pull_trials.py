"""A closed hand is pulled at harder and harder: what its fingertips felt, and when it lost the
object.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import Observation, Targets
from torchgrasp.control.uncertainty_closing import UncertaintyClosing
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver, TrialRun
from torchgrasp.foundation.base import Value
from torchgrasp.geometry.frames import rotation_angle
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.specs import TrialSpec

Step = Callable[[Observation, float], Float[Tensor, " j"]]
"""Joint targets from an observation and the period [s]."""

Holding = Callable[[ClosingReference, Observation, Float[Tensor, " j"]], Step]
"""Makes what holds a grasped object, from the last observation and targets of the closing."""

CLOSING_TIME = 2.5
PRESSING_TIME = 0.5
"""Longest time [s] of the closing: fingers that touch are done by then. Time [s] in which the
forces build up.
"""

MASS = 0.1
"""Mass of the object [kg]: nothing pulls at it but the disturbance."""

LOST_DISTANCE = 0.03
"""Motion [m] of the object's centre that counts as lost: a fingertip and a half."""

SAMPLE_TIME = 0.1
"""Time [s] between two samples, over which the fingertips' readings are averaged."""


@dataclasses.dataclass(frozen=True)
class RisingPull(Value):
    """A force on the object in a direction of the world: it rises by `rate` [N/s] to `most` [N],
    for `seconds`.
    """

    direction: Float[Tensor, "3"]
    rate: float
    most: float
    seconds: float

    def force(self, time: float) -> float:
        """Return the force [N] at a time [s]; 0 before the start."""
        return min(max(time * self.rate, 0.0), self.most)


@dataclasses.dataclass(frozen=True)
class PullRecord(Value):
    """One row every `SAMPLE_TIME` seconds since the end of the closing; the last row is that of the
    loss.

    Args:
        tips: centres of the fingertips in the hand's frame [m].
        forces: mean normal forces that the fingertips report [N].
        springs: stiffness of the grasp [N/m]; NaN where the holding has none.
        pulled: force on the object [N]; 0 while the hand builds up its forces.
        moved: motion of the object's centre since the pull began [m].
        turned: rotation of the object since then [rad].
        overlap: whether the hand overlapped the object before it closed; then there are no rows.
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
        return self.overlap or float(self.moved[-1]) > LOST_DISTANCE


def pull_until_lost(
    trial: GraspTrial,
    reference: ClosingReference,
    holding: Holding,
    pull: RisingPull,
    friction: float = 0.8,
) -> PullRecord:
    """Close a hand on a floating object, hold the object and pull at it, in a fresh simulation
    without gravity.

    Args:
        trial: what is tried.
        reference: what the hand follows; its forces may be others than the trial's own.
        holding: `ForceHold`, `Impedance`.
        pull: at the object.
        friction: of every contact.
    """
    spec = TrialSpec(
        mass=MASS, friction=friction, gravity=0.0, approach=0.0, lift_height=0.0, table=False
    )
    run = TrialDriver(trial, spec, reference).open()
    return _record(_pull(run, holding, pull) if run.starts else [], overlap=not run.starts)


def _pull(
    run: TrialRun, holding: Holding, pull: RisingPull
) -> list[tuple[Tensor, Tensor, Tensor, list[float]]]:
    """Return tips, readings, springs, and pull, motion and rotation of every sample."""
    robot = run.robot
    scene = run.scene
    rows = []
    observation, hold = _close(run, holding)
    readings = torch.zeros(3, dtype=torch.float64)
    every = robot.ticks(SAMPLE_TIME)
    start = scene.object_pose()
    centre = np.append(scene.centre, 1.0)
    pressing = robot.ticks(PRESSING_TIME)
    for k in range(pressing + robot.ticks(pull.seconds)):
        if k == pressing:
            start = scene.object_pose()
        force = pull.force((k - pressing + 1) * robot.period)
        scene.pull(force * pull.direction.numpy())
        observation = robot.tick(Targets(hold(observation, robot.period)))
        readings = readings + observation.tactile.reading / every
        pose = scene.object_pose()
        if not np.isfinite(pose).all():
            break
        moved = float(np.linalg.norm((pose @ centre - start @ centre)[:3]))
        if (k + 1) % every == 0 or moved > LOST_DISTANCE:
            turned = float(rotation_angle(torch.from_numpy(start[:3, :3].T @ pose[:3, :3])))
            springs = getattr(hold, "springs", torch.full((3,), torch.nan, dtype=torch.float64))
            rows.append((observation.tips, readings, springs, [force, moved, turned]))
            readings = torch.zeros_like(readings)
            if moved > LOST_DISTANCE:
                break
    return rows


def _close(run: TrialRun, holding: Holding) -> tuple[Observation, Step]:
    """Close under the law, and return the last observation and what holds from then on."""
    robot = run.robot
    targets = run.controller.targets.joints
    observation = robot.tick(Targets(targets))
    closing = UncertaintyClosing(robot.reference, ClosingOptions())
    for _ in range(robot.ticks(CLOSING_TIME)):
        targets = closing(observation, robot.period)
        observation = robot.tick(Targets(targets))
        if closing.done:
            break
    return observation, holding(robot.reference, observation, targets)


def _record(rows: list[tuple[Tensor, Tensor, Tensor, list[float]]], overlap: bool) -> PullRecord:
    """Return the samples as a value."""
    if not rows:
        none = torch.zeros(0, 3, dtype=torch.float64)
        return PullRecord(
            none[..., None].expand(0, 3, 3), none, none, none[:, 0], none[:, 0], none[:, 0], overlap
        )
    tips, forces, springs = (torch.stack(column) for column in list(zip(*rows, strict=True))[:3])
    pulled, moved, turned = torch.tensor([row[3] for row in rows], dtype=torch.float64).unbind(1)
    return PullRecord(tips, forces, springs, pulled, moved, turned, overlap)
