"""A simulated hand as a controller uses it: targets of joints and palm go in, observations come
out.
"""

import math
from typing import Annotated

import numpy as np
import torch

from torchgrasp.control import FingertipSensor, Observation, Targets, TipContact
from torchgrasp.control.reference import ClosingReference
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range
from torchgrasp.sim.scene_spec import SceneSpec
from torchgrasp.sim.simulated_scene import SimulatedScene
from torchgrasp.values.specs import Simulator


@checked
def open_scene(spec: SceneSpec, simulator: Simulator = "sapien") -> SimulatedScene:
    """Return a fresh scene of a simulator, at its initial state.

    Args:
        spec: parameters of the scene.
        simulator: "sapien" or "mujoco".

    Raises:
        BadArgument: the simulator is unknown, or a joint of the hand has no start position or
            drive.
        HandFileError: the hand's URDF is missing or malformed, or there are too many
            `self_pairs`.
        MissingExtra: the simulator is not installed.

    >>> from torchgrasp import load_hand, load_object
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> start, tips = dict.fromkeys(hand.tree.joint_names, 0.1), hand.tips.links
    >>> body = jug.mesh, jug.parts, 0.2
    >>> spec = SceneSpec(hand.urdf_path, np.eye(4), start, hand.actuators, tips, *body)
    >>> open_scene(spec).object_pose().shape
    (4, 4)
    """
    if simulator == "mujoco":
        from torchgrasp.sim.mujoco_scene import MujocoScene

        return MujocoScene(spec)
    from torchgrasp.sim.sapien_scene import SapienScene

    return SapienScene(spec)


