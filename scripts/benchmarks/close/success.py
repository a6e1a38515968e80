"""Whether predicted success is true: trials of grasps of all ranks on objects that the shipped model has not seen."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from torchgrasp.data import list_views, read_entry, read_object_mesh, read_view
from torchgrasp.errors import Status
from torchgrasp.evaluation import score
from torchgrasp.evaluation.protocols import PROTOCOLS, draw_error, seed_of
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.files import format_json, write_file
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.ranking import FEATURES, MODEL, success_features
from torchgrasp.jobs import run_tasks
from torchgrasp.planner import plan_grasps
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_surface
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ClosingMode, ContactSpec
from torchgrasp.values import load_grasps

TESTS: tuple[tuple[str, ClosingMode], ...] = (
    ("dexgraspbench", "open_loop"),
    ("dexgraspbench", "uncertainty"),
    ("dexgraspbench-hard", "open_loop"),
    ("dexgraspbench-hard", "uncertainty"),
    ("pose-noise", "uncertainty"),
    ("table-lift", "uncertainty"),
)
"""Protocols, of friction 0.8 to 0.3, and closings of the trials: what an executed grasp may meet. Every grasp is put
to the first and, in turn, to one of the others. A lift has to hold the object without slip."""

FRICTION = 0.6
"""At which grasps are planned: that of the first test."""

STARTS = 400
"""Random starts of the contact planner: planning takes half as long as with 1000."""

LIMIT = 3600.0
"""Wall time [s] that the trials of one object may take."""

PENALTY = 1.0
"""Inverse of the weight of the squared coefficients, of standardised features."""

ENOUGH, NEAR = 20, 0.08
"""Trials from which on a bin is judged, and how near the share that passed must then be to the prediction."""


class Trials(NamedTuple):
    """Trials of grasps: `features` (n, k), whether each `passed`, and of which object, family, hand and test."""

    features: np.ndarray
    passed: np.ndarray
    object: np.ndarray
    family: np.ndarray
    hand: np.ndarray
    test: np.ndarray

    def select(self, rows: np.ndarray) -> "Trials":
        """Return some of the trials, by a mask."""
        return Trials(*(column[rows] for column in self))


class SuccessModel(NamedTuple):
    """Weights of the features, a bias for each hand, and what an error of the hand's pose adds."""

    weights: np.ndarray
    bias: dict[str, float]
    pose_error: float

    @classmethod
    def shipped(cls) -> "SuccessModel":
        """Return the model that ranks grasps."""
        model = json.loads(MODEL.read_text("utf-8"))
        return cls(np.array([model["weights"][name] for name in FEATURES]), model["bias"], model["pose_error"])

    def predict(self, trials: Trials) -> np.ndarray:
        """Return the probability of each trial."""
        bias = np.array([self.bias[name] for name in trials.hand.tolist()])
        return 1 / (1 + np.exp(-(trials.features @ self.weights + bias + self.pose_error * beside_plan(trials))))


def beside_plan(trials: Trials) -> np.ndarray:
    """Tell which trials had an error of the hand's pose."""
    return np.char.startswith(trials.test, "pose-noise")


@bench("close/success", objects=True)
def success(o: Options) -> list[Row]:
    """Judge the shipped model on the objects of a folder, none of which it was fitted on."""
    hands, folder = o.hands, o.out / "success"
    trials, rows = read_trials(o.objects[0], hands, o.grasps, o.workers, folder), []
    predicted = SuccessModel.shipped().predict(trials)
    for hand in hands:
        mine = trials.hand == hand
        said = describe(predicted[mine], trials.select(mine))
        bins = [x for x in said["bins"] if x.passed.total >= ENOUGH]
        off = max((abs(x.predicted - x.passed.value) for x in bins), default=math.nan)
        skill, order, error = (float(said[name]) for name in ("skill", "auc", "error"))
        rows += [
            Row(f"{hand}: Brier skill, objects not fitted on", ">= 0.30", f"{skill:.2f}", skill >= 0.3, said),
            Row(f"{hand}: area under the curve", ">= 0.85", f"{order:.2f}", order >= 0.85, {}),
            Row(f"{hand}: expected calibration error", "<= 0.05", f"{error:.2f}", error <= 0.05, {}),
            Row(f"{hand}: {len(bins)} bins of {ENOUGH} trials", f"within {NEAR:.2f}", f"{off:.2f}", off <= NEAR, {}),
        ]
    draw_reliability(folder / "reliability.png", predicted, trials)
    print(*judge(predicted, trials), sep="\n")
    return rows


