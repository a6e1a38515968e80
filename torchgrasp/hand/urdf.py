"""A URDF as values: the checked tree of links, joints and collision shapes.

The gate in `safe_xml` checks a file's bytes; yourdfpy reads the checked elements alone. Mesh files
are not opened.
"""

import dataclasses
import functools
import io
import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from torchgrasp.files import read_bounded
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import HandFileError
from torchgrasp.foundation.lazy import yourdfpy
from torchgrasp.foundation.limits import HAND_LINKS, HAND_SHAPES, MAX_EXTENT, URDF_BYTES
from torchgrasp.geometry.frames import real, rigid, rotation_from_rpy
from torchgrasp.hand.safe_xml import DEGREES, FULL_TURN, SIZES, bounded_tree, parse_urdf

AXIS_ERROR = 0.001  # largest error of the length of a joint's axis
DEEPEST = 100  # most links in a line: pytorch-kinematics walks the tree by recursion
REPAIR = "(torchgrasp hand new writes a clean copy)"
"""The end of an error about a published URDF that the library cannot use as it is."""
Triple = tuple[float, float, float]


class Mimic(NamedTuple):
    """How the position of a coupled joint follows that of other joints.

    The position is `ratio` times that of the joint `source`, plus `offset`. A joint that follows a
    sum, as by a tendon, adds the terms of `others`.
    """

    source: str  # name of the joint that is followed
    ratio: float  # factor on its position (no unit between joints of one kind)
    offset: float  # position [rad or m] if all followed joints are at 0
    # names of further followed joints, each with its ratio
    others: tuple[tuple[str, float], ...] = ()

    @property
    def terms(self) -> tuple[tuple[str, float], ...]:
        """Pairs (name, ratio) of all joints that this joint follows: `source` and `others`."""
        return (self.source, self.ratio), *self.others

    def follow(self, positions: Mapping[str, Any]) -> Any:
        """Return the position [rad or m] of the coupled joint.

        `positions` holds those of the joints that it follows, by their names.
        """
        value = self.ratio * positions[self.source] + self.offset
        for source, ratio in self.others:
            value = value + ratio * positions[source]
        return value


@dataclasses.dataclass(frozen=True)
class LinkShape:
    """A collision shape of a link of a URDF."""

    kind: str  # "box", "sphere", "cylinder" or "mesh"
    # (x, y, z) of a box, (radius,) of a sphere, (radius, length) of a cylinder [m]; the scale (x,
    # y, z) of a mesh
    size: tuple[float, ...]
    xyz: Triple  # position [m] of the shape in the link's frame
    rpy: Triple  # rotation [rad] of the shape about the fixed axes x, y, z of this frame
    file: str = ""  # file of a mesh; "" for other shapes

    @property
    def half(self) -> Triple:
        """Half sizes (x, y, z) [m], along the shape's own axes, of the smallest box around it. It
        is not defined for a mesh.
        """
        if self.kind == "box":
            return self.size[0] / 2, self.size[1] / 2, self.size[2] / 2
        return (
            self.size[0],
            self.size[0],
            self.size[0] if self.kind == "sphere" else self.size[1] / 2,
        )


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid link of a URDF."""

    name: str  # name of the link
    mass: float  # mass [kg]
    com: Triple  # centre of mass [m] in the link's frame
    # moments of inertia xx, xy, xz, yy, yz, zz [kg m^2] about the centre of mass, along the link's
    # axes
    inertia: tuple[float, ...]
    shapes: tuple[LinkShape, ...]  # its collision shapes

    @property
    def inertia_matrix(self) -> np.ndarray:
        """The symmetric matrix (3, 3) of the moments of inertia [kg m^2]."""
        xx, xy, xz, yy, yz, zz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint of a URDF, between two links."""

    name: str  # name of the joint
    kind: str  # "revolute", "prismatic", "continuous" or "fixed"
    parent: str  # name of the link nearer to the root
    child: str  # name of the link that the joint moves
    xyz: Triple  # position [m] of the joint's frame in the parent's frame
    # rotation [rad] of the joint's frame about the fixed axes x, y, z of the parent's frame
    rpy: Triple
    axis: Triple = (1.0, 0.0, 0.0)  # unit axis in the joint's frame
    # lower limit [rad or m]; 0 for a fixed joint, -infinity if the URDF has none
    lower: float = 0.0
    upper: float = 0.0  # upper limit [rad or m]; 0 for a fixed joint, infinity if the URDF has none
    effort: float = 0.0  # greatest torque or force [N m or N]; 0 if the URDF has none
    velocity: float = 0.0  # greatest speed [rad/s or m/s]; 0 if the URDF has none
    # how its position follows other joints; None for an independent joint
    mimic: Mimic | None = None

    @property
    def rest(self) -> float:
        """Position [rad or m] of a joint that is not used in a grasp: zero, or the limit nearest to
        zero.
        """
        return min(max(0.0, self.lower), self.upper)


