"""What a second process brings to trials that share a machine of two cores."""

import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import Row
from torchgrasp import load_hand
from torchgrasp.close.evaluate import evaluate
from torchgrasp.shape.calibrate import list_views

SPEED_UP = 1.7
"""That two processes bring over one."""


def bench_workers(objects: Path, tries: int, starts: int, seed: int) -> list[Row]:
    """Time the same lifts of two objects on one process and on two; only on a quiet machine does that say anything."""
    hand, walls = load_hand("allegro"), {}
    names = sorted({name for name, _ in list_views(objects)})[:2]
    with tempfile.TemporaryDirectory() as shelf:
        options: dict[str, Any] = {"folder": Path(shelf), "only": names, "starts": starts, "seed": seed}
        evaluate(objects, hand, "tabletop", grasps=1, **options)
        for workers in (1, 2):
            began = time.perf_counter()
            scores = evaluate(objects, hand, "tabletop", grasps=tries, workers=workers, planned=True, **options)
            walls[workers] = time.perf_counter() - began
    count, ratio = sum(len(score.attempts) for score in scores), walls[1] / walls[2]
    told = f"{ratio:.2f}x: {count} trials in {walls[1]:.0f} s and in {walls[2]:.0f} s, the processes' start included"
    return [Row("trials on two processes over one", f"at least {SPEED_UP}x", told, ratio >= SPEED_UP, walls)]
