"""Trials that can tell closings apart: the object is elsewhere, turned, of another shape, mass or
friction, afloat.

Plans know nothing of it. Each law closes the same grasps with the same errors on the same draws.
"""

import dataclasses
import functools
import math
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import torch
import trimesh
from paper.tables6_7 import format_points
from paper.trials import Subject, TableSpec, subjects
from sklearn.metrics import cohen_kappa_score, confusion_matrix

from benchmarks.close.campaign import fit_view, keep, plan_view, read_solid, run_all, table_spec
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
from benchmarks.common import Options, Row, bench
from benchmarks.perturb import PERTURBATIONS, perturb_trial
from torchgrasp import ClosureResult, Grasps, Status, TrialSpec, load_hand
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, Truth, pull_grasp
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.protocols import error_from_object_pose, seed_of
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.foundation.errors import GraspError
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.values.closing import SensorModel

PLANNED_FRICTION = 0.6
"""Friction that grasps are planned for, and that the lifts have unless it is drawn: as in ada-
grasp-ctrl (2025).
"""

TABLETOP = TrialSpec(friction=PLANNED_FRICTION)
"""Lifts of 0.1 kg."""

HIT = 5.0
"""Motion [mm] of the object in the approach that counts as a hit by the opened hand: a graze moves
things less.
"""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One trial: motion before the lift [mm], unbalanced share of the forces then, CPU time [s];
    None: not measured.

    `most` is the largest normal force of a fingertip over a tick [N], `early` the motion in the
    approach [mm].
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
    """Close on misplaced objects with every controller, and compare each with `DEFAULT`, paired by
    grasp.
    """
    return _bench(table_spec(o), o.conditions or tuple(CONDITIONS), o.laws or tuple(LAWS))


@bench("close/sensors", objects=True)
def sensors(o: Options) -> list[Row]:
    """Close on misplaced objects with poorer tactile sensors."""
    return _bench(table_spec(o), o.conditions or tuple(CONDITIONS), o.laws or LAWS_OF_SENSORS)


def _bench(spec: TableSpec, conditions: Sequence[str], laws: Sequence[str]) -> list[Row]:
    """Close every law in every condition."""
    tasks = [
        (spec, x, hand, name, laws)
        for x in subjects(spec)
        for name in conditions
        for hand in spec.hands
    ]
    found = [
        Outcome(**one) for outcomes in run_all(try_object, tasks, spec.workers) for one in outcomes
    ]
    rows = [
        row for hand in spec.hands for name in conditions for row in _rows(hand, name, laws, found)
    ]
    return rows + _agreement_rows(found)


def _agreement_rows(found: Sequence[Outcome]) -> list[Row]:
    """Return the agreement of the simulators where both ran the same trials: in each condition, and
    in all.
    """
    held = {(x.hand, x.object, x.rank, x.condition, x.law): x.held for x in found}
    pairs: dict[str, list[tuple[str, bool, bool]]] = {}
    for x in found:
        other = held.get((x.hand, x.object, x.rank, f"{x.condition}{IN_MUJOCO}", x.law))
        if other is not None:
            pairs.setdefault(f"{x.hand}, {x.condition}", []).append((x.family, x.held, other))
    if len(pairs) > 1:
        pairs["all of these"] = [one for verdicts in pairs.values() for one in verdicts]
    return [_agreement_row(name, verdicts) for name, verdicts in pairs.items()]


def _agreement_row(what: str, verdicts: list[tuple[str, bool, bool]]) -> Row:
    """Return the share of equal verdicts of SAPIEN and MuJoCo by family, and which way the others
    went.
    """
    _, *both = zip(*verdicts, strict=True)
    table = confusion_matrix(*both, labels=[True, False])
    kappa = float(cohen_kappa_score(*both, labels=[True, False]))
    share = share_over(count_by((family, one == other) for family, one, other in verdicts))
    measured = f"{format_share(share)}, kappa {kappa:.2f}; both hold {table[0, 0]}, both lose {table[1, 1]}, "
    measured += f"SAPIEN alone holds {table[0, 1]}, MuJoCo alone {table[1, 0]}"
    numbers = {"share": share, "table": table.tolist(), "kappa": kappa}
    return Row(
        f"agreement of the simulators, {what}", ">= 93%", measured, share.value >= 0.93, numbers
    )


