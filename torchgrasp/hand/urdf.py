"""A URDF as values: links, joints and collision shapes of a checked tree. No other file is opened."""

import dataclasses
import functools
import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import NamedTuple, NoReturn

from torchgrasp.errors import HandFileError
from torchgrasp.hand.safe_xml import parse_urdf, read_bounded

MAX_BYTES = 4 * 1024 * 1024
"""Largest URDF; those of the shipped hands have about 12 kB."""
MAX_LINKS = 512
"""Most links: the pairs of them are tested for collisions."""
NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
"""A decimal number. Python alone also reads 1_0, digits other than ASCII's, and nan."""

Triple = tuple[float, float, float]


class Mimic(NamedTuple):
    """The value of a coupled joint: `ratio * source + offset`."""

    source: str
    ratio: float
    offset: float


@dataclasses.dataclass(frozen=True)
class Shape:
    """A collision shape: `size` is (x, y, z) of a box, (radius,) of a sphere, (radius, length) of a cylinder [m]."""

    kind: str
    size: tuple[float, ...]
    xyz: Triple
    rpy: Triple


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid body: mass [kg], centre [m], inertia (xx, xy, xz, yy, yz, zz) [kg m2] about it, shapes."""

    name: str
    mass: float
    com: Triple
    inertia: tuple[float, ...]
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint of the tree; a fixed one has limits of 0."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Triple
    rpy: Triple
    axis: Triple = (1.0, 0.0, 0.0)
    lower: float = 0.0
    upper: float = 0.0
    effort: float = 0.0
    velocity: float = 0.0
    mimic: Mimic | None = None


@dataclasses.dataclass(frozen=True)
class Urdf:
    """A checked URDF: one tree of links, finite numbers throughout."""

    path: Path
    name: str
    root: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    data: bytes

    def wrong(self, found: str, allowed: str) -> HandFileError:
        """Make the error for a broken rule."""
        return HandFileError("urdf", f"{self.path}: {found}", allowed)

    @functools.cached_property
    def movable(self) -> tuple[Joint, ...]:
        """The joints that are not fixed."""
        return tuple(j for j in self.joints if j.kind != "fixed")

    def joints_above(self, link: str) -> tuple[Joint, ...]:
        """Return the joints from a link to the root, nearest first."""
        above, chain = {j.child: j for j in self.joints}, []
        while link in above:
            chain.append(above[link])
            link = above[link].parent
        return tuple(chain)

    def movers(self, link: str) -> tuple[Joint, ...]:
        """Return the movable joints above a link."""
        return tuple(j for j in self.joints_above(link) if j.kind != "fixed")

    def kinematic_xml(self) -> bytes:
        """Write links and joints alone, as bytes without an encoding declaration."""
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
    """Read and check a URDF file of at most 4 MiB, without opening meshes; raises `HandFileError`."""
    path = Path(path)
    data = read_bounded("urdf", path, "a URDF file", MAX_BYTES)
    robot, reader = parse_urdf(path, data), _Reader(path)
    links = tuple(reader.link(e) for e in robot if e.tag == "link")
    joints = tuple(reader.joint(e) for e in robot if e.tag == "joint")
    return Urdf(path, robot.get("name", ""), reader.check_tree(links, joints), links, joints, data)


class _Reader:
    """Reads the elements of one URDF; every complaint names the file."""

    def __init__(self, path: Path):
        self.path = path

    def refuse(self, found: str, allowed: str) -> NoReturn:
        raise HandFileError("urdf", f"{self.path}: {found}", allowed)

    def numbers(
        self, where: str, element: ET.Element | None, key: str, n: int, default: float | None = None
    ) -> tuple[float, ...]:
        """Read n finite numbers from an attribute."""
        text = None if element is None else element.get(key)
        if text is None and default is not None:
            return (default,) * n
        words = (text or "").split()
        values = tuple(float(word) for word in words if NUMBER.fullmatch(word))
        if len(words) != n or len(values) != n or not all(map(math.isfinite, values)):
            self.refuse(f"{where} {key} {(text or 'nothing')[:80]!r}", f"{n} finite number(s)")
        return values

    def number(self, where: str, element: ET.Element | None, key: str, default: float | None = None) -> float:
        return self.numbers(where, element, key, 1, default)[0]

    def triple(self, where: str, element: ET.Element | None, key: str, default: float | None = None) -> Triple:
        x, y, z = self.numbers(where, element, key, 3, default)
        return x, y, z

    def name(self, element: ET.Element | None, key: str, where: str) -> str:
        name = "" if element is None else element.get(key, "")
        if not 0 < len(name) <= 200:
            self.refuse(f"{where} without a name", f"a {key} of 1 to 200 letters")
        return name

    def origin(self, where: str, element: ET.Element) -> tuple[Triple, Triple]:
        origin, where = element.find("origin"), f"{where} origin"
        return self.triple(where, origin, "xyz", 0.0), self.triple(where, origin, "rpy", 0.0)

    def link(self, element: ET.Element) -> Link:
        """Read a link with its inertia and its collision shapes."""
        name = self.name(element, "name", "a link")
        mass, com, inertia = 0.0, (0.0, 0.0, 0.0), (0.0,) * 6
        inertial = element.find("inertial")
        if inertial is not None:
            where = f"link {name} inertial"
            com, rpy = self.origin(where, inertial)
            if any(rpy):
                self.refuse(f"{where} rpy {rpy}", "an inertia in the axes of the link")
            mass = self.number(f"{where} mass", inertial.find("mass"), "value")
            keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            inertia = tuple(self.number(where, inertial.find("inertia"), key) for key in keys)
        return Link(name, mass, com, inertia, tuple(self.shape(name, c) for c in element.findall("collision")))

    def shape(self, link: str, collision: ET.Element) -> Shape:
        """Read a collision shape; planner and simulator see no mesh."""
        where = f"link {link} collision"
        xyz, rpy = self.origin(where, collision)
        geometry = collision.find("geometry")
        if geometry is None or len(geometry) != 1:
            self.refuse(f"{where} without one geometry", "box, cylinder or sphere")
        g = geometry[0]
        if g.tag == "box":
            size = self.triple(where, g, "size")
        elif g.tag == "sphere":
            size = (self.number(where, g, "radius"),)
        elif g.tag == "cylinder":
            size = (self.number(where, g, "radius"), self.number(where, g, "length"))
        else:
            self.refuse(f"{where} <{g.tag}>", "box, cylinder or sphere")
        if min(size) <= 0:
            self.refuse(f"{where} of size {size}", "positive lengths")
        return Shape(g.tag, size, xyz, rpy)

    def joint(self, element: ET.Element) -> Joint:
        name = self.name(element, "name", "a joint")
        where, kind = f"joint {name}", element.get("type", "")
        if kind not in ("revolute", "prismatic", "fixed"):
            self.refuse(f"{where} of type {kind!r}", "revolute, prismatic or fixed")
        parent = self.name(element.find("parent"), "link", f"{where}: a parent")
        child = self.name(element.find("child"), "link", f"{where}: a child")
        xyz, rpy = self.origin(where, element)
        if kind == "fixed":
            return Joint(name, kind, parent, child, xyz, rpy)
        axis = element.find("axis")
        x, y, z = (1.0, 0.0, 0.0) if axis is None else self.triple(f"{where} axis", axis, "xyz")
        length = math.sqrt(sum(a * a for a in (x, y, z)))
        if not 0.999 < length < 1.001:  # a longer axis has been used to hide a ratio, which readers then lose
            self.refuse(f"{where} axis of length {length:g}", "a unit axis")
        limit, follow, mimic = element.find("limit"), element.find("mimic"), None
        lower, upper = self.number(f"{where} limit", limit, "lower"), self.number(f"{where} limit", limit, "upper")
        if not lower < upper:
            self.refuse(f"{where} limits {lower}, {upper}", "lower < upper")
        effort, velocity = self.number(where, limit, "effort", 0.0), self.number(where, limit, "velocity", 0.0)
        if follow is not None:
            source = self.name(follow, "joint", f"{where}: a mimic")
            ratio, offset = self.number(where, follow, "multiplier", 1.0), self.number(where, follow, "offset", 0.0)
            mimic = Mimic(source, ratio, offset)
        unit = (x / length, y / length, z / length)
        return Joint(name, kind, parent, child, xyz, rpy, unit, lower, upper, effort, velocity, mimic)

    def check_tree(self, links: tuple[Link, ...], joints: tuple[Joint, ...]) -> str:
        """Check that a tree reaches every link once; return its root."""
        names = [x.name for x in links]
        known = set(names)
        if not 0 < len(links) <= MAX_LINKS:
            self.refuse(f"{len(links)} links", f"1 to {MAX_LINKS} links")
        lists = {"link": names, "joint": [j.name for j in joints], "child": [j.child for j in joints]}
        for what, listed in lists.items():
            twice = sorted(n for n, times in Counter(listed).items() if times > 1)
            if twice:
                self.refuse(f"{what} {twice[0]!r} twice", f"every {what} once")
        for name, link in ((j.name, link) for j in joints for link in (j.parent, j.child)):
            if link not in known:
                self.refuse(f"joint {name} names link {link!r}", "a link of the file")
        roots = sorted(known - {j.child for j in joints})
        if len(roots) != 1:
            self.refuse(f"roots {roots}" if roots else "a cycle and no root", "exactly one root link")
        reached, front = {roots[0]}, [roots[0]]
        while front:
            front = [j.child for j in joints if j.parent in front]
            reached |= set(front)
        if len(reached) < len(names):
            self.refuse(f"a cycle around {sorted(known - reached)[0]!r}", "a tree")
        movable = {j.name: j for j in joints if j.kind != "fixed"}
        for j, source in ((j, j.mimic.source) for j in joints if j.mimic):
            if source not in movable:
                self.refuse(f"joint {j.name} mimics {source!r}", "a movable joint of the file")
            if movable[source].mimic:
                self.refuse(f"joint {j.name} mimics a coupled joint", "an independent joint")
        return roots[0]
