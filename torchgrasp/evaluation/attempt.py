"""One grasp put to one protocol, whether that pulls at the object or lifts it."""

import dataclasses
import math
import time

from torchgrasp.base import Value
from torchgrasp.errors import Status
from torchgrasp.evaluation.closing import GraspTrial, TrialDriver
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.protocols import Protocol
from torchgrasp.evaluation.pull import pull_grasp


@dataclasses.dataclass(frozen=True)
class ProtocolResult(Value):
    """The outcome of a grasp of some `rank` under one `draw` of the error of pose; NaN was not measured.

    `moved` [m] and `turned` [rad] are the object's motion: in the world under a pull, in the hand in a lift. `force`
    [N] is the fingers' mean normal force, `overlap` [m] as of `TrialDriver.grasp_overlap`, `seconds` CPU time.
    """

    rank: int
    draw: int
    passed: bool
    status: Status
    moved: float = math.nan
    turned: float = math.nan
    force: float = math.nan
    overlap: float = math.nan
    seconds: float = math.nan


def run_protocol(trial: GraspTrial, protocol: Protocol, rank: int = 0, draw: int = 0) -> ProtocolResult:
    """Put one grasp to a protocol; see `pull_grasp` and `lift_grasp`."""
    started = time.process_time()
    overlap = TrialDriver(trial, protocol.trial).grasp_overlap()
    if protocol.pull is not None:
        pull = pull_grasp(trial, protocol)
        status, moved, turned, force = pull.status, pull.moved, pull.turned, pull.force
    else:
        lift = lift_grasp(trial, protocol.trial)
        status, (moved, turned) = lift.status, lift.object_motion
        force = math.nan if status is Status.START_OVERLAP else float(lift.forces[-1].mean())
    spent = time.process_time() - started
    return ProtocolResult(rank, draw, status is Status.OK, status, moved, turned, force, overlap, spent)
