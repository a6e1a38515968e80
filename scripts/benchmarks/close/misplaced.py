"""Trials that can tell closings apart: the object is elsewhere, turned, of another shape, mass or friction, afloat.

Plans know nothing of it. Each law closes the same grasps with the same errors on the same draws. Plans and trials are
kept as files: a campaign that was stopped goes on where it was.
"""

import dataclasses
import functools
import json
import math
import statistics
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from paper.trials import CELL_SECONDS, Subject, TableSpec, subjects

from benchmarks.close.agreement import Verdicts, agreement_row
from benchmarks.close.conditions import (
    BARS,
    CONDITIONS,
    DEFAULT,
    FRAGILE,
    IN_MUJOCO,
    LAWS,
    LAWS_OF_SENSORS,
    SENSED,
    Condition,
    Law,
    draw_solid,
    swap_deviations,
)
from benchmarks.close.household import read_solid, table_spec
from benchmarks.common import Options, Row, bench
from benchmarks.perturb import PERTURBATIONS, household_mass, perturb_trial
from torchgrasp import ClosureResult, Grasps, Status, TrialSpec, load_hand, plan_grasps
from torchgrasp.closure import SensorModel
from torchgrasp.data import list_views, read_entry, read_view
from torchgrasp.errors import GraspError
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, pull_grasp
from torchgrasp.evaluation.intervals import count_by, difference_over, format_share, share_over
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.protocols import error_from_object_pose, seed_of
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.files import write_file
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.jobs import run_tasks
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec
from torchgrasp.values import load_grasps

PLANNED_FRICTION = 0.6
"""Friction that grasps are planned for, and that the lifts have unless it is drawn: as in ada-grasp-ctrl (2025)."""

TABLETOP = TrialSpec(friction=PLANNED_FRICTION)
"""Lifts of 0.1 kg."""

HIT = 5.0
"""Motion [mm] of the object in the approach that counts as a hit by the opened hand: a graze moves things less."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One trial: motion before the lift [mm], unbalanced share of the forces then, CPU time [s]; None: not measured.

    `most` is the largest normal force of a fingertip over a tick [N], `early` the motion in the approach [mm].
    """

    object: str
    family: str
    hand: str
    rank: int
    condition: str
    law: str
    status: str
    moved: float | None
    unbalanced: float | None
    seconds: float
    most: float | None = None
    early: float | None = None

    @property
    def held(self) -> bool:
        """Tell whether it held."""
        return self.status == Status.OK.name


@bench("close/misplaced", objects=True)
def misplaced(o: Options) -> list[Row]:
    """Close on misplaced objects with every controller."""
    return bench_misplaced(table_spec(o), o.conditions, o.laws)


@bench("close/sensors", objects=True)
def sensors(o: Options) -> list[Row]:
    """Close on misplaced objects with poorer tactile sensors."""
    return bench_misplaced(table_spec(o), o.conditions, o.laws or LAWS_OF_SENSORS)


def bench_misplaced(spec: TableSpec, conditions: Sequence[str] = (), laws: Sequence[str] = ()) -> list[Row]:
    """Close every law in every condition, or the named ones, and compare each with `DEFAULT`, paired by grasp."""
    conditions, laws = conditions or tuple(CONDITIONS), laws or tuple(LAWS)
    tasks = [
        (spec, subject, hand, condition, tuple(laws))
        for subject in subjects(spec)
        for condition in conditions
        for hand in spec.hands
    ]
    found: list[Outcome] = []
    for task, outcome in zip(tasks, run_tasks(try_object, tasks, spec.workers, CELL_SECONDS), strict=True):
        if isinstance(outcome, Status):
            raise SystemExit(f"{task[1].name} {task[2]}: {outcome.sentence}")
        found += [Outcome(**one) for one in outcome]
    rows = [row for hand in spec.hands for c in conditions for row in _rows(hand, c, laws, found)]
    return rows + _agreement_rows(found)


def _agreement_rows(found: Sequence[Outcome]) -> list[Row]:
    """Return the agreement of the simulators where both ran the same trials: in each condition, and in all."""
    held = {(x.hand, x.object, x.rank, x.condition, x.law): x.held for x in found}
    pairs: dict[str, list[Verdicts]] = {}
    for x in found:
        other = held.get((x.hand, x.object, x.rank, f"{x.condition}{IN_MUJOCO}", x.law))
        if other is not None:
            pairs.setdefault(f"{x.hand}, {x.condition}", []).append((x.family, x.held, other))
    if len(pairs) > 1:
        pairs["all of these"] = [one for verdicts in pairs.values() for one in verdicts]
    return [agreement_row(name, verdicts) for name, verdicts in pairs.items()]


