"""Whether the order of a list is that of the friction at which its grasps hold.

The friction of the best grasps of a list is uncertain to the planner. Lifts at falling frictions
find the least one of a few levels at which each grasp holds.
"""

import math
from typing import NamedTuple

from scipy.stats import spearmanr
from train.household import CALIBRATING, FAMILIES, HouseholdBody, family_of

from benchmarks.common import Options, Row, bench, mean_over
from benchmarks.plan.uncertain import FIRST, plan, see_body
from torchgrasp import ContactSpec, Distribution, load_hand
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec

FRICTION = "0.15:1.2"
LEVELS = (0.12, 0.17, 0.24, 0.34, 0.48, 0.68, 0.96)
"""Frictions of the lifts, each about 1.4 times the one before."""
MASS = 0.25
"""Mass [kg] of the bodies."""
BEST = 20
GRASPS = 8
"""Best grasps of a list among which grasps are taken at even steps, and their number."""
BODIES = 15
LIMIT = 1800.0
"""Bodies, and wall time [s] of one body."""


class Order(NamedTuple):
    """Scores of grasps, and the index in `LEVELS` of the least friction at which each holds."""

    body: str
    scores: tuple[float, ...]
    levels: tuple[int, ...]

    @property
    def correlation(self) -> float:
        """Spearman's correlation of falling scores and rising frictions; 0 if one has no order."""
        if len(set(self.levels)) < 2 or len(set(self.scores)) < 2:
            return math.nan
        return -float(spearmanr(self.scores, self.levels)[0])


@bench("plan/critical_order")
def critical_order(o: Options) -> list[Row]:
    """Correlate scores within lists with the least friction at which grasps hold in MuJoCo."""
    count = o.times(BODIES)
    left_out = [k for k in range(FIRST, FIRST + len(FAMILIES)) if family_of(k) in CALIBRATING]
    step = max(1, len(left_out) // count)
    tasks = [(k, o.hands[0], o.seed) for k in left_out[1::step][:count]]
    found = list[Order]()
    for fields in run_tasks(try_list, tasks, o.workers, LIMIT):
        if isinstance(fields, Status):
            raise SystemExit(f"critical_order: a body ended with {fields.name}")
        print(*fields, flush=True)
        found.append(Order(*fields))
    ordered = [x for x in found if not math.isnan(x.correlation)]
    share = mean_over((x.body, x.correlation) for x in ordered)
    text = (
        f"{share.value:+.2f} [{share.low:+.2f}, {share.high:+.2f}] "
        f"of {len(ordered)} lists in which grasps differ, of {len(found)}"
    )
    numbers = {"orders": [x._asdict() for x in found]}
    what = f"friction {FRICTION}: rank correlation of score and simulated critical friction"
    return [Row(what, ">= 0.3", text, share.value >= 0.3, numbers)]


def try_list(k: int, hand: str, seed: int) -> tuple[str, tuple[float, ...], tuple[int, ...]]:
    """Return the fields of an `Order` of the grasps of body `k`."""
    model = load_hand(hand)
    body, cloud = see_body(k)
    spec = ContactSpec(Distribution.parse(FRICTION), table=0.0)
    good = plan(cloud, model, spec, MASS, seed)
    if good is None:
        return body.name, (), ()
    last = min(BEST, len(good)) - 1
    places = sorted({round(last * i / (GRASPS - 1)) for i in range(GRASPS)})
    levels = tuple(least_level(model, body, good[i : i + 1], seed) for i in places)
    return body.name, tuple(good.score[places].tolist()), levels


def least_level(hand: Hand, body: HouseholdBody, grasp: Grasps, seed: int) -> int:
    """Return the index of the least of `LEVELS` at which a grasp holds, by bisection; their number
    if it holds at none.
    """
    truth = Truth(body.mesh, body.parts)
    low, high = 0, len(LEVELS)
    while low < high:
        middle = (low + high) // 2
        trial = TrialSpec(mass=MASS, friction=LEVELS[middle], simulator="mujoco")
        if lift_grasp(GraspTrial(hand, grasp, truth, seed), trial).held:
            high = middle
        else:
            low = middle + 1
    return low
