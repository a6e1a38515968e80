"""What an error of the hand's pose costs, closed under the law and in open loop."""

import dataclasses
import tempfile
from pathlib import Path

from benchmarks.common import Row
from torchgrasp import load_hand
from torchgrasp.evaluation.campaign import EvaluationSpec, evaluate
from torchgrasp.evaluation.protocols import PROTOCOLS
from torchgrasp.evaluation.score import share

MOST_LOST = 0.10
"""Largest loss of the share that passes without errors: the project's own bar."""


def bench_noise(objects: Path, hands: tuple[str, ...], draws: int, spec: EvaluationSpec, workers: int) -> list[Row]:
    """Put the same grasps to the test with and without errors of the pose, under the law and in open loop."""
    noisy = PROTOCOLS["pose-noise"]
    noisy = dataclasses.replace(noisy, noise=dataclasses.replace(noisy.noise, draws=draws))
    tests = {"still": PROTOCOLS["dexgraspbench"], "noisy": noisy}
    rows = []
    for name in hands:
        with tempfile.TemporaryDirectory() as folder:
            planned = False
            for closing, bar in (("uncertainty", MOST_LOST), ("open_loop", None)):
                shares = {}
                for key, test in tests.items():
                    scores = evaluate(
                        objects,
                        load_hand(name),
                        test.with_trial(closing=closing),
                        dataclasses.replace(spec, planned=planned),
                        folder=Path(folder),
                        workers=workers,
                    )
                    attempts = [attempt for score in scores for attempt in score.attempts]
                    shares[key] = share(sum(attempt.passed for attempt in attempts), len(attempts))
                    planned = True
                lost = shares["still"][0] - shares["noisy"][0]
                words = [f"{key} {x[0]:.1%} [{x[1]:.1%}, {x[2]:.1%}] of {x[3]}" for key, x in shares.items()]
                rows.append(
                    Row(
                        f"{name}, {closing}: loss by 5 mm and 5 degrees",
                        "none" if bar is None else f"at most {bar:.0%}",
                        f"{lost:+.1%}: {', '.join(words)}",
                        None if bar is None else lost <= bar,
                        shares,
                    )
                )
    return rows
