"""Single tries of the paper's problem from the same starts, by this planner and by IPOPT, under the same judge."""

import dataclasses
import time
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.plan.ipopt import Hessian, feasible, ipopt_planner
from torchgrasp import ContactSpec, fit_shape, plan_contacts
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.gp import ShapeGP

RADII = (0.1, 1.0)
POINTS = 65
NEAR_BEST = 1e-3


def draw_starts(shape: ShapeGP, radius: float, count: int, seed: int) -> Tensor:
    """Return starts [m] on a sphere about the shape's centre, Sec. 6.2."""
    generator = torch.Generator().manual_seed(seed)
    return shape.metres(radius * unit(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)))


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
    clock = time.process_time if threads == 1 else time.perf_counter
    rows = []
    for radius, least in zip(RADII, (0.97, 0.95), strict=True):
        ours, same = Tally(), Tally()
        theirs = {h: Tally() for h in hessians}
        shares: dict[str, float] = {}
        counted = Tally()
        for name, view, cloud, _ in tqdm(views, desc=f"radius {radius}", disable=None, leave=False):
            shape = fit_shape(cloud, support="paper", budget=POINTS)
            first = draw_starts(shape, radius, starts, seed)
            began = clock()
            plan = plan_contacts(shape, spec, first)
            seconds = clock() - began
            points = shape.normalise(plan.contacts.points)
            peers, times = {}, {}
            for hessian in hessians:
                solve = ipopt_planner(shape, spec, hessian)
                use = shape.normalise(first[: tries if hessian == "limited-memory" else max(tries // 4, 1)])
                answers = [solve(x) for x in use]
                peers[hessian], times[hessian] = torch.stack([a for a, _, _ in answers]), sum(t for _, t, _ in answers)
            good, peers_good = feasible(shape, spec, points), {h: feasible(shape, spec, x) for h, x in peers.items()}
            cost, peers_cost = _cost(points), {h: _cost(x) for h, x in peers.items()}
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
