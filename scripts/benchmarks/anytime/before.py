"""Another checkout of the project on the same views, in the same run."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from statistics import mean, median

from benchmarks.anytime.course import BEST, Course
from benchmarks.common import Row

OLD = """
import json, sys, time
from pathlib import Path
import torch
torch.set_num_threads(1)
from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
from torchgrasp.datasets import list_views, read_view
objects, hand, starts, only = Path(sys.argv[1]), load_hand(sys.argv[2]), int(sys.argv[3]), json.loads(sys.argv[4])
plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), 20)
found = {}
for name, view in only:
    cloud, began = read_view(objects, name, view), time.process_time()
    grasps = plan_grasps(cloud, hand, ContactSpec(table=0.0), starts)
    best = sorted(grasps.success.tolist(), reverse=True)[:20]
    found[f"{name}/{view}"] = time.process_time() - began, int((grasps.status == 0).sum()), sum(best) / 20
print(json.dumps(found))
"""
"""What another checkout is asked: seconds, executable grasps and mean success of the 20 best of each view."""


def bench_before(
    courses: list[Course], views: list[tuple[str, str]], arguments: list[str], before: Path | None
) -> list[Row]:
    """Measure another checkout on the same views, in the same run."""
    if before is None:
        raise SystemExit("before: the folder of a checkout, as in --before")
    environment = dict(os.environ, PYTHONPATH=str(before), OMP_NUM_THREADS="1")
    command = [sys.executable, "-c", OLD, *arguments, json.dumps(views)]
    done = subprocess.run(command, cwd=before, env=environment, capture_output=True, text=True, check=True)
    old = list(json.loads(done.stdout).values())
    pairs = [
        ("seconds of the whole call", mean(c.seconds for c in courses), mean(x[0] for x in old)),
        ("executable grasps", mean(c.executable for c in courses), mean(x[1] for x in old)),
        (f"success of the {BEST} best", mean(c.best(math.inf, BEST) for c in courses), mean(x[2] for x in old)),
        ("seconds to the first grasp, then all", median(c.time_of(1) for c in courses), median(x[0] for x in old)),
    ]
    return [
        Row(what, "none", f"{now:.3g} now, {then:.3g} before: {now / then:.2f}", None, {"now": now, "before": then})
        for what, now, then in pairs
    ]
