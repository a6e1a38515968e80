"""A simulated trial: approach, closing, lift and hold of the true object."""

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import check_contacts, check_stand
from torchgrasp.control.reference import check_single
from torchgrasp.control.smooth import smooth_step
from torchgrasp.data.shipped import GraspObject, solid_of
from torchgrasp.evaluation.criterion import Tick, judge_lift, motion_between
from torchgrasp.evaluation.trial import (
    TRIALS,
    GraspTrial,
    TrialDriver,
    TrialRun,
    Truth,
)
from torchgrasp.foundation.base import map_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Pose, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.sim.scene_spec import Neighbour
from torchgrasp.values.closing import ClosingTrace, ClosureResult, Disturbance, ObjectMotion
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec

LIFT_TIME = 1.0  # time [s] in which the hand rises
# least motion [m] of the object's centre during the closing that counts as ejected
PUSHED_DISTANCE = 0.05


@dataclasses.dataclass(frozen=True)
class LiftNumbers:
    """Parameters of a simulated lift and of its verdict."""

    shaking: float = 5.0
    """Frequency [Hz] at which the raised hand shakes."""
    judged: float = 0.2
    """Time [s] at the end of the trial in which the fingers must touch the object."""
    lost: float = 0.5
    """Distance [m], beyond the lift's height, that the object may move: beyond it, the object is
    lost, and the trial ends.
    """


LIFTS = LiftNumbers()


@checked
@single_threaded
def close_hand(
    grasp: Grasps,
    hand: Hand | Path | str,
    mesh: "trimesh.Trimesh | Path | str | GraspObject",
    spec: TrialSpec | None = None,
    seed: Seed = 0,
    *,
    error: Pose | None = None,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
    table: Plane | None = None,
    neighbours: Sequence[Neighbour] = (),
    told: Plane | None = None,
    surface: SignedDistanceField | None = None,
    slide: Float[Tensor, "3"] | None = None,
) -> ClosureResult:
    """Close a hand on the true object, lift it and hold it, in simulation; return the record.

    The opened hand moves straight to its pre-grasp, closes and presses (`GraspController`), rises
    and holds. The frame of the grasp, in which poses are given, is that of the planned cloud. The
    object is **held** if three conditions are met:

    * its centre rose by at least half of the lift's height;
    * at least two fingers touch it at the end;
    * it slipped by less than 20 mm and 30 degrees in the closed hand.

    `status` says why an object was not held. Equal arguments give bitwise equal results.

    Args:
        grasp: a single grasp.
        hand: the hand of the grasp, or its name or folder.
        mesh: the true object [m], closed, in the frame of the grasp: a trimesh, a file, or a
            `GraspObject`.
        spec: parameters of the trial; None means `TrialSpec()`.
        seed: seed of the sensors' noise, and of friction and mass if the `spec` has distributions
            of them.
        error: pose (4, 4) [m] of the true hand in the frame of the planned hand, the hand at
            `Grasps.obj_from_hand`. None means no error. The controller does not know it.
        parts: convex parts [m] of the mesh. None means the parts of a `GraspObject`, or those that
            `convex_parts` computes.
        table: the true table below the object, in the frame of the grasp. None means a level table
            at the mesh's lowest point. It ends where the plan's table (`Grasps.table`) ends.
        neighbours: other bodies on the table, which the hand may push.
        told: the table that the controller knows, in the frame of the grasp. None means the table
            of the plan (`Grasps.table`).
        surface: estimated surface of the object (`surface_field`), in the frame of the grasp. The
            controller compares touches with it to estimate the object's pose. None means the
            tangent planes of the planned contacts.
        slide: displacement (3,) [m] of the object along the table, in the frame of the grasp. It
            happens halfway through the approach, and the controller does not know it. None means no
            displacement.

    Raises:
        BadArgument: there is not exactly one grasp, or its approach is no unit vector.
        BadArgument: joints are of another hand, or a pre-grasp is outside the joint limits.
        BadArgument: contacts are off the mesh, or the mesh does not stand on the `table`.
        BadArgument: a `slide` without an approach, or `told` without a table.
        MeshError: the mesh is missing, open or without volume.
        MissingExtra: the simulator is not installed.

    >>> from torchgrasp import load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "allegro")
    >>> result = close_hand(grasp, "allegro", load_object("jug"), TrialSpec(hold_time=0.2))
    >>> result.held, result.slip.distance < 0.01, result.disturbance.early
    (True, True, tensor([False, False, False]))
    >>> result.trace.forces.shape[1:]
    torch.Size([3, 3])
    """
    check_single(grasp)
    mesh, parts = solid_of(mesh, parts)
    hand = hand if isinstance(hand, Hand) else hand_of(grasp, hand)
    check_contacts(grasp, mesh, TRIALS.slack)
    if table is not None:
        check_stand(mesh, table)
    truth = Truth(mesh, parts, error, table, neighbours, slide)
    return lift_grasp(GraspTrial(hand, grasp, truth, seed, told, surface), spec)


