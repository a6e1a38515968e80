"""What a grasp is asked to do in a trial: pulls or a lift. Also the numbers that decide whether it
holds.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from torchgrasp.evaluation import PROTOCOLS, PoseNoise, Protocol
from torchgrasp.evaluation.protocols import POSE_NOISE
from torchgrasp.foundation.base import Value
from torchgrasp.success.task import GraspTask
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import ClosingMode

FRICTION = (0.12, 1.2)
MASS = (0.02, 1.0)
FORCE = (2.0, 10.0)
"""Least and greatest friction, mass [kg] and force [N] of the strongest finger. Friction and mass
are even in their logarithm: wet glass to rubber.
"""

ORDINARY_FRICTION = (0.3, 1.0)
ORDINARY_MASS = (0.02, 0.25)
ORDINARY_FORCE = (4.0, 10.0)
"""The same of the tasks for which a promise is made."""

PULL = PROTOCOLS["dexgraspbench"]
LIFT = PROTOCOLS["table-lift"]

ASIDE = PoseNoise(0.03)
"""Greatest error of the place of a lifted object; a floating one errs as in protocol "pose-noise".
"""


@dataclasses.dataclass(frozen=True)
class Task(Value):
    """The task of one simulated trial of a grasp.

    Args:
        lift: whether the object is lifted off a table and held without slip; otherwise it floats
            and is pulled at.
        closing: "uncertainty" or "open_loop".
        friction: at the fingertips; that of the table is in the same proportion to it as in
            protocol "table-lift".
        mass: of the object [kg]; the pulls press with 10 m/s^2 times the mass.
        force: of the strongest finger [N]; None: the hand grips as the felt load asks for.
        errs: whether the object is not where the planner saw it.
    """

    lift: bool
    closing: ClosingMode
    friction: float
    mass: float
    force: float | None
    errs: bool

    def pressing(self, force: float) -> "Task":
        """Return the task with another force [N] of the strongest finger, unless the hand grips.

        The hand grips if the task's own force is None.
        """
        return self if self.force is None else dataclasses.replace(self, force=force)

    @property
    def known(self) -> GraspTask:
        """The task as the planner takes it: mass, force, lift, way to close, and displacement."""
        closing = "open_loop" if self.closing == "open_loop" else "uncertainty"
        return GraspTask(self.mass, self.force, self.lift, closing, self.errs)

    @property
    def protocol(self) -> Protocol:
        """The protocol of the trial, in MuJoCo.

        >>> Task(True, "uncertainty", 0.8, 0.25, None, False).protocol.trial.table_friction
        0.2
        """
        base = LIFT if self.lift else PULL
        error = ASIDE if self.lift else POSE_NOISE
        trial = base.trial
        planned = Distribution.of(trial.friction).mean
        changes: dict[str, Any] = {"closing": self.closing, "mass": self.mass, "force": self.force}
        if trial.table_friction is not None:
            changes["table_friction"] = trial.table_friction / planned * self.friction
        # friction times patch resists torsion
        changes["patch"] = trial.patch * planned / self.friction
        noise = error if self.errs else PoseNoise()
        found = dataclasses.replace(base, noise=noise, tries=1, criterion="held")
        return found.with_trial(**changes, friction=self.friction, simulator="mujoco")


def draw_friction(draw: np.random.Generator) -> float:
    """Draw a friction coefficient; its logarithm is uniform between those of the limits `FRICTION`.

    >>> FRICTION[0] <= draw_friction(np.random.default_rng(0)) <= FRICTION[1]
    True
    """
    return round(math.exp(draw.uniform(*np.log(FRICTION))), 3)


def draw_ordinary(draw: np.random.Generator, planned: float) -> Task:
    """Draw the task of a grasp for which a promise is made. It has the planned friction, and the
    object is where the planner saw it.

    >>> draw_ordinary(np.random.default_rng(0), 0.6).mass <= ORDINARY_MASS[1]
    True
    """
    mass = round(math.exp(draw.uniform(*np.log(ORDINARY_MASS))), 4)
    force = round(float(draw.uniform(*ORDINARY_FORCE)), 3)
    task = draw_task(draw, planned).pressing(force)
    return dataclasses.replace(task, friction=planned, mass=mass, errs=False)


def draw_task(draw: np.random.Generator, planned: float) -> Task:
    """Draw the task of one trial of a grasp that was planned for the friction `planned`.

    Half of all tasks have this friction, the others a random one.

    >>> draw_task(np.random.default_rng(0), 0.6) == draw_task(np.random.default_rng(0), 0.6)
    True
    """
    # a lift takes three times as long as pulls
    lift, kept, errs, grips = draw.random(4) < (0.25, 0.5, 0.5, 0.75)
    friction = draw_friction(draw)
    force = round(float(draw.uniform(*FORCE)), 3)
    mass = round(math.exp(draw.uniform(*np.log(MASS))), 4)
    closing = "uncertainty" if lift or draw.random() < 0.5 else "open_loop"
    asked = planned if kept else friction
    pressing = None if lift and grips else force
    return Task(bool(lift), closing, asked, mass, pressing, bool(errs))
