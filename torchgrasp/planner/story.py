"""What an observer is told while grasps are planned."""

import dataclasses
from typing import Any

import torch

from torchgrasp.base import count_status, join
from torchgrasp.checks import checked
from torchgrasp.errors import Status
from torchgrasp.planner.fingers import Observer
from torchgrasp.values import Grasps

STAGES = ("plan", "certify", "query")
"""The stages of every wave, in their order."""


@checked
def describe(counts: dict[Status, int]) -> str:
    """Return counts of statuses as one line, the successes first.

    >>> describe({Status.NOT_CLOSED: 2, Status.OK: 1})
    '1 ok, 2 not_closed'
    """
    ordered = sorted(counts.items(), key=lambda pair: pair[0] is not Status.OK)
    return ", ".join(f"{n} {s.name.lower()}" for s, n in ordered) or "none"


class Story:
    """Tells of each stage once, in the last of the waves with starts, of all together; and of each wave as it ends.

    The last of all `waves` is told of by "refine".
    """

    def __init__(self, observer: Observer, waves: int, planned: int, friction: float):
        self.observer, self.waves, self.planned, self.friction = observer, waves, planned, friction
        self.parts: dict[str, list[Any]] = {stage: [] for stage in STAGES}
        self.ended = self.offered = self.closed = 0

    def note(self, stage: str, value: Any, offered: int = 0) -> None:
        """Note the result of a stage; `offered` counts the contacts of which some were certified."""
        if stage == "query":  # rows of contacts are counted through all waves
            value = dataclasses.replace(value, row=value.row + self.closed - len(self.parts["certify"][-1]))
        elif stage == "certify":
            self.offered, self.closed = self.offered + offered, self.closed + len(value)
        self.parts[stage].append(value)
        if len(self.parts[stage]) == self.planned:
            self.tell(stage)

    def end_wave(self, grasps: Grasps) -> None:
        """Tell of a wave that is not the last; `grasps` are its own, best first."""
        self.ended += 1
        if self.ended < self.waves:
            good = int((grasps.status == Status.OK).sum())
            best = f", the best {float(grasps.success[0]):.0%} likely" if good else ""
            text = f"{self.ended} of {self.waves}: {good} executable of {len(grasps)}{best}"
            self.observer("wave", text, grasps)

    def stop(self) -> None:
        """Tell of all stages: there will be no further wave."""
        if len(self.parts["plan"]) < self.planned:
            for stage in STAGES:
                self.tell(stage)

    def tell(self, stage: str) -> None:
        """Tell of a stage in all waves so far."""
        value = join(self.parts[stage])
        if stage == "plan":
            text = f"{len(value)} starts: {describe(count_status(value.status))}"
        elif stage == "certify":
            text = f"{self.closed} of {self.offered} closed at friction {self.friction:g}"
        else:
            text = f"{len(value)} seeds for {len(torch.unique(value.row))} of {self.closed} triples"
        self.observer(stage, text, value)
