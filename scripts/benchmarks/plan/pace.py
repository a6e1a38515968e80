"""How long a person waits for grasps on one core: for the first, for fifty, and for all of a view."""

import numpy as np
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.ground_truth import read_views
from benchmarks.plan.beside import FRICTIONS, Numbers, compare_with_commit
from benchmarks.plan.timed import time_stream
from torchgrasp import load_hand, load_object

BARS = {"first": 0.4, "first, worst decile": 1.0, "fifty": 1.2, "all": 2.2}
"""Most CPU seconds of the Allegro hand from a cloud to grasps: medians but for the worst decile."""
RATE = 110.0
"""Least executable grasps for each CPU second."""


@bench("plan/pace", objects=True)
def keep_pace(o: Options) -> list[Row]:
    """Plan on one view of each object at each friction, and time the batches; the first plan is not
    counted. With `beside`, all is done at another commit, too.
    """
    if o.beside is not None:
        return compare_with_commit(o, o.beside)
    rows = list[Row]()
    for name in o.hands:
        hand = load_hand(name)
        time_stream(load_object("jug").view, hand, FRICTIONS[0], o.starts, o.seed)
        views = read_views(o.objects[0], o.views)
        seen = {one: cloud for one, _, cloud, _ in views if not o.names or one in o.names}
        found = [
            time_stream(seen[x], hand, f, o.starts, o.seed)
            for x in tqdm(seen, disable=None, leave=False)
            for f in FRICTIONS
        ]
        rows += rows_of(name, len(seen), found)
    return rows


def rows_of(hand: str, objects: int, found: list[Numbers]) -> list[Row]:
    """Return a row for each time and one for the rate; targets are those of the Allegro hand."""
    names = ("first", "fifty", "all", "grasps")
    first, fifty, every, count = np.array([[x[name] for name in names] for x in found]).T
    times = {
        "first": np.nanmedian(first),
        "first, worst decile": np.nanquantile(first, 0.9),
        "fifty": np.nanmedian(fifty),
        "all": np.median(every),
    }
    what = f"{hand}, {objects} objects, friction {' and '.join(map(str, FRICTIONS))}"
    known = hand == "allegro"
    rows = [
        Row(
            f"{what}: {name}",
            f"{BARS[name]:g} s" if known else "-",
            f"{x:.2f} s",
            bool(x <= BARS[name]) if known else None,
            {"s": float(x)},
        )
        for name, x in times.items()
    ]
    rate = count.sum() / every.sum()
    empty = int((count == 0).sum())
    text = f"{rate:.0f} for each CPU second; {empty} of {len(found)} plans have none"
    return [
        *rows,
        Row(
            f"{what}: executable grasps",
            f"{RATE:g}" if known else "-",
            text,
            bool(rate >= RATE) if known else None,
            {"rate": float(rate)},
        ),
    ]
