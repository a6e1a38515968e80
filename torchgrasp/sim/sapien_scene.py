"""A simulated scene in SAPIEN: it moves the hand and the bodies of `sapien_bodies` in each step."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from torchgrasp.sim.sapien_bodies import (
    CENTIMETRES,
    import_sapien,
    mounted_hand,
    open_world,
    place,
    rigid_body,
    surface_of,
    table,
)
from torchgrasp.sim.scene_spec import WRIST_JOINT, SceneSpec
from torchgrasp.sim.simulated_scene import STILL, SimulatedScene, StepContacts


def _noted(method: Callable[..., Any]) -> Any:
    """Decorate a method of `SapienScene`: record each of its calls, which `SapienScene.keep`
    repeats in a new scene.
    """

    @functools.wraps(method)
    def call(self: "SapienScene", *args: Any) -> Any:
        self._calls.append((call, args))
        return method(self, *args)

    return call


class SapienScene(SimulatedScene):
    """A simulated scene in SAPIEN, whose engine is PhysX: table, object and hand."""

    def __init__(self, spec: SceneSpec) -> None:
        super().__init__(spec)
        self._calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self.system, self.scene = open_world(spec.gravity, spec.timestep, spec.patch > 0.0)
        slick = surface_of(spec.body_friction)
        # PhysX averages the coefficients of two bodies.
        grip = surface_of(2 * spec.friction - spec.body_friction)
        if spec.table:
            place(self.scene, "table", table(slick, spec), spec.table_height)
        solids = zip((spec.body, *spec.neighbours), spec.hulls, strict=True)
        bodies = [rigid_body(slick, body, hulls, spec.patch) for body, hulls in solids]
        for k, body in enumerate(bodies):
            place(self.scene, "neighbour" if k else "object", body)
        self.body, *self.neighbours = bodies
        self.hand = mounted_hand(self.scene, grip, spec)
        links = {link.name: link for link in self.hand.links}
        self.tips = [links[name] for name in spec.tip_links]
        self.root = next(j.child_link for j in self.hand.joints if j.name == WRIST_JOINT)
        carriers = (tip.parent if tip.joint.dof == 0 else None for tip in self.tips)
        self._map_contacts(self.system.rigid_static_components, carriers)
        self._map_joints(spec)
        self.pull(STILL)

    def _map_joints(self, spec: SceneSpec) -> None:
        """Sort the joints of hand and mount; store the frames of the driven joints and the tips
        that they move.
        """
        active = self.hand.active_joints
        slides = {slide.name for slide in spec.slides}
        self._mount = {j.name: j for j in active if j.name in slides}
        self._places = [k for k, j in enumerate(active) if j.name not in slides]
        self._driven = [active[k] for k in self._places]
        self.joint_names = tuple(j.name for j in self._driven)
        self._frames = np.array([_matrix(j.pose_in_child) for j in self._driven])
        self._children = [j.child_link for j in self._driven]
        self._slides = np.array([j.type == "prismatic" for j in self._driven])
        self._units = np.where(self._slides, CENTIMETRES, 1.0)
        self._moves = np.zeros((len(self.tips), len(self._driven)))
        for t, link in enumerate(self.tips):
            while link is not None:
                self._moves[t, [child is link for child in self._children]] = 1.0
                link = link.parent
        self._sensor_axes = [_matrix(tip.joint.pose_in_child)[:3, :3] for tip in self.tips]
        self._tip_index = [self.hand.links.index(tip) for tip in self.tips]

    def keep(self) -> "Callable[[], SapienScene]":
        """Return a function without arguments; each call returns a new copy of this scene as it is
        now.

        The function repeats all calls so far in a fresh scene, so it takes as long as they did.
        PhysX can store the state of its bodies, but not that of its contacts.
        """
        calls = tuple(self._calls)

        def reopen() -> SapienScene:
            scene = SapienScene(self.spec)
            for call, args in calls:
                call(scene, *args)
            return scene

        return reopen

    @_noted
    def _simulate(self) -> None:
        """Advance by one timestep."""
        if self._pulled:
            self.body.add_force_torque(self._force, self._torque)
        self.system.step()

    def skip(self, steps: int) -> None:
        """Advance the simulation by `steps` timesteps, without a report of contacts."""
        for _ in range(steps):
            self._simulate()

    def _advance(self) -> Iterator[tuple[Any, Any, Any]]:
        """Advance by one timestep; yield each pair of bodies that touch, with their contact."""
        self._simulate()
        for contact in self.system.get_contacts():
            yield *contact.bodies, contact

    def _read(self, contact: Any, sign: float) -> Iterator[tuple[float, list[float]]]:
        """Yield the size [N s] of the impulse at each point of a contact, and seven numbers.

        The first three are the impulse [N s] on the body that the hand touches. The others are size
        times position (3,) [N s m], and size. Points without an impulse are left out. `sign` is 1
        if the hand's link is the contact's first body, else -1. SAPIEN reports the impulse on the
        first body.
        """
        for point in contact.points:
            impulse = point.impulse / CENTIMETRES
            squared = impulse.dot(impulse)
            if squared:
                size = float(np.sqrt(squared))
                where = point.position / CENTIMETRES
                yield size, [*(-sign * impulse).tolist(), *(size * where).tolist(), size]

    def step(self) -> StepContacts:
        """Advance by one timestep; return the impulses [N s], forces [N] and places of the hand's
        contacts during it, summed for each fingertip.

        The forces include friction: they are measured at the joints that carry the fingertips. For
        contacts, SAPIEN reports no friction, but it reports the complete wrench at each joint.
        """
        contacts = super().step()
        touching = [i for i, weight in enumerate(contacts.weight.tolist()) if weight > 0.0]
        if touching:
            wrenches = self.hand.get_link_incoming_joint_forces()[self._tip_index, :3].astype(float)
            wrenches = wrenches / CENTIMETRES
            for i in touching:
                world_from_sensor = self._pose(self.tips[i])[:3, :3].dot(self._sensor_axes[i])
                contacts.force[i] = world_from_sensor.dot(wrenches[i])
        return contacts

    @_noted
    def drive(self, targets: np.ndarray) -> None:
        """Set the target positions (j,) [rad or m] of the j driven joints.

        They are in the order of `joint_names`, and hold until the next call.
        """
        for joint, target in zip(self._driven, (self._units * targets).tolist(), strict=True):
            joint.set_drive_target(target)

    @_noted
    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force (3,) [N] at the object's centre of mass and a torque (3,) [N m].

        Both are in the world's frame, and act in all later steps until the next call.
        """
        self._force = np.asarray(CENTIMETRES * force, np.float32)
        self._torque = np.asarray(CENTIMETRES**2 * torque, np.float32)
        self._pulled = bool(self._force.any() or self._torque.any())

    @_noted
    def displace(self, shift: np.ndarray) -> None:
        """Move the object at once by a displacement `shift` (3,) [m] in the world's frame."""
        sapien, _ = import_sapien()
        pose = self.body.entity_pose
        self.body.entity.set_pose(sapien.Pose(pose.p + CENTIMETRES * shift, pose.q))

    def joints(self) -> np.ndarray:
        """Return the positions (j,) [rad or m] of the j driven joints, in the order of
        `joint_names`.
        """
        return np.asarray(self.hand.get_qpos(), float)[self._places] / self._units

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the Jacobian (f, 3, j) [m/rad] of a point on each fingertip with respect to the j
        driven joints.

        Jacobian and `points` (f, 3) [m] are in the world's frame. Columns of joints that slide have
        no unit.
        """
        frames = np.array([self._pose(link) for link in self._children]) @ self._frames
        axes = frames[:, :3, 0]
        arms = points[:, None, :] - frames[:, :3, 3]
        # coordinates of a cross product; np.cross takes much longer
        following = [1, 2, 0]
        last = [2, 0, 1]
        turned = axes.take(following, -1) * arms.take(last, -1) - axes.take(last, -1) * arms.take(
            following, -1
        )
        columns = np.where(self._slides[:, None], axes, turned) * self._moves[..., None]
        return columns.transpose(0, 2, 1)

    @_noted
    def penetration(self) -> float:
        """Return the largest depth [m] by which the hand penetrates another body or itself; at most
        0 if it penetrates nothing.

        This call advances the scene by one timestep, in which object and neighbours feel no
        gravity. The depth is measured after it.
        """
        bodies = [self.body, *self.neighbours]
        for body in bodies:
            body.disable_gravity = True
        self.scene.step()
        for body in bodies:
            body.disable_gravity = False
        touching = [
            c for c in self.system.get_contacts() if not set(c.bodies) <= self._place_of.keys()
        ]
        depths = (-point.separation for contact in touching for point in contact.points)
        return float(max(depths, default=0.0)) / CENTIMETRES

    def _pose(self, body: Any) -> np.ndarray:
        """Return the pose (4, 4) of a body in the world's frame."""
        return _matrix(body.entity_pose)

    @_noted
    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint of the mount."""
        self._mount[joint].set_drive_target(float(CENTIMETRES * target))
        self._mount[joint].set_drive_velocity_target(float(CENTIMETRES * speed))


def _matrix(pose: Any) -> np.ndarray:
    """Return a SAPIEN pose as a matrix (4, 4) [m]."""
    matrix = pose.to_transformation_matrix().astype(float)
    matrix[:3, 3] /= CENTIMETRES
    return matrix
