"""The contact planner beside its bars: against IPOPT from the same starts, on the true surface, and as it grows."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Row, least_seconds, write_rows
from benchmarks.ipopt import Hessian, feasible, ipopt_planner
from torchgrasp import ContactSpec, Status, certify, fit_shape, plan_contacts
from torchgrasp.linalg import unit
from torchgrasp.plan.wrench import closed_exact
from torchgrasp.shape.calibrate import nearest_on_mesh, read_views
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values import PointCloud

SUBJECTS = ("call", "peers", "truth", "growth")
RADII = (0.1, 1.0)
POINTS = 65
NEAR_BEST = 1e-3


def plan(
    objects: Path,
    only: tuple[str, ...] = SUBJECTS,
    starts: int = 1000,
    tries: int = 20,
    threads: int = 1,
    seed: int = 0,
    quick: bool = False,
    out: Path = Path("out/bench_plan.json"),
) -> None:
    """Measure the contact planner against its bars and IPOPT, in one run; needs the extra bench.

    Args:
        objects: folder with manifest.json and a folder for each object.
        only: subjects to measure, of call, peers, truth, growth.
        starts: of the planner, for each view and radius.
        tries: the first of them that IPOPT gets, for each view and radius.
        threads: of torch. IPOPT with MUMPS, as casadi brings it, has one; on two it is counted as two processes that
            do not hinder each other.
        seed: of the starts.
        quick: a tenth of starts and tries.
        out: where the numbers are written as JSON, and beside it the growth as a picture.
    """
    unknown = sorted(set(only) - set(SUBJECTS))
    if unknown:
        raise SystemExit(f"only: {unknown} are no subjects; {', '.join(SUBJECTS)} are")
    torch.set_num_threads(threads)
    starts, tries = (starts // 10, tries // 10) if quick else (starts, tries)
    views = [(name, view, cloud, mesh) for name, view, cloud, mesh in read_views(objects)]
    subjects: dict[str, Callable[[], list[Row]]] = {
        "call": lambda: bench_call(views[0][2], starts),
        "peers": lambda: bench_peers(views, starts, tries, seed, threads),
        "truth": lambda: [bench_truth(views, starts, seed)],
        "growth": lambda: [bench_growth(views[0][2], 4 if quick else 5, out.with_name("bench_plan_growth.png"))],
    }
    settings = {"threads": threads, "clock": "processor" if threads == 1 else "wall", "starts": starts, "tries": tries}
    settings |= {"seed": seed, "torch": torch.__version__}
    print(", ".join(f"{name} {value}" for name, value in settings.items()))
    rows: list[Row] = []
    for name in SUBJECTS:
        if name in only:
            found = subjects[name]()
            print(*found, sep="\n", flush=True)
            rows += found
    write_rows(out, "plan", settings, rows)


def draw_starts(shape: ShapeGP, radius: float, count: int, seed: int) -> Tensor:
    """Return starts [m] on a sphere about the shape's centre, Sec. 6.2."""
    generator = torch.Generator().manual_seed(seed)
    return shape.metres(radius * unit(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)))


def bench_call(cloud: PointCloud, starts: int) -> list[Row]:
    """Time the whole call with the default and the paper's specification, and a call that stops at its first grasps."""
    shapes = {"n = 65 (paper's points)": fit_shape(cloud, support="paper", budget=POINTS), "default": fit_shape(cloud)}
    rows = []
    for name, shape in shapes.items():
        for label, spec in (("default spec", ContactSpec()), ("paper's spec", ContactSpec.paper())):
            whole = least_seconds(partial(plan_contacts, shape, spec, starts))
            first = least_seconds(lambda shape=shape, spec=spec: _first(shape, spec))
            bar = name.startswith("n = 65")
            size = f"{len(shape.x)} points, {len(shape.weights)} rows"
            rows.append(
                Row(
                    f"whole call, {starts} starts, {label}, shape {name}: {size}",
                    "<= 1.5 s, first certified grasp <= 0.3 s" if bar else "none",
                    f"{whole:.2f} s, first {first:.2f} s",
                    whole <= 1.5 and first <= 0.3 if bar else None,
                    {"seconds": whole, "first_s": first},
                )
            )
    return rows


def _first(shape: ShapeGP, spec: ContactSpec) -> None:
    """Plan from ten starts and certify."""
    found = plan_contacts(shape, spec, 10)
    if not bool(certify(found[found.status == Status.OK].contacts, spec).closed.any()):
        raise RuntimeError("no certified grasp from ten starts")


