"""Lifts with what a robot does not know of an object on a table, one thing at a time and all
together.

The best grasps of one view of each object are lifted under protocol "household". An object without
a grasp fails.
"""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from paper.tables6_7 import format_points
from paper.trials import Subject, TableSpec, subjects

from benchmarks.close.campaign import fit_view, keep, plan_view, read_solid, run_all, table_spec
from benchmarks.common import Options, Row, bench
from benchmarks.perturb import PERTURBATIONS, Perturbation, find_perturbation, perturb_trial
from torchgrasp import close_hand
from torchgrasp.evaluation import PROTOCOLS, PoseNoise
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.evaluation.protocols import draw_error, seed_of
from torchgrasp.foundation.errors import Status
from torchgrasp.hand.load import load_hand

HOUSEHOLD = PROTOCOLS["household"]

LEAST_HELD = 0.85
"""Share of the best grasps that must hold with everything unknown together: the project's own bar.
"""


@dataclasses.dataclass(frozen=True)
class Lift:
    """A lift of the grasp of a `rank`, of an object of a `family`; rank -1: there was none.

    `slip` [m, rad] is the object's motion in the hand, `mass` [kg] and `friction` are the true
    ones. None: no lift.
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


@bench("close/perturb", objects=True)
def perturb(o: Options) -> list[Row]:
    """Lift with nothing unknown, and with each factor alone and all of them, or under some
    perturbations only.
    """
    for name in o.conditions:
        find_perturbation(name)  # raises for an unknown one
    chosen = [name for name in PERTURBATIONS if not o.conditions or name in ("none", *o.conditions)]
    spec = table_spec(o)
    rows = list[Row]()
    for hand in spec.hands:
        tasks = [(spec, subject, hand, chosen) for subject in subjects(spec)]
        lifts: dict[str, list[Lift]] = {name: [] for name in chosen}
        for found in run_all(lift_object, tasks, spec.workers):
            for name, some in zip(chosen, found, strict=True):
                lifts[name] += [Lift(**lift) for lift in some]
        rows += [
            _row(f"{hand}, {name}", some, lifts["none"], name == "all")
            for name, some in lifts.items()
        ]
    return rows


def _row(what: str, lifts: Sequence[Lift], base: Sequence[Lift], judged: bool) -> Row:
    """Return the share that held, of the best grasps and of all, the loss, the slip, and what lost
    the rest.
    """
    best, first = (
        count_by((x.family, x.held) for x in some if x.rank <= 0) for some in (lifts, base)
    )
    lost = dict(Counter(x.status for x in lifts if not x.held).most_common())
    slips = np.array([x.slip for x in lifts if x.held], dtype=float).reshape(-1, 2) * (
        1e3,
        math.degrees(1),
    )
    median, most = (
        np.quantile(slips, [0.5, 0.95], axis=0) if len(slips) else np.full((2, 2), math.nan)
    )
    share = share_over(best)
    every = share_over(count_by((x.family, x.held) for x in lifts))
    change = contrast_over([best, first], [1.0, -1.0])
    words = [f"best one {format_share(share)}", f"change {format_points(change)}"]
    words += [f"all ranks tried {format_share(every)}"] if any(x.rank > 0 for x in lifts) else []
    words.append(
        f"slip {median[0]:.1f} mm, {median[1]:.1f} deg; 95 % below {most[0]:.1f} mm, {most[1]:.1f} deg"
    )
    numbers: dict[str, Any] = {"best": share, "change": change, "all": every, "lost": lost}
    numbers |= {
        "slip": [median.tolist(), most.tolist()],
        "objects": {x.object: x.status for x in lifts if x.rank <= 0},
    }
    numbers["seconds"] = sum(x.seconds for x in lifts) / max(len({x.object for x in lifts}), 1)
    bar, met = (f">= {LEAST_HELD:.0%}", share.value >= LEAST_HELD) if judged else ("-", None)
    return Row(f"held, {what}", bar, "; ".join([*words, f"lost {lost}"]), met, numbers)


def lift_object(
    spec: TableSpec, subject: Subject, hand: str, names: Sequence[str]
) -> list[list[dict[str, Any]]]:
    """Return the lifts of an object under each perturbation, kept or run."""
    found = []
    for name in names:
        what = f"{hand}_{subject.label}", name, HOUSEHOLD.trial.pressing, spec.grasps, spec.draws
        path = spec.kept("household", *what).with_suffix(".json")
        found.append(
            keep(path, lambda: list(map(dataclasses.asdict, _lift(spec, subject, hand, name))))  # noqa: B023
        )
    return found


def _lift(spec: TableSpec, subject: Subject, hand: str, name: str) -> Iterator[Lift]:
    """Lift the best grasps of one view under one perturbation."""
    perturbation = PERTURBATIONS[name]
    (mesh, parts, mass, view) = read_solid(subject)
    began = time.process_time()
    seen = seen_part(perturbation)
    grasps = plan_view(spec, subject, hand, HOUSEHOLD.trial.friction, seen)[: spec.grasps]
    spent = time.process_time() - began
    if not grasps:
        yield Lift(subject.label, subject.family, -1, "NO_GRASP", (None, None), mass, None, spent)
    for rank, grasp in enumerate(grasps):
        for draw in range(spec.draws):
            began = time.process_time()
            seed = seed_of(spec.seed, subject.label, view, rank, draw)
            trial = perturb_trial(HOUSEHOLD.trial, perturbation, mass, seed)
            error = draw_error(
                dataclasses.replace(HOUSEHOLD, noise=perturbation.pose), grasp, mesh, seed
            )
            felt = fit_view(spec, subject, seen)[1]
            done = close_hand(
                grasp, load_hand(hand), mesh, trial, seed, error=error, parts=parts, surface=felt
            )
            spent += time.process_time() - began
            slip = done.slip.distance, done.slip.angle
            told = (
                subject.label,
                subject.family,
                rank,
                done.status.name,
                slip,
                trial.mass,
                trial.friction,
            )
            yield Lift(*told, spent)
            spent = 0.0


def seen_part(perturbation: Perturbation) -> Perturbation:
    """Return the part of a perturbation that changes what is seen."""
    return dataclasses.replace(perturbation, mass=False, friction=None, pose=PoseNoise())
