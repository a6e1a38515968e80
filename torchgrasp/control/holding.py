"""Hold controllers: press with balanced forces at the contacts, or with the least forces that carry
the sensed load.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.control.least_forces import Balance, LeastForces, balance, friction_ratios
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import Observation, low_pass
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.frames import apply, inverse

MAX_FACTOR = 1.5  # largest factor on the forces; it bounds the force if a sensor reads too little
RAMP = 0.4  # time [s] in which the forces rise to the desired forces
MIN_PUSH = 0.4  # least normal force [N] of a finger: four standard deviations of its reading
# standard deviation of the friction estimate at the start, and its least value
PRIOR_STD = 0.2
MIN_STD = 0.03
LIFTED = 0.35  # load [N] from which the object counts as lifted
# force [N] from any side at the object's centre that a grip withstands without pressing harder
PUSH = 2.5


class ForceHold:
    """Press with balanced forces at the sensed contacts; `start` holds the joint targets [rad] at
    the closing's end.

    The joints stay compliant. Force feedback changes one common factor on all forces, because a
    separate force loop for each finger would push the object away.
    """

    def __init__(
        self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]
    ) -> None:
        self.start = start
        self.rest = observation.joints
        forces, self.strength = held_forces(reference, observation)
        self.lead = torch.einsum("cij,ci->j", observation.jacobian, forces) / reference.kp
        largest = float(torch.linalg.vector_norm(forces, dim=-1).max())
        self.most = (
            MAX_FACTOR
            if reference.max_force is None
            else min(MAX_FACTOR, reference.max_force / largest)
        )
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
    """Return the hold that keeps the joint targets of the closing's end, `start` [rad]."""
    return lambda observation, period: start


def regulate(factor: float, observation: Observation, strength: float, period: float) -> float:
    """Return the common factor on all forces one tick later; it brings the sum of normal forces to
    `strength` [N].
    """
    lacking = 1 - float(observation.tactile.reading.sum()) / strength
    return min(max(factor + period * lacking, 0.5), MAX_FACTOR)


def held_forces(
    reference: ClosingReference, observation: Observation
) -> tuple[Float[Tensor, "f 3"], float]:
    """Return balanced forces [N] on the object, and the sum [N] of their normal parts at tips with
    a working sensor.

    The forces act at the sensed contacts. They sum to a zero wrench. If a finger does not touch, or
    if no such forces exist that press at every contact, the planned forces are returned.
    """
    gains = reference.gains
    normals = reference.normals
    forces = gains.desired_force
    sensed = observation.tactile
    if bool(torch.isfinite(sensed.points).all()) and bool(torch.isfinite(sensed.normals).all()):
        push = -(forces * normals).sum(-1)
        preferred = push[None] if gains.force_source == "stability" else None
        balanced = least_friction_forces(
            sensed.points[None], sensed.normals[None], float(push.max()), preferred
        )[0]
        if bool(torch.isfinite(balanced).all()):
            forces = balanced
            normals = sensed.normals
    return forces, float(-((forces * normals).sum(-1) * reference.alive).sum())


class FrictionEstimate:
    """A running estimate of the friction coefficient: mean and standard deviation, common to all
    fingertips.
    """

    def __init__(self) -> None:
        self.mean = 0.8
        self.std = PRIOR_STD
        self.least = 0.15

    def update(self, ratio: float, force: float, slides: bool = True) -> None:
        """Update the estimate by a fingertip's tangential over normal force, and its normal force
        [N].

        A fingertip that sticks shows that friction is at least its ratio; a slide with a smaller
        ratio is a spin.
        """
        noise = 0.4 * math.hypot(1.0, ratio) / force
        if not slides:
            self.least = max(self.least, ratio - noise)
            self.mean = max(self.mean, self.least)
        elif ratio + noise > self.least:
            weight = self.std**2 / (self.std**2 + noise**2)
            self.mean = min(max(self.mean + weight * (ratio - self.mean), self.least), 1.5)
            self.std = max(self.std * math.sqrt(1 - weight), MIN_STD)

    @property
    def high(self) -> float:
        """An upper bound of the friction coefficient: the mean plus one standard deviation."""
        return self.mean + self.std


