"""Fit the model of predicted success to trials, calibrate it on families left out, and judge it
there.

`scripts/train.py trials` makes the trials. Two of three families fit boosted trees; more friction,
more force and less load never lower their prediction. The other families calibrate it: they scale
the log-odds, and give intervals. Their trials with `--best` choose the bounds of promises.

Later trials judge the model. Where it is right there, they can widen the range in which its
predictions count as known.
"""

import dataclasses
import itertools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy import ndarray as Array
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression

from torchgrasp.evaluation import summary as score
from torchgrasp.files import read_value, save_tensors
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.success.features import CAUSES, FEATURES
from torchgrasp.success.model import KIND, MODEL, SuccessModel
from train.household import CALIBRATING
from train.measured import Trials, read_trials
from train.trials import HANDS

TREES = {
    "max_iter": 100,
    "learning_rate": 0.05,
    "max_leaf_nodes": 16,
    "min_samples_leaf": 60,
    "l2_regularization": 5.0,
    "max_features": 0.3,
    "random_state": 0,
    "early_stopping": False,
}
"""Parameters of the boosted trees; families left out of the fit chose them."""

RISES = ("force to spare", *CAUSES["moved"], "friction")
FALLS = ("force needed", "mass", "displaced", "deviation", "tilt")
"""Features that never lower the prediction when they rise, or never raise it."""

FRICTIONS = (0.12, 0.2, 0.4, 0.6, 0.8, 1.21)
MASSES = (0.02, 0.05, 0.1, 0.25, 0.5, 1.01)
"""Edges of groups of trials, of friction and of mass [kg]."""

UNLIMITED = 1e9  # a bound that no feature reaches: files hold no infinity
# knots of the intervals, and how often their families are drawn anew
KNOTS = 12
DRAWS = 1000


def success(
    folders: tyro.conf.Positional[tuple[Path, ...]],
    best: tuple[Path, ...] = (),
    workers: int = 1,
    model: Path = MODEL,
) -> None:
    """Fit the model of predicted success to data sets of trials, judge it on families left out, and
    write it.

    Args:
        folders: of `scripts/train.py trials`.
        best: of the same with `--best`, after a fit to the same folders; without one the model
            makes no promise.
        workers: processes that measure the grasps; the features are kept in the folders.
        model: file of the model.
    """
    torch.set_num_threads(1)
    trials = read_trials(list_hands(folders), workers)
    left = np.isin(trials.family, list(CALIBRATING))
    fitted = fit_model(trials, left)
    print(*judge(fitted, trials.select(left)), sep="\n")
    about = {
        "fitted_on": f"{(~left).sum()} trials",
        "calibrated_on": f"{left.sum()} trials of other families",
    }
    if best:
        tried = read_at_rest(best, workers)
        fitted = dataclasses.replace(fitted, kept=keep_trials(fitted, tried))
        print("best grasps:", *judge(fitted, tried), sep="\n")
        about["promised_on"] = f"{len(tried.passed)} trials of best grasps"
    print(save_tensors(model, KIND, named_tensors(fitted), about))


def judge_fresh(
    folders: tyro.conf.Positional[tuple[Path, ...]],
    workers: int = 1,
    widen: bool = False,
    model: Path = MODEL,
) -> None:
    """Judge a fitted model on trials that it has not seen, of all families.

    Args:
        folders: of `scripts/train.py trials`.
        workers: processes that measure the grasps; the features are kept in the folders.
        widen: also write the model with a range that includes these trials.
        model: file of the model.
    """
    torch.set_num_threads(1)
    trials = read_trials(list_hands(folders), workers)
    fitted, about = read_value(model, KIND, SuccessModel)
    print(*judge(fitted, trials), sep="\n")
    if not widen:
        return
    seen = torch.from_numpy(find_range(trials.features))
    low = torch.minimum(fitted.range[:, 0], seen[:, 0])
    high = torch.maximum(fitted.range[:, 1], seen[:, 1])
    fitted = dataclasses.replace(fitted, range=torch.stack([low, high], -1))
    about["judged_on"] = f"{len(trials.passed)} later trials, to which the range was widened"
    print(save_tensors(model, KIND, named_tensors(fitted), about))