@checked
@single_threaded
def lift_grasp(trial: GraspTrial, spec: TrialSpec | None = None) -> ClosureResult:
    """Run one simulated trial: close the hand, lift the object and hold it; return the record.

    `trial` has the hand, a single grasp and the true object. `spec` are the parameters of the
    trial; None means `TrialSpec()`. The object is held if three conditions are met. Its centre rose
    by at least half of the lift. At least two fingers touch it at the end. It slipped by less than
    20 mm and 30 degrees in the closed hand.

    Raises `BadArgument` for a trial whose hand, grasp, mesh and table do not fit together. Raises
    `MeshError` for a mesh that is missing, open or without volume, and `MissingExtra` without the
    simulator.
    """
    return run_lift(TrialDriver(trial, TrialSpec() if spec is None else spec))


def run_lift(driver: TrialDriver) -> ClosureResult:
    """Run the lift trial of a `driver` in a fresh simulated scene, and return its record.

    The hand closes, lifts the object and holds it. The `driver` has checked the trial.
    """
    return RecordedLift(driver.open()).complete()


class _ObjectLost(Exception):
    """Raised when the object is too far away to continue the trial."""


class RecordedLift:
    """One simulated trial that closes the hand, lifts the object and holds it, with the record of
    its control ticks.
    """

    def __init__(self, run: TrialRun) -> None:
        self.run = run
        self.spec = run.spec
        self.ticks: list[Tick] = []
        self.arrived = 0
        self.pushed = 0.0
        self.strained = False
        self.unbalanced = math.nan
        self.touched: int | None = None
        self.pressed: int | None = None

    def complete(self) -> ClosureResult:
        """Run all phases of the trial, from approach to hold; return its record."""
        started = time.perf_counter()
        status = self.perform()
        return self.result(status, time.perf_counter() - started)

    def perform(self) -> Status:
        """Run all phases of the trial, from approach to hold. Return `OK` if the object was held,
        or why not.
        """
        self._record()
        if not self.run.starts:
            return Status.START_OVERLAP
        try:
            for _ in self.run.approach():
                self._record()
            self.arrived = len(self.ticks) - 1
            self._close()
            failed = self._lift()
        except FloatingPointError:
            return Status.UNSTABLE
        except _ObjectLost:
            failed = None
        return self._verdict() if failed is None else failed

    def _close(self) -> None:
        """Close the hand and press; record when all fingers touched, and what the pressing did."""
        run = self.run
        for _ in run.close():
            self._record()
            touching = run.controller.hold is not None or self._touched_all()
            if self.touched is None and touching:
                self.touched = len(self.ticks) - 1
        self.pressed = len(self.ticks) - 1
        self.touched = self.pressed if self.touched is None else self.touched
        self.pushed = self._moved()
        self.strained = run.strained()
        self.unbalanced = run.robot.unbalanced()

    def _lift(self) -> Status | None:
        """Raise the hand and hold the object; return the failure if the hand puts it down."""
        run = self.run
        ticks = run.robot.ticks(LIFT_TIME)
        rising = ticks * run.robot.period
        for k in range(ticks + run.robot.ticks(self.spec.hold_time)):
            if k == ticks and any(self.spec.push):
                run.scene.pull(np.array(self.spec.push))
            elapsed = (k + 1) * run.robot.period
            height, speed = self._height(elapsed, rising)
            run.scene.lift(height, speed)
            run.step()
            self._record()
            if self._gives_up(height):
                return self._put_down(elapsed, rising)
        return None

    def _gives_up(self, height: float) -> bool:
        """Return whether the hand, raised to a height [m], shall put the object down."""
        return self.run.controller.status is Status.TOO_HEAVY

    def _put_down(self, elapsed: float, rising: float) -> Status:
        """Lower the hand for as long as it rose; return `TOO_HEAVY`, or `DROPPED` if the object is
        then elsewhere.
        """
        height, _ = self._height(elapsed, rising)
        ticks = self.run.robot.ticks(min(elapsed, rising))
        for k in range(ticks):
            share, rate = smooth_step((k + 1) / ticks)
            speed = -height * rate / (ticks * self.run.robot.period)
            self.run.scene.lift(height * (1 - share), speed)
            self.run.step()
            self._record()
        return Status.TOO_HEAVY if self._moved() < PUSHED_DISTANCE else Status.DROPPED

    def _height(self, elapsed: float, rising: float) -> tuple[float, float]:
        """Return target height [m] and speed [m/s] after an `elapsed` time [s], for a rise of
        `rising` seconds and then shaking.
        """
        share, rate = smooth_step(min(elapsed / rising, 1.0))
        height = self.spec.lift_height * share
        if elapsed < rising or self.spec.shake == 0.0:
            return height, self.spec.lift_height * rate / rising
        frequency = 2 * math.pi * LIFTS.shaking
        phase = frequency * (elapsed - rising)
        speed = self.spec.shake * frequency * math.cos(phase)
        return height + self.spec.shake * math.sin(phase), speed

    def _record(self) -> None:
        """Record a tick; raise an error if the simulation has diverged or the object is too far
        away.
        """
        robot = self.run.robot
        scene = self.run.scene
        pose = scene.object_pose()
        joints = scene.joints()
        arrays = (
            np.float64(robot.steps * self.spec.timestep),
            pose,
            scene.hand_pose(),
            scene.neighbour_poses(),
            joints,
            robot.sent,
            robot.finger.sum(),
            pose[:3, :3] @ scene.centre + pose[:3, 3],
            np.array(self.run.felt),
        )
        numbers = map(torch.as_tensor, arrays)
        self.ticks.append(Tick(*numbers, blend=self.run.controller.blend, truth=robot.truth))
        moved = self._moved()
        if not np.isfinite(joints).all() or not math.isfinite(moved):
            raise FloatingPointError
        if moved > LIFTS.lost + self.spec.lift_height:
            self.pushed = self.pushed or moved
            raise _ObjectLost

    def _moved(self) -> float:
        """Return how far [m] the object's centre of mass is from its place before the hand touched
        the object.
        """
        start = self.ticks[0].centre + torch.from_numpy(self.run.slid)
        return float(norm(self.ticks[-1].centre - start))

    def _touched_all(self) -> bool:
        """Return whether every finger has touched the object."""
        return bool(np.isfinite(self.run.robot.first_touch).all())

    def _verdict(self) -> Status:
        """Return the status of a completed trial: `Status.OK` if the object was held, or else the
        first failure.
        """
        last = self.run.robot.ticks(LIFTS.judged)
        judged = judge_lift(self.ticks, self.pressed or 0, last, self.spec.lift_height)
        if judged in (Status.OK, Status.SLIPPED):
            return judged
        if not self._touched_all():
            return Status.NO_CONTACT
        if self.pushed > PUSHED_DISTANCE:
            return Status.EJECTED
        return Status.TOO_WEAK if self.strained else judged

    def _motion(self, first: int | None, last: int | None, in_hand: bool = True) -> ObjectMotion:
        """Return the object's motion between two ticks, relative to the hand or the world; NaN if a
        tick is None.
        """
        if first is None or last is None:
            return ObjectMotion(math.nan, math.nan)
        return motion_between(self.ticks[first], self.ticks[last], in_hand)

    def result(self, status: Status, seconds: float) -> ClosureResult:
        """Return the record of the trial as a `ClosureResult`, with its `status` and its wall time
        `seconds` [s].
        """
        ticks = map_tensors(lambda *tensors: torch.stack(tensors), *self.ticks)
        robot = self.run.robot
        obj_from_world = self.run.obj_from_world
        ends = (self.arrived, self.touched, self.pressed)
        reached = [math.nan if k is None else ticks.time[k] for k in ends]
        first_touch = robot.first_touch
        first_stray = torch.from_numpy(robot.first_stray)
        truth = ticks.truth
        touched = [finger for finger, step in enumerate(first_touch) if np.isfinite(step)]
        assert truth.sliding is not None
        if not torch.equal(obj_from_world, torch.eye(4, dtype=torch.float64)):
            bodies = {"object_pose": ticks.object_pose, "neighbour_pose": ticks.neighbour_pose}
            world_from_obj = inverse(obj_from_world)
            moved = {name: obj_from_world @ x @ world_from_obj for name, x in bodies.items()}
            ticks = dataclasses.replace(ticks, hand_pose=obj_from_world @ ticks.hand_pose, **moved)
        disturbance = Disturbance(
            first_stray * self.spec.timestep,
            torch.from_numpy(robot.stray),
            torch.from_numpy(robot.most_stray),
            early=first_stray < min(first_touch),
            neighbour_pose=ticks.neighbour_pose,
        )
        return ClosureResult(
            held=status is Status.OK,
            status=status,
            time=ticks.time,
            forces=truth.normal_force,
            object_pose=ticks.object_pose,
            hand_pose=ticks.hand_pose,
            joints=ticks.joints,
            targets=ticks.targets,
            joint_names=self.run.scene.joint_names,
            contact_order=tuple(sorted(touched, key=lambda finger: first_touch[finger])),
            object_motion=self._motion(self.arrived, -1),
            pushed=self._motion(self.arrived, self.touched, in_hand=False),
            before_lift=self._motion(0, self.pressed, in_hand=False),
            rise=float(ticks.centre[-1, 2] - ticks.centre[0, 2]),
            unbalanced=self.unbalanced,
            slip=self._motion(self.pressed, -1),
            start_overlap=self.run.overlap,
            disturbance=disturbance,
            trace=ClosingTrace(
                truth.forces, truth.points, truth.normals, truth.sliding, ticks.blend, *ticks.felt.T
            ),
            phases=torch.tensor(reached, dtype=torch.float64),
            stops=self.run.controller.stops,
            attempts=self.run.controller.attempts,
            seconds=seconds,
            friction=self.run.controller.friction,
            mass=self.run.controller.mass,
            finger_names=robot.reference.hand.finger_names,
        )
