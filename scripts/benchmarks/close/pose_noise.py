"""What an error of the hand's pose costs, closed under the law and in open loop."""

import dataclasses
import tempfile
from pathlib import Path

from benchmarks.common import Row
from torchgrasp import load_hand
from torchgrasp.evaluation import EvaluationSpec, evaluate
from torchgrasp.evaluation.intervals import count_by, difference_over, format_share, share_over
from torchgrasp.evaluation.protocols import PROTOCOLS

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
                counts = {}
                for key, test in tests.items():
                    scores = evaluate(
                        objects,
                        load_hand(name),
                        test.with_trial(closing=closing),
                        dataclasses.replace(spec, planned=planned),
                        folder=Path(folder),
                        workers=workers,
                    )
                    counts[key] = count_by((score.unit, a.passed) for score in scores for a in score.attempts)
                    planned = True
                lost = difference_over(counts["still"], counts["noisy"])
                shares = {key: share_over(x) for key, x in counts.items()}
                words = [f"{key} {format_share(x)}" for key, x in shares.items()]
                rows.append(
                    Row(
                        f"{name}, {closing}, {spec.tried}: loss by 5 mm and 5 degrees",
                        "none" if bar is None else f"at most {bar:.0%}",
                        f"{format_share(lost)}: {', '.join(words)}",
                        None if bar is None else lost.value <= bar,
                        {**shares, "lost": lost},
                    )
                )
    return rows
