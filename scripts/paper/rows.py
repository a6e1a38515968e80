"""The values of the tables: what is planned and lifted in a row, what a campaign is made of, and
what came of it.
"""

import dataclasses
import math
from pathlib import Path
from typing import Literal, NamedTuple

from torchgrasp.evaluation.protocols import seed_of
from torchgrasp.foundation.base import Value, check_whole
from torchgrasp.foundation.errors import Status
from torchgrasp.values.specs import ClosingMode, ContactSpec, HoldingMode, Mode

Support = Literal["camera", "paper"]
Order = Literal["success", "certain", "risky"]
"""Which executable grasp comes first: the likeliest success, or the least or greatest sum of
variances (Sec. 6.5).
"""


@dataclasses.dataclass(frozen=True)
class Plan(Value):
    """How grasps are planned: `mode` of `plan_grasps`, support of the shape, and the problem of the
    contacts.

    `margins` are the library's (`ContactSpec`); without them the problem is the paper's. `variance`
    is S_thresh; None: that of the problem.
    """

    mode: Mode = "joint"
    support: Support = "camera"
    margins: bool = True
    variance: float | None = None

    def contacts(self) -> ContactSpec:
        """Return the problem, for an object that stands on a table at z = 0."""
        spec = dataclasses.replace(
            ContactSpec() if self.margins else ContactSpec.paper(), table=0.0
        )
        return (
            spec if self.variance is None else dataclasses.replace(spec, max_variance=self.variance)
        )


@dataclasses.dataclass(frozen=True)
class Row(Value):
    """A row of a table: its name, how grasps are planned, which come first, and how the hand closes
    and holds.

    With a `risk`, grasps take part whose contacts lack force closure at the planned friction with at
    most this probability, by the uncertain shape. Then `first="risky"` is by this probability.
    """

    name: str
    plan: Plan
    first: Order
    closing: ClosingMode
    holding: HoldingMode
    risk: float | None = None


@dataclasses.dataclass(frozen=True)
class TableSpec(Value):
    """What a table is made of. A campaign that is stopped goes on where it was, if it is called
    again alike.

    Args:
        out: folder of the results, and of the plans and cells that are kept. After a change of the
            code, take another.
        objects: folders of objects with noisy views, besides the library's own.
        hands: by name.
        only: names of objects to keep; by default all.
        own: whether the library's own objects take part.
        representatives: take one object of each family, the first by name.
        finished: make the table of the objects that an earlier call has finished, and run nothing.
        views: views of each object.
        grasps: grasps of each view.
        draws: lifts of each grasp, with an error of the pose each.
        starts: of the contact planner.
        by_risk: the rows have levels of risk in place of S_thresh.
        workers: processes; the results do not depend on their number.
        seed: of every random draw.
    """

    out: Path
    objects: tuple[Path, ...] = ()
    hands: tuple[str, ...] = ("allegro", "barrett")
    only: tuple[str, ...] = ()
    own: bool = True
    representatives: bool = False
    finished: bool = False
    views: int = 1
    grasps: int = 2
    draws: int = 1
    starts: int = 1000
    by_risk: bool = False
    workers: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("views", "grasps", "draws", "starts"):
            check_whole(name, getattr(self, name), 1, 1_000_000)

    def kept(self, kind: str, *what: object) -> Path:
        """Return the file, without its ending, in which something of this campaign is kept."""
        key = seed_of(self.seed, repr((self.starts, *what[1:])))
        return self.out / kind / f"{what[0]}_{key:016x}"


class Subject(NamedTuple):
    """An object: its folder, None for the library's own, its name, family and group."""

    folder: Path | None
    name: str
    family: str
    group: str

    @property
    def label(self) -> str:
        """Return a name that no other object has."""
        return f"own {self.name}" if self.folder is None else self.name


@dataclasses.dataclass(frozen=True)
class Lift(Value):
    """One lift, of the grasp at a `rank`, under one `draw` of the object's pose.

    `pushed` [m] is how far the object moved until all fingers touched, `slip` [m] in the hand from
    then on. `certain` tells whether the finger on the most certain contact touched first. NaN,
    None: never measured.
    """

    view: str
    rank: int
    draw: int
    status: Status
    pushed: float = math.nan
    slip: float = math.nan
    certain: bool | None = None

    @property
    def held(self) -> bool:
        """Tell whether the object was held."""
        return self.status is Status.OK


@dataclasses.dataclass(frozen=True)
class Cell(Value):
    """The lifts of one object with one hand in one row.

    `refused` views had no executable grasp; `note` may say why. `std_m` [m] is that of a grasp's
    least certain contact, a mean over the grasps. `seconds` is the mean CPU time of planning on a
    view.
    """

    object: str
    family: str
    group: str
    hand: str
    row: str
    lifts: tuple[Lift, ...]
    refused: int
    std_m: float
    seconds: float
    note: str = ""

    @property
    def held(self) -> int:
        """Count the lifts that held."""
        return sum(lift.held for lift in self.lifts)
