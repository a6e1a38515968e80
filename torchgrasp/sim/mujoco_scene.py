"""A simulated scene in MuJoCo, and its model in MJCF, MuJoCo's XML format."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from torchgrasp.errors import HandFileError, MissingExtra
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand.hand import Actuator
from torchgrasp.hand.urdf import Link, Urdf
from torchgrasp.sim.scene import STILL, Scene
from torchgrasp.sim.scene_spec import ARMATURE, MOUNT_DRIVE, Body, SceneSpec, pair_masks

OBJECT, TABLE, NEIGHBOUR = "torchgrasp_object", "torchgrasp_table", "torchgrasp_neighbour_{}"
"""Names of the object (its body and its free joint), of the table, and of the neighbours, which are numbered."""
HAND_BIT, OBJECT_BIT, TABLE_BIT, FREE_BIT = 1, 2, 4, 3
"""Bits of three collision groups, which all collide except the hand with itself; number of the first bit after them."""
OPTION = {"integrator": "implicitfast", "cone": "elliptic", "impratio": "10", "noslip_iterations": "2"}
"""Options of MuJoCo's solver, from DexGraspBench (arXiv 2412.16490)."""
SOLREF, SOLIMP = "0.005 1", "0.5 0.99 0.0001"
"""Contact springs: time constant [s] and damping ratio, and impedance over depth, as in DexGraspBench."""


