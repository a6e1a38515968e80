"""What a grasp must do, which decides whether it holds."""

import dataclasses
from typing import Annotated, Literal

from torchgrasp.base import Value
from torchgrasp.checks import Force, Range, checked
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.plane import Plane


@checked
@dataclasses.dataclass(frozen=True)
class GraspTask(Value):
    """What a grasp must do. The predicted success is that of this task.

    Args:
        mass: of the object [kg].
        force: normal force [N] of the strongest finger. None: the hand that lifts grips as the felt load asks for, and
            one that is pulled at presses with 4 N.
        lift: whether the object is lifted off its table. Otherwise it floats, and is pulled along six directions with a
            force of 10 m/s^2 times its mass. None means a lift if the planner knows the table, but not in open loop.
        closing: how the hand closes, see `TrialSpec`.
        displaced: whether the object may be elsewhere: up to 30 mm along the table, or 5 mm and 5 degrees if it floats.

    Raises `BadArgument` for a number outside its range, or a lift in open loop.

    >>> GraspTask(mass=0.5, lift=True).describe(), GraspTask(force=7.0, lift=False).describe()
    ('lift of 0.5 kg', 'pulls of 0.25 kg with 7 N')
    """

    mass: Annotated[float, Range(0.001, 10.0)] = 0.25
    force: Force | None = None
    lift: bool | None = None
    closing: Literal["uncertainty", "open_loop"] = "uncertainty"
    displaced: bool = False

    def __post_init__(self) -> None:
        if self.lift and self.closing == "open_loop":  # no trial has tested it
            raise BadArgument("closing", "'open_loop' for a lift", "'uncertainty'")

    def describe(self) -> str:
        """Return the task as text."""
        what = "task" if self.lift is None else "lift" if self.lift else "pulls"
        force = "" if self.force is None else f" with {self.force:g} N"
        return f"{what} of {self.mass:g} kg{force}" + (", displaced" if self.displaced else "")

    @checked
    def pressing(self, lifted: bool) -> float:
        """Return the normal force [N] of the strongest finger; 0 where the hand grips as the felt load asks for."""
        return self.force or (0.0 if lifted else 4.0)

    @checked
    def lifts(self, table: Plane | None) -> bool:
        """Return whether the object is lifted: as `lift` says, or else if there is a table and no open loop."""
        return table is not None and self.closing != "open_loop" if self.lift is None else self.lift
