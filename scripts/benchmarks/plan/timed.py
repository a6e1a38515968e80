"""Times one tree of torchgrasp: python timed.py THREADS, with the tree first in PYTHONPATH.

Each line of the input is a job, as `["plan", {"hand": "allegro", ...}]`, and each line of the
output its numbers. Jobs use only names that the trees of commits since 5382ed30 have.
"""

import dataclasses
import inspect
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchgrasp import (
    ContactSpec,
    Hand,
    PointCloud,
    fit_shape,
    load_hand,
    load_object,
    plan_grasps,
    stream_grasps,
)
from torchgrasp.shape.surface import extract_surface, surface_field

POINTS = 10_000
"""Points that are predicted."""


class Calls(TorchDispatchMode):
    """A context that counts the operations of torch inside it, in `count`."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count an operation, and run it."""
        self.count += 1
        return func(*args, **(kwargs or {}))


@cache
def read_hand(name: str) -> Hand:
    """Return the shipped hand `name`; it is loaded once in this process."""
    return load_hand(name)


def read_view(view: str) -> PointCloud:
    """Return the cloud [m] of a file of `write_view`; "jug" means the view of the shipped jug."""
    if view == "jug":
        return load_object("jug").view
    with np.load(view) as fields:
        return PointCloud(**{name: torch.from_numpy(fields[name]) for name in fields.files})


def time_stream(
    cloud: PointCloud, hand: Hand, friction: float, starts: int, seed: int
) -> dict[str, float]:
    """Plan grasps on a cloud one batch after another, and return the times and the count by name.

    "first", "fifty" and "all" are CPU seconds from the cloud to the first grasp, to fifty and to
    the end. The first two are NaN if there are too few grasps. "grasps" is their number.
    """
    spec = ContactSpec(friction=friction, table=0.0)
    found = {"first": math.nan, "fifty": math.nan}
    count = 0
    began = time.process_time()
    for grasps in stream_grasps(cloud, hand, spec, starts, seed):
        now = time.process_time() - began
        if not count:
            found["first"] = now
        if count < 50 <= count + len(grasps):
            found["fifty"] = now
        count += len(grasps)
    return found | {"all": time.process_time() - began, "grasps": count}


def plan(view: str, hand: str, friction: float, starts: int, seed: int) -> dict[str, float]:
    """Return the numbers of `time_stream` for the file of a view and the name of a hand."""
    return time_stream(read_view(view), read_hand(hand), friction, starts, seed)


def shape(view: str, seed: int) -> dict[str, float]:
    """Return the CPU seconds of steps with a view's shape, by name.

    The steps are its fit, predictions of points with and without all covariances, its surface, and
    its distance field.
    """
    cloud = read_view(view)
    times = dict[str, float]()

    def timed(name: str, action: Any) -> Any:
        began = time.process_time()
        result = action()
        times[name] = time.process_time() - began
        return result

    found = timed("shape", lambda: fit_shape(cloud, table=0.0))
    generator = torch.Generator().manual_seed(seed)
    cube = 2.0 * torch.rand(POINTS, 3, dtype=torch.float64, generator=generator) - 1.0
    # the cube within the ball in which the shape is known
    half = found.domain_radius * found.scale / math.sqrt(3)
    points = found.center + half * cube
    timed("predict", lambda: found.predict(points))
    # a copy keeps nothing that the first call made; older commits know no other way
    fresh = dataclasses.replace(found)
    short = "covariance" in inspect.signature(fresh.predict).parameters
    timed("deviation", lambda: fresh.predict(points, **({"covariance": False} if short else {})))
    timed("surface", lambda: extract_surface(found))
    timed("field", lambda: surface_field(found))
    return times


def calls(hand: str, starts: int, seed: int) -> dict[str, float]:
    """Return the number of operations of torch in a plan on the shipped jug, as "calls"."""
    cloud = read_view("jug")
    spec = ContactSpec(friction=0.8, table=0.0)
    with Calls() as counted:
        plan_grasps(cloud, read_hand(hand), spec, starts, seed)
    return {"calls": counted.count}


def cold(hand: str, starts: int, seed: int) -> dict[str, float]:
    """Return the CPU seconds of two new processes.

    "import" is of one that imports the library. "command" is of one that plans on the shipped jug
    without a report.
    """
    with tempfile.TemporaryDirectory() as out:
        words = ["grasp", "jug", "--hand", hand, "--no-report", "--out", out]
        words += ["--starts", str(starts), "--seed", str(seed)]
        return {
            "import": _child_seconds("-c", "import torchgrasp"),
            "command": _child_seconds("-m", "torchgrasp", *words),
        }


def _child_seconds(*words: str) -> float:
    """Return the CPU seconds of a new process of Python."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


JOBS = {"plan": plan, "shape": shape, "calls": calls, "cold": cold}


def answer(line: str) -> str:
    """Run the job of a line of input, the JSON of [name, arguments]; return its numbers as JSON."""
    name, arguments = json.loads(line)
    return json.dumps(JOBS[name](**arguments))


if __name__ == "__main__":
    torch.set_num_threads(int(sys.argv[1]))
    print(json.dumps(str(Path(sys.modules["torchgrasp"].__file__ or "").parents[1])), flush=True)
    for job in sys.stdin:
        print(answer(job), flush=True)