def _rows(
    hand: str, condition: str, laws: Sequence[str], found: Sequence[Outcome]
) -> Iterator[Row]:
    """Yield a row for each law in one condition."""
    there = [x for x in found if (x.hand, x.condition) == (hand, condition)]
    base = [x for x in there if x.law == DEFAULT]
    in_place = [x for x in found if x.condition == "in place"]
    for law in laws:
        mine = [x for x in there if x.law == law]
        if not mine:
            continue
        held, first = (count_by((x.family, x.held) for x in some) for some in (mine, base))
        share = share_over(held)
        better = contrast_over([first, held], [1.0, -1.0])
        moved = median_over([(x.family, math.nan if x.moved is None else x.moved) for x in mine])
        lost = dict(Counter(x.status for x in mine if not x.held).most_common())
        words = [
            format_share(share),
            "moved {:.1f} mm [{:.1f}, {:.1f}]".format(*moved),
            *_forces(mine),
        ]
        if law != DEFAULT and base:
            less = "it moves things by {:+.2f} mm [{:.2f}, {:.2f}] less".format(
                *_moved_less(base, mine)
            )
            words += [f"{DEFAULT} is better by {format_points(better)}", less]
        words += [f"lost {lost}", *_when_lost(mine, in_place)]
        numbers = {"held": share, "better": better, "moved_mm": moved, "lost": lost}
        bar = "-"
        met = None
        if law == DEFAULT and condition in BARS:
            least, most = BARS[condition]
            bar = f">= {least:.0%}, <= {most:g} mm"
            met = share.value >= least and moved[0] <= most
        yield Row(f"{hand}, {condition}, {law}", bar, "; ".join(words), met, numbers)


def _forces(mine: Sequence[Outcome]) -> list[str]:
    """Say how far the forces were from balance before the lift, and how large they were."""
    unbalanced = [x.unbalanced for x in mine if x.unbalanced is not None]
    most = [x.most for x in mine if x.most is not None]
    words = [f"unbalanced {statistics.median(unbalanced):.2f}"] if unbalanced else []
    return words + (
        [f"largest force {statistics.median(most):.1f} N, {max(most):.1f} N in the worst"]
        if most
        else []
    )


def _when_lost(mine: Sequence[Outcome], in_place: Sequence[Outcome]) -> list[str]:
    """Say how many were hit in the approach, and how many of the lost are lost in place, too, where
    that was tried.
    """
    lost = [x for x in mine if not x.held]
    early = [(x.early, x.held) for x in mine if x.early is not None]
    hit = [held for moved, held in early if moved > HIT]
    told = f"{len(hit)} were moved by over {HIT:g} mm in the approach, {len(hit) - sum(hit)} of them lost"
    words = [told] if early else []
    if in_place and lost and lost[0].condition != "in place":
        anyway = {(x.hand, x.object, x.rank, x.law) for x in in_place if not x.held}
        count = sum((x.hand, x.object, x.rank, x.law) in anyway for x in lost)
        words.append(f"{count} are lost in place, too")
    return words


def _moved_less(base: Sequence[Outcome], mine: Sequence[Outcome]) -> tuple[float, float, float]:
    """Return the median over the same grasps by which the base moves things less [mm], with its
    interval.
    """
    before = {(x.object, x.rank): x.moved for x in base}
    pairs = [(x.family, x.moved, before.get((x.object, x.rank))) for x in mine]
    return median_over(
        [
            (family, own - other)
            for family, own, other in pairs
            if own is not None and other is not None
        ]
    )


def median_over(values: Sequence[tuple[str, float]], seed: int = 0) -> tuple[float, float, float]:
    """Return the median of the families' medians and its 95 % interval over families; NaN values do
    not count.
    """
    known = [(family, value) for family, value in values if not math.isnan(value)]
    families = sorted({family for family, _ in known})
    if not families:
        return math.nan, math.nan, math.nan
    medians = torch.tensor(
        [statistics.median(v for f, v in known if f == family) for family in families]
    ).double()
    drawn = torch.randint(
        len(families), (10_000, len(families)), generator=torch.Generator().manual_seed(seed)
    )
    low, high = (
        medians[drawn].quantile(0.5, dim=1).quantile(torch.tensor([0.025, 0.975]).double()).tolist()
    )
    return float(medians.quantile(0.5)), low, high


