"""The planner as it grows and as time is limited: starts, observed points, seconds and memory, with pictures."""

import multiprocessing
import time
from functools import partial
from pathlib import Path

import torch

from benchmarks.common import Row, least_seconds, peak_mib
from benchmarks.plan.ipopt_comparison import POINTS
from torchgrasp import ContactSpec, Status, certify, fit_shape, load_object, plan_contacts
from torchgrasp.shape.gp import ShapeGP

BUDGETS = (0.5, 1.0, 2.0, 5.0, 10.0)
SIZES = (30, 65, 100, 150, 200, 300)


def papers_shape(points: int = POINTS) -> ShapeGP:
    """Return the jug as the paper would see it."""
    return fit_shape(load_object("jug").view, support="paper", budget=points)


def bench_growth(decades: int, out: Path) -> Row:
    """Time the paper's problem from 10 to 10^`decades` starts at n = 65, and from 300 starts at n = 30 to 300."""
    spec, shape = ContactSpec.paper(), papers_shape()
    counts = [10**k for k in range(1, decades + 1)]
    by_starts = [least_seconds(partial(plan_contacts, shape, spec, count), 2) for count in counts]
    by_size = [least_seconds(partial(plan_contacts, papers_shape(n), spec, 300), 2) for n in SIZES]
    _draw_growth((counts, by_starts), (list(SIZES), by_size), out)
    first = ", ".join(f"{c} {1e3 * s / c:.2f}" for c, s in zip(counts, by_starts, strict=True))
    second = ", ".join(f"{n} {1e3 * s / 300:.2f}" for n, s in zip(SIZES, by_size, strict=True))
    return Row(
        f"growth, the jug, paper's problem; drawn in {out}",
        "none",
        f"ms a start by starts: {first}; by n: {second}",
        None,
        {"starts": dict(zip(counts, by_starts, strict=True)), "n": dict(zip(SIZES, by_size, strict=True))},
    )


def bench_memory(starts: int, threads: int) -> Row:
    """Plan from many starts in a process of its own and return how far the peak of its memory rises over a few."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        rise, plan = pool.apply(_rise, (starts, threads))
    return Row(
        f"memory of {starts} starts over that of 1000",
        "<= 64 MiB and twice the plan",
        "not told by this system" if rise is None else f"{rise:.0f} MiB, of which the plan is {plan:.0f} MiB",
        None if rise is None else rise <= 64 + 2 * plan,
        {"rise_mib": rise, "plan_mib": plan},
    )


def _rise(starts: int, threads: int) -> tuple[float | None, float]:
    """Return the rise of the peak and the size of the plan [MiB]."""
    torch.set_num_threads(threads)
    shape, spec = papers_shape(), ContactSpec.paper()
    plan_contacts(shape, spec, 1000)
    before = peak_mib()
    plan = plan_contacts(shape, spec, starts)
    after = peak_mib()
    parts = (*vars(plan.contacts).values(), plan.coefficients, plan.quality, plan.status)
    size = sum(t.numel() * t.element_size() for t in parts) / 2**20
    return (None if before is None or after is None else after - before), size


def bench_anytime(longest: float, out: Path) -> Row:
    """Count the certified grasps of the jug, and the best of them, within seconds of wall time."""
    specs = {
        "default": (ContactSpec(table=0.0), fit_shape(load_object("jug").view, table=0.0)),
        "paper": (ContactSpec.paper(), papers_shape()),
    }
    budgets = [b for b in BUDGETS if b <= longest]
    curves: dict[str, list[tuple[float, int, float]]] = {}
    for name, (spec, shape) in specs.items():
        plan_contacts(shape, spec, 25)
        curves[name] = [_within(shape, spec, budget) for budget in budgets]
    _draw_anytime(curves, out)
    text = [
        f"{name} spec: " + ", ".join(f"{b:g} s {c} (margin {m:.4f}, took {s:.2f} s)" for b, (s, c, m) in zipped)
        for name, zipped in ((name, zip(budgets, curve, strict=True)) for name, curve in curves.items())
    ]
    late = max(
        seconds - budget for curve in curves.values() for budget, (seconds, *_) in zip(budgets, curve, strict=True)
    )
    return Row(
        f"certified grasps of the jug within a time budget, n = {POINTS} with the paper's spec; drawn in {out}",
        "none",
        f"{'; '.join(text)}; at most {1e3 * late:.0f} ms late",
        None,
        {"budgets": budgets, "curves": curves},
    )


def _within(shape: ShapeGP, spec: ContactSpec, budget: float) -> tuple[float, int, float]:
    """Return the seconds that a plan within the budget took, its certified grasps, and the greatest margin."""
    began = time.perf_counter()
    plan = plan_contacts(shape, spec, 10**6, time_budget=budget)
    seconds = time.perf_counter() - began
    certificate = certify(plan[plan.status == Status.OK].contacts, spec)
    return seconds, int(certificate.closed.sum()), float(certificate.margin.max())


def _draw_growth(by_starts: tuple[list[int], list[float]], by_size: tuple[list[int], list[float]], out: Path) -> None:
    """Draw both on logarithmic axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, (x, seconds), power, label in (
        (left, by_starts, 1, f"starts, n = {POINTS}"),
        (right, by_size, 2, "observed points n, 300 starts"),
    ):
        axes.loglog(x, seconds, "o-", color="black", label="measured")
        axes.loglog(x, [seconds[-1] * (v / x[-1]) ** power for v in x], "--", color="grey", label=f"power {power}")
        axes.set(xlabel=label, title="whole call [s]")
        axes.set_xticks(x, [str(v) if v < 1000 else f"1e{len(str(v)) - 1}" for v in x])
        axes.minorticks_off()
        axes.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)


def _draw_anytime(curves: dict[str, list[tuple[float, int, float]]], out: Path) -> None:
    """Draw what was found against the seconds that it took."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (name, curve), style in zip(curves.items(), ("o-", "s--"), strict=True):
        seconds, counts, margins = zip(*curve, strict=True)
        left.loglog(seconds, counts, style, color="black", label=f"{name} specification")
        right.semilogx(seconds, margins, style, color="black", label=f"{name} specification")
    for axes in (left, right):
        axes.set_xticks(BUDGETS, [f"{b:g}" for b in BUDGETS])
        axes.minorticks_off()
    left.set(xlabel="time [s]", title="certified grasps")
    right.set(xlabel="time [s]", title="greatest margin of a certificate")
    left.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)
