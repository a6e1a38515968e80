"""Parameters of a simulated scene: table, object, neighbours, and a hand on a mount."""

import dataclasses
import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchgrasp.files import render
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Positive
from torchgrasp.geometry.plane import UNIT_ERROR, Plane
from torchgrasp.hand.hand import Actuator
from torchgrasp.hand.urdf import Urdf, read_urdf
from torchgrasp.values.specs import GRAVITY

# inertia [kg m^2] that each motor's rotor adds to its joint; PhysX's implicit drives need it
ARMATURE = 1e-3
LIFT_JOINT = "torchgrasp_lift"
APPROACH_JOINT = "torchgrasp_approach"
"""Names of the mount's prismatic joints: along the world's z axis, and along the approach, which
ends at position 0.
"""
SHIFT_JOINTS = ("torchgrasp_shift_x", "torchgrasp_shift_y", "torchgrasp_shift_z")
"""Names of the prismatic joints of a mount that yields, along the world's axes."""


@dataclasses.dataclass(frozen=True)
class SimulationNumbers:
    """Constants of every simulated scene, and of the prismatic joints that carry its hand."""

    near: float = 3e-4
    """Height [m] above the table below which a vertex is moved onto the table."""
    slack: float = 0.01
    """Distance [m] by which the joint limits of the hand's mount exceed the planned motion."""
    lift_slack: float = 0.05
    """Height [m] by which the limit of the mount's lift exceeds the planned lift."""
    level: float = 1e-9
    """Cosine of the pitch below which roll and yaw count as rotations about the same axis."""
    bits: int = 31
    """Number of bits of a collision mask: MuJoCo's masks are signed numbers of 32 bits."""
    reach: float = 1.0
    """Distance [m] that a table with an edge reaches from the object: a lost object ends a trial
    sooner.
    """
    thickness: float = 0.5
    """Thickness [m] of a table with an edge: hands beside it do not reach its underside."""


SIMULATION = SimulationNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class Neighbour:
    """Another body on the simulated table, beside the object to grasp; `close_hand` takes it.

    Args:
        mesh: closed mesh [m], in the frame of the grasp, that of the planned cloud.
        parts: convex parts of the mesh [m]; None means those that `convex_parts` computes.
        mass: mass [kg]. None means that `TrialSpec.mass` or `TrialSpec.density` gives it, as for
            the object.

    Raises `BadArgument` for a mass that is not positive.
    """

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh] | None" = None
    mass: Positive | None = None


