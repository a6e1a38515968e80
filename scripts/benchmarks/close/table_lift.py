"""Lifts of a quarter of a kilogram off a slippery table. The object is in place, moved after the
view, or pushed in the air.

The best grasp of one view of each object is lifted under protocol "table-lift". An object without a
grasp fails.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import Options, Row, bench
from torchgrasp.app.report.evaluation_page import list_causes
from torchgrasp.data.manifest import read_entries
from torchgrasp.evaluation import (
    PROTOCOLS,
    EvaluationSpec,
    PoseNoise,
    Protocol,
    ViewScore,
    evaluate,
    summarise,
)
from torchgrasp.evaluation.intervals import format_share
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand

BASE = PROTOCOLS["table-lift"]

BARS: dict[str, tuple[dict[str, Any], float, float]] = {
    "in place": ({}, 0.97, 0.92),
    "moved by up to 3 cm": ({"noise": PoseNoise(0.03)}, 0.93, 0.0),
    "moved by up to 5 cm": ({"noise": PoseNoise(0.05)}, 0.85, 0.0),
    "pushed with 2.5 N": ({"push": 2.5}, 0.95, 0.0),
}
"""Conditions by name: changes of the protocol, and the project's bars for the shares risen and held
without slip.
"""

HANDS = {"barrett": 0.92, "leap": 0.95, "shadow": 0.95}
"""Bars of other hands for the share risen in place; none was set for the share held without slip.
"""


@bench("close/table-lift", objects=True)
def table_lift(o: Options) -> list[Row]:
    """Lift every object in each condition, with each hand; return a row for each of these pairs."""
    rows = list[Row]()
    for hand, name in itertools.product(map(load_hand, o.hands), o.conditions or BARS):
        changes, least, strict = BARS[name]
        if name == "in place" and hand.name in HANDS:
            least = HANDS[hand.name]
            strict = 0.0
        protocol = dataclasses.replace(BASE, **changes)
        scores = lift_objects(o, hand, protocol, o.simulator)
        rows.append(_row(f"{hand.name}, {name}", scores, least, strict))
        print(rows[-1], flush=True)
    return rows


def lift_objects(o: Options, hand: Hand, protocol: Protocol, simulator: str) -> list[ViewScore]:
    """Lift each object by the best grasp of one view under a protocol, and return a score for each.

    The grasps are those that an earlier call kept in the folder `out`. If there are none, they are
    planned and kept.
    """
    noise = dataclasses.replace(protocol.noise, draws=o.draws)
    protocol = dataclasses.replace(protocol, noise=noise).with_trial(simulator=simulator)
    found = []
    for folder in o.objects:
        shelf = o.out / "table-lift" / f"{hand.name}_{folder.name}"
        here = names_in(folder, o.names)
        if o.names and not here:
            continue
        planned = are_kept(shelf, here or read_entries(folder))
        spec = EvaluationSpec(1, starts=o.starts, only=here, seed=o.seed, views=1, planned=planned)
        found += evaluate(folder, hand, protocol, spec, folder=shelf, workers=o.workers)
    return found


def names_in(folder: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return those of some objects' names that a folder of objects has, sorted."""
    return tuple(sorted({*names} & {*read_entries(folder)}))


def are_kept(shelf: Path, names: Iterable[str]) -> bool:
    """Return whether a folder has the grasps of all named objects.

    After a run that was cut off it has those of some. Then all are planned again.
    """
    return all(any((shelf / name).glob("*.safetensors")) for name in names)


def _row(what: str, scores: Sequence[ViewScore], least: float, strict: float) -> Row:
    """Return the shares that rose and that were held without slip, refusals, and causes."""
    risen = summarise(scores)
    held = summarise([_strict(score) for score in scores])
    words = [format_share(risen["top1"]), f"without slip {format_share(held['top1'])}"]
    words += [
        f"by the first grasp and further ones {risen['tries']}",
        f"{risen['refused']} of {len(scores)} refused",
    ]
    words += [f"{cause} {text}" for cause, text in list_causes(risen)]
    bar = f">= {least:.0%}" + (f", without slip >= {strict:.0%}" if strict else "")
    met = risen["top1"].value >= least and held["top1"].value >= strict
    lost = [
        (x.object, a.draw, a.status.name, a.cause, a.size)
        for x in scores
        for a in x.attempts
        if not a.held
    ]
    numbers = {"risen": risen["top1"], "held": held["top1"], "causes": risen["causes"]}
    return Row(what, bar, "; ".join(words), met, numbers | {"not held": lost})


def _strict(score: ViewScore) -> ViewScore:
    """Return a score in which only trials without slip have passed."""
    return dataclasses.replace(
        score, attempts=tuple(dataclasses.replace(x, passed=x.held) for x in score.attempts)
    )