class MujocoScene(Scene):
    """A simulated scene in MuJoCo: table, object and hand.

    A step runs the second half of MuJoCo's step (forces to state) before its first half (state to poses and contacts),
    so that poses are current between steps.
    """

    def __init__(self, spec: SceneSpec) -> None:
        super().__init__(spec)
        self._mujoco = mujoco = import_mujoco()
        text = self._write(spec)
        try:
            self.model = model = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            raise HandFileError("urdf", f"{spec.urdf_path}: {error}", "a hand that MuJoCo can simulate") from error
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
        self._body_of, self._wrench = model.geom_bodyid.tolist(), np.zeros(6)
        parents = model.body_parentid.tolist()
        self._map_contacts([0], (parents[tip] if model.body_jntnum[tip] == 0 else None for tip in self.tips))
        self._begin()

    def _write(self, spec: SceneSpec) -> str:
        """Return the scene's model; a scene in which something else carries the hand returns another."""
        return scene_mjcf(spec)

    def _begin(self) -> None:
        """Set joints and mount to the start, with their targets."""
        data, spec = self.data, self.spec
        data.qpos[self._positions] = [spec.joints[name] for name in self.joint_names]
        self.drive(data.qpos[self._positions])
        for slide in spec.slides:
            data.qpos[self.model.joint(slide.name).qposadr[0]] = slide.start
            self._move_mount(slide.name, slide.start, 0.0)
        self._mujoco.mj_step1(self.model, data)

    def restart(self, spec: SceneSpec) -> None:
        """Change to the start of another scene, which differs in joints and pose of the hand alone."""
        self.spec, model, pose = spec, self.model, spec.world_from_hand
        model.body_pos[self.root] = pose[:3, 3]
        self._mujoco.mju_mat2Quat(model.body_quat[self.root], pose[:3, :3].ravel())
        self._mujoco.mj_setConst(model, self.data)
        self._mujoco.mj_resetData(model, self.data)
        self._begin()

    def _advance(self) -> Iterator[tuple[int, int, tuple[int, np.ndarray, np.ndarray]]]:
        """Advance by one timestep; yield each pair of bodies that touch, with number, axes and place of the contact."""
        if self._diverged():
            return
        self._mujoco.mj_step2(self.model, self.data)
        found = self.data.contact
        for k, (first, second) in enumerate(found.geom.tolist()):
            yield self._body_of[first], self._body_of[second], (k, found.frame[k], found.pos[k])
        self._mujoco.mj_step1(self.model, self.data)

    def skip(self, steps: int) -> None:
        """Advance by a number of timesteps, of whose contacts nobody asks."""
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

    def _read(self, contact: tuple[int, np.ndarray, np.ndarray], sign: float) -> list[tuple[float, list[float]]]:
        """Return size and numbers of MuJoCo's contact point, as a list of one."""
        k, axes, place = contact  # the axes in rows; the first points from the first body to the second
        wrench = self._wrench
        self._mujoco.mj_contactForce(self.model, self.data, k, wrench)
        size = max(float(wrench[0]), 0.0) * self.timestep
        force = (wrench[:3] @ axes.reshape(3, 3)).tolist()
        impulse, moment = [sign * size * x for x in axes[:3].tolist()], [size * x for x in place.tolist()]
        return [(size, [*impulse, *moment, size, *(sign * x for x in force)])]

    def keep(self) -> "Callable[[], MujocoScene]":
        """Return a function that opens scenes in the present state of this one; they share its model."""
        kept = copy.copy(self.data)

        def reopen() -> MujocoScene:
            scene = copy.copy(self)
            scene.data = copy.copy(kept)
            return scene

        return reopen

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""
        self.data.ctrl[self.motors] = targets

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force [N] and a torque [N m] to the object, in this and all later steps."""
        self.data.xfrc_applied[self.body] = [*force, *torque]

    def displace(self, shift: np.ndarray) -> None:
        """Move the object by a displacement (3,) [m]."""
        start = self.model.joint(OBJECT).qposadr[0]
        self.data.qpos[start : start + 3] += shift
        self._mujoco.mj_step1(self.model, self.data)

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""
        return self.data.qpos[self._positions]

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the Jacobian (f, 3, j) [m/rad] of one point (world's frame) per fingertip for the driven joints."""
        jacobian = np.zeros((len(self.tips), 3, self.model.nv))
        for rows, point, tip in zip(jacobian, points, self.tips, strict=True):
            self._mujoco.mj_jac(self.model, self.data, rows, None, point, tip)
        return jacobian[:, :, self._velocities]

    def penetration(self) -> float:
        """Return the largest depth [m] by which the hand penetrates another body or itself."""
        deepest = 0.0
        for (first, second), distance in zip(self.data.contact.geom, self.data.contact.dist, strict=True):
            if not {self._body_of[first], self._body_of[second]} <= self._place_of.keys():
                deepest = max(deepest, -float(distance))
        return deepest

    def _pose(self, body: int) -> np.ndarray:
        """Return the pose (4, 4) of a body in the world's frame, given its index."""
        pose = np.zeros((4, 4))
        pose[:3, :3], pose[:3, 3], pose[3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body], 1.0
        return pose

    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint of the mount."""
        self.data.ctrl[self.model.actuator(joint).id] = target + speed * MOUNT_DRIVE.kd / MOUNT_DRIVE.kp


def import_mujoco() -> Any:
    """Import and return MuJoCo; its warnings are no longer written to a file, only counted."""
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtra("mujoco", "mujoco") from error
    engine: Any = mujoco
    if engine.get_mju_user_warning() is None:
        engine.set_mju_user_warning(lambda text: None)
    return engine


def scene_mjcf(spec: SceneSpec) -> str:
    """Return MuJoCo's XML model of a scene (MJCF), with all joints at zero and a position servo for each joint."""
    urdf = spec.urdf
    movable = [joint.name for joint in urdf.joints if joint.kind != "fixed"]
    spec.check_drives(movable)
    root = ET.Element("mujoco", model="torchgrasp")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    option = ET.SubElement(root, "option", OPTION, timestep=repr(spec.timestep), gravity=f"0 0 {-spec.gravity!r}")
    ET.SubElement(option, "flag", multiccd="enable", autoreset="disable")
    default = ET.SubElement(root, "default")
    friction, slick = (format_numbers((x, x * spec.patch, 0.0)) for x in (spec.friction, spec.body_friction))
    condim = "4" if spec.patch > 0 else "3"
    ET.SubElement(default, "geom", friction=friction, condim=condim, solref=SOLREF, solimp=SOLIMP)
    ET.SubElement(default, "joint", solreflimit=SOLREF)
    ET.SubElement(default, "mesh", inertia="shell")
    asset, world, actuator = (ET.SubElement(root, tag) for tag in ("asset", "worldbody", "actuator"))
    if spec.table:
        bits = _bits(TABLE_BIT, HAND_BIT)
        height = format_numbers((0.0, 0.0, spec.table_height))
        ET.SubElement(world, "geom", bits, name=TABLE, type="plane", size="1 1 0.1", pos=height, friction=slick)
    for k, (body, hulls) in enumerate(zip((spec.body, *spec.neighbours), spec.hulls, strict=True)):
        name, hits = (NEIGHBOUR.format(k - 1), OBJECT_BIT) if k else (OBJECT, 0)
        _add_body(asset, world, name, body, hulls, _bits(OBJECT_BIT, HAND_BIT | TABLE_BIT | hits), slick)
    mount = world
    for slide in spec.slides:
        mount = ET.SubElement(mount, "body", name=slide.name, gravcomp="1")
        _weigh(mount, 1.0, np.zeros(3), (0.01, 0.0, 0.0, 0.01, 0.0, 0.01))
        limits = {"axis": format_numbers(slide.axis), "range": format_numbers((slide.lower, slide.upper))}
        ET.SubElement(mount, "joint", limits, name=slide.name, type="slide")
    add_links(mount, urdf, spec.world_from_hand, pair_masks(spec.self_pairs, FREE_BIT))
    for name in movable:
        add_drive(actuator, name, spec.drives[name])
    for slide in spec.slides:
        add_drive(actuator, slide.name, MOUNT_DRIVE)
    return ET.tostring(root, encoding="unicode")


