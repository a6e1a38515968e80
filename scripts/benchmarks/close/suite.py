"""Closing the hand beside its bars: both simulators, the parts of the closing, speed, stability."""

from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.close.ablation import bench_ablation
from benchmarks.close.pose_noise import bench_noise
from benchmarks.close.simulator_agreement import bench_agreement
from benchmarks.close.speed import bench_closing_speed
from benchmarks.close.stability import bench_stability
from benchmarks.close.statics import bench_statics
from benchmarks.close.success import bench_success
from benchmarks.common import Row, measure
from torchgrasp.evaluation.campaign import EvaluationSpec

SUBJECTS = ("statics", "speed", "ablation", "agreement", "stability", "noise", "success")


def close(
    objects: Path | None = None,
    only: tuple[str, ...] = SUBJECTS,
    hands: tuple[str, ...] = ("allegro",),
    tries: int = 4,
    draws: int = 5,
    starts: int = 1000,
    workers: int = 1,
    threads: int = 1,
    seed: int = 0,
    out: Path = Path("out/bench_close.json"),
) -> None:
    """Measure closing, lifting and pulling in simulation.

    Args:
        objects: folder with manifest.json and a folder for each object; without it what needs grasps is left out.
        only: subjects to measure: statics, speed, ablation, agreement, stability, noise, success.
        hands: of noise and success; agreement takes both.
        tries: grasps of each view: the best for noise, else spread over all ranks.
        draws: errors of the hand's pose for each grasp.
        starts: of the contact planner.
        workers: processes that share the trials.
        threads: of torch.
        seed: of every draw.
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(threads)
    spec = EvaluationSpec(tries, starts=starts, seed=seed)
    subjects: dict[str, Callable[[], list[Row]]] = {
        "statics": bench_statics,
        "speed": bench_closing_speed,
        "ablation": lambda: bench_ablation(objects, tries, starts, seed, workers) if objects else [],
        "agreement": lambda: bench_agreement(objects, spec, workers) if objects else [],
        "stability": lambda: bench_stability(objects, tries, starts, seed) if objects else [],
        "noise": lambda: bench_noise(objects, hands, draws, spec, workers) if objects else [],
        "success": lambda: bench_success(objects, hands, tries, workers, out.parent / "success") if objects else [],
    }
    settings = {"tries": tries, "starts": starts, "threads": threads, "seed": seed, "torch": torch.__version__}
    measure("close", subjects, only, settings, out)
