"""A scene that MuJoCo simulates."""

from typing import Any

import numpy as np

from torchgrasp.errors import HandFileError, MissingExtra
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.sim.mjcf import OBJECT, TABLE, scene_mjcf
from torchgrasp.sim.mount import APPROACH_JOINT, LIFT_JOINT, MOUNT_DRIVE, mount_slides
from torchgrasp.sim.scene import STILL, SceneSpec, StepContacts


class MujocoScene:
    """Table, object and hand in one MuJoCo model (`Scene`).

    A step is MuJoCo's second half, from forces to the new state, and then its first, which finds that state's places
    and contacts: so what is asked between steps is current.
    """

    def __init__(self, setup: SceneSpec) -> None:
        self._mujoco = mujoco = _import_mujoco()
        self.timestep, self.centre = setup.timestep, np.asarray(setup.mesh.center_mass, float)
        text = scene_mjcf(setup)
        try:
            self.model = model = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            raise HandFileError("urdf", f"{setup.urdf_path}: {error}", "a hand that MuJoCo can simulate") from error
        self.data = data = mujoco.MjData(model)
        self._object = model.body(OBJECT).id
        urdf = read_urdf(setup.urdf_path)
        self.joint_names = tuple(joint.name for joint in urdf.joints if joint.kind != "fixed")
        self._places = np.array([model.joint(name).qposadr[0] for name in self.joint_names])
        self._speeds = np.array([model.joint(name).dofadr[0] for name in self.joint_names])
        self._motors = np.array([model.actuator(name).id for name in self.joint_names])
        self._root = model.body(urdf.root).id
        self._tips = [model.body(name).id for name in setup.tip_links]
        self._map_contacts(setup.table)
        data.qpos[self._places] = [setup.joints[name] for name in self.joint_names]
        self.drive(data.qpos[self._places])
        for slide in mount_slides(setup):
            data.qpos[model.joint(slide.name).qposadr[0]] = slide.start
            self._carry(slide.name, slide.start, 0.0)
        mujoco.mj_step1(model, data)

    def _map_contacts(self, table: bool) -> None:
        """Remember which body each shape belongs to, and which finger a body: its tip, and what that is fixed to."""
        model = self.model
        self._body_of = model.geom_bodyid.tolist()
        self._table = model.geom(TABLE).id if table else -1
        self._finger_of = {body: i for i, body in enumerate(self._tips)}
        for i, tip in enumerate(self._tips):
            if model.body_jntnum[tip] == 0:
                self._finger_of.setdefault(int(model.body_parentid[tip]), i)

    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""
        impulse, moment, weight = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
        finger, force = np.zeros(3, dtype=bool), np.zeros((3, 3))
        if self._broken():
            return StepContacts(impulse, moment, weight, finger, force)
        self._mujoco.mj_step2(self.model, self.data)
        wrench, contacts = np.zeros(6), self.data.contact
        for k, (first, second) in enumerate(contacts.geom.tolist()):
            first, second = self._body_of[first], self._body_of[second]
            if first == self._object:
                link, sign = second, -1.0
            elif second == self._object:
                link, sign = first, 1.0
            else:
                continue
            which = self._finger_of.get(link)
            if which is None:
                continue
            self._mujoco.mj_contactForce(self.model, self.data, k, wrench)
            if wrench[0] > 0.0:
                finger[which] = True
                if link == self._tips[which]:
                    axes = contacts.frame[k].reshape(3, 3)  # in rows; the first from the first body to the second
                    size = float(wrench[0]) * self.timestep
                    impulse[which] += sign * size * axes[0]
                    moment[which] += size * contacts.pos[k]
                    weight[which] += size
                    force[which] += sign * (wrench[:3] @ axes)
        self._mujoco.mj_step1(self.model, self.data)
        return StepContacts(impulse, moment, weight, finger, force)

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""
        self.data.ctrl[self._motors] = targets

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Let a force [N] at the object's mass centre and a torque [N m] act on it from now on."""
        self.data.xfrc_applied[self._object] = [*force, *torque]

    def lift(self, height: float, speed: float = 0.0) -> None:
        """Set the height [m] that the hand is to be lifted to, and the speed [m/s] at which that target moves."""
        self._carry(LIFT_JOINT, height, speed)

    def approach(self, left: float, speed: float = 0.0) -> None:
        """Set what is to be left [m] of the hand's approach, and the speed [m/s] at which it goes on."""
        self._carry(APPROACH_JOINT, -left, speed)

    def _carry(self, name: str, target: float, speed: float) -> None:
        """Set the target [m] of a joint of the carriage, and the speed [m/s] at which it moves."""
        motor = self.model.actuator(name).id
        self.data.ctrl[motor] = target + speed * MOUNT_DRIVE.kd / MOUNT_DRIVE.kp

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""
        return self.data.qpos[self._places]

    def object_pose(self) -> np.ndarray:
        """Return the object's pose (4, 4)."""
        return self._pose(self._object)

    def hand_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the hand's root link."""
        return self._pose(self._root)

    def tip_poses(self) -> np.ndarray:
        """Return the poses (3, 4, 4) of the fingertips' links."""
        return np.stack([self._pose(tip) for tip in self._tips])

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d points / d driven joints (3, 3, j), each point fixed to its fingertip [m/rad or 1]."""
        found = np.zeros((3, 3, self.model.nv))
        for row, point, tip in zip(found, points, self._tips, strict=True):
            self._mujoco.mj_jac(self.model, self.data, row, None, point, tip)
        return found[:, :, self._speeds]

    def penetration(self) -> float:
        """Return how deep [m] the hand is in the object or the table."""
        deepest = 0.0
        for (first, second), distance in zip(self.data.contact.geom, self.data.contact.dist, strict=True):
            if self._table not in (first, second) or self._object not in (self._body_of[first], self._body_of[second]):
                deepest = max(deepest, -float(distance))
        return deepest

    def _broken(self) -> bool:
        """Tell whether numbers have left all bounds; nothing moves from then on, and every pose is NaN."""
        if self.data.warning.number[self._mujoco.mjtWarning.mjWARN_BADQPOS :].any():
            self.data.qpos[:] = self.data.xpos[:] = np.nan
            return True
        return False

    def _pose(self, body: int) -> np.ndarray:
        """Return a body's pose (4, 4) in the world."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return pose


def _import_mujoco() -> Any:
    """Import MuJoCo; its warnings are counted (`_broken`), not written to a file in the working folder."""
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtra("mujoco", "mujoco") from error
    engine: Any = mujoco
    if engine.get_mju_user_warning() is None:
        engine.set_mju_user_warning(lambda text: None)
    return engine
