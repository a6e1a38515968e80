"""Simpler fingertip sensors than tactile ones: binary contact or joint torques; and simulated
sensors with delay, noise and failures.

A robot with such sensors makes its `TactileState` with `feel_flags` or `feel_torques` instead of
`measure`. Here f counts fingertips, and j all joints of the URDF.
"""

import dataclasses
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import (
    FLAG_CUTOFF,
    NOISE,
    SAMPLING_RATE,
    TOUCH_ON,
    Observation,
    TactileState,
    TipContact,
    flag,
    measure,
    no_contact,
    silenced,
    smooth,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.linalg import dot, norm

WAITING_FORCE = 0.3
"""Largest force [N] of a finger that waits until the others touch; also the reading [N] of a binary
sensor in contact.
"""
TORQUE_NOISE = 0.01  # standard deviation [N m] of a sensed joint torque
# largest torque that is felt, as a multiple of the strongest drive's: a blow; more is another unit
MOST_TORQUE = 10.0
SWITCH_ON = 0.45  # reading [N] at which a binary contact closes; it opens at `TOUCH_ON`
# standard deviations [N] of a contact force across and along the normal, before it is sensed
ACROSS_STD = 0.5
ALONG_STD = 3.0


@checked
def feel_flags(tactile: TactileState, touching: Bool[Tensor, "f"]) -> TactileState:
    """Return the tactile state, readings and filters, of f fingertips that sense only whether they
    touch.

    The `reading` of a fingertip that touches is 0.3 N (`WAITING_FORCE`), that of any other one 0.
    The `forces` are 0. Contact points and normals are NaN.

    Args:
        tactile: the state at the last control tick; `no_contact` returns the first one.
        touching: mask (f,) of the fingertips that touch.

    >>> feel_flags(no_contact(), torch.tensor([True, False, False])).reading
    tensor([0.3000, 0.0000, 0.0000], dtype=torch.float64)
    """
    nothing = no_contact(fingers=len(touching))
    reading = WAITING_FORCE * touching.double()
    return dataclasses.replace(
        nothing, reading=reading, contact=touching, average=reading, age=tactile.age
    )


@checked
def feel_torques(
    tactile: TactileState,
    reference: ClosingReference,
    jacobian: Float[Tensor, "f 3 j"],
    torques: Float[Tensor, " j"],
    period: Annotated[float, Range(1e-06, 1.0)],
) -> TactileState:
    """Return the tactile state, readings and filters, of f fingertips whose forces are estimated
    from joint torques.

    j counts all joints of the URDF, in the order of `hand.tree.joint_names`. Contact points and
    normals of the state are NaN.

    Args:
        tactile: the state at the last tick; `no_contact` returns the first one.
        reference: the closing plan; its normals give the direction in which a finger presses.
        jacobian: Jacobian (f, 3, j) [m/rad, or no unit for a sliding joint] of the centres of the
            fingertips. It is in the frame of the hand's root link (`Observation.jacobian`).
        torques: torques (j,) [N m, or N for a sliding joint] by which the joints press on the
            object. Each is positive in the direction of its joint. The caller must first subtract
            the torques of weight, friction and acceleration.
        period: time [s] since the last readings, 1e-6 to 1.

    Raises `BadArgument` for a Jacobian with the shape of another hand, and a period out of range.
    Raises it for torques beyond ten times the hand's largest (`MOST_TORQUE`), which are in another
    unit.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> reference = ClosingReference.from_grasp(load_hand("barrett"), grasp)
    >>> feel_torques(no_contact(), reference, torch.ones(3, 3, 8), torch.zeros(8), 0.01).contact
    tensor([False, False, False])
    """
    jacobian = jacobian.double()
    torques = torques.double()
    shape = len(reference.normals), 3, len(reference.kp)
    if jacobian.shape != shape:
        found = f"fingertips, 3 and joints {tuple(jacobian.shape)}"
        raise BadArgument("jacobian", found, f"those of the hand, {shape}")
    largest = float(torques.abs().max())
    effort = max(drive.effort for drive in reference.hand.actuators.values())
    if largest > MOST_TORQUE * effort:
        found = f"{largest:.3g}, where the strongest drive of the hand has {effort:g}"
        raise BadArgument("torques", found, "torques in N m, or forces of sliding joints in N")
    return _felt_by_torques(tactile, reference, jacobian, torques, period)


def _felt_by_torques(
    tactile: TactileState,
    reference: ClosingReference,
    jacobian: Float[Tensor, "f 3 j"],
    torques: Float[Tensor, " j"],
    period: float,
) -> TactileState:
    """Return the tactile state of f fingertips whose forces are estimated from the torques [N m] of
    j joints; the arguments are those of `feel_torques`.
    """
    forces_by = _forces_by_torques(reference, jacobian)
    radius = reference.hand.tips.radius
    forces = forces_by @ torques
    push = -dot(forces, reference.normals)
    nowhere = torch.full_like(forces, torch.nan)
    pushes = TipContact(push.clamp_min(0.0), forces, nowhere, nowhere)
    sensed = measure(tactile, pushes, reference.normals, radius, period)
    if sensed.reading is tactile.reading:
        return sensed
    # thresholds of flags grow where torques tell a force less surely than a tactile fingertip
    along = torch.einsum("fc,fcj->fj", reference.normals, forces_by)
    factor = norm(along) * TORQUE_NOISE / NOISE
    factor = (factor * reference.sensor.noise).clamp_min(1.0)
    return dataclasses.replace(sensed, contact=flag(tactile.contact, sensed.average, factor))


def _forces_by_torques(
    reference: ClosingReference, jacobian: Float[Tensor, "f 3 j"]
) -> Float[Tensor, "f 3 j"]:
    """Return the matrix [1/m] that maps torques [N m] of all joints to each finger's most probable
    contact force [N].
    """
    along = reference.normals[:, :, None] * reference.normals[:, None]
    across = (TORQUE_NOISE / ACROSS_STD) ** 2
    up = (TORQUE_NOISE / ALONG_STD) ** 2
    prior = across * torch.eye(3, dtype=jacobian.dtype) + (up - across) * along
    return torch.linalg.solve(jacobian @ jacobian.mT + prior, jacobian)


class DriveFeel:
    """Estimator of contact forces from the joint drives alone: a call returns the low-passed normal
    force (f,) [N] of each fingertip.

    The call takes an `Observation`, the targets (j,) [rad] of all joints, and the period [s] of
    control. A drive of stiffness k and damping d exerts the torque k (target - q) - d dq/dt. Here q
    is the joint angle. A joint that is blocked does not reach its target, so this torque shows the
    force at its fingertip. f counts fingertips, and j all joints of the URDF.

    Args:
        reference: the closing plan, with the hand, its drives and the planned contact normals.
    """

    def __init__(self, reference: ClosingReference) -> None:
        hand = reference.hand
        self.reference = reference
        self.before = reference.expand(reference.pregrasp)
        damping = [hand.actuators[name].kd for name in hand.tree.joint_names]
        self.damping = torch.tensor(damping, dtype=torch.float64)
        self.pushes = torch.zeros_like(reference.normals[:, 0])

    def __call__(
        self, observation: Observation, targets: Float[Tensor, " j"], period: float
    ) -> Float[Tensor, "f"]:
        """Return the low-passed normal force (f,) [N] of each fingertip.

        `targets` [rad] are those of all joints in the tick of `period` [s].
        """
        joints = observation.joints
        damped = self.damping * (joints - self.before) / period
        torques = self.reference.kp * (targets - joints) - damped
        self.before = joints
        forces = _forces_by_torques(self.reference, observation.jacobian) @ torques
        pushes = -dot(forces, self.reference.normals)
        self.pushes = smooth(self.pushes, pushes, FLAG_CUTOFF, period)
        return self.pushes


class FingertipSensor:
    """Simulator of the fingertip sensors that a `SensorModel` describes.

    Call it at each control tick, a period of the controller, with three arguments. The first holds
    the true contacts (`TipContact`). The second is the fingertips' Jacobian (f, 3, j) [m/rad]
    (`Observation.jacobian`). The third is the tick's length [s]. It returns the readings
    (`TactileState`).

    Args:
        reference: the closing plan; its `sensor` is the sensor model.
        generator: draws the noise; None means no noise.

    Raises `BadArgument` if the sensor model names an unknown finger as dead.
    """

    def __init__(
        self, reference: ClosingReference, generator: torch.Generator | None = None
    ) -> None:
        self.reference = reference
        self.model = reference.sensor
        self.generator = generator
        fingers = len(reference.normals)
        self.sensed = no_contact(fingers=fingers)
        self.switched = torch.zeros(fingers, dtype=torch.bool)
        self.reports = [self.sensed]
        self.alive = reference.alive
        self.whole = bool(reference.alive.all())

    def __call__(
        self, truth: TipContact, jacobian: Float[Tensor, "f 3 j"], period: float
    ) -> TactileState:
        """Return what the sensors report at the end of a control tick, with the sensor's delay.

        Args:
            truth: true contacts of the f fingertips, averaged over the tick.
            jacobian: Jacobian (f, 3, j) [m/rad] of the fingertips with respect to all j joints of
                the URDF (`Observation.jacobian`).
            period: length [s] of the tick.
        """
        reference = self.reference
        before = self.sensed
        if self.model.kind == "torque":
            torques = torch.einsum("fcj,fc->j", jacobian, truth.forces)
            if self.generator is not None:
                drawn = torch.randn(len(torques), generator=self.generator, dtype=torques.dtype)
                torques = torques + self.model.noise * TORQUE_NOISE * drawn
            self.sensed = _felt_by_torques(before, reference, jacobian, torques, period)
        else:
            radius = reference.hand.tips.radius
            noise = self.model.noise
            self.sensed = measure(
                before, truth, reference.normals, radius, period, self.generator, noise
            )
        report = self.sensed
        if self.model.kind == "binary":
            stays = report.reading > TOUCH_ON
            self.switched = torch.where(self.switched, stays, report.reading >= SWITCH_ON)
            report = feel_flags(report, self.switched)
        if not self.whole:
            report = silenced(report, self.alive)
        late = round(self.model.delay / max(period, 1 / SAMPLING_RATE))
        if self.sensed.reading is not before.reading:  # a sample is held until the next one
            self.reports = [*self.reports, report][-late - 1 :]
        return self.reports[0]
