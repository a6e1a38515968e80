"""The stream of grasps beside the bars: time to the first and to fifty, the best one so far, many clouds at once."""

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import mean, median

import torch

from benchmarks.anytime.course import BEST, TIMES, Course, watch
from benchmarks.common import Row, measure
from torchgrasp import ContactSpec, Hand, PointCloud, load_hand, load_object, plan_grasps
from torchgrasp.datasets import list_views, read_object_mesh, read_view
from torchgrasp.evaluation import GraspTrial, find_protocol, run_protocol

SUBJECTS = ("stream", "before", "pull", "many")
SPEC = ContactSpec(table=0.0)
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


def anytime(
    objects: Path,
    only: tuple[str, ...] = ("stream", "many"),
    names: tuple[str, ...] = (),
    views: int = 3,
    hand: str = "allegro",
    starts: int = 1000,
    before: Path | None = None,
    out: Path = Path("out/bench_anytime.json"),
) -> None:
    """Measure how grasps come, in seconds of one thread's processor.

    Args:
        objects: folder with manifest.json and a folder for each object.
        only: subjects to measure: stream, before, pull, many.
        names: objects to keep; all by default.
        views: of each object, at most.
        hand: that grasps.
        starts: of the contact planner.
        before: another checkout of the project, for the ratios of "before".
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(1)
    chosen = list_views(objects, only=names, most=views)
    model = load_hand(hand)
    watch(load_object("cylinder").view, model, SPEC, 40)  # the first call alone imports
    courses: dict[tuple[str, str], Course] = {}

    def all_courses() -> list[Course]:
        for name, view in chosen:
            if (name, view) not in courses:
                courses[name, view] = watch(read_view(objects, name, view), model, SPEC, starts)
        return list(courses.values())

    subjects: dict[str, Callable[[], list[Row]]] = {
        "stream": lambda: bench_stream(all_courses()),
        "before": lambda: bench_before(all_courses(), chosen, [str(objects), hand, str(starts)], before),
        "pull": lambda: bench_pull(objects, chosen, all_courses(), model),
        "many": lambda: bench_many([read_view(objects, *one) for one in chosen], model, starts),
    }
    measure("anytime", subjects, only, {"hand": hand, "starts": starts, "views": len(chosen)}, out)


def bench_stream(courses: list[Course]) -> list[Row]:
    """Measure when grasps come, and how good the best one is that has come."""
    first, fifty = [c.time_of(1) for c in courses], [c.time_of(50) for c in courses]
    rate = sum(c.executable for c in courses) / sum(c.seconds for c in courses)
    curve = {t: (mean(c.best(t) for c in courses), mean(c.best(t, BEST) for c in courses)) for t in (*TIMES, math.inf)}
    texts = [f"{t:g} s {one:.0%} and {many:.0%}" for t, (one, many) in curve.items()]
    some = f"{len(courses)} views"
    return [
        Row(
            f"first executable grasp, {some}",
            "median <= 0.6 s, worst <= 1.2 s",
            f"median {median(first):.2f} s, worst {max(first):.2f} s",
            median(first) <= 0.6 and max(first) <= 1.2,
            {"seconds": first},
        ),
        Row(
            f"fifty executable grasps, {some}",
            "median <= 2.0 s",
            f"median {median(fifty):.2f} s; {sum(map(math.isinf, fifty))} views have fewer",
            median(fifty) <= 2.0,
            {"seconds": fifty},
        ),
        Row(
            f"all of the work, {some}",
            "<= 3.5 s, >= 60 executable grasps a second",
            f"mean {mean(c.seconds for c in courses):.2f} s, {rate:.0f} a second",
            mean(c.seconds for c in courses) <= 3.5 and rate >= 60,
            {"seconds": [c.seconds for c in courses], "executable": [c.executable for c in courses]},
        ),
        Row(
            f"predicted success of the best grasp, and mean of the {BEST} best, after so long",
            "none",
            "; ".join(texts),
            None,
            {str(t): values for t, values in curve.items()},
        ),
    ]


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


def bench_pull(objects: Path, views: list[tuple[str, str]], courses: list[Course], hand: Hand) -> list[Row]:
    """Measure how often the best grasp so far holds when it is pulled in six directions (DexGraspBench)."""
    protocol, held = find_protocol("dexgraspbench"), dict[float, list[bool]]()
    for (name, _), course in zip(views, courses, strict=True):
        mesh, known = read_object_mesh(objects, name), dict[float, bool]()
        for t in (*TIMES, math.inf):
            grasps = course.until(t)
            if grasps is None:
                held.setdefault(t, []).append(False)
                continue
            key = float(grasps.score[0])
            if key not in known:
                known[key] = run_protocol(GraspTrial(hand, grasps[0], mesh), protocol).passed
            held.setdefault(t, []).append(known[key])
    texts = [f"{t:g} s {mean(x):.0%}" for t, x in held.items()]
    numbers = {str(t): x for t, x in held.items()}
    share = mean(held[1.0]) / max(mean(held[math.inf]), 1e-9)
    return [Row("the best grasp so far holds", ">= 90 % at 1 s", "; ".join(texts), share >= 0.9, numbers)]


def bench_many(clouds: list[PointCloud], hand: Hand, starts: int) -> list[Row]:
    """Measure one call of many clouds on two processes beside the loop, by the wall clock."""
    began = time.monotonic()
    alone = [plan_grasps(cloud, hand, SPEC, starts) for cloud in clouds]
    loop, began = time.monotonic() - began, time.monotonic()
    together = plan_grasps(clouds, hand, SPEC, starts, workers=2)
    call = time.monotonic() - began
    equal = all(torch.equal(a.joints, b.joints) for a, b in zip(alone, together, strict=True))
    return [
        Row(
            f"{len(clouds)} clouds in one call, two processes; wall clock of a machine with two free cores",
            ">= 1.5 times the loop, equal grasps",
            f"{loop / call:.2f} times ({loop:.1f} and {call:.1f} s), {'equal' if equal else 'OTHER'} grasps",
            loop / call >= 1.5 and equal,
            {"loop": loop, "call": call},
        )
    ]
