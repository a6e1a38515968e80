"""Reports of the planner to an observer. It hears of each stage once, with the results of all
batches. It also hears of the end of each batch except the last one of the plan.
"""

import dataclasses
from typing import Any

import torch

from torchgrasp.foundation.base import count_status, join
from torchgrasp.foundation.errors import Status
from torchgrasp.ik.attempts import is_executable
from torchgrasp.planner.objects import Objects
from torchgrasp.shape.estimate import surface_deviation
from torchgrasp.values.planning import Grasps, format_success


@dataclasses.dataclass(frozen=True)
class ReportNumbers:
    """Parameters of the report on the estimated shape."""

    vertices: int = 500
    """Greatest number of vertices at which the certainty of the surface is judged."""
    certain: float = 0.004
    """Standard deviation [m] below which the surface counts as certain: it moves a contact little.
    """


REPORT = ReportNumbers()


class Report:
    """Calls the observer of a plan, the user's function, as the plan makes progress.

    Without an observer it does nothing. The estimated shape is reported first. Then each batch of
    initial guesses passes three stages: contacts, force closure and initial hand postures. A stage
    is reported once, when the last of these batches has passed it, with the results of all. The end
    of each batch is reported with its grasps, except that of the plan's last batch.
    """

    def __init__(self, objects: Objects, batches: int, planned: int) -> None:
        """Prepare the report of a plan of `batches` batches, of which `planned` plan new initial
        guesses.
        """
        self.objects = objects
        self.batches = batches
        self.planned = planned
        # without an observer nothing is stored or counted
        self.heard = objects.request.observer is not None
        self.parts: dict[str, list[Any]] = {"plan": [], "certify": [], "query": []}
        self.ended = 0
        self.offered = 0
        self.closed = 0

    def shape(self) -> None:
        """Report the estimated shape, and the share of its surface whose standard deviation is
        below 4 mm (`REPORT.certain`).
        """
        if not self.heard:
            return
        shape = self.objects.each[0].shape
        vertices = self.objects.each[0].surface.vertices
        some = vertices[:: len(vertices) // REPORT.vertices + 1]
        x = shape.normalise(some)
        _, gradient = shape.mean_and_gradient(x)
        deviation = surface_deviation(shape.variance(x), gradient)
        std_m = shape.std_factor * shape.scale * deviation
        certain = float((std_m < REPORT.certain).double().mean())
        told = f"{certain:.0%} of the surface certain to {1000.0 * REPORT.certain:g} mm"
        self.objects.tell("shape", f"{len(shape.x)} points, {told}", shape)

    def note(self, stage: str, value: Any, offered: int = 0) -> None:
        """Store the result of one stage of one batch, and report the stage after its last batch.

        `stage` is "plan" (contact planning), "certify" (force closure) or "query" (initial hand
        postures), and `value` its result. `offered` is the number of contact sets that stage
        "certify" checked; other stages do not use it.
        """
        if not self.heard:
            return
        if stage == "query":  # rows are counted through all batches
            value = dataclasses.replace(
                value, row=value.row + self.closed - len(self.parts["certify"][-1])
            )
        elif stage == "certify":
            self.offered += offered
            self.closed += len(value)
        self.parts[stage].append(value)
        if len(self.parts[stage]) == self.planned:
            self._tell(stage)

    def end_batch(self, grasps: Grasps, last: bool) -> None:
        """Report that a batch has ended with the given grasps.

        If it is the `last` one, the stages that are not yet reported are reported, too.
        """
        if not self.heard:
            return
        self.ended += 1
        if self.ended < self.batches:
            good = int(is_executable(grasps).sum())
            best = f", success of the best {format_success(grasps)}" if good else ""
            text = f"{self.ended} of {self.batches}: {good} executable of {len(grasps)}{best}"
            self.objects.tell("batch", text, grasps)
        if last and len(self.parts["plan"]) < self.planned:
            for stage in self.parts:
                self._tell(stage)

    def _tell(self, stage: str) -> None:
        """Report to the observer the results of one stage, from all batches so far."""
        value = join(self.parts[stage])
        if stage == "plan":
            text = f"{len(value)} starts: {describe(count_status(value.status))}"
        elif stage == "certify":
            text = f"{self.closed} of {self.offered} closed at friction {self.objects.spec.planned_friction:g}"
        else:
            text = f"{len(value)} seeds for {len(torch.unique(value.row))} of {self.closed} triples"
        self.objects.tell(stage, text, value)


def describe(counts: dict[Status, int]) -> str:
    """Return the number of each status as one line of text, which begins with `Status.OK`."""
    ordered = sorted(counts.items(), key=lambda pair: pair[0] is not Status.OK)
    return ", ".join(f"{n} {s.name.lower()}" for s, n in ordered) or "none"