def _rows(hand: str, condition: str, laws: Sequence[str], found: Sequence[Outcome]) -> Iterator[Row]:
    """Yield a row for each law in one condition."""
    there = [x for x in found if (x.hand, x.condition) == (hand, condition)]
    base = [x for x in there if x.law == DEFAULT]
    for law in laws:
        mine = [x for x in there if x.law == law]
        if not mine:
            continue
        held, against = share_over(_held(mine)), difference_over(_held(base), _held(mine))
        moved = median_over([(x.family, math.nan if x.moved is None else x.moved) for x in mine])
        unbalanced = [x.unbalanced for x in mine if x.unbalanced is not None]
        lost = dict(Counter(x.status for x in mine if not x.held).most_common())
        words = [format_share(held), "moved {:.1f} mm [{:.1f}, {:.1f}]".format(*moved)]
        words += [f"unbalanced {statistics.median(unbalanced):.2f}"] if unbalanced else []
        most = [x.most for x in mine if x.most is not None]
        words += [f"largest force {statistics.median(most):.1f} N, {max(most):.1f} N in the worst"] if most else []
        if law != DEFAULT and base:
            low, high = 100 * against.low, 100 * against.high
            words.append(f"{DEFAULT} is better by {100 * against.value:+.1f} points [{low:.1f}, {high:.1f}]")
            words.append("it moves things by {:+.2f} mm [{:.2f}, {:.2f}] less".format(*_moved_less(base, mine)))
        words += [f"lost {lost}", *_when_lost(mine, [x for x in found if (x.hand, x.condition) == (hand, "in place")])]
        least, most = BARS.get(condition, (0.0, math.inf)) if law == DEFAULT else (0.0, math.inf)
        bar = f">= {least:.0%}, <= {most:g} mm" if least else "-"
        met = held.value >= least and moved[0] <= most if least else None
        numbers = {"held": held, "better": against, "moved_mm": moved, "lost": lost}
        yield Row(f"{hand}, {condition}, {law}", bar, "; ".join(words), met, numbers)


def _when_lost(mine: Sequence[Outcome], in_place: Sequence[Outcome]) -> list[str]:
    """Say how many were hit in the approach, and how many of the lost are lost in place, too, where that was tried."""
    lost, seen = [x for x in mine if not x.held], [x for x in mine if x.early is not None]
    hit = [x for x in seen if x.early is not None and x.early > HIT]
    told = f"{len(hit)} were moved by over {HIT:g} mm in the approach, {sum(not x.held for x in hit)} of them lost"
    words = [told] if seen else []
    if in_place and lost and lost[0].condition != "in place":
        anyway = {(x.object, x.rank, x.law) for x in in_place if not x.held}
        words.append(f"{sum((x.object, x.rank, x.law) in anyway for x in lost)} are lost in place, too")
    return words


def _moved_less(base: Sequence[Outcome], mine: Sequence[Outcome]) -> tuple[float, float, float]:
    """Return the median over the same grasps by which the base moves things less [mm], with its interval."""
    before = {(x.object, x.rank): x.moved for x in base}
    pairs = [(x.family, x.moved, before.get((x.object, x.rank))) for x in mine]
    return median_over([(family, own - other) for family, own, other in pairs if own is not None and other is not None])


def median_over(values: Sequence[tuple[str, float]], seed: int = 0) -> tuple[float, float, float]:
    """Return the median of the families' medians and its 95 % interval over families; NaN values do not count."""
    known = [(family, value) for family, value in values if not math.isnan(value)]
    families = sorted({family for family, _ in known})
    if not families:
        return math.nan, math.nan, math.nan
    medians = torch.tensor([statistics.median(v for f, v in known if f == family) for family in families]).double()
    drawn = torch.randint(len(families), (10_000, len(families)), generator=torch.Generator().manual_seed(seed))
    low, high = medians[drawn].quantile(0.5, dim=1).quantile(torch.tensor([0.025, 0.975]).double()).tolist()
    return float(medians.quantile(0.5)), low, high


def _held(outcomes: Iterable[Outcome]) -> dict[str, tuple[int, int]]:
    """Return the counts of what held by family."""
    return count_by((x.family, x.held) for x in outcomes)


