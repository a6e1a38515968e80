"""Another checkout of the project on the same views, in the same run."""

import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import mean, median

import numpy as np

from benchmarks.anytime.course import BEST, Course
from benchmarks.common import Row
from torchgrasp import PointCloud

OLD = """
import json, sys, time
from pathlib import Path
import numpy, torch
torch.set_num_threads(1)
from torchgrasp import ContactSpec, PointCloud, load_hand, load_object, plan_grasps
folder, hand, starts, spec = Path(sys.argv[1]), load_hand(sys.argv[2]), int(sys.argv[3]), ContactSpec(table=0.0)
plan_grasps(load_object("cylinder").view, hand, spec, 20)
for file in sorted(folder.glob("*.npz")):
    points, viewpoint = (torch.from_numpy(x) for x in numpy.load(file).values())
    began = time.process_time()
    grasps = plan_grasps(PointCloud(points, None, viewpoint), hand, spec, starts)
    success = torch.where(grasps.status == 0, torch.sigmoid(grasps.score), 0.0).sort(descending=True).values
    print(json.dumps([time.process_time() - began, int((grasps.status == 0).sum()), float(success[:20].sum()) / 20]))
"""
"""What another checkout is asked: seconds, executable grasps and mean predicted success of the 20 best of each view.
The clouds are handed over as arrays, which every version can take."""


def bench_before(
    courses: list[Course], clouds: list[PointCloud], hand: str, starts: int, before: Path | None
) -> list[Row]:
    """Measure another checkout on the same views, in the same run."""
    if before is None:
        raise SystemExit("before: the folder of a checkout, as in --before")
    environment = dict(os.environ, PYTHONPATH=str(before), OMP_NUM_THREADS="1")
    with tempfile.TemporaryDirectory() as folder:
        for k, cloud in enumerate(clouds):
            assert cloud.viewpoint is not None
            np.savez(Path(folder) / f"{k:04}.npz", points=cloud.points.numpy(), viewpoint=cloud.viewpoint.numpy())
        command = [sys.executable, "-c", OLD, folder, hand, str(starts)]
        done = subprocess.run(command, cwd=before, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{before}: {done.stderr.strip().splitlines()[-1]}")
    old = [json.loads(line) for line in done.stdout.splitlines()]
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
