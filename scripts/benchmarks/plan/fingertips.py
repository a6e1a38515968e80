"""Four and five fingertips beside three: how many starts end certified, in what time, and how they touch the truth."""

import dataclasses
import time
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.plan.true_surface import DEFAULT, FRICTION, closed_on_mesh
from torchgrasp import Status, fit_shape, plan_contacts
from torchgrasp.plan.certify import certify

MOST_TIME = {3: 1.0, 4: 3.0, 5: 5.0}
"""Most time of a start, over that of three fingertips."""


def bench_fingertips(views: list[Any], starts: int, seed: int) -> list[Row]:
    """Plan three, four and five contacts on every view."""
    measured: dict[int, list[tuple[float, float, float]]] = {f: [] for f in MOST_TIME}
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    for _, _, cloud, mesh in tqdm(views, desc="fingertips", disable=None, leave=False):
        shape = fit_shape(cloud, table=0.0)
        for f, found in measured.items():
            spec = dataclasses.replace(DEFAULT, fingertips=f)
            began = clock()
            plan = plan_contacts(shape, spec, starts, seed)
            seconds = clock() - began
            good = plan.contacts[plan.status == Status.OK]
            certified = good[certify(good, spec).closed]
            truth = float(closed_on_mesh(certified, mesh).double().mean()) if len(certified) else float("nan")
            found.append((len(certified) / starts, 1e3 * seconds / starts, truth))
    mean = {f: torch.tensor(rows, dtype=torch.float64).nanmean(0).tolist() for f, rows in measured.items()}
    return [
        Row(
            f"{f} fingertips, {len(views)} views: certified starts, time of a start, and share closed on the true "
            f"surface at friction {FRICTION}",
            f">= 95 %, <= {most:g}x the time of three",
            f"{certified:.1%}, {time_:.2f} ms ({time_ / mean[3][1]:.2f}x), {truth:.3f}",
            certified >= 0.95 and time_ <= most * mean[3][1],
            {"views": measured[f]},
        )
        for (f, most), (certified, time_, truth) in zip(MOST_TIME.items(), mean.values(), strict=True)
    ]
