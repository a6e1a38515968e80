"""Whether contacts planned at several frictions help where the friction is only a distribution."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from train.household import (
    CALIBRATING,
    FAMILIES,
    GOLDEN_ANGLE,
    author_household,
    family_of,
)

from benchmarks.common import Options, Row, bench, mean_over
from torchgrasp import ContactSpec, Distribution, GraspTask, load_hand, plan_grasps
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.foundation.errors import GraspError, Status
from torchgrasp.hand.hand import Hand
from torchgrasp.values.specs import TrialSpec

REGIMES = ("0.15:1.2", "0.18|1", "0.4:1", "0.15:0.4")
"""Distributions of friction."""
MASS = 0.25
FIRST = 30_000
"""Number of the first body: none of the bodies from here on is in the success model's trials."""
STARTS = 50
BODIES = 4
LIFTS = 4
"""Bodies, and lifts of each best grasp, with the frictions at the quantiles (i + 1/2) / `LIFTS`."""


class Outcome(NamedTuple):
    """What one rule gave for a body under a regime."""

    body: str
    executable: int
    predicted: float
    held: float
    planned: float


class OneFriction(ContactSpec):
    """Contacts are planned at `planned_friction` alone."""

    @property
    def planned_frictions(self) -> tuple[float, ...]:
        """The only friction."""
        return (self.planned_friction,)


RULES: dict[str, Callable[[Distribution], ContactSpec]] = {
    "at the mean": lambda law: OneFriction(law, friction_margin=1.0, table=0.0),
    "at half of the mean": lambda law: OneFriction(law, table=0.0),
    "in turn": lambda law: ContactSpec(law, table=0.0),
}


@bench("plan/uncertain")
def uncertain(o: Options) -> list[Row]:
    """Lift the best grasp of each rule at quantiles of the friction; predictions know all of it."""
    # one body of each family
    left_out = [k for k in range(FIRST, FIRST + len(FAMILIES)) if family_of(k) in CALIBRATING]
    step = max(1, len(left_out) // o.times(BODIES))
    hand = load_hand(o.hands[0])
    rows = list[Row]()
    for regime in REGIMES:
        law = Distribution.parse(regime)
        found: dict[str, list[Outcome]] = {name: [] for name in RULES}
        for k in left_out[::step][: o.times(BODIES)]:
            for name, rule in RULES.items():
                outcome = try_rule(k, hand, law, rule(law), o.seed)
                print(regime, name, *outcome, flush=True)
                found[name].append(outcome)
        rows += [describe(regime, name, outcomes) for name, outcomes in found.items()]
    return rows


def try_rule(k: int, hand: Hand, law: Distribution, spec: ContactSpec, seed: int) -> Outcome:
    """Plan on a view of body `k`, and lift the best grasp at quantiles of the friction."""
    body = author_household(k)
    eye = look_at(GOLDEN_ANGLE * k % 360, 35.0, target=body.mesh)
    cloud = partial_view(body.mesh, eye, noise=True, seed=k)
    none = Outcome(body.name, 0, math.nan, 0.0, math.nan)
    try:
        grasps = plan_grasps(cloud, hand, spec, STARTS, seed=seed, task=GraspTask(MASS))
    except GraspError:
        return none
    good = grasps[grasps.status == Status.OK]
    if not len(good):
        return none
    best = good[:1]
    truth = Truth(body.mesh, body.parts)
    held = list[bool]()
    for friction in law.quantile((torch.arange(LIFTS).double() + 0.5) / LIFTS).tolist():
        trial = TrialSpec(mass=MASS, friction=friction, simulator="mujoco")
        held.append(lift_grasp(GraspTrial(hand, best, truth, seed), trial).held)
    planned = best.certificate.friction
    at = spec.planned_friction if planned is None else float(planned)
    predicted = float(torch.sigmoid(best.score))
    return Outcome(body.name, len(good), predicted, sum(held) / LIFTS, at)


def describe(regime: str, rule: str, outcomes: list[Outcome]) -> Row:
    """Return how often the grasps of a rule held beside what was predicted."""
    planned = [x for x in outcomes if x.executable]
    held = mean_over((x.body, x.held) for x in outcomes)
    error = mean_over((x.body, x.predicted - x.held) for x in planned)
    count = sum(x.executable for x in outcomes) / len(outcomes)
    text = (
        f"held {held.value:.2f}, predicted minus held {error.value:+.2f}, "
        f"{count:.1f} executable grasps, {len(outcomes) - len(planned)} bodies without"
    )
    numbers = {"outcomes": [x._asdict() for x in outcomes]}
    return Row(f"friction {regime}, planned {rule}", "-", text, numbers=numbers)
