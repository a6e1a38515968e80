"""Campaigns of lifts behind Tables 6 and 7: planned once, kept as files, resumed where they stopped.

A row says how grasps are planned, and how the hand closes and holds. Rows share plans where they
are the same. Every lift draws the object's pose on its table, unknown to the
hand. The draw depends on object, view, rank and repetition only, so that rows are compared under
the same errors.
"""

import dataclasses
import functools
import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from paper.rows import Cell, Lift, Row, Subject, Support, TableSpec
from torchgrasp import ContactSpec, close_hand, load_grasps, plan_grasps
from torchgrasp.control.reference import check_single
from torchgrasp.data import list_views, read_entry, read_object_mesh, read_view
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.evaluation.protocols import draw_error, seed_of
from torchgrasp.files import format_json, write_file
from torchgrasp.foundation.errors import BadArgument, GraspError, Status
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.success.order import rank_by_variance
from torchgrasp.values.planning import Grasps, PointCloud

if TYPE_CHECKING:
    import trimesh

PAPER = PROTOCOLS["paper"]

MASS = 0.1
"""Mass of objects that are not the library's own [kg]: a light household object."""

CELL_SECONDS = 3600.0
"""CPU time [s] after which an object is given up: many times the usual."""


def run_cells(spec: TableSpec, rows: Sequence[Row]) -> Iterator[tuple[Cell, ...]]:
    """Lift each object with each hand in each row of a table; yield the cells of all rows for each
    hand and object.

    Cells that an earlier call kept are read.

    Raises:
        BadArgument: no such objects, or an unknown hand.
    """
    for hand in spec.hands:
        load_hand(hand)
    pairs = [(subject, hand) for hand in spec.hands for subject in subjects(spec)]
    tasks = [(spec, tuple(rows), *pair) for pair in pairs]
    filled = run_tasks(fill, tasks, spec.workers, CELL_SECONDS)
    for (subject, hand), cells in zip(pairs, filled, strict=True):
        if isinstance(cells, Status):
            about = subject.label, subject.family, subject.group, hand
            cells = tuple(Cell(*about, row.name, (), 1, cells.sentence) for row in rows)
        yield cells


def subjects(spec: TableSpec) -> list[Subject]:
    """Return the objects of a campaign: first one of each family, the families in random order.

    So the objects that are finished when a campaign is stopped are a fair sample of all. Equal
    names of two folders get the name of the folder. Raises `BadArgument` if that is equal, too.
    """
    own = list_objects() if spec.own else ()
    found = [Subject(None, name, f"own {name}", "", f"own {name}") for name in own]
    for folder in spec.objects:
        names = dict.fromkeys(name for name, _ in list_views(folder))
        entries = {name: read_entry(folder, name) for name in names}
        found += [
            Subject(folder, name, entry.family, entry.group, name)
            for name, entry in entries.items()
        ]
    found = _with_own_labels(found)
    kept = [subject for subject in found if not spec.only or subject.name in spec.only]
    families: dict[str, list[Subject]] = {}
    for subject in sorted(kept, key=lambda x: x.label):
        families.setdefault(subject.family, []).append(subject)
    ranked = [(k, subject) for some in families.values() for k, subject in enumerate(some)]
    ranked.sort(key=lambda x: (x[0], seed_of(spec.seed, x[1].label)))
    return [subject for k, subject in ranked if not (spec.representatives and k)]


def _with_own_labels(subjects: list[Subject]) -> list[Subject]:
    """Return the objects with labels of their own: equal ones get the name of their folder."""
    times = Counter(subject.label for subject in subjects)
    found = list[Subject]()
    for subject in subjects:
        if times[subject.label] > 1 and subject.folder is not None:
            folder = subject.folder.resolve().name
            subject = subject._replace(label=f"{subject.name} of {folder}")
        found.append(subject)
    (label, count), *_ = Counter(subject.label for subject in found).most_common(1) or [("", 0)]
    if count > 1:
        raise BadArgument("objects", f"{label} {count} times", "folders of different names")
    return found


def fill(
    spec: TableSpec, rows: tuple[Row, ...], subject: Subject, hand_name: str
) -> tuple[Cell, ...]:
    """Return the cells of one object and hand, one for each row; each is kept once it is done.

    A cell that an earlier call kept is read.

    Rows that differ in their names alone share a file.
    """
    bench = _Bench(spec, subject, hand_name)
    cells = []
    for row in rows:
        asked = (dataclasses.replace(row, name=""), spec.views, spec.grasps, spec.draws)
        path = spec.kept("cells", f"{hand_name}_{subject.label}", *asked).with_suffix(".json")
        if not path.is_file():
            write_file(path, format_json(dataclasses.asdict(bench.fill(row))))
        cells.append(dataclasses.replace(_read_cell(path), row=row.name))
    return tuple(cells)


def _read_cell(path: Path) -> Cell:
    """Read a kept cell, with NaN for null."""
    kept = json.loads(path.read_text("utf-8"))
    lifts = list[Lift]()
    for lift in kept.pop("lifts"):
        lift["status"] = Status[lift["status"]]
        lift |= {name: math.nan for name in ("pushed", "slip") if lift[name] is None}
        lifts.append(Lift(**lift))
    return Cell(**kept, lifts=tuple(lifts))


