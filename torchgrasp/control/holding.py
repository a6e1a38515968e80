"""Hold controllers: they press with balanced forces, or with the least forces that carry the sensed
load.

A load is a wrench of force [N] and torque [N m] about the centroid of the contacts. All vectors are
in the hand's frame. f counts the fingertips, and j all joints of the URDF.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.control.held_object import LOAD, FrictionEstimate, LoadEstimate, likely_body
from torchgrasp.control.law import TINY
from torchgrasp.control.least_forces import Balance, LeastForces, balance, friction_ratios
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import Observation, smooth
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.linalg import dot, norm
from torchgrasp.hand.drives import drive_efforts
from torchgrasp.values.distribution import Distribution

MAX_FACTOR = 1.5  # largest factor on the forces; it bounds the force if a sensor reads too little
RAMP = 0.4  # time [s] in which the forces rise to the desired forces
# force [N] from any side at the object's centre that a grip withstands without pressing harder
PUSH = 2.5


@dataclasses.dataclass(frozen=True)
class GripNumbers:
    """Parameters of `GripHold`, the holding mode "grip", which carries the sensed load."""

    least_push: float = 0.4
    """Least normal force [N] of a finger: four standard deviations of its reading."""
    planned: float = 0.01
    """Least planned normal force of a finger, as a share of the largest finger's force."""
    fastest: float = 60.0
    """Largest rate [N/s] of a fingertip's force."""
    room: float = 0.8
    """Upper bound of the least normal force that is demanded of a finger, as a share of its largest
    force.
    """
    near: float = 0.95
    """Share of the limits of torque and force above which the forces count as near the limits."""
    normals: float = 1.0
    """Cut-off frequency [Hz] of the low-pass filter of the sensed normals."""
    forces: float = 8.0
    """Cut-off frequency [Hz] of the low-pass filter of the sensed forces."""
    carries: float = 0.8
    """Share of the carried load that is commanded. With 1, the hand would press a rigid table with
    ever growing forces.
    """
    settled: float = 0.4
    """Time [s] after the start of the hold in which the hand may still reopen."""
    sure: float = 4.0
    """Rate [1/s] at which the reserve for a push grows after the time `settled`."""
    slow: float = 0.008
    """Speed [m/s] of a fingertip along the surface above which it slides."""
    slide: float = 0.03
    """Time [s] of sliding after which the filtered forces show the friction."""
    release: float = 3.0
    """Rate [1/s] at which forces that are not needed fall once the load is steady."""
    changes: float = 2.0
    """Largest rate [1/s] of the friction coefficient. The applied share of the reserve rises at
    twice this rate. Near the limits of torque and force it falls at four times this rate.
    """
    over: float = 0.25
    """Time [s] of sliding with forces at their limits after which the load is too heavy."""
    feedback: float = 4.0
    """Gain [1/s] of the feedback of felt forces."""


GRIP = GripNumbers()


class ForceHold:
    """Hold controller that presses with balanced forces at the sensed contacts.

    The joints stay compliant. Force feedback changes one common factor on all forces. A separate
    force loop for each finger would push the object away.

    Args:
        reference: the closing plan.
        observation: the observation at the end of the closing.
        start: targets [rad] of all joints at the end of the closing.
    """

    def __init__(
        self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]
    ) -> None:
        self.start = start
        self.rest = observation.joints
        forces, self.strength = held_forces(reference, observation)
        self.lead = torch.einsum("cij,ci->j", observation.jacobian, forces) / reference.kp
        largest = float(norm(forces).max())
        self.most = MAX_FACTOR
        if reference.max_force is not None:
            self.most = min(MAX_FACTOR, reference.max_force / largest)
        self.factor = min(1.0, self.most)
        self.time = 0.0
        self.senses_force = reference.sensor.kind != "binary"

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        self.time += period
        share = min(self.time / RAMP, 1.0)
        if share == 1.0 and self.senses_force:
            self.factor = min(regulate(self.factor, observation, self.strength, period), self.most)
        return self.start + share * (self.rest + self.factor * self.lead - self.start)