@dataclasses.dataclass(frozen=True)
class Urdf:
    """A checked URDF, with its links and joints in the order of the file."""

    path: Path  # path of the file
    name: str  # name of the robot
    root: str  # name of the root link
    links: tuple[Link, ...]  # its links
    joints: tuple[Joint, ...]  # its joints
    data: bytes  # the bytes of the file
    xml: bytes  # a copy of the file with only the checked links and joints

    @checked
    def wrong(self, found: str, allowed: str) -> HandFileError:
        """Return an error for a fault of this URDF. The text `found` says what the file has, and
        `allowed` what is expected.
        """
        return HandFileError("urdf", f"{self.path}: {found}", allowed)

    @functools.cached_property
    def movable(self) -> tuple[Joint, ...]:
        """The joints that are not fixed, in the order of the file."""
        return tuple(j for j in self.joints if j.kind != "fixed")

    @checked
    def joints_above(self, link: str) -> tuple[Joint, ...]:
        """Return the joints on the way from the link named `link` to the root, nearest first."""
        above = {j.child: j for j in self.joints}
        chain = []
        while link in above:
            chain.append(above[link])
            link = above[link].parent
        return tuple(chain)

    @checked
    def movers(self, link: str) -> tuple[Joint, ...]:
        """Return the movable joints on the way from the link named `link` to the root, nearest
        first.
        """
        return tuple(j for j in self.joints_above(link) if j.kind != "fixed")

    @checked
    def pose_at_zero(self, link: str) -> Float[np.ndarray, "4 4"]:
        """Return the pose (4, 4) [m] of the link named `link` in the root's frame, with every joint
        at zero.
        """
        pose = np.eye(4)
        for joint in self.joints_above(link):
            pose = pose_of(joint) @ pose
        return pose


def pose_of(part: Joint | LinkShape) -> Float[np.ndarray, "4 4"]:
    """Return the pose (4, 4) [m] of a joint, in its parent link's frame and at position zero. For a
    shape it is the pose in the frame of its link.
    """
    return rigid(rotation_from_rpy(part.rpy), real(part.xyz)).numpy()


@checked
def read_urdf(path: Path | str) -> Urdf:
    """Read a URDF that the library can use as it is; return its links, joints and collision shapes.

    Raises `HandFileError` for a missing or malformed file. Raises it also for collision meshes,
    joints without limits, and coupled joints that follow a coupled joint.
    """
    urdf = read_published(path)
    for link in urdf.links:
        if any(shape.kind == "mesh" for shape in link.shapes):
            raise urdf.wrong(f"link {link.name} with a mesh", f"a box, cylinder or sphere {REPAIR}")
    for j in urdf.movable:
        if math.isinf(j.upper - j.lower):
            raise urdf.wrong(f"joint {j.name} without a limit", f"lower and upper limits {REPAIR}")
        if j.mimic and any(other.mimic for other in urdf.movable if other.name == j.mimic.source):
            raise urdf.wrong(
                f"joint {j.name} that follows a coupled joint",
                f"an independent joint to follow {REPAIR}",
            )
    return urdf


def read_published(path: Path | str, visual: bool = False) -> Urdf:
    """Read a URDF as its maker published it: with meshes, joints without limits, and chains of
    coupled joints.

    With `visual`, links without <collision> take their <visual> as collision shapes. Raises
    `HandFileError` for a missing or malformed file.
    """
    path = Path(path)
    return _parse(
        path,
        read_bounded(path, URDF_BYTES, "a URDF file", functools.partial(HandFileError, "urdf")),
        visual,
    )


