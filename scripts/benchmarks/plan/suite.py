"""The contact planner beside its bars: against IPOPT from the same starts, on the true surface, and as it grows."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from benchmarks.common import Row, least_seconds, measure
from benchmarks.ground_truth import read_views
from benchmarks.plan.executable import bench_executable
from benchmarks.plan.fingertips import bench_fingertips
from benchmarks.plan.ipopt_comparison import POINTS, bench_peers
from benchmarks.plan.probability import bench_probability
from benchmarks.plan.sampler import bench_sampler
from benchmarks.plan.scaling import bench_anytime, bench_growth, bench_memory
from benchmarks.plan.true_surface import bench_fields, bench_truth
from torchgrasp import ContactSpec, Status, certify, fit_shape, plan_contacts
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values import PointCloud

SUBJECTS = (
    "call",
    "peers",
    "truth",
    "fields",
    "probability",
    "executable",
    "sampler",
    "fingertips",
    "growth",
    "memory",
    "anytime",
)


def plan(
    objects: Path,
    only: tuple[str, ...] = SUBJECTS,
    names: tuple[str, ...] = (),
    starts: int = 1000,
    tries: int = 20,
    threads: int = 1,
    seed: int = 0,
    fingertips: int = 3,
    quick: bool = False,
    out: Path = Path("out/bench_plan.json"),
) -> None:
    """Measure the contact planner against its bars and IPOPT, in one run; needs the extra bench.

    Args:
        objects: folder with manifest.json and a folder for each object.
        only: subjects to measure, of call, peers, truth, fields, probability, executable, sampler,
            fingertips, growth, memory and anytime.
        names: of the views of each object that are measured, such as view0; by default all.
        starts: of the planner, for each view and radius.
        tries: the first of them that IPOPT gets, for each view and radius.
        threads: of torch. IPOPT with MUMPS, as casadi brings it, has one; on two it is counted as two processes that
            do not hinder each other.
        seed: of the starts.
        fingertips: of the contacts whose probability of closure is judged.
        quick: a tenth of starts and tries.
        out: where the numbers are written as JSON, and beside it growth and time budget as pictures.
    """
    torch.set_num_threads(threads)
    starts, tries = (starts // 10, tries // 10) if quick else (starts, tries)
    views = [(name, view, cloud, mesh) for name, view, cloud, mesh in read_views(objects, views=names)]
    subjects: dict[str, Callable[[], list[Row]]] = {
        "call": lambda: bench_call(views[0][2], starts),
        "peers": lambda: bench_peers(views, starts, tries, seed, threads),
        "truth": lambda: [bench_truth(views, starts, seed)],
        "fields": lambda: [bench_fields(views, max(starts // 5, 1), seed)],
        "probability": lambda: bench_probability(objects, names, max(starts // 5, 1), seed, fingertips),
        "executable": lambda: bench_executable(views, starts, seed),
        "sampler": lambda: [bench_sampler(views, max(starts // 2, 1), seed)],
        "fingertips": lambda: bench_fingertips(views, max(starts // 5, 1), seed),
        "growth": lambda: [bench_growth(4 if quick else 5, out.with_name("bench_plan_growth.png"))],
        "memory": lambda: [bench_memory(10 * starts if quick else 100 * starts, threads)],
        "anytime": lambda: [bench_anytime(2.0 if quick else 10.0, out.with_name("bench_plan_anytime.png"))],
    }
    settings = {"threads": threads, "clock": "processor" if threads == 1 else "wall", "starts": starts, "tries": tries}
    settings |= {"seed": seed, "torch": torch.__version__}
    measure("plan", subjects, only, settings, out)


def bench_call(cloud: PointCloud, starts: int) -> list[Row]:
    """Time the whole call with the default and the paper's specification, and a call that stops at its first grasps."""
    shapes = {"n = 65 (paper's points)": fit_shape(cloud, support="paper", budget=POINTS), "default": fit_shape(cloud)}
    specs = {"default spec": ContactSpec(), "paper's spec": ContactSpec.paper()}
    calls = [(name, label) for name in shapes for label in specs]
    # One thread first: a second one, once begun, spins, and the processor's time would be of both.
    alone, whole, first = (
        [_seconds_on(threads, partial(action, shapes[name], specs[label])) for name, label in calls]
        for threads, action in ((1, partial(_plan, starts)), (2, partial(_plan, starts)), (2, _first))
    )
    rows = []
    for (name, label), one, two, begun in zip(calls, alone, whole, first, strict=True):
        bar, shape = name.startswith("n = 65"), shapes[name]
        size = f"{len(shape.x)} points, {len(shape.weights)} rows"
        rows.append(
            Row(
                f"whole call, {starts} starts, {label}, shape {name}: {size}",
                "<= 1.5 s, first certified grasp <= 0.3 s" if bar else "none",
                f"{two:.2f} s on two threads, first {begun:.2f} s (one thread's processor {one:.2f} s)",
                two <= 1.5 and begun <= 0.3 if bar else None,
                {"seconds": two, "first_s": begun, "alone_s": one},
            )
        )
    return rows


def _plan(starts: int, shape: ShapeGP, spec: ContactSpec) -> None:
    """Plan from so many starts."""
    plan_contacts(shape, spec, starts)


def _seconds_on(threads: int, action: Callable[[], object]) -> float:
    """Return the least time of an action on so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return least_seconds(action)
    finally:
        torch.set_num_threads(before)


def _first(shape: ShapeGP, spec: ContactSpec) -> None:
    """Plan from ten starts and certify."""
    plan = plan_contacts(shape, spec, 10)
    if not bool(certify(plan[plan.status == Status.OK].contacts, spec).closed.any()):
        raise RuntimeError("no certified grasp from ten starts")
