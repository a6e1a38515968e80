"""What a grasp is asked to do in a trial: pulls or a lift, and the numbers that decide whether it holds."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from torchgrasp.base import Value
from torchgrasp.evaluation import PROTOCOLS, PoseNoise, Protocol

FRICTION, MASS, FORCE = (0.2, 1.0), (0.02, 1.0), (2.0, 10.0)
"""Least and greatest friction, mass [kg] (even in its logarithm) and force [N] of the strongest finger."""

ASIDE, TURNED = 0.03, math.radians(5)
"""Greatest displacement [m] along each axis, and turn [rad] of a floating hand, of the half of trials that err."""

PULL, LIFT = PROTOCOLS["dexgraspbench"], PROTOCOLS["table-lift"]


@dataclasses.dataclass(frozen=True)
class Task(Value):
    """One trial's task.

    Args:
        lift: whether the object is lifted off a table and held without slip; otherwise it floats and is pulled at.
        closing: "uncertainty" or "open_loop".
        friction: at the fingertips, which the planner knows; that of the table is a quarter of it.
        mass: of the object [kg]; the pulls press with 10 m/s^2 times the mass.
        force: of the strongest finger [N]; None: the hand grips as the felt load asks for.
        aside: greatest error of the object's place [m].
    """

    lift: bool
    closing: str
    friction: float
    mass: float
    force: float | None
    aside: float

    @property
    def protocol(self) -> Protocol:
        """The protocol of the trial, in MuJoCo.

        >>> Task(True, "uncertainty", 0.8, 0.25, None, 0.0).protocol.trial.table_friction
        0.2
        """
        changes: dict[str, Any] = {"closing": self.closing, "friction": self.friction, "mass": self.mass}
        if not self.lift:
            noise = PoseNoise(self.aside / 6, TURNED if self.aside else 0.0)  # a floating object is seen from all sides
            found = dataclasses.replace(PULL, noise=noise)
            changes["patch"] = 0.02 / self.friction  # [m], DexGraspBench's
        else:
            found = dataclasses.replace(LIFT, noise=PoseNoise(self.aside), tries=1, criterion="held")
            changes["table_friction"] = self.friction / 4
        return found.with_trial(**changes, force=self.force, simulator="mujoco")

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Task":
        """Return a task, given its fields."""
        return cls(**fields)


def draw_task(draw: np.random.Generator, planned: float) -> Task:
    """Draw the task of one trial of a grasp that was planned for the friction `planned`; half keep this friction.

    >>> draw_task(np.random.default_rng(0), 0.6) == draw_task(np.random.default_rng(0), 0.6)
    True
    """
    lift, kept, errs, grips = draw.random(4) < (0.5, 0.5, 0.5, 0.75)
    friction, force = (round(float(draw.uniform(*bounds)), 3) for bounds in (FRICTION, FORCE))
    mass = round(math.exp(draw.uniform(*np.log(MASS))), 4)
    closing = "uncertainty" if lift or draw.random() < 0.5 else "open_loop"
    gripped = lift and grips
    return Task(
        bool(lift), closing, planned if kept else friction, mass, None if gripped else force, ASIDE if errs else 0.0
    )
