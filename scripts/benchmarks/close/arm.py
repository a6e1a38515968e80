"""Lifts by an Allegro hand on a UR5e, beside lifts by the same hand without an arm; what the arm
adds to planning.

The arm's joints have position drives with the gains and efforts of MuJoCo Menagerie's model of the
UR5e. Its base stands on the table. What the mount of a hand without an arm would do, the arm's
joints do by inverse kinematics.
"""

import dataclasses
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from benchmarks.common import Options, Row, bench, timed
from benchmarks.ur5e import ur5e
from torchgrasp import ContactSpec, Status, TrialSpec, load_hand, plan_grasps
from torchgrasp.arm import Arm
from torchgrasp.arm.reach import solve_tips
from torchgrasp.data import list_views, read_object_mesh, read_view
from torchgrasp.evaluation.lift import run_lift
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver, Truth
from torchgrasp.hand.hand import Actuator
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.sim.mujoco_scene import (
    MujocoScene,
    format_numbers,
    nest_links,
    render_mjcf,
    scene_mjcf,
)
from torchgrasp.sim.scene_spec import SceneSpec
from torchgrasp.values.closing import ClosureResult

TRIAL = TrialSpec(mass=0.249, table_friction=0.2, lift_height=0.1, approach=0.1, simulator="mujoco")
"""A lift as of protocol "table-lift", by as much as the planner checks the way of the arm."""
DRIVES = {150.0: (2000.0, 400.0), 28.0: (500.0, 100.0)}
"""Stiffness [N m/rad] and damping [N m s/rad] of the UR5e's joints by their effort [N m], of MuJoCo
Menagerie.
"""
ROTOR = 0.1
"""Inertia [kg m2] of the rotors at the joints, of the same."""
LEAST = 0.95
SLOWEST = 1.5
"""Bars: share of the lifts without an arm that succeed with it; processor time of a plan over that
without an arm.
"""


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


@dataclasses.dataclass(frozen=True)
class Lifts:
    """The lifts of a grasp without and with the arm: their statuses, and whether the object rose by
    half the lift.
    """

    object: str
    free: str
    carried: str
    free_risen: bool
    carried_risen: bool


@bench("close/arm", objects=True)
def arm(o: Options) -> list[Row]:
    """Plan each object's first view with and without the arm; lift the best grasps of the plan with
    it both ways.
    """
    hand = load_hand("allegro")
    lifts = list[Lifts]()
    seconds = np.zeros(2)
    empty = list[str]()
    carried = ur5e(hand)
    for folder in o.objects:
        for name, view in dict(list_views(folder, only=o.names)[::-1]).items():
            cloud = read_view(folder, name, view)
            spec = ContactSpec(table=0.0)
            plain, alone = timed(lambda: plan_grasps(cloud, hand, spec, o.starts, o.seed))  # noqa: B023
            found, more = timed(
                lambda: plan_grasps(cloud, hand, spec, o.starts, o.seed, arm=carried)  # noqa: B023
            )
            seconds += more, alone
            counts = [int((x.status == Status.OK).sum()) for x in (plain, found)]
            print(
                f"{name}: {counts[0]} grasps in {alone:.1f} s, with the arm {counts[1]} in {more:.1f} s",
                flush=True,
            )
            good = found[found.status == Status.OK][: o.grasps]
            empty += [name] * (len(good) == 0)
            mesh = read_object_mesh(folder, name)
            parts = convex_parts(mesh)
            for grasp in good:
                lifts.append(
                    _lift(name, GraspTrial(hand, grasp, Truth(mesh, parts), o.seed), carried)
                )
                print(lifts[-1], flush=True)
    risen = [(x.free_risen, x.carried_risen) for x in lifts]
    held = [(x.free == "OK", x.carried == "OK") for x in lifts]
    rows = [_share("risen", risen, lifts), _share("held without slip", held, lifts)]
    ratio = float(seconds[0] / seconds[1])
    words = f"{ratio:.2f} ({seconds[0]:.0f} s, without {seconds[1]:.0f} s); no grasp: {', '.join(empty) or 'none'}"
    return [
        *rows,
        Row(
            "time of a plan with the arm",
            f"<= {SLOWEST}",
            words,
            ratio <= SLOWEST,
            {"ratio": ratio},
        ),
    ]


def _share(what: str, pairs: list[tuple[bool, bool]], lifts: list[Lifts]) -> Row:
    """Return how many of the grasps that succeed without the arm do so with it."""
    free, carried, both = (sum(map(of, pairs)) for of in (lambda x: x[0], lambda x: x[1], all))
    words = f"{both} of {free} that do so without the arm; of all {len(pairs)}: {carried} with it, {free} without"
    return Row(
        f"{what} with the arm", f">= {LEAST:.0%}", words, both >= LEAST * free, {"lifts": lifts}
    )


def _lift(name: str, trial: GraspTrial, arm: Arm) -> Lifts:
    """Lift a grasp both ways."""
    free = run_lift(TrialDriver(trial, TRIAL))
    carried = lift_with_arm(trial, arm)
    risen = [bool(x.rise >= TRIAL.lift_height / 2) for x in (free, carried)]
    return Lifts(name, free.status.name, carried.status.name, *risen)
