"""One stream of grasps, with the time at which each wave came."""

import dataclasses
import time

from torchgrasp import ContactSpec, Grasps, Hand, PointCloud, stream_grasps
from torchgrasp.base import join

TIMES = (0.6, 1.0, 2.0, 4.0)
"""Processor seconds after which the best grasp so far is judged."""
BEST = 20
"""Best grasps whose predicted success is averaged: as many as an evaluation tries of a view."""


@dataclasses.dataclass(frozen=True)
class Course:
    """The waves of a stream, each with the processor's seconds since the call; `seconds` at the end."""

    waves: tuple[tuple[float, Grasps], ...]
    seconds: float

    def until(self, seconds: float) -> Grasps | None:
        """Return the grasps that had come, best first; None: none had."""
        parts = [grasps for came, grasps in self.waves if came <= seconds]
        if not parts:
            return None
        grasps = join(parts)
        return grasps[grasps.score.argsort(descending=True, stable=True)]

    def time_of(self, count: int) -> float:
        """Return when `count` executable grasps had come; infinity where there are fewer."""
        total = 0
        for came, grasps in self.waves:
            total += len(grasps)
            if total >= count:
                return came
        return float("inf")

    def best(self, seconds: float, count: int = 1) -> float:
        """Return the mean predicted success of the `count` best so far; those that are missing fail."""
        grasps = self.until(seconds)
        return 0.0 if grasps is None else float(grasps.success[:count].sum()) / count

    @property
    def executable(self) -> int:
        """Count the grasps."""
        return sum(len(grasps) for _, grasps in self.waves)


def watch(cloud: PointCloud, hand: Hand, spec: ContactSpec, starts: int) -> Course:
    """Return the course of a stream."""
    began, waves = time.process_time(), []
    for grasps in stream_grasps(cloud, hand, spec, starts):
        waves.append((time.process_time() - began, grasps))
    return Course(tuple(waves), time.process_time() - began)