def read_trials(objects: Path, hands: Sequence[str], grasps: int, workers: int | None, folder: Path) -> Trials:
    """Return trials on the objects of a folder, running what is missing; nothing is run without workers (None).

    Raises:
        FileNotFoundError: the trials of an object came to no end.
    """
    names = sorted({name for name, _ in list_views(objects)})
    tasks = [(objects, name, hand, grasps, folder) for hand in hands for name in names]
    missing = [task for task in tasks if not kept_at(*task).exists()]
    if workers is None:
        tasks, missing = [task for task in tasks if task not in missing], []
    running = run_tasks(try_object, missing, workers or 0, LIMIT)
    for _ in tqdm(running, total=len(missing), disable=None, leave=False):
        pass
    rows = [row for task in tasks for row in describe_trials(*task)]
    return Trials(*(np.array([row[name] for row in rows]) for name in Trials._fields))


def kept_at(source: Path, name: str, hand: str, grasps: int, folder: Path) -> Path:
    """Return where the trials of an object are kept: those of another number of grasps stay apart."""
    return folder / f"{hand}_{source.name}_{name}_{grasps}.json"


def grasps_at(source: Path, name: str, hand: str, folder: Path) -> Path:
    """Return where the executable grasps of an object are kept."""
    return folder / "grasps" / hand / source.name / f"{name}.safetensors"


def try_object(source: Path, name: str, hand: str, grasps: int, folder: Path) -> None:
    """Plan on the first view of an object, and keep a row for each trial: grasp, test, and whether it passed."""
    model, rows, view = load_hand(hand), [], next(view for found, view in list_views(source) if found == name)
    planned = plan_grasps(read_view(source, name, view), model, ContactSpec(friction=FRICTION, table=0.0), STARTS)
    executable = planned[planned.status == Status.OK]
    executable.save(grasps_at(source, name, hand, folder))
    mesh = read_object_mesh(source, name)
    parts, first = convex_parts(mesh), seed_of(0, name, hand)
    for k, rank in enumerate(choose_rows(len(executable), grasps, "spread")):
        for test in (0, 1 + (first + k) % (len(TESTS) - 1)):
            protocol = PROTOCOLS[TESTS[test][0]].with_trial(closing=TESTS[test][1])
            seed, grasp = seed_of(0, name, hand, rank, test), executable[rank]
            error = draw_error(protocol, grasp, mesh, seed)
            trial = GraspTrial(model, grasp, Truth(mesh, parts, error), seed_of(seed, "touch"))
            passed = run_protocol(trial, protocol, rank).held
            rows.append({"object": name, "view": view, "hand": hand, "test": test, "rank": rank, "passed": passed})
    write_file(kept_at(source, name, hand, grasps, folder), format_json(rows))


def describe_trials(source: Path, name: str, hand: str, grasps: int, folder: Path) -> list[dict[str, Any]]:
    """Return the kept rows of an object with its family and the features of each grasp at its test's friction."""
    rows = json.loads(kept_at(source, name, hand, grasps, folder).read_text())
    if not rows:
        return []
    shape = fit_shape(read_view(source, name, rows[0]["view"]), table=0.0)
    center, family = extract_surface(shape).vertices.mean(0), read_entry(source, name).family or name
    model, planned = load_hand(hand), load_grasps(grasps_at(source, name, hand, folder))
    frictions = [PROTOCOLS[TESTS[row["test"]][0]].trial.friction for row in rows]
    for friction in sorted(set(frictions)):
        mine = [row for row, own in zip(rows, frictions, strict=True) if own == friction]
        tried = planned[torch.tensor([row["rank"] for row in mine])]
        features = success_features(model, shape, tried, center, friction)
        for row, known in zip(mine, features.tolist(), strict=True):
            row |= {"features": known, "family": family, "test": ", ".join(TESTS[row["test"]])}
    return rows


