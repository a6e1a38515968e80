"""A hand of a compiled MuJoCo model as the text of a URDF, with its meshes as files."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.app.author.mjcf_hand import TIP, Drive, ModelHand, names_of, unused_name
from torchgrasp.app.author.repair import place
from torchgrasp.app.author.tendons import Mechanism
from torchgrasp.foundation.lazy import trimesh

FINENESS = 3  # subdivisions of an icosahedron that stands for an ellipsoid


class UrdfWriter:
    """Writes a hand of a compiled MuJoCo model as a URDF.

    Args:
        name: name of the robot.
        hand: the bodies and joints of the model that are the hand.
        mechanism: which of its joints lead, follow or stand still.
        drives: limits and effort of each joint, by its index in the model.
        folder: the folder to which meshes are written.
        visual: whether the meshes of geoms without collision are written, too.
    """

    def __init__(
        self,
        name: str,
        hand: ModelHand,
        mechanism: Mechanism,
        drives: dict[int, Drive],
        folder: Path,
        visual: bool,
    ) -> None:
        self.robot = ET.Element("robot", name=name)
        self.hand = hand
        self.model = hand.model
        self.mechanism = mechanism
        self.drives = drives
        self.folder = folder
        self.visual = visual
        self.links = set(hand.names)  # names of links that are taken
        # place [m] of each link's frame in its body
        self.offset = {0: np.zeros(3), hand.root: np.zeros(3)}

    def write(self, tips: Sequence[str]) -> str:
        """Return the hand as the text of a URDF; write its meshes to the folder.

        Sites of the hand become links if their names are among the `tips`, or contain "tip", in
        capitals or not.
        """
        for body in self.hand.bodies:
            self._add_body(body)
        self._add_sites(tips)
        ET.indent(self.robot)
        return ET.tostring(self.robot, encoding="unicode")

    def _add_body(self, body: int) -> None:
        """Add a body as a link, with the joints to its parent and a link between each two."""
        hand = self.hand
        model = self.model
        name = hand.names[body]
        own = hand.own_joints(body)
        if body != hand.root:
            # a link's frame is at its last joint
            last = np.asarray(model.jnt_pos[own[-1]], dtype=float) if own else np.zeros(3)
            self.offset[body] = last
        self._link(body)
        if body == hand.root:
            return
        parent = hand.names[hand.parents[body]]
        pose = _shift(-self.offset[hand.parents[body]])
        pose = pose @ _pose(model.body_pos[body], model.body_quat[body])
        before = np.zeros(3)
        for count, j in enumerate(own):
            child = name
            if count < len(own) - 1:
                child = unused_name(f"{name}_{hand.joint_names[j]}", self.links)
                ET.SubElement(self.robot, "link", name=child)
            at = np.asarray(model.jnt_pos[j], dtype=float)
            self._joint(j, parent, child, pose @ _shift(at - before))
            parent = child
            pose = np.eye(4)
            before = at
        if not own:
            self._connect(unused_name(f"{name}_fixed", set(hand.joint_names)), parent, name, pose)

    def _add_sites(self, tips: Sequence[str]) -> None:
        """Add the sites at fingertips, and those that `tips` name, as links."""
        model = self.model
        names = names_of(model, "site", model.nsite)
        for k, name in enumerate(names):
            body = int(model.site_bodyid[k])
            named = bool(model.site(k).name)
            wanted = name in tips or TIP in name.lower()
            if not (named and wanted and body in self.hand.bodies) or name in self.links:
                continue
            self.links.add(name)
            ET.SubElement(self.robot, "link", name=name)
            pose = _shift(-self.offset[body]) @ _pose(model.site_pos[k], model.site_quat[k])
            self._connect(f"{name}_site", self.hand.names[body], name, pose)

    def _connect(
        self, name: str, parent: str, child: str, pose: np.ndarray, kind: str = "fixed"
    ) -> ET.Element:
        """Add a joint without axis and limits, and return its element."""
        element = ET.SubElement(self.robot, "joint", name=name, type=kind)
        _origin(element, pose)
        ET.SubElement(element, "parent", link=parent)
        ET.SubElement(element, "child", link=child)
        return element

    def _joint(self, joint: int, parent: str, child: str, pose: np.ndarray) -> None:
        """Add a joint; `pose` is that of its frame in the parent at its reference."""
        model = self.model
        name = self.hand.joint_names[joint]
        still = self.mechanism.still
        axis = np.asarray(model.jnt_axis[joint], dtype=float)
        slides = self.hand.slides[joint]
        rest = float(model.qpos0[model.jnt_qposadr[joint]])
        if name in still:
            move = _move(slides, axis, still[name] - rest)
            self._connect(name, parent, child, pose @ move)
            return
        drive = self.drives[joint]
        kind = "prismatic" if slides else "revolute"
        bounds = {}
        if math.isfinite(drive.upper - drive.lower):
            bounds = {"lower": _number(drive.lower), "upper": _number(drive.upper)}
        elif not slides:
            kind = "continuous"
        element = self._connect(name, parent, child, pose @ _move(slides, axis, -rest), kind)
        ET.SubElement(element, "axis", xyz=_text(axis))
        limit = {"effort": _number(drive.effort), "velocity": "0"}
        ET.SubElement(element, "limit", limit | bounds)

    def _link(self, body: int) -> None:
        """Add the link of a body."""
        model = self.model
        offset = self.offset[body]
        link = ET.SubElement(self.robot, "link", name=self.hand.names[body])
        mass = float(model.body_mass[body]) if body else 0.0
        if mass > 0:
            turn = _pose(np.zeros(3), model.body_iquat[body])[:3, :3]
            inertia = turn @ np.diag(np.asarray(model.body_inertia[body], dtype=float)) @ turn.T
            element = ET.SubElement(link, "inertial")
            ET.SubElement(element, "origin", xyz=_text(model.body_ipos[body] - offset))
            ET.SubElement(element, "mass", value=_number(mass))
            rows = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2)}
            rows |= {"iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
            values = {key: _number(inertia[at]) for key, at in rows.items()}
            ET.SubElement(element, "inertia", values)
        paired = {*np.ravel(model.pair_geom1).tolist(), *np.ravel(model.pair_geom2).tolist()}
        geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
        for k in geoms if body or self.hand.on_world else ():
            touches = k in paired or bool(model.geom_contype[k]) or bool(model.geom_conaffinity[k])
            # a mesh that is only seen need not be written
            seen = touches or self.visual
            pose = _shift(-offset) @ _pose(model.geom_pos[k], model.geom_quat[k])
            for kind, sizes, at in self._shapes(k, seen):
                element = ET.SubElement(link, "collision" if touches else "visual")
                _origin(element, pose @ _shift(at))
                ET.SubElement(ET.SubElement(element, "geometry"), kind, sizes)

    def _shapes(self, geom: int, write: bool) -> list[tuple[str, dict[str, str], np.ndarray]]:
        """Return the URDF shapes of a geom: kind, sizes, and place [m] in the geom's frame.

        `write` says whether a mesh is written.
        """
        model = self.model
        kinds = self.hand.mujoco.mjtGeom
        kind = int(model.geom_type[geom])
        x, y, z = np.asarray(model.geom_size[geom], dtype=float).tolist()
        here = np.zeros(3)
        if kind == kinds.mjGEOM_BOX:
            return [("box", {"size": _text(np.array([2 * x, 2 * y, 2 * z]))}, here)]
        if kind == kinds.mjGEOM_SPHERE:
            return [("sphere", {"radius": _number(x)}, here)]
        if kind in (kinds.mjGEOM_CYLINDER, kinds.mjGEOM_CAPSULE):
            shapes = [("cylinder", {"radius": _number(x), "length": _number(2 * y)}, here)]
            if kind == kinds.mjGEOM_CAPSULE:
                for end in (-y, y):
                    shapes.append(("sphere", {"radius": _number(x)}, np.array([0.0, 0.0, end])))
            return shapes
        name = f"geom{geom}.stl"
        if kind == kinds.mjGEOM_ELLIPSOID:
            surface = trimesh.creation.icosphere(FINENESS)
            surface.apply_scale([x, y, z])
        elif kind == kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            name = f"mesh{mesh}.stl"
            corner = int(model.mesh_vertadr[mesh])
            face = int(model.mesh_faceadr[mesh])
            surface = trimesh.Trimesh(
                model.mesh_vert[corner : corner + int(model.mesh_vertnum[mesh])],
                model.mesh_face[face : face + int(model.mesh_facenum[mesh])],
                process=False,
            )
        else:
            called = model.geom(geom).name or f"of {self.hand.names[int(model.geom_bodyid[geom])]}"
            self.hand.told.append(f"geom {called}, a plane or a field, is left out")
            return []
        file = self.folder / name
        if write and not file.exists():
            surface.export(file)
        return [("mesh", {"filename": name}, here)]


def _pose(position: Any, quaternion: Any) -> np.ndarray:
    """Return the pose (4, 4) [m] of a position and a quaternion (w, x, y, z)."""
    pose = trimesh.transformations.quaternion_matrix(np.asarray(quaternion, dtype=float))
    pose[:3, 3] = position
    return pose


def _shift(by: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a translation [m]."""
    return trimesh.transformations.translation_matrix(by)


def _move(slides: bool, axis: np.ndarray, value: float) -> np.ndarray:
    """Return the pose (4, 4) that a joint makes at a value [rad or m]."""
    if slides:
        return _shift(value * axis)
    return np.asarray(trimesh.transformations.rotation_matrix(value, axis))


def _number(x: float) -> str:
    return repr(float(x))


def _text(numbers: Any) -> str:
    return " ".join(repr(x) for x in np.asarray(numbers, dtype=float).tolist())


def _origin(element: ET.Element, pose: np.ndarray) -> None:
    """Add the origin of a pose (4, 4) [m] to an element of a URDF."""
    xyz, rpy = place(pose)
    ET.SubElement(element, "origin", xyz=_text(xyz), rpy=_text(rpy))
