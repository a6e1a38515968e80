"""One simulated trial: the opened hand comes to the true object, closes under the law, lifts it and holds it."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.controller import GraspController, check_modes
from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.errors import BadArgument, Status
from torchgrasp.frames import apply, inverse, rotation_angle
from torchgrasp.hand.hand import Hand
from torchgrasp.mesh import read_mesh
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.sim.convex_parts import check_parts, convex_parts
from torchgrasp.sim.hand import SimulatedHand
from torchgrasp.sim.open import open_scene
from torchgrasp.sim.scene import SceneSpec
from torchgrasp.specs import TrialSpec
from torchgrasp.values import ClosureResult, Grasps

if TYPE_CHECKING:
    import trimesh

START_TOLERANCE = 1e-3
"""Overlap [m] of the hand with object or table up to which a trial starts: convex parts bulge a little."""

APPROACH_SPEED = 0.2
"""Of the hand on its way to the pre-grasp [m/s], on average."""

LIFT_TIME = 1.0
"""Time [s] in which the hand rises, by a smooth step."""

SHAKE_RATE = 5.0
"""Of the shaking [Hz]: 3 mm are then 3 m/s^2."""

JUDGED_TIME = 0.2
"""Time [s] at the end of the hold in which at least two fingers must touch, most of the time."""

PUSHED = 0.05
"""Motion [m] of the object's centre while the hand closes from which on it counts as pushed out."""

LOST = 0.5
"""Distance [m] from its start at which the object is gone and the trial over."""


def close_hand(
    grasp: Grasps,
    hand: Hand,
    mesh: "trimesh.Trimesh | Path | str",
    spec: TrialSpec | None = None,
    seed: int = 0,
    *,
    error: Float[Tensor, "4 4"] | None = None,
    belief: ShapeGP | None = None,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
) -> ClosureResult:
    """Close a hand on the true object, lift it and hold it, in a fresh simulation.

    The object stands on a table where its mesh is lowest, in the frame of the grasp. The opened hand comes the last
    `spec.approach` of its way straight to its pre-grasp, pushing aside what it meets, closes and presses
    (`GraspController`), rises by `spec.lift_height` and holds, shaken if `spec.shake` says so. The object is **held**
    when at the end its centre has risen by at least half the lift and in most of the last `JUDGED_TIME` at least two
    fingers touch it. `object_motion` is against the hand, so that stricter rules can be counted from it. The same
    arguments give the same result to the last bit.

    Args:
        grasp: one row.
        hand: the hand that the grasp was planned for.
        mesh: the true object [m], closed: a trimesh or a file.
        spec: of the trial; None: `TrialSpec()`.
        seed: of the tactile sensor's noise.
        error: where the hand really stands in its planned frame, of which it knows nothing; None: where it was planned.
        belief: the shape that the grasp was planned on: touches that surprise revise it while the hand closes, and the
            contacts of the fingers still in the air; None: they do not.
        parts: convex bodies to use for the mesh instead of its own decomposition (`convex_parts`).

    Raises:
        BadArgument: not exactly one row, a grasp of another hand or with numbers that are not finite, a pre-grasp
            outside the joint limits, an approach that is no unit vector, a controller faster than the simulator, or a
            belief for a closing that does not follow the law (Eq. 25).
        MeshError: the mesh is missing, open or without volume.
        MissingExtra: the simulator is not installed.
    """
    started = time.perf_counter()
    spec = TrialSpec() if spec is None else spec
    check_modes(spec.closing, spec.holding, belief)
    if not spec.control_rate * spec.timestep < 1 + 1e-9:
        found = f"{spec.control_rate:g} Hz with a timestep of {spec.timestep:g} s"
        raise BadArgument("control_rate", found, "a period of at least one timestep")
    grasp, hand = grasp.to("cpu", torch.float64), hand.to("cpu", torch.float64)
    reference = ClosingReference.from_grasp(hand, grasp, spec.force)
    hand.check_joints(grasp.pregrasp)
    if spec.approach and not abs(float(torch.linalg.vector_norm(grasp.approach)) - 1) < 1e-4:
        raise BadArgument("grasp", f"an approach along {grasp.approach[0].tolist()}", "a unit vector")
    mesh = read_mesh(mesh)
    bodies = convex_parts(mesh) if parts is None else check_parts(parts)
    stands = grasp.obj_from_hand[0] if error is None else grasp.obj_from_hand[0] @ error.double().cpu()
    trial = _Trial(grasp, reference, mesh, bodies, spec, stands, seed)
    status = trial.run(belief)
    return trial.result(status, time.perf_counter() - started)