def fit(trials: Trials) -> SuccessModel:
    """Return a logistic regression of the features as they are, with one bias a hand."""
    hands, count = np.unique(trials.hand), trials.features.shape[1]
    known = np.column_stack([trials.features, beside_plan(trials), *(trials.hand == hand for hand in hands[1:])])
    scaler = StandardScaler().fit(known)
    model = LogisticRegression(C=PENALTY, tol=1e-10, max_iter=1000)
    model.fit(scaler.transform(known), trials.passed)
    weights = model.coef_[0] / scaler.scale_
    bias = float(model.intercept_[0] - weights @ scaler.mean_)
    more = dict(zip(hands.tolist(), [0.0, *weights[count + 1 :].tolist()], strict=True))
    biases = {hand: bias + added for hand, added in more.items()}
    return SuccessModel(weights[:count], biases, float(weights[count]))


def leave_one_out(trials: Trials) -> np.ndarray:
    """Return for each trial the prediction of a model fitted on the other families alone."""
    predicted = np.zeros(len(trials.passed))
    for name in np.unique(trials.family):
        mine = trials.family == name
        predicted[mine] = fit(trials.select(~mine)).predict(trials.select(mine))
    return predicted


def describe(predicted: np.ndarray, trials: Trials) -> dict[str, Any]:
    """Return what `torchgrasp.evaluation.score` finds of predictions, with intervals over families."""
    passed = torch.from_numpy(trials.passed.astype(bool))
    return score.judge(torch.from_numpy(predicted), passed, trials.family.tolist())


def judge(predicted: np.ndarray, trials: Trials) -> list[str]:
    """Return what is to be said of predictions: of all, each hand and each test; then the bins of all and each hand."""
    kinds = [("all", np.ones(len(predicted), dtype=bool))]
    kinds += [(str(name), trials.hand == name) for name in np.unique(trials.hand)]
    binned = len(kinds)
    kinds += [(str(name), trials.test == name) for name in np.unique(trials.test)]
    found, lines = [describe(predicted[mine], trials.select(mine)) for _, mine in kinds], []
    for (name, mine), said in zip(kinds, found, strict=True):
        scores = f"Brier {said['brier']:.3f}, skill {said['skill']:.2f}, AUC {said['auc']:.2f}, ECE {said['error']:.3f}"
        lines.append(
            f"{name}: {scores}, predicted {said['predicted']:.2f}, passed {said['passed']:.2f} of {mine.sum()}"
        )
    for (name, _), said in zip(kinds[:binned], found[:binned], strict=True):
        for x in said["bins"]:
            value, least, most, count, _ = x.passed
            lines.append(
                f"{name}, {x.low:.1f} to {x.high:.1f}: predicted {x.predicted:.2f}, "
                f"passed {value:.2f} [{least:.2f}, {most:.2f}] of {count}"
            )
    return lines


def draw_reliability(path: Path, predicted: np.ndarray, trials: Trials) -> None:
    """Draw the share that passed over the prediction, with intervals and counts."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 5.0), dpi=140, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xlabel="predicted success", ylabel="share that passed", xlim=(0, 1), ylim=(0, 1))
    axes.plot([0, 1], [0, 1], color="#7c8591", linewidth=1)
    axes.fill_between([0, 1], [-NEAR, 1 - NEAR], [NEAR, 1 + NEAR], color="#e7e5de", zorder=0)
    for x in describe(predicted, trials)["bins"]:
        value, low, high, count, _ = x.passed
        ends = [[0.0], [0.0]] if math.isnan(low) else [[value - low], [high - value]]
        axes.errorbar([x.predicted], [value], ends, fmt="o", color="#23967f", capsize=3)
        axes.annotate(f"{count}", (x.predicted, value), (6, -12), textcoords="offset points", color="#4b525b")
    axes.set_title(f"{len(predicted)} trials on objects not fitted on")
    write_file(path, lambda file: figure.savefig(file, format="png"))
