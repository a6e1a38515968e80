"""Which fingers of a hand grasp: the sets that it declares, compared by the predicted success of their best grasps."""

from collections.abc import Callable
from typing import Any

from torchgrasp.errors import BadArgument, Status
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.hand.load import with_fingers
from torchgrasp.specs import Mode
from torchgrasp.values import Grasps

Observer = Callable[[str, str, Any], None]
"""Called after each stage with its name, one line about it, and its value."""
BEST = 20
"""Best grasps of a set by which it is judged: as many as an evaluation tries of a view."""


def ignore(stage: str, message: str, value: Any) -> None:
    """Do nothing: for this observer nothing is made that is only told."""


def finger_sets(hand: Hand, fingers: Fingers | None, mode: Mode = "joint") -> tuple[Hand, ...]:
    """Return the hand with each set of fingers that is wanted: its own, another, or with "auto" all that it declares.

    Raises:
        BadArgument: fingers that the hand does not have, or more than three or "auto" in another mode than "joint".
    """
    if fingers == "auto":
        if mode != "joint":
            raise BadArgument("fingers", f"'auto' in mode {mode!r}", "mode 'joint'")
        found = (hand, *(with_fingers(hand, option) for option in hand.source.options))
        return tuple({one.finger_names: one for one in reversed(found)}.values())[::-1]
    one = hand if fingers is None else with_fingers(hand, fingers)
    if mode != "joint":
        one.require_three("mode", repr(mode))
    return (one,)


def plan_sets(
    hands: tuple[Hand, ...], plan: Callable[[Hand, Observer, int], Grasps], observer: Observer
) -> tuple[Hand, Grasps]:
    """Plan with each set of fingers; return the one with the greatest `expected_success`, and its grasps.

    `plan` is also told how many sets are left, with its own. A stage "fingers" tells of each set as it ends; then come
    the stages of the best.
    """
    best, notes = None, list[tuple[str, str, Any]]()
    for left, hand in zip(range(len(hands), 0, -1), hands, strict=True):
        stages = list[tuple[str, str, Any]]()
        grasps = plan(hand, lambda *stage: stages.append(stage), left)  # noqa: B023 called at once
        expected, count = expected_success(grasps), int((grasps.status == Status.OK).sum())
        observer("fingers", f"{', '.join(hand.finger_names)}: {count} executable, {expected:.0%} expected", grasps)
        if best is None or expected > best[0]:
            best, notes = (expected, hand, grasps), stages
    assert best is not None
    for stage in notes:
        observer(*stage)
    return best[1:]


def expected_success(grasps: Grasps) -> float:
    """Return the mean predicted success of the `BEST` likeliest grasps; those that are missing fail."""
    return float(grasps.success.sort(descending=True).values[:BEST].sum()) / BEST
