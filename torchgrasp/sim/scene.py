"""The simulated scene of one trial: table, object and a hand on a mount.

Every trial opens a fresh scene: only then do two runs give equal bits. The world's frame is that of the grasp.
"""

import abc
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchgrasp.checks import checked
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Actuator
from torchgrasp.sim.step_contacts import StepContacts, check_vector

if TYPE_CHECKING:
    import trimesh

PATCH_RADIUS = 0.005
"""Radius [m] of the patch in which a soft fingertip touches."""

ARMATURE = 1e-3
"""Inertia [kg m^2] that each motor's rotor adds to its joint; PhysX's implicit drives need one (`sapien_build`)."""

TABLE = (2.0, 2.0, 0.1)
"""Size of the table [m]."""

LIFT_JOINT, APPROACH_JOINT = "torchgrasp_lift", "torchgrasp_approach"
"""Prismatic joints of the mount: along the world's z axis, and along the approach, 0 where the hand has arrived."""

SHIFT_JOINTS = ("torchgrasp_shift_x", "torchgrasp_shift_y", "torchgrasp_shift_z")
"""Prismatic joints of a mount that yields, along the world's axes."""

STILL = np.zeros(3)
"""No force, no torque."""


NEIGHBOURS, TABLETOP, TARGET = range(3)
"""What a hand may touch otherwise than with a finger on the object: the places in `StepContacts.stray`."""


@checked
@dataclasses.dataclass(frozen=True)
class Neighbour:
    """A body that stands or lies beside the object.

    Args:
        mesh: closed [m], where it lies, in the frame of the grasp.
        parts: convex bodies that make up its surface; None: its own decomposition (`convex_parts`).
        mass: [kg]; None: as the object's, by `TrialSpec.mass` or `TrialSpec.density`.

    >>> import trimesh
    >>> box = trimesh.creation.box([0.05, 0.05, 0.1])
    >>> Neighbour(box.apply_translation([0.2, 0.0, 0.05]), parts=[box]).mass is None  # as the object's
    True
    """

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh] | None" = None
    mass: float | None = None


@checked
@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body of the simulator: its mesh, convex parts that make up its surface, and its mass [kg].

    >>> import trimesh
    >>> box = trimesh.creation.box([0.1, 0.1, 0.1])
    >>> Body(box, [box], mass=0.6).inertia.diagonal().round(6)  # m a^2 / 6
    array([0.001, 0.001, 0.001])
    """

    mesh: "trimesh.Trimesh"
    parts: "Sequence[trimesh.Trimesh]"
    mass: float

    @property
    def inertia(self) -> np.ndarray:
        """The inertia (3, 3) [kg m^2] of an even filling about the mass centre."""
        return np.asarray(self.mesh.moment_inertia) * (self.mass / self.mesh.volume)


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """What a scene is made of.

    Args:
        urdf_path: of the hand.
        world_from_hand: pose of the hand (4, 4).
        joints: start position of every joint of the URDF by name [rad].
        drives: of every joint by name.
        tip_links: the f fingertips' links, in grasp order.
        mesh: the closed object, for its table height, mass centre and inertia.
        parts: convex bodies that make up its surface.
        mass: of the object [kg].
        friction: of every contact.
        gravity: [m/s^2].
        timestep: [s].
        travel: how far the hand can be lifted [m].
        approach: displacement [m] from the hand's start to its pose.
        table: whether there is one.
        patch: radius [m] of a fingertip's contact patch; torsional friction is friction x force x patch.
        height: of the table [m]; None: the lowest point of the mesh.
        neighbours: further bodies.
        self_pairs: names of the links of the hand that collide with each other.
        yields: how far [m] the mount can be displaced along each axis of the world; 0: not at all.

    >>> from torchgrasp import load_hand, load_object
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> start = dict.fromkeys(hand.tree.joint_names, 0.1)
    >>> drives, tips = hand.actuators, hand.tips.links
    >>> spec = SceneSpec(hand.urdf_path, np.eye(4), start, drives, tips, jug.mesh, jug.parts, mass=0.2)
    >>> spec.check_drives(list(hand.tree.joint_names))
    >>> spec.body.mass, round(spec.table_height, 3)
    (0.2, 0.0)
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
    patch: float = PATCH_RADIUS
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
        """Refuse joints without a start or a drive."""
        missing = [name for name in names if name not in self.joints or name not in self.drives]
        if missing:
            raise BadArgument("joints", f"no position or drive for {missing}", "one for every joint of the URDF")


