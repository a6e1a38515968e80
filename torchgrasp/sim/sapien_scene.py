"""A scene that SAPIEN simulates."""

from typing import Any

import numpy as np

from torchgrasp.sim.mount import WRIST_JOINT
from torchgrasp.sim.sapien_build import build
from torchgrasp.sim.scene import (
    APPROACH_JOINT,
    LIFT_JOINT,
    NEIGHBOURS,
    SHIFT_JOINTS,
    STILL,
    TABLETOP,
    TARGET,
    Scene,
    SceneSpec,
)
from torchgrasp.sim.step_contacts import StepContacts

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Coordinates after and before each one, in a vector product: `np.cross` takes five times as long."""


class SapienScene(Scene):
    """Table, object and hand in one SAPIEN scene."""

    def __init__(self, spec: SceneSpec) -> None:
        super().__init__(spec)
        self.system, self.scene, self.body, self.hand, self.neighbours = build(spec)
        active = self.hand.active_joints
        self._mount = {j.name: j for j in active if j.name in (LIFT_JOINT, APPROACH_JOINT, *SHIFT_JOINTS)}
        self._places = [k for k, j in enumerate(active) if j.name not in self._mount]
        self._driven = [active[k] for k in self._places]
        self.joint_names = tuple(j.name for j in self._driven)
        links = {link.name: link for link in self.hand.links}
        self.tips = [links[name] for name in spec.tip_links]
        self.root = next(j.child_link for j in self.hand.joints if j.name == WRIST_JOINT)
        self.pull(STILL)
        self._map_contacts()
        self._map_joints()

    def _map_contacts(self) -> None:
        """Map tips and their parent links to fingers, and what is no link to its column of `Disturbance`."""
        self._links = set(self.hand.links)
        self._finger_of = {link: i for i, link in enumerate(self.tips)}
        self._place_of = {self.body: TARGET} | dict.fromkeys(self.neighbours, NEIGHBOURS)
        self._place_of |= dict.fromkeys(self.system.rigid_static_components, TABLETOP)
        for i, tip in enumerate(self.tips):
            if tip.joint.dof == 0:
                self._finger_of.setdefault(tip.parent, i)

    def _map_joints(self) -> None:
        """Prepare the Jacobian: each driven joint's frame in its link, and the tips it moves."""
        self._frames = np.array([_matrix(j.pose_in_child) for j in self._driven])
        self._children = [j.child_link for j in self._driven]
        self._slides = np.array([j.type == "prismatic" for j in self._driven])
        self._moves = np.zeros((len(self.tips), len(self._driven)))
        for t, tip in enumerate(self.tips):
            link = tip
            while link is not None:
                for k, joint in enumerate(self._driven):
                    if joint.child_link.name == link.name:
                        self._moves[t, k] = 1.0
                link = link.parent
        self._sensor_axes = [_matrix(tip.joint.pose_in_child)[:3, :3] for tip in self.tips]
        self._tip_index = [self.hand.links.index(tip) for tip in self.tips]

    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""
        if self._pulled:
            self.body.add_force_torque(self._force, self._torque)
        self.scene.step()
        contacts = StepContacts.none(len(self.tips))
        for contact in self.system.get_contacts():
            first, second = contact.bodies
            if (first in self._links) == (second in self._links):
                continue
            link, other, sign = (first, second, -1.0) if first in self._links else (second, first, 1.0)
            finger = self._finger_of.get(link) if other is self.body else None
            if finger is None:
                contacts.stray[self._place_of[other]] += sum(_length(point.impulse) for point in contact.points)
                continue
            for point in contact.points:
                impulse = point.impulse
                size = _length(impulse)
                if size > 0.0:
                    contacts.finger[finger] = True
                    if link is self.tips[finger]:
                        contacts.add(finger, sign * impulse, size, point.position)
        self._add_forces(contacts)
        return contacts

    def _add_forces(self, contacts: StepContacts) -> None:
        """Add the force of each touching fingertip, as a sensor at its base measures it.

        SAPIEN reports contacts without friction. The wrench of an incoming joint is complete; its axes are
        the joint's in the child.
        """
        touching = [i for i, weight in enumerate(contacts.weight.tolist()) if weight > 0.0]
        if touching:
            wrenches = self.hand.get_link_incoming_joint_forces().astype(float)
            for i in touching:
                world_from_sensor = self._pose(self.tips[i])[:3, :3].dot(self._sensor_axes[i])
                contacts.force[i] = world_from_sensor.dot(wrenches[self._tip_index[i], :3])

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""
        for joint, target in zip(self._driven, targets, strict=True):
            joint.set_drive_target(float(target))

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force [N] and a torque [N m] to the object from now on."""
        self._force, self._torque = np.asarray(force, np.float32), np.asarray(torque, np.float32)
        self._pulled = bool(self._force.any() or self._torque.any())

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""
        return np.asarray(self.hand.get_qpos(), float)[self._places]

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the geometric Jacobian (f, 3, j) of points on the fingertips."""
        frames = np.array([_matrix(link.entity_pose) for link in self._children]) @ self._frames
        axes, arms = frames[:, :3, 0], points[:, None, :] - frames[:, :3, 3]
        turned = axes.take(_NEXT, -1) * arms.take(_LAST, -1) - axes.take(_LAST, -1) * arms.take(_NEXT, -1)
        columns = np.where(self._slides[:, None], axes, turned) * self._moves[..., None]
        return columns.transpose(0, 2, 1)

    def penetration(self) -> float:
        """Return the depth [m] of the hand in anything after a weightless step."""
        bodies = [self.body, *self.neighbours]
        for body in bodies:
            body.disable_gravity = True
        self.scene.step()
        for body in bodies:
            body.disable_gravity = False
        deepest = 0.0
        for contact in self.system.get_contacts():
            if not self._links.isdisjoint(contact.bodies):
                deepest = max([deepest, *(-p.separation for p in contact.points)])
        return float(deepest)

    def _pose(self, body: Any) -> np.ndarray:
        """Return the pose (4, 4) of a body of the scene."""
        return _matrix(body.entity_pose)

    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Drive a joint of the mount."""
        self._mount[joint].set_drive_target(float(target))
        self._mount[joint].set_drive_velocity_target(float(speed))


def _matrix(pose: Any) -> np.ndarray:
    """Return a pose of SAPIEN as a matrix (4, 4)."""
    return pose.to_transformation_matrix().astype(float)


def _length(impulse: np.ndarray) -> float:
    """Return the length of a vector as `np.linalg.norm` does, to the bit, in less than half of its time."""
    squared = impulse.dot(impulse)
    return float(np.sqrt(squared)) if squared else 0.0  # most points of a contact press nothing