def keep_targets(
    reference: ClosingReference, observation: Observation, start: Tensor
) -> Callable[..., Tensor]:
    """Return a hold controller that always returns `start`, the joint targets (j,) [rad] at the end
    of the closing.

    The controller is a function of an observation and a period [s]. `reference` and `observation`
    are not used; other hold controllers need them.
    """
    return lambda observation, period: start


def regulate(factor: float, observation: Observation, strength: float, period: float) -> float:
    """Return the common `factor` (no unit) on all forces after another control period of `period`
    [s].

    It is `factor` + `period` (1 - s / `strength`), clamped to [0.5, 1.5]. So the sum s [N] of the
    sensed normal forces approaches `strength` [N].
    """
    lacking = 1 - float(observation.tactile.reading.sum()) / strength
    return min(max(factor + period * lacking, 0.5), MAX_FACTOR)


def held_forces(
    reference: ClosingReference, observation: Observation
) -> tuple[Float[Tensor, "f 3"], float]:
    """Return balanced forces [N] of f fingertips on the object in the hand's frame, and the sum [N]
    of their normal parts.

    The sum is over fingertips with a working sensor. The forces act at the sensed contacts, and
    their total wrench is zero. The planned forces are returned if a finger does not touch, or if no
    such forces press at every contact.
    """
    gains = reference.gains
    normals = reference.normals
    forces = gains.desired_force
    sensed = observation.tactile
    placed = torch.isfinite(sensed.points) & torch.isfinite(sensed.normals)
    if bool(placed.all()):
        push = -dot(forces, normals)
        preferred = push[None] if gains.force_source == "stability" else None
        balanced = least_friction_forces(
            sensed.points[None], sensed.normals[None], float(push.max()), preferred
        )[0]
        if bool(torch.isfinite(balanced).all()):
            forces = balanced
            normals = sensed.normals
    pushes = dot(forces, normals) * reference.alive
    return forces, float(-pushes.sum())


