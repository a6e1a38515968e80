"""The run of all claims: each is measured again, and a table says what holds."""

import os
import time
import warnings
from collections.abc import Callable

import torch
from benchmarks.common import describe_run

from claims import measured  # noqa: F401
from claims.table import CLAIMS, Finding


def claims(only: str = "", threads: int = 1) -> None:
    """Measure the figures of README and guides again; end with 1 if one does not hold.

    Times are for a quiet machine.

    Args:
        only: part of the page or of the text; by default all claims are run.
        threads: of torch.
    """
    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    chosen = [x for x in CLAIMS if only in x.page or only in x.said]
    print(describe_run(threads), f"Load {', '.join(f'{x:.1f}' for x in os.getloadavg())}.\n")
    print("| claim | said | found | held |\n| --- | --- | --- | --- |")
    held = 0
    results = dict[Callable[[], Finding], tuple[str, bool, float]]()
    for one in chosen:
        if one.check not in results:
            began = time.perf_counter()
            try:
                found, holds = one.check()
            except Exception as error:
                found = f"{type(error).__name__}: {error}"
                holds = False
            results[one.check] = found, holds, time.perf_counter() - began
        found, holds, took = results[one.check]
        if not one.stands():
            found = "the page says so no more"
            holds = False
        cells = (
            one.page,
            one.said,
            f"{' '.join(found.split())} (run: {took:.0f} s)",
            "yes" if holds else "NO",
        )
        print(f"| {' | '.join(x.replace('|', '/') for x in cells)} |", flush=True)
        held += holds
    print(f"\n{held} of {len(chosen)} hold")
    if held < len(chosen):
        raise SystemExit(1)
