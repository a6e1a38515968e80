"""Simulated drags: a hand drags the true object to the edge of its table, then lifts it there."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import AGREEMENT, check_contacts, check_stand
from torchgrasp.control.drag import DRAGGING, DragController
from torchgrasp.control.reference import ClosingReference
from torchgrasp.data.shipped import GraspObject, solid_of
from torchgrasp.evaluation.frame import rounded, rounded_table, world_frame
from torchgrasp.evaluation.protocols import draw_trial
from torchgrasp.evaluation.several_tries import LiftTry, lift_grasps
from torchgrasp.evaluation.trial import TRIALS, GraspTrial, Truth
from torchgrasp.evaluation.true_scene import edge_in_world, true_body, true_scene
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import ANY, Count, Measured, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.drives import drive_stiffness
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.drag_plan import DragPlan
from torchgrasp.planner.edge import EdgePlan
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import read_solid
from torchgrasp.sim.simulated_hand import SimulatedHand, open_scene
from torchgrasp.values.closing import ClosingGains, SensorModel
from torchgrasp.values.specs import TrialSpec


@dataclasses.dataclass(frozen=True)
class DragTrialNumbers:
    """Parameters of a simulated drag and of its verdict."""

    rest: float = 0.5
    """Time [s] after the drag in which the object comes to rest."""
    below: float = 0.005
    """Depth [m] below the table of the object's lowest point, beyond which the object hangs or
    falls over the edge.
    """
    tipped: float = math.radians(10)
    """Tilt [rad] of the object against the vertical beyond which it has toppled."""
    slipped: float = 0.02
    """Distance [m] of the object from its planned position, beyond which the fingertips slid over
    it.
    """
    table_friction: float = 0.3
    """Coefficient of friction between object and table by default, the same as in
    `plan_edge_grasps`.
    """


DRAGS = DragTrialNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class DragResult(Value):
    """The record of a simulated drag.

    Attributes:
        status: `OK`, or the reason of a failure.
            `NO_CONTACT`: the hand could not press, or lost the object on the way.
            `DROPPED`: the object toppled, or hangs or fell over the edge.
            `SLIPPED`: the object is more than 20 mm (`DRAGS.slipped`) from its planned position.
            `START_OVERLAP`: the hand overlapped the object or the table at the start.
            `UNSTABLE`: the simulation diverged.
        motion: motion (4, 4) [m] of the object from the start of the trial to its end. It is a
            rigid transform in the frame of the planned cloud. NaN if the status is `UNSTABLE`.
        missed: distance [m] of the object's centre of mass from its planned position. NaN if the
            status is `UNSTABLE`.
        forces: sum (t,) [N] of the true normal forces of the fingertips at each control tick.
    """

    status: Status
    motion: Annotated[Float[Tensor, "4 4"], ANY]
    missed: Measured
    forces: Annotated[Float[Tensor, "t"], ANY]


@checked
@single_threaded
def drag_object(
    plan: DragPlan,
    hand: Hand,
    mesh: "trimesh.Trimesh | Path | str | GraspObject",
    spec: TrialSpec | None = None,
    seed: Seed = 0,
    *,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
    table: Plane | None = None,
) -> DragResult:
    """Drag the true object as planned, in simulation; return where it came to rest, and whether
    this is its planned position.

    Args:
        plan: the drag, from `plan_edge_grasps`.
        hand: the hand of the plan.
        mesh: the true object [m], closed, in the frame of the plan: a trimesh, a file, or a
            `GraspObject`.
        spec: parameters of the trial. None means a table with a friction of 0.3, as planned by
            default: `TrialSpec(table_friction=0.3)`. Its closing mode has no effect on a drag.
        seed: seed of the sensors' noise, and of friction and mass if the `spec` has distributions
            of them.
        parts: convex parts [m] of the mesh. None means those of a `GraspObject`, or those that
            `convex_parts` computes.
        table: the true table, with its edge. None means that of the plan.

    Raises:
        BadArgument: a plan of another hand, without a pressing finger or without a displacement.
        BadArgument: a mesh that does not stand on the table.
        BadArgument: a sensor that measures no force, at all or at a finger that presses.
        MeshError: the mesh is missing, open or without volume.
        MissingExtra: the simulator is not installed.

    >>> import torch
    >>> from torchgrasp import ContactSpec, Plane, load_hand, plan_edge_grasps
    >>> from torchgrasp.cloud import look_at, partial_view
    >>> box = trimesh.creation.box([0.12, 0.06, 0.01]).apply_translation([0.0, 0.0, 0.005])
    >>> view, hand = partial_view(box, look_at(-135.0, 40.0, target=box)), load_hand("barrett")
    >>> x = torch.tensor([1.0, 0, 0])
    >>> spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.15 * x, x))
    >>> plan = plan_edge_grasps(view, hand, spec, starts=2)
    >>> drag_object(plan.drag, hand, box, TrialSpec(table_friction=0.3), parts=[box]).status
    <Status.OK: 0>
    """
    solid, parts = solid_of(mesh, parts)
    table = plan.table if table is None else table
    check_stand(solid, table)
    spec = draw_trial(_spec_of(spec), seed)
    _check_sensor(spec.sensor, plan, hand)
    return _Drag(plan, hand.to("cpu", torch.float64), solid, parts, table, spec, seed).complete()


def _check_sensor(sensor: SensorModel, plan: DragPlan, hand: Hand) -> None:
    """Raise `BadArgument` if a pressing finger has no sensor of forces."""
    if sensor.kind == "binary":
        raise BadArgument("spec.sensor", "'binary' sensors", "sensors that measure forces")
    names = [name for name, on in zip(hand.finger_names, plan.presses.tolist(), strict=False) if on]
    dead = [name for name in names if name in sensor.dead]
    if dead:
        raise BadArgument("spec.sensor", f"dead fingers {dead}", "forces of the fingers that press")


class EdgeLift(NamedTuple):
    """The record of a drag and of the lift after it; `lift_from_edge` returns it.

    Attributes:
        drag: record of the drag; None if the plan has none.
        tries: the tries of the lift (`lift_grasps`). Empty if the drag failed, or if most contacts
            of the grasps are off the object after the drag.
    """

    drag: DragResult | None
    tries: tuple[LiftTry, ...]

    @property
    def held(self) -> bool:
        """Whether the last try held the object; False without a try.

        The object is held if three conditions are met. Its centre rose by at least half of the
        lift. At least two fingers touch it at the end. It slipped by less than 20 mm and 30 degrees
        in the closed hand.
        """
        return bool(self.tries) and self.tries[-1].result.held


@checked
@single_threaded
def lift_from_edge(
    plan: EdgePlan,
    hand: Hand,
    mesh: "trimesh.Trimesh | Path | str | GraspObject",
    spec: TrialSpec | None = None,
    seed: Seed = 0,
    *,
    tries: Count = 1,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
    table: Plane | None = None,
) -> EdgeLift:
    """Drag the true object to the table's edge, then lift it with the plan's grasps, the first one
    first.

    The grasps are where the plan expects the object, and the object is where the drag left it.

    Args:
        plan: drag and grasps, from `plan_edge_grasps`. At least one grasp must be executable: it
            passed all checks.
        hand: the hand of the plan.
        mesh: the true object [m], closed, in the frame of the plan: a trimesh, a file, or a
            `GraspObject`.
        spec: parameters of both trials. None means a table with a friction of 0.3, as planned by
            default: `TrialSpec(table_friction=0.3)`.
        seed: seed of both trials.
        tries: largest number of grasps that are tried (`lift_grasps`).
        parts: convex parts [m] of the mesh. None means those of a `GraspObject`, or those that
            `convex_parts` computes.
        table: the true table, with its edge. None means that of the plan.

    Raises `BadArgument` for a plan of another hand or without an executable grasp. It is also
    raised for a mesh off the table, and for sensors that do not measure the pressing forces. Raises
    `MeshError` for a mesh that is missing, open or without volume, and `MissingExtra` without the
    simulator.

    >>> import torch
    >>> from torchgrasp import ContactSpec, Plane, load_hand, plan_edge_grasps
    >>> from torchgrasp.cloud import look_at, partial_view
    >>> box = trimesh.creation.box([0.12, 0.06, 0.01]).apply_translation([0.0, 0.0, 0.005])
    >>> view, hand = partial_view(box, look_at(-135.0, 40.0, target=box)), load_hand("barrett")
    >>> x = torch.tensor([1.0, 0, 0])
    >>> spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.15 * x, x))
    >>> plan = plan_edge_grasps(view, hand, spec, starts=8)
    >>> trial = TrialSpec(table_friction=0.3, hold_time=0.2)
    >>> lift_from_edge(plan, hand, box, trial, parts=[box]).held
    True
    """
    good = plan.grasps.executable
    if not len(good):
        raise BadArgument("plan", "no executable grasp", "at least one")
    solid, pieces = read_solid(*solid_of(mesh, parts))
    table = good.table if table is None else table
    drag = None
    if plan.drag is not None:
        drag = drag_object(plan.drag, hand, solid, spec, seed, parts=pieces, table=table)
        if drag.status is not Status.OK:
            return EdgeLift(drag, ())
        motion = drag.motion.numpy()
        solid, *pieces = (x.copy().apply_transform(motion) for x in (solid, *pieces))
        try:
            check_contacts(good, solid, TRIALS.slack, AGREEMENT.astray)
        except BadArgument:  # the drag is to blame, not the caller
            return EdgeLift(drag, ())
    truth = Truth(solid, pieces, table=table)
    trial = GraspTrial(hand, good, truth, seed, surface=surface_field(plan.shape))
    return EdgeLift(drag, lift_grasps(trial, _spec_of(spec), tries))


def _spec_of(spec: TrialSpec | None) -> TrialSpec:
    """Return the parameters of a trial; by default the table has the friction that plans expect."""
    return TrialSpec(table_friction=DRAGS.table_friction) if spec is None else spec


class _Drag:
    """One simulated drag."""

    def __init__(
        self,
        plan: DragPlan,
        hand: Hand,
        mesh: "trimesh.Trimesh",
        parts: "Sequence[trimesh.Trimesh] | None",
        table: Plane,
        spec: TrialSpec,
        seed: int,
    ) -> None:
        self.obj_from_world = world_frame(table, plan.obj_from_hand.to("cpu", torch.float64))
        plan = _in_world(plan, inverse(self.obj_from_world))
        self.plan = plan
        self.spec = spec
        body = true_body(spec, mesh, parts, obj_from_world=self.obj_from_world)
        self.controller = DragController(plan, hand)
        start = plan.obj_from_hand[:3, :3] @ self.controller.targets.palm
        farthest = float(norm(plan.displacement)) + float(norm(start))
        scene_spec = true_scene(
            spec,
            hand,
            plan.obj_from_hand,
            plan.joints,
            body,
            height=0.0,
            edge=edge_in_world(table, self.obj_from_world),
            yields=farthest + DRAGGING.lag + DRAGGING.deepest,
            start=tuple(start.tolist()),
        )
        self.vertices = np.asarray(body.mesh.vertices)
        self.scene = open_scene(scene_spec, spec.simulator)
        generator = torch.Generator().manual_seed(seed) if spec.noise else None
        self.robot = SimulatedHand(
            self.scene, _reference(hand, plan, spec), spec.control_rate, generator
        )
        self.overlap = self.scene.penetration()

    def complete(self) -> DragResult:
        """Run the drag; return its record."""
        forces = list[float]()
        start = self.scene.object_pose()
        if self.overlap > self.spec.overlap:
            return self._result(Status.START_OVERLAP, start, forces)
        observation = self.robot.tick(self.controller.targets)
        while self.controller.phase != "done":  # the controller ends every phase
            targets = self.controller.step(observation, self.robot.period)
            observation = self.robot.tick(targets)
            forces.append(float(self.robot.force.sum()))
        self.robot.rest(self.robot.ticks(DRAGS.rest))
        return self._result(self.controller.status, start, forces)

    def _result(self, status: Status, start: np.ndarray, forces: list[float]) -> DragResult:
        """Return the record of a drag; its status tells whether the object fell."""
        pose = self.scene.object_pose()
        moved = torch.from_numpy(pose @ np.linalg.inv(start))
        centre = torch.from_numpy(self.scene.centre)
        before = apply(torch.from_numpy(start), centre[None])[0]
        after = apply(torch.from_numpy(pose), centre[None])[0]
        wanted = self.plan.displacement
        if not torch.isfinite(moved).all():
            status = Status.UNSTABLE
        else:
            vertices = moved[2, :3].numpy() @ self.vertices.T + float(moved[2, 3])
            if vertices.min() < -DRAGS.below or moved[2, 2] < math.cos(DRAGS.tipped):
                status = Status.DROPPED
        missed = float(norm(after - before - wanted))
        if status is Status.OK and missed > DRAGS.slipped:
            status = Status.SLIPPED
        motion = self.obj_from_world @ moved @ inverse(self.obj_from_world)
        return DragResult(
            status,
            motion,
            missed,
            torch.tensor(forces, dtype=torch.float64),
        )


def _in_world(plan: DragPlan, world_from_obj: Float[Tensor, "4 4"]) -> DragPlan:
    """Return a drag in the simulator's frame, in float64 on the CPU.

    Its numbers are rounded, so that the frame of the plan does not change the trial.
    """
    plan = plan.to("cpu", torch.float64)
    turn = world_from_obj[:3, :3]
    return dataclasses.replace(
        plan,
        obj_from_hand=rounded(world_from_obj @ plan.obj_from_hand),
        feet=rounded(apply(world_from_obj, plan.feet)),
        displacement=rounded(turn @ plan.displacement),
        table=rounded_table(plan.table.moved(world_from_obj)),
    )


def _reference(hand: Hand, plan: DragPlan, spec: TrialSpec) -> ClosingReference:
    """Return what the fingertips' sensors need to know: the fingers touch from above."""
    f = len(hand.tips)
    joints = plan.joints
    normals = (plan.table.normal @ plan.obj_from_hand[:3, :3]).expand(f, 3)
    still = torch.zeros(f, 3, dtype=torch.float64)
    gains = ClosingGains(still, torch.zeros(f, 3, 3, dtype=torch.float64), still, still, still)
    return ClosingReference(
        hand,
        drive_stiffness(hand, spec.kp),
        obj_from_hand=plan.obj_from_hand,
        pregrasp=joints,
        joints=joints,
        squeeze=joints,
        normals=normals.clone(),
        gains=gains,
        sensor=spec.sensor,
    )
