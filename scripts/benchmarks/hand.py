"""The hands beside their bars: kinematics, collision, samples, the learned model, and from contacts to postures."""

from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.common import Row, write_rows
from benchmarks.query import bench_codes

SUBJECTS = ("codes",)


def hand(
    only: tuple[str, ...] = SUBJECTS,
    codes: int = 10_000,
    peers: int = 100,
    threads: int = 1,
    seed: int = 0,
    quick: bool = False,
    out: Path = Path("out/bench_hand.json"),
) -> None:
    """Measure the hands against their bars and against peers, in one run and on the same threads.

    Args:
        only: subjects to measure: codes.
        codes: held-out codes of each hand.
        peers: how many of them COBYLA gets.
        threads: of torch, for the library and its peers alike.
        seed: of every draw.
        quick: a tenth of everything.
        out: where the numbers are written as JSON.
    """
    unknown = sorted(set(only) - set(SUBJECTS))
    if unknown:
        raise SystemExit(f"only: {unknown} are no subjects; {', '.join(SUBJECTS)} are")
    torch.set_num_threads(threads)
    codes, peers = (codes // 10, peers // 10) if quick else (codes, peers)
    subjects: dict[str, Callable[[], list[Row]]] = {
        "codes": lambda: bench_codes(codes, peers),
    }
    settings = {"threads": threads, "codes": codes, "peers": peers, "seed": seed, "torch": torch.__version__}
    print(", ".join(f"{name} {value}" for name, value in settings.items()))
    rows: list[Row] = []
    for name in SUBJECTS:
        if name in only:
            found = subjects[name]()
            print(*found, sep="\n", flush=True)
            rows += found
    met, missed = (sum(row.met is verdict for row in rows) for verdict in (True, False))
    print(f"{met} bars met, {missed} missed, {len(rows) - met - missed} rows without one")
    write_rows(out, "hand", settings, rows)
