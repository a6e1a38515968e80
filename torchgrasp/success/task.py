"""The task of a grasp: the loads that it must hold."""

import dataclasses
import functools
import itertools
import math
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Force
from torchgrasp.geometry.frames import apply, real, rotate
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.distribution import Distribution, check_within
from torchgrasp.values.specs import GRAVITY, MASSES


@checked
@dataclasses.dataclass(frozen=True)
class GraspTask(Value):
    """What a grasp must do. The predicted success is the success in this task.

    Args:
        mass: mass [kg] of the object, 0.001 to 10, or its `Distribution`.
        force: normal force [N] of the strongest finger. None means 4 N in pulls. In a lift it means
            as much as the measured load requires.
        lift: True means that the object is lifted off its table. False means pulls. The object
            floats, and is pulled along six directions with a force of 10 m/s^2 times its mass. None
            means a lift if the planner knows the table and the closing is not "open_loop".
        closing: how the hand closes.
            "uncertainty": by touch.
            "open_loop": without sensors, from pre-grasp to grasp to squeeze. The squeeze is joint
              targets with which the fingers press.
        displaced: whether the object may have moved since the camera saw it. In a lift it may have
            moved by up to 30 mm along each of two axes of the table. In pulls it may have moved by
            up to 5 mm along, and 5 degrees about, each of three axes.

    Raises `BadArgument` for a number outside its range, or a lift in open loop.

    >>> GraspTask(mass=0.5, lift=True).describe(), GraspTask(force=7.0, lift=False).describe()
    ('lift of 0.5 kg', 'pulls of 0.25 kg with 7 N')
    """

    mass: Annotated[float, MASSES] | Distribution = 0.25
    force: Force | None = None
    lift: bool | None = None
    closing: Literal["uncertainty", "open_loop"] = "uncertainty"
    displaced: bool = False

    def __post_init__(self) -> None:
        check_within("mass", self.mass, MASSES)
        if self.lift and self.closing == "open_loop":  # no trial has tested it
            raise BadArgument("closing", "'open_loop' for a lift", "'uncertainty'")

    def describe(self) -> str:
        """Return the task as a short text, such as "lift of 0.5 kg".

        The text begins with "lift" or "pulls", or with "task" if the field `lift` is None. It names
        `force` if that is not None. It ends with ", displaced" if the object may have moved
        (`displaced`).
        """
        what = "task" if self.lift is None else "lift" if self.lift else "pulls"
        force = "" if self.force is None else f" with {self.force:g} N"
        return f"{what} of {Distribution.of(self.mass)} kg{force}" + (
            ", displaced" if self.displaced else ""
        )

    @checked
    def updated(self, result: ClosureResult) -> "GraspTask":
        """Return the task of the next grasp, with the mass narrowed to what a lift has measured
        (`ClosureResult.mass`).

        `result` is what `close_hand` returned. Masses that the lift excludes are left out. If none
        is left, the mass is that of the lift. The task is returned as it is in two cases: the lift
        measured no mass, or its status is neither `OK` nor `TOO_HEAVY`.
        """
        felt = result.mass
        if felt is None or result.status not in (Status.OK, Status.TOO_HEAVY):
            return self
        mass = Distribution.of(self.mass)
        if mass.share(felt.least, felt.most) > 0.0:
            mass = mass.given(felt.least, felt.most)
        else:
            mass = felt.clamped(MASSES.low, MASSES.high)
        return dataclasses.replace(self, mass=mass.simplest)

    @checked
    def pressing(self, lifted: bool) -> float:
        """Return the normal force [N] of the strongest finger; 0 if the measured load is to set it.

        The result is the field `force`, if `force` is not None. Otherwise it is 0 for a lift, in
        which the hand presses as much as the measured load requires. For pulls at a floating object
        it is 4 N.

        `lifted` says whether the task is a lift, as `lifts` returns it; False means pulls.
        """
        return self.force or (0.0 if lifted else 4.0)

    @checked
    def lifts(self, table: Plane | None) -> bool:
        """Return whether the task is a lift, for a planner that knows this `table` (None: no
        table).

        The answer is the field `lift`. If that is None, the task is a lift with a `table`, unless
        the closing is "open_loop".
        """
        return table is not None and self.closing != "open_loop" if self.lift is None else self.lift


@dataclasses.dataclass(frozen=True)
class ConditionNumbers:
    """Numbers of frictions and masses that stand for their distributions."""

    one: int = 9
    """Number of frictions, or of masses if the friction is certain. Where success falls from 1 to 0
    in a step, a mean over 9 is off by at most 1/18.
    """
    both: int = 3
    """Number of masses if the friction is uncertain, too: the load matters less."""


CONDITIONS = ConditionNumbers()


@dataclasses.dataclass(frozen=True)
class Conditions:
    """The c pairs of a friction and a mass [kg] for which success is predicted.

    The two are independent. Each of n frictions is paired with each of m masses, so that c = n m.
    """

    friction: Distribution
    mass: Distribution

    @classmethod
    def of(cls, friction: float | Distribution, mass: float | Distribution) -> "Conditions":
        """Return the conditions for a coefficient of friction and a mass [kg], each a number or a
        `Distribution`.
        """
        return cls(Distribution.of(friction), Distribution.of(mass))

    @functools.cached_property
    def frictions(self) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """The n coefficients of friction that stand for its distribution, then their n
        probabilities.
        """
        return self.friction.nodes(CONDITIONS.one)

    @functools.cached_property
    def masses(self) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """The m masses [kg] that stand for their distribution, then their m probabilities."""
        certain = len(self.frictions[0]) == 1
        return self.mass.nodes(CONDITIONS.one if certain else CONDITIONS.both)

    @property
    def weights(self) -> Float[Tensor, "c"]:
        """The probability (c,) of each pair of a friction and a mass. From pair to pair the mass
        changes first.
        """
        return torch.outer(self.frictions[1], self.masses[1]).flatten()


