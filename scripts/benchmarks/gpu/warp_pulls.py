"""Trials of many grasps of one hand at once, which pull in six directions, in MuJoCo Warp on a GPU."""

import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from benchmarks.gpu.warp_scene import WarpScenes
from torchgrasp.control.paper.closings import OpenLoopClosing
from torchgrasp.evaluation.protocols import Protocol, PullSpec, find_protocol
from torchgrasp.evaluation.pull import DIRECTIONS, INTERVAL, PullResult
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import rotation_angle


@checked
def pull_grasps(
    trials: Sequence[GraspTrial], protocol: Protocol | str = "dexgraspbench", device: str = "cuda"
) -> list[PullResult]:
    """Close one hand on many objects and pull each along the world's axes, as `pull_grasp` in
    MuJoCo, all at once.

    The closing must be "open_loop", which needs no sensor. All six pulls of a trial begin from the
    same closed hand. `device` is Warp's: "cuda" or "cpu". `PullResult.force` is NaN; `seconds` is a
    trial's share of the wall time. On a GPU the order of sums changes from run to run, and with it
    the last digits of the motion. Raises `BadArgument` for no trial, more than one `Hand`, an
    unknown device, or a protocol that this cannot run. Without MuJoCo Warp, `MissingExtra` is
    raised; otherwise the errors are those of `pull_grasp`.

    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.evaluation import Truth
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "allegro")
    >>> trial = GraspTrial(load_hand("allegro"), grasp, Truth(jug.mesh, jug.parts))
    >>> pull_grasps([trial] * 1000)[0].passed  # doctest: +SKIP
    True
    """
    protocol = find_protocol(protocol)
    if protocol.pull is None or protocol.trial.closing != "open_loop" or protocol.trial.approach:
        raise BadArgument(
            "protocol",
            repr(protocol.name),
            "one that closes in open loop, without approach, and pulls",
        )
    if len({id(trial.hand) for trial in trials}) != 1:
        raise BadArgument(
            "trials", f"{len({id(trial.hand) for trial in trials})} hands", "trials of one hand"
        )
    drivers = [TrialDriver(trial, protocol.trial) for trial in trials]
    results = list[PullResult]()
    batch = 1024  # trials that are simulated at once, which bounds the memory
    for first in range(0, len(drivers), batch):
        results += pull_drivers(drivers[first : first + batch], protocol.pull, device)
    return results


def pull_drivers(drivers: Sequence[TrialDriver], spec: PullSpec, device: str) -> list[PullResult]:
    """Return the results of checked trials of one hand, which differ in grasp, truth and friction."""
    began = time.perf_counter()
    trial = drivers[0].spec
    n = len(drivers)
    scenes = WarpScenes([driver.scene_spec for driver in drivers], device)
    substeps = max(1, round(1 / (trial.control_rate * trial.timestep)))
    period = substeps * trial.timestep
    start = scenes.object_poses()
    centres = np.array([[*driver.scene_spec.mesh.center_mass, 1.0] for driver in drivers])
    for targets in _closing_targets(drivers, period, scenes.joint_names):
        scenes.drive(targets)
        scenes.step(substeps)
    closed, first = _look(scenes.object_poses(), start, centres, spec)
    closed[closed == Status.MOVED] = Status.EJECTED
    closed[scenes.overlap > trial.overlap] = Status.START_OVERLAP
    ways = len(DIRECTIONS)
    pulls = scenes.copies(ways)
    start = np.tile(start, (ways, 1, 1))
    centres = np.tile(centres, (ways, 1))
    loads = np.tile([driver.scene_spec.mass * spec.acceleration for driver in drivers], ways)
    pulls.pull(np.repeat(DIRECTIONS, n, axis=0) * loads[:, None])
    status = np.full(ways * n, Status.OK)
    largest = np.zeros((ways * n, 2))
    for _ in range(round(spec.seconds / INTERVAL)):
        pulls.step(max(1, round(INTERVAL / period)) * substeps)
        now, motion = _look(pulls.object_poses(), start, centres, spec)
        held = status == Status.OK
        largest[held] = np.maximum(largest, motion)[held]
        status[held] = now[held]
    seconds = (time.perf_counter() - began) / n
    return [
        _result(Status(closed[k]), first[k], status[k::n], largest[k::n], seconds) for k in range(n)
    ]


def _closing_targets(
    drivers: Sequence[TrialDriver], period: float, joint_names: tuple[str, ...]
) -> Iterator[np.ndarray]:
    """Yield the targets (n, j) [rad] of all hands at each tick of a closing in open loop."""
    references = [driver.reference for driver in drivers]
    closings = [OpenLoopClosing(reference) for reference in references]
    together = closings[0]
    names = references[0].hand.tree.joint_names
    order = [names.index(name) for name in joint_names]
    together.poses = torch.stack([closing.poses for closing in closings], 1)
    yield together.poses[0, :, order].numpy()
    while not together.done:
        yield together.advance(period)[:, order].numpy()


def _look(
    poses: np.ndarray, start: np.ndarray, centres: np.ndarray, spec: PullSpec
) -> tuple[np.ndarray, np.ndarray]:
    """Return status (w,) and motion (w, 2) [m, rad] of the objects, given their poses now and at
    the start.
    """
    moved = np.linalg.norm(((poses - start) @ centres[:, :, None])[:, :3, 0], axis=-1)
    turned = rotation_angle(
        torch.from_numpy(start[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, :3])
    ).numpy()
    status = np.where((moved < spec.distance) & (turned < spec.angle), Status.OK, Status.MOVED)
    broken = ~np.isfinite(poses.sum((1, 2)))
    return np.where(broken, Status.UNSTABLE, status), np.where(
        broken[:, None], np.inf, np.stack([moved, turned], -1)
    )


def _result(
    closed: Status, first: np.ndarray, status: np.ndarray, largest: np.ndarray, seconds: float
) -> PullResult:
    """Return the result of one trial, given status and motion after its closing and in each
    direction.
    """
    if closed is not Status.OK:
        moved, turned = (0.0, 0.0) if closed is Status.START_OVERLAP else first.tolist()
        return PullResult(False, closed, 1, moved, turned, np.nan, seconds)
    tried = min([*np.nonzero(status != Status.OK)[0] + 1, len(DIRECTIONS)])
    (moved, turned), last = largest[:tried].max(0).tolist(), Status(status[tried - 1])
    return PullResult(last is Status.OK, last, int(tried), moved, turned, np.nan, seconds)
