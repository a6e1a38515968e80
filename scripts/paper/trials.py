"""Campaigns of lifts behind Tables 6 and 7 and the ladder: planned once, kept as files, resumed where they stopped.

A row says how grasps are planned, which of them come first, and how the hand closes and holds. Rows share plans where
they are the same. Every lift draws the object's pose on its table, unknown to the hand. The draw depends on object,
view, rank and repetition only, so that rows are compared under the same errors.
"""

import dataclasses
import functools
import json
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch

from torchgrasp.base import Value, check_whole
from torchgrasp.datasets import list_views, read_family, read_group, read_object_mesh, read_view
from torchgrasp.errors import GraspError, Status
from torchgrasp.evaluation import PROTOCOLS, close_hand, draw_error, run_tasks, seed_of
from torchgrasp.files import format_json, write_file
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.objects import list_objects, load_object
from torchgrasp.pipeline import Mode, plan_grasps
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ClosingMode, ContactSpec, HoldingMode
from torchgrasp.values import Grasps, PointCloud, load_grasps

if TYPE_CHECKING:
    import trimesh

PAPER = PROTOCOLS["paper"]

MASS = 0.1
"""Mass of objects that come without one [kg]: a light household object."""

CELL_SECONDS = 3600.0
"""Wall time [s] after which an object is given up: many times the usual."""

Support = Literal["camera", "paper"]
Order = Literal["success", "certain", "risky"]
"""Which executable grasp comes first: the likeliest success, or the least or greatest sum of variances (Sec. 6.5)."""


@dataclasses.dataclass(frozen=True)
class Plan(Value):
    """How grasps are planned: `mode` of `plan_grasps`, support of the shape, and the problem of the contacts.

    `margins` are the library's (`ContactSpec`); without them the problem is the paper's. `variance` is S_thresh; None:
    that of the problem.
    """

    mode: Mode = "joint"
    support: Support = "camera"
    margins: bool = True
    variance: float | None = None

    def contacts(self) -> ContactSpec:
        """Return the problem, for an object that stands on a table at z = 0."""
        spec = dataclasses.replace(ContactSpec() if self.margins else ContactSpec.paper(), table=0.0)
        return spec if self.variance is None else dataclasses.replace(spec, max_variance=self.variance)


@dataclasses.dataclass(frozen=True)
class Row(Value):
    """A row of a table: its name, how grasps are planned, which come first, and how the hand closes and holds."""

    name: str
    plan: Plan
    first: Order
    closing: ClosingMode
    holding: HoldingMode


@dataclasses.dataclass(frozen=True)
class TableSpec(Value):
    """What a table is made of. A campaign that is stopped goes on where it was, if it is called again alike.

    Args:
        out: folder of the results, and of the plans and cells that are kept. After a change of the code, take another.
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

    `pushed` [m] is how far the object moved until all fingers touched, `slip` [m] in the hand from then on. `certain`
    tells whether the finger on the most certain contact touched first. NaN, None: never measured.
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

    `refused` views had no executable grasp; `note` may say why. `std_m` [m] is that of a grasp's least certain contact,
    a mean over the grasps. `seconds` is the mean CPU time of planning on a view.
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


def run_cells(spec: TableSpec, rows: Sequence[Row]) -> Iterator[tuple[Cell, ...]]:
    """Yield for each hand and object the cells of the rows.

    Raises:
        BadArgument: no such objects, or an unknown hand.
    """
    for hand in spec.hands:
        load_hand(hand)
    tasks = [(spec, tuple(rows), subject, hand) for hand in spec.hands for subject in subjects(spec)]
    for (_, _, subject, hand), cells in zip(tasks, run_tasks(fill, tasks, spec.workers, CELL_SECONDS), strict=True):
        if isinstance(cells, Status):
            lost = Cell(
                subject.label, subject.family, subject.group, hand, "", (), 1, math.nan, math.nan, cells.sentence
            )
            cells = tuple(dataclasses.replace(lost, row=row.name) for row in rows)
        yield cells


def subjects(spec: TableSpec) -> list[Subject]:
    """Return the objects of a campaign, by family and name."""
    own = [Subject(None, name, f"own {name}", "") for name in list_objects() if spec.own]
    names = [(folder, name) for folder in spec.objects for name in dict.fromkeys(n for n, _ in list_views(folder))]
    found = own + [Subject(folder, name, read_family(folder, name), read_group(folder, name)) for folder, name in names]
    found = sorted((s for s in found if not spec.only or s.name in spec.only), key=lambda s: (s.family, s.label))
    return list({s.family: s for s in reversed(found)}.values())[::-1] if spec.representatives else found


def fill(spec: TableSpec, rows: tuple[Row, ...], subject: Subject, hand_name: str) -> tuple[Cell, ...]:
    """Return the cells of one object and hand; each is kept as soon as it is there."""
    torch.set_num_threads(1)
    bench, cells = _Bench(spec, subject, hand_name), []
    for row in rows:
        asked = dataclasses.replace(row, name=""), spec.views, spec.grasps, spec.draws
        path = spec.kept("cells", f"{hand_name}_{subject.label}", *asked).with_suffix(".json")
        if not path.is_file():
            write_file(path, format_json(dataclasses.asdict(bench.fill(row))))
        cells.append(dataclasses.replace(_read_cell(path), row=row.name))
    return tuple(cells)


def _read_cell(path: Path) -> Cell:
    """Read a kept cell."""
    kept = _with_nan(json.loads(path.read_text("utf-8")), ("std_m", "seconds"))
    lifts = (_with_nan(lift, ("pushed", "slip")) for lift in kept.pop("lifts"))
    return Cell(**kept, lifts=tuple(Lift(**lift | {"status": Status[lift["status"]]}) for lift in lifts))


def _with_nan(kept: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return a kept record with NaN for null."""
    return kept | {name: math.nan for name in names if kept[name] is None}