class Solid(NamedTuple):
    """The bodies and views of an object: true mesh [m], convex parts [m], and noisy views by name.

    `mass` [kg] is None if it is unknown.
    """

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh]"
    mass: float | None
    views: dict[str, PointCloud]


@functools.lru_cache(maxsize=2)
def read_solid(subject: Subject) -> Solid:
    """Read mesh, convex parts, mass and views of an object of a folder, or of the library's own."""
    folder, name = subject.folder, subject.name
    if folder is None:
        own = load_object(name)
        return Solid(own.mesh, own.parts, own.mass, {"view": own.view})
    mesh = read_object_mesh(folder, name)
    views = {view: read_view(folder, name, view) for _, view in list_views(folder, only=[name])}
    return Solid(mesh, convex_parts(mesh), read_entry(folder, name).mass, views)


class _Bench:
    """One object and one hand. What a row needs is loaded or planned when the first row asks for
    it.
    """

    def __init__(self, spec: TableSpec, subject: Subject, hand_name: str) -> None:
        self.spec = spec
        self.subject = subject
        self.hand = _load_hand(hand_name)
        self.solid = read_solid(subject)
        self.shapes: dict[tuple[str, Support], ShapeGP] = {}

    def fill(self, row: Row) -> Cell:
        """Plan on every view, and lift the first grasps."""
        lifts: list[Lift] = []
        refusals: list[str] = []
        for view in list(self.solid.views)[: self.spec.views]:
            planned, why = self.plan(view, row)
            if planned is None or not len(planned):
                refusals.append(why)
                continue
            grasps = riskiest_first(planned)[: self.spec.grasps]
            lifts += [
                self.lift(row, grasps[rank], view, rank, draw)
                for rank in range(len(grasps))
                for draw in range(self.spec.draws)
            ]
        about = self.subject.label, self.subject.family, self.subject.group, self.hand.name
        return Cell(*about, row.name, tuple(lifts), len(refusals), "; ".join(refusals))

    def plan(self, view: str, row: Row) -> tuple[Grasps | None, str]:
        """Return the executable grasps of a view, kept or planned, or why planning failed."""
        name = f"{self.hand.name}_{self.subject.label}_{view}"
        path = self.spec.kept("plans", name, row.support, row.variance)
        file = path.with_suffix(".safetensors")
        reason = path.with_suffix(".txt")
        if not (file.is_file() or reason.is_file()):
            try:
                self._plan(view, row).save(file)
            except GraspError as error:
                write_file(reason, " ".join(str(error).split()))
        return (load_grasps(file), "") if file.is_file() else (None, reason.read_text("utf-8"))

    def _plan(self, view: str, row: Row) -> Grasps:
        """Plan on a view of an object that stands on a table at z = 0."""
        cloud = self.solid.views[view]
        asked = ContactSpec(max_variance=row.variance, table=0.0)
        shape = self.shape(view, row.support)
        starts = self.spec.starts
        grasps = plan_grasps(cloud, self.hand, asked, starts, self.spec.seed, shape=shape)
        return grasps.executable

    def shape(self, view: str, support: Support) -> ShapeGP:
        """Return the shape of a view."""
        if (view, support) not in self.shapes:
            self.shapes[view, support] = fit_shape(
                self.solid.views[view], support=support, seed=self.spec.seed, table=0.0
            )
        return self.shapes[view, support]

    def lift(self, row: Row, grasp: Grasps, view: str, rank: int, draw: int) -> Lift:
        """Close the hand on the true object, somewhere beside where it was seen, and lift it."""
        mesh, parts, mass, _ = self.solid
        mass = mass if self.subject.folder is None else MASS
        seed = seed_of(self.spec.seed, self.subject.label, view, rank, draw)
        trial = dataclasses.replace(
            PAPER.trial, closing=row.closing, holding=row.holding, mass=mass
        )
        error = draw_error(PAPER, grasp, mesh, seed)
        touch = seed_of(seed, "touch")
        found = close_hand(grasp, self.hand, mesh, trial, touch, parts=parts, error=error)
        certain = most_certain_first(found.contact_order, grasp) if found.contact_order else None
        return Lift(
            view, rank, draw, found.status, found.pushed.distance, found.slip.distance, certain
        )


def most_certain_first(contact_order: Sequence[int], grasp: Grasps) -> bool:
    """Return whether the finger with the most certain contact touched first, as the paper expects
    (Sec. 5, Eq. 27).
    """
    check_single(grasp)
    std_m = grasp.contacts.require_std()[0]
    return len(contact_order) > 0 and bool(std_m[contact_order[0]] == std_m.min())


def riskiest_first(grasps: Grasps) -> Grasps:
    """Return grasps by the sum of their contacts' variances, the greatest first (Sec. 6.5)."""
    ranked = rank_by_variance(grasps)
    return ranked[torch.arange(len(ranked)).flip(0)]


@functools.lru_cache(maxsize=4)
def _load_hand(name: str) -> Hand:
    """Return a hand, loaded once in a process."""
    return load_hand(name)