class SimulatedHand:
    """A simulated hand of f fingers, as a controller sees it: `tick` takes targets, simulates a
    control tick, and returns measurements.

    Args:
        scene: scene at its initial state, from `open_scene`.
        reference: the closing plan, which also has the hand and the settings of its sensors.
        control_rate: rate [Hz] of the control ticks; a tick is a whole number of the scene's
            timesteps.
        generator: source of the noise of the fingertips' sensors; None means no noise.

    Attributes:
        truth: the true contacts of all fingertips in the last tick, as one `TipContact`. They are
            in the frame of the hand's root link.
        force: true normal forces (f,) [N], averaged over the last tick.
        pushes: full forces (f, 3) [N] of the fingertips on the object, in the world's frame,
            averaged over the last tick.
        finger: mask (f,) of the fingers that touched the object in the last timestep. Contacts of
            the fingertip and of the link that carries it count.
        steps: number of timesteps so far.
        sent: targets (j,) [rad or m] of the last tick, in the order of `scene.joint_names`.
        first_touch: number (f,) of the timestep of each fingertip's first contact with the object;
            infinite before it.
        first_stray: number (3,) of the timestep of the hand's first unintended contact: with a
            neighbour, with the table, with the object. With the object, contacts of fingertips and
            the links that carry them do not count. Infinite before it.
        stray: sums (3,) [N s] of the impulses of these three kinds of contact so far.
        most_stray: largest force (3,) [N] of each of these kinds so far, averaged over a tick.
        period: time [s] of a control tick.

    Raises `BadArgument` if the plan's sensor names an unknown finger as dead.
    """

    def __init__(
        self,
        scene: SimulatedScene,
        reference: ClosingReference,
        control_rate: float,
        generator: torch.Generator | None,
    ) -> None:
        self.scene = scene
        self.reference = reference
        self.substeps = max(1, round(1 / (control_rate * scene.timestep)))
        self.period = self.substeps * scene.timestep
        fingers = len(reference.hand.tips)
        self.steps = 0
        self.first_touch = [float("inf")] * fingers
        self.first_stray = np.full(3, np.inf)
        self.stray = np.zeros(3)
        self.most_stray = np.zeros(3)
        self._palm: np.ndarray | None = None
        self.pushes = np.zeros((fingers, 3))
        self.force = np.zeros(fingers)
        self.finger = np.zeros(fingers, dtype=bool)
        self.sensor = FingertipSensor(reference, generator)
        nothing = torch.full((fingers, 3), torch.nan, dtype=torch.float64)
        zero = torch.zeros(fingers, dtype=torch.float64)
        self.truth = TipContact(zero, torch.zeros_like(nothing), nothing, nothing, sliding=zero)
        self._poses: np.ndarray | None = None
        self.sent = scene.joints()
        names = reference.hand.tree.joint_names
        centres = reference.hand.tips.center.double()
        ones = torch.ones(fingers, 1, dtype=torch.float64)
        self._centres = torch.cat([centres, ones], dim=-1).numpy()  # (f, 4)
        self._to_scene = np.array([names.index(name) for name in scene.joint_names])
        self._from_scene = np.array([scene.joint_names.index(name) for name in names])

    @checked
    def tick(self, targets: Targets) -> Observation:
        """Drive joints and palm towards their targets for one control tick; return what the hand
        then measures.

        Args:
            targets: targets of all movable joints of the URDF and of the palm, as
                `GraspController.step` returns them.

        Raises `BadArgument` unless the targets have all joints of the URDF. Raises it also for a
        displaced palm if the scene's mount cannot shift (`SceneSpec.yields`).
        """
        if len(targets.joints) != len(self._to_scene):
            allowed = f"all {len(self._to_scene)} of the URDF"
            raise BadArgument("targets", f"{len(targets.joints)} joints", allowed)
        self.sent = targets.joints.numpy()[self._to_scene]
        self.scene.drive(self.sent)
        palm = targets.palm.numpy()
        # The scene begins where the palm is first sent.
        last = palm if self._palm is None else self._palm
        if palm.any() or last.any():
            rotation = self.scene.hand_pose()[:3, :3]
            self.scene.shift(rotation @ palm, rotation @ (palm - last) / self.period)
        self._palm = palm
        impulse, moment, self.pushes = np.zeros((3, *self.pushes.shape))
        weight = np.zeros(len(self.force))
        before = self.stray.copy()
        for _ in range(self.substeps):
            step = self.scene.step()
            self.steps += 1
            impulse += step.impulse
            moment += step.moment
            weight += step.weight
            self.pushes += step.force / self.substeps  # the mean force of the tick
            self.finger = step.finger
            if math.inf in self.first_touch:
                touches = zip(self.first_touch, step.weight.tolist(), strict=True)
                self.first_touch = [
                    self.steps if at > self.steps and size > 0.0 else at for at, size in touches
                ]
            if any(step.stray.tolist()):
                self.first_stray[(step.stray > 0) & np.isinf(self.first_stray)] = self.steps
                self.stray += step.stray
        self.most_stray = np.maximum(self.most_stray, (self.stray - before) / self.period)
        return self._observe(impulse, moment, weight)

    @checked
    def rest(self, ticks: Annotated[int, Range(0, 1000000)]) -> None:
        """Simulate a number of control ticks with the last tick's targets, without measurements.

        Only `steps` counts on; the other attributes stay. Raises `BadArgument` for a negative
        number.
        """
        self.scene.skip(ticks * self.substeps)
        self.steps += ticks * self.substeps

    def unbalanced(self) -> float:
        """Return how far the fingertip forces of the last control tick are from balance, in [0, 1].

        It is the norm of the sum of all forces, divided by the sum of their norms. It is NaN if no
        fingertip exerts a force.
        """
        sizes = float(np.linalg.norm(self.pushes, axis=-1).sum())
        return float(np.linalg.norm(self.pushes.sum(0))) / sizes if sizes > 0.0 else math.nan

    @checked
    def ticks(self, seconds: Annotated[float, Range(0.0, 1e6)]) -> int:
        """Return the whole number of control ticks nearest to `seconds` [s], at least one.

        Raises `BadArgument` for a negative time.
        """
        return max(1, round(seconds / self.period))

    def _observe(self, impulse: np.ndarray, moment: np.ndarray, weight: np.ndarray) -> Observation:
        """Return what the hand measures at the end of a tick, given sums over the tick as in
        `StepContacts`.
        """
        world_from_hand = self.scene.hand_pose()
        tips = self.scene.tip_poses()
        rotation = world_from_hand[:3, :3]
        origin = world_from_hand[:3, 3]
        centres = (tips @ self._centres[:, :, None])[:, :3, 0]
        sizes = np.linalg.norm(impulse, axis=-1)
        self.force = sizes / self.period
        with np.errstate(invalid="ignore", divide="ignore"):
            points = moment / weight[:, None]
            normals = -impulse / sizes[:, None]
        vectors = torch.from_numpy(np.concatenate([self.pushes, normals]) @ rotation)
        places = torch.from_numpy((np.concatenate([points, centres]) - origin) @ rotation)
        f = len(self.force)
        sliding = torch.from_numpy(self._sliding(tips, points, normals))
        self.truth = TipContact(
            torch.from_numpy(self.force), vectors[:f], places[:f], vectors[f:], sliding
        )
        joints = self.scene.joints()[self._from_scene]
        jacobian = self.scene.jacobian(centres).take(self._from_scene, -1)
        turned = torch.from_numpy(rotation.T @ jacobian)
        tactile = self.sensor(self.truth, turned, self.period)
        return Observation(torch.from_numpy(joints), places[f:], turned, tactile)

    def _sliding(self, tips: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the speed [m/s] of each tip along the object's surface since the last tick; 0
        without contact.
        """
        poses = np.array([*tips, self.scene.object_pose()])
        before = self._poses
        self._poses = poses
        if before is None or np.isnan(points).all():
            return np.zeros(len(tips))
        here = np.ones((len(points), 4))
        here[:, :3] = points
        then = before @ np.linalg.inv(poses)
        on_tip = (then[:-1] @ here[:, :, None])[:, :3, 0]
        on_object = (here @ then[-1].T)[:, :3]
        moved = on_object - on_tip
        along = moved - (moved * normals).sum(-1, keepdims=True) * normals
        speed = np.linalg.norm(along, axis=-1) / self.period
        return np.where(np.isnan(speed), 0.0, speed)
