"""The values of the tables: what is planned and lifted in a row, what a campaign is made of. Also
what came of it.
"""

import dataclasses
import math
from pathlib import Path
from typing import Literal, NamedTuple

from torchgrasp.evaluation.protocols import seed_of
from torchgrasp.foundation.base import Value, check_whole
from torchgrasp.foundation.errors import Status
from torchgrasp.values.specs import ClosingMode, HoldingMode

Support = Literal["camera", "paper"]


@dataclasses.dataclass(frozen=True)
class Row(Value):
    """A row of a table: its name, the support of the shape, and S_thresh of the contacts
    (`variance`). Also how the hand closes and holds.

    The grasps with the greatest sum of variances come first (Sec. 6.5).
    """

    name: str
    support: Support
    variance: float
    closing: ClosingMode
    holding: HoldingMode


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
        views: views of each object.
        grasps: grasps of each view.
        draws: lifts of each grasp, with an error of the pose each.
        starts: of the contact planner.
        workers: processes; the results do not depend on their number.
        seed: of every random draw.
    """

    out: Path
    objects: tuple[Path, ...] = ()
    hands: tuple[str, ...] = ("allegro", "barrett")
    only: tuple[str, ...] = ()
    own: bool = True
    representatives: bool = False
    views: int = 1
    grasps: int = 2
    draws: int = 1
    starts: int = 1000
    workers: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("views", "grasps", "draws", "starts"):
            check_whole(name, getattr(self, name), 1, 1_000_000)

    def kept(self, kind: str, name: str, *asked: object) -> Path:
        """Return the path, without its ending, of a file that keeps a result of this campaign.

        `kind` is its folder and `name` the beginning of its name. A hash of `asked`, of the starts
        and of the seed follows.
        """
        key = seed_of(self.seed, repr((self.starts, *asked)))
        return self.out / kind / f"{name}_{key:016x}"


class Subject(NamedTuple):
    """An object of a campaign: its folder (None for the library's own), name, family and group.

    `label` is its name in results and their files, which no other object of the campaign has.
    """

    folder: Path | None
    name: str
    family: str
    group: str
    label: str


@dataclasses.dataclass(frozen=True)
class Lift(Value):
    """One lift of an object by the grasp at a `rank`, under one `draw` of the object's pose.

    `pushed` [m] is how far the object moved until all fingers touched. `slip` [m] is how far it
    moved in the hand from then on. `certain` tells whether the finger on the most certain contact
    touched first. NaN and None mean that it was never measured.
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
        """Whether the object was lifted and held."""
        return self.status is Status.OK


@dataclasses.dataclass(frozen=True)
class Cell(Value):
    """The lifts of one object with one hand, in one row of a table.

    `refused` views had no executable grasp; `note` may say why.
    """

    object: str
    family: str
    group: str
    hand: str
    row: str
    lifts: tuple[Lift, ...]
    refused: int
    note: str = ""

    @property
    def held(self) -> int:
        """The number of lifts in which the object was held."""
        return sum(lift.held for lift in self.lifts)