class GripHold:
    """Press with the least forces that carry the load felt by the fingertips, and a push of `PUSH`
    from any side.

    Until the lifted load is steady, the reserve also covers the largest weight that an object of
    this size may have. The reserve shrinks where torques or forces would exceed their limits; no
    force exceeds `reference.max_force`. `status` becomes `TOO_HEAVY` when a fingertip slides
    although the torques or forces have reached their limits.
    """

    def __init__(
        self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]
    ) -> None:
        max_force = (
            1000.0 if reference.max_force is None else reference.max_force
        )  # [N], no hand presses as hard
        hand = reference.hand
        self.start = start.numpy()
        self.rest = observation.joints.numpy()
        self.stiffness = reference.kp.numpy()
        effort = np.array([hand.actuators[name].effort for name in hand.tree.joint_names])
        forces, _ = held_forces(reference, observation)
        self.normals = _sensed(observation, reference.normals.numpy())
        self.radius = hand.tips.radius.numpy()
        self.solver = LeastForces(forces.numpy().copy(), effort, max_force)
        push = np.abs((forces.numpy() * self.normals).sum(-1))
        self.planned = np.maximum(push, 0.01 * max(float(push.max()), MIN_PUSH))
        self.grip = np.minimum(push, max_force)  # the closing has pressed so hard
        self.felt = np.zeros((len(push), 3))
        self.load = np.zeros(6)
        self.carried = np.zeros(6)
        self.up = None if reference.table is None else reference.table.normal.numpy()
        self.centre, self.unfelt = likely_body(reference)
        self.friction = FrictionEstimate()
        self.cover = 0.0
        self.aim = self.friction.mean
        self.sent, self.trim, self.most = *np.zeros((2, len(push), 3)), 0.0
        self.time = self.steady = self.over = 0.0
        self.released = self.strained = (
            False  # whether the load is steady, and forces are near their limits
        )
        self.status = Status.OK
        self.slid = np.zeros(len(push))

    @property
    def weight(self) -> float:
        """The size of the force [N] with which the object loads the fingertips, as they feel it."""
        return float(np.linalg.norm(self.load[:3]))

    @property
    def sliding(self) -> np.ndarray:
        """A mask of the fingers that have slid for so long that the filtered forces show the
        friction.
        """
        return self.slid > 0.03  # [s]

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        self.time += period
        # [N/s]
        jacobian = observation.jacobian.numpy()
        fastest_rise = 60.0
        contacts, reserve = self._feel(observation, period)
        self._adapt(observation, period)
        floor = self._bounded(np.maximum(self.cover * self.grip, MIN_PUSH))
        wanted = self.solver.solve(
            contacts, self.normals, jacobian, self.load, self.aim, floor, reserve
        )
        self._judge(wanted, jacobian, period)
        step = self._command(contacts, wanted, period) - self.sent
        length = np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-9)
        self.sent = self.sent + step * np.minimum(1.0, fastest_rise * period / length)
        self.sent /= max(1.0, self.solver.share(self.sent, self.normals, jacobian))
        torque = np.einsum("cij,ci->j", jacobian, self.sent)
        share = min(self.time / RAMP, 1.0)
        return torch.from_numpy(
            self.start + share * (self.rest + torque / self.stiffness - self.start)
        )

    def _bounded(self, push: np.ndarray) -> np.ndarray:
        """Return normal forces [N] of all fingers, reduced where a balance would need forces near
        the largest.
        """
        largest = float((push / self.planned).max() * self.planned.max())
        return push * min(1.0, 0.8 * self.solver.most / max(largest, 1e-9))

    def _feel(self, observation: Observation, period: float) -> tuple[Balance, np.ndarray]:
        """Filter the sensed forces, load and normals; return the contacts' grasp map and each
        finger's reserve [N].
        """
        normals = _sensed(observation, self.normals)
        self.normals = self.normals + low_pass(1.0, period) * (normals - self.normals)
        self.normals /= np.linalg.norm(self.normals, axis=-1, keepdims=True)
        points = observation.tips.numpy() - self.radius[:, None] * self.normals
        touching = observation.tactile.contact.numpy()
        forces = observation.tactile.forces.numpy()
        contacts = balance(points, touching)
        if (
            not touching.all()
            and friction_ratios(contacts.inner(self.solver.start), self.normals).max() > self.aim
        ):
            contacts = balance(points)  # the fingers that touch cannot hold without the others
        self.felt = self.felt + low_pass(8.0, period) * (forces - self.felt)
        load = self._weight(contacts.wrench @ forces.ravel())
        self.load = self.load + low_pass(3.0, period) * (load - self.load)
        self.carried = self.carried + low_pass(0.7, period) * (
            load - self.carried
        )  # a faster one rocks the object
        sure = min(
            max(4.0 * (self.time - 0.4), 0.0), 1.0
        )  # earlier the hand may still reopen beside the object
        push = self.cover * sure * (PUSH + self.unfelt)
        reserve = push * push_reserve(
            contacts, self.normals, self.centre - points.mean(0), self.aim
        )
        return contacts, self._bounded(reserve)

    def _weight(self, load: np.ndarray) -> np.ndarray:
        """Return the part of a load wrench that weight and, once lifted, pushes of `PUSH` can
        cause.
        """
        if self.up is None:
            return load
        lifted = max(float(load[:3] @ self.up), 0.0)
        most = PUSH if self.released else 0.0
        side = load[:3] - float(load[:3] @ self.up) * self.up
        side = side * min(1.0, most / max(float(np.linalg.norm(side)), 1e-9))
        torque = load[3:] * min(
            1.0, 0.1 * (lifted + most) / max(float(np.linalg.norm(load[3:])), 1e-9)
        )
        return np.concatenate([lifted * self.up + side, torque])

    def _adapt(self, observation: Observation, period: float) -> None:
        """Update the friction estimate by sliding fingers, and reduce forces that are not needed."""
        slides = (
            observation.tactile.sliding.numpy() > 0.008
        ) & observation.tactile.contact.numpy()  # [m/s]
        self.slid = np.where(slides, self.slid + period, 0.0)
        if self.time < RAMP:
            return
        push = -(self.felt * self.normals).sum(-1)
        ratios = friction_ratios(self.felt, self.normals)
        for ratio, force, slides in zip(
            ratios.tolist(), push.tolist(), self.sliding.tolist(), strict=True
        ):
            if force > 0.5 * MIN_PUSH:
                self.friction.update(min(ratio, 2.0), force, slides)
        self._release(period)

    def _release(self, period: float) -> None:
        """Once the lifted load is steady, reduce the forces of the closing and the reserve for an
        unknown weight.
        """
        if self.weight > 1.05 * self.most:
            self.most = self.weight
            self.steady = 0.0
        self.steady += period
        if self.steady < 0.3 or self.weight < LIFTED:
            return
        self.released = True
        self.grip, self.unfelt = (
            x * (1 - min(3.0 * period, 1.0)) for x in (self.grip, self.unfelt)
        )

    def _judge(self, wanted: np.ndarray, jacobian: np.ndarray, period: float) -> None:
        """Choose the friction coefficient for the forces of the next tick; judge whether the load
        is too heavy.
        """
        share = self.solver.share(wanted, self.normals, jacobian)
        fastest = 2.0 * period
        self.cover = min(max(self.cover + fastest * (2 if share < 0.95 else -4), 0.0), 1.0)
        goal = self.friction.high if share > 1.0 and self.cover == 0.0 else self.friction.mean
        self.aim += min(max(goal - self.aim, -fastest), fastest)
        self.strained = share > 0.95
        beyond = self.strained and self.cover == 0.0 and bool(self.sliding.any())
        self.over = self.over + period if beyond and self.weight > LIFTED else 0.0
        if self.over > 0.25:  # [s]
            self.status = Status.TOO_HEAVY

    def _command(self, contacts: Balance, wanted: np.ndarray, period: float) -> np.ndarray:
        """Return the fingertip forces [N] to command: `wanted`, corrected by feedback; new load is
        taken up slowly.
        """
        if self.time > RAMP:
            lacking = ((self.felt - wanted) * self.normals).sum(-1)
            self.trim = self.trim - period * 4.0 * lacking[:, None] * self.normals
            flat = self.trim.ravel()
            self.trim = (flat - contacts.inverse @ (contacts.wrench @ flat)).reshape(-1, 3)
            largest, bound = (
                float(np.linalg.norm(x, axis=-1).max()) for x in (self.trim, 0.5 * wanted)
            )
            self.trim = self.trim * min(1.0, bound / max(largest, 1e-9))
        missing = (
            self.load - 0.8 * self.carried
        )  # carrying all of it would press ever harder on a rigid table
        return wanted + self.trim - (contacts.inverse @ missing).reshape(-1, 3)


