"""Trials that pull at a grasped object in six directions, and trials under any protocol."""

import dataclasses
import math
import time
from typing import Annotated, Any

import numpy as np
import torch

from torchgrasp.evaluation.causes import find_cause
from torchgrasp.evaluation.protocols import (
    PULL_INTERVAL,
    Protocol,
    PullSpec,
    draw_push,
    find_protocol,
    seed_of,
)
from torchgrasp.evaluation.several_tries import run_lifts
from torchgrasp.evaluation.summary import ProtocolResult
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver, TrialRun, check_truth
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Measured, Range
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import rotation_angle

DIRECTIONS = tuple(np.array(sign) * axis for axis in np.eye(3) for sign in (-1.0, 1.0))
"""Directions of the pulls: -x, +x, -y, +y, -z, +z of the world."""


@checked
@dataclasses.dataclass(frozen=True)
class PullResult(Value):
    """The result of a pull trial: whether the object stayed in the hand; `pull_grasp` returns it.

    Attributes:
        passed: whether the object stayed in the hand in all six pulls, within the motion that
            `PullSpec` allows.
        status: how the last pull ended. If no pull was tried, it says how the closing failed.
        directions: number of pulls that were tried, up to 6; 0 if the closing failed.
        moved: largest motion [m] of the object's centre of mass in the world, over all tried pulls.
            It counts from the start of the trial. If no pull was tried, it is the motion at the end
            of the closing. It is infinite if the simulation diverged, and 0 if the closing did not
            start.
        turned: largest rotation [rad] of the object in the world, counted as for `moved`; infinite
            or 0 in the same cases.
        force: mean normal force [N] of the fingers at the end of the closing; NaN if the closing
            did not start.
        seconds: CPU time [s] of the trial.
    """

    passed: bool
    status: Status
    directions: int
    moved: Measured
    turned: Measured
    force: Measured
    seconds: Measured


@checked
@single_threaded
def pull_grasp(trial: GraspTrial, protocol: Protocol | str = "dexgraspbench") -> PullResult:
    """Close a hand on the true object, pull at the object, and return whether it stayed in the
    hand.

    A pull fails if the object's centre of mass moves by `distance` [m], or the object turns by
    `angle` [rad]. Both are fields of the protocol's `PullSpec`. This motion counts from the start
    of the trial, so it includes the closing.

    The pulls are along -x, +x, -y, +y, -z and +z of the grasp's frame, until one fails. This is the
    frame in which the grasp was planned. With a `truth.table` the axes are those of a frame on this
    table. There z is up, and x along the hand's x axis. Every pull starts from the same closed
    grasp.

    Args:
        trial: the hand, a single grasp and the true object.
        protocol: a protocol with pulls, or its name in `PROTOCOLS`.

    Raises `BadArgument` for an unknown protocol, or one without pulls. It is also raised for a
    trial whose hand, grasp, mesh and table do not fit together. Raises `MeshError` for a mesh that
    is missing, open or without volume, and `MissingExtra` without the simulator.

    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "allegro")
    >>> from torchgrasp.evaluation import Truth
    >>> pull = PullSpec(10.0, 0.2, 0.05, 0.26)
    >>> protocol = dataclasses.replace(find_protocol("dexgraspbench"), pull=pull)
    >>> trial = GraspTrial(load_hand("allegro"), grasp, Truth(jug.mesh, jug.parts))
    >>> found = pull_grasp(trial, protocol)
    >>> found.passed, found.directions
    (True, 6)
    """
    protocol = find_protocol(protocol)
    if protocol.pull is None:
        raise BadArgument("protocol", f"{protocol.name!r}, which lifts", "a protocol that pulls")
    driver = TrialDriver(trial, protocol.trial)
    check_truth(trial)
    return run_pulls(driver, protocol.pull)


def run_pulls(driver: TrialDriver, spec: PullSpec) -> PullResult:
    """Run the pull trial that `driver` has checked, and return its result.

    The hand grasps the object once. Pulls in six directions follow, until one fails. Every pull
    starts from the same closed grasp, along -x, +x, -y, +y, -z and +z of the simulator's frame.
    `spec` gives the force and time of each pull, and the motion of the object at which it fails.
    """
    started = time.process_time()
    run = driver.open()
    start = run.scene.object_pose()
    force = math.nan
    tried = 0
    status = Status.START_OVERLAP
    largest = np.zeros(2)
    if run.starts:
        for _ in run.close():
            pass
        force = float(run.robot.force.mean())
        status, largest = _look(run, spec, start)
        status = Status.EJECTED if status is Status.MOVED else status
    if status is Status.OK:
        largest = np.zeros(2)
        reopen = run.keep()
        for tried, direction in enumerate(DIRECTIONS, start=1):
            status, motion = _pull(run if tried == 1 else reopen(), spec, start, direction)
            largest = np.maximum(largest, motion)
            if status is not Status.OK:
                break
    moved, turned = largest.tolist()
    return PullResult(
        status is Status.OK, status, tried, moved, turned, force, time.process_time() - started
    )


