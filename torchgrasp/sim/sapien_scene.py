"""A scene that SAPIEN simulates."""

from typing import Any

import numpy as np

from torchgrasp.sim.mount import APPROACH_JOINT, LIFT_JOINT, WRIST_JOINT
from torchgrasp.sim.sapien_build import build
from torchgrasp.sim.scene import STILL, SceneSpec, StepContacts


class SapienScene:
    """Table, object and hand in one SAPIEN scene (`Scene`)."""

    def __init__(self, setup: SceneSpec) -> None:
        self.timestep, self.centre = setup.timestep, np.asarray(setup.mesh.center_mass, float)
        self.system, self.scene, self.body, self.hand = build(setup)
        active = self.hand.active_joints
        self._carriage = {j.name: j for j in active if j.name in (LIFT_JOINT, APPROACH_JOINT)}
        self._order = [k for k, j in enumerate(active) if j.name not in self._carriage]
        self._driven = [active[k] for k in self._order]
        self.joint_names = tuple(j.name for j in self._driven)
        links = {link.name: link for link in self.hand.links}
        self.tips = [links[name] for name in setup.tip_links]
        self._root = next(j.child_link for j in self.hand.joints if j.name == WRIST_JOINT)
        self.pull(STILL)
        self._map_contacts()
        self._map_joints()

    def _map_contacts(self) -> None:
        """Remember which finger a link belongs to: its tip, and the link that the tip is fixed to."""
        self._tip_of = {link.name: i for i, link in enumerate(self.tips)}
        self._finger_of = dict(self._tip_of)
        for i, tip in enumerate(self.tips):
            if tip.joint.dof == 0:
                self._finger_of.setdefault(tip.parent.name, i)

    def _map_joints(self) -> None:
        """Prepare the geometric Jacobian: each driven joint's frame in its link, and the tips that it moves."""
        self._frames = [_matrix(j.pose_in_child) for j in self._driven]
        self._slides = np.array([j.type == "prismatic" for j in self._driven])
        self._moves = np.zeros((len(self.tips), len(self._driven)))
        for t, tip in enumerate(self.tips):
            link = tip
            while link is not None:
                for k, joint in enumerate(self._driven):
                    if joint.child_link.name == link.name:
                        self._moves[t, k] = 1.0
                link = link.parent
        self._mounts = [_matrix(tip.joint.pose_in_child)[:3, :3] for tip in self.tips]
        self._tip_index = [self.hand.links.index(tip) for tip in self.tips]

    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""
        if self._pull.any() or self._turn.any():
            self.body.add_force_torque(self._pull, self._turn)
        self.scene.step()
        impulse, moment, weight = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
        finger = np.zeros(3, dtype=bool)
        for contact in self.system.get_contacts():
            first, second = (b.entity.name for b in contact.bodies)
            if first == "object":
                link, sign = second, 1.0
            elif second == "object":
                link, sign = first, -1.0
            else:
                continue
            which = self._finger_of.get(link)
            if which is None:
                continue
            for point in contact.points:
                size = float(np.linalg.norm(point.impulse))
                if size > 0.0:
                    finger[which] = True
                    if link in self._tip_of:
                        impulse[which] += sign * point.impulse
                        moment[which] += size * point.position
                        weight[which] += size
        return StepContacts(impulse, moment, weight, finger, self._tip_forces(weight > 0))

    def _tip_forces(self, touches: np.ndarray) -> np.ndarray:
        """Return the force (3, 3) [N] that each fingertip that touches exerts, as a sensor in its mount feels it.

        SAPIEN's contacts are without friction. The wrench of an incoming joint is complete; its axes are those of the
        joint in the child, not those of the link.
        """
        force = np.zeros((3, 3))
        if touches.any():
            wrenches = self.hand.get_link_incoming_joint_forces()
            for i in np.flatnonzero(touches):
                turn = _matrix(self.tips[i].entity_pose)[:3, :3] @ self._mounts[i]
                force[i] = turn @ wrenches[self._tip_index[i], :3]
        return force

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""
        for joint, target in zip(self._driven, targets, strict=True):
            joint.set_drive_target(float(target))

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Let a force [N] at the object's mass centre and a torque [N m] act on it from now on."""
        self._pull, self._turn = np.asarray(force, np.float32), np.asarray(torque, np.float32)

    def lift(self, height: float, speed: float = 0.0) -> None:
        """Set the height [m] that the hand is to be lifted to, and the speed [m/s] at which that target moves."""
        self._carry(LIFT_JOINT, height, speed)

    def approach(self, left: float, speed: float = 0.0) -> None:
        """Set what is to be left [m] of the hand's approach, and the speed [m/s] at which it goes on."""
        self._carry(APPROACH_JOINT, -left, speed)

    def _carry(self, name: str, target: float, speed: float) -> None:
        """Set the target [m] of a joint of the carriage, and the speed [m/s] at which it moves."""
        self._carriage[name].set_drive_target(float(target))
        self._carriage[name].set_drive_velocity_target(float(speed))

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""
        return np.asarray(self.hand.get_qpos(), float)[self._order]

    def object_pose(self) -> np.ndarray:
        """Return the object's pose (4, 4)."""
        return _matrix(self.body.entity.pose)

    def hand_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the hand's root link, after at least one step."""
        return _matrix(self._root.entity_pose)

    def tip_poses(self) -> np.ndarray:
        """Return the poses (3, 4, 4) of the fingertips' links."""
        return np.stack([_matrix(t.entity_pose) for t in self.tips])

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d points / d driven joints (3, 3, j), each point fixed to its fingertip [m/rad or 1]."""
        links = [_matrix(j.child_link.entity_pose) for j in self._driven]
        frames = np.stack([link @ frame for link, frame in zip(links, self._frames, strict=True)])
        arms = points[:, None, :] - frames[None, :, :3, 3]
        axes = np.broadcast_to(frames[:, :3, 0], arms.shape)
        columns = np.where(self._slides[:, None], axes, np.cross(axes, arms)) * self._moves[..., None]
        return columns.transpose(0, 2, 1)

    def penetration(self) -> float:
        """Return how deep [m] the hand is in the object or the table after one step without the object's weight."""
        self.body.disable_gravity = True
        self.scene.step()
        self.body.disable_gravity = False
        deepest = 0.0
        for contact in self.system.get_contacts():
            if {b.entity.name for b in contact.bodies} != {"object", "table"}:
                deepest = max([deepest, *(-p.separation for p in contact.points)])
        return float(deepest)


def _matrix(pose: Any) -> np.ndarray:
    """Return a pose of SAPIEN as a matrix (4, 4)."""
    return np.asarray(pose.to_transformation_matrix(), float)
