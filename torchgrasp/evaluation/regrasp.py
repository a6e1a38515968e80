"""A trial over several grasps: where the object stays behind in a lift, the hand opens and tries
another grasp.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.control.controller import GraspController
from torchgrasp.control.recovery import LiftCheck, Reopening
from torchgrasp.control.tactile import Targets
from torchgrasp.control.uncertainty_closing import UncertaintyClosing
from torchgrasp.evaluation.lift import _Lift, run_lift
from torchgrasp.evaluation.protocols import apply_error, seed_of
from torchgrasp.evaluation.trial import (
    GraspTrial,
    TrialDriver,
    TrialRun,
    Truth,
    check_truth,
    smooth_step,
)
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import inverse, rigid, rotation_from_vector
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.sim.convex_parts import read_solid
from torchgrasp.sim.scene_spec import Neighbour
from torchgrasp.success.loads import log_odds_about
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec


@dataclasses.dataclass(frozen=True)
class RegraspNumbers:
    """Parameters by which another grasp is chosen after a failed one."""

    gap: float = 0.015  # mean distance [m] of the contacts above which a grasp differs
    turn: float = math.radians(30)  # angle [rad] of the approaches above which a grasp differs
    share: float = 0.35  # share of the object's mass that may be concentrated at one surface point
    withdrawal: float = 0.6  # time [s] in which the opened hand withdraws, and the object rests
    # number of surface points, at least, that are tried as the place of this mass (fewer if the
    # surface has fewer)
    places: int = 64


REGRASP = RegraspNumbers()


@checked
def next_grasp(
    grasps: Grasps, tried: Sequence[int], surface: SignedDistanceField | None = None
) -> int:
    """Return the index of the grasp of `list_others` that most likely holds, after those `tried`
    failed.

    `surface` is the estimated surface of the object, in the frame of the grasps. Without it or a
    table, or if the grasps are not ranked by success, it is the best-ranked one.
    """
    others = list_others(grasps, tried)
    if surface is None or grasps.table is None or grasps.meta.get("ranking") != "success":
        return int(others[0])
    return int(others[_chances(grasps, grasps.table, surface, tried)[others].argmax()])


@checked
def list_others(grasps: Grasps, tried: Sequence[int]) -> Int[Tensor, "k"]:
    """Return the indices of the grasps that differ from all `tried` (indices).

    They differ by more than `REGRASP.turn` in approach, or `REGRASP.gap` in contacts.
    """
    approach = grasps.approach
    points = grasps.contacts.points.double()
    gaps = norm(points[:, None] - points[list(tried)]).mean(-1)  # (g, t)
    differs = (gaps > REGRASP.gap) | (approach @ approach[list(tried)].T < math.cos(REGRASP.turn))
    return flatnonzero(differs.all(-1))


def _chances(
    grasps: Grasps, table: Plane, surface: SignedDistanceField, tried: Sequence[int]
) -> Float[Tensor, "g"]:
    """Return each grasp's probability of success given that the tried ones failed; 0 if it is
    unknown.

    A share of the mass may be at any point of the surface, which may explain the failures.
    """
    shell = (surface.values.abs() < surface.spacing).nonzero().double()
    some = shell[:: max(1, len(shell) // REGRASP.places)]
    places = surface.origin.double() + surface.spacing * some  # (p, 3)
    middle = places.mean(0)
    centers = torch.cat([middle[None], middle + REGRASP.share * (places - middle)])
    friction = float(grasps.meta["friction"])
    log_odds = log_odds_about(grasps, centers, friction, (-table.normal).tolist())  # (g, p + 1)
    weight = torch.sigmoid(-log_odds[list(tried)]).prod(0)
    return (torch.sigmoid(log_odds) @ weight / weight.sum()).where(grasps.success > 0, 0.0)


class LiftTry(NamedTuple):
    """One try of a trial over several grasps."""

    row: int  # index of the grasp that was tried
    result: ClosureResult  # record of its lift


@checked
@single_threaded
def lift_grasps(
    trial: GraspTrial, spec: TrialSpec | None = None, tries: Count = 3
) -> tuple[LiftTry, ...]:
    """Lift an object with the first grasp of a trial, and with others where a lift fails.

    The result lists all tries, at most `tries`. Where the hand feels that the object slides or
    stays behind (`LiftCheck`), or is too heavy, it goes down, opens and withdraws. The object stays
    where it then is. The robot expects it at the pose that the touches of the last try show, or
    looks once more, and tries the grasp of `next_grasp`.

    The trial's grasps are in the order of preference; the truth's `error` is that of the first
    grasp. With `tries` 1 the trial is that of `close_hand`. Raises the errors of `close_hand`.

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
    """Run the trial of the first of several grasps, and trials of others where a lift fails.

    Return all tries, at most `tries`.
    """
    tried = [0]
    done = list[LiftTry]()
    while len(tried) < tries and len(list_others(grasps, tried)):
        lift = _CheckedLift(driver.open())
        result = lift.complete()
        done.append(LiftTry(tried[-1], result))
        if not (lift.check.lost or result.status is Status.TOO_HEAVY):
            return tuple(done)
        trial = driver.trial
        controller = lift.run.controller
        row = next_grasp(grasps, tried, trial.surface)
        following = grasps.obj_from_hand[row].to("cpu", torch.float64)
        truth = _left_behind(trial, result, _felt(controller), following)
        seed = seed_of(trial.seed, "again")
        trial = dataclasses.replace(trial, grasp=grasps[row], truth=truth, seed=seed)
        tried = [*tried, row]
        driver = TrialDriver(trial, driver.spec)
    last = run_lift(driver)  # it goes on whatever the hand feels
    return *done, LiftTry(tried[-1], last)


