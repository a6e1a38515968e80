"""A URDF as values: links, joints and collision shapes of a checked tree. yourdfpy reads it; no mesh is opened."""

import dataclasses
import functools
import io
import math
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchgrasp.border import checked
from torchgrasp.errors import HandFileError
from torchgrasp.hand.safe_xml import parse_urdf, read_bounded

MAX_BYTES = 4 * 1024 * 1024
"""Largest URDF; those of the shipped hands have about 12 kB."""
MAX_LINKS = 512
"""Most links: the pairs of them are tested for collisions."""
MAX_SHAPES = 1000
"""Most collision shapes, for the same reason; a hand has up to 100."""
MAX_SIZE = 2.0
"""Largest collision shape [m]: a hand is smaller, and its cover of spheres grows with the surface."""
MEND = "torchgrasp hand new writes a clean copy"
"""What helps against what a published URDF may hold, and a clean one may not."""

Triple = tuple[float, float, float]


class Mimic(NamedTuple):
    """The value of a coupled joint: `ratio * source + offset`."""

    source: str
    ratio: float
    offset: float


@dataclasses.dataclass(frozen=True)
class Shape:
    """A collision shape, box, sphere, cylinder or mesh.

    `size` is (x, y, z) of a box, (radius,) of a sphere, (radius, length) of a cylinder [m]; the scale of a mesh.
    """

    kind: str
    size: tuple[float, ...]
    xyz: Triple
    rpy: Triple
    file: str = ""


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
    """A joint of the tree; a fixed one has limits of 0, one without limits infinite ones."""

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
    """A checked URDF: one tree of links, finite numbers throughout.

    `data` are the bytes of the file, `xml` those of its links and joints alone.
    """

    path: Path
    name: str
    root: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    data: bytes
    xml: bytes

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


@checked
def read_urdf(path: Path | str) -> Urdf:
    """Read and check a URDF file of at most 4 MiB; raises `HandFileError`.

    It has to be a clean one: no meshes as collision shapes, no joint without limits, none that follows a follower.
    """
    urdf = read_published(path)
    for link in urdf.links:
        if any(shape.kind == "mesh" for shape in link.shapes):
            raise urdf.wrong(f"link {link.name} collision <mesh>", f"box, cylinder or sphere; {MEND}")
    for j in urdf.movable:
        if math.isinf(j.upper - j.lower):
            raise urdf.wrong(f"joint {j.name} without a limit", f"lower and upper; {MEND}")
        if j.mimic and any(other.mimic for other in urdf.movable if other.name == j.mimic.source):
            raise urdf.wrong(f"joint {j.name} mimics a coupled joint", f"an independent joint; {MEND}")
    return urdf


def read_published(path: Path | str) -> Urdf:
    """Read a URDF as it is published: with meshes, without limits, with joints that follow a follower.

    Raises:
        HandFileError: the file is missing, too large or hostile, or no tree of bodies.
    """
    path = Path(path)
    data = read_bounded("urdf", path, "a URDF file", MAX_BYTES)
    return urdf_from_xml(path, data, ET.tostring(parse_urdf(path, data)))


def urdf_from_xml(path: Path, data: bytes, xml: bytes) -> Urdf:
    """Read the XML that passed the gate of `safe_xml`."""
    import yourdfpy  # takes half a second

    robot = yourdfpy.URDF.load(io.BytesIO(xml), build_scene_graph=False, load_meshes=False).robot
    links, joints = tuple(map(_link, robot.links)), tuple(map(_joint, robot.joints))
    urdf = Urdf(path, robot.name, "", links, joints, data, xml)
    _check_names(urdf)
    _check_shapes(urdf)
    _check_joints(urdf)
    return dataclasses.replace(urdf, root=_check_tree(urdf))


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(x) + 0.0 for x in values)


def place(origin: Any) -> tuple[Triple, Triple]:
    """Return translation [m] and fixed-axis angles [rad] of a 4 x 4 pose; None: zeros."""
    from trimesh.transformations import euler_from_matrix

    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    # of the two triples the smaller one, to the digits that a rotation keeps: so the numbers of the file come back
    one = _floats(euler_from_matrix(origin))
    two = [math.copysign(math.pi, angle) - angle for angle in one]
    angles = min((one, (-two[0], two[1], -two[2])), key=lambda triple: sum(map(abs, triple)))
    x, y, z, roll, pitch, yaw = _floats([*origin[:3, 3], *(round(angle, 15) for angle in angles)])
    return (x, y, z), (roll, pitch, yaw)


def _link(link: Any) -> Link:
    """Read a link; its inertia is turned into the link's axes."""
    mass, com, inertia = 0.0, (0.0, 0.0, 0.0), np.zeros((3, 3))
    if link.inertial is not None:
        mass, inertia = link.inertial.mass, link.inertial.inertia
        com, rpy = place(link.inertial.origin)
        if any(rpy):
            turn = link.inertial.origin[:3, :3]
            inertia = turn @ inertia @ turn.T
    return Link(link.name, float(mass), com, _floats(inertia[np.triu_indices(3)]), tuple(map(_shape, link.collisions)))


