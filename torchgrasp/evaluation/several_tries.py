"""A trial over several grasps: where the object stays behind in a lift, the hand opens and tries
another grasp.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.controller import GraspController
from torchgrasp.control.regrasp import GraspTry
from torchgrasp.evaluation.lift import RecordedLift
from torchgrasp.evaluation.protocols import apply_error, seed_of
from torchgrasp.evaluation.trial import (
    GraspTrial,
    TrialDriver,
    TrialRun,
    Truth,
    check_truth,
    true_table,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.sim.convex_parts import read_solid
from torchgrasp.sim.scene_spec import Neighbour
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec


class LiftTry(NamedTuple):
    """One try of `lift_grasps`: a grasp and the record of its lift.

    Attributes:
        row: index of the grasp among the grasps of the trial (`GraspTrial.grasp`), which are in the
            order of preference.
        result: record of the lift, as `close_hand` returns it.
    """

    row: int
    result: ClosureResult


@checked
@single_threaded
def lift_grasps(
    trial: GraspTrial, spec: TrialSpec | None = None, tries: Count = 3
) -> tuple[LiftTry, ...]:
    """Lift an object with the first of several grasps; after a failed lift, try the next one.
    Return all tries.

    The robot may detect that the object slides or stays behind (`LiftCheck`), or that it is too
    heavy. Then the hand goes down, opens and withdraws; the object stays where it is. The robot
    estimates the object's new pose from the touches. With a `trial.truth.camera` it looks at the
    object before each try. Of the remaining grasps it tries the one that most likely holds there
    (`GraspTry.next`).

    Args:
        trial: the hand, grasps in the order of preference, and the true object. `trial.truth.error`
            is the error of the hand's pose at the first grasp.
        spec: parameters of the trial; None means `TrialSpec()`.
        tries: largest number of tries. With 1 the trial is that of `close_hand`.

    Raises:
        BadArgument: joints are of another hand, or a pre-grasp is outside the joint limits.
        BadArgument: contacts are off the mesh, or the mesh does not stand on the table.
        BadArgument: the approach of the first grasp is no unit vector.
        MeshError: the mesh is missing, open or without volume.
        MissingExtra: the simulator is not installed.

    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "allegro")
    >>> trial = GraspTrial(load_hand("allegro"), grasp, Truth(jug.mesh, jug.parts))
    >>> [(row, result.held) for row, result in lift_grasps(trial, TrialSpec(hold_time=0.2))]
    [(0, True)]
    """
    first = dataclasses.replace(trial, grasp=trial.grasp[0])
    driver = TrialDriver(first, TrialSpec() if spec is None else spec)
    check_truth(trial)
    return run_lifts(driver, trial.grasp, tries)


def run_lifts(driver: TrialDriver, grasps: Grasps, tries: int) -> tuple[LiftTry, ...]:
    """Lift the object with the first of several `grasps`; after a failed lift, try another one.

    Return all tries, at most `tries`. `driver` has checked the trial, and opens a fresh simulated
    scene for each try. `GraspTry` chooses the next grasp.
    """
    done = list[LiftTry]()
    run: TrialRun | None = None

    def start(grasp: Grasps) -> GraspController:
        nonlocal driver, run
        if run is not None:
            driver = _next_driver(driver, grasp, done[-1].result, run.controller.displacement)
        run = driver.open()
        return run.controller

    attempt: GraspTry | None = GraspTry(grasps, start, driver.trial.surface)
    while attempt is not None:
        assert run is not None
        # the last try goes on whatever the hand feels
        last = len(done) + 1 >= tries or not len(attempt.others)
        lift = RecordedLift(run) if last else _CheckedLift(run, attempt)
        result = lift.complete()
        done.append(LiftTry(attempt.row, result))
        if last or not (attempt.lost or result.status is Status.TOO_HEAVY):
            break
        attempt = attempt.next()
    return tuple(done)


class _CheckedLift(RecordedLift):
    """A lift that ends where the robot feels that it has failed."""

    def __init__(self, run: TrialRun, attempt: GraspTry) -> None:
        super().__init__(run)
        self.attempt = attempt

    def _gives_up(self, height: float) -> bool:
        """Return whether the object is too heavy or, before it is pushed, lost."""
        alone = height < self.spec.lift_height or not any(self.spec.push)
        period = self.run.robot.period
        failed = alone and self.attempt.fails(self.run.observation, height, period)
        return failed or super()._gives_up(height)

    def _put_down(self, elapsed: float, rising: float) -> Status:
        """Lower the hand, open it, withdraw it and let the object come to rest; return why the lift
        failed.
        """
        status = super()._put_down(elapsed, rising)
        run = self.run
        withdrawal = self.attempt.withdraw(run.observation, run.robot.period, self.spec.approach)
        for targets in withdrawal:
            run.scene.approach(targets.left, -withdrawal.speed)
            run.robot.tick(targets)
            self._record()
        return self._verdict() if self.attempt.lost else status


def _next_driver(
    driver: TrialDriver, grasp: Grasps, result: ClosureResult, felt: Float[Tensor, "4 4"]
) -> TrialDriver:
    """Return the driver of the next try, of another `grasp`, where the last try left the bodies.

    `felt` is the displacement of the object that the last try felt, in its planned hand's frame.
    """
    trial = driver.trial
    following = grasp.obj_from_hand[0].to("cpu", torch.float64)
    truth = _left_behind(trial, result, felt, following)
    seed = seed_of(trial.seed, "again")
    following_trial = dataclasses.replace(trial, grasp=grasp, truth=truth, seed=seed)
    return TrialDriver(following_trial, driver.spec)


def _left_behind(
    trial: GraspTrial,
    result: ClosureResult,
    felt: Float[Tensor, "4 4"],
    following: Float[Tensor, "4 4"],
) -> Truth:
    """Return the truth of the next try: all bodies are where the last try left them.

    The hand errs as before, and the robot follows the displacement that it has felt, in the planned
    hand's frame.
    """
    truth = trial.truth
    planned = trial.grasp.obj_from_hand[0].to("cpu", torch.float64)
    true = apply_error(planned, truth.error)
    error = inverse(following) @ true @ felt @ inverse(planned) @ following
    table = true_table(trial.grasp, truth)
    bodies = Neighbour(read_mesh(truth.mesh), truth.parts), *truth.neighbours
    poses = result.object_pose[-1], *result.disturbance.neighbour_pose[-1]
    target, *others = (_moved(body, pose.numpy()) for body, pose in zip(bodies, poses, strict=True))
    changes = {"error": error, "table": table, "neighbours": others, "slide": None}
    return dataclasses.replace(truth, mesh=target.mesh, parts=target.parts, **changes)


def _moved(body: Neighbour, pose: np.ndarray) -> Neighbour:
    """Return a body whose mesh and convex parts are moved by a pose."""
    mesh, parts = read_solid(body.mesh, body.parts)
    moved = [solid.copy().apply_transform(pose) for solid in (mesh, *parts)]
    return Neighbour(moved[0], moved[1:], body.mass)