def promise(
    folders: tyro.conf.Positional[tuple[Path, ...]], workers: int = 1, model: Path = MODEL
) -> None:
    """Let trials of best grasps on further families choose the bounds of promises, too; write the
    model.

    Args:
        folders: of `scripts/train.py trials --best --objects`.
        workers: processes that measure the grasps; the features are kept in the folders.
        model: file of the model.

    Raises `BadArgument` for trials that support the promises already.
    """
    torch.set_num_threads(1)
    tried = read_at_rest(folders, workers)
    fitted, about = read_value(model, KIND, SuccessModel)
    print(*judge(fitted, tried), sep="\n")
    further = keep_trials(fitted, tried)
    # trials that count twice would pass for those of further families
    if bool(torch.isin(further[:, 0], fitted.kept[:, 0]).all()):
        raise BadArgument("folders", "trials that support the promises already", "other trials")
    # these families are none of those before
    further[:, 2] += fitted.kept[:, 2].max() + 1
    fitted = dataclasses.replace(fitted, kept=torch.cat([fitted.kept, further]))
    about["promised_on"] += f", {len(further)} of scanned and printed objects"
    print(save_tensors(model, KIND, named_tensors(fitted), about))


def read_at_rest(folders: Iterable[Path], workers: int) -> Trials:
    """Return the trials, of all hands, in which the object was where the planner saw it.

    Promises are made only for such trials.
    """
    tried = read_trials(list_hands(folders), workers)
    return tried.select(tried.features[:, FEATURES.index("displaced")] == 0)


def list_hands(folders: Iterable[Path]) -> list[Path]:
    """Return the folder of each hand's data set in folders that `scripts/train.py trials` wrote."""
    return [folder / hand for folder in folders for hand in HANDS if (folder / hand).exists()]


def fit_model(trials: Trials, left: Array) -> SuccessModel:
    """Return the model of success fitted to trials, without promises.

    The mask `left` (n,) chooses the trials that calibrate the model; its trees are fitted to the
    others.
    """
    monotonic = [directions().get(name, 0) for name in FEATURES]
    trees = HistGradientBoostingClassifier(**TREES, monotonic_cst=monotonic)
    trees.fit(trials.features[~left], trials.passed[~left])
    others = trials.select(left)
    fitted = read_trees(trees)
    raw = fitted.log_odds(torch.from_numpy(others.features)).numpy()
    platt = LogisticRegression(C=np.inf).fit(raw[:, None], others.passed)
    slope = float(platt.coef_[0, 0])
    shift = float(platt.intercept_[0])
    bands = find_bands(slope * raw + shift, others.passed, others.family)
    held = trials.features[trials.passed]
    return dataclasses.replace(
        fitted,
        value=slope * fitted.value,
        start=slope * fitted.start + shift,
        range=torch.from_numpy(find_range(trials.features)),
        usual=torch.from_numpy(np.median(held, 0)),
        bands=torch.from_numpy(bands),
    )


def keep_trials(model: SuccessModel, tried: Trials) -> torch.Tensor:
    """Return (log-odds, 1 if the grasp held else 0, number of the family) of each trial, (n, 3)."""
    odds = model.log_odds(torch.from_numpy(tried.features)).numpy()
    family = np.unique(tried.family, return_inverse=True)[1]
    return torch.from_numpy(np.stack([odds, tried.passed, family], -1))