class Scene(abc.ABC):
    """Table, object and hand. Arrays are in the world's axes; joints are in the order of `joint_names`.

    `centre` [m] is the object's mass centre in its own frame, `timestep` is in seconds. A simulator sets `joint_names`
    and its handles of bodies.

    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.evaluation import GraspTrial, TrialDriver
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.sim import open_scene
    >>> from torchgrasp.specs import TrialSpec
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "barrett")
    >>> trial = GraspTrial(load_hand("barrett"), grasp, jug.mesh, parts=jug.parts)
    >>> scene = open_scene(TrialDriver(trial, TrialSpec()).scene_spec)
    >>> scene.penetration(), scene.neighbour_poses().shape
    (0.0, (0, 4, 4))
    >>> scene.drive(scene.joints() + 0.1)
    >>> scene.pull(np.array([0.0, 0.0, -1.0]))  # [N]
    >>> scene.approach(0.05, speed=-0.1)
    >>> scene.lift(0.01, speed=0.1)
    >>> scene.shift(np.array([0.001, 0.0, 0.0]))
    >>> scene.step().finger, scene.object_pose().shape, scene.hand_pose().shape
    (array([False, False, False]), (4, 4), (4, 4))
    >>> scene.jacobian(scene.tip_poses()[:, :3, 3]).shape  # [m/rad] by all joints
    (3, 3, 8)
    """

    joint_names: tuple[str, ...]
    body: Any
    root: Any
    tips: list[Any]
    neighbours: list[Any]

    def __init__(self, spec: SceneSpec) -> None:
        self.timestep, self.centre = spec.timestep, np.asarray(spec.mesh.center_mass, float)

    @abc.abstractmethod
    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""

    @abc.abstractmethod
    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""

    @abc.abstractmethod
    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force [N] at the object's mass centre and a torque [N m] from now on."""

    @abc.abstractmethod
    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""

    @abc.abstractmethod
    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d points / d driven joints (f, 3, j) of points on the fingertips."""

    @abc.abstractmethod
    def penetration(self) -> float:
        """Return the initial depth [m] of the hand in anything, itself included."""

    @abc.abstractmethod
    def _pose(self, body: Any) -> np.ndarray:
        """Return the pose (4, 4) of a body by its handle."""

    @abc.abstractmethod
    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint of the mount."""

    @checked
    def lift(self, height: float, speed: float = 0.0) -> None:
        """Set target height [m] and speed [m/s] of the hand."""
        self._move_mount(LIFT_JOINT, height, speed)

    @checked
    def approach(self, left: float, speed: float = 0.0) -> None:
        """Set the remaining length [m] of the approach, and its speed [m/s]."""
        self._move_mount(APPROACH_JOINT, -left, speed)

    @checked
    def shift(self, displacement: np.ndarray, velocity: np.ndarray = STILL) -> None:
        """Set the target displacement [m] of the hand from its path, and its velocity [m/s], if its mount yields."""
        for name, vector in (("displacement", displacement), ("velocity", velocity)):
            check_vector(name, vector)
        for joint, target, speed in zip(SHIFT_JOINTS, displacement, velocity, strict=True):
            self._move_mount(joint, target, speed)

    def neighbour_poses(self) -> np.ndarray:
        """Return the poses (m, 4, 4) of the neighbours."""
        return np.array([self._pose(body) for body in self.neighbours]).reshape(-1, 4, 4)

    def object_pose(self) -> np.ndarray:
        """Return the object's pose (4, 4)."""
        return self._pose(self.body)

    def hand_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the hand's root, after at least one step."""
        return self._pose(self.root)

    def tip_poses(self) -> np.ndarray:
        """Return the poses (f, 4, 4) of the fingertips' links."""
        return np.array([self._pose(tip) for tip in self.tips])
