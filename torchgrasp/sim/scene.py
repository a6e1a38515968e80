"""The simulated scene of one trial, whatever simulates it: table, object and a hand that can be lifted.

`SceneSpec` says what is in the scene, `Scene` what can be done with it. Every trial opens a fresh one: only then are two
runs equal to the last bit. Positions are in the object's frame, which is the world's.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Actuator

if TYPE_CHECKING:
    import trimesh

PATCH_RADIUS = 0.005
"""Radius [m] of the patch in which a soft fingertip touches."""

ARMATURE = 1e-3
"""Inertia [kg m^2] that each motor's rotor adds to its joint."""

TABLE = (2.0, 2.0, 0.1)
"""Size of the table [m]; its top is where the mesh is lowest."""


STILL = np.zeros(3)
"""No force, no torque."""


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """What a scene is made of.

    Args:
        urdf_path: of the hand.
        world_from_hand: pose of the hand (4, 4).
        joints: start position of every joint of the URDF by name [rad].
        drives: stiffness, damping and largest torque of every joint by name.
        tip_links: the three fingertips' links, in the order of the fingers.
        mesh: the closed object, for its table height, mass centre and inertia.
        parts: convex bodies that make up its surface.
        mass: of the object [kg].
        friction: of every contact.
        gravity: [m/s^2].
        timestep: [s].
        travel: how far the hand can be lifted [m].
        approach: the straight way [m] in the world on which the hand comes to its pose; it starts at its other end.
        table: whether there is one.
        patch: radius [m] of the patch in which a fingertip touches; its torsional friction is friction x force x patch.
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


@dataclasses.dataclass(frozen=True)
class StepContacts:
    """The true state after one step: contacts of the fingertips with the object, summed over the step.

    `impulse` [N s] (3, 3) is along the contact normals (friction is not in it) and acts on the object; `moment` [N s m]
    and `weight` [N s] sum the contact points weighted by impulse, so that their quotient is the mean contact point;
    `finger` tells which fingers touch, by the tip or by the link that carries it; `force` [N] (3, 3) is what each
    fingertip that touches exerts on the object, friction included.
    """

    impulse: np.ndarray
    moment: np.ndarray
    weight: np.ndarray
    finger: np.ndarray
    force: np.ndarray


@runtime_checkable
class Scene(Protocol):
    """Table, object and hand; arrays are in the world's axes, and of joints in the order of `joint_names`.

    `centre` is the object's mass centre in its own frame [m] and `timestep` in seconds.
    """

    joint_names: tuple[str, ...]
    centre: np.ndarray
    timestep: float

    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""
        ...

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""
        ...

    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Let a force [N] at the object's mass centre and a torque [N m] act on it from now on."""
        ...

    def lift(self, height: float, speed: float = 0.0) -> None:
        """Set the height [m] that the hand is to be lifted to, and the speed [m/s] at which that target moves."""
        ...

    def approach(self, left: float, speed: float = 0.0) -> None:
        """Set what is to be left [m] of the hand's approach, and the speed [m/s] at which it goes on."""
        ...

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""
        ...

    def object_pose(self) -> np.ndarray:
        """Return the object's pose (4, 4)."""
        ...

    def hand_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the hand's root link, after at least one step."""
        ...

    def tip_poses(self) -> np.ndarray:
        """Return the poses (3, 4, 4) of the fingertips' links."""
        ...

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d points / d driven joints (3, 3, j), each point fixed to its fingertip [m/rad or 1]."""
        ...

    def penetration(self) -> float:
        """Return how deep [m] the hand is in the object or the table; to be asked before anything else moves."""
        ...


def check_drives(setup: SceneSpec, names: list[str]) -> None:
    """Raise `BadArgument` when one of the hand's joints has no start or no drive."""
    missing = [name for name in names if name not in setup.joints or name not in setup.drives]
    if missing:
        raise BadArgument("joints", f"no position or drive for {missing}", "one for every joint of the URDF")
