"""Whether predicted success is true: trials of grasps of all ranks on objects that the shipped model has not seen."""

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.preprocessing import StandardScaler
from tqdm import tqdm

from benchmarks.common import Row
from torchgrasp.datasets import list_views, read_view
from torchgrasp.evaluation.campaign import EvaluationSpec, evaluate
from torchgrasp.evaluation.intervals import count_by, share_over
from torchgrasp.evaluation.pool import run_tasks
from torchgrasp.evaluation.protocols import PROTOCOLS
from torchgrasp.files import format_json, write_atomically, write_file
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.ranking import success_features, success_log_odds
from torchgrasp.pipeline import SURFACE_DRAWS
from torchgrasp.plan.closure_probability import closure_share
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.specs import ClosingMode
from torchgrasp.values import load_grasps

TESTS: tuple[tuple[str, ClosingMode], ...] = (
    ("dexgraspbench", "open_loop"),
    ("dexgraspbench", "uncertainty"),
    ("dexgraspbench-hard", "open_loop"),
    ("dexgraspbench-hard", "uncertainty"),
    ("pose-noise", "uncertainty"),
)
"""Protocols, of friction 0.6 and 0.3, and closings of the trials: what an executed grasp may meet, alike in weight.
Every grasp is put to each, to the errors of the hand's pose in one draw of its own."""

LIMIT = 3600.0
"""Wall time [s] that the trials of one object may take."""

PENALTY = 0.1
"""Inverse of the weight of the squared coefficients, of standardised features."""

EDGES = np.linspace(0.0, 1.0, 6)
"""Of the bins of predicted success in which reliability is looked at."""

ENOUGH, NEAR = 20, 0.10
"""Trials from which on a bin is judged, and how near the share that passed must then be to the prediction."""


def bench_success(objects: Path, hands: tuple[str, ...], grasps: int, workers: int, folder: Path) -> list[Row]:
    """Judge the shipped model on the objects of a folder, none of which it was fitted on."""
    trials = read_trials(objects, hands, grasps, workers, folder)
    features = torch.from_numpy(trials.features)
    predicted = torch.sigmoid(success_log_odds(features)).numpy()
    base = np.zeros(len(predicted))
    for protocol in np.unique(trials.protocol):
        mine = trials.protocol == protocol
        base[mine] = trials.passed[mine].mean()
    draw_reliability(folder / "reliability.png", predicted, trials)
    print(*judge(predicted, base, trials), sep="\n")
    mine, theirs = brier(predicted, trials.passed), brier(base, trials.passed)
    numbers = {"trials": len(trials.passed), "brier": mine, "base": theirs}
    bins = [x for x in reliability(predicted, trials) if x[2] >= ENOUGH]
    off = max((abs(mean - found[0]) for *_, mean, found in bins), default=math.nan)
    return [
        Row("Brier score on objects not fitted on", f"below {theirs:.3f}", f"{mine:.3f}", mine < theirs, numbers),
        Row(
            f"reliability of predicted success in bins of {ENOUGH} trials or more",
            f"within {NEAR:.2f}",
            f"{off:.2f} off at most in {len(bins)} bins",
            off <= NEAR,
            {"bins": bins},
        ),
    ]


class Trials(NamedTuple):
    """Trials of grasps: `features` (n, k), whether each `passed`, of which `object`, by which protocol and closing."""

    features: np.ndarray
    passed: np.ndarray
    object: np.ndarray
    protocol: np.ndarray
    closing: np.ndarray

    def select(self, rows: np.ndarray) -> "Trials":
        """Return some of the trials, by a mask."""
        return Trials(*(column[rows] for column in self))


def read_trials(objects: Path, hands: Sequence[str], grasps: int, workers: int, folder: Path) -> Trials:
    """Return trials on the objects of a folder, running what is missing.

    Raises:
        FileNotFoundError: the trials of an object came to no end.
    """
    names = sorted({name for name, _ in list_views(objects)})
    tasks = [(objects, name, hand, grasps, folder) for hand in hands for name in names]
    missing = [task for task in tasks if not kept_at(*task).exists()]
    for _ in tqdm(run_tasks(try_object, missing, workers, LIMIT), total=len(missing), disable=None, leave=False):
        pass
    rows = [row for task in tasks for row in json.loads(kept_at(*task).read_text())]
    return Trials(*(np.array([row[name] for row in rows]) for name in Trials._fields))


def kept_at(source: Path, name: str, hand: str, grasps: int, folder: Path) -> Path:
    """Return where the trials of an object are kept: those of another number of grasps stay apart."""
    return folder / f"{hand}_{source.name}_{name}_{grasps}.json"


def try_object(source: Path, name: str, hand: str, grasps: int, folder: Path) -> None:
    """Keep a row for each trial of an object: which it was, its features, and whether it passed."""
    rows, shelf = [], folder / "grasps" / hand / source.name
    for k, (protocol, closing) in enumerate(TESTS):
        test = PROTOCOLS[protocol].with_trial(closing=closing)
        test = dataclasses.replace(test, noise=dataclasses.replace(test.noise, draws=1))
        spec = EvaluationSpec(grasps, "spread", only=(name,), planned=k > 0)
        for score in evaluate(source, load_hand(hand), test, spec, folder=shelf):
            told = {"object": name, "view": score.view, "hand": hand, "protocol": protocol, "closing": closing}
            ranks = tuple(attempt.rank for attempt in score.attempts)
            known = known_of(source, name, score.view, shelf, test.trial.friction, ranks)
            rows += [
                {**told, "rank": attempt.rank, "features": features, "passed": attempt.passed}
                for attempt, features in zip(score.attempts, known, strict=True)
            ]
    write_file(kept_at(source, name, hand, grasps, folder), format_json(rows))