def find_range(features: Array) -> Array:
    """Return the least and the greatest value of each of k features over trials, (k, 2).

    On the side on which grasps hold better there is no limit.
    """
    found = np.stack([features.min(0), features.max(0)], -1)
    for name, direction in directions().items():
        found[FEATURES.index(name), (direction + 1) // 2] = direction * UNLIMITED
    return found


def directions() -> dict[str, int]:
    """Return 1 for each feature with which the prediction may only rise, -1 where it may only fall.

    Other features are not in the dict.
    """
    return {name: 1 for name in RISES} | {name: -1 for name in FALLS}


def read_trees(trees: HistGradientBoostingClassifier) -> SuccessModel:
    """Return a model of success with the boosted trees of scikit-learn, without calibration."""
    nodes = [predictor[0].nodes for predictor in trees._predictors]  # pyright: ignore
    shape = len(nodes), max(map(len, nodes))
    feature = np.zeros(shape, dtype=np.int64)
    own = np.tile(np.arange(shape[1]), (shape[0], 1))
    threshold = np.zeros(shape)
    children = np.stack([own, own], -1)
    value = np.zeros(shape)
    for k, tree in enumerate(nodes):
        leaf = tree["is_leaf"].astype(bool)
        n = len(tree)
        feature[k, :n] = np.where(leaf, 0, tree["feature_idx"])
        threshold[k, :n] = np.where(leaf, 0.0, tree["num_threshold"])
        for side, name in enumerate(("left", "right")):
            children[k, :n, side] = np.where(leaf, own[k, :n], tree[name])
        value[k, :n] = np.where(leaf, tree["value"], 0.0)
    start = torch.tensor(float(trees._baseline_prediction.item()), dtype=torch.float64)  # pyright: ignore
    none = torch.zeros(0, 3, dtype=torch.float64)
    reads, bounds, links, values = map(torch.from_numpy, (feature, threshold, children, value))
    return SuccessModel(reads, bounds, links, values, start, none[:, :2], none[:, 0], none, none)


def find_bands(odds: Array, passed: Array, family: Array, seed: int = 0) -> Array:
    """Return (log-odds, low, high) of bins of trials: the 95 % interval of the share that held.

    `odds`, `passed` and `family` are those of n trials. The interval is from a bootstrap over
    families.
    """
    edges = np.quantile(odds, np.linspace(0, 1, KNOTS + 1))
    bins = np.clip(np.searchsorted(edges, odds, side="right") - 1, 0, KNOTS - 1)
    middle = np.array([odds[bins == b].mean() for b in range(KNOTS)])
    members = [np.flatnonzero(family == name) for name in np.unique(family)]
    draw = np.random.default_rng(seed)
    shares = np.full((DRAWS, KNOTS), np.nan)
    for k in range(DRAWS):
        rows = np.concatenate([members[i] for i in draw.integers(len(members), size=len(members))])
        total = np.bincount(bins[rows], minlength=KNOTS)
        shares[k] = (np.bincount(bins[rows], passed[rows], KNOTS) + 0.5) / (total + 1)
    low, high = np.nanquantile(shares, (0.025, 0.975), axis=0)
    return np.stack([middle, np.maximum.accumulate(low), np.maximum.accumulate(high)], -1)


def judge(model: SuccessModel, trials: Trials) -> list[str]:
    """Return lines of text on how well a model predicts trials: all trials, then each group."""
    p = torch.sigmoid(model.log_odds(torch.from_numpy(trials.features)))
    columns = dict(zip(FEATURES, trials.features.T, strict=True))
    friction = columns["friction"]
    mass = columns["mass"]
    groups = {
        "all": np.ones(len(p), dtype=bool),
        "20 best": trials.rank < 20,
        "lifts": columns["lifted"] > 0,
        "pulls": columns["lifted"] == 0,
        "best of its body": trials.is_best(model),
    }
    groups |= {hand: trials.hand == hand for hand in HANDS}
    for a, b in itertools.pairwise(FRICTIONS):
        groups[f"friction {a:g} to {b:g}"] = (friction >= a) & (friction < b)
    for a, b in itertools.pairwise(MASSES):
        groups[f"{a:g} to {b:g} kg"] = (mass >= a) & (mass < b)
    lines = []
    for name, rows in groups.items():
        passed = trials.passed[rows]
        if rows.sum() < 2 or len(np.unique(passed)) < 2:
            continue
        predicted = p[torch.from_numpy(rows)]
        said = score.judge(predicted, torch.from_numpy(passed), trials.family[rows].tolist())
        text = f"predicted {said['predicted']:.2f}, passed {said['passed']:.2f} of {rows.sum()}"
        error = f"AUC {said['auc']:.3f}, ECE {said['error']:.3f}, Brier skill {said['skill']:.2f}"
        lines.append(f"{name}: {text}; {error}")
    return lines