@checked
@dataclasses.dataclass(frozen=True)
class TaskWrenches(Value):
    """The w loads on an object in a task, for the argument `resist` of `plan_grasps`.

    The contacts must balance each load alone.

    Args:
        wrenches: loads (w, 6) on the object in the cloud's frame. First is the force [N], then the
            torque [N m] about `point`. Include the object's weight in each load: the planner does
            not add it.
        point: point (3,) [m] in the cloud's frame; None means the estimated centre of the object.

    Raises `BadArgument` for no load, or a load that is all zeros.

    A jar of 2.5 N, whose lid is turned with 0.1 N m about the vertical, in both directions:

    >>> turn = [0.0, 0.0, -2.5, 0.0, 0.0, 0.1]
    >>> back = [0.0, 0.0, -2.5, 0.0, 0.0, -0.1]
    >>> unscrew = TaskWrenches(torch.tensor([turn, back]))
    """

    wrenches: Float[Tensor, "w 6"]
    point: Float[Tensor, "3"] | None = None

    def __post_init__(self) -> None:
        if not len(self.wrenches) or not bool(self.wrenches.any(1).all()):
            raise BadArgument(
                "wrenches", f"{len(self.wrenches)} wrenches, or one of zeros", "loads of the object"
            )


@dataclasses.dataclass(frozen=True)
class TaskNumbers:
    """Loads of the named tasks, and the directions of pushes."""

    farthest: float = 2.0
    """Greatest distance [m] of the point of a load from the object's centre."""
    push: float = 2.5
    """Force [N] of each push in the named tasks."""
    around: float = 1.24
    """Length (no unit) of vectors along the 14 diagonals and axes of a cube. Their convex hull
    contains the unit ball.
    """
    upward: float = 1.2
    """Component along z of such a vector from which on it counts as straight up. The task "pour"
    leaves these out.
    """


TASKS = TaskNumbers()
TaskName = Literal["lift", "pour", "push"]
Resist = TaskName | tuple[TaskName, ...] | TaskWrenches
"""What contacts must resist: `TaskWrenches`, or names of loads at the estimated centre. Without a
table z points up.

* "lift": the weight.
* "pour": the weight while the object is tilted by up to 120 degrees about any horizontal axis.
* "push": the weight, and 2.5 N in any direction.
"""


def loads_of(
    resist: Resist,
    mass: float,
    center: Float[Tensor, "3"],
    upright_from_obj: Float[Tensor, "4 4"],
    table: bool,
) -> Float[Tensor, "w 6"]:
    """Return the w loads of a task as wrenches: forces [N], then torques [N m] about the upright
    frame's origin.

    Args:
        resist: the loads: names, or `TaskWrenches`. "lift" is the weight. "pour" is the weight
            while the object is tilted by up to 120 degrees. "push" is the weight, and 2.5 N in any
            direction. A tuple of these names joins their loads.
        mass: mass of the object [kg], of a distribution the greatest one.
        center: estimated centre of the object [m] in the upright frame.
        upright_from_obj: transform from the cloud's frame, in which `TaskWrenches` are, to the
            upright frame.
        table: whether a table is known; without one, named loads take the cloud's z axis for up.

    Raises `BadArgument` for a point of `TaskWrenches` more than 2 m (`TASKS.farthest`) from the
    centre: it is in another frame, or in millimetres.
    """
    if isinstance(resist, TaskWrenches):
        vectors = rotate(upright_from_obj, resist.wrenches.to(center).reshape(-1, 3))
        force, torque = vectors.reshape(-1, 6).split(3, -1)
        point = (
            center
            if resist.point is None
            else apply(upright_from_obj, resist.point.to(center)[None])[0]
        )
        away = float(norm(point - center))
        if away > TASKS.farthest:
            found = f"a point {away:.4g} m from the object's centre"
            allowed = f"one within {TASKS.farthest:g} m, in metres and in the frame of the cloud"
            raise BadArgument("resist.point", found, allowed)
    else:
        names = (resist,) if isinstance(resist, str) else resist
        loads = _named_loads(mass)
        force = torch.cat([loads[name] for name in names]).to(center)
        force = force if table else rotate(upright_from_obj, force)
        torque = torch.zeros_like(force)
        point = center
    return torch.cat([force, torque + torch.linalg.cross(point.expand_as(force), force)], -1)


def _named_loads(mass: float) -> dict[str, Float[Tensor, "w 3"]]:
    """Return the forces [N] of each named load on an object of a `mass` [kg], with z up."""
    axes = torch.eye(3, dtype=torch.float64)
    signs = [*itertools.product((-1.0, 1.0), repeat=3)]
    corners = torch.tensor(signs, dtype=torch.float32) / math.sqrt(3)
    # The convex hull of these vectors contains the unit ball.
    around = TASKS.around * torch.cat([corners, axes, -axes])  # (14, 3)
    weight = real([[0.0, 0.0, -GRAVITY * mass]])
    # Without the vector that points up, the hull contains the part of the ball within 120 degrees
    # of straight down.
    return {
        "lift": weight,
        "pour": GRAVITY * mass * around[around[:, 2] < TASKS.upward],
        "push": weight + TASKS.push * around,
    }