def _shape(collision: Any) -> Shape:
    xyz, rpy = place(collision.origin)
    box, sphere, cylinder, mesh = (getattr(collision.geometry, k) for k in ("box", "sphere", "cylinder", "mesh"))
    if mesh is not None:
        return Shape("mesh", _floats(mesh.scale), xyz, rpy, mesh.filename)
    if box is not None:
        return Shape("box", _floats(box.size), xyz, rpy)
    if sphere is not None:
        return Shape("sphere", (sphere.radius,), xyz, rpy)
    return Shape("cylinder", (cylinder.radius, cylinder.length), xyz, rpy)


def _joint(joint: Any) -> Joint:
    xyz, rpy = place(joint.origin)
    if joint.type == "fixed":
        return Joint(joint.name, joint.type, joint.parent, joint.child, xyz, rpy)
    x, y, z = _floats(joint.axis)
    length = math.sqrt(x * x + y * y + z * z)
    length = length if _is_unit(length) else 1.0  # refused later
    limit, mimic = joint.limit, joint.mimic
    lower, upper = (None, None) if limit is None or joint.type == "continuous" else (limit.lower, limit.upper)
    return Joint(
        joint.name,
        joint.type,
        joint.parent,
        joint.child,
        xyz,
        rpy,
        (x / length, y / length, z / length),
        -math.inf if lower is None else lower,
        math.inf if upper is None else upper,
        0.0 if limit is None else limit.effort,
        0.0 if limit is None else limit.velocity,
        None if mimic is None else Mimic(mimic.joint, mimic.multiplier, mimic.offset),
    )


def _is_unit(length: float) -> bool:
    """Tell whether an axis has length 1; a longer one has been used to hide a ratio, which readers then lose."""
    return 0.999 < length < 1.001


def _check_names(urdf: Urdf) -> None:
    """Refuse too many links, names and children that come twice, and joints of unknown links."""
    if not 0 < len(urdf.links) <= MAX_LINKS:
        raise urdf.wrong(f"{len(urdf.links)} links", f"1 to {MAX_LINKS} links")
    names = [x.name for x in urdf.links]
    lists = {"link": names, "joint": [j.name for j in urdf.joints], "child": [j.child for j in urdf.joints]}
    for what, listed in lists.items():
        twice = sorted(n for n, times in Counter(listed).items() if times > 1)
        if twice:
            raise urdf.wrong(f"{what} {twice[0]!r} twice", f"every {what} once")
    for j in urdf.joints:
        for link in {j.parent, j.child} - set(names):
            raise urdf.wrong(f"joint {j.name} names link {link!r}", "a link of the file")


def _check_shapes(urdf: Urdf) -> None:
    """Refuse too many shapes, and sizes that are not positive or no hand's."""
    count = sum(len(link.shapes) for link in urdf.links)
    if count > MAX_SHAPES:
        raise urdf.wrong(f"{count} collision shapes", f"at most {MAX_SHAPES}")
    for link, shape in ((x, shape) for x in urdf.links for shape in x.shapes):
        if shape.kind != "mesh" and not 0 < min(shape.size) <= max(shape.size) <= MAX_SIZE:
            found = f"link {link.name} collision of size {shape.size}"
            raise urdf.wrong(found, f"positive lengths, at most {MAX_SIZE:g} m")


def _check_joints(urdf: Urdf) -> None:
    """Refuse unknown kinds of joints, axes and limits that are none, and mimics in a circle."""
    movable = {j.name: j for j in urdf.movable}
    for j in urdf.movable:
        if j.kind not in ("revolute", "prismatic", "continuous"):
            raise urdf.wrong(f"joint {j.name} of type {j.kind!r}", "revolute, prismatic, continuous or fixed")
        if not _is_unit(math.hypot(*j.axis)):
            raise urdf.wrong(f"joint {j.name} axis of length {math.hypot(*j.axis):g}", "a unit axis")
        if not j.lower < j.upper:
            raise urdf.wrong(f"joint {j.name} limits {j.lower}, {j.upper}", "lower < upper")
        passed = [j.name]
        while mimic := movable[passed[-1]].mimic:
            if mimic.source not in movable:
                raise urdf.wrong(f"joint {passed[-1]} mimics {mimic.source!r}", "a movable joint of the file")
            if mimic.source in passed:
                raise urdf.wrong(f"joint {passed[-1]} mimics a coupled joint in a circle", "an independent joint")
            passed.append(mimic.source)


def _check_tree(urdf: Urdf) -> str:
    """Check that a tree reaches every link; return its root."""
    known = {x.name for x in urdf.links}
    roots = sorted(known - {j.child for j in urdf.joints})
    if len(roots) != 1:
        raise urdf.wrong(f"roots {roots}" if roots else "a cycle and no root", "exactly one root link")
    reached, front = {roots[0]}, [roots[0]]
    while front:
        front = [j.child for j in urdf.joints if j.parent in front]
        reached |= set(front)
    if len(reached) < len(known):
        raise urdf.wrong(f"a cycle around {sorted(known - reached)[0]!r}", "a tree")
    return roots[0]
