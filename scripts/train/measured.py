"""Trials with the features of their grasps, from which the model of success is fitted."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy import ndarray as Array
from tqdm import tqdm

from torchgrasp.campaign.folder import ASKED, PARTS
from torchgrasp.data.shards import JobRow, load_shard
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.shape.fit import fit_shape
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.features import FEATURES, measure_grasps
from torchgrasp.success.model import SuccessModel
from torchgrasp.success.task import Conditions
from torchgrasp.values.planning import Grasps, PointCloud
from train.trials import BEST, SPREAD, Trial, read_rows

LIMIT = 7200.0
"""CPU time [s] in which the grasps of one data set are measured."""


class Trials(NamedTuple):
    """n simulated trials of grasps, with the k features of success (`FEATURES`) of each.

    `features` are (n, k). `passed`, `family`, `rank` and `hand` are (n,): whether the grasp held,
    the body's family, the grasp's rank and the hand's name. `beside` (n, m, k) holds the features
    of all grasps that were tried on the same body, for the task of the trial. It is NaN where there
    are fewer than m. `place` (n,) says which of them the trial tried.
    """

    features: Array
    passed: Array
    family: Array
    rank: Array
    hand: Array
    beside: Array
    place: Array

    def select(self, rows: Array) -> "Trials":
        """Return those of the trials that a mask (n,) or indices choose."""
        return Trials(*(column[rows] for column in self))

    def is_best(self, model: SuccessModel) -> Array:
        """Return a mask (n,) of the trials whose grasp has the greatest predicted success.

        It is the greatest of all grasps that were tried on the same body.
        """
        odds = model.log_odds(torch.from_numpy(self.beside.reshape(-1, len(FEATURES)))).numpy()
        odds = np.where(np.isnan(self.beside[..., 0]), -np.inf, odds.reshape(self.beside.shape[:2]))
        return odds.argmax(1) == self.place


def read_trials(folders: Sequence[Path], workers: int = 1) -> Trials:
    """Return all trials of data sets that `scripts/train.py trials` wrote, with their features.

    Features that an earlier call kept are read; others are measured in `workers` processes. Of a
    data set that is not finished, its jobs so far are read.
    """
    missing = [(folder,) for folder in folders if not kept_features(folder).exists()]
    for _ in tqdm(
        run_tasks(measure_folder, missing, workers, LIMIT), total=len(missing), disable=None
    ):
        pass
    parts = [np.load(kept_features(folder)) for folder in folders]
    return Trials(*(np.concatenate([part[name] for part in parts]) for name in Trials._fields))


def kept_features(folder: Path) -> Path:
    """Return the path of the file in a data set that keeps the features of its present trials."""
    names = *FEATURES, *(path.name for path in list_shards(folder))
    return folder / f"features-{hashlib.sha256(','.join(names).encode()).hexdigest()[:8]}.npz"


def list_shards(folder: Path) -> list[Path]:
    """Return the paths of a data set's files: first complete shards, then those of single jobs."""
    return [*sorted(folder.glob("*.safetensors")), *sorted((folder / PARTS).glob("*.safetensors"))]


def measure_folder(folder: Path) -> None:
    """Measure the features of all trials of a data set, and write them to a file in its folder."""
    asked = json.loads((folder / ASKED).read_text("utf-8"))["hand"]
    shards = [load_shard(path, {}) for path in list_shards(folder)]
    found = measure_jobs(load_hand(asked["name"], asked["option"]), read_rows(shards))
    np.savez_compressed(kept_features(folder), **found._asdict())


def measure_jobs(
    hand: Hand, jobs: Iterable[tuple[JobRow, PointCloud, Grasps, list[Trial]]]
) -> Trials:
    """Return the trials, with their features, of jobs of one hand; `read_rows` yields such jobs."""
    columns = [measure_job(hand, cloud, grasps, trials) for _, cloud, grasps, trials in jobs]
    return Trials(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def measure_job(hand: Hand, cloud: PointCloud, grasps: Grasps, trials: list[Trial]) -> Trials:
    """Return the trials on one view of a body with their features, measured on the view's shape."""
    body = EstimatedBody.of(fit_shape(cloud, table=0.0))
    n = len(trials)
    beside = np.full((n, BEST + SPREAD, len(FEATURES)), np.nan)
    for k, trial in enumerate(trials):
        task = trial.task.known
        conditions = Conditions.of(trial.task.friction, task.mass)
        lifted = trial.task.lift
        beside[k, :n] = measure_grasps(hand, body, grasps, conditions, task, lifted)[0].numpy()
    place = np.arange(n)
    return Trials(
        features=beside[place, place],
        passed=np.array([trial.passed for trial in trials]),
        family=np.array([trial.family for trial in trials]),
        rank=np.array([trial.rank for trial in trials]),
        hand=np.array([hand.name] * n),
        beside=beside,
        place=place,
    )
