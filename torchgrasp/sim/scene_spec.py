"""Parameters of a simulated scene: table, object, neighbours, and a hand on a mount."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchgrasp.checks import checked
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Actuator

if TYPE_CHECKING:
    import trimesh

ARMATURE = 1e-3  # inertia [kg m^2] that each motor's rotor adds to its joint; PhysX's implicit drives need it

TABLE = (2.0, 2.0, 0.1)  # size of the table [m]

LIFT_JOINT, APPROACH_JOINT = "torchgrasp_lift", "torchgrasp_approach"
"""Prismatic joints of the mount: along the world's z axis, and along the approach, where 0 is the hand's pose."""

SHIFT_JOINTS = ("torchgrasp_shift_x", "torchgrasp_shift_y", "torchgrasp_shift_z")
"""Prismatic joints of a mount that yields, along the world's axes."""


@checked
@dataclasses.dataclass(frozen=True)
class Neighbour:
    """A body beside the object.

    Args:
        mesh: closed mesh [m] in the frame of the grasp.
        parts: convex bodies that make up the mesh; None: `convex_parts` of the mesh.
        mass: mass [kg]; None: from `TrialSpec.mass` or `TrialSpec.density`, as for the object.

    >>> import trimesh
    >>> Neighbour(trimesh.creation.box([0.05, 0.05, 0.1]), mass=0.2).mass
    0.2
    """

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh] | None" = None
    mass: float | None = None


@checked
@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body of the simulator: its mesh, convex parts that make up the mesh, and its mass [kg]."""

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh]"
    mass: float

    @property
    def inertia(self) -> np.ndarray:
        """The inertia (3, 3) [kg m^2] of an even filling about the mass centre."""
        return np.asarray(self.mesh.moment_inertia) * (self.mass / self.mesh.volume)


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """Parameters of a scene.

    Args:
        urdf_path: URDF of the hand.
        world_from_hand: pose of the hand (4, 4).
        joints: start position of every joint of the URDF by name [rad].
        drives: drive of every joint by name.
        tip_links: links of the f fingertips, in grasp order.
        mesh: the closed object, which gives table height, mass centre and inertia.
        parts: convex bodies that make up the object.
        mass: mass of the object [kg].
        friction: friction coefficient of every contact.
        gravity: gravity [m/s^2].
        timestep: timestep of the simulator [s].
        travel: largest height [m] of a lift.
        approach: displacement [m] from the hand's start to its pose.
        table: whether there is a table.
        patch: radius [m] of a fingertip's contact patch; torsional friction is friction x force x patch.
        height: height of the table [m]; None: the lowest point of the mesh.
        neighbours: further bodies.
        self_pairs: pairs of the hand's links that collide with each other.
        yields: largest displacement [m] of the mount along each axis of the world; 0: it does not yield.

    >>> from torchgrasp import load_hand, load_object
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> start, tips = dict.fromkeys(hand.tree.joint_names, 0.1), hand.tips.links
    >>> spec = SceneSpec(hand.urdf_path, np.eye(4), start, hand.actuators, tips, jug.mesh, jug.parts, mass=0.2)
    >>> spec.check_drives(list(hand.tree.joint_names))
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
    gravity: float = 9.81
    timestep: float = 1 / 500
    travel: float = 0.1
    approach: tuple[float, float, float] = (0.0, 0.0, 0.0)
    table: bool = True
    patch: float = 0.005
    height: float | None = None
    neighbours: tuple[Body, ...] = ()
    self_pairs: tuple[tuple[str, str], ...] = ()
    yields: float = 0.0

    @property
    def body(self) -> Body:
        """The object as a body."""
        return Body(self.mesh, self.parts, self.mass)

    @property
    def table_height(self) -> float:
        """The height [m] of the table."""
        return float(self.mesh.bounds[0, 2]) if self.height is None else self.height

    @checked
    def check_drives(self, names: list[str]) -> None:
        """Refuse joints without a start position or a drive."""
        missing = [name for name in names if name not in self.joints or name not in self.drives]
        if missing:
            raise BadArgument("joints", f"no position or drive for {missing}", "one for every joint of the URDF")