class _CheckedLift(_Lift):
    """A lift that ends where the hand feels that it has lost the object."""

    def __init__(self, run: TrialRun) -> None:
        super().__init__(run)
        self.check = LiftCheck(run.robot.reference)

    def _gives_up(self, height: float) -> bool:
        """Return whether the object is too heavy or, before it is pushed, lost."""
        alone = height < self.spec.lift_height or not any(self.spec.push)
        lost = alone and self.check(self.run.observation, height, self.run.robot.period)
        return super()._gives_up(height) or lost

    def _put_down(self, time: float, rising: float) -> Status:
        """Lower the hand, open it, withdraw it and let the object come to rest; return why the lift
        failed.
        """
        status = super()._put_down(time, rising)
        run = self.run
        length = self.spec.approach
        joints = run.observation.joints
        palm = run.controller.targets.palm
        here = torch.zeros(6, dtype=torch.float64)
        reference = run.robot.reference
        opening = Reopening(reference, here, joints, palm, palm + reference.rise, reach=0.0)
        while not opening.done:
            run.robot.tick(Targets(opening(run.robot.period), opening.palm))
            self._record()
        ticks = run.robot.ticks(REGRASP.withdrawal)
        for k in range(2 * ticks):
            share, rate = smooth_step(min((k + 1) / ticks, 1.0))
            run.scene.approach(length * share, -length * rate / (ticks * run.robot.period))
            run.robot.tick(Targets(opening.opened, opening.palm))
            self._record()
        return self._verdict() if self.check.lost else status


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
    table = truth.table
    if table is None:
        table = Plane.horizontal(float(read_mesh(truth.mesh).bounds[0, 2]))
    bodies = Neighbour(read_mesh(truth.mesh), truth.parts), *truth.neighbours
    poses = result.object_pose[-1], *result.disturbance.neighbour_pose[-1]
    target, *others = (_moved(body, pose.numpy()) for body, pose in zip(bodies, poses, strict=True))
    changes = {"error": error, "table": table, "neighbours": others, "slide": None}
    return dataclasses.replace(truth, mesh=target.mesh, parts=target.parts, **changes)


def _felt(controller: GraspController) -> Float[Tensor, "4 4"]:
    """Return the displacement of the object that a controller has felt, in the planned hand's
    frame.
    """
    closing = controller.closing
    centre = controller.reference.gains.target.mean(0)
    if not isinstance(closing, UncertaintyClosing):
        return torch.eye(4, dtype=torch.float64)
    shift = closing.displacement[:3]
    rotation = rotation_from_vector(closing.displacement[3:])
    return rigid(rotation, centre + shift - rotation @ centre)


def _moved(body: Neighbour, pose: np.ndarray) -> Neighbour:
    """Return a body whose mesh and convex parts are moved by a pose."""
    mesh, parts = read_solid(body.mesh, body.parts)
    moved = [solid.copy().apply_transform(pose) for solid in (mesh, *parts)]
    return Neighbour(moved[0], moved[1:], body.mass)
