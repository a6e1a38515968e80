"""The one driver of trials: a fresh scene, the approach, the closing and the pressing."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.controller import GraspController, check_modes
from torchgrasp.control.reference import ClosingReference
from torchgrasp.errors import BadArgument
from torchgrasp.evaluation.protocols import apply_error
from torchgrasp.hand.hand import Hand
from torchgrasp.mesh import read_mesh
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.sim.convex_parts import check_parts, convex_parts
from torchgrasp.sim.hand import SimulatedHand
from torchgrasp.sim.open import open_scene
from torchgrasp.sim.scene import SceneSpec
from torchgrasp.specs import TrialSpec
from torchgrasp.values import Grasps

if TYPE_CHECKING:
    import trimesh

APPROACH_SPEED = 0.2
"""Mean speed of the hand on its way to the pre-grasp [m/s]: slow enough to push a light object without a blow."""


@dataclasses.dataclass(frozen=True)
class GraspTrial:
    """A grasp and the true object, as in `close_hand`."""

    hand: Hand
    grasp: Grasps
    mesh: "trimesh.Trimesh | Path | str"
    seed: int = 0
    error: Float[Tensor, "4 4"] | None = None
    belief: ShapeGP | None = None
    parts: "Sequence[trimesh.Trimesh] | None" = None


class TrialDriver:
    """A trial that was checked once, for any number of runs.

    The hand follows `reference`; None: that of the trial's hand and grasp.

    Raises:
        BadArgument, MeshError: as in `close_hand`.
    """

    def __init__(self, trial: GraspTrial, spec: TrialSpec, reference: ClosingReference | None = None) -> None:
        check_modes(spec.closing, spec.holding, trial.belief)
        self.trial, self.spec = trial, spec
        hand, grasp = trial.hand.to("cpu", torch.float64), trial.grasp.to("cpu", torch.float64)
        self.reference = reference or ClosingReference.from_grasp(hand, grasp, spec.force, spec.kp)
        hand.check_joints(grasp.pregrasp)
        if spec.approach and not abs(float(torch.linalg.vector_norm(grasp.approach)) - 1) < 1e-4:
            raise BadArgument("grasp", f"an approach along {grasp.approach[0].tolist()}", "a unit vector")
        mesh, drives = read_mesh(trial.mesh), hand.actuators
        if spec.kp is not None:
            drives = {name: drive._replace(kp=spec.kp) for name, drive in drives.items()}
        true_pose = apply_error(grasp.obj_from_hand[0], trial.error)
        approach = true_pose[:3, :3] @ grasp.obj_from_hand[0, :3, :3].T @ grasp.approach[0] * spec.approach
        self.scene_spec = SceneSpec(
            urdf_path=hand.urdf_path,
            world_from_hand=true_pose.numpy(),
            joints=_by_name(hand, grasp.pregrasp[0]),
            drives=drives,
            tip_links=tuple(hand.tips.links),
            mesh=mesh,
            parts=convex_parts(mesh) if trial.parts is None else check_parts(trial.parts),
            mass=spec.mass if spec.density is None else spec.density * float(mesh.volume),
            friction=spec.friction,
            gravity=spec.gravity,
            timestep=spec.timestep,
            travel=spec.lift_height,
            approach=tuple(approach.tolist()),
            table=spec.table,
            patch=spec.patch,
        )

    def open(self) -> "TrialRun":
        """Return a run in a fresh scene; raises `MissingExtra` without the simulator."""
        return TrialRun(self)

    def grasp_overlap(self) -> float:
        """Return the overlap [m] of hand and object at the grasp."""
        joints = _by_name(self.reference.hand, self.reference.joints)
        scene_spec = dataclasses.replace(self.scene_spec, joints=joints, approach=(0.0, 0.0, 0.0), table=False)
        return open_scene(scene_spec, self.spec.simulator).penetration()


class TrialRun:
    """One run of a trial in a fresh scene; its phases yield after every control tick."""

    def __init__(self, driver: TrialDriver) -> None:
        spec, trial = driver.spec, driver.trial
        self.spec, self.mass = spec, driver.scene_spec.mass
        self.scene = open_scene(driver.scene_spec, spec.simulator)
        generator = torch.Generator().manual_seed(trial.seed) if spec.noise else None
        self.robot = SimulatedHand(self.scene, driver.reference, spec.control_rate, generator)
        self.controller = GraspController(self.robot.reference, spec.closing, spec.holding, trial.belief)
        self.overlap = self.scene.penetration()

    @property
    def starts(self) -> bool:
        """Whether no more overlaps than the trial allows."""
        return self.overlap <= self.spec.overlap

    def approach(self) -> Iterator[None]:
        """Bring the opened hand straight to its pre-grasp."""
        length = self.spec.approach
        ticks = self.robot.ticks(length / APPROACH_SPEED) if length else 0
        for k in range(ticks):
            share, rate = smooth_step((k + 1) / ticks)
            self.scene.approach(length * (1 - share), length * rate / (ticks * self.robot.period))
            self.robot.tick(self.controller.targets)
            yield

    def close(self) -> Iterator[None]:
        """Close the fingers and press, until the hand counts as closed."""
        self.observation = self.robot.tick(self.controller.targets)
        yield
        while not self.controller.closed:
            self.step()
            yield

    def step(self) -> None:
        """Let the controller act for one control tick."""
        self.observation = self.robot.tick(self.controller.step(self.observation, self.robot.period))

    def strained(self) -> bool:
        """Return whether some drive is at its largest torque."""
        reference = self.robot.reference
        effort = torch.tensor([reference.hand.actuators[name].effort for name in reference.hand.tree.joint_names])
        return bool((reference.kp * (self.controller.targets - self.observation.joints).abs() >= effort).any())


def smooth_step(time: float) -> tuple[float, float]:
    """Return place and speed of a motion from rest at 0 to rest at 1.

    >>> smooth_step(0.5)
    (0.5, 1.5)
    """
    return time * time * (3 - 2 * time), 6 * time * (1 - time)


def _by_name(hand: Hand, joints: Float[Tensor, " h"]) -> dict[str, float]:
    """Return every joint of the URDF [rad] by name."""
    return {name: float(q) for name, q in hand.expand(joints).items()}
