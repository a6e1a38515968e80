"""A scene as MJCF, MuJoCo's own format, with the solver's settings of the published protocols.

Joints have the same armature, drives and friction as in SAPIEN. Torsional friction is a length in MuJoCo: friction
times the radius of the contact patch. The hand feels neither gravity nor itself. The table is a plane, on which a flat
bottom gets several contacts. What leaves all bounds is not put back to its start, as MuJoCo does by default: what was
lost would count as held.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np

from torchgrasp.frames import rotation_from_rpy
from torchgrasp.hand.hand import Actuator
from torchgrasp.hand.urdf import Link, Urdf, read_urdf
from torchgrasp.sim.mount import MOUNT_DRIVE, mount_slides
from torchgrasp.sim.scene import ARMATURE, SceneSpec, check_drives

OBJECT, TABLE = "torchgrasp_object", "torchgrasp_table"
"""Names of the object (its body and the joint by which it floats) and of the table."""

HAND_BIT, OBJECT_BIT, TABLE_BIT = 1, 2, 4
"""What may collide: any two of these, but not the hand with itself."""

OPTION = {"integrator": "implicitfast", "cone": "elliptic", "impratio": "10", "noslip_iterations": "2"}
"""Of the solver, as in DexGraspBench (arXiv 2412.16490)."""

SOLREF, SOLIMP = "0.005 1", "0.5 0.99 0.0001"
"""Contacts are springs: their time constant [s] and damping ratio, and how they stiffen with depth, as there."""


def scene_mjcf(setup: SceneSpec) -> str:
    """Return a scene of table, object and hand with all joints at zero.

    Actuators are positional and named like their joints. The joints of the `mount_slides` carry the hand, `OBJECT` floats.

    Raises:
        BadArgument: a joint of the hand without a position or drive.
        HandFileError: the URDF is no sound one (`read_urdf`).
    """
    urdf = read_urdf(setup.urdf_path)
    movable = [joint.name for joint in urdf.joints if joint.kind != "fixed"]
    check_drives(setup, movable)
    root = ET.Element("mujoco", model="torchgrasp")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    option = ET.SubElement(root, "option", OPTION, timestep=repr(setup.timestep), gravity=f"0 0 {-setup.gravity!r}")
    ET.SubElement(option, "flag", multiccd="enable", autoreset="disable")
    default = ET.SubElement(root, "default")
    friction = format_numbers((setup.friction, setup.friction * setup.patch, 0.0))
    condim = "4" if setup.patch > 0 else "3"
    ET.SubElement(default, "geom", friction=friction, condim=condim, solref=SOLREF, solimp=SOLIMP)
    ET.SubElement(default, "joint", solreflimit=SOLREF)
    ET.SubElement(default, "mesh", inertia="shell")
    asset, world, actuator = (ET.SubElement(root, tag) for tag in ("asset", "worldbody", "actuator"))
    if setup.table:
        bits = _bits(TABLE_BIT, HAND_BIT)
        height = format_numbers((0.0, 0.0, float(setup.mesh.bounds[0, 2])))
        ET.SubElement(world, "geom", bits, name=TABLE, type="plane", size="1 1 0.1", pos=height)
    _add_object(asset, world, setup)
    _add_hand(world, setup, urdf)
    for name in movable:
        add_drive(actuator, name, setup.drives[name])
    for slide in mount_slides(setup):
        add_drive(actuator, slide.name, MOUNT_DRIVE)
    return ET.tostring(root, encoding="unicode")


def _add_object(asset: ET.Element, world: ET.Element, setup: SceneSpec) -> None:
    """Put the object where its mesh is; mass centre and inertia are those of the mesh, filled evenly."""
    body = ET.SubElement(world, "body", name=OBJECT)
    ET.SubElement(body, "freejoint", name=OBJECT)
    inertia = np.asarray(setup.mesh.moment_inertia) * (setup.mass / setup.mesh.volume)
    _weigh(body, setup.mass, setup.mesh.center_mass, inertia[np.triu_indices(3)])
    for k, part in enumerate(setup.parts):
        ET.SubElement(asset, "mesh", name=f"part_{k}", vertex=format_numbers(np.asarray(part.vertices, float).ravel()))
        ET.SubElement(body, "geom", _bits(OBJECT_BIT, HAND_BIT | TABLE_BIT), type="mesh", mesh=f"part_{k}")


def _add_hand(world: ET.Element, setup: SceneSpec, urdf: Urdf) -> None:
    """Hang the hand on the joints that carry it."""
    arm = world
    for slide in mount_slides(setup):
        arm = ET.SubElement(arm, "body", name=slide.name, gravcomp="1")
        _weigh(arm, 1.0, np.zeros(3), (0.01, 0.0, 0.0, 0.01, 0.0, 0.01))
        limits = {"axis": format_numbers(slide.axis), "range": format_numbers((slide.lower, slide.upper))}
        ET.SubElement(arm, "joint", limits, name=slide.name, type="slide")
    add_links(arm, urdf, setup.world_from_hand)


def add_links(parent: ET.Element, urdf: Urdf, parent_from_root: np.ndarray) -> ET.Element:
    """Add the tree of a hand to a body, link by link from its root, and return the root's body."""
    links = {link.name: link for link in urdf.links}
    root = _add_link(parent, links[urdf.root], parent_from_root[:3, 3], parent_from_root[:3, :3])
    bodies = {urdf.root: root}
    while len(bodies) < len(links):
        for joint in urdf.joints:
            if joint.parent in bodies and joint.child not in bodies:
                body = _add_link(bodies[joint.parent], links[joint.child], joint.xyz, _rotation(joint.rpy))
                bodies[joint.child] = body
                if joint.kind != "fixed":
                    kind = "slide" if joint.kind == "prismatic" else "hinge"
                    limits = {"axis": format_numbers(joint.axis), "range": format_numbers((joint.lower, joint.upper))}
                    ET.SubElement(body, "joint", limits, name=joint.name, type=kind, armature=repr(ARMATURE))
    return root


