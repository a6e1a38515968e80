"""Closing the hand beside its bars: both simulators, the parts of the closing, speed, stability."""

from collections.abc import Callable
from pathlib import Path

import torch
from paper.trials import TableSpec

from benchmarks.close.ablation import bench_ablation
from benchmarks.close.conditions import LAWS_OF_SENSORS
from benchmarks.close.holding import bench_holding
from benchmarks.close.household import bench_grip, bench_household
from benchmarks.close.misplaced import bench_misplaced
from benchmarks.close.pose_noise import bench_noise
from benchmarks.close.real_scans import bench_scans
from benchmarks.close.simulator_agreement import bench_agreement
from benchmarks.close.speed import bench_closing_speed
from benchmarks.close.stability import bench_stability
from benchmarks.close.statics import bench_statics
from benchmarks.close.success import bench_success
from benchmarks.common import Row, measure
from torchgrasp.evaluation.views import EvaluationSpec

SUBJECTS = (
    "statics", "speed", "ablation", "agreement", "stability", "noise", "success", "misplaced", "sensors",
    "perturb", "grip", "scans", "holding",
)  # fmt: skip


def close(
    objects: tuple[Path, ...] = (),
    only: tuple[str, ...] = SUBJECTS,
    hands: tuple[str, ...] = ("allegro",),
    tries: int = 4,
    draws: int = 5,
    grasps: int = 1,
    conditions: tuple[str, ...] = (),
    laws: tuple[str, ...] = (),
    names: tuple[str, ...] = (),
    starts: int = 1000,
    workers: int = 1,
    threads: int = 1,
    seed: int = 0,
    out: Path = Path("out/bench_close.json"),
) -> None:
    """Measure closing, lifting and pulling in simulation.

    Args:
        objects: folders with manifest.json and a folder for each object; without one what needs grasps is left out.
            Only misplaced, perturb, grip and scans take more than the first.
        only: subjects to measure. statics, speed, ablation, agreement, stability, noise and success are of the closing;
            misplaced, sensors, perturb, grip, scans and holding lift what a robot would meet, one object of each family
            (not scans).
        hands: of all but ablation and agreement, which take both.
        tries: grasps of each view: the best for noise, else spread over all ranks.
        draws: errors of the hand's pose for each grasp.
        grasps: the best of each view that perturb and grip lift; misplaced spreads them over all ranks.
        conditions: of misplaced and sensors, or perturbations of perturb; by default all.
        laws: of misplaced; by default all.
        names: of the objects that misplaced, perturb and grip keep; by default all.
        starts: of the contact planner.
        workers: processes that share the trials.
        threads: of torch.
        seed: of every draw.
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(threads)
    spec = EvaluationSpec(tries, starts=starts, seed=seed)
    folder = objects[0] if objects else None
    household = TableSpec(
        out.parent, objects, hands=hands, only=names, own=False, representatives=True, grasps=grasps, starts=starts,
        workers=workers, seed=seed,
    )  # fmt: skip
    subjects: dict[str, Callable[[], list[Row]]] = {
        "statics": bench_statics,
        "speed": bench_closing_speed,
        "ablation": lambda: bench_ablation(folder, tries, starts, seed, workers) if folder else [],
        "agreement": lambda: bench_agreement(folder, spec, workers) if folder else [],
        "stability": lambda: bench_stability(folder, tries, starts, seed) if folder else [],
        "noise": lambda: bench_noise(folder, hands, draws, spec, workers) if folder else [],
        "misplaced": lambda: bench_misplaced(household, conditions, laws) if folder else [],
        "sensors": lambda: bench_misplaced(household, conditions, laws or LAWS_OF_SENSORS) if folder else [],
        "perturb": lambda: bench_household(household, conditions) if folder else [],
        "grip": lambda: bench_grip(household) if folder else [],
        "holding": lambda: bench_holding(household) if folder else [],
        "scans": lambda: bench_scans(objects, hands, tries, starts, seed) if folder else [],
        "success": lambda: bench_success(folder, hands, tries, workers, out.parent / "success") if folder else [],
    }
    settings = {"tries": tries, "starts": starts, "threads": threads, "seed": seed, "torch": torch.__version__}
    measure("close", subjects, only, settings, out)
