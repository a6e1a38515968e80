"""A simulated scene in MuJoCo, and its model in MJCF, MuJoCo's XML format."""

import copy
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.files import render
from torchgrasp.foundation.errors import HandFileError
from torchgrasp.foundation.lazy import import_extra
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand.urdf import Joint, Link, Urdf
from torchgrasp.sim.scene_spec import ARMATURE, MOUNT_DRIVE, SceneSpec, pair_masks
from torchgrasp.sim.simulated_scene import STILL, SimulatedScene

OBJECT = "torchgrasp_object"
NEIGHBOUR = "torchgrasp_neighbour_{}"
"""Names in the model: of the object (its body and its free joint), and of numbered neighbours."""


class MujocoScene(SimulatedScene):
    """A simulated scene in MuJoCo: table, object and hand.

    MuJoCo splits a timestep into `mj_step1` (from state to poses and contacts) and `mj_step2` (from
    forces to state). A step of this scene runs `mj_step2`, then the next `mj_step1`. So poses and
    contacts always belong to the present state.
    """

    def __init__(self, spec: SceneSpec) -> None:
        super().__init__(spec)
        self._mujoco = mujoco = import_mujoco()
        text = self._write(spec)
        try:
            self.model = model = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            found = f"{spec.urdf_path}: {error}"
            raise HandFileError("urdf", found, "a hand that MuJoCo can simulate") from error
        self.data = mujoco.MjData(model)
        self.body = model.body(OBJECT).id
        urdf = spec.urdf
        self.joint_names = tuple(joint.name for joint in urdf.joints if joint.kind != "fixed")
        self._positions = np.array([model.joint(name).qposadr[0] for name in self.joint_names])
        self._velocities = np.array([model.joint(name).dofadr[0] for name in self.joint_names])
        self.motors = np.array([model.actuator(name).id for name in self.joint_names])
        self.root = model.body(urdf.root).id
        self.tips = [model.body(name).id for name in spec.tip_links]
        self.neighbours = [model.body(NEIGHBOUR.format(k)).id for k in range(len(spec.neighbours))]
        self._body_of = model.geom_bodyid.tolist()
        self._wrench = np.zeros(6)
        parents = model.body_parentid.tolist()
        rigid = model.body_jntnum == 0
        self._map_contacts([0], (parents[tip] if rigid[tip] else None for tip in self.tips))
        self._begin()

    def _write(self, spec: SceneSpec) -> str:
        """Return the scene's model; a scene in which something else carries the hand returns
        another.
        """
        return scene_mjcf(spec)

    def _begin(self) -> None:
        """Set joints and mount to the start, with their targets."""
        data = self.data
        spec = self.spec
        data.qpos[self._positions] = [spec.joints[name] for name in self.joint_names]
        self.drive(data.qpos[self._positions])
        for slide in spec.slides:
            data.qpos[self.model.joint(slide.name).qposadr[0]] = slide.start
            self._move_mount(slide.name, slide.start, 0.0)
        self._mujoco.mj_step1(self.model, data)

    def _advance(self) -> Iterator[tuple[int, int, tuple[int, np.ndarray, np.ndarray]]]:
        """Advance by one timestep; yield each pair of bodies that touch, with number, axes and
        place of the contact.
        """
        if self._diverged():
            return
        self._mujoco.mj_step2(self.model, self.data)
        found = self.data.contact
        for k, (first, second) in enumerate(found.geom.tolist()):
            yield self._body_of[first], self._body_of[second], (k, found.frame[k], found.pos[k])
        self._mujoco.mj_step1(self.model, self.data)

    def skip(self, steps: int) -> None:
        """Advance the simulation by `steps` timesteps, without a report of contacts."""
        for _ in range(steps):
            if self._diverged():
                return
            self._mujoco.mj_step2(self.model, self.data)
            self._mujoco.mj_step1(self.model, self.data)

    def _diverged(self) -> bool:
        """Return whether the simulation has diverged; then positions are NaN."""
        diverged = any(self.data.warning.number[self._mujoco.mjtWarning.mjWARN_BADQPOS :].tolist())
        if diverged:
            self.data.qpos[:] = self.data.xpos[:] = np.nan
        return diverged

    def _read(
        self, contact: tuple[int, np.ndarray, np.ndarray], sign: float
    ) -> list[tuple[float, list[float]]]:
        """Return size and numbers of MuJoCo's contact point, as a list of one."""
        # The axes are in rows; the first points from the first body to the second.
        k, axes, place = contact
        wrench = self._wrench
        self._mujoco.mj_contactForce(self.model, self.data, k, wrench)
        size = max(float(wrench[0]), 0.0) * self.timestep
        force = (wrench[:3] @ axes.reshape(3, 3)).tolist()
        impulse = [sign * size * x for x in axes[:3].tolist()]
        moment = [size * x for x in place.tolist()]
        return [(size, [*impulse, *moment, size, *(sign * x for x in force)])]

    def keep(self) -> "Callable[[], MujocoScene]":
        """Return a function without arguments; each call returns a new copy of this scene as it is
        now.

        The copies share the MuJoCo model of this scene.
        """
        kept = copy.copy(self.data)

        def reopen() -> MujocoScene:
            scene = copy.copy(self)
            scene.data = copy.copy(kept)
            return scene

        return reopen

    def drive(self, targets: np.ndarray) -> None:
        """Set the target positions (j,) [rad or m] of the j driven joints.

        They are in the order of `joint_names`, and hold until the next call.
        """
        self.data.ctrl[self.motors] = targets

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force (3,) [N] at the object's centre of mass and a torque (3,) [N m].

        Both are in the world's frame, and act in all later steps until the next call.
        """
        self.data.xfrc_applied[self.body] = [*force, *torque]

    def displace(self, shift: np.ndarray) -> None:
        """Move the object at once by a displacement `shift` (3,) [m] in the world's frame."""
        start = self.model.joint(OBJECT).qposadr[0]
        self.data.qpos[start : start + 3] += shift
        self._mujoco.mj_step1(self.model, self.data)

    def joints(self) -> np.ndarray:
        """Return the positions (j,) [rad or m] of the j driven joints, in the order of
        `joint_names`.
        """
        return self.data.qpos[self._positions]

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the Jacobian (f, 3, j) [m/rad] of a point on each fingertip with respect to the j
        driven joints.

        Jacobian and `points` (f, 3) [m] are in the world's frame. Columns of joints that slide have
        no unit.
        """
        jacobian = np.zeros((len(self.tips), 3, self.model.nv))
        for rows, point, tip in zip(jacobian, points, self.tips, strict=True):
            self._mujoco.mj_jac(self.model, self.data, rows, None, point, tip)
        return jacobian[:, :, self._velocities]

    def penetration(self) -> float:
        """Return the largest depth [m] by which the hand now penetrates another body or itself; 0
        if it penetrates nothing.
        """
        deepest = 0.0
        found = self.data.contact
        for (first, second), distance in zip(found.geom, found.dist, strict=True):
            if not {self._body_of[first], self._body_of[second]} <= self._place_of.keys():
                deepest = max(deepest, -float(distance))
        return deepest

    def _pose(self, body: int) -> np.ndarray:
        """Return the pose (4, 4) of a body in the world's frame, given its index."""
        pose = np.zeros((4, 4))
        pose[:3, :3] = self.data.xmat[body].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[body]
        pose[3, 3] = 1.0
        return pose

    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint of the mount."""
        ahead = speed * MOUNT_DRIVE.kd / MOUNT_DRIVE.kp
        self.data.ctrl[self.model.actuator(joint).id] = target + ahead


def import_mujoco() -> Any:
    """Import and return the module `mujoco`; its warnings are then counted, not written to a file.

    Raises `MissingExtra` if MuJoCo is not installed.
    """
    engine = import_extra("mujoco", "mujoco", "mujoco")
    if engine.get_mju_user_warning() is None:
        engine.set_mju_user_warning(lambda text: None)
    return engine


def scene_mjcf(spec: SceneSpec) -> str:
    """Return the model of a scene in MJCF, MuJoCo's XML format, as text.

    All joints are at zero, and each has a position servo. Raises `BadArgument` for a joint without
    a start position or drive, and `HandFileError` for a malformed URDF.
    """
    spec.check_drives([joint.name for joint in spec.urdf.movable])
    names = [OBJECT, *(NEIGHBOUR.format(k) for k in range(len(spec.neighbours)))]
    bodies = list(zip(names, (spec.body, *spec.neighbours), spec.hulls, strict=True))
    masks = pair_masks(spec.self_pairs, first=3)  # three bits are of hand, bodies and table
    return render_mjcf(
        "scene.xml", spec=spec, bodies=bodies, masks=masks, nested=nest_links(spec.urdf)
    )


def render_mjcf(template: str, **values: Any) -> str:
    """Return a model in MJCF (MuJoCo's XML format), as text: a Jinja template filled with `values`.

    `template` is the file's name in `torchgrasp/sim/templates`, without ".jinja". `values` are the
    template's variables by name. Numbers are written without loss of precision.
    """
    filters = {
        "numbers": format_numbers,
        "rotation": lambda rpy: rotation_from_rpy(rpy).numpy(),
        "axes": lambda rotation: rotation[:3, :2].T.ravel(),
    }
    path = Path(__file__).parent / "templates" / f"{template}.jinja"
    return render(path, filters, **values, armature=ARMATURE, mount=MOUNT_DRIVE)


def nest_links(urdf: Urdf) -> list[tuple[Link, Joint | None, int]]:
    """Return (link, joint, ends) for each link of a URDF, in depth-first order from the root.

    In this order, each link's XML element is nested in that of its parent. `joint` connects the
    link to its parent; it is None for the root. `ends` is the number of XML elements to close after
    the link.
    """
    links = {link.name: link for link in urdf.links}
    waiting = [(0, urdf.root, None)]
    found: list[tuple[int, str, Joint | None]] = []
    while waiting:
        found.append(waiting.pop())
        depth, name, _ = found[-1]
        ahead = [joint for joint in reversed(urdf.joints) if joint.parent == name]
        waiting += [(depth + 1, joint.child, joint) for joint in ahead]
    depths = [*(depth for depth, _, _ in found[1:]), 0]
    return [
        (links[name], joint, depth - after + 1)
        for (depth, name, joint), after in zip(found, depths, strict=True)
    ]


def format_numbers(numbers: Iterable[float | int]) -> str:
    """Return numbers as the text of an XML attribute, separated by spaces, without loss of
    precision.
    """
    return " ".join(repr(float(x)) for x in numbers)