def _pull(
    run: TrialRun, spec: PullSpec, start: np.ndarray, direction: np.ndarray
) -> tuple[Status, np.ndarray]:
    """Pull in one direction; return status and largest motion [m, rad] from the pose `start`."""
    run.scene.pull(spec.acceleration * run.mass * direction)
    status = Status.OK
    largest = np.zeros(2)
    for _ in range(spec.checks):
        run.hold(PULL_INTERVAL)
        status, motion = _look(run, spec, start)
        largest = np.maximum(largest, motion)
        if status is not Status.OK:
            break
    return status, largest


def _look(run: TrialRun, spec: PullSpec, start: np.ndarray) -> tuple[Status, np.ndarray]:
    """Return `OK` or a failure if the object has moved too far, and the object's motion [m, rad]
    from the start.
    """
    pose = run.scene.object_pose()
    centre = np.append(run.scene.centre, 1.0)
    if not np.isfinite(pose).all():
        return Status.UNSTABLE, np.full(2, math.inf)
    moved = np.linalg.norm((pose @ centre - start @ centre)[:3])
    turned = float(rotation_angle(torch.from_numpy(start[:3, :3].T @ pose[:3, :3])))
    still = moved < spec.distance and turned < spec.angle
    return Status.OK if still else Status.MOVED, np.array([moved, turned])


@checked
@single_threaded
def run_protocol(
    trial: GraspTrial,
    protocol: Protocol,
    rank: Annotated[int, Range(0, 1000000)] = 0,
    draw: Annotated[int, Range(0, 1000000)] = 0,
) -> ProtocolResult:
    """Run one simulated trial of a grasp under a protocol, pulls or a lift, and return its outcome.

    With `protocol.tries` > 1 the trial may hold further grasps, which are tried where a lift fails
    (`lift_grasps`). A force of the size `protocol.push` [N] pushes the lifted object. Its direction
    is drawn from the trial's seed.

    The numbers `rank` and `draw` are only stored in the result. They are the grasp's rank among
    those of its view, and the index of the trial's random pose error.
    """
    started = time.process_time()
    if protocol.push:
        protocol = protocol.with_trial(push=draw_push(protocol.push, seed_of(trial.seed, "push")))
    first = trial if protocol.tries == 1 else dataclasses.replace(trial, grasp=trial.grasp[0])
    driver = TrialDriver(first, protocol.trial)
    overlap = driver.grasp_overlap()
    if protocol.pull is None:
        found = _lift_results(driver, trial, protocol)
    else:
        found = _pull_results(driver, protocol.pull)
    seconds = time.process_time() - started
    return ProtocolResult(rank, draw, overlap=overlap, seconds=seconds, **found)


def _pull_results(driver: TrialDriver, spec: PullSpec) -> dict[str, Any]:
    """Run a pull trial; return its results as fields of `ProtocolResult`."""
    pull = run_pulls(driver, spec)
    return {
        "passed": pull.passed,
        "status": pull.status,
        "moved": pull.moved,
        "turned": pull.turned,
        "force": pull.force,
    }


def _lift_results(driver: TrialDriver, trial: GraspTrial, protocol: Protocol) -> dict[str, Any]:
    """Run the lifts of a trial; return the results of the last one as fields of `ProtocolResult`."""
    lifts = run_lifts(driver, trial.grasp, protocol.tries)
    lift = lifts[-1].result
    risen = lift.rise >= 0.5 * protocol.trial.lift_height
    closed = lift.status is not Status.START_OVERLAP
    cause, size = find_cause(lifts, trial, protocol.trial)
    return {
        "passed": lift.held if protocol.criterion == "held" else risen,
        "status": lift.status,
        "moved": lift.object_motion.distance,
        "turned": lift.object_motion.angle,
        "force": float(lift.forces[-1].mean()) if closed else math.nan,
        "slip": lift.slip.distance,
        "slip_angle": lift.slip.angle,
        "tries": len(lifts),
        "cause": cause,
        "size": size,
    }
