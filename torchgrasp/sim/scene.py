"""A simulated scene for one trial: table, object and a hand on a mount.

Every trial opens a fresh scene: only then are two runs bitwise equal. The world's frame is the frame of the grasp.
"""

import abc
import dataclasses
from collections.abc import Callable, Iterable
from typing import Annotated, Any, NamedTuple

import numpy as np

from torchgrasp.checks import Range, checked
from torchgrasp.errors import BadArgument
from torchgrasp.sim.scene_spec import APPROACH_JOINT, LIFT_JOINT, SHIFT_JOINTS, SceneSpec

STILL = np.zeros(3)  # no force, no torque

NEIGHBOURS, TABLETOP, TARGET = range(3)
"""Places in `StepContacts.stray`: contacts of the hand that are not a finger's with the object."""


@dataclasses.dataclass(frozen=True)
class StepContacts:
    """True contacts of f fingers with the object, summed over a simulation step.

    Args:
        impulse: normal impulse on the object (f, 3) [N s], without friction.
        moment: contact points weighted by the size of their impulse (f, 3) [N s m].
        weight: sum of the impulse sizes (f,) [N s]; `moment / weight` is the mean contact point.
        finger: whether each finger touches (f,), with its tip or with the link that carries the tip.
        force: force of each fingertip on the object (f, 3) [N], friction included.
        stray: sums of other normal impulses (3,) [N s]: of the hand on neighbours, of the hand on the table, and of
            other links than fingertips on the object.
    """

    impulse: np.ndarray
    moment: np.ndarray
    weight: np.ndarray
    finger: np.ndarray
    force: np.ndarray
    stray: np.ndarray

    @classmethod
    @checked
    def none(cls, fingers: Annotated[int, Range(1, 1000)] = 3) -> "StepContacts":
        """Return sums without any contact."""
        impulse, moment, force = np.zeros((3, fingers, 3))
        return cls(impulse, moment, np.zeros(fingers), np.zeros(fingers, dtype=bool), force, np.zeros(3))


class ContactPoint(NamedTuple):
    """A point where two bodies touch: impulse on the second body (3,) [N s] and its size, and position (3,) [m].

    `force` (3,) [N] on the second body includes friction; 0 if the simulator reports it elsewhere.
    """

    impulse: np.ndarray
    size: float
    place: np.ndarray
    force: np.ndarray | float = 0.0


class Scene(abc.ABC):
    """The interface of a simulated scene: table, object, neighbours and hand.

    Arrays are in the world's axes; joints are in the order of `joint_names`. `centre` [m] is the object's centre of
    mass in its own frame, `timestep` is in seconds. A simulator's subclass sets `joint_names` and the handles of
    bodies, and calls `_map_contacts`.
    """

    joint_names: tuple[str, ...]
    body: Any
    root: Any
    tips: list[Any]
    neighbours: list[Any]

    def __init__(self, spec: SceneSpec) -> None:
        self.timestep, self.centre = spec.timestep, np.asarray(spec.mesh.center_mass, float)

    def _map_contacts(self, tables: Iterable[Any], carriers: Iterable[Any]) -> None:
        """Map bodies to their place in `StepContacts.stray`, and links to fingers.

        `carriers` holds for each fingertip the link that carries it rigidly, or None.
        """
        self._place_of = {self.body: TARGET} | dict.fromkeys(self.neighbours, NEIGHBOURS)
        self._place_of |= dict.fromkeys(tables, TABLETOP)
        self._finger_of = {tip: i for i, tip in enumerate(self.tips)}
        for i, carrier in enumerate(carriers):
            if carrier is not None:
                self._finger_of.setdefault(carrier, i)

    def step(self) -> StepContacts:
        """Advance by one timestep and report the contacts between fingertips and object."""
        contacts = StepContacts.none(len(self.tips))
        for first, second, read in self._advance():
            if (first in self._place_of) == (second in self._place_of):
                continue
            link, other, sign = (second, first, -1.0) if first in self._place_of else (first, second, 1.0)
            finger = self._finger_of.get(link) if other == self.body else None
            if finger is None:
                contacts.stray[self._place_of[other]] += sum(point.size for point in read())
                continue
            for impulse, size, place, force in read():
                if size > 0.0:
                    contacts.finger[finger] = True
                    if link == self.tips[finger]:
                        contacts.impulse[finger] += sign * impulse
                        contacts.moment[finger] += size * place
                        contacts.weight[finger] += size
                        contacts.force[finger] += sign * force
        return contacts

    @abc.abstractmethod
    def _advance(self) -> Iterable[tuple[Any, Any, Callable[[], Iterable[ContactPoint]]]]:
        """Advance by one timestep; yield two bodies that touch, and the function that reads their contact points."""

    @abc.abstractmethod
    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint."""

    @abc.abstractmethod
    def pull(self, force: np.ndarray, torque: np.ndarray = STILL) -> None:
        """Apply a force [N] at the object's mass centre and a torque [N m], in this and all later steps."""

    @abc.abstractmethod
    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad]."""

    @abc.abstractmethod
    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the Jacobian (f, 3, j) of points on the fingertips by the driven joints."""

    @abc.abstractmethod
    def penetration(self) -> float:
        """Return the largest initial penetration depth [m] of the hand, itself included."""

    @abc.abstractmethod
    def _pose(self, body: Any) -> np.ndarray:
        """Return the pose (4, 4) of a body, given its handle."""

    @abc.abstractmethod
    def _move_mount(self, joint: str, target: float, speed: float) -> None:
        """Set target [m] and target speed [m/s] of a joint of the mount."""

    @checked
    def lift(self, height: float, speed: float = 0.0) -> None:
        """Set the target height [m] and the speed [m/s] of the hand's lift."""
        self._move_mount(LIFT_JOINT, height, speed)

    @checked
    def approach(self, left: float, speed: float = 0.0) -> None:
        """Set the target of the remaining approach length [m], and the speed [m/s]."""
        self._move_mount(APPROACH_JOINT, -left, speed)

    @checked
    def shift(self, displacement: np.ndarray, velocity: np.ndarray = STILL) -> None:
        """Set the target displacement [m] of the hand from its path and its velocity [m/s], if the mount can yield."""
        for name, vector in (("displacement", displacement), ("velocity", velocity)):
            if vector.shape != (3,) or vector.dtype.kind not in "iuf":
                raise BadArgument(name, f"shape {vector.shape} of {vector.dtype}", "shape (3,) of numbers")
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
        """Return the poses (f, 4, 4) of the fingertip links."""
        return np.array([self._pose(tip) for tip in self.tips])
