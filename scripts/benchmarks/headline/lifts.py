"""Lifts of the left-out objects: four hands in place, the Allegro hand in other conditions and in a
second simulator. Also lifts of low bodies.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from train.household import household

from benchmarks.common import Options, Row, bench, keep_rows
from benchmarks.headline.left_out import LEFT_OUT
from torchgrasp.data.manifest import read_entries
from torchgrasp.evaluation import (
    PROTOCOLS,
    EvaluationSpec,
    PoseNoise,
    Protocol,
    ViewScore,
    evaluate,
)
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand

BASE = PROTOCOLS["table-lift"]

HANDS = {"allegro": 0.98, "barrett": 0.97, "leap": 0.97, "shadow": 0.97}
"""Hands, and the project's bars for the share that rises in place with up to three grasps."""

FIRST = 0.96
"""Bar of the Allegro hand for the share that rises in place with the first grasp."""

CONDITIONS: dict[str, tuple[dict[str, Any], float]] = {
    "moved by up to 3 cm on each axis": ({"noise": PoseNoise(0.03)}, 0.96),
    "moved by up to 5 cm on each axis": ({"noise": PoseNoise(0.05)}, 0.94),
    "pushed by 2.5 N in any direction": ({"push": 2.5}, 0.96),
}
"""Other conditions: changes of the protocol, and bars of the Allegro hand."""

LOW = {"allegro": 0.80, "barrett": 0.85}
LOW_BODIES = 30
HIGHEST = 0.016
"""Hands that lift low bodies, with their bars; number of the bodies; height [m] of the highest."""


@bench("headline/lifts", objects=True)
def lifts(o: Options) -> list[Row]:
    """Lift each object once with each hand and in each condition, with up to three grasps of one
    view.
    """
    o = dataclasses.replace(o, names=o.names or LEFT_OUT)
    rows = [_tried(o, hand, "in place", "sapien", {}, bar) for hand, bar in HANDS.items()]
    rows.append(_tried(o, "allegro", "in place", "mujoco", {}, HANDS["allegro"]))
    for name, (changes, bar) in CONDITIONS.items():
        rows.append(_tried(o, "allegro", name, "sapien", changes, bar))
    return rows


@bench("headline/low")
def low(o: Options) -> list[Row]:
    """Lift authored bodies that are 8 to 16 mm high."""
    count = o.times(LOW_BODIES)
    folder = o.out / f"low_{count}"
    if not (folder / "manifest.json").is_file():
        household(folder, count, highest=HIGHEST)
    o = dataclasses.replace(o, objects=(Path(folder),), names=())
    return [_tried(o, hand, "low bodies", "sapien", {}, bar) for hand, bar in LOW.items()]


def _tried(
    o: Options, hand: str, condition: str, simulator: str, changes: dict[str, Any], bar: float
) -> Row:
    """Return the row of one hand in one condition."""
    protocol = dataclasses.replace(BASE, **changes).with_trial(simulator=simulator)

    def try_objects() -> list[Row]:
        scores = lift_objects(o, load_hand(hand), protocol)
        return [row_of(hand, condition, simulator, scores, bar)]

    words = f"headline {hand} {condition} {simulator}"
    (row,) = keep_rows(o, words.replace(" ", "-"), try_objects)
    print(row, flush=True)
    return row


def lift_objects(o: Options, hand: Hand, protocol: Protocol) -> list[ViewScore]:
    """Lift each object by the grasps of one view under a protocol, and return a score for each.

    The grasps are those that an earlier call kept in the folder `out`. If there are none, they are
    planned and kept.
    """
    found = []
    for folder in o.objects:
        shelf = o.out / "table-lift" / f"{hand.name}_{folder.name}"
        here = tuple(sorted({*o.names} & {*read_entries(folder)}))
        if o.names and not here:
            continue
        kept = are_kept(shelf, here or read_entries(folder))
        spec = EvaluationSpec(1, starts=o.starts, only=here, seed=o.seed, views=1, planned=kept)
        found += evaluate(folder, hand, protocol, spec, folder=shelf, workers=o.workers)
    return found


def are_kept(shelf: Path, names: Iterable[str]) -> bool:
    """Return whether a folder has the grasps of all named objects.

    After a run that was cut off it has those of some. Then all are planned again.
    """
    return all(any((shelf / name).glob("*.safetensors")) for name in names)


def row_of(
    hand: str, condition: str, simulator: str, scores: Sequence[ViewScore], bar: float
) -> Row:
    """Return the row of one hand in one condition: the shares of objects that rose.

    The shares are with up to three grasps, and with the first one alone. `bar` is the target of the
    former. An object without a grasp counts as lost. `Row.numbers` names what was lost, and how.
    """
    tries = {x.object: [a.tries if a.passed else 0 for a in x.attempts] or [0] for x in scores}
    unit = {x.object: x.unit for x in scores}
    risen = share_over(count_by((unit[k], t > 0) for k, some in tries.items() for t in some))
    first = share_over(count_by((unit[k], t == 1) for k, some in tries.items() for t in some))
    refused = sum(not x.attempts for x in scores)
    lost = {
        x.object: [a.status.name for a in x.attempts] or [x.refusal.name]
        for x in scores
        if not all(tries[x.object])
    }
    least = FIRST if (hand, condition) == ("allegro", "in place") else 0.0
    words = f"up to three grasps {format_share(risen)}; the first {format_share(first)}; "
    words += f"no grasp for {refused} of {len(scores)}"
    if lost:
        words += f"; lost {', '.join(sorted(lost))}"
    numbers = {"hand": hand, "condition": condition, "simulator": simulator, "risen": risen}
    numbers |= {"first": first, "refused": refused, "objects": len(scores), "lost": lost}
    return Row(
        f"{hand}, {condition}, {simulator}",
        f">= {bar:.0%}" + (f", first >= {least:.0%}" if least else ""),
        words,
        risen.value >= bar and first.value >= least,
        numbers,
    )
