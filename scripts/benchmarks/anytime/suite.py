"""The stream of grasps beside the bars: time to the first and to fifty, what waiting is worth, peers, cores, memory."""

from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.anytime.before import bench_before
from benchmarks.anytime.cores import bench_many, bench_threads
from benchmarks.anytime.course import Course, watch
from benchmarks.anytime.field import bench_field
from benchmarks.anytime.memory import bench_memory
from benchmarks.anytime.peers import bench_peers
from benchmarks.anytime.stream import bench_pull, bench_stream
from benchmarks.common import Row, measure
from torchgrasp import ContactSpec, load_hand, load_object
from torchgrasp.data import list_views, read_view

SPEC = ContactSpec(table=0.0)
MANY = 10_000
"""Starts of the plan whose memory is bounded."""


def anytime(
    objects: Path,
    only: tuple[str, ...] = ("stream", "many"),
    names: tuple[str, ...] = (),
    views: int = 3,
    hand: str = "allegro",
    starts: int = 1000,
    tries: int = 10,
    most: int | None = None,
    before: Path | None = None,
    out: Path = Path("out/bench_anytime.json"),
) -> None:
    """Measure how grasps come, in seconds of one thread's processor.

    Args:
        objects: folder with manifest.json and a folder for each object.
        only: subjects to measure: stream, before, pull, peers, many, threads, memory, field.
        names: objects to keep; all by default.
        views: of each object, at most.
        hand: that grasps.
        starts: of the contact planner.
        tries: single starts of the peer on each view.
        most: views in all, the first ones; a hundred with 100 starts each take "many" five minutes.
        before: another checkout of the project, for the ratios of "before".
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(1)
    chosen = list_views(objects, only=names, most=views)[:most]
    clouds, model = [read_view(objects, *one) for one in chosen], load_hand(hand)
    watch(load_object("cylinder").view, model, SPEC, 40)  # the first call alone imports
    courses: list[Course] = []

    def all_courses() -> list[Course]:
        courses.extend(watch(cloud, model, SPEC, starts) for cloud in clouds[len(courses) :])
        return courses

    subjects: dict[str, Callable[[], list[Row]]] = {
        "stream": lambda: bench_stream(all_courses()),
        "before": lambda: bench_before(all_courses(), clouds, hand, starts, before),
        "pull": lambda: bench_pull(objects, chosen, all_courses(), model),
        "peers": lambda: bench_peers(clouds, all_courses(), model, SPEC, tries),
        "many": lambda: bench_many(clouds, model, SPEC, starts),
        "threads": lambda: bench_threads(clouds, model, SPEC, starts),
        "field": lambda: bench_field(clouds),
        "memory": lambda: bench_memory(objects, chosen, hand, (starts, MANY)),
    }
    measure("anytime", subjects, only, {"hand": hand, "starts": starts, "views": len(chosen)}, out)
