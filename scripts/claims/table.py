"""The table of claims: a text of a page, and what a run finds in its place."""

import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from benchmarks.common import describe_run

ROOT = Path(__file__).resolve().parents[2]
Finding = tuple[str, bool]
"""What was found, and whether the claim holds."""


class Claim(NamedTuple):
    """A text of a page, and the function that measures it again."""

    page: str
    said: str
    check: Callable[[], Finding]

    def stands(self) -> bool:
        """Return whether the page still has the text; line breaks count as spaces."""
        return self.said in " ".join((ROOT / self.page).read_text("utf-8").split())


CLAIMS: list[Claim] = []
"""All claims, in the order in which `measured.py` registers them."""


def claim(page: str, *said: str) -> Callable[[Callable[[], Finding]], Callable[[], Finding]]:
    """Register the function that measures one or several texts of a page again."""

    def register(check: Callable[[], Finding]) -> Callable[[], Finding]:
        CLAIMS.extend(Claim(page, text, check) for text in said)
        return check

    return register


def claims(only: str = "", threads: int = 1) -> None:
    """Measure the figures of README and guides again; end with 1 if one does not hold.

    Times are for a quiet machine.

    Args:
        only: part of the page or of the text; by default all claims are run.
        threads: of torch.
    """
    from claims import measured  # noqa: F401 - registers the claims

    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    chosen = [x for x in CLAIMS if only in x.page or only in x.said]
    print(describe_run(threads), f"Load {', '.join(f'{x:.1f}' for x in os.getloadavg())}.\n")
    print("| claim | said | found | held |\n| --- | --- | --- | --- |")
    held, results = 0, dict[Callable[[], Finding], tuple[str, bool, float]]()
    for one in chosen:
        if one.check not in results:
            began = time.perf_counter()
            try:
                found, holds = one.check()
            except Exception as error:
                found, holds = f"{type(error).__name__}: {error}", False
            results[one.check] = found, holds, time.perf_counter() - began
        found, holds, took = results[one.check]
        if not one.stands():
            found, holds = "the page says so no more", False
        cells = one.page, one.said, f"{' '.join(found.split())} (run: {took:.0f} s)", "yes" if holds else "NO"
        print(f"| {' | '.join(x.replace('|', '/') for x in cells)} |", flush=True)
        held += holds
    print(f"\n{held} of {len(chosen)} hold")
    if held < len(chosen):
        raise SystemExit(1)
