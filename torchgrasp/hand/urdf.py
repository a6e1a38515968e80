"""A URDF as values: links, joints and shapes of a checked tree; no file but the URDF itself is opened."""

import dataclasses
import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

from torchgrasp.errors import HandFileError
from torchgrasp.hand.safe_xml import parse_urdf

MAX_BYTES = 4 * 1024 * 1024
MAX_LINKS = 512
NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
KINDS = ("revolute", "prismatic", "fixed")

Triple = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Shape:
    """A collision shape: `size` is (x, y, z) of a box, (radius,) of a sphere, (radius, length) of a cylinder [m]."""

    kind: str
    size: tuple[float, ...]
    xyz: Triple
    rpy: Triple


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid body: mass [kg], centre [m], inertia about the centre (xx, xy, xz, yy, yz, zz) [kg m2] and shapes."""

    name: str
    mass: float
    com: Triple
    inertia: tuple[float, ...]
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint of the tree; `mimic` is (source, multiplier, offset) or None."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Triple
    rpy: Triple
    axis: Triple
    lower: float
    upper: float
    effort: float
    velocity: float
    mimic: tuple[str, float, float] | None


@dataclasses.dataclass(frozen=True)
class Urdf:
    """A checked URDF: one root, every other link the child of exactly one joint, finite numbers throughout."""

    path: Path
    name: str
    root: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    data: bytes

    def joints_above(self, link: str) -> tuple[Joint, ...]:
        """Return the joints between a link and the root, fixed ones included, those nearest to the link first."""
        above, chain = {j.child: j for j in self.joints}, []
        while link in above:
            chain.append(above[link])
            link = above[link].parent
        return tuple(chain)

    def kinematic_xml(self) -> bytes:
        """Write the tree alone (links and joints, nothing unknown), as bytes without an encoding declaration."""
        robot = ET.Element("robot", name=self.name)
        for link in self.links:
            ET.SubElement(robot, "link", name=link.name)
        for j in self.joints:
            joint = ET.SubElement(robot, "joint", name=j.name, type=j.kind)
            ET.SubElement(joint, "origin", xyz=" ".join(map(repr, j.xyz)), rpy=" ".join(map(repr, j.rpy)))
            ET.SubElement(joint, "parent", link=j.parent)
            ET.SubElement(joint, "child", link=j.child)
            if j.kind != "fixed":
                ET.SubElement(joint, "axis", xyz=" ".join(map(repr, j.axis)))
                limits = {"lower": j.lower, "upper": j.upper, "effort": j.effort, "velocity": j.velocity}
                ET.SubElement(joint, "limit", {k: repr(v) for k, v in limits.items()})
        return ET.tostring(robot)


def read_urdf(path: Path | str) -> Urdf:
    """Read and check a URDF file; meshes it names are neither opened nor allowed outside the file's folder.

    Args:
        path: a UTF-8 file of at most 4 MiB and 512 links, without a document type declaration.

    Raises:
        HandFileError: with the file, what was found and what is allowed.
    """
    path = Path(path)
    if not path.is_file():
        raise HandFileError("urdf", f"{path}, which is no file", "a URDF file")
    if path.stat().st_size > MAX_BYTES:
        raise HandFileError("urdf", f"{path}: {path.stat().st_size} bytes", f"at most {MAX_BYTES} bytes")
    data = path.read_bytes()
    robot = parse_urdf(path, data)
    links = tuple(_link(path, e) for e in robot if e.tag == "link")
    joints = tuple(_joint(path, e) for e in robot if e.tag == "joint")
    root = _check_tree(path, links, joints)
    return Urdf(path, robot.get("name", ""), root, links, joints, data)


def _numbers(path: Path, where: str, text: str | None, default: tuple[float, ...] | None, n: int) -> Any:
    """Read n finite numbers from an attribute."""
    if text is None and default is not None:
        return default
    words = (text or "").split()
    # Python alone reads 1_0, other digits than ASCII's, and nan
    values = tuple(float(word) for word in words if NUMBER.fullmatch(word))
    if len(words) != n or len(values) != n or not all(math.isfinite(v) for v in values):
        raise HandFileError("urdf", f"{path}: {where} {(text or 'nothing')[:80]!r}", f"{n} finite number(s)")
    return values


def _name(path: Path, element: ET.Element | None, attribute: str, where: str) -> str:
    """Read a name that must be there."""
    name = "" if element is None else element.get(attribute, "")
    if not 0 < len(name) <= 200:
        raise HandFileError("urdf", f"{path}: {where} without a name", f"a {attribute} of 1 to 200 letters")
    return name


def _origin(path: Path, where: str, element: ET.Element) -> tuple[Triple, Triple]:
    """Read an element's origin; none means the identity."""
    origin = element.find("origin")
    found = {} if origin is None else origin.attrib
    zero = (0.0, 0.0, 0.0)
    xyz = _numbers(path, f"{where} origin xyz", found.get("xyz"), zero, 3)
    return xyz, _numbers(path, f"{where} origin rpy", found.get("rpy"), zero, 3)


def _link(path: Path, element: ET.Element) -> Link:
    """Read a link with its inertia and its collision shapes."""
    name = _name(path, element, "name", "a link")
    mass, com, inertia = 0.0, (0.0, 0.0, 0.0), (0.0,) * 6
    inertial = element.find("inertial")
    if inertial is not None:
        where = f"link {name} inertial"
        com, turn = _origin(path, where, inertial)
        if any(turn):
            raise HandFileError("urdf", f"{path}: {where} rpy {turn}", "an inertia in the axes of the link")
        weight, tensor = inertial.find("mass"), inertial.find("inertia")
        mass = _numbers(path, f"{where} mass", None if weight is None else weight.get("value"), None, 1)[0]
        found = {} if tensor is None else tensor.attrib
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        inertia = tuple(_numbers(path, f"{where} {k}", found.get(k), None, 1)[0] for k in keys)
    return Link(name, mass, com, inertia, tuple(_shape(path, name, c) for c in element.findall("collision")))


