"""Pulls at a grasped object in six directions."""

import dataclasses
import math
import time

import numpy as np
import torch

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.closing import GraspTrial, TrialDriver, TrialRun
from torchgrasp.evaluation.protocols import Protocol, PullSpec, find_protocol
from torchgrasp.frames import rotation_angle

DIRECTIONS = tuple(np.array(sign) * axis for axis in np.eye(3) for sign in (-1.0, 1.0))
"""-x, +x, -y, +y, -z, +z of the world."""

CHECK_SECONDS = 0.2
"""Interval [s] between two looks at the pulled object: ten in a pull of 2 s."""


@dataclasses.dataclass(frozen=True)
class PullResult(Value):
    """The outcome of a grasp: `passed` if the object stayed in every direction.

    `directions` counts those tried, `status` is of the last. `moved` [m] and `turned` [rad] are the largest motion.
    `force` [N] is the fingers' mean before the first pull, NaN if they never closed.
    """

    passed: bool
    status: Status
    directions: int
    moved: float
    turned: float
    force: float
    seconds: float


def pull_grasp(trial: GraspTrial, protocol: Protocol | str = "dexgraspbench") -> PullResult:
    """Close a hand on the true object and pull along the world's axes.

    Every direction has a fresh scene. The first in which the object moves too far is the last. Motion counts from
    before the hand closed.

    Args:
        trial: the grasp and the object.
        protocol: one that pulls, or its name in `PROTOCOLS`.

    Raises:
        BadArgument: an unknown protocol or one that lifts; else as `close_hand`.
        MeshError, MissingExtra: as `close_hand`.
    """
    started = time.process_time()
    protocol = find_protocol(protocol)
    if protocol.pull is None:
        raise BadArgument("protocol", f"{protocol.name!r}, which lifts", "one that pulls")
    driver = TrialDriver(trial, protocol.trial)
    status, moved, turned, force, tried = Status.OK, 0.0, 0.0, math.nan, 0
    while status is Status.OK and tried < len(DIRECTIONS):
        pull = _Pull(driver.open(), protocol.pull)
        status = pull.perform(DIRECTIONS[tried])
        moved, turned, tried = max(moved, pull.moved), max(turned, pull.turned), tried + 1
        force = pull.force if math.isnan(force) else force
    return PullResult(status is Status.OK, status, tried, moved, turned, force, time.process_time() - started)


class _Pull:
    """A pull along one direction, with the largest motion so far."""

    def __init__(self, run: TrialRun, spec: PullSpec) -> None:
        self.run, self.spec = run, spec
        self.start = run.scene.object_pose()
        self.moved, self.turned, self.force = 0.0, 0.0, math.nan

    def perform(self, direction: np.ndarray) -> Status:
        """Close the hand, pull at the object, and return the status."""
        run = self.run
        if not run.starts:
            return Status.START_OVERLAP
        for _ in run.close():
            pass
        self.force = float(run.robot.force.mean())
        status = self._look()
        if status is not Status.OK:
            return Status.EJECTED if status is Status.MOVED else status
        run.scene.pull(self.spec.acceleration * run.mass * direction)
        self.moved = self.turned = 0.0
        for _ in range(round(self.spec.seconds / CHECK_SECONDS)):
            for _ in range(run.robot.ticks(CHECK_SECONDS)):
                run.step()
            status = self._look()
            if status is not Status.OK:
                break
        return status

    def _look(self) -> Status:
        """Compare the object's pose with its start."""
        pose, centre = self.run.scene.object_pose(), np.append(self.run.scene.centre, 1.0)
        if not np.isfinite(pose).all():
            self.moved = self.turned = math.inf
            return Status.UNSTABLE
        moved = float(np.linalg.norm((pose @ centre - self.start @ centre)[:3]))
        turned = float(rotation_angle(torch.from_numpy(self.start[:3, :3].T @ pose[:3, :3])))
        self.moved, self.turned = max(self.moved, moved), max(self.turned, turned)
        return Status.OK if moved < self.spec.distance and turned < self.spec.angle else Status.MOVED
