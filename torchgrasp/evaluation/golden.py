"""The golden set: shipped grasps with known verdicts, to check that an installed simulator works.

`scripts/train.py golden` makes the grasps. In two cases the hand is displaced by 60 mm, so that the
fingers miss the object. Two heavy objects weigh 0.5 and 0.8 kg. Two opposite fingers that press
with 4 N carry at most 0.65 kg at a friction of 0.8.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch

from torchgrasp.data.shipped import load_object, load_shipped_grasp
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.foundation.checks import checked
from torchgrasp.hand.load import load_hand
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.specs import Simulator, TrialSpec


class GoldenCase(NamedTuple):
    """A test case of the simulation: a shipped grasp, and whether it should hold its object.

    Attributes:
        object: name of a shipped object.
        hand: name of a shipped hand.
        held: whether the object should be held.
        shift: distance [m] by which the hand is moved back from the object, against its approach.
        mass: mass [kg] of the object.
    """

    object: str
    hand: str
    held: bool
    shift: float = 0.0
    mass: float = 0.1


GOLDEN = (
    *(
        GoldenCase(name, hand, True)
        for hand in ("allegro", "barrett")
        for name in ("cylinder", "jug")
    ),
    GoldenCase("cylinder", "allegro", False, shift=0.06),
    GoldenCase("jug", "barrett", False, shift=0.06),
    *(
        GoldenCase("cylinder", "barrett", held, mass=mass)
        for held, mass in ((True, 0.5), (False, 0.8))
    ),
)
"""The test cases: grasps of two hands on two objects. In some of them the object is held."""


class GoldenResult(NamedTuple):
    """The outcome of a test case of the simulation.

    Attributes:
        case: the test case.
        held: whether the simulated hand held the object.
        seconds: wall time [s] of the trial.
    """

    case: GoldenCase
    held: bool
    seconds: float

    @property
    def right(self) -> bool:
        """Whether the verdict of the simulation is that of the test case."""
        return self.held == self.case.held


@checked
def run_golden(simulator: Simulator) -> Iterator[GoldenResult]:
    """Simulate the shipped grasp of each test case in `GOLDEN` in a `simulator`. Yield for each
    whether the hand held the object.

    Raises `MissingExtra` if the simulator is not installed.
    """
    for case in GOLDEN:
        thing = load_object(case.object)
        hand = load_hand(case.hand)
        grasp = load_shipped_grasp(case.object, case.hand)
        error = torch.eye(4, dtype=torch.float64)
        error[:3, 3] = -case.shift * hand.approach
        once = ClosingOptions(attempts=1)  # a hand that misses the object ends soon
        spec = TrialSpec(
            force=4.0, simulator=simulator, mass=case.mass, hold_time=0.5, options=once
        )
        found = close_hand(grasp, hand, thing.mesh, spec, error=error, parts=thing.parts)
        yield GoldenResult(case, found.held, found.seconds)
