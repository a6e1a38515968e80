"""What an error of the hand's pose costs, with the controller and with the naive closing."""

import dataclasses
import tempfile
from pathlib import Path

from benchmarks.common import Row
from torchgrasp import load_hand
from torchgrasp.evaluation.evaluate import evaluate
from torchgrasp.evaluation.protocols import PROTOCOLS, Execution
from torchgrasp.evaluation.pull import PullProtocol
from torchgrasp.evaluation.score import share

MOST_LOST = 0.10
"""Of the share that passes without errors."""


def bench_noise(
    objects: Path, hands: tuple[str, ...], tries: int, draws: int, starts: int, seed: int, workers: int
) -> list[Row]:
    """Put the same grasps to the test with and without errors of the pose, by the controller and open loop."""
    noisy = PROTOCOLS["pose-noise"]
    assert isinstance(noisy, PullProtocol)
    tests = {"still": PROTOCOLS["dexgraspbench"], "noisy": dataclasses.replace(noisy, draws=draws)}
    rows = []
    for name in hands:
        with tempfile.TemporaryDirectory() as shelf:
            planned = False
            for closing, bar in (("uncertainty", MOST_LOST), ("open_loop", None)):
                found = {}
                for key, test in tests.items():
                    scores = evaluate(
                        objects, load_hand(name), test, Execution(closing=closing), tries, starts, seed,
                        workers=workers, folder=Path(shelf), planned=planned,
                    )  # fmt: skip
                    every = [attempt for score in scores for attempt in score.attempts]
                    found[key] = share(sum(attempt.passed for attempt in every), len(every))
                    planned = True
                lost = found["still"][0] - found["noisy"][0]
                words = [f"{key} {x[0]:.1%} [{x[1]:.1%}, {x[2]:.1%}] of {x[3]}" for key, x in found.items()]
                rows.append(
                    Row(
                        f"{name}, {closing}: loss by 5 mm and 5 degrees",
                        "none" if bar is None else f"at most {bar:.0%}",
                        f"{lost:+.1%}: {', '.join(words)}",
                        None if bar is None else lost <= bar,
                        found,
                    )
                )
    return rows