def smooth_step(time: float) -> tuple[float, float]:
    """Return how far a motion from 0 to 1 that starts and ends at rest has come by a time in [0, 1], and its speed.

    >>> smooth_step(0.5)
    (0.5, 1.5)
    """
    return time * time * (3 - 2 * time), 6 * time * (1 - time)


class _Lost(Exception):
    """The object is gone, or the numbers are: the trial is over before its time."""


class _Trial:
    """The state of one trial: the scene, the sensor, and the record of every tick."""

    def __init__(
        self,
        grasp: Grasps,
        reference: ClosingReference,
        mesh: "trimesh.Trimesh",
        parts: "list[trimesh.Trimesh]",
        spec: TrialSpec,
        stands: Float[Tensor, "4 4"],
        seed: int,
    ) -> None:
        self.spec, hand = spec, reference.hand
        start = {name: float(q) for name, q in hand.expand(grasp.pregrasp[0]).items()}
        way = stands[:3, :3] @ grasp.obj_from_hand[0, :3, :3].T @ grasp.approach[0] * spec.approach
        setup = SceneSpec(
            hand.urdf_path,
            stands.numpy(),
            start,
            hand.actuators,
            tuple(hand.tip_links),
            mesh,
            parts,
            spec.mass,
            spec.friction,
            spec.gravity,
            spec.timestep,
            spec.lift_height,
            tuple(way.tolist()),
        )
        self.scene = open_scene(setup, spec.simulator)
        generator = torch.Generator().manual_seed(seed) if spec.noise else None
        self.robot = SimulatedHand(self.scene, reference, spec.control_rate, generator)
        self.time: list[float] = []
        self.forces: list[np.ndarray] = []
        self.touching: list[int] = []
        self.object_pose: list[np.ndarray] = []
        self.hand_pose: list[np.ndarray] = []
        self.joints: list[np.ndarray] = []
        self.overlap, self.pushed, self.strained, self.arrived = 0.0, 0.0, False, 0
        self.effort = torch.tensor([hand.actuators[name].effort for name in self.scene.joint_names])

    # ------------------------------------------------------------------------------------------------- the phases

    def run(self, belief: ShapeGP | None) -> Status:
        """Approach, close, press, lift and hold; return what became of it."""
        self.overlap = self.scene.penetration()
        self._record(np.zeros(3))
        if not self.overlap <= START_TOLERANCE:
            return Status.START_OVERLAP
        controller = GraspController(self.robot.reference, self.spec.closing, self.spec.holding, belief)
        period = self.robot.period
        try:
            arriving = self.robot.ticks(self.spec.approach / APPROACH_SPEED) if self.spec.approach else 0
            for k in range(arriving):
                share, rate = smooth_step((k + 1) / arriving)
                self.scene.approach(self.spec.approach * (1 - share), self.spec.approach * rate / (arriving * period))
                self._tick(controller.targets)
            self.arrived = len(self.time) - 1
            observation = self._tick(controller.targets)
            while not controller.closed:
                observation = self._tick(controller.step(observation, period))
            self.pushed = float(np.linalg.norm(self._centre(-1) - self._centre(0)))
            kp = self.robot.reference.model.kp
            self.strained = bool((kp * (controller.targets - observation.joints).abs() >= self.effort).any())
            rising = self.robot.ticks(LIFT_TIME)
            for k in range(rising + self.robot.ticks(self.spec.hold_time)):
                self.scene.lift(*self._height((k + 1) * period, rising * period))
                observation = self._tick(controller.step(observation, period))
        except _Lost as lost:
            if lost.args:
                return Status.UNSTABLE
        return self._verdict()

    def _height(self, time: float, rising: float) -> tuple[float, float]:
        """Return how high [m] the hand is to be some time [s] after it began to rise, and how fast [m/s]."""
        share, rate = smooth_step(min(time / rising, 1.0))
        height = self.spec.lift_height * share
        if time < rising or self.spec.shake == 0.0:
            return height, self.spec.lift_height * rate / rising
        turning = 2 * math.pi * SHAKE_RATE
        phase = turning * (time - rising)
        return height + self.spec.shake * math.sin(phase), self.spec.shake * turning * math.cos(phase)

    def _tick(self, targets: Float[Tensor, " j"]) -> Observation:
        """Drive the joints for one control period, record it, and return what the robot then knows."""
        observation = self.robot.tick(targets)
        self._record(self.robot.force)
        moved = float(np.linalg.norm(self._centre(-1) - self._centre(0)))
        if not np.isfinite(self.joints[-1]).all() or not np.isfinite(moved):
            raise _Lost(Status.UNSTABLE)
        if moved > LOST + self.spec.lift_height:
            self.pushed = self.pushed or moved
            raise _Lost
        return observation

    # ------------------------------------------------------------------------------------------------ the record

    def _record(self, force: np.ndarray) -> None:
        """Append one tick."""
        self.time.append(self.robot.steps * self.spec.timestep)
        self.forces.append(force)
        self.touching.append(int(self.robot.finger.sum()))
        self.object_pose.append(self.scene.object_pose())
        self.hand_pose.append(self.scene.hand_pose())
        self.joints.append(self.scene.joints())

    def _centre(self, tick: int) -> np.ndarray:
        """Return the object's mass centre [m] in the world at a tick."""
        pose = self.object_pose[tick]
        return pose[:3, :3] @ self.scene.centre + pose[:3, 3]

    def _verdict(self) -> Status:
        """Return the status of a finished trial: held, or the earliest thing that went wrong."""
        rise = np.array([self._centre(k)[2] - self._centre(0)[2] for k in range(len(self.time))])
        half = 0.5 * self.spec.lift_height
        gripped = np.array(self.touching[-self.robot.ticks(JUDGED_TIME) :]) >= 2
        if rise[-1] >= half and gripped.mean() > 0.5:
            return Status.OK
        if not np.isfinite(self.robot.first_touch).all():
            return Status.NO_CONTACT
        if self.pushed > PUSHED:
            return Status.EJECTED
        if self.strained:
            return Status.TOO_WEAK
        return Status.DROPPED if rise.max() >= half else Status.NOT_LIFTED

    def result(self, status: Status, seconds: float) -> ClosureResult:
        """Return the record as a value."""
        object_pose, hand_pose = (
            torch.from_numpy(np.stack(self.object_pose)),
            torch.from_numpy(np.stack(self.hand_pose)),
        )
        hand_from_object = inverse(hand_pose) @ object_pose
        centre = torch.from_numpy(self.scene.centre)[None]
        ends = apply(hand_from_object[[self.arrived, -1]], centre.expand(2, 1, 3))[:, 0]
        turned = hand_from_object[self.arrived, :3, :3].T @ hand_from_object[-1, :3, :3]
        touched = [i for i in range(3) if np.isfinite(self.robot.first_touch[i])]
        return ClosureResult(
            held=status is Status.OK,
            status=status,
            time=torch.tensor(self.time, dtype=torch.float64),
            forces=torch.from_numpy(np.stack(self.forces)),
            object_pose=object_pose,
            hand_pose=hand_pose,
            joints=torch.from_numpy(np.stack(self.joints)),
            joint_names=self.scene.joint_names,
            contact_order=tuple(sorted(touched, key=lambda i: self.robot.first_touch[i])),
            object_motion=(float(torch.linalg.vector_norm(ends[1] - ends[0])), float(rotation_angle(turned))),
            start_overlap=self.overlap,
            seconds=seconds,
        )
