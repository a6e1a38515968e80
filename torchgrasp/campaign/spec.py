"""What a campaign is asked for."""

import dataclasses
from typing import Annotated

from torchgrasp.base import Value
from torchgrasp.checks import Range, checked
from torchgrasp.errors import BadArgument
from torchgrasp.evaluation.protocols import Protocol, find_protocol
from torchgrasp.evaluation.views import EvaluationSpec

LONGEST_LICENCE = 100  # letters of a licence's name; those of the SPDX list have at most 40


@checked
@dataclasses.dataclass(frozen=True)
class CampaignSpec(Value):
    """What is planned, tried and written.

    Args:
        protocol: the test that each grasp is put to: itself, or its name in `torchgrasp.evaluation.PROTOCOLS`.
        trials: which views, and how many of their grasps. The hand's own fingers grasp.
        licence: of the data set, as its card names it; an SPDX identifier such as "CC-BY-4.0" is understood widely.
        jobs_in_shard: objects and views whose records share a file.

    Raises:
        BadArgument: an unknown protocol, or trials of whole clouds, of grasps that were planned before, or of other
            fingers than the hand's.

    >>> CampaignSpec("dexgraspbench").test.trial.friction
    0.6
    """

    protocol: Protocol | str = "tabletop"
    trials: EvaluationSpec = dataclasses.field(default_factory=EvaluationSpec)
    licence: str = "unknown"
    jobs_in_shard: Annotated[int, Range(1, 10_000)] = 64

    def __post_init__(self) -> None:
        """Check what depends on two fields."""
        trials = self.trials
        if trials.planned or trials.complete or trials.fingers is not None:
            found = next(name for name in ("planned", "complete", "fingers") if getattr(trials, name))
            raise BadArgument("trials", f"{found} = {getattr(trials, found)!r}", "views that are planned on anew")
        if not self.licence.isprintable() or not 0 < len(self.licence) <= LONGEST_LICENCE:
            raise BadArgument("licence", repr(self.licence), f"a line of 1 to {LONGEST_LICENCE} letters")

    @property
    def test(self) -> Protocol:
        """The protocol itself."""
        return find_protocol(self.protocol)
