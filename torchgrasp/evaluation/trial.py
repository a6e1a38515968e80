"""The driver of simulated trials: opens a fresh scene, approaches, closes and presses."""

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import AGREEMENT, check_contacts
from torchgrasp.cloud.camera import partial_view
from torchgrasp.control.controller import GraspController
from torchgrasp.control.holding import GripHold
from torchgrasp.control.modes import choose_preference
from torchgrasp.control.recovery import can_guard
from torchgrasp.control.reference import ClosingReference, check_single
from torchgrasp.control.relook import REACH
from torchgrasp.control.smooth import smooth_step
from torchgrasp.evaluation.frame import rounded_table, to_frame, world_frame
from torchgrasp.evaluation.protocols import apply_error, draw_trial, seed_of
from torchgrasp.evaluation.true_scene import (
    edge_in_world,
    joints_by_name,
    true_body,
    true_scene,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Pose, Seed
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.drives import drive_efforts
from torchgrasp.hand.hand import Hand
from torchgrasp.sim.scene_spec import Body, Neighbour, SceneSpec
from torchgrasp.sim.simulated_hand import SimulatedHand, open_scene
from torchgrasp.sim.simulated_scene import SimulatedScene
from torchgrasp.values.closing import SensorModel
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ClosingMode, TrialSpec


@dataclasses.dataclass(frozen=True)
class TrialNumbers:
    """Parameters of a simulated trial of a grasp."""

    unit_error: float = 1e-4
    """Greatest deviation from 1 of the length of the approach, a unit vector."""
    speed: float = 0.2
    """Mean speed [m/s] of an approach in which touches do not stop the hand."""
    slid: float = 0.75
    """Greatest displacement [m] of an object along its table."""
    aside: float = 2.0
    """Greatest displacement [m] of the true hand from the planned one."""
    off_table: float = 0.001
    """Greatest part [m] of a displacement along the table that leads off it."""
    slack: float = 0.03
    """Distance [m] from the mesh beyond which a contact is off the mesh: objects may be a bit
    misplaced.
    """
    relooked: float = 1.5
    """Range of motion of the simulated hand for a second look. It is in multiples of the largest
    displacement of the object that the look (`relocate`) tries at first.
    """


TRIALS = TrialNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class Truth:
    """The true world of a trial, which only the simulator knows; `GraspTrial(truth=)` takes it.

    Everything is in the frame of the grasp, that of the planned cloud, in metres. Meshes are
    checked when a trial runs. The planned hand is the hand at the pose of the plan.

    Args:
        mesh: closed mesh of the object [m], or its file.
        parts: convex parts of the mesh [m]; None means those that `convex_parts` computes.
        error: pose (4, 4) [m] of the true hand in the frame of the planned hand; None means no
            error.
        table: the true table below the object. None means a level table at the mesh's lowest point.
            It ends where the plan's table (`Grasps.table`) ends.
        neighbours: other bodies on the table, which the hand may push.
        slide: displacement (3,) [m] of the object along the table, halfway through the approach.
            None means no displacement. A trial without an approach refuses it.
        camera: pose (4, 4) [m] of a depth camera (x right, y down, z forward). With it the robot
            looks again before the approach. None means no second look.

    Raises `BadArgument` for an `error` or `camera` that is not a rigid transform. It is raised for a
    `slide` of more than 0.75 m (`TRIALS.slid`), or an `error` of more than 2 m (`TRIALS.aside`).
    """

    mesh: "trimesh.Trimesh | Path | str"
    parts: "Sequence[trimesh.Trimesh] | None" = None
    error: Pose | None = None
    table: Plane | None = None
    neighbours: Sequence[Neighbour] = ()
    slide: Float[Tensor, "3"] | None = None
    camera: Pose | None = None

    def __post_init__(self) -> None:
        """Check that displacements are in metres."""
        moved = None if self.error is None else self.error[:3, 3]
        for name, vector, most in (
            ("slide", self.slide, TRIALS.slid),
            ("error", moved, TRIALS.aside),
        ):
            length = 0.0 if vector is None else float(norm(vector))
            if length > most:
                found = f"a displacement of {length:.4g} m"
                raise BadArgument(name, found, f"at most {most:g} m, in metres")


@checked
@dataclasses.dataclass(frozen=True)
class GraspTrial:
    """The input of a trial: the true world, and what the robot knows.

    `pull_grasp` and `lift_grasps` take it.

    Args:
        hand: the hand.
        grasp: one grasp of the hand, or for `lift_grasps` several in the order of preference.
        truth: the true world, which only the simulator knows.
        seed: seed of the sensors' noise, and of friction and mass if they are distributions; 0 or
            more.
        told: the table that the controller knows, in the frame of the grasp, that of the planned
            cloud. None means the table of the plan (`Grasps.table`).
        surface: estimated surface of the object (`surface_field`), in the frame of the grasp. The
            controller compares touches with it to estimate the object's pose. None means the
            tangent planes of the planned contacts.

    Raises `BadArgument` for a `seed` out of range.
    """

    hand: Hand
    grasp: Grasps
    truth: Truth
    seed: Seed = 0
    told: Plane | None = None
    surface: SignedDistanceField | None = None


def check_truth(trial: GraspTrial) -> None:
    """Raise `BadArgument` if over 70 % of the contacts of the trial's grasps are over 30 mm off the
    true mesh. The grasps are then probably in another frame.

    It is also raised if the mesh does not stand on the planned table (`Grasps.table`), or is
    wholly below the true one.
    """
    mesh = read_mesh(trial.truth.mesh)
    table = trial.truth.table
    if table is not None:
        top = float(table.height(torch.tensor(mesh.vertices, dtype=torch.float64)).max())
        if top <= 0:
            found = f"one {-1e3 * top:.0f} mm above the whole mesh"
            raise BadArgument("table", found, "the true table below the object, its normal upward")
    check_contacts(trial.grasp, mesh, TRIALS.slack, AGREEMENT.astray)


class TrialDriver:
    """A simulated trial of a grasp, which is checked once and can run any number of times.

    Its constructor raises `BadArgument` if hand, grasp, mesh and table do not fit together. Raises
    `MeshError` for a mesh that is missing, open or without volume.

    Attributes:
        spec: the parameters of the trial, with friction and mass drawn by the trial's seed.
        reference: the closing plan, derived from what the robot knows of the trial.
        obj_from_world: pose (4, 4) [m] of the simulator's frame in the grasp's frame. If there is a
            true table, the frame is upright on it. Numbers are then rounded, so that results are
            bitwise invariant to rigid motion. Without one, both frames are the same.
    """

    def __init__(self, trial: GraspTrial, spec: TrialSpec) -> None:
        check_single(trial.grasp)
        self.trial = trial
        spec = draw_trial(spec, trial.seed)
        self.spec = spec
        hand = trial.hand.to("cpu", torch.float64)
        planned = trial.grasp.to("cpu", torch.float64)
        pose = planned.obj_from_hand[0]
        told = trial.grasp.table if trial.told is None else trial.told
        _check_effects(trial, spec)
        # what the simulator and the robot get: in the frame of the grasp, or of world and hand
        self.obj_from_world = torch.eye(4, dtype=torch.float64)
        grasp = planned
        known = planned
        if trial.truth.table is not None:
            self.obj_from_world = world_frame(trial.truth.table, pose)
            grasp = to_frame(planned, self.obj_from_world)
            known = to_frame(planned, pose)
            if told is not None:
                told = rounded_table(told.moved(inverse(pose)))
        reference = derive_reference(
            hand,
            known,
            told if spec.table else None,
            trial.surface,
            closing=spec.closing,
            force=spec.strongest,
            kp=spec.kp,
            sensor=spec.sensor,
            max_force=spec.max_force,
        )
        self.reference = dataclasses.replace(reference, obj_from_hand=pose)
        hand.check_joints(grasp.pregrasp)
        length = float(norm(grasp.approach))
        if spec.approach and not abs(length - 1) < TRIALS.unit_error:
            found = f"an approach along {grasp.approach[0].tolist()}"
            raise BadArgument("grasp", found, "a unit vector")
        self.scene_spec = self._scene_spec(hand, grasp)

    def _scene_spec(self, hand: Hand, grasp: Grasps) -> SceneSpec:
        """Return the parameters of the simulated scene; the hand's true pose in it includes the
        trial's pose error.
        """
        spec = self.spec
        truth = self.trial.truth
        edge = None
        if spec.table:
            edge = edge_in_world(true_table(self.trial.grasp, truth), self.obj_from_world)
        rise = self.reference.rise
        true_pose = apply_error(grasp.obj_from_hand[0], truth.error)
        turn = true_pose[:3, :3] @ grasp.obj_from_hand[0, :3, :3].T
        approach = turn @ grasp.approach[0] * spec.approach
        relooked = TRIALS.relooked * REACH * (truth.camera is not None)
        return true_scene(
            spec,
            hand,
            true_pose,
            grasp.pregrasp[0],
            self._body(truth),
            travel=spec.lift_height,
            approach=tuple(approach.tolist()),
            table=spec.table,
            height=None if truth.table is None else 0.0,
            edge=edge,
            neighbours=tuple(self._body(x, x.mass) for x in truth.neighbours),
            yields=spec.components.palm_reach + relooked + float(rise.norm()),
        )

    def _body(self, given: Truth | Neighbour, mass: float | None = None) -> Body:
        """Return a given mesh as a body of the scene; `mass` [kg] is that of a neighbour."""
        moved = None if self.trial.truth.table is None else self.obj_from_world
        return true_body(self.spec, given.mesh, given.parts, mass, moved)

    def _open_scene(self, spec: SceneSpec) -> SimulatedScene:
        """Return a fresh scene of a run of the trial."""
        return open_scene(spec, self.spec.simulator)

    def open(self) -> "TrialRun":
        """Return a new run of the trial, in a fresh simulated scene.

        Raises `MissingExtra` if the simulator is not installed.
        """
        return TrialRun(self)

    def grasp_overlap(self) -> float:
        """Return the penetration depth [m] of the hand into the true object at the planned posture,
        before any force. It is at most 0 if they do not overlap.

        The hand is at its true pose, which includes the trial's pose error (`Truth.error`).
        """
        joints = joints_by_name(self.reference.hand, self.reference.joints)
        alone = {"approach": (0.0, 0.0, 0.0), "table": False, "neighbours": (), "self_pairs": ()}
        scene_spec = dataclasses.replace(self.scene_spec, joints=joints, **alone)
        return open_scene(scene_spec, self.spec.simulator).penetration()


def _check_effects(trial: GraspTrial, spec: TrialSpec) -> None:
    """Raise `BadArgument` for what a trial without a table or an approach would ignore; warn of a
    surface that its closing does not look at.
    """
    if trial.told is not None and not spec.table:
        raise BadArgument("told", "a table, for a trial without one", "None")
    slide = trial.truth.slide
    if slide is not None and slide.any() and not spec.approach:
        found = "a displacement halfway through an approach of 0 m"
        raise BadArgument("slide", found, "None, or an approach above 0 m")
    if slide is not None:
        off = float(slide.double() @ true_table(trial.grasp, trial.truth).normal.double().cpu())
        if abs(off) > TRIALS.off_table:
            found = f"a displacement of {1e3 * off:.0f} mm along the table's normal"
            raise BadArgument("slide", found, "one along the table, in the frame of the grasp")
    if trial.surface is not None and spec.closing == "open_loop":
        warn_user(NoEffect, "surface: the closing 'open_loop' looks at no surface")


def true_table(grasps: Grasps, truth: Truth) -> Plane:
    """Return the true table of a trial (`Truth.table`), in the frame of the grasp. If it is None,
    return the level table at the lowest point of the true mesh.

    The level table ends where the planned table (`Grasps.table`) ends. A table ends at its edge, a
    second plane. Raises `BadArgument` if this edge plane is almost level.
    """
    if truth.table is not None:
        return truth.table
    box = read_mesh(truth.mesh).bounds
    level = Plane.horizontal(float(box[0, 2]))
    planned = grasps.table
    if planned is None or planned.edge is None:
        return level
    centre = torch.tensor(box.mean(0).tolist(), dtype=torch.float64)
    # the point of the edge that is next to the object
    off = [plane.height(centre) * plane.normal.to(centre) for plane in (planned, planned.edge)]
    try:
        return level.ending(centre - off[0] - off[1], planned.edge.normal)
    except BadArgument as error:
        found = "None, with a plan whose table ends at a level edge plane"
        raise BadArgument("table", found, "the true table, a Plane") from error


def derive_reference(
    hand: Hand,
    grasp: Grasps,
    table: Plane | None = None,
    surface: SignedDistanceField | None = None,
    closing: ClosingMode = "uncertainty",
    force: float = 4.0,
    kp: float | None = None,
    sensor: SensorModel | None = None,
    max_force: float | None = None,
) -> ClosingReference:
    """Return the closing plan that the controller follows, from all that the robot knows.

    The function takes no `TrialSpec` or `Truth`, which hold numbers of the true world.

    Args:
        hand: the hand of the grasp.
        grasp: a single grasp.
        table: the table in the frame of the grasp; None if unknown.
        surface: the estimated surface of the object, in the frame of the grasp; None if unknown.
        closing: the closing mode, such as "uncertainty" (`TrialSpec`).
        force: normal force [N] of the strongest finger.
        kp: stiffness of every joint's drive [N m/rad]; None means the hand's own.
        sensor: model of the fingertip sensors; None means `SensorModel()`.
        max_force: greatest normal force [N] of a fingertip; None means no limit.
    """
    preference = choose_preference(hand, closing)
    # a simulation may show how a grasp ends that failed a check
    tried = dataclasses.replace(grasp, status=torch.zeros_like(grasp.status))
    plan = ClosingReference.from_grasp(hand, tried, force, kp, preference)
    table = table and table.moved(inverse(grasp.obj_from_hand[0]))
    sensor = sensor or plan.sensor
    return dataclasses.replace(
        plan,
        table=table,
        # trials also tell tables that are wrong, and grasps that were moved into another frame
        planned_table=None,
        surface=surface,
        sensor=sensor,
        max_force=max_force,
    )


class TrialRun:
    """One run of a simulated trial in a fresh scene, with its controller.

    Its phases `approach` and `close` are iterators that yield after every control tick, a period of
    the controller.
    """

    def __init__(self, driver: TrialDriver) -> None:
        spec = driver.spec
        trial = driver.trial
        self.spec = spec
        self.mass = driver.scene_spec.mass
        self.obj_from_world = driver.obj_from_world
        self.slide = None
        if trial.truth.slide is not None:
            slide = trial.truth.slide.to("cpu", torch.float64)
            self.slide = (driver.obj_from_world[:3, :3].T @ slide).numpy()
        guarded = spec.approach if spec.components.stops and can_guard(driver.reference) else 0.0
        self.controller = GraspController(
            driver.reference, spec.closing, spec.pressing, spec.options, guarded
        )
        if trial.truth.camera is not None:
            self._relook(driver, trial.truth.camera)
        start = driver.scene_spec.world_from_hand[:3, :3] @ self.controller.targets.palm.numpy()
        scene_spec = dataclasses.replace(driver.scene_spec, start=tuple(start.tolist()))
        self.scene = driver._open_scene(scene_spec)
        generator = torch.Generator().manual_seed(trial.seed) if spec.noise else None
        self.robot = SimulatedHand(self.scene, driver.reference, spec.control_rate, generator)
        self.overlap = self.scene.penetration()
        self.slid = np.zeros(3)

    def _relook(self, driver: TrialDriver, camera: Float[Tensor, "4 4"]) -> None:
        """Show the controller what a camera sees."""
        seen_from = driver.reference.obj_from_hand.numpy()
        scene_spec = driver.scene_spec
        mesh = scene_spec.mesh.copy()
        # The robot takes its pose for true.
        mesh.apply_transform(seen_from @ np.linalg.inv(scene_spec.world_from_hand))
        seed = seed_of(driver.trial.seed, "relook")
        # not `relook`: in a trial the object may have rolled too far away to be found
        moved = self.controller.locate(partial_view(mesh, camera, seed=seed))
        self.controller.follow(moved)

    @property
    def starts(self) -> bool:
        """Whether the trial starts: the opened hand penetrates other bodies and itself by at most
        `TrialSpec.overlap`, by default 1 mm.
        """
        return self.overlap <= self.spec.overlap

    def keep(self) -> "Callable[[], TrialRun]":
        """Return a function without arguments; each call returns a new run, in the state that this
        run has now.

        The new runs continue with bitwise the same results as this one.
        """
        reopen = self.scene.keep()
        hand = self.robot.reference.hand
        kept = copy.deepcopy(self, {id(x): x for x in (self.scene, hand)})
        return lambda: copy.deepcopy(kept, {id(self.scene): reopen(), id(hand): hand})

    def approach(self) -> Iterator[None]:
        """Move the opened hand straight to its pre-grasp; yield after every control tick.

        A touch stops the hand if `ClosingOptions.stops` is above 0. The hand must then have tactile
        sensors, and know a table and a surface. The object is displaced halfway by `Truth.slide`,
        if that is not None.
        """
        half = 0.5 * self.spec.approach
        if self.controller.approaching:
            self.observation = self.robot.tick(self.controller.targets)
            yield
            while self.controller.approaching:
                self._slide(self.controller.targets.left <= half)
                self.step()
                yield
            self.scene.approach(0.0)
            return
        length = self.spec.approach
        ticks = self.robot.ticks(length / TRIALS.speed) if length else 0
        for k in range(ticks):
            share, rate = smooth_step((k + 1) / ticks)
            self._slide(share >= 0.5)
            self.scene.approach(length * (1 - share), length * rate / (ticks * self.robot.period))
            self.robot.tick(self.controller.targets)
            yield

    def _slide(self, due: bool) -> None:
        """Displace the object once, when it is due, if the truth says that the object moves during
        the approach.
        """
        if due and self.slide is not None:
            self.scene.displace(self.slide)
            self.slid = self.slide
            self.slide = None

    def close(self) -> Iterator[None]:
        """Close the fingers and press until the closing ends; yield after every control tick."""
        self.observation = self.robot.tick(self.controller.targets)
        yield
        while not self.controller.closed:
            self.step()
            yield

    def step(self) -> None:
        """Run the controller and the simulation for one control tick."""
        left = self.controller.targets.left
        targets = self.controller.step(self.observation, self.robot.period)
        if self.spec.approach:
            self.scene.approach(targets.left, (left - targets.left) / self.robot.period)
        self.observation = self.robot.tick(targets)

    def hold(self, seconds: float) -> None:
        """Hold the object for a time `seconds` [s].

        A hand that closed in open loop reaches its last targets one control tick after its closing
        ends. Then it keeps them, whatever it would observe.
        """
        ticks = self.robot.ticks(seconds)
        rests = not self.controller.closing.feels and self.controller.closed
        for _ in range(1 if rests else ticks):
            self.step()
        if rests:
            self.robot.rest(ticks - 1)

    @property
    def felt(self) -> tuple[float, float]:
        """The controller's estimates (friction coefficient, load [N]).

        The load is that of the object on the fingertips. Both are NaN unless the controller holds
        in the mode "grip".
        """
        hold = self.controller.hold
        if isinstance(hold, GripHold):
            return hold.friction.mean, hold.weight
        return math.nan, math.nan

    def strained(self) -> bool:
        """Return whether a joint's drive is at its limit: it needs its greatest torque, or more, to
        reach its target.

        In the holding mode "grip" the torque that the drive needs for the gripping force counts.
        """
        reference = self.robot.reference
        hold = self.controller.hold
        if isinstance(hold, GripHold):
            return hold.strained
        off = (self.controller.targets.joints - self.observation.joints).abs()
        return bool((reference.kp * off >= drive_efforts(reference.hand)).any())
