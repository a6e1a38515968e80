"""A scene that MuJoCo simulates."""

from typing import Any

import numpy as np

from torchgrasp.errors import HandFileError, MissingExtra
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.sim.mjcf import NEIGHBOUR, OBJECT, scene_mjcf
from torchgrasp.sim.scene import NEIGHBOURS, STILL, TABLETOP, TARGET, Scene, StepContacts
from torchgrasp.sim.scene_spec import MOUNT_DRIVE, SceneSpec, mount_slides


class MujocoScene(Scene):
    """Table, object and hand in one MuJoCo model.

    A step runs MuJoCo's second half (forces to state) before its first (state to poses and contacts), so that poses are
    current between steps.
    """

    def __init__(self, spec: SceneSpec) -> None:
        super().__init__(spec)
        self._mujoco = mujoco = _import_mujoco()
        text = scene_mjcf(spec)
        try:
            self.model = model = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            raise HandFileError("urdf", f"{spec.urdf_path}: {error}", "a hand that MuJoCo can simulate") from error
        self.data = data = mujoco.MjData(model)
        self.body = model.body(OBJECT).id
        urdf = read_urdf(spec.urdf_path)
        self.joint_names = tuple(joint.name for joint in urdf.joints if joint.kind != "fixed")
        self._positions = np.array([model.joint(name).qposadr[0] for name in self.joint_names])
        self._velocities = np.array([model.joint(name).dofadr[0] for name in self.joint_names])
        self._motors = np.array([model.actuator(name).id for name in self.joint_names])
        self.root = model.body(urdf.root).id
        self.tips = [model.body(name).id for name in spec.tip_links]
        self.neighbours = [model.body(NEIGHBOUR.format(k)).id for k in range(len(spec.neighbours))]
        self._map_contacts()
        data.qpos[self._positions] = [spec.joints[name] for name in self.joint_names]
        self.drive(data.qpos[self._positions])
        for slide in mount_slides(spec):
            data.qpos[model.joint(slide.name).qposadr[0]] = slide.start
            self._move_mount(slide.name, slide.start, 0.0)
        mujoco.mj_step1(model, data)

    def _map_contacts(self) -> None:
        """Map shapes to bodies, tips and their parent bodies to fingers, and other bodies to their kind."""
        model = self.model
        self._body_of = model.geom_bodyid.tolist()
        self._kind_of = {0: TABLETOP, self.body: TARGET} | dict.fromkeys(self.neighbours, NEIGHBOURS)
        self._finger_of = {body: i for i, body in enumerate(self.tips)}
        for i, tip in enumerate(self.tips):
            if model.body_jntnum[tip] == 0:
                self._finger_of.setdefault(int(model.body_parentid[tip]), i)

    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""
        contacts = StepContacts.none(len(self.tips))
        if self._diverged():
            return contacts
        self._mujoco.mj_step2(self.model, self.data)
        wrench, found = np.zeros(6), self.data.contact
        for k, shapes in enumerate(found.geom.tolist()):
            first, second = (self._body_of[shape] for shape in shapes)
            if (first in self._kind_of) == (second in self._kind_of):
                continue
            link, other, sign = (second, first, -1.0) if first in self._kind_of else (first, second, 1.0)
            self._mujoco.mj_contactForce(self.model, self.data, k, wrench)
            finger = self._finger_of.get(link) if other == self.body else None
            if finger is None:
                contacts.stray[self._kind_of[other]] += max(float(wrench[0]), 0.0) * self.timestep
            elif wrench[0] > 0.0:
                contacts.finger[finger] = True
                if link == self.tips[finger]:
                    axes = found.frame[k].reshape(3, 3)  # in rows; the first points from the first body to the second
                    size = float(wrench[0]) * self.timestep
                    contacts.add(finger, sign * size * axes[0], size, found.pos[k])
                    contacts.force[finger] += sign * (wrench[:3] @ axes)
        self._mujoco.mj_step1(self.model, self.data)
        return contacts

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""
        self.data.ctrl[self._motors] = targets

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force [N] and a torque [N m] to the object, in this and all later steps."""
        self.data.xfrc_applied[self.body] = [*force, *torque]

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""
        return self.data.qpos[self._positions]

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the geometric Jacobian (f, 3, j) of points on the fingertips."""
        jacobian = np.zeros((len(self.tips), 3, self.model.nv))
        for rows, point, tip in zip(jacobian, points, self.tips, strict=True):
            self._mujoco.mj_jac(self.model, self.data, rows, None, point, tip)
        return jacobian[:, :, self._velocities]

    def penetration(self) -> float:
        """Return the depth [m] of the hand in anything."""
        deepest = 0.0
        for (first, second), distance in zip(self.data.contact.geom, self.data.contact.dist, strict=True):
            if self._body_of[first] not in self._kind_of or self._body_of[second] not in self._kind_of:
                deepest = max(deepest, -float(distance))
        return deepest

    def _diverged(self) -> bool:
        """Return whether the state has left all bounds: then every pose is NaN."""
        if self.data.warning.number[self._mujoco.mjtWarning.mjWARN_BADQPOS :].any():
            self.data.qpos[:] = self.data.xpos[:] = np.nan
            return True
        return False

    def _pose(self, body: int) -> np.ndarray:
        """Return the pose (4, 4) of a body by its index."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return pose

    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Drive a joint of the mount."""
        self.data.ctrl[self.model.actuator(joint).id] = target + speed * MOUNT_DRIVE.kd / MOUNT_DRIVE.kp


def _import_mujoco() -> Any:
    """Import MuJoCo, whose warnings are counted (`_diverged`) instead of written to a file."""
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtra("mujoco", "mujoco") from error
    engine: Any = mujoco
    if engine.get_mju_user_warning() is None:
        engine.set_mju_user_warning(lambda text: None)
    return engine