@checked
@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body of uniform density in a simulated scene; `SceneSpec.neighbours` takes it.

    Args:
        mesh: closed mesh [m] of the body, in the world's frame at its initial pose.
        parts: convex parts [m] whose union approximates the mesh, as `convex_parts` returns them.
        mass: mass [kg] of the body.

    Raises `BadArgument` for a mass that is not positive.
    """

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh]"
    mass: Positive

    @property
    def inertia(self) -> np.ndarray:
        """The matrix of inertia (3, 3) [kg m^2] about the centre of mass, for uniform density.

        Its axes are those of the mesh's frame.
        """
        # scaled by their own mass, as the mesh may have a density
        weighed = self.mesh.mass_properties
        return np.asarray(weighed.inertia) * (self.mass / float(weighed.mass))


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """Parameters of a simulated scene: a hand, the object, the table and neighbours.

    `open_scene` takes it. Everything is in the world's frame, with z up. The hand is carried by a
    mount: a chain of driven prismatic joints in place of an arm. They lift the hand, move it along
    its approach, and shift it along the axes of the world.

    Args:
        urdf_path: URDF of the hand.
        world_from_hand: pose (4, 4) [m] of the hand's root link at the end of the approach.
        joints: start position [rad or m] of every movable joint of the URDF, by name.
        drives: drive of every movable joint of the URDF, by name.
        tip_links: names of the links of the f fingertips, in the order of the grasp's contacts.
        mesh: closed mesh [m] of the object, which gives table height, centre of mass and inertia.
        parts: convex parts [m] that make up the object.
        mass: mass [kg] of the object.
        friction: friction coefficient of every contact; `table_friction` may replace it.
        gravity: acceleration [m/s^2] by gravity, downward.
        timestep: timestep [s] of the simulator.
        travel: largest height [m] of a lift.
        approach: displacement (x, y, z) [m] from the hand's start to the pose `world_from_hand`.
        table: whether there is a table.
        patch: radius [m] of a fingertip's contact patch. The torque of torsional friction is
            friction x force x patch.
        height: height [m] of the table; None means the lowest point of the mesh.
        edge: (x, y, offset) of a table that ends, with a horizontal unit vector (x, y) and an
            offset [m]. The table fills points below its height whose coordinate [m] along this
            vector is less than the offset. None means that the table does not end.
        neighbours: other bodies on the table, each a `Body`.
        self_pairs: names of the two links of each pair of the hand's links that can collide.
        yields: largest displacement [m] by which `SimulatedScene.shift` can move the mount along
            each axis of the world. It adds to approach and lift. 0 means that the mount cannot
            shift.
        start: initial displacement (x, y, z) [m] of the mount by such a shift; without effect if
            `yields` is 0.
        table_friction: friction coefficient of objects with the table and with each other, at most
            2 `friction`; None means `friction`. SAPIEN takes the mean of two surfaces, so a greater
            one would need fingertips of negative friction.
        mount: all prismatic joints of the mount, each a `Slide`, from the world to the hand. None
            means those that `travel`, `approach` and `yields` need.

    Raises `BadArgument` for an edge whose vector is not of unit length, a negative `friction`, and a
    `table_friction` that is not in [0, 2 friction].
    """

    urdf_path: Path | str
    world_from_hand: np.ndarray
    joints: dict[str, float]
    drives: dict[str, Actuator]
    tip_links: tuple[str, ...]
    mesh: "trimesh.Trimesh"
    parts: "list[trimesh.Trimesh]"
    mass: float
    friction: float = 0.8
    gravity: float = GRAVITY
    timestep: float = 1 / 500
    travel: float = 0.1
    approach: tuple[float, float, float] = (0.0, 0.0, 0.0)
    table: bool = True
    patch: float = 0.0
    height: float | None = None
    neighbours: tuple[Body, ...] = ()
    self_pairs: tuple[tuple[str, str], ...] = ()
    yields: float = 0.0
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    table_friction: float | None = None
    mount: "tuple[Slide, ...] | None" = None
    edge: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if not self.friction >= 0:
            raise BadArgument("friction", self.friction, "a number >= 0")
        most = 2 * self.friction
        if not 0 <= self.body_friction <= most:
            allowed = f"at least 0 and at most 2 friction, {most:g}"
            raise BadArgument("table_friction", self.body_friction, allowed)
        if self.edge is None:
            return
        length = math.hypot(*self.edge[:2])
        if not abs(length - 1) < UNIT_ERROR:
            raise BadArgument("edge", f"a vector of length {length:g}", "a unit vector (x, y)")

    @functools.cached_property
    def urdf(self) -> Urdf:
        """The parsed URDF of the hand, with tuples of its `links` and `joints` in the file's order.

        Raises `HandFileError` if the file is not valid.
        """
        return read_urdf(self.urdf_path)

    @functools.cached_property
    def slides(self) -> list["Slide"]:
        """The prismatic joints of the mount that carries the hand, from the world to the hand.

        They are `mount` if it is given. Otherwise there is one joint for the lift. One for the
        approach follows if `approach` is not zero, and three for yielding if `yields` is positive.
        """
        if self.mount is not None:
            return list(self.mount)
        slack = SIMULATION.slack
        highest = self.travel + SIMULATION.lift_slack
        slides = [Slide(LIFT_JOINT, (0.0, 0.0, 1.0), -slack, highest, 0.0)]
        length = float(np.linalg.norm(self.approach))
        if length > 0:
            x, y, z = self.approach
            axis = (x / length, y / length, z / length)
            slides.append(Slide(APPROACH_JOINT, axis, -length - slack, slack, -length))
        if self.yields > 0:
            most = self.yields + slack
            axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
            each = zip(SHIFT_JOINTS, axes, self.start, strict=True)
            slides += [Slide(name, axis, -most, most, start) for name, axis, start in each]
        return slides

    @property
    def body(self) -> Body:
        """The object to grasp as a rigid body: its mesh, convex parts and mass."""
        return Body(self.mesh, self.parts, self.mass)

    @property
    def body_friction(self) -> float:
        """The friction coefficient of objects with the table and with each other."""
        return self.friction if self.table_friction is None else self.table_friction

    @property
    def table_height(self) -> float:
        """The height [m] of the table along the world's z: `height`, or the lowest point of the
        object's mesh if that is None.
        """
        return float(self.mesh.bounds[0, 2]) if self.height is None else self.height

    @property
    def ledge(self) -> "Ledge":
        """The box that stands for a table with an `edge`: a named tuple (centre, half, axes).

        `centre` (3,) [m] is its centre in the world's frame, and `half` (3,) [m] half its lengths.
        The columns of `axes` (3, 3) are its axes in this frame: outward beyond the edge, along the
        edge, and up. The box is under the object. It ends at the edge, or 1 m beyond the object's
        middle (`SIMULATION.reach`) if the edge is farther. Read it only if `edge` is not None.
        """
        assert self.edge is not None
        x, y, offset = self.edge
        axes = np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
        reach = SIMULATION.reach
        along, across, _ = self.mesh.bounds.mean(0) @ axes
        end = min(offset, along + reach)
        thickness = SIMULATION.thickness
        centre = axes @ np.array([end - reach, across, self.table_height - thickness / 2])
        return Ledge(centre, np.array([reach, reach, thickness / 2]), axes)

    @property
    def hulls(self) -> list[list[np.ndarray]]:
        """The vertices (v, 3) [m] of all convex parts: a list for the object, then one for each
        neighbour.

        They are in the world's frame, at the bodies' initial poses. Vertices less than 0.3 mm above
        the table, or below it, are moved onto it. Otherwise a scanned round body would roll away on
        its facets before it is touched. Vertices that hang far below the table beyond its edge stay
        there.
        """
        lowest = self.table_height + SIMULATION.near if self.table else -math.inf
        found = []
        for body in (self.body, *self.neighbours):
            hulls = [np.array(part.vertices, dtype=float) for part in body.parts]
            for vertices in hulls:
                low = vertices[:, 2] < lowest
                if self.edge is not None:
                    hangs = vertices[:, :2] @ np.array(self.edge[:2]) > self.edge[2]
                    low &= ~hangs | (vertices[:, 2] > self.table_height - SIMULATION.near)
                vertices[low, 2] = self.table_height
            found.append(hulls)
        return found

    @checked
    def check_drives(self, names: list[str]) -> None:
        """Raise `BadArgument` if a joint of `names` lacks a start position in `joints` or a drive
        in `drives`.
        """
        missing = [name for name in names if name not in self.joints or name not in self.drives]
        if missing:
            found = f"no position or drive for {missing}"
            raise BadArgument("joints", found, "one for every joint of the URDF")


class Ledge(NamedTuple):
    """The box that stands for a table with an edge in a simulated scene.

    Attributes:
        centre: centre (3,) [m] of the box in the world's frame.
        half: half of the box's lengths (3,) [m] along its axes.
        axes: the box's axes (3, 3) in columns, in the world's frame. The first points off the
            table, the second along the edge, the third up.
    """

    centre: np.ndarray
    half: np.ndarray
    axes: np.ndarray


MOUNT_DRIVE = Actuator(effort=1e4, velocity=10.0, kp=1e4, kd=1e3)
"""Motor of a slide: force [N], speed [m/s], stiffness [N/m], damping [N s/m]."""

WRIST_JOINT = "torchgrasp_wrist"  # name of the fixed joint between mount and hand


class Slide(NamedTuple):
    """A driven prismatic joint of the mount that carries a simulated hand (`SceneSpec.mount`).

    Attributes:
        name: name of the joint. "torchgrasp_lift" is what `SimulatedScene.lift` moves, and
            "torchgrasp_approach" what `approach` moves. "torchgrasp_shift_x", "torchgrasp_shift_y"
            and "torchgrasp_shift_z" are what `shift` moves.
        axis: unit vector (x, y, z) of the motion in the world's frame.
        lower: least position [m] along the axis.
        upper: greatest position [m] along the axis.
        start: initial position [m] along the axis.
    """

    name: str
    axis: tuple[float, float, float]
    lower: float
    upper: float
    start: float


def edge_of(table: Plane) -> tuple[float, float, float] | None:
    """Return the edge of a level table as (x, y, offset), for `SceneSpec.edge`; None without an
    edge.

    (x, y) is a horizontal unit vector that points off the table, and `offset` [m] the edge's
    position along it. Both are in the frame of `table`, which is the world's.
    """
    if table.edge is None:
        return None
    x, y, _ = table.edge.normal.tolist()
    length = math.hypot(x, y)
    return x / length, y / length, table.edge.offset


def mounted_urdf(spec: SceneSpec) -> str:
    """Return the URDF of the hand on its mount, as XML text.

    `<visual>` elements are left out, because they need a render device. `<mimic>` elements are left
    out, because SAPIEN's mimic joints transmit wrong forces; coupled joints get their own targets
    instead.
    """
    urdf = spec.urdf
    robot = ET.fromstring(urdf.xml)
    for joint in robot.iter("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    mount = render(
        Path(__file__).parent / "templates" / "mount.xml.jinja",
        slides=spec.slides,
        root=urdf.root,
        place=spec.world_from_hand[:3, 3],
        angles=euler_from_rotation(spec.world_from_hand[:3, :3]),
        wrist=WRIST_JOINT,
    )
    robot[:0] = list(ET.fromstring(mount))
    return ET.tostring(robot, encoding="unicode")


def euler_from_rotation(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the roll, pitch and yaw [rad] of a rotation matrix (3, 3), as in a URDF.

    The matrix is R = Rz(yaw) Ry(pitch) Rx(roll). At a pitch of 90 degrees only yaw - roll is
    determined; roll is then 0.
    """
    sine = -float(rotation[2, 0])
    cosine = math.hypot(float(rotation[0, 0]), float(rotation[1, 0]))
    pitch = math.atan2(sine, cosine)
    if cosine < SIMULATION.level:
        return 0.0, pitch, math.atan2(-float(rotation[0, 1]), float(rotation[1, 1]))
    roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    return roll + 0.0, pitch + 0.0, math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))


