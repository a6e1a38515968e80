"""Lifts in MuJoCo by a hand that an arm carries.

The arm's joints have position drives with the gains and efforts of MuJoCo Menagerie's model of the
UR5e. Its base stands on the table. What the mount of a hand without an arm would do, the arm's
joints do by inverse kinematics.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from torchgrasp import TrialSpec
from torchgrasp.arm import Arm
from torchgrasp.arm.reach import solve_tips
from torchgrasp.evaluation.lift import run_lift
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver
from torchgrasp.hand.hand import Actuator
from torchgrasp.sim.mujoco_scene import (
    MujocoScene,
    format_numbers,
    nest_links,
    render_mjcf,
    scene_mjcf,
)
from torchgrasp.sim.scene_spec import SceneSpec
from torchgrasp.values.closing import ClosureResult

TRIAL = TrialSpec(
    mass=0.249,
    table_friction=0.2,
    lift_height=0.1,
    approach=0.1,
    hold_time=0.3,
    control_rate=50.0,
    simulator="mujoco",
)
"""A lift as of protocol "table-lift", by as much as the planner checks the way of the arm; it is
held for a shorter time.
"""
DRIVES = {150.0: (2000.0, 400.0), 28.0: (500.0, 100.0)}
"""Stiffness [N m/rad] and damping [N m s/rad] of the UR5e's joints by their effort [N m], of MuJoCo
Menagerie.
"""
ROTOR = 0.1
"""Inertia [kg m2] of the rotors at the joints, of the same."""


class ArmScene(MujocoScene):
    """A scene in which an arm carries the hand; `posture` (n, 1) [rad] is that of the grasp."""

    def __init__(self, spec: SceneSpec, arm: Arm, posture: torch.Tensor) -> None:
        self.arm = arm
        self.posture = posture
        self.mount = {slide.name: (np.array(slide.axis), slide.start, 0.0) for slide in spec.slides}
        self.aimed = False
        super().__init__(spec)

    def _write(self, spec: SceneSpec) -> str:
        """Return the model of the scene with the hand on the arm instead of its mount."""
        root = ET.fromstring(scene_mjcf(spec))
        world = root.find("worldbody")
        actuator = root.find("actuator")
        assert world is not None and actuator is not None
        bodies = {body.get("name"): body for body in root.iter("body")}
        world.remove(bodies[spec.slides[0].name])
        for servo in [servo for servo in actuator if servo.get("name") in self.mount]:
            actuator.remove(servo)
        joints = {
            j.name: Actuator(j.effort, j.velocity, *DRIVES[j.effort]) for j in self.arm.urdf.movable
        }
        parts = {
            "nested": nest_links(self.arm.urdf),
            "pose": self.arm.obj_from_base.numpy(),
            "order": [*joints],
        }
        model = ET.fromstring(render_mjcf("robot.xml", name="arm", **parts, drives=joints))
        base = model.find("worldbody/body")
        servos = model.find("actuator")
        assert base is not None and servos is not None
        for joint in base.iter("joint"):
            joint.set("armature", str(ROTOR))
        world.append(base)
        actuator.extend(servos)
        hand = bodies[spec.urdf.root]
        place = self.arm.tip_from_hand.numpy()
        hand.attrib |= {
            "pos": format_numbers(place[:3, 3]),
            "xyaxes": format_numbers(place[:3, :2].T.ravel()),
        }
        next(
            body for body in base.iter("body") if body.get("name") == self.arm.urdf.links[-1].name
        ).append(hand)
        return ET.tostring(root, encoding="unicode")

    def _begin(self) -> None:
        """Set the hand's joints, and the arm's to the start of the approach, with their targets."""
        model = self.model
        data = self.data
        data.qpos[self._positions] = [self.spec.joints[name] for name in self.joint_names]
        self.drive(data.qpos[self._positions])
        self.servos = [model.actuator(name).id for name in self.arm.joint_names]
        self.gains = np.array(
            [model.actuator_biasprm[k, 2] / model.actuator_biasprm[k, 1] for k in self.servos]
        )
        start = {name: at for name, (_, at, _) in self.mount.items()}
        for share in np.linspace(0, 1, 9):  # along the approach, as the arm came
            for name, at in start.items():
                self._move_mount(name, share * at, 0.0)
            self._aim()
        data.qpos[[model.joint(name).qposadr[0] for name in self.arm.joint_names]] = self.posture[
            :, 0
        ]
        self._mujoco.mj_step1(model, data)

    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of what would be a joint of the mount."""
        self.mount[joint] = (self.mount[joint][0], target, speed)
        self.aimed = False

    def _aim(self) -> None:
        """Set the targets of the arm's joints, which lead by what their damping takes at the target
        speed.
        """
        if self.aimed:
            return
        pose = torch.from_numpy(self.spec.world_from_hand.copy())[None]
        pose[0, :3, 3] += torch.from_numpy(sum(axis * at for axis, at, _ in self.mount.values()))
        velocity = 1e3 * sum(axis * speed for axis, _, speed in self.mount.values())
        self.posture, _ = solve_tips(self.arm, self.posture, self.arm.tip_poses(pose))
        motion = self.arm.tip_motion(self.posture)[1][..., 0].numpy()
        turned = self.arm.obj_from_base[:3, :3].numpy().T @ velocity
        rates = np.linalg.lstsq(motion, np.concatenate([turned, np.zeros(3)]), rcond=None)[0]
        self.data.ctrl[self.servos] = self.posture[:, 0].numpy() + self.gains * rates
        self.aimed = True

    def _advance(self) -> Iterator[Any]:
        """Advance by one timestep, as `MujocoScene`."""
        self._aim()
        return super()._advance()

    def skip(self, steps: int) -> None:
        """Advance by a number of timesteps."""
        self._aim()
        super().skip(steps)


class ArmDriver(TrialDriver):
    """A trial in which an arm carries the hand."""

    def __init__(self, trial: GraspTrial, spec: TrialSpec, arm: Arm) -> None:
        super().__init__(trial, spec)
        self.arm = arm

    def _open_scene(self, spec: SceneSpec) -> ArmScene:
        """Return a fresh scene with the arm in the posture of the grasp."""
        assert self.trial.grasp.arm is not None
        return ArmScene(spec, self.arm, self.trial.grasp.arm.T.contiguous())


def lift_with_arm(trial: GraspTrial, arm: Arm, spec: TrialSpec = TRIAL) -> ClosureResult:
    """Close the hand on the true object and lift it with the arm."""
    return run_lift(ArmDriver(trial, spec, arm))
