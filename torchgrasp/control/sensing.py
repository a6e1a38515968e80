"""Fingertips that tell less than a tactile one: what their controller is told, and how a simulator makes it.

A robot with such sensors fills its `TactileState` by `feel_flags` or `feel_torques`, as by `measure` for tactile ones.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.checks import Positive, checked
from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import Part
from torchgrasp.control.tactile import (
    FLAG_CUTOFF,
    NOISE,
    SAMPLING_RATE,
    TOUCH_ON,
    Noise,
    TactileState,
    TipContact,
    flag,
    low_pass,
    measure,
    no_contact,
    sample,
)
from torchgrasp.errors import BadArgument

FLAGGED = 0.3
"""Reading [N] that stands for a flag: that of a finger which waits, so that the force loop leaves it where it is."""

SWITCH = 0.45
"""Force [N] at which a switch in a fingertip closes; below `TOUCH_ON` it opens. Resistive pads close at .2 to .5 N."""

TORQUE_NOISE = 0.01
"""Standard deviation of a sensed joint torque [N m]: 0.12 N at a fingertip 80 mm away."""

USUAL = 0.5, 3.0
"""Standard deviations [N] of the forces of a grasp across and along the normal: what torques barely tell, as of a
finger stretched out, is none. By plain least squares noise of 1 N touched for the thumb in 2 of 12 grasps."""


@checked
def feel_flags(tactile: TactileState, touching: Bool[Tensor, "f"]) -> TactileState:
    """Return what fingertips report that tell only whether they touch.

    >>> feel_flags(no_contact(), torch.tensor([True, False, False])).reading
    tensor([0.3000, 0.0000, 0.0000], dtype=torch.float64)
    """
    nothing = no_contact(fingers=len(touching))
    reading = FLAGGED * touching.double()
    return dataclasses.replace(nothing, reading=reading, contact=touching, average=reading, age=tactile.age)


@checked
def feel_torques(
    tactile: TactileState,
    reference: ClosingReference,
    jacobian: Float[Tensor, "f 3 j"],
    torques: Float[Tensor, " j"],
    period: Positive,
) -> TactileState:
    """Return what fingertips report whose forces are told by the torques of the joints alone.

    Args:
        tactile: their state before.
        reference: what the hand follows; its normals tell along which direction a finger presses.
        jacobian: of the fingertips by all joints [m/rad], as in `Observation`.
        torques: of all joints [N m] that hold against contacts: without those for weight, friction and acceleration.
        period: since the state before [s].

    Raises:
        BadArgument: a jacobian of another hand.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> reference = ClosingReference.from_grasp(hand, grasp)
    >>> jacobian, none = torch.eye(9)[:, :8].double().reshape(3, 3, 8), torch.zeros(8).double()
    >>> feel_torques(no_contact(), reference, jacobian, none, 0.01).contact
    tensor([False, False, False])
    """
    jacobian, torques = jacobian.double(), torques.double()
    shape = len(reference.normals), 3, len(reference.kp)
    if jacobian.shape != shape:
        found = f"fingertips, 3 and joints {tuple(jacobian.shape)}"
        raise BadArgument("jacobian", found, f"those of the hand, {shape}")
    forces_by, radius = _forces_by_torques(reference, jacobian), reference.hand.tips.radius
    told = measure(tactile, _pushes(reference, forces_by @ torques), reference.normals, radius, period)
    if told.reading is tactile.reading:
        return told
    doubt = torch.einsum("fc,fcj->fj", reference.normals, forces_by).norm(dim=-1) * TORQUE_NOISE / NOISE
    doubt = (doubt * reference.sensor.noise).clamp_min(1.0)
    return dataclasses.replace(told, contact=flag(tactile.contact, told.average, doubt))


def _forces_by_torques(reference: ClosingReference, jacobian: Float[Tensor, "f 3 j"]) -> Float[Tensor, "f 3 j"]:
    """Return the map from torques to the likeliest forces: the mean of a Gaussian, given noise and `USUAL` forces."""
    along = reference.normals[:, :, None] * reference.normals[:, None]
    across, up = ((TORQUE_NOISE / usual) ** 2 for usual in USUAL)
    prior = across * torch.eye(3, dtype=jacobian.dtype) + (up - across) * along
    return torch.linalg.solve(jacobian @ jacobian.mT + prior, jacobian)


def _pushes(reference: ClosingReference, forces: Float[Tensor, "f 3"]) -> TipContact:
    """Return contacts with forces, at places that nobody knows."""
    push, nothing = -(forces * reference.normals).sum(-1), torch.full_like(forces, torch.nan)
    return TipContact(push.clamp_min(0.0), forces, nothing, nothing)


class DriveFeel(Part):
    """What fingers feel by their drives alone: a joint that is kept from its target is pushed against.

    A drive of stiffness k and damping d exerts k (target - q) - d dq/dt. A hand of other drives has their currents.
    """

    def __init__(self, reference: ClosingReference) -> None:
        hand = reference.hand
        self.reference, self.before = reference, reference.expand(reference.pregrasp)
        damping = [hand.actuators[name].kd for name in hand.tree.joint_names]
        self.damping = torch.tensor(damping, dtype=torch.float64)
        self.pushes = torch.zeros_like(reference.normals[:, 0])

    def __call__(self, observation: Observation, targets: Float[Tensor, " j"], period: float) -> Float[Tensor, "f"]:
        """Return how hard each fingertip presses [N], averaged as for a contact flag, by the targets of the tick."""
        joints = observation.joints
        torques = self.reference.kp * (targets - joints) - self.damping * (joints - self.before) / period
        self.before = joints
        forces = _forces_by_torques(self.reference, observation.jacobian) @ torques
        pushes = -(forces * self.reference.normals).sum(-1)
        self.pushes = self.pushes + low_pass(FLAG_CUTOFF, period) * (pushes - self.pushes)
        return self.pushes


class FingertipSensor:
    """Simulated fingertips of a `SensorModel`, as the controller of `reference` knows them.

    Args:
        reference: what the hand follows, with its sensor.
        generator: draws the noise; None: no noise.

    >>> from torchgrasp import SensorModel, load_hand, load_object, plan_grasps
    >>> hand = load_hand("allegro")
    >>> grasp = plan_grasps(load_object("cylinder").view, hand, starts=20)[0]
    >>> reference = ClosingReference.from_grasp(hand, grasp)
    >>> sensor = FingertipSensor(dataclasses.replace(reference, sensor=SensorModel("binary")))
    >>> push = torch.tensor([1.0, 0.0, 0.0]).double()
    >>> jacobian = torch.zeros(3, 3, 16).double()
    >>> truth = TipContact(push, -push[:, None] * reference.normals, reference.gains.target, reference.normals)
    >>> for _ in range(20):
    ...     told = sensor(truth, jacobian, 0.01)
    >>> told.contact
    tensor([ True, False, False])
    """

    def __init__(self, reference: ClosingReference, generator: torch.Generator | None = None) -> None:
        self.reference, self.model = reference, reference.sensor
        self.noise = None if generator is None else Noise(generator, self.model.noise)
        fingers = len(reference.normals)
        self.felt = no_contact(fingers=fingers)
        self.closed = torch.zeros(fingers, dtype=torch.bool)
        self.told = [self.felt]
        self.alive = reference.alive

    def __call__(self, truth: TipContact, jacobian: Float[Tensor, "f 3 j"], period: float) -> TactileState:
        """Return what is told a tick [s] later.

        Args:
            truth: true contacts during the tick.
            jacobian: of the fingertips by all joints [m/rad].
            period: of the tick [s].
        """
        reference, before = self.reference, self.felt
        if self.model.kind == "torque":
            self.felt = feel_torques(before, reference, jacobian, self._torques(truth, jacobian), period)
        else:
            self.felt = sample(before, truth, reference.normals, reference.hand.tips.radius, period, self.noise)
        told = self.felt
        if self.model.kind == "binary":
            self.closed = torch.where(self.closed, told.reading > TOUCH_ON, told.reading >= SWITCH)
            told = feel_flags(told, self.closed)
        if not bool(self.alive.all()):
            told = _silence(told, self.alive)
        fresh = self.felt.reading is not before.reading  # a sample is held until the next one
        late = round(self.model.delay / max(period, 1 / SAMPLING_RATE))
        if fresh:
            self.told = [*self.told, told][-late - 1 :]
        return self.told[0]

    def _torques(self, truth: TipContact, jacobian: Float[Tensor, "f 3 j"]) -> Float[Tensor, " j"]:
        """Return the torques of all joints that contacts cause [N m]; friction at a tip's side turns no joint."""
        torques = torch.einsum("fcj,fc->j", jacobian, truth.forces)
        if self.noise is not None:
            drawn = torch.randn(len(torques), generator=self.noise.generator, dtype=torques.dtype)
            torques = torques + self.noise.scale * TORQUE_NOISE * drawn
        return torques


def _silence(tactile: TactileState, alive: Bool[Tensor, "f"]) -> TactileState:
    """Return a report in which the dead fingertips say nothing."""
    quiet, row = no_contact(fingers=len(alive)), alive[:, None]
    return dataclasses.replace(
        tactile,
        reading=tactile.reading * alive,
        forces=tactile.forces * row,
        contact=tactile.contact & alive,
        points=torch.where(row, tactile.points, quiet.points),
        normals=torch.where(row, tactile.normals, quiet.normals),
        average=tactile.average * alive,
        sliding=tactile.sliding * alive,
    )
