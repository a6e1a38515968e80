"""At which friction contacts are planned best where the friction is only a distribution.

Every rule plans on the same view of a body. All but one know the distribution, and rank by it; the
one that stands for other planners knows its mean alone. The best grasp of each rule is lifted at
quantiles of the distribution. Bodies are of families that fitted no tree of the success model.
Masses and simulators alternate from body to body. Intervals are over families.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from train.household import (
    CALIBRATING,
    FAMILIES,
    GOLDEN_ANGLE,
    HouseholdBody,
    author_household,
    family_of,
)

from benchmarks.common import (
    Options,
    Row,
    bench,
    format_number,
    keep,
    keep_at_commit,
    mean_over,
    run_all,
    sum_by,
)
from torchgrasp import ContactSpec, Distribution, GraspTask, load_hand, plan_grasps
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.evaluation.intervals import Share, contrast_over
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.foundation.errors import GraspError, Status
from torchgrasp.geometry.frames import real
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import TrialSpec

REGIMES = ("0.4:1", "0.15:0.4", "0.15:1.2", "0.18|1")
"""Distributions of friction."""
SURE = ("0.4:1", "0.15:1.2")
"""Regimes whose predictions must be closest."""
PROMISED = "0.2:0.9"
PROMISE = 0.9
"""The friction for which a share of the returned grasps is promised to hold, and this share."""
SETTINGS = tuple(itertools.product(("mujoco", "sapien"), (0.25, 0.1)))
"""Simulators and masses [kg], which bodies take in turn."""
FIRST = 50_000
"""Number of the first body: none of the bodies from here on chose a rule, or is in the success
model's trials.
"""
STARTS = 50
BODIES = 60
"""Number of bodies: one of each family, then second ones of some families."""
LIFTS = 4
"""Number of lifts of each best grasp: their frictions are the quantiles (i + 1/2) / `LIFTS`."""
LOW = 0.05
"""The quantile of the friction at which the most careful rule plans."""
GAIN = 0.03
"""Share of lifts by which knowing the distribution must beat knowing its mean."""
LIMIT = 1800.0
"""Limit [s] of the CPU time of one body."""
MEAN, HALF, LOWEST = "at the mean", "at half of the mean", "at the 5 % quantile"
"""Names of the rules; the second one is the default."""
NUMBER = "at half of the mean, told the mean alone"
"""Name of the rule of a planner that takes a number for the friction."""


def _low_margin(law: Distribution) -> float:
    return float(law.quantile(real([LOW]))) / law.mean


RULES: dict[str, Callable[[Distribution], ContactSpec]] = {
    MEAN: lambda law: ContactSpec(law, friction_margin=1.0, table=0.0),
    HALF: lambda law: ContactSpec(law, table=0.0),
    LOWEST: lambda law: ContactSpec(law, friction_margin=_low_margin(law), table=0.0),
    NUMBER: lambda law: ContactSpec(law.mean, table=0.0),
}


class Outcome(NamedTuple):
    """What one rule gave for a body of a family under a regime: the share of lifts that held, and what was
    predicted; NaN without a grasp.
    """

    family: str
    regime: str
    rule: str
    executable: int
    predicted: float
    held: float


@bench("plan/uncertain")
def uncertain(o: Options) -> list[Row]:
    """Lift the best grasp of each rule at quantiles of the friction; predictions know all of it."""
    folder = keep_at_commit(o, "uncertain")
    chosen = choose_bodies(o.times(BODIES))
    tasks = [(folder, k, o.hands[0], o.seed, setting) for k, setting in chosen]
    found = list[Outcome]()
    for outcomes in run_all(kept_body, tasks, o.workers, LIMIT):
        print(*outcomes, sep="\n", flush=True)
        found += [Outcome(*map(_number, outcome)) for outcome in outcomes]
    return describe(found)


def choose_bodies(count: int) -> list[tuple[int, tuple[str, float]]]:
    """Return numbers of bodies of families that are left out, with simulator and mass [kg].

    Families are spread evenly. More bodies than families are second ones, third ones, and so on.
    """
    left_out = [k for k in range(FIRST, FIRST + len(FAMILIES)) if family_of(k) in CALIBRATING]
    rounds, rest = divmod(count, len(left_out))
    chosen = [k + turn * len(FAMILIES) for turn in range(rounds) for k in left_out]
    chosen += [left_out[i * len(left_out) // rest] + rounds * len(FAMILIES) for i in range(rest)]
    return list(zip(chosen, itertools.cycle(SETTINGS), strict=False))


def see_body(k: int) -> tuple[HouseholdBody, PointCloud]:
    """Return body `k` and a noisy view of it."""
    body = author_household(k)
    eye = look_at(GOLDEN_ANGLE * k % 360, 35.0, target=body.mesh)
    return body, partial_view(body.mesh, eye, noise=True, seed=k)


def _number(value: Any) -> Any:
    """Return a value of a kept outcome, where NaN was written as null."""
    return math.nan if value is None else value


def kept_body(
    folder: Path | None, k: int, hand: str, seed: int, setting: tuple[str, float]
) -> list[Any]:
    """Return the fields of the outcomes of body `k`; those of a stopped run are read.

    They are kept in `folder`; without one all is measured.
    """
    if folder is None:
        return try_body(k, hand, seed, setting)
    simulator, mass = setting
    path = folder / f"{hand}_{k}_{seed}_{simulator}_{mass}.json"
    return keep(path, lambda: try_body(k, hand, seed, setting))


def try_body(k: int, hand: str, seed: int, setting: tuple[str, float]) -> list[tuple[Any, ...]]:
    """Return the fields of the outcomes of all rules and regimes for body `k`."""
    model = load_hand(hand)
    body, cloud = see_body(k)
    simulator, mass = setting
    family = family_of(k)
    found = list[tuple[Any, ...]]()
    for regime, (rule, spec_of) in itertools.product(REGIMES, RULES.items()):
        law = Distribution.parse(regime)
        good = plan(cloud, model, spec_of(law), mass, seed)
        outcome = lift_best(good, model, body, law, simulator, mass, seed)
        found.append((family, regime, rule, *outcome))
    law = Distribution.parse(PROMISED)
    good = plan(cloud, model, RULES[HALF](law), mass, seed, PROMISE)
    outcome = lift_best(good, model, body, law, simulator, mass, seed)
    found.append((family, PROMISED, f"promise {PROMISE}", *outcome))
    return found


def plan(
    cloud: PointCloud,
    hand: Hand,
    spec: ContactSpec,
    mass: float,
    seed: int,
    promise: float | None = None,
) -> Grasps | None:
    """Return the executable grasps of a view, best first; None if there are none."""
    task = GraspTask(mass)
    try:
        grasps = plan_grasps(cloud, hand, spec, STARTS, seed=seed, task=task, promise=promise)
    except GraspError:
        return None
    good = grasps[grasps.status == Status.OK]
    return good if len(good) else None


def lift_best(
    good: Grasps | None,
    hand: Hand,
    body: HouseholdBody,
    law: Distribution,
    simulator: str,
    mass: float,
    seed: int,
) -> tuple[int, float, float]:
    """Lift the first grasp at quantiles of the friction; return the last fields of an `Outcome`."""
    if good is None:
        return 0, math.nan, math.nan
    best = good[:1]
    truth = Truth(body.mesh, body.parts)
    held = list[bool]()
    for friction in law.quantile((torch.arange(LIFTS).double() + 0.5) / LIFTS).tolist():
        trial = TrialSpec(mass=mass, friction=friction, simulator=simulator)  # pyright: ignore[reportArgumentType]
        held.append(lift_grasp(GraspTrial(hand, best, truth, seed), trial).held)
    return len(good), float(torch.sigmoid(best.score)), sum(held) / LIFTS


def describe(found: list[Outcome]) -> list[Row]:
    """Return a row for each regime and rule, then the comparisons with targets."""
    cells = {
        (regime, rule): [x for x in found if x.regime == regime and x.rule == rule]
        for regime, rule in itertools.product(REGIMES, RULES)
    }
    rows = [describe_cell(regime, rule, cell) for (regime, rule), cell in cells.items()]
    for regime in REGIMES:
        held = {rule: mean_held(cells[regime, rule]) for rule in RULES}
        behind = held[HALF] - max(held.values())
        error = errors(cells[regime, HALF])
        bar = 0.05 if regime in SURE else 0.1
        what = f"friction {regime}: held, {HALF} minus the best rule"
        rows.append(Row(what, ">= -0.02", f"{behind:+.3f}", behind >= -0.02))
        what = f"friction {regime}: predicted minus held, {HALF}"
        rows.append(Row(what, f"<= {bar}", format_number(error), abs(error.value) <= bar))
    every = {rule: [x for r in REGIMES for x in cells[r, rule]] for rule in RULES}
    for rule in (MEAN, LOWEST, NUMBER):
        gain = contrast_over([sum_by(held_of(every[x])) for x in (HALF, rule)], [1.0, -1.0])
        target = ">= 0.03, interval above 0" if rule == NUMBER else "-"
        met = gain.value >= GAIN and gain.low > 0 if rule == NUMBER else None
        rows.append(Row(f"held, {HALF} minus {rule}", target, format_number(gain), met))
    refused = {rule: sum(not x.executable for x in every[rule]) for rule in RULES}
    what = f"plans without a grasp, of {len(every[HALF])}"
    text = ", ".join(f"{rule} {n}" for rule, n in refused.items())
    rows.append(Row(what, f"{HALF} <= {MEAN}", text, refused[HALF] <= refused[MEAN]))
    promised = [x for x in found if x.regime == PROMISED]
    kept = mean_over((x.family, x.held) for x in promised)
    answered = sum(x.executable > 0 for x in promised)
    what = f"friction {PROMISED}, promise {PROMISE}: held where returned"
    text = f"{format_number(kept, sign='')}, {answered} of {len(promised)} bodies answered"
    numbers = {"outcomes": [x._asdict() for x in found]}
    return [*rows, Row(what, f">= {PROMISE}", text, kept.value >= PROMISE, numbers)]


def describe_cell(regime: str, rule: str, cell: list[Outcome]) -> Row:
    """Return how often the grasps of a rule held beside what was predicted."""
    held = mean_over(held_of(cell))
    count = sum(x.executable for x in cell) / len(cell)
    without = sum(not x.executable for x in cell)
    text = (
        f"held {held.value:.3f}, predicted minus held {errors(cell).value:+.3f}, "
        f"{count:.1f} executable grasps, {without} bodies without"
    )
    return Row(f"friction {regime}, planned {rule}", "-", text)


def held_of(cell: Iterable[Outcome]) -> list[tuple[str, float]]:
    """Return the share of lifts that held of each body, by its family; 0 without a grasp."""
    return [(x.family, x.held if x.executable else 0.0) for x in cell]


def mean_held(cell: Iterable[Outcome]) -> float:
    """Return the mean share of lifts that held."""
    return mean_over(held_of(cell)).value


def errors(cell: Iterable[Outcome]) -> Share:
    """Return predicted minus held of the bodies with a grasp."""
    return mean_over((x.family, x.predicted - x.held) for x in cell if x.executable)
