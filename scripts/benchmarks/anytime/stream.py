"""Rows of streams: when grasps come, how many a second, and whether the best one so far holds."""

import math
from pathlib import Path
from statistics import mean, median

from benchmarks.anytime.course import BEST, TIMES, Course
from benchmarks.common import Row
from torchgrasp import Hand
from torchgrasp.data import read_object_mesh
from torchgrasp.evaluation import GraspTrial, find_protocol, run_protocol


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