def _add_body(
    asset: ET.Element, world: ET.Element, name: str, spec: Body, hulls: list[np.ndarray], bits: Mapping[str, str],
    friction: str,
) -> None:  # fmt: skip
    """Add a free body of uniform density, made of convex hulls; `bits` are those of its collision groups.

    A contact has the larger friction of its two bodies, so that a slick body sticks to the hand but not to the table.
    """
    body = ET.SubElement(world, "body", name=name)
    ET.SubElement(body, "freejoint", name=name)
    _weigh(body, spec.mass, spec.mesh.center_mass, spec.inertia[np.triu_indices(3)])
    for k, vertices in enumerate(hulls):
        ET.SubElement(asset, "mesh", name=f"{name}_{k}", vertex=format_numbers(vertices.ravel()))
        ET.SubElement(body, "geom", dict(bits), type="mesh", mesh=f"{name}_{k}", friction=friction)


def add_links(
    parent: ET.Element, urdf: Urdf, parent_from_root: np.ndarray, masks: Mapping[str, tuple[int, int]] | None = None
) -> ET.Element:
    """Add the links of a hand to a body; return the root's body. `masks` come from `pair_masks`."""
    masks = masks or {}
    links = {link.name: link for link in urdf.links}
    root = _add_link(parent, links[urdf.root], parent_from_root[:3, 3], parent_from_root[:3, :3], masks)
    bodies = {urdf.root: root}
    while len(bodies) < len(links):
        for joint in urdf.joints:
            if joint.parent in bodies and joint.child not in bodies:
                body = _add_link(bodies[joint.parent], links[joint.child], joint.xyz, _rotation(joint.rpy), masks)
                bodies[joint.child] = body
                if joint.kind != "fixed":
                    kind = "slide" if joint.kind == "prismatic" else "hinge"
                    limits = {"axis": format_numbers(joint.axis), "range": format_numbers((joint.lower, joint.upper))}
                    ET.SubElement(body, "joint", limits, name=joint.name, type=kind, armature=repr(ARMATURE))
    return root


def _add_link(
    parent: ET.Element, link: Link, place: Iterable[float], rotation: np.ndarray, masks: Mapping[str, tuple[int, int]]
) -> ET.Element:
    """Add a link of the hand, with its collision shapes, to the body of its parent; return the link's body."""
    body = ET.SubElement(parent, "body", _frame(place, rotation), name=link.name, gravcomp="1")
    if link.mass > 0:
        _weigh(body, link.mass, link.com, link.inertia)
    kind, hits = masks.get(link.name, (0, 0))
    for shape in link.shapes:
        halves = {"box": (0.5, 0.5, 0.5), "sphere": (1.0,), "cylinder": (1.0, 0.5)}[shape.kind]
        size = format_numbers(np.multiply(shape.size, halves))
        frame = _frame(shape.xyz, _rotation(shape.rpy))
        ET.SubElement(body, "geom", _bits(HAND_BIT | kind, hits) | frame, type=shape.kind, size=size)
    return body


def add_drive(actuator: ET.Element, joint: str, drive: Actuator) -> None:
    """Add a position servo to a joint of position q: torque kp (target - q) - kd dq/dt, at most the drive's effort."""
    gains = {"kp": repr(drive.kp), "kv": repr(drive.kd), "forcerange": format_numbers((-drive.effort, drive.effort))}
    ET.SubElement(actuator, "position", gains, name=joint, joint=joint)


def _weigh(body: ET.Element, mass: float, centre: Iterable[float], inertia: Iterable[float]) -> None:
    """Set a body's mass [kg], centre of mass [m] and inertia (xx, xy, xz, yy, yz, zz) [kg m^2]."""
    xx, xy, xz, yy, yz, zz = inertia
    tensor = format_numbers((xx, yy, zz, xy, xz, yz))
    ET.SubElement(body, "inertial", mass=repr(float(mass)), pos=format_numbers(centre), fullinertia=tensor)


def _bits(kind: int, others: int) -> dict[str, str]:
    """Return MJCF attributes of a shape: the bit of its collision group, and the bits of groups it collides with."""
    return {"contype": str(kind), "conaffinity": str(others)}


def _frame(place: Iterable[float], rotation: np.ndarray) -> dict[str, str]:
    """Return a pose as MJCF attributes: the position [m], and the first two axes of the rotation matrix."""
    return {"pos": format_numbers(place), "xyaxes": format_numbers(rotation[:, :2].T.ravel())}


def _rotation(rpy: tuple[float, float, float]) -> np.ndarray:
    """Return the rotation matrix (3, 3) of roll, pitch and yaw [rad]."""
    return rotation_from_rpy(rpy).numpy()


def format_numbers(numbers: Iterable[float]) -> str:
    """Return numbers as the text of an XML attribute, without loss of precision."""
    return " ".join(repr(float(x)) for x in numbers)
