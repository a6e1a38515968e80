"""Lifts that a robot would recognise: what each thing that it does not know costs, one at a time and all together.

The best grasps of one view of each object are lifted under protocol "household". An object without a grasp fails.
Plans and lifts are kept as files: a campaign that was stopped goes on where it was.
"""

import dataclasses
import functools
import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from paper.trials import CELL_SECONDS, Subject, TableSpec, subjects

from benchmarks.common import Options, Row, bench
from benchmarks.perturb import (
    PERTURBATIONS,
    Perturbation,
    find_perturbation,
    household_mass,
    perturb_trial,
    perturb_view,
)
from torchgrasp.data import list_views, read_entry, read_object_mesh, read_view
from torchgrasp.errors import GraspError, Status
from torchgrasp.evaluation import PROTOCOLS, PoseNoise, close_hand
from torchgrasp.evaluation.intervals import count_by, difference_over, format_share, share_over
from torchgrasp.evaluation.protocols import draw_error, seed_of
from torchgrasp.files import format_json, write_file
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.load import load_hand
from torchgrasp.jobs import run_tasks
from torchgrasp.planner import plan_grasps
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Grasps, load_grasps

HOUSEHOLD = PROTOCOLS["household"]

LEAST_HELD = 0.85
"""Share of the best grasps that must hold with everything unknown together: the project's own bar."""

GRIPS = {"barrett": 8.0}
"""Grip [N] of hands that press harder than `HOUSEHOLD` asks: on eight heavy and light families the Barrett held 13 of
16 lifts by 8 N and 10 by 6 N, the Allegro 6 and 10."""

FORCES = (4.0, 6.0, 8.0, 10.0)
"""Grips [N] that are compared: a light squeeze, up to what the drives of a small hand can do."""


Case = tuple[str, float]
"""A perturbation by name, and a grip [N]."""


@dataclasses.dataclass(frozen=True)
class Lift:
    """A lift of the grasp of a `rank`, of an object of a `family`; rank -1: there was none.

    `slip` [m, rad] is the object's motion in the hand, `mass` [kg] and `friction` are the true ones. None: no lift.
    """

    object: str
    family: str
    rank: int
    status: str
    slip: tuple[float | None, float | None]
    mass: float
    friction: float | None
    seconds: float

    @property
    def held(self) -> bool:
        """Tell whether it held."""
        return self.status == Status.OK.name


def table_spec(o: Options) -> TableSpec:
    """Return the campaign of lifts that some options ask for, of one object of each family."""
    return TableSpec(
        o.out, o.objects, hands=o.hands, only=o.names, own=False, representatives=True, grasps=o.grasps,
        starts=o.starts, workers=o.workers, seed=o.seed,
    )  # fmt: skip


@bench("close/perturb", objects=True)
def perturb(o: Options) -> list[Row]:
    """Lift under each household perturbation, or some of them."""
    return bench_household(table_spec(o), o.conditions)


@bench("close/grip", objects=True)
def grip(o: Options) -> list[Row]:
    """Lift under all household perturbations with several grips."""
    return bench_grip(table_spec(o))


def bench_household(spec: TableSpec, only: Sequence[str] = ()) -> list[Row]:
    """Lift with nothing unknown, and with each factor alone and all of them, or under some perturbations only."""
    rows: list[Row] = []
    for name in only:
        find_perturbation(name)  # raises for an unknown one
    chosen = [name for name in PERTURBATIONS if not only or name in ("none", *only)]
    for hand in spec.hands:
        cases = [(name, GRIPS.get(hand, HOUSEHOLD.trial.force)) for name in chosen]
        found = _run(spec, hand, cases)
        rows += [_row(f"{hand}, {case[0]}", found[case], found[cases[0]], case[0] == "all") for case in cases]
    return rows


def bench_grip(spec: TableSpec) -> list[Row]:
    """Lift with everything unknown by several grips."""
    rows: list[Row] = []
    for hand in spec.hands:
        cases = [("all", force) for force in FORCES]
        found = _run(spec, hand, cases)
        rows += [_row(f"{hand}, {case[1]:g} N", found[case], found[cases[0]], False) for case in cases]
    return rows


def _run(spec: TableSpec, hand: str, cases: Sequence[Case]) -> dict[Case, list[Lift]]:
    """Return the lifts of all objects by case."""
    tasks = [(spec, subject, hand, tuple(cases)) for subject in subjects(spec)]
    lifts: dict[Case, list[Lift]] = {case: [] for case in cases}
    for task, found in zip(tasks, run_tasks(lift_object, tasks, spec.workers, CELL_SECONDS), strict=True):
        if isinstance(found, Status):
            raise SystemExit(f"{task[1].name} {hand}: {found.sentence}")
        for case, some in zip(cases, found, strict=True):
            lifts[case] += [Lift(**lift) for lift in some]
    return lifts


def _row(what: str, lifts: Sequence[Lift], base: Sequence[Lift], judged: bool) -> Row:
    """Return the share that held, of the best grasps and of all, the loss, the slip, and what lost the rest."""
    best, first = (_counts(x for x in some if x.rank <= 0) for some in (lifts, base))
    held = [x for x in lifts if x.held]
    lost = dict(Counter(x.status for x in lifts if not x.held).most_common())
    slips = [_quantiles([x.slip[k] for x in held], scale) for k, scale in ((0, 1e3), (1, math.degrees(1)))]
    numbers: dict[str, Any] = {"best": share_over(best), "change": difference_over(best, first)}
    numbers |= {"all": share_over(_counts(lifts)), "lost": lost, "slip": slips}
    numbers["seconds"] = sum(x.seconds for x in lifts) / max(len({x.object for x in lifts}), 1)
    numbers["objects"] = {x.object: x.status for x in lifts if x.rank <= 0}
    change = numbers["change"]
    words = [f"best one {format_share(numbers['best'])}"]
    words.append(f"change {100 * change.value:+.1f} [{100 * change.low:+.1f}, {100 * change.high:+.1f}]")
    if any(x.rank > 0 for x in lifts):
        words.append(f"all ranks tried {format_share(numbers['all'])}")
    (slip, far), (turn, wide) = slips
    words.append(f"slip {slip:.1f} mm, {turn:.1f} deg; 95 % below {far:.1f} mm, {wide:.1f} deg; lost {lost}")
    met = numbers["best"].value >= LEAST_HELD if judged else None
    return Row(f"held, {what}", f">= {LEAST_HELD:.0%}" if judged else "-", "; ".join(words), met, numbers)