def _add_link(parent: ET.Element, link: Link, place: Iterable[float], turn: np.ndarray) -> ET.Element:
    """Add a link of the hand with its shapes."""
    body = ET.SubElement(parent, "body", _frame(place, turn), name=link.name, gravcomp="1")
    if link.mass > 0:
        _weigh(body, link.mass, link.com, link.inertia)
    for shape in link.shapes:
        halves = {"box": (0.5, 0.5, 0.5), "sphere": (1.0,), "cylinder": (1.0, 0.5)}[shape.kind]
        size = format_numbers(np.multiply(shape.size, halves))
        frame = _frame(shape.xyz, _rotation(shape.rpy))
        ET.SubElement(body, "geom", _bits(HAND_BIT, 0) | frame, type=shape.kind, size=size)
    return body


def add_drive(actuator: ET.Element, joint: str, drive: Actuator) -> None:
    """Let a motor hold a joint at its target: kp (target - q) - kd dq/dt, the effort at most."""
    gains = {"kp": repr(drive.kp), "kv": repr(drive.kd), "forcerange": format_numbers((-drive.effort, drive.effort))}
    ET.SubElement(actuator, "position", gains, name=joint, joint=joint)


def _weigh(body: ET.Element, mass: float, centre: Iterable[float], inertia: Iterable[float]) -> None:
    """Give a body its mass [kg], centre [m] and inertia (xx, xy, xz, yy, yz, zz) [kg m^2] in its own axes."""
    xx, xy, xz, yy, yz, zz = inertia
    tensor = format_numbers((xx, yy, zz, xy, xz, yz))
    ET.SubElement(body, "inertial", mass=repr(float(mass)), pos=format_numbers(centre), fullinertia=tensor)


def _bits(kind: int, others: int) -> dict[str, str]:
    """Return what a shape is and what it collides with."""
    return {"contype": str(kind), "conaffinity": str(others)}


def _frame(place: Iterable[float], turn: np.ndarray) -> dict[str, str]:
    """Return a pose as attributes: where it is, and where its first two axes point."""
    return {"pos": format_numbers(place), "xyaxes": format_numbers(turn[:, :2].T.ravel())}


def _rotation(rpy: tuple[float, float, float]) -> np.ndarray:
    """Return a URDF's rotation (3, 3)."""
    return rotation_from_rpy(rpy).numpy()


def format_numbers(numbers: Iterable[float]) -> str:
    """Return numbers as an attribute holds them, without loss."""
    return " ".join(repr(float(x)) for x in numbers)