def try_object(
    spec: TableSpec, subject: Subject, hand: str, condition: str, laws: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the outcomes of one object in one condition, kept or run."""
    found: list[dict[str, Any]] = []
    for law in laws:
        path = spec.kept(
            "misplaced", f"{hand}_{subject.label}_{condition}_{law}", spec.grasps
        ).with_suffix(".json")
        found += keep(
            path,
            lambda: list(map(dataclasses.asdict, _try(spec, subject, hand, condition, law))),  # noqa: B023
        )
    return found


def _try(
    spec: TableSpec, subject: Subject, hand: str, condition: str, law: str
) -> Iterator[Outcome]:
    """Put grasps of one view, spread over the ranks, to one condition."""
    wrong = CONDITIONS[condition]
    followed = (LAWS | SENSED | FRAGILE)[law]
    view = read_solid(subject).view
    grasps = plan_view(spec, subject, hand, PLANNED_FRICTION)
    for rank in choose_rows(len(grasps), spec.grasps, "spread"):
        began = time.process_time()
        seed = seed_of(spec.seed, subject.label, view, rank, 0)
        try:
            mesh, parts = (
                _drawn_solid(spec, subject, seed) if wrong.drawn else read_solid(subject)[:2]
            )
        except GraspError as problem:
            print(f"{subject.name}, {hand}: {problem}", flush=True)
            continue
        error = _misplace(wrong, grasps[rank], mesh, seed)
        touch = seed_of(seed, "touch")
        grasp = swap_deviations(grasps[rank]) if followed.swapped else grasps[rank]
        surface = fit_view(spec, subject)[1]
        trial = GraspTrial(
            load_hand(hand), grasp, Truth(mesh, parts, error), touch, surface=surface
        )
        measured = _run(trial, wrong, followed, read_solid(subject).mass, seed)
        known = subject.label, subject.family, hand, rank, condition, law
        yield Outcome(*known, seconds=time.process_time() - began, **measured)


@functools.lru_cache(maxsize=8)
def _drawn_solid(
    spec: TableSpec, subject: Subject, seed: int
) -> tuple[trimesh.Trimesh, Sequence[trimesh.Trimesh]]:
    """Return a solid of the posterior with its convex parts."""
    mesh = draw_solid(fit_view(spec, subject)[0], seed)
    return mesh, convex_parts(mesh)


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
        spec = perturb_trial(
            spec, dataclasses.replace(PERTURBATIONS["mass"], friction=(0.3, 1.0)), mass, seed
        )
    done = lift_grasp(trial, spec)
    measured = {
        "moved": 1e3 * done.before_lift.distance,
        "unbalanced": done.unbalanced,
        "most": float(done.forces.max()),
        "early": _moved_early(done, trial.truth.mesh),
    }
    return {"status": done.status.name} | {
        name: None if math.isnan(x) else x for name, x in measured.items()
    }


def _moved_early(done: ClosureResult, mesh: Any) -> float:
    """Return the motion [mm] of the object's centre while the hand approached."""
    arrived = (
        int((done.time <= done.phases[0]).sum()) - 1
    )  # the last tick, if the hand never arrived
    start, end = apply(done.object_pose[[0, arrived]], _centre(mesh).expand(2, 1, 3))[:, 0]
    return 1e3 * float(torch.linalg.vector_norm(end - start))


def _misplace(wrong: Condition, grasp: Grasps, mesh: Any, seed: int) -> torch.Tensor:
    """Return the hand's error: the object is off by the condition's amounts in a drawn direction."""
    generator = torch.Generator().manual_seed(seed_of(seed, "misplaced"))
    place, turn = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    if not wrong.afloat:
        level = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        place = place * level
        turn = turn * (1 - level)
    rotation = rotation_from_vector(wrong.angle * turn / torch.linalg.vector_norm(turn))
    centre = _centre(mesh)
    shift = wrong.distance * place / torch.linalg.vector_norm(place)
    return error_from_object_pose(
        grasp.obj_from_hand[0].double(), rigid(rotation, centre + shift - rotation @ centre)
    )


def _centre(mesh: Any) -> torch.Tensor:
    """Return the mass centre [m]."""
    return torch.tensor(mesh.center_mass.tolist(), dtype=torch.float64)