def read_visuals(path: Path, data: bytes) -> dict[str, tuple[LinkShape, ...]]:
    """Return the visual shapes (<visual>) of each link of a URDF, by the link's name.

    `data` are the bytes of a URDF that `read_urdf` or `read_published` has accepted, and `path` is
    named in errors. Only pictures use these shapes: the dict is empty if any is malformed.
    """
    robot = bounded_tree(data)
    for link in robot.findall("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
        for shape in link.findall("visual"):
            shape.tag = "collision"
    try:
        return {link.name: link.shapes for link in _parse(path, ET.tostring(robot), False).links}
    except HandFileError:
        return {}


@functools.lru_cache(maxsize=16)
def _parse(path: Path, data: bytes, visual: bool) -> Urdf:
    """Return a file's bytes as checked values; the latest files are kept, as many callers read the
    same hand again.
    """
    # links and joints alone, each with all of its names and with finite numbers
    clean = parse_urdf(path, data, visual)
    xml = ET.tostring(clean)
    robot = yourdfpy.URDF.load(io.BytesIO(xml), build_scene_graph=False, load_meshes=False).robot
    links = tuple(_link(*pair) for pair in zip(robot.links, clean.findall("link"), strict=True))
    joints = tuple(_joint(*pair) for pair in zip(robot.joints, clean.findall("joint"), strict=True))
    urdf = Urdf(path, robot.name, "", links, joints, data, xml)
    _check_names(urdf)
    _check_shapes(urdf)
    _check_joints(urdf)
    return dataclasses.replace(urdf, root=_check_tree(urdf))


def _place(origin: Any, element: ET.Element | None) -> tuple[Triple, Triple]:
    """Return translation [m] and fixed-axis angles [rad]; yourdfpy keeps a matrix, so the XML gives
    the angles.
    """
    if origin is None or element is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    x, y, z = origin[:3, 3].tolist()
    roll, pitch, yaw = map(float, element.attrib["rpy"].split())
    return (x, y, z), (roll, pitch, yaw)


def _link(link: Any, element: ET.Element) -> Link:
    """Return a link; its inertia is rotated into the link's axes."""
    shapes = tuple(
        _shape(*pair) for pair in zip(link.collisions, element.findall("collision"), strict=True)
    )
    if (body := link.inertial) is None:
        return Link(link.name, 0.0, (0.0, 0.0, 0.0), (0.0,) * 6, shapes)
    com, rpy = _place(body.origin, element.find("inertial/origin"))
    turn = body.origin[:3, :3] if any(rpy) else np.eye(3)
    inertia = body.inertia
    return Link(
        link.name,
        body.mass,
        com,
        tuple((turn @ inertia @ turn.T)[np.triu_indices(3)].tolist()),
        shapes,
    )


def _shape(collision: Any, element: ET.Element) -> LinkShape:
    kind, shape = next(
        (kind, shape) for kind, shape in vars(collision.geometry).items() if shape is not None
    )
    size = [float(x) for key in SIZES[kind] for x in np.atleast_1d(getattr(shape, key))]
    return LinkShape(
        kind,
        tuple(size),
        *_place(collision.origin, element.find("origin")),
        getattr(shape, "filename", ""),
    )


def _joint(joint: Any, element: ET.Element) -> Joint:
    """Return a joint. Its default axis is x, as in ROS; a continuous joint gets no limits."""
    xyz, rpy = _place(joint.origin, element.find("origin"))
    if joint.type == "fixed":
        return Joint(joint.name, joint.type, joint.parent, joint.child, xyz, rpy)
    x, y, z = joint.axis.tolist()
    length = math.sqrt(x * x + y * y + z * z)
    length = length if _is_unit(length) else 1.0  # refused later
    low, high, effort, velocity = (
        getattr(joint.limit, key, None) for key in ("lower", "upper", "effort", "velocity")
    )
    if joint.type == "continuous":
        low = high = None
    mimic = (
        None
        if joint.mimic is None
        else Mimic(joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
    )
    return Joint(
        joint.name,
        joint.type,
        joint.parent,
        joint.child,
        xyz,
        rpy,
        (x / length, y / length, z / length),
        -math.inf if low is None else low,
        math.inf if high is None else high,
        effort or 0.0,
        velocity or 0.0,
        mimic,
    )


def _is_unit(length: float) -> bool:
    return 1 - AXIS_ERROR < length < 1 + AXIS_ERROR


def _check_names(urdf: Urdf) -> None:
    """Raise `HandFileError` for too many links, repeated names or children, and joints of unknown
    links.
    """
    if not 0 < len(urdf.links) <= HAND_LINKS:
        raise urdf.wrong(f"{len(urdf.links)} links", f"1 to {HAND_LINKS} links")
    names = [x.name for x in urdf.links]
    lists = {
        "link": names,
        "joint": [j.name for j in urdf.joints],
        "child": [j.child for j in urdf.joints],
    }
    for what, listed in lists.items():
        twice = sorted(n for n, times in Counter(listed).items() if times > 1)
        if twice:
            raise urdf.wrong(f"{what} {twice[0]!r} twice", f"every {what} once")
    for j in urdf.joints:
        for link in {j.parent, j.child} - set(names):
            raise urdf.wrong(f"joint {j.name} of link {link!r}", "joints of links in the file")


def _check_shapes(urdf: Urdf) -> None:
    """Raise `HandFileError` for too many shapes, and for sizes that are not positive or too large
    for a hand.
    """
    count = sum(len(link.shapes) for link in urdf.links)
    if count > HAND_SHAPES:
        raise urdf.wrong(f"{count} collision shapes", f"at most {HAND_SHAPES} collision shapes")
    for link, shape in ((x, shape) for x in urdf.links for shape in x.shapes):
        if shape.kind != "mesh" and not 0 < min(shape.size) <= max(shape.size) <= MAX_EXTENT:
            found = f"link {link.name} collision of size {shape.size}"
            raise urdf.wrong(found, f"positive lengths, at most {MAX_EXTENT:g} m")


def _check_joints(urdf: Urdf) -> None:
    """Raise `HandFileError` for unknown types, wrong axes or limits, and cyclic couplings of
    joints.
    """
    movable = {j.name: j for j in urdf.movable}
    for j in urdf.movable:
        if j.kind not in ("revolute", "prismatic", "continuous"):
            raise urdf.wrong(
                f"joint {j.name} of type {j.kind!r}", "revolute, prismatic, continuous or fixed"
            )
        if not _is_unit(math.hypot(*j.axis)):
            raise urdf.wrong(
                f"joint {j.name} with an axis of length {math.hypot(*j.axis):g}", "a unit axis"
            )
        limits = f"joint {j.name} with limits {j.lower:g}, {j.upper:g}"
        if not j.lower < j.upper:
            cause = "are they swapped?" if j.lower > j.upper else 'else type "fixed"'
            raise urdf.wrong(limits, f"limits with lower < upper: {cause}")
        if math.isinf(j.lower) != math.isinf(j.upper):
            raise urdf.wrong(limits, "both limits, or none (ROS takes 0 for the missing one)")
        farthest = max(-j.lower, j.upper)
        if j.kind == "revolute" and math.isfinite(j.lower) and farthest > FULL_TURN:
            raise urdf.wrong(limits, f"radians, at most a full turn either way {DEGREES}")
        if j.kind == "prismatic" and math.isfinite(j.lower) and farthest > MAX_EXTENT:
            raise urdf.wrong(limits, f"at most {MAX_EXTENT:g} m either way (in millimetres?)")
        passed = [j.name]
        while mimic := movable[passed[-1]].mimic:
            follower = f"joint {passed[-1]} that follows"
            if mimic.source not in movable:
                raise urdf.wrong(
                    f"{follower} {mimic.source!r}", "a movable joint of the file to follow"
                )
            if mimic.source in passed:
                raise urdf.wrong(
                    f"{follower} coupled joints in a circle", "an independent joint to follow"
                )
            passed.append(mimic.source)


def _check_tree(urdf: Urdf) -> str:
    """Raise `HandFileError` unless one tree reaches every link; return its root."""
    known = {x.name for x in urdf.links}
    roots = sorted(known - {j.child for j in urdf.joints})
    if len(roots) != 1:
        raise urdf.wrong(
            f"roots {roots}" if roots else "a cycle and no root", "exactly one root link"
        )
    reached = {roots[0]}
    front = [roots[0]]
    depth = 0
    while front:
        front = [j.child for j in urdf.joints if j.parent in front]
        reached |= set(front)
        depth += 1
    if len(reached) < len(known):
        raise urdf.wrong(f"a cycle around {sorted(known - reached)[0]!r}", "a tree")
    if depth > DEEPEST:
        allowed = f"at most {DEEPEST} links from the root to a tip"
        raise urdf.wrong(f"{depth} links in a line", allowed)
    return roots[0]