def try_object(
    spec: TableSpec, subject: Subject, hand: str, condition: str, laws: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Return the outcomes of one object in one condition, as they are kept, a line each; what is missing is run."""
    torch.set_num_threads(1)
    path = spec.kept("misplaced", f"{hand}_{subject.label}_{condition}", spec.grasps).with_suffix(".jsonl")
    kept = [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.is_file() else []
    missing = [law for law in laws if law not in {one["law"] for one in kept}]
    if missing:
        kept += [dataclasses.asdict(x) for x in _try(spec, subject, hand, condition, missing)]
        write_file(path, "".join(f"{json.dumps(one)}\n" for one in kept))
    return [one for one in kept if one["law"] in laws]


def _try(spec: TableSpec, subject: Subject, hand: str, condition: str, laws: list[str]) -> Iterator[Outcome]:
    """Put grasps of one view, spread over the ranks, to one condition."""
    folder, wrong = subject.folder, CONDITIONS[condition]
    assert folder is not None
    view = list_views(folder, only=[subject.name])[0][1]
    known = subject.label, subject.family, hand
    try:
        grasps = _plan(spec, subject, hand, view)
    except GraspError as error:
        print(f"{subject.name}, {hand}: {error}", flush=True)
        return
    mesh, parts = read_solid(folder, subject.name)
    mass = household_mass(float(mesh.volume), read_entry(folder, subject.name).mass)
    shape, surface = _fit(folder, subject.name, view)
    for rank in choose_rows(len(grasps), spec.grasps, "spread"):
        seed = seed_of(spec.seed, subject.label, view, rank, 0)
        if wrong.drawn:
            try:
                mesh = draw_solid(shape, seed)
                parts = convex_parts(mesh)
            except GraspError as problem:
                print(f"{subject.name}, {hand}: {problem}", flush=True)
                continue
        error = _misplace(wrong, grasps[rank], mesh, seed)
        for law in laws:
            began = time.process_time()
            followed = (LAWS | SENSED | FRAGILE)[law]
            grasp = swap_deviations(grasps[rank]) if followed.swapped else grasps[rank]
            touch = seed_of(seed, "touch")
            trial = GraspTrial(load_hand(hand), grasp, mesh, touch, error, parts=parts, surface=surface)
            measured = _run(trial, wrong, followed, mass, seed)
            yield Outcome(*known, rank, condition, law, seconds=time.process_time() - began, **measured)


def _run(trial: GraspTrial, wrong: Condition, law: Law, mass: float, seed: int) -> dict[str, Any]:
    """Return what an `Outcome` has of a trial."""
    changes = law.trial | {"simulator": wrong.simulator}
    if law.dead:
        changes["sensor"] = SensorModel(dead=tuple(trial.hand.finger_names[k] for k in law.dead))
    if wrong.afloat:
        spec = PROTOCOLS[wrong.afloat].with_trial(**{"closing": DEFAULT} | changes)
        return {"status": pull_grasp(trial, spec).status.name, "moved": None, "unbalanced": None}
    spec = dataclasses.replace(TABLETOP, **changes)
    if wrong.unknown:
        spec = perturb_trial(spec, dataclasses.replace(PERTURBATIONS["mass"], friction=(0.3, 1.0)), mass, seed)
    done = lift_grasp(trial, spec)
    measured = {
        "moved": 1e3 * done.before_lift.distance,
        "unbalanced": done.unbalanced,
        "most": float(done.forces.max()),
        "early": _moved_early(done, trial.mesh),
    }
    return {"status": done.status.name} | {name: None if math.isnan(x) else x for name, x in measured.items()}


def _moved_early(done: ClosureResult, mesh: Any) -> float:
    """Return the motion [mm] of the object's centre while the hand approached."""
    arrived = int((done.time <= done.phases[0]).sum()) - 1  # the last tick, if the hand never arrived
    start, end = apply(done.object_pose[[0, arrived]], _centre(mesh).expand(2, 1, 3))[:, 0]
    return 1e3 * float(torch.linalg.vector_norm(end - start))


def _misplace(wrong: Condition, grasp: Grasps, mesh: Any, seed: int) -> torch.Tensor:
    """Return the hand's error: the object is off by the condition's amounts in a drawn direction."""
    generator = torch.Generator().manual_seed(seed_of(seed, "misplaced"))
    place, turn = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    if not wrong.afloat:
        level = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        place, turn = place * level, turn * (1 - level)
    rotation = rotation_from_vector(wrong.angle * turn / torch.linalg.vector_norm(turn))
    centre = _centre(mesh)
    shift = wrong.distance * place / torch.linalg.vector_norm(place)
    return error_from_object_pose(grasp.obj_from_hand[0].double(), rigid(rotation, centre + shift - rotation @ centre))


def _centre(mesh: Any) -> torch.Tensor:
    """Return the mass centre [m]."""
    return torch.tensor(mesh.center_mass.tolist(), dtype=torch.float64)


def _plan(spec: TableSpec, subject: Subject, hand: str, view: str) -> Grasps:
    """Return the executable grasps of a view, kept or planned."""
    assert subject.folder is not None
    path = spec.kept("misplaced", f"{hand}_{subject.label}_{view}", "plan").with_suffix(".safetensors")
    if not path.is_file():
        cloud = read_view(subject.folder, subject.name, view)
        contacts = ContactSpec(friction=PLANNED_FRICTION, table=0.0)
        grasps = plan_grasps(cloud, load_hand(hand), contacts, spec.starts, spec.seed)
        grasps[grasps.status == Status.OK].save(path)
    return load_grasps(path)


@functools.lru_cache(maxsize=2)
def _fit(folder: Path, name: str, view: str) -> tuple[ShapeGP, SignedDistanceField]:
    """Return the shape of a view, and its surface as touches are compared with it."""
    shape = fit_shape(read_view(folder, name, view), table=0.0)
    return shape, surface_field(shape)
