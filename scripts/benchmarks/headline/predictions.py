"""Whether predicted success is true, whether the best grasp is the best, and whether a promise is
kept.

The left-out objects are planned on: the model of success was not fitted on them. The 20 best grasps
and some that follow are pulled at by protocol "dexgraspbench".
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from paper.trials import CELL_SECONDS, Subject, TableSpec, read_solid, subjects

from benchmarks.common import Options, Row, bench, keep, mean_over, run_all
from benchmarks.headline.left_out import LEFT_OUT
from torchgrasp import plan_grasps
from torchgrasp.evaluation import summary as score
from torchgrasp.evaluation.intervals import Share, count_by, format_share, share_over
from torchgrasp.evaluation.protocols import PROTOCOLS, seed_of
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.files import sha256
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.load import load_hand
from torchgrasp.success.model import MODEL
from torchgrasp.success.promise import find_promise
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import ContactSpec

HAND = "allegro"
SIMULATOR = "mujoco"
FRICTIONS = (0.3, 0.6, 0.8)
MASSES = (0.05, 0.1, 0.25)
"""Hand and simulator of all trials; coefficients of friction, and masses [kg] that take turns with
them.
"""
BEST = 20
OTHERS = 4
"""Best grasps that are tried of each plan, and grasps tried of those that follow."""
SHARE = 0.9
"""Share of held grasps that is promised."""
ENOUGH = 100
"""Trials from which on a group is judged."""


class Cell(NamedTuple):
    """One plan on one object, and the trials of its grasps.

    `executable` counts the grasps that passed all checks, and `mass` is in kg. `tried` holds for
    each trial the grasp's rank from 0, its predicted success, and whether it passed.
    """

    object: str
    family: str
    group: str
    hand: str
    friction: float
    mass: float
    executable: int
    tried: list[tuple[int, float, bool]]

    @property
    def best(self) -> list[tuple[int, float, bool]]:
        """The trials (rank, predicted success, passed) of the 20 best grasps."""
        return [x for x in self.tried if x[0] < BEST]


def table_spec(o: Options, representatives: bool) -> TableSpec:
    """Return the settings of a campaign of trials, given the options of a bench.

    If `representatives`, the campaign has one object of each family, else all.
    """
    return TableSpec(
        o.out,
        o.objects,
        only=o.names,
        own=False,
        representatives=representatives,
        starts=o.starts,
        seed=o.seed,
    )


@bench("headline/pulls", objects=True)
def pulls(o: Options) -> list[Row]:
    """Pull at grasps of the Allegro hand, each object at one friction and mass: they take turns."""
    spec = table_spec(dataclasses.replace(o, names=o.names or LEFT_OUT), representatives=False)
    tasks = [(spec, x, FRICTIONS[k % 3], MASSES[k // 3 % 3]) for k, x in enumerate(subjects(spec))]
    cells = [Cell(*found) for found in run_all(try_object, tasks, o.workers, CELL_SECONDS)]
    planned = [cell for cell in cells if cell.tried]
    rows = [Row("views with an executable grasp", "-", f"{len(planned)} of {len(cells)}")]
    if planned:
        rows += judge_predictions(planned) + judge_order(planned) + judge_promise(planned)
    return rows


def try_object(spec: TableSpec, subject: Subject, friction: float, mass: float) -> tuple[Any, ...]:
    """Plan on the first view of an object, and pull at grasps of its plan; return the fields of a
    `Cell`.

    A result that an earlier call kept in a file is read.
    """
    about = (subject.label, subject.family, subject.group, HAND, friction, mass)
    asked = friction, mass, SIMULATOR, sha256(MODEL)[:12]
    path = spec.kept("success", f"{HAND}_{subject.label}", *asked).with_suffix(".json")
    executable, tried = keep(path, lambda: pull_at(spec, subject, friction, mass))
    return *about, executable, tried


def pull_at(
    spec: TableSpec, subject: Subject, friction: float, mass: float
) -> tuple[int, list[tuple[int, float, bool]]]:
    """Plan on the first view of an object and pull at its grasps; return (executable, tried).

    `executable` is the number of grasps that passed all checks. `tried` has (rank, predicted
    success, passed) of each trial: of the 20 best grasps, and of some that follow.
    """
    base = PROTOCOLS["dexgraspbench"]
    model = load_hand(HAND)
    solid = read_solid(subject)
    patch = base.trial.patch * Distribution.of(base.trial.friction).mean / friction
    protocol = base.with_trial(friction=friction, mass=mass, patch=patch, simulator=SIMULATOR)
    contacts = ContactSpec(friction, table=Plane.horizontal(0.0))
    cloud = next(iter(solid.views.values()))
    grasps = plan_grasps(cloud, model, contacts, spec.starts, spec.seed, task=protocol.task)
    good = grasps.executable
    more = max(len(good) - BEST, 0)
    rest = [BEST + k for k in choose_rows(more, OTHERS, "spread")] if more else []
    tried = list[tuple[int, float, bool]]()
    for rank in (*range(min(BEST, len(good))), *rest):
        seed = seed_of(spec.seed, subject.label, rank)
        trial = GraspTrial(model, good[rank], Truth(solid.mesh, solid.parts), seed)
        predicted = float(torch.sigmoid(good.score[rank]))
        tried.append((rank, predicted, run_protocol(trial, protocol, rank).passed))
    return len(good), tried


def judge_predictions(cells: list[Cell]) -> list[Row]:
    """Return rows that judge the predicted success of grasps.

    They are the calibration error of all trials and of each group, and the areas under the ROC
    curve. The last row has the share that passed by bins of the prediction.
    """
    groups = {"all": cells, **group_cells(cells)}
    rows = list[Row]()
    for name, mine in groups.items():
        trials = [(cell.family, *x) for cell in mine for x in cell.tried]
        if len(trials) < ENOUGH:
            continue
        said = judge_trials(trials)
        bar = 0.04 if name == "all" else 0.08
        error = said["error"]
        text = f"{error:.3f} of {len(trials)}: predicted {said['predicted']:.2f}"
        text += f", passed {said['passed']:.2f}"
        rows.append(Row(f"calibration error, {name}", f"<= {bar}", text, error <= bar, said))
    every = judge_trials([(cell.family, *x) for cell in cells for x in cell.tried])
    best = judge_trials([(cell.family, *x) for cell in cells for x in cell.best])
    for name, said, bar in (("20 best", best, 0.8), ("all ranks", every, 0.88)):
        area = said["auc"]
        rows.append(Row(f"area under the curve, {name}", f">= {bar}", f"{area:.3f}", area >= bar))
    bins = [f"{x.predicted:.2f}: {format_share(x.passed)}" for x in every["bins"]]
    return [*rows, Row("predicted and passed", "-", "; ".join(bins))]


def judge_trials(trials: Iterable[tuple[str, int, float, bool]]) -> dict[str, Any]:
    """Return calibration error, area under the curve and bins of predictions, by `score.judge`.

    A trial is (family, rank, predicted success, passed).
    """
    units, _, predicted, passed = zip(*trials, strict=True)
    return score.judge(torch.tensor(predicted, dtype=torch.float64), torch.tensor(passed), units)


def judge_order(cells: list[Cell]) -> list[Row]:
    """Return rows that judge the order of grasps.

    The first says how much more often the best grasp passes than the mean of the 20 best. For each
    group follow the shares that passed: of the best grasp, and of one of the best two.
    """
    gains = [
        (c.family, 100 * (c.best[0][2] - sum(x[2] for x in c.best) / len(c.best))) for c in cells
    ]
    gain = mean_over(gains)
    text = f"{gain.value:+.1f} [{gain.low:.1f}, {gain.high:.1f}] points of {gain.total} plans"
    met = gain.value >= 6 and gain.low > 0
    rows = [Row("best one over the mean of 20 best", ">= +6 points", text, met)]
    bars = {"solid": (95, 99), "shell": (90, 97), "thin": (80, 90)}
    for name, (one, two) in bars.items():
        mine = [cell for cell in cells if cell.group == name]
        first = share_of(mine, lambda cell: cell.best[0][2])
        both = share_of(mine, lambda cell: any(x[2] for x in cell.best[:2]))
        rows.append(bar_row(f"best one, {name}", one, first))
        rows.append(bar_row(f"within two tries, {name}", two, both))
    return rows


def judge_promise(cells: list[Cell]) -> list[Row]:
    """Return rows that judge the promise that a share `SHARE` of the returned grasps holds.

    A plan whose best grasp has too low a prediction is refused. The first row is the share of
    refused plans. The others are the share of the other plans whose best grasp passed, by group.
    """
    promise = find_promise(SHARE)
    if promise is None:
        return [Row(f"promise {SHARE:g}", "a bound", "the trials support none", False)]
    least = float(torch.sigmoid(torch.tensor(promise.least)))
    kept = [cell for cell in cells if cell.best[0][1] >= least]
    refused = 100 * (1 - len(kept) / len(cells))
    what = f"promise {SHARE:g}: views refused"
    rows = [Row(what, "<= 15 %", f"{refused:.1f} %", refused <= 15, {"least": least})]
    for name, mine in {"all": kept, **group_cells(kept)}.items():
        found = share_of(mine, lambda cell: cell.best[0][2])
        rows.append(bar_row(f"promise {SHARE:g}: held of returned, {name}", 100 * SHARE, found))
    return rows


def group_cells(cells: list[Cell]) -> dict[str, list[Cell]]:
    """Return the plans in groups by name: by group of objects, by friction, by mass and by hand.

    Each plan is in four of these groups.
    """
    keys: tuple[Callable[[Cell], str], ...] = (
        lambda cell: cell.group,
        lambda cell: f"friction {cell.friction:g}",
        lambda cell: f"{cell.mass:g} kg",
        lambda cell: cell.hand,
    )
    names = [sorted({key(cell) for cell in cells}) for key in keys]
    return {
        n: [c for c in cells if key(c) == n]
        for key, some in zip(keys, names, strict=True)
        for n in some
    }


def share_of(cells: list[Cell], held: Callable[[Cell], bool]) -> Share:
    """Return the share of plans for which `held` is true, with its interval over families."""
    return share_over(count_by((cell.family, held(cell)) for cell in cells))


def bar_row(what: str, bar: float, found: Share) -> Row:
    """Return the row `what` for a share of plans, with its target: at least `bar` percent."""
    met = 100 * found.value >= bar if found.total else None
    return Row(what, f">= {bar:g} %", format_share(found), met)
