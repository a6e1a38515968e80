"""Bodies that fall onto a table and come to rest, in SAPIEN, without a hand."""

from typing import Any

import numpy as np

from torchgrasp.sim.sapien_build import import_sapien, open_world, place, rigid_body, table
from torchgrasp.sim.scene import PATCH_RADIUS, TABLE, Body

TIMESTEP = 1 / 240
"""Timestep [s]: bodies that fall need no finer one."""
ROLLING_DAMPING = 2.0
"""Damping of rotation [1/s]: it stands for the rolling resistance that rigid balls lack."""
PAUSE = 0.1
"""Time [s] between two looks at the bodies."""
STILL_SHIFT, STILL_TURN = 5e-4, 0.01
"""Motion [m] and change of a rotation matrix in that time below which a body is still; a ball on facets trembles less,
though its speed of the moment does not tell."""


class SettlingTable:
    """A table z = 0 and bodies on it. The same calls give the same bits.

    Args:
        friction: of every contact.
        damping: of rotation [1/s].
        timestep: [s].

    Raises:
        MissingExtra: SAPIEN is not installed.
    """

    def __init__(self, friction: float = 0.8, damping: float = ROLLING_DAMPING, timestep: float = TIMESTEP) -> None:
        self._sapien, self._physx = import_sapien()
        self._system, self._scene = open_world(self._sapien, self._physx, 9.81, timestep)
        self._material = self._physx.PhysxMaterial(friction, friction, 0.0)
        place(self._sapien, self._scene, "table", table(self._physx, self._material), -TABLE[2] / 2)
        self._damping, self._timestep = damping, timestep
        self._bodies: list[Any] = []

    def add(self, body: Body, pose: np.ndarray) -> None:
        """Add a body at rest at a pose (4, 4) of its mesh's frame."""
        self._bodies.append(rigid_body(self._sapien, self._physx, self._material, body, PATCH_RADIUS))
        self._bodies[-1].angular_damping = self._damping
        place(self._sapien, self._scene, "neighbour", self._bodies[-1])
        self.move(len(self._bodies) - 1, pose)

    def move(self, index: int, pose: np.ndarray) -> None:
        """Put a body elsewhere, at rest."""
        body = self._bodies[index]
        body.entity.set_pose(self._sapien.Pose(np.asarray(pose, float)))
        body.linear_velocity = body.angular_velocity = np.zeros(3, np.float32)

    def poses(self) -> np.ndarray:
        """Return the poses (m, 4, 4) of the bodies."""
        return np.array([body.entity_pose.to_transformation_matrix() for body in self._bodies], float)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / self._timestep)):
            self._scene.step()

    def settle(self, seconds: float) -> bool:
        """Wait until all bodies are still, at most some seconds; return whether they are."""
        before = self.poses()
        for _ in range(round(seconds / PAUSE)):
            self.wait(PAUSE)
            poses = self.poses()
            change, before = np.abs(poses - before), poses
            if change[:, :3, 3].max() < STILL_SHIFT and change[:, :3, :3].max() < STILL_TURN:
                return True
        return False