def pair_masks(pairs: Iterable[tuple[str, str]], first: int) -> dict[str, tuple[int, int]]:
    """Return (group, mask) for each link in `pairs`, by its name: two bit masks that let only these
    pairs collide.

    `pairs` are names of the two links of each pair. In PhysX and MuJoCo, links collide if the group
    of one shares a bit with the other's mask. Only one link of each pair needs its own bit. The
    bits from number `first` on are used; bit 0 is the lowest. Raises `HandFileError` if 31 bits do
    not suffice (`SIMULATION.bits`).
    """
    left = [tuple(pair) for pair in pairs]
    kinds = dict.fromkeys((name for pair in left for name in pair), 0)
    hits = dict(kinds)
    for bit in range(first, SIMULATION.bits):
        if not left:
            break
        names = [name for pair in left for name in pair]
        owner = max(kinds, key=names.count)  # the first of equals
        kinds[owner] = 1 << bit
        for one, two in left:
            if owner in (one, two):
                hits[two if one == owner else one] |= 1 << bit
        left = [pair for pair in left if owner not in pair]
    if left:
        allowed = f"pairs that {SIMULATION.bits - first} bits distinguish"
        raise HandFileError("self_collision", f"{len(left)} pairs too many", allowed)
    return {name: (kinds[name], hits[name]) for name in kinds}
