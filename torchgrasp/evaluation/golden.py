"""The golden set: shipped grasps with known verdicts, by which an installation shows that its simulators work.

`scripts/train.py golden` makes the grasps. A lost one is a held one whose hand stands 60 mm off: the fingers miss.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import torch

from torchgrasp.checks import checked
from torchgrasp.data.shipped import load_object, load_shipped_grasp
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.hand.load import load_hand
from torchgrasp.specs import Simulator, TrialSpec

OFF = 0.06
"""How far [m] the hand of a lost grasp stands back along its approach: no fingertip touches."""


class GoldenCase(NamedTuple):
    """A grasp of a shipped object; `held` is the verdict that is expected."""

    object: str
    hand: str
    held: bool


GOLDEN = (
    GoldenCase("cylinder", "allegro", True),
    GoldenCase("jug", "allegro", True),
    GoldenCase("cylinder", "barrett", True),
    GoldenCase("jug", "barrett", True),
    GoldenCase("cylinder", "allegro", False),
    GoldenCase("jug", "barrett", False),
)
"""Both hands, two objects, either verdict."""


class GoldenResult(NamedTuple):
    """A case and what the simulator found; `seconds` of wall time."""

    case: GoldenCase
    held: bool
    seconds: float

    @property
    def right(self) -> bool:
        """Whether the verdict is the expected one."""
        return self.held == self.case.held


@checked
def run_golden(simulator: Simulator) -> Iterator[GoldenResult]:
    """Yield the result of each case of `GOLDEN` in a simulator, as they come.

    Raises:
        MissingExtra: the simulator is not installed.
    """
    for case in GOLDEN:
        thing, hand = load_object(case.object), load_hand(case.hand)
        grasp = load_shipped_grasp(case.object, case.hand)
        error = torch.eye(4, dtype=torch.float64)
        if not case.held:
            error[:3, 3] = -OFF * hand.approach
        spec = dataclasses.replace(TrialSpec(), simulator=simulator, mass=0.1, hold_time=0.5)
        found = close_hand(grasp, hand, thing.mesh, spec, error=error, parts=thing.parts)
        yield GoldenResult(case, found.held, found.seconds)