def _counts(lifts: Iterable[Lift]) -> dict[str, tuple[int, int]]:
    """Return the counts of what held by family."""
    return count_by((lift.family, lift.held) for lift in lifts)


def _quantiles(values: Sequence[float | None], scale: float) -> tuple[float, float]:
    """Return median and 95 % quantile."""
    known = torch.tensor([scale * x for x in values if x is not None], dtype=torch.float64)
    if not len(known):
        return math.nan, math.nan
    median, most = known.quantile(torch.tensor([0.5, 0.95], dtype=torch.float64)).tolist()
    return median, most


def lift_object(spec: TableSpec, subject: Subject, hand: str, cases: Sequence[Case]) -> list[list[dict[str, Any]]]:
    """Return the lifts of an object in every case, kept or run."""
    torch.set_num_threads(1)
    found = []
    for name, force in cases:
        what = f"{hand}_{subject.label}", name, force, spec.grasps, spec.draws
        path = spec.kept("household", *what).with_suffix(".json")
        if not path.is_file():
            lifts = [dataclasses.asdict(lift) for lift in _lift(spec, subject, hand, name, force)]
            write_file(path, format_json(lifts))
        found.append(json.loads(path.read_text("utf-8")))
    return found


def _lift(spec: TableSpec, subject: Subject, hand: str, name: str, force: float) -> Iterator[Lift]:
    """Lift the best grasps of one view under one perturbation."""
    folder, perturbation = subject.folder, PERTURBATIONS[name]
    assert folder is not None
    began = time.process_time()
    mesh, parts = read_solid(folder, subject.name)
    view = list_views(folder, only=[subject.name])[0][1]
    mass = household_mass(float(mesh.volume), read_entry(folder, subject.name).mass)
    try:
        grasps = _best(plan_view(spec, subject, hand, view, name), spec.grasps)
    except GraspError as error:
        print(f"{subject.name}, {hand}, {name}: {error}", flush=True)
        grasps = []
    spent = time.process_time() - began
    if not grasps:
        yield Lift(subject.label, subject.family, -1, "NO_GRASP", (None, None), mass, None, spent)
    for rank, grasp in enumerate(grasps):
        for draw in range(spec.draws):
            began = time.process_time()
            seed = seed_of(spec.seed, subject.label, view, rank, draw)
            trial = perturb_trial(dataclasses.replace(HOUSEHOLD.trial, force=force), perturbation, mass, seed)
            error = draw_error(dataclasses.replace(HOUSEHOLD, noise=perturbation.pose), grasp, mesh, seed)
            felt = fit_surface(folder, subject.name, view, _seen(name), seed_of(spec.seed, subject.label, view))
            done = close_hand(grasp, load_hand(hand), mesh, trial, seed, error=error, parts=parts, surface=felt)
            spent += time.process_time() - began
            slip = done.slip.distance, done.slip.angle
            told = subject.label, subject.family, rank, done.status.name, slip, trial.mass, trial.friction
            yield Lift(*told, spent)
            spent = 0.0


def _best(grasps: Grasps, most: int) -> list[Grasps]:
    """Return the best grasps, one by one."""
    return [grasps[row] for row in range(min(len(grasps), most))]


def plan_view(spec: TableSpec, subject: Subject, hand: str, view: str, name: str) -> Grasps:
    """Return the executable grasps of a view, kept or planned; what only the lift meets shares one plan."""
    assert subject.folder is not None
    seen = _seen(name)
    path = spec.kept("household", f"{hand}_{subject.label}_{view}", "plan", seen).with_suffix(".safetensors")
    if not path.is_file():
        cloud, seed = read_view(subject.folder, subject.name, view), seed_of(spec.seed, subject.label, view)
        cloud, table = perturb_view(cloud, seen, seed)
        contacts = ContactSpec(friction=HOUSEHOLD.trial.friction, table=table)
        grasps = plan_grasps(cloud, load_hand(hand), contacts, spec.starts, spec.seed)
        grasps[grasps.status == Status.OK].save(path)
    return load_grasps(path)


@functools.lru_cache(maxsize=2)
def fit_surface(folder: Path, name: str, view: str, seen: Perturbation, seed: int) -> SignedDistanceField:
    """Return the surface that is estimated of a view, with which touches are compared."""
    cloud, table = perturb_view(read_view(folder, name, view), seen, seed)
    return surface_field(fit_shape(cloud, table=table))


def _seen(name: str) -> Perturbation:
    """Return the part of a perturbation that changes what is seen."""
    return dataclasses.replace(PERTURBATIONS[name], mass=False, friction=None, pose=PoseNoise())


@functools.lru_cache(maxsize=2)
def read_solid(folder: Path, name: str) -> tuple[Any, Any]:
    """Return mesh and convex parts."""
    mesh = read_object_mesh(folder, name)
    return mesh, convex_parts(mesh)
