"""How long a person waits for grasps on one core. It is timed for the first, for fifty, and for all
of a view.
"""

from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.ground_truth import read_views
from benchmarks.plan.beside import FRICTIONS, MEASURES, Numbers, compare_with_commit, summarise
from benchmarks.plan.timed import time_stream
from torchgrasp import load_hand, load_object

BARS = (0.4, 1.0, 1.2, 2.2, 110.0)
"""Bars of the Allegro hand for the first of `MEASURES`. They are the most CPU seconds from a cloud
to grasps, and the least executable grasps for each CPU second.
"""


@bench("plan/pace", objects=True)
def keep_pace(o: Options) -> list[Row]:
    """Plan on one view of each object at each friction; time the first grasp, fifty and all.

    A plan before is not counted. If the options name a commit `beside`, all is timed at this
    commit, too, and the rows are ratios.
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
    """Return a row for each time and one for the rate of grasps, over all plans of a hand.

    `found` holds the numbers of each plan. Only the Allegro hand has targets.
    """
    what = f"{hand}, {objects} objects, friction {' and '.join(map(str, FRICTIONS))}"
    rows = list[Row]()
    for (name, text, statistic, unit, _), bar in zip(MEASURES, BARS, strict=False):
        value = summarise(found, name, statistic)
        limit, met = "-", None
        if hand == "allegro":
            limit = f"{bar:g} {unit}"
            met = value >= bar if statistic == "rate" else value <= bar
        measured = f"{value:.2f} {unit}"
        rows.append(Row(f"{what}: {text}", limit, measured, met, {statistic: value}))
    empty = sum(x["grasps"] == 0 for x in found)
    return [*rows, Row(f"{what}: plans without a grasp", "-", f"{empty} of {len(found)}")]
