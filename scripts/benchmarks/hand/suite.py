"""The hands beside their bars: kinematics, collision, samples, learned model, inverse kinematics."""

from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.common import Row, measure
from benchmarks.hand.kinematics import bench_collision, bench_fk, bench_samples
from benchmarks.hand.mixture import bench_em, bench_mae, bench_queries
from benchmarks.hand.query import bench_codes
from benchmarks.hand.reach import bench_reach
from benchmarks.hand.seeds import bench_seeds
from benchmarks.plan.executable import bench_planned

SUBJECTS = ("fk", "collision", "samples", "codes", "em", "mae", "queries", "reach", "seeds", "planned")


def hand(
    objects: Path | None = None,
    only: tuple[str, ...] = SUBJECTS,
    codes: int = 10_000,
    samples: int = 1_000_000,
    queries: int = 100_000,
    peers: int = 100,
    starts: int = 1000,
    threads: int = 1,
    seed: int = 0,
    quick: bool = False,
    out: Path = Path("out/bench_hand.json"),
) -> None:
    """Measure the hands against their bars and against peers, in one run and on the same threads.

    Args:
        objects: folder with manifest.json and a folder for each object; planned contacts need it; seeds use it too.
        only: subjects to measure: fk, collision, samples, codes, em, mae, queries, reach, seeds, planned.
        codes: held-out codes of each hand.
        samples: free postures of each hand; the first four tenths are fitted.
        queries: contact triples, in all six assignments.
        peers: number of codes that COBYLA solves, too.
        starts: of the contact planner on each object.
        threads: of torch, for the library and its peers.
        seed: of every draw.
        quick: a tenth of everything.
        out: JSON file of the numbers.
    """
    torch.set_num_threads(threads)
    if quick:
        codes, peers, samples, queries, starts = (x // 10 for x in (codes, peers, samples, queries, starts))
    subjects: dict[str, Callable[[], list[Row]]] = {
        "fk": lambda: bench_fk(samples, threads),
        "collision": lambda: bench_collision(samples // 5, threads),
        "samples": lambda: bench_samples(samples, threads),
        "codes": lambda: bench_codes(codes, peers),
        "em": lambda: bench_em(2 * samples // 5),
        "mae": lambda: bench_mae(samples),
        "queries": lambda: bench_queries(queries),
        "reach": lambda: bench_reach(samples // 50),
        "seeds": lambda: bench_seeds(objects, starts, seed),
        "planned": lambda: bench_planned(objects, starts, seed) if objects else [],
    }
    settings = {"threads": threads, "codes": codes, "peers": peers, "samples": samples, "queries": queries}
    settings |= {"starts": starts, "seed": seed, "torch": torch.__version__}
    measure("hand", subjects, only, settings, out)
