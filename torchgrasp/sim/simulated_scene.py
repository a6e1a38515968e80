"""A simulated scene for one trial: table, object and a hand on a mount.

Every trial opens a fresh scene: only then are two runs bitwise equal. The world's frame is the
frame of the grasp.
"""

import abc
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.sim.scene_spec import APPROACH_JOINT, LIFT_JOINT, SHIFT_JOINTS, SceneSpec

STILL = np.zeros(3)  # no force, no torque
NEIGHBOURS, TABLETOP, TARGET = range(3)
"""Indices into `StepContacts.stray`, which sums contacts of the hand other than those of fingers
with the object.
"""


@dataclasses.dataclass(frozen=True)
class StepContacts:
    """The true contacts of a hand during one timestep; `SimulatedScene.step` returns it.

    Arrays are in the world's frame. f counts the fingertips, in the order of the grasp's contacts.

    Attributes:
        impulse: normal impulse (f, 3) [N s] of each fingertip on the object, without friction.
        moment: sum (f, 3) [N s m] of each fingertip's contact points, weighted by the size of their
            normal impulse. `moment / weight` is the mean contact point [m].
        weight: sum (f,) [N s] of these weights.
        finger: mask (f,) of the fingers that touch the object, with the fingertip or with the link
            that carries it.
        force: force (f, 3) [N] of each fingertip on the object, with friction. SAPIEN measures it
            at the joint that carries the fingertip, and gives 0 without a contact.
        stray: sums (3,) [N s] of the sizes of the hand's unintended normal impulses: on neighbours,
            on the table, on the object. On the object, those of fingertips and the links that carry
            them do not count.
    """

    impulse: np.ndarray
    moment: np.ndarray
    weight: np.ndarray
    finger: np.ndarray
    force: np.ndarray
    stray: np.ndarray