class GripHold:
    """Hold controller that presses with the least forces against two loads. They are the sensed
    load and a push of 2.5 N (`PUSH`) from any side.

    Until the lifted load is steady, the forces also allow for the greatest weight that an object of
    this size may have. This reserve shrinks where torques or forces would exceed their limits; no
    force exceeds `reference.max_force`. `status` becomes `TOO_HEAVY` when a fingertip slides
    although the torques or forces have reached their limits. A load is a force [N] and a torque [N
    m] about the contacts' centroid.

    Args:
        reference: the closing plan.
        observation: the observation at the end of the closing.
        start: targets [rad] of all joints at the end of the closing.
    """

    def __init__(
        self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]
    ) -> None:
        # no hand presses with more [N]
        max_force = 1000.0 if reference.max_force is None else reference.max_force
        hand = reference.hand
        self.start = start.numpy()
        self.rest = observation.joints.numpy()
        self.stiffness = reference.kp.numpy()
        forces = held_forces(reference, observation)[0].numpy()
        self.normals = _sensed(observation, reference.normals.numpy())
        self.radius = hand.tips.radius.numpy()
        self.solver = LeastForces(forces.copy(), drive_efforts(hand).numpy(), max_force)
        push = np.abs((forces * self.normals).sum(-1))  # (f,)
        largest = max(float(push.max()), GRIP.least_push)
        self.planned = np.maximum(push, GRIP.planned * largest)
        # the closing has pressed so hard
        self.grip = np.minimum(push, max_force)
        self.felt = np.zeros((len(push), 3))
        up = None if reference.table is None else reference.table.normal.numpy()
        self.load = LoadEstimate(up, PUSH)
        self.centre, self.unfelt = likely_body(reference)
        self.friction = FrictionEstimate(reference.friction)
        self.cover = 0.0
        self.aim = self.friction.mean
        self.sent = np.zeros((len(push), 3))
        self.trim = np.zeros((len(push), 3))
        self.time = 0.0
        self.over = 0.0
        self.strained = False  # whether forces are near their limits
        self.status = Status.OK
        self.slid = np.zeros(len(push))

    @property
    def weight(self) -> float:
        """Magnitude [N] of the low-passed force with which the object loads the fingertips."""
        return self.load.weight

    @property
    def mass(self) -> Distribution | None:
        """The `Distribution` of the object's mass [kg], from the steady load, while nothing else
        pushes at the object.

        None if no load is steady. A load that is too heavy bounds the mass below.
        """
        return self.load.exceeded if self.status is Status.TOO_HEAVY else self.load.mass

    @property
    def sliding(self) -> np.ndarray:
        """Mask (f,) of the fingers that have slid for more than 0.03 s (`GRIP.slide`).

        The filtered forces of these fingers show the friction.
        """
        return self.slid > GRIP.slide

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        self.time += period
        jacobian = observation.jacobian.numpy()
        contacts, reserve = self._feel(observation, period)
        self._adapt(observation, period)
        floor = self._bounded(np.maximum(self.cover * self.grip, GRIP.least_push))
        wanted = self.solver.solve(
            contacts, self.normals, jacobian, self.load.wrench, self.aim, floor, reserve
        )
        self._judge(wanted, jacobian, period)
        step = self._command(contacts, wanted, period) - self.sent
        length = np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), TINY)
        self.sent = self.sent + step * np.minimum(1.0, GRIP.fastest * period / length)
        self.sent /= max(1.0, self.solver.share(self.sent, self.normals, jacobian))
        torque = np.einsum("cij,ci->j", jacobian, self.sent)
        share = min(self.time / RAMP, 1.0)
        targets = self.start + share * (self.rest + torque / self.stiffness - self.start)
        return torch.from_numpy(targets)

    def _bounded(self, push: np.ndarray) -> np.ndarray:
        """Return the normal forces `push` (f,) [N], all reduced if a balance with them would need
        forces near the largest allowed.
        """
        largest = float((push / self.planned).max() * self.planned.max())
        return push * min(1.0, GRIP.room * self.solver.most / max(largest, TINY))

    def _feel(self, observation: Observation, period: float) -> tuple[Balance, np.ndarray]:
        """Filter the sensed forces, load and normals. Return the grasp map of the contacts and the
        reserve (f,) [N] of each finger.
        """
        normals = _sensed(observation, self.normals)
        self.normals = smooth(self.normals, normals, GRIP.normals, period)
        self.normals /= np.linalg.norm(self.normals, axis=-1, keepdims=True)
        points = observation.tips.numpy() - self.radius[:, None] * self.normals  # (f, 3)
        touching = observation.tactile.contact.numpy()
        forces = observation.tactile.forces.numpy()
        contacts = balance(points, touching)
        if not touching.all():
            needed = friction_ratios(contacts.inner(self.solver.start), self.normals).max()
            if needed > self.aim:
                # the fingers that touch cannot hold without the others
                contacts = balance(points)
        self.felt = smooth(self.felt, forces, GRIP.forces, period)
        if observation.up is not None:
            self.load.turn(observation.up.numpy())
        self.load.update(contacts.wrench @ forces.ravel(), period)
        sure = min(max(GRIP.sure * (self.time - GRIP.settled), 0.0), 1.0)
        push = self.cover * sure * (PUSH + self.unfelt)
        arm = self.centre - points.mean(0)
        reserve = push * push_reserve(contacts, self.normals, arm, self.aim)
        return contacts, self._bounded(reserve)

    def _adapt(self, observation: Observation, period: float) -> None:
        """Update the friction estimate by the sensed forces of each finger; reduce forces that are
        not needed.
        """
        tactile = observation.tactile
        slides = (tactile.sliding.numpy() > GRIP.slow) & tactile.contact.numpy()
        self.slid = np.where(slides, self.slid + period, 0.0)
        if self.time < RAMP:
            return
        push = -(self.felt * self.normals).sum(-1)
        ratios = friction_ratios(self.felt, self.normals)
        fingers = zip(ratios.tolist(), push.tolist(), self.sliding.tolist(), strict=True)
        for ratio, force, slides in fingers:
            if force > 0.5 * GRIP.least_push:
                self.friction.update(ratio, force, slides)
        if self.load.settles(period):
            # the closing's forces and the reserve for an unknown weight are no longer needed
            kept = 1 - min(GRIP.release * period, 1.0)
            self.grip = self.grip * kept
            self.unfelt = self.unfelt * kept

    def _judge(self, wanted: np.ndarray, jacobian: np.ndarray, period: float) -> None:
        """Choose the friction coefficient for the next tick, and judge whether the load is too
        heavy.
        """
        share = self.solver.share(wanted, self.normals, jacobian)
        fastest = GRIP.changes * period
        # the applied share of the reserve (0 to 1) falls twice as fast as it grows: at 4 and at 2
        # times the largest rate of the friction coefficient
        cover = self.cover + fastest * (2 if share < GRIP.near else -4)
        self.cover = min(max(cover, 0.0), 1.0)
        goal = self.friction.high if share > 1.0 and self.cover == 0.0 else self.friction.mean
        self.aim += min(max(goal - self.aim, -fastest), fastest)
        self.strained = share > GRIP.near
        beyond = self.strained and self.cover == 0.0 and bool(self.sliding.any())
        self.over = self.over + period if beyond and self.weight > LOAD.lifted else 0.0
        if self.over > GRIP.over:
            self.status = Status.TOO_HEAVY

    def _command(self, contacts: Balance, wanted: np.ndarray, period: float) -> np.ndarray:
        """Return the fingertip forces (f, 3) [N] to command in this tick of `period` seconds.

        They are the `wanted` forces (f, 3) [N] plus a correction. It is the integrated difference
        between wanted and sensed normal forces, without the part that would move the object. Of the
        load, they carry only the share `GRIP.carries` of `LoadEstimate.carried`, so new load is
        taken up slowly. `contacts` is the grasp map of the fingertips.
        """
        if self.time > RAMP:
            lacking = ((self.felt - wanted) * self.normals).sum(-1)
            trim = self.trim - period * GRIP.feedback * lacking[:, None] * self.normals
            # without the part that would move the object
            flat = trim.ravel()
            trim = (flat - contacts.inverse @ (contacts.wrench @ flat)).reshape(-1, 3)
            largest = float(np.linalg.norm(trim, axis=-1).max())
            bound = float(np.linalg.norm(0.5 * wanted, axis=-1).max())
            self.trim = trim * min(1.0, bound / max(largest, TINY))
        missing = self.load.wrench - GRIP.carries * self.load.carried
        return wanted + self.trim - (contacts.inverse @ missing).reshape(-1, 3)