@dataclasses.dataclass
class Tally:
    """What one planner found from one sphere of starts, over all views."""

    tried: int = 0
    feasible: int = 0
    seconds: float = 0.0
    near: int = 0
    objectives: list[float] = dataclasses.field(default_factory=list)

    def add(self, good: Tensor, objective: Tensor, seconds: float, best: float) -> None:
        """Count one view."""
        self.tried += len(good)
        self.feasible += int(good.sum())
        self.seconds += seconds
        self.near += int((good & (objective <= best + NEAR_BEST)).sum())
        self.objectives += objective[good].tolist()

    @property
    def mean(self) -> float:
        """The mean objective of the feasible tries."""
        return sum(self.objectives) / max(len(self.objectives), 1)


def bench_peers(views: list[Any], starts: int, tries: int, seed: int, threads: int) -> list[Row]:
    """Plan the paper's problem from the same starts by this planner and by IPOPT, and check all by the same judge."""
    spec = ContactSpec.paper()
    hessians: tuple[Hessian, ...] = ("limited-memory", "exact")
    rows = []
    for radius, least in zip(RADII, (0.97, 0.95), strict=True):
        ours, same = Tally(), Tally()
        theirs = {h: Tally() for h in hessians}
        shares: dict[str, float] = {}
        counted = Tally()
        for name, view, cloud, _ in tqdm(views, desc=f"radius {radius}", disable=None, leave=False):
            shape = fit_shape(cloud, support="paper", budget=POINTS)
            first = draw_starts(shape, radius, starts, seed)
            seconds = least_seconds(partial(plan_contacts, shape, spec, first), 1, limit=0.0)
            found = shape.normalise(plan_contacts(shape, spec, first).contacts.points)
            peers, times = {}, {}
            for hessian in hessians:
                solve = ipopt_planner(shape, spec, hessian)
                use = shape.normalise(first[: tries if hessian == "limited-memory" else max(tries // 4, 1)])
                answers = [solve(x) for x in use]
                peers[hessian], times[hessian] = torch.stack([a for a, _, _ in answers]), sum(t for _, t, _ in answers)
            good, peers_good = feasible(shape, spec, found), {h: feasible(shape, spec, x) for h, x in peers.items()}
            cost, peers_cost = _cost(found), {h: _cost(x) for h, x in peers.items()}
            reached = [cost[good], *(peers_cost[h][peers_good[h]] for h in hessians)]
            best = float(torch.cat(reached).min()) if sum(map(len, reached)) else 0.0
            ours.add(good, cost, seconds, best)
            same.add(good[:tries], cost[:tries], 0.0, best)
            for h in hessians:
                theirs[h].add(peers_good[h], peers_cost[h], times[h] / threads, best)
            shares[f"{name}/{view}"] = float(good.double().mean())
            if bool(peers_good["limited-memory"].any()):
                counted.add(good, cost, 0.0, best)
        peer = theirs["limited-memory"]
        rows += _peer_rows(radius, least, ours, same, counted, peer, theirs["exact"], shares, len(views))
    return rows


def _peer_rows(
    radius: float,
    least: float,
    ours: Tally,
    same: Tally,
    counted: Tally,
    peer: Tally,
    exact: Tally,
    shares: dict[str, float],
    views: int,
) -> list[Row]:
    """Return the rows of one radius."""
    share = counted.feasible / max(counted.tried, 1)
    each, peer_each, exact_each = (1e3 * t.seconds / max(t.tried, 1) for t in (ours, peer, exact))
    good, peer_good = (1e3 * t.seconds / max(t.feasible, 1) for t in (ours, peer))
    lowest = sorted(shares.items(), key=lambda item: item[1])[:4]
    near, peer_near = same.near / max(same.tried, 1), peer.near / max(peer.tried, 1)
    numbers = {"ours": dataclasses.asdict(ours), "ipopt": dataclasses.asdict(peer), "exact": dataclasses.asdict(exact)}
    for each_tally in numbers.values():
        each_tally.pop("objectives")
    return [
        Row(
            f"feasible single tries from radius {radius}, paper's problem, n = 65, {views} views",
            f">= {least:.0%} where IPOPT finds any",
            f"{share:.1%} of {counted.tried} (all views {ours.feasible / ours.tried:.1%}, IPOPT L-BFGS "
            f"{peer.feasible / peer.tried:.1%} of {peer.tried}, exact {exact.feasible / exact.tried:.1%} of "
            f"{exact.tried}); least {', '.join(f'{n} {s:.0%}' for n, s in lowest)}",
            share >= least,
            numbers | {"shares": shares},
        ),
        Row(
            f"time a start from radius {radius}, and per feasible grasp, against IPOPT L-BFGS, equal threads",
            ">= 40x and >= 25x less",
            f"{peer_each / each:.0f}x and {peer_good / good:.0f}x: {each:.2f} ms against {peer_each:.0f} ms "
            f"(exact Hessian {exact_each:.0f} ms)",
            peer_each / each >= 40 and peer_good / good >= 25,
            {},
        ),
        Row(
            f"objective from radius {radius}: mean over feasible tries from the same starts",
            "<= 1.05x IPOPT's",
            f"{same.mean:.5f} against {peer.mean:.5f} (exact {exact.mean:.5f}; all starts {ours.mean:.5f})",
            same.mean <= 1.05 * peer.mean,
            {},
        ),
        Row(
            f"share within {NEAR_BEST} of the best known objective, radius {radius}, same starts",
            ">= IPOPT's",
            f"{near:.1%} against {peer_near:.1%}",
            near >= peer_near,
            {},
        ),
    ]


def _cost(points: Tensor) -> Tensor:
    """Return Eq. (14), squared, of normalised contacts."""
    return points.mean(1).square().sum(-1)


def bench_truth(views: list[Any], starts: int, seed: int) -> Row:
    """Move certified grasps to the nearest points of the true surface and judge them there at friction 0.6."""
    settings = {
        "default": (ContactSpec(table=0.0), {"table": 0.0}),
        "paper": (ContactSpec.paper(), {"support": "paper"}),
    }
    shares: dict[str, dict[str, float]] = {name: {} for name in settings}
    okay: dict[str, list[float]] = {name: [] for name in settings}
    for name, view, cloud, mesh in tqdm(views, desc="truth", disable=None, leave=False):
        for label, (spec, options) in settings.items():
            found = plan_contacts(fit_shape(cloud, **options), spec, starts, seed)
            good = found[found.status == Status.OK].contacts
            okay[label].append(len(good) / starts)
            if len(good):
                points, normals = nearest_on_mesh(mesh, good.points.flatten(0, 1))
                closed = closed_exact(points.view_as(good.points), normals.view_as(good.points), 0.6)
                shares[label][f"{name}/{view}"] = float(closed.double().mean())
    mean = {label: sum(s.values()) / len(s) for label, s in shares.items()}
    lowest = sorted(shares["default"].items(), key=lambda item: item[1])[:4]
    done = {label: sum(values) / len(values) for label, values in okay.items()}
    return Row(
        f"certified grasps closed on the true surface at friction 0.6, {len(views)} views, mean over views",
        ">= 0.80 with the default specification",
        f"{mean['default']:.2f} (paper's specification on the paper's shape {mean['paper']:.2f}); least "
        f"{', '.join(f'{n} {s:.2f}' for n, s in lowest)}; certified {done['default']:.1%} of the starts "
        f"(paper {done['paper']:.1%})",
        mean["default"] >= 0.8,
        {"shares": shares, "certified": okay},
    )


def bench_growth(cloud: PointCloud, decades: int, out: Path) -> Row:
    """Time the paper's problem from 10 to 10^`decades` starts at n = 65, and from 300 starts at n = 30 to 300."""
    spec = ContactSpec.paper()
    shape = fit_shape(cloud, support="paper", budget=POINTS)
    counts = [10**k for k in range(1, decades + 1)]
    by_starts = [least_seconds(partial(plan_contacts, shape, spec, count), 2) for count in counts]
    sizes = [30, 65, 100, 150, 200, 300]
    by_size = []
    for n in sizes:
        larger = fit_shape(cloud, support="paper", budget=n)
        by_size.append(least_seconds(partial(plan_contacts, larger, spec, 300), 2))
    _draw_growth((counts, by_starts), (sizes, by_size), out)
    first = ", ".join(f"{c} {1e3 * s / c:.2f}" for c, s in zip(counts, by_starts, strict=True))
    second = ", ".join(f"{n} {1e3 * s / 300:.2f}" for n, s in zip(sizes, by_size, strict=True))
    return Row(
        f"growth; drawn in {out}",
        "none",
        f"ms a start by starts: {first}; by n: {second}",
        None,
        {"starts": dict(zip(counts, by_starts, strict=True)), "n": dict(zip(sizes, by_size, strict=True))},
    )


def _draw_growth(by_starts: tuple[list[int], list[float]], by_size: tuple[list[int], list[float]], out: Path) -> None:
    """Draw both on logarithmic axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, (x, seconds), power, label in (
        (left, by_starts, 1, "starts, n = 65"),
        (right, by_size, 2, "observed points n, 300 starts"),
    ):
        axes.loglog(x, seconds, "o-", color="black", label="measured")
        axes.loglog(x, [seconds[-1] * (v / x[-1]) ** power for v in x], "--", color="grey", label=f"power {power}")
        axes.set(xlabel=label, title="whole call [s]")
        axes.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=150)