class SimulatedScene(abc.ABC):
    """A simulated scene of one trial: table, object, neighbours and a hand; `open_scene` makes it.

    Arrays are in the world's frame. The hand is carried by a mount, a chain of prismatic joints
    (`SceneSpec.slides`), each with a motor. The j driven joints are all movable joints of the
    hand's URDF. Here f counts the fingertips, in the order of the grasp's contacts.

    Attributes:
        joint_names: names of the j driven joints, in the order of every array of joints.
        spec: the parameters of the scene.
        timestep: time [s] of a step of the simulator.
        centre: centre of mass (3,) [m] of the object, in the object's frame.
        body: the simulator's handle of the object.
        root: the simulator's handle of the hand's root link.
        tips: the simulator's handles of the links of the f fingertips.
        neighbours: the simulator's handles of the other bodies.
    """

    # The class of a simulator sets these, then calls `_map_contacts`.
    joint_names: tuple[str, ...]
    body: Any
    root: Any
    tips: list[Any]
    neighbours: list[Any]

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec
        self.timestep = spec.timestep
        self.centre = np.asarray(spec.mesh.center_mass, float)

    def _map_contacts(self, tables: Iterable[Any], carriers: Iterable[Any]) -> None:
        """Store which index into `StepContacts.stray` belongs to each body, and which finger to
        each link.

        `tables` are the table's bodies. `carriers` holds for each fingertip the link that carries
        it rigidly, or None.
        """
        self._place_of = {self.body: TARGET} | dict.fromkeys(self.neighbours, NEIGHBOURS)
        self._place_of |= dict.fromkeys(tables, TABLETOP)
        self._finger_of = {tip: i for i, tip in enumerate(self.tips)}
        for i, carrier in enumerate(carriers):
            if carrier is not None:
                self._finger_of.setdefault(carrier, i)

    def step(self) -> StepContacts:
        """Advance by one timestep; return the contacts of the hand during it.

        The result holds impulses [N s], forces [N] and contact points (`StepContacts`), summed for
        each fingertip.
        """
        sums = [[0.0] * 10 for _ in self.tips]
        finger = [False] * len(self.tips)
        stray = [0.0] * 3
        for first, second, contact in self._advance():
            if (first in self._place_of) == (second in self._place_of):
                continue
            link = first
            other = second
            sign = 1.0
            if first in self._place_of:
                link = second
                other = first
                sign = -1.0
            touching = self._finger_of.get(link) if other == self.body else None
            if touching is None:
                stray[self._place_of[other]] += sum(size for size, _ in self._read(contact, sign))
                continue
            for size, numbers in self._read(contact, sign):
                if size > 0.0:
                    finger[touching] = True
                    if link == self.tips[touching]:
                        # Python's numbers are faster than short arrays.
                        row = sums[touching]
                        for column, number in enumerate(numbers):
                            row[column] += number
        found = np.array(sums)
        return StepContacts(
            found[:, :3],
            found[:, 3:6],
            found[:, 6],
            np.array(finger),
            found[:, 7:],
            np.array(stray),
        )

    @abc.abstractmethod
    def skip(self, steps: int) -> None:
        """Advance the simulation by `steps` timesteps, without a report of contacts."""

    @abc.abstractmethod
    def _advance(self) -> Iterable[tuple[Any, Any, Any]]:
        """Advance by one timestep; yield each pair of bodies that touch, with an argument of
        `_read`.
        """

    @abc.abstractmethod
    def _read(self, contact: Any, sign: float) -> Iterable[tuple[float, Iterable[float]]]:
        """Yield size [N s] and numbers of each point of a contact; points with an impulse of zero
        may be left out.

        The numbers are normal impulse (3,) [N s], place times size (3,) [N s m], size, and force
        (3,) [N] if known. They are on the second body, or on the first if the `sign` is -1.
        """

    @abc.abstractmethod
    def keep(self) -> "Callable[[], SimulatedScene]":
        """Return a function without arguments; each call returns a new copy of this scene as it is
        now.

        Each copy continues with bitwise the same results as this scene. So several pulls can start
        from one closed grasp.
        """

    @abc.abstractmethod
    def drive(self, targets: np.ndarray) -> None:
        """Set the target positions (j,) [rad or m] of the j driven joints.

        They are in the order of `joint_names`, and hold until the next call.
        """

    @abc.abstractmethod
    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force (3,) [N] at the object's centre of mass, and a torque (3,) [N m].

        Both are in the world's frame, and act in all later steps until the next call.
        """

    @abc.abstractmethod
    def displace(self, shift: np.ndarray) -> None:
        """Move the object at once by a displacement `shift` (3,) [m] in the world's frame.

        Trials call it to displace the object while the hand approaches.
        """

    @abc.abstractmethod
    def joints(self) -> np.ndarray:
        """Return the positions (j,) [rad or m] of the j driven joints, in the order of
        `joint_names`.
        """

    @abc.abstractmethod
    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the Jacobian (f, 3, j) of one point on each fingertip with respect to the j driven
        joints: the movable joints of the hand's URDF, not those of the mount.

        Points and result are in the world's frame. The columns are in the order of `joint_names`.
        Their unit is [m/rad]; columns of joints that slide have none.

        Args:
            points: a point (f, 3) [m] on each fingertip.
        """

    @abc.abstractmethod
    def penetration(self) -> float:
        """Return the largest depth [m] by which the hand penetrates another body or itself.

        It is at most 0 if the hand penetrates nothing. Call it before the first step. It may change
        the scene: with SAPIEN it advances the scene by a timestep, in which objects do not fall.
        """

    @abc.abstractmethod
    def _pose(self, body: Any) -> np.ndarray:
        """Return the pose (4, 4) of a body in the world's frame, given the simulator's handle of
        the body.
        """

    @abc.abstractmethod
    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint of the mount."""

    @checked
    def lift(self, height: float, speed: float = 0.0) -> None:
        """Set the target height and speed of the mount's lift along the world's z axis, until the
        next call.

        A motor of the mount holds the position `height` and the speed `speed` like a spring and a
        damper. A `height` above `SceneSpec.travel` may not be reached.

        Args:
            height: target height [m] of the mount above its start.
            speed: speed [m/s] at which the target itself moves. 0 means that the mount comes to
                rest at `height`.
        """
        self._drive_mount(LIFT_JOINT, height, speed)

    @checked
    def approach(self, left: float, speed: float = 0.0) -> None:
        """Set the target of the mount's motion along `SceneSpec.approach`, until the next call.

        Args:
            left: target distance [m] of the mount from the end of the approach, where the hand is
                at `SceneSpec.world_from_hand`.
            speed: speed [m/s] at which the target itself moves forward; negative backward. 0 means
                that the mount comes to rest at `left`.

        Raises `BadArgument` for a scene whose `SceneSpec.approach` is zero.
        """
        self._drive_mount(APPROACH_JOINT, -left, speed)

    @checked
    def shift(self, displacement: np.ndarray, velocity: np.ndarray = STILL) -> None:
        """Set the target of the mount's displacement along the world's axes, until the next call.
        It adds to approach and lift.

        Args:
            displacement: target displacement (3,) [m] in the world's frame.
            velocity: velocity (3,) [m/s] in the world's frame at which the target itself moves. 0
                means that the mount comes to rest at `displacement`.

        Raises `BadArgument` unless both arrays have the shape (3,) and are integers or floats. It
        is also raised for a scene whose `SceneSpec.yields` is 0.
        """
        for name, vector in (("displacement", displacement), ("velocity", velocity)):
            if vector.shape != (3,) or vector.dtype.kind not in "iuf":
                raise BadArgument(
                    name, f"shape {vector.shape} of {vector.dtype}", "shape (3,) of numbers"
                )
        for joint, target, speed in zip(SHIFT_JOINTS, displacement, velocity, strict=True):
            self._drive_mount(joint, target, speed)

    def _drive_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint, which the mount must have."""
        try:
            self._move_mount(joint, target, speed)
        except KeyError:
            allowed = "SceneSpec.approach, yields or mount that give it one"
            raise BadArgument("mount", f"no joint {joint}", allowed) from None

    def neighbour_poses(self) -> np.ndarray:
        """Return the rigid transform of each of m neighbours since the start, (m, 4, 4) [m], in the
        world's frame.

        They are in the order of `SceneSpec.neighbours`. A transform takes the points of a body's
        mesh from the initial to the present position. So it is the identity at the start.
        """
        return np.array([self._pose(body) for body in self.neighbours]).reshape(-1, 4, 4)

    def object_pose(self) -> np.ndarray:
        """Return the rigid transform (4, 4) [m] that has moved the object since the start, in the
        world's frame.

        It takes the points of the object's mesh from the initial to the present position. So it is
        the identity at the start.
        """
        return self._pose(self.body)

    def hand_pose(self) -> np.ndarray:
        """Return the pose (4, 4) [m] of the hand's root link in the world's frame.

        It is valid only after the first step.
        """
        return self._pose(self.root)

    def tip_poses(self) -> np.ndarray:
        """Return the poses (f, 4, 4) [m] of the links of the f fingertips in the world's frame."""
        return np.array([self._pose(tip) for tip in self.tips])
