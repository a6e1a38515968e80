"""What a plan asks of a GPU, counted without one. Counted are kernel launches, waits of the host
and uploads, by stage and line.

The planner runs on the pretended device of `tests/devices`, which computes on the CPU.
"""

import sys
from collections.abc import Iterable

from golden import OBJECTS, see

from benchmarks.common import ROOT, Options, Row, bench
from torchgrasp import ContactSpec, Hand, PointCloud, load_hand, plan_grasps

sys.path.append(str(ROOT))

from tests.devices.elsewhere import DEVICE, pretend
from tests.devices.launches import Launches, Place

SPEC = ContactSpec(friction=0.8, table=0.0)
KINDS = ("launch", "read", "upload")
STAGES = {
    "shape": "upright_frame remove_duplicates fit_upright extract_mesh collision_field vague",
    "plan": "settle_flatness plan_chunk",
    "certify": "certify",
    "seeds": "_drawn nearest_postures query_mixture drop_unreachable contact_costs",
    "fixed contacts": "try_best_seeds",
    "sliding": "solve_sliding",
    "check": "check_candidates",
    "rank": "rank rank_together",
    "other": "",
}
"""The functions of the planner that begin each stage."""


@bench("gpu/launches")
def count_launches(o: Options) -> list[Row]:
    """Count kernel launches, waits and uploads of plans of batches of clouds, for each cloud."""
    hand = load_hand(o.hands[0])
    found = dict[int, Launches]()
    with pretend():  # what a process keeps is made before
        plan_grasps([see(OBJECTS[0], 0).to(DEVICE)], hand, SPEC, 4)
    for size in o.batches:
        found[size] = count_plans(hand, views(size), o.starts)
    rows = [batch_row(size, counted, hand, o.starts) for size, counted in found.items()]
    for stage in STAGES:
        texts = {
            size: say([n.by_stage(kind)[stage] / size for kind in KINDS])
            for size, n in found.items()
        }
        text = "; ".join(f"batch {b}: {x}" for b, x in texts.items())
        rows.append(Row(f"stage {stage}", "-", text, numbers={"batches": texts}))
    size, last = list(found.items())[-1]
    return rows + [lines_row(kind, last.most(kind, 10), size) for kind in KINDS]


def views(count: int, first: int = 0) -> list[PointCloud]:
    """Return `count` views of the shipped objects, from number `first` on.

    Number 0 is of the jug. The first views are the shipped ones; then follow views from other
    sides.
    """
    names = ("jug", *(name for name in OBJECTS if name != "jug"))
    return [see(names[k % len(names)], k // len(names)) for k in range(first, first + count)]


def count_plans(hand: Hand, clouds: list[PointCloud], starts: int) -> Launches:
    """Plan grasps on clouds in one call on the pretended device, and return what was counted."""
    stages = {
        function: stage for stage, functions in STAGES.items() for function in functions.split()
    }
    with pretend():
        there = [cloud.to(DEVICE) for cloud in clouds]
        with Launches(stages) as counted:
            plan_grasps(there, hand, SPEC, starts)
    return counted


def say(counts: Iterable[float]) -> str:
    """Return the numbers of launches, reads and uploads, in this order, as text."""
    return "{:.0f} launches, {:.1f} reads, {:.1f} uploads".format(*counts)


def batch_row(size: int, counted: Launches, hand: Hand, starts: int) -> Row:
    """Return the row of a batch of `size` clouds planned at once: its counts for each cloud."""
    each = {kind: counted.total(kind) / size for kind in KINDS}
    what = f"{size} clouds at once; {hand.name}, {starts} starts; for each cloud"
    return Row(what, "-", say(each.values()), numbers=each)


def lines_row(kind: str, lines: list[tuple[Place, int]], size: int) -> Row:
    """Return a row of the lines of torchgrasp with the most events of a kind, such as launches.

    `lines` are pairs of place and number of events; the row divides them by the number of clouds.
    """
    counts = {str(place): count / size for place, count in lines}
    text = "; ".join(f"{count:.0f} {place}" for place, count in counts.items())
    return Row(f"lines of torchgrasp with the most of: {kind}", "-", text, None, counts)