class _Bench:
    """One object and one hand. What a row needs is loaded or planned when the first row asks for it."""

    def __init__(self, spec: TableSpec, subject: Subject, hand_name: str) -> None:
        self.spec, self.subject, self.hand = spec, subject, _load_hand(hand_name)
        self.shapes: dict[tuple[str, Support], ShapeGP] = {}

    @functools.cached_property
    def solid(self) -> "tuple[trimesh.Trimesh, Sequence[trimesh.Trimesh], float]":
        """Return the true mesh, its convex parts and its mass."""
        if self.subject.folder is None:
            own = load_object(self.subject.name)
            return own.mesh, own.parts, own.mass
        mesh = read_object_mesh(self.subject.folder, self.subject.name)
        return mesh, convex_parts(mesh), MASS

    @functools.cached_property
    def views(self) -> dict[str, PointCloud]:
        """Return the noisy views by name."""
        folder, name = self.subject.folder, self.subject.name
        if folder is None:
            return {"view": load_object(name).view}
        views = [view for _, view in list_views(folder, only=[name])][: self.spec.views]
        return {view: read_view(folder, name, view) for view in views}

    def fill(self, row: Row) -> Cell:
        """Plan on every view, and lift the first grasps."""
        lifts: list[Lift] = []
        stds: list[float] = []
        seconds: list[float] = []
        notes: list[str] = []
        refused = 0
        for view in self.views:
            grasps, kept = self.plan(view, row.plan)
            seconds.append(kept["seconds"])
            if grasps is None or not len(grasps):
                refused += 1
                notes.append(kept["note"])
                continue
            grasps = in_order(grasps, row.first)[: self.spec.grasps]
            stds += grasps.contacts.std_m.amax(1).tolist()
            lifts += [
                self.lift(row, grasps[rank], view, rank, draw)
                for rank in range(len(grasps))
                for draw in range(self.spec.draws)
            ]
        mean = [sum(x) / len(x) if x else math.nan for x in (stds, seconds)]
        label, family, group = self.subject.label, self.subject.family, self.subject.group
        return Cell(label, family, group, self.hand.name, row.name, tuple(lifts), refused, *mean, "; ".join(notes))

    def plan(self, view: str, plan: Plan) -> tuple[Grasps | None, dict[str, Any]]:
        """Return the executable grasps of a view, kept or planned, and what is known of the planning."""
        path = self.spec.kept("plans", f"{self.hand.name}_{self.subject.label}_{view}", plan)
        file, record = path.with_suffix(".safetensors"), path.with_suffix(".json")
        if not record.is_file():
            started, note = time.process_time(), ""
            try:
                self._plan(view, plan).save(file)
            except GraspError as error:
                note = " ".join(str(error).split())
            write_file(record, format_json({"seconds": time.process_time() - started, "note": note}))
        return load_grasps(file) if file.is_file() else None, json.loads(record.read_text("utf-8"))

    def _plan(self, view: str, plan: Plan) -> Grasps:
        """Plan on a view."""
        cloud, seed = self.views[view], self.spec.seed
        if (view, plan.support) not in self.shapes:
            self.shapes[view, plan.support] = fit_shape(cloud, support=plan.support, seed=seed, table=0.0)
        shape = self.shapes[view, plan.support]
        grasps = plan_grasps(cloud, self.hand, plan.contacts(), self.spec.starts, seed, mode=plan.mode, shape=shape)
        return grasps[grasps.status == Status.OK]

    def lift(self, row: Row, grasp: Grasps, view: str, rank: int, draw: int) -> Lift:
        """Close the hand on the true object, somewhere beside where it was seen, and lift it."""
        mesh, parts, mass = self.solid
        seed = seed_of(self.spec.seed, self.subject.label, view, rank, draw)
        trial = dataclasses.replace(PAPER.trial, closing=row.closing, holding=row.holding, mass=mass)
        error = draw_error(PAPER, grasp, mesh, seed)
        touch = seed_of(seed, "touch")
        found = close_hand(grasp, self.hand, mesh, trial, touch, parts=parts, error=error)
        certain = found.contact_order[0] == int(grasp.contacts.std_m[0].argmin()) if found.contact_order else None
        return Lift(view, rank, draw, found.status, found.pushed.distance, found.slip.distance, certain)


def in_order(grasps: Grasps, first: Order) -> Grasps:
    """Return grasps in an order; planned ones are by success already."""
    if first == "success":
        return grasps
    variance = grasps.contacts.std_m.square().sum(1)
    return grasps[torch.argsort(variance, descending=first == "risky", stable=True)]


@functools.lru_cache(maxsize=4)
def _load_hand(name: str) -> Hand:
    """Return a hand, loaded once in a process."""
    return load_hand(name)
