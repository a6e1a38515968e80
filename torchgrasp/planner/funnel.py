"""Where grasps are lost: what each stage of the chain was given, and what became of it."""

import dataclasses

import torch

from torchgrasp.base import Value, count_status
from torchgrasp.checks import checked
from torchgrasp.errors import Status
from torchgrasp.values import Certificate, ContactPlan, Grasps, IKSeeds


@dataclasses.dataclass(frozen=True)
class Losses(Value):
    """How many `things` a stage was given, and how many it lost for each reason, the most frequent first.

    >>> lost = Losses("contacts", "starts", 50, {Status.NOT_CLOSED: 10})
    >>> lost.kept, str(lost)
    (40, 'contacts: 40 of 50 starts (10 not_closed)')
    """

    stage: str
    things: str
    given: int
    lost: dict[Status, int]

    @property
    def kept(self) -> int:
        """What the next stage gets."""
        return self.given - sum(self.lost.values())

    @property
    def reasons(self) -> str:
        """The reasons with their numbers."""
        return ", ".join(f"{n} {status.name.lower()}" for status, n in self.lost.items())

    def __str__(self) -> str:
        """Return the numbers as a line."""
        return f"{self.stage}: {self.kept} of {self.given} {self.things}" + f" ({self.reasons})" * bool(self.lost)


@dataclasses.dataclass(frozen=True)
class Funnel(Value):
    """The stages from random starts to executable grasps, in their order.

    "contacts" are planned from starts. Those without a posture near them are out of reach; of the others the likeliest
    are tried. "grasps" are the executable ones; each of the others counts by what its best posture lacks.

    >>> found = Funnel((Losses("contacts", "starts", 50, {Status.NOT_CLOSED: 10}),))
    >>> found.share(frozenset({Status.NOT_CLOSED}))
    0.2
    """

    stages: tuple[Losses, ...]

    @classmethod
    @checked
    def of(cls, plan: ContactPlan, closed: Certificate, seeds: IKSeeds, grasps: Grasps) -> "Funnel":
        """Return the funnel of what "plan", "certify", "query" and "refine" of `plan_grasps` told its observer.

        >>> from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
        >>> told, view = {}, load_object("cylinder").view
        >>> spec, note = ContactSpec(friction=0.0), lambda stage, text, value: told.update({stage: value})
        >>> grasps = plan_grasps(view, load_hand("barrett"), spec, starts=20, observer=note)
        >>> Funnel.of(told["plan"], told["certify"], told["query"], grasps).stages[0].kept
        0
        """
        far = len(closed) - len(seeds.row.unique())
        stages = (
            Losses("contacts", "starts", len(plan), _failures(plan.status)),
            Losses("postures", "contacts", far + len(grasps), {Status.OUT_OF_REACH: far} if far else {}),
            Losses("grasps", "postures", len(grasps), _failures(grasps.status)),
        )
        return cls(stages)

    @property
    def executable(self) -> int:
        """The number of executable grasps."""
        return self.stages[-1].kept

    @property
    def worst(self) -> Losses:
        """The first stage that lost all that it was given; without one the stage that lost the greatest share."""
        empty = next((stage for stage in self.stages if stage.given and not stage.kept), None)
        return empty or max(self.stages, key=lambda stage: 1 - stage.kept / max(stage.given, 1))

    @property
    def reason(self) -> Status:
        """What was lost most often where most was lost; `Status.OK` where nothing was."""
        return next(iter(self.worst.lost), Status.OK)

    @checked
    def share(self, reasons: frozenset[Status]) -> float:
        """Return the share lost for some reasons, summed over the stages."""
        shares = (n / stage.given for stage in self.stages for status, n in stage.lost.items() if status in reasons)
        return sum(shares, 0.0)

    def __str__(self) -> str:
        """Return a line for each stage that was given something."""
        return "\n".join(str(stage) for stage in self.stages if stage.given)


def _failures(status: torch.Tensor) -> dict[Status, int]:
    """Count the rows of each status but OK, the most frequent first."""
    return {name: n for name, n in count_status(status).items() if name is not Status.OK}