def push_reserve(
    contacts: Balance, normals: np.ndarray, arm: np.ndarray, friction: float
) -> np.ndarray:
    """Return the normal force [N] that keeps each finger's force in its cone, for a push of 1 N
    from the worst side.

    The push acts at `arm` [m] from the middle of the contacts. The fingers share it like springs of
    equal stiffness.
    """
    pushes = np.concatenate([np.eye(3), np.cross(arm, np.eye(3)).T])
    share = (contacts.inverse @ pushes).reshape(-1, 3, 3)
    along = np.einsum("fi,fij->fj", normals, share)
    across = share - normals[:, :, None] * along[:, None]
    return np.hypot(
        np.linalg.norm(along, axis=-1), np.linalg.norm(across, ord=2, axis=(1, 2)) / friction
    )


def likely_body(reference: ClosingReference) -> tuple[np.ndarray, float]:
    """Return the object's centre [m] in the hand's frame and its largest likely weight [N], from
    what a robot knows.

    The weight is that of water in the volume of the estimated surface, or else of a ball as wide as
    the contacts; a small thing may be of metal.
    """
    field = reference.surface
    points = reference.gains.target
    density = 1000.0
    if field is None or not bool((field.values < 0).any()):
        ball = math.pi / 6 * float(torch.cdist(points, points).max()) ** 3
        return points.mean(0).numpy(), 9.81 * max(density * ball, 0.4)
    shell = (field.values.abs() < field.spacing).nonzero()
    inside = (field.values < 0).nonzero()
    inside = inside[
        ((inside >= shell.amin(0)) & (inside <= shell.amax(0))).all(-1)
    ]  # farther the sign may be wrong
    centre = apply(
        inverse(reference.obj_from_hand),
        (field.origin + field.spacing * inside.double().mean(0))[None],
    )
    return centre[0].numpy(), 9.81 * max(density * len(inside) * field.spacing**3, 0.4)


def _sensed(observation: Observation, normals: np.ndarray) -> np.ndarray:
    """Return the contact normals that the fingertips sense, or the given normals where a fingertip
    senses none.
    """
    sensed = observation.tactile.normals.numpy()
    return np.where(np.isfinite(sensed).all(-1, keepdims=True), sensed, normals)