def _shape(path: Path, link: str, collision: ET.Element) -> Shape:
    """Read one collision shape; a mesh is refused, because neither the planner nor the simulator would see it."""
    where = f"link {link} collision"
    xyz, rpy = _origin(path, where, collision)
    geometry = collision.find("geometry")
    if geometry is None or len(geometry) != 1:
        raise HandFileError("urdf", f"{path}: {where} without one geometry", "box, cylinder or sphere")
    g = geometry[0]
    if g.tag == "box":
        size = _numbers(path, where, g.get("size"), None, 3)
    elif g.tag == "sphere":
        size = _numbers(path, where, g.get("radius"), None, 1)
    elif g.tag == "cylinder":
        size = tuple(_numbers(path, where, g.get(k), None, 1)[0] for k in ("radius", "length"))
    else:
        raise HandFileError("urdf", f"{path}: {where} <{g.tag}>", "box, cylinder or sphere")
    if min(size) <= 0:
        raise HandFileError("urdf", f"{path}: {where} of size {size}", "positive lengths")
    return Shape(g.tag, size, xyz, rpy)


def _joint(path: Path, element: ET.Element) -> Joint:
    """Read a joint; a movable one needs an axis of non-zero length and finite limits in order."""
    name = _name(path, element, "name", "a joint")
    where = f"joint {name}"
    kind = element.get("type", "")
    if kind not in KINDS:
        raise HandFileError("urdf", f"{path}: {where} of type {kind!r}", f"one of {KINDS}")
    parent = _name(path, element.find("parent"), "link", f"{where}: a parent")
    child = _name(path, element.find("child"), "link", f"{where}: a child")
    xyz, rpy = _origin(path, where, element)
    if kind == "fixed":
        return Joint(name, kind, parent, child, xyz, rpy, (1.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, None)
    axis_element, limit = element.find("axis"), element.find("limit")
    text = None if axis_element is None else axis_element.get("xyz")
    axis = _numbers(path, f"{where} axis", text, (1.0, 0.0, 0.0), 3)
    length = math.sqrt(sum(a * a for a in axis))
    if not 0.999 < length < 1.001:  # a longer axis has been used to hide a ratio, which readers then lose
        raise HandFileError("urdf", f"{path}: {where} axis of length {length:g}", "a unit axis")
    axis = (axis[0] / length, axis[1] / length, axis[2] / length)
    found = {} if limit is None else limit.attrib
    lower, upper = (_numbers(path, f"{where} {k} limit", found.get(k), None, 1)[0] for k in ("lower", "upper"))
    if not lower < upper:
        raise HandFileError("urdf", f"{path}: {where} limits {lower}, {upper}", "lower < upper")
    effort, velocity = (_numbers(path, f"{where} {k}", found.get(k), (0.0,), 1)[0] for k in ("effort", "velocity"))
    mimic, follow = None, element.find("mimic")
    if follow is not None:
        source = _name(path, follow, "joint", f"{where}: a mimic")
        ratio = _numbers(path, f"{where} multiplier", follow.get("multiplier"), (1.0,), 1)[0]
        mimic = (source, ratio, _numbers(path, f"{where} offset", follow.get("offset"), (0.0,), 1)[0])
    return Joint(name, kind, parent, child, xyz, rpy, axis, lower, upper, effort, velocity, mimic)


def _check_tree(path: Path, links: tuple[Link, ...], joints: tuple[Joint, ...]) -> str:
    """Return the root of a tree in which every link is reached exactly once."""
    names = [x.name for x in links]
    known = set(names)
    if not 0 < len(links) <= MAX_LINKS:
        raise HandFileError("urdf", f"{path}: {len(links)} links", f"1 to {MAX_LINKS} links")
    for what, found in (("link", names), ("joint", [j.name for j in joints]), ("child", [j.child for j in joints])):
        twice = sorted(n for n, times in Counter(found).items() if times > 1)
        if twice:
            raise HandFileError("urdf", f"{path}: {what} {twice[0]!r} twice", f"every {what} once")
    for j in joints:
        for link in (j.parent, j.child):
            if link not in known:
                raise HandFileError("urdf", f"{path}: joint {j.name} names link {link!r}", "a link of the file")
    roots = sorted(known - {j.child for j in joints})
    if len(roots) != 1:
        found = f"roots {roots}" if roots else "a cycle and no root"
        raise HandFileError("urdf", f"{path}: {found}", "exactly one root link")
    reached, front = {roots[0]}, [roots[0]]
    while front:
        front = [j.child for j in joints if j.parent in front]
        reached |= set(front)
    if len(reached) < len(names):
        raise HandFileError("urdf", f"{path}: a cycle around {sorted(known - reached)[0]!r}", "a tree")
    by_name = {j.name: j for j in joints}
    for j in joints:
        if j.mimic is not None and (j.mimic[0] not in by_name or by_name[j.mimic[0]].kind == "fixed"):
            raise HandFileError("urdf", f"{path}: joint {j.name} mimics {j.mimic[0]!r}", "a movable joint of the file")
        if j.mimic is not None and by_name[j.mimic[0]].mimic is not None:
            raise HandFileError("urdf", f"{path}: joint {j.name} mimics a coupled joint", "an independent joint")
    return roots[0]