def push_reserve(
    contacts: Balance, normals: np.ndarray, arm: np.ndarray, friction: float
) -> np.ndarray:
    """Return the extra normal force (f,) [N] of each finger against a push of 1 N from the worst
    side.

    With it, the force of the finger stays within the cone of the coefficient `friction`. The push
    acts at `arm` (3,) [m] from the centroid of the `contacts`. `normals` (f, 3) are their outward
    unit normals. All vectors are in one frame. f counts fingers. The fingers share the push like
    springs of equal stiffness.
    """
    sides = np.eye(3)
    pushes = np.concatenate([sides, np.cross(arm, sides).T])  # (6, 3): wrenches
    share = (contacts.inverse @ pushes).reshape(-1, 3, 3)
    along = np.einsum("fi,fij->fj", normals, share)
    across = share - normals[:, :, None] * along[:, None]
    tangential = np.linalg.norm(across, ord=2, axis=(1, 2))
    return np.hypot(np.linalg.norm(along, axis=-1), tangential / friction)


def _sensed(observation: Observation, normals: np.ndarray) -> np.ndarray:
    """Return the contact normals (f, 3) that the fingertips sense, or the given `normals` where a
    fingertip senses none.
    """
    sensed = observation.tactile.normals.numpy()
    return np.where(np.isfinite(sensed).all(-1, keepdims=True), sensed, normals)