@functools.lru_cache(maxsize=16)
def known_of(
    source: Path, name: str, view: str, shelf: Path, friction: float, ranks: tuple[int, ...]
) -> list[list[float]]:
    """Return the features of some grasps of a view."""
    if not ranks:
        return []
    grasps = load_grasps(shelf / f"{name}_{view}.safetensors")[torch.tensor(ranks)]
    shape, center = shape_of(source, name, view)
    closure = closure_share(shape, grasps.contacts, friction, SURFACE_DRAWS, 0)
    return success_features(grasps.contacts, closure, grasps.normal_angle, center, friction).tolist()


@functools.lru_cache(maxsize=8)
def shape_of(source: Path, name: str, view: str) -> tuple[ShapeGP, torch.Tensor]:
    """Return the estimated shape of the object in a view, and its centre [m]."""
    shape = fit_shape(read_view(source, name, view), table=0.0)
    return shape, extract_surface(shape).vertices.mean(0)


def fit(trials: Trials) -> tuple[list[float], float]:
    """Return weights and bias of a logistic regression, of the features as they are."""
    scaler = StandardScaler().fit(trials.features)
    model = LogisticRegression(C=PENALTY, tol=1e-10, max_iter=1000)
    model.fit(scaler.transform(trials.features), trials.passed)
    weights = model.coef_[0] / scaler.scale_
    return weights.tolist(), float(model.intercept_[0] - weights @ scaler.mean_)


def leave_one_out(trials: Trials) -> tuple[np.ndarray, np.ndarray]:
    """Return for each trial the prediction, and the base rate of its protocol, both by the other objects alone."""
    predicted, base = np.zeros(len(trials.passed)), np.zeros(len(trials.passed))
    for name in np.unique(trials.object):
        mine = trials.object == name
        others = trials.select(~mine)
        weights, bias = fit(others)
        predicted[mine] = 1 / (1 + np.exp(-(trials.features[mine] @ weights + bias)))
        for protocol in np.unique(trials.protocol):
            base[mine & (trials.protocol == protocol)] = others.passed[others.protocol == protocol].mean()
    return predicted, base


def judge(predicted: np.ndarray, base: np.ndarray, trials: Trials) -> list[str]:
    """Return what is to be said of predictions: Brier scores, how they order, and reliability by bins and closings."""
    lines, y = [], trials.passed
    tests = np.char.add(np.char.add(trials.protocol, ", "), trials.closing)
    kinds = [("all", np.ones(len(y), dtype=bool))]
    kinds += [(str(name), column == name) for column in (trials.closing, tests) for name in np.unique(column)]
    for name, mine in kinds:
        scores = f"Brier {brier(predicted[mine], y[mine]):.3f}, base rate {brier(base[mine], y[mine]):.3f}"
        auc = f"AUC {roc_auc_score(y[mine], predicted[mine]):.2f}"
        rates = f"predicted {predicted[mine].mean():.2f}, passed {y[mine].mean():.2f} of {mine.sum()}"
        lines.append(f"{name}: {scores}, {auc}, {rates}")
    for name, mine in kinds[: 1 + len(np.unique(trials.closing))]:
        for low, high, count, mean, (value, least, most) in reliability(predicted[mine], trials.select(mine)):
            found = f"predicted {mean:.2f}, passed {value:.2f} [{least:.2f}, {most:.2f}] of {count}"
            lines.append(f"{name}, {low:.1f} to {high:.1f}: {found}")
    return lines


def reliability(predicted: np.ndarray, trials: Trials) -> list[tuple[float, float, int, float, tuple[float, ...]]]:
    """Return for each bin its ends, count, mean prediction, and the share that passed with its interval over bodies."""
    bins = []
    for low, high in itertools.pairwise(EDGES):
        mine = (predicted >= low) & ((predicted < high) | (high == EDGES[-1]))
        if mine.any():
            outcomes = zip(trials.object[mine].tolist(), trials.passed[mine].tolist(), strict=True)
            found = share_over(count_by(outcomes))[:3]
            bins.append((float(low), float(high), int(mine.sum()), float(predicted[mine].mean()), found))
    return bins


def brier(predicted: np.ndarray, y: np.ndarray) -> float:
    """Return the mean squared error of probabilities."""
    return float(((predicted - y) ** 2).mean())


def draw_reliability(path: Path, predicted: np.ndarray, trials: Trials) -> None:
    """Draw the share that passed over the prediction, with intervals and counts."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 5.0), dpi=140, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xlabel="predicted success", ylabel="share that passed", xlim=(0, 1), ylim=(0, 1))
    axes.plot([0, 1], [0, 1], color="#7c8591", linewidth=1)
    axes.fill_between([0, 1], [-0.1, 0.9], [0.1, 1.1], color="#e7e5de", zorder=0)
    for _, _, count, mean, (value, low, high) in reliability(predicted, trials):
        axes.errorbar([mean], [value], [[value - low], [high - value]], fmt="o", color="#23967f", capsize=3)
        axes.annotate(f"{count}", (mean, value), (6, -12), textcoords="offset points", color="#4b525b")
    axes.set_title(f"{len(predicted)} trials on objects not fitted on")
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="png"))
