"""A hand in a simulated scene as its controllers know it: joint targets in, and a tick later what the robot sees."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import TipContact, measure, no_contact
from torchgrasp.sim.scene import Scene


class SimulatedHand:
    """The hand of a scene, with tactile fingertips.

    After each tick `force` (3,) holds the true normal forces [N] averaged over it, `finger` which fingers touched in
    its last step, `steps` counts the steps of the simulator so far, and `first_touch` tells at which of them each
    fingertip first touched, infinite for none.

    Args:
        scene: at its start.
        reference: what it follows.
        control_rate: ticks a second [Hz].
        generator: draws the noise of the fingertips; None: no noise.
    """

    def __init__(
        self,
        scene: Scene,
        reference: ClosingReference,
        control_rate: float,
        generator: torch.Generator | None,
    ) -> None:
        self.scene, self.reference, self.generator = scene, reference, generator
        self.substeps = max(1, round(1 / (control_rate * scene.timestep)))
        self.period = self.substeps * scene.timestep
        self.steps, self.first_touch = 0, [float("inf")] * 3
        self.force, self.finger = np.zeros(3), np.zeros(3, dtype=bool)
        self._centres = torch.cat(
            [reference.hand.tips.center.double(), torch.ones(3, 1, dtype=torch.float64)], dim=-1
        ).numpy()
        self.tactile = no_contact()
        names = reference.hand.tree.joint_names
        self._to_scene = [names.index(name) for name in scene.joint_names]
        self._from_scene = [scene.joint_names.index(name) for name in names]

    def tick(self, targets: Float[Tensor, " j"]) -> Observation:
        """Drive the joints for one control period and return what the robot then knows."""
        self.scene.drive(targets[self._to_scene].numpy())
        impulse, moment, weight, force = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
        for _ in range(self.substeps):
            seen = self.scene.step()
            self.steps += 1
            impulse += seen.impulse
            moment += seen.moment
            weight += seen.weight
            force += seen.force / self.substeps
            self.finger = seen.finger
            for i in np.flatnonzero(seen.weight > 0):
                self.first_touch[i] = min(self.first_touch[i], self.steps)
        self.force = np.linalg.norm(impulse, axis=-1) / self.period
        return self._sight(impulse, moment, weight, force)

    def ticks(self, seconds: float) -> int:
        """Count the control ticks in a time [s]."""
        return max(1, round(seconds / self.period))

    def _sight(self, impulse: np.ndarray, moment: np.ndarray, weight: np.ndarray, force: np.ndarray) -> Observation:
        """Return the hand's own knowledge, in its frame: the true contacts only as the fingertips sense them."""
        stands = self.scene.hand_pose()
        turn, origin = stands[:3, :3], stands[:3, 3]
        centres = (self.scene.tip_poses() @ self._centres[:, :, None])[:, :3, 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            points = moment / weight[:, None]
            normals = -impulse / np.linalg.norm(impulse, axis=-1, keepdims=True)
        directions = torch.from_numpy(np.concatenate([force, normals]) @ turn)
        places = torch.from_numpy((np.concatenate([points, centres]) - origin) @ turn)
        press = TipContact(torch.from_numpy(self.force), directions[:3], places[:3], directions[3:])
        normals, radius = self.reference.normals, self.reference.hand.tip_radius
        self.tactile = measure(self.tactile, press, normals, radius, self.period, self.generator)
        joints, jacobian = self.scene.joints()[self._from_scene], self.scene.jacobian(centres)[..., self._from_scene]
        return Observation(torch.from_numpy(joints), places[3:], torch.from_numpy(turn.T @ jacobian), self.tactile)
