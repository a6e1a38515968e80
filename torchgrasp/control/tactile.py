"""Observations of a hand, and simulated tactile fingertips with noise, lag and sampling.

f counts fingertips, h actuated joints, and j all joints of the URDF.
"""

import dataclasses
import math
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import FINGERTIPS, Value, check_device, map_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import ANY, Count, Range
from torchgrasp.geometry.linalg import unit
from torchgrasp.hand.hand import Hand

SAMPLING_RATE = 100.0  # samples of a fingertip a second [Hz]
NOISE = 0.1  # standard deviation [N] of the normal force (Sec. 6.5).
FLAG_CUTOFF = 5.0  # cut-off [Hz] of the average force behind the contact flag
# average force [N] at which the contact flag turns on; it turns off at half of this force
TOUCH_ON = 0.2
EARLY = 1e-9  # largest rounding [s] of times that are sums of ticks
STILL = torch.zeros(3, dtype=torch.float64)  # displacement of a palm that stays on its path
Filtered = TypeVar("Filtered", Tensor, np.ndarray, float)


@dataclasses.dataclass(frozen=True)
class TactileNumbers:
    """Parameters of simulated fingertip sensors. The standard deviation of their normal force is
    0.1 N (`NOISE`).
    """

    cutoff: float = 20.0
    """Cut-off frequency [Hz] of the low-pass filter that models the lag of the sensor."""
    tangential: float = 0.3
    """Standard deviation [N] of the sensed force along the surface."""
    place: float = 1.5e-3
    """Standard deviation [m] of the sensed position of the contact, on each axis along the
    surface.
    """
    slide: float = 2e-3
    """Standard deviation [m/s] of the sensed sliding speed."""
    radius: float = 0.012
    """Radius [m] that is assumed for fingertips that are not round."""


TACTILE = TactileNumbers()
ASTRAY = 1.0
"""Distance [rad or m] of a measured joint beyond its limits that no encoder's error explains."""


@checked
@dataclasses.dataclass(frozen=True)
class TipContact(Value):
    """True contacts of f fingertips, averaged over a control tick, in the frame of the hand's root
    link.

    A simulator makes it for `measure` or a `FingertipSensor`. All tensors may have further leading
    axes `*b`, the same for all.

    Args:
        normal_force: normal force (*b, f) [N] on the object, along the inward normal; 0 without
            contact.
        forces: full force (*b, f, 3) [N] on the object, friction included; 0 without contact.
        points: contact points (*b, f, 3) [m]; NaN without contact.
        normals: outward unit normals (*b, f, 3) of the object; NaN without contact.
        sliding: speed (*b, f) [m/s] of each tip along the surface; None means that no tip slides.
    """

    normal_force: Float[Tensor, "*b f"]
    forces: Float[Tensor, "*b f 3"]
    points: Annotated[Float[Tensor, "*b f 3"], ANY]
    normals: Annotated[Float[Tensor, "*b f 3"], ANY]
    sliding: Float[Tensor, "*b f"] | None = None


@checked
@dataclasses.dataclass(frozen=True)
class TactileState(Value):
    """Readings of f fingertips in the frame of the hand's root link, and the state of their
    filters.

    `no_contact` returns the first one. `measure`, `feel_flags` or `feel_torques` then return one at
    each tick, a period of the controller. All tensors may have further leading axes `*b`, the same
    for all.

    Args:
        reading: normal force (*b, f) [N].
        forces: full force (*b, f, 3) [N] on the object, friction included.
        contact: mask (*b, f) of the fingertips that touch.
        points: contact points (*b, f, 3) [m]; NaN where the sample has none. `contact` may lag
            behind it.
        normals: outward unit normals (*b, f, 3) of the object; NaN as in `points`.
        lagged: low-passed values (*b, f, 5): normal force [N] (entry 0), full force [N] (1 to 3),
            sliding speed [m/s] (4).
        average: low-passed normal force (*b, f) [N], by which `contact` is decided.
        sliding: sliding speed (*b, f) [m/s].
        age: time [s] since the last sample was due.
    """

    reading: Float[Tensor, "*b f"]
    forces: Float[Tensor, "*b f 3"]
    contact: Bool[Tensor, "*b f"]
    points: Annotated[Float[Tensor, "*b f 3"], ANY]
    normals: Annotated[Float[Tensor, "*b f 3"], ANY]
    lagged: Float[Tensor, "*b f 5"]
    average: Float[Tensor, "*b f"]
    sliding: Float[Tensor, "*b f"]
    age: float


@checked
def no_contact(*batch: Count, fingers: Annotated[int, Range(*FINGERTIPS)] = 3) -> TactileState:
    """Return the tactile state, readings and filters, of fingertips that touch nothing: the first
    state of a closing.

    Forces are 0, contact points and normals NaN, in float64 on the CPU. The fingertips are sampled
    at the next control tick, a period of the controller.

    Args:
        batch: sizes of further leading axes of all tensors; by default none.
        fingers: number of fingertips, 3 to 5.

    Raises `BadArgument` for another number of fingertips, or a size below 1.

    >>> no_contact().contact
    tensor([False, False, False])
    """
    lagged = torch.zeros(*batch, fingers, 5, dtype=torch.float64)
    zero = lagged[..., 0]
    vectors = lagged[..., 1:4]
    nothing = torch.full_like(vectors, torch.nan)
    return TactileState(
        zero, vectors, zero > 0, nothing, nothing, lagged, zero, zero, 1 / SAMPLING_RATE
    )


def silenced(tactile: TactileState, alive: Bool[Tensor, "f"]) -> TactileState:
    """Return readings with those of `no_contact` where a sensor is not `alive` (f,)."""

    def choose(sensed: Tensor, nothing: Tensor) -> Tensor:
        return torch.where(alive if sensed.ndim == 1 else alive[:, None], sensed, nothing)

    return map_tensors(choose, tactile, no_contact(fingers=len(alive)))


@checked
def measure(
    tactile: TactileState,
    truth: TipContact,
    pads: Float[Tensor, "*#b f 3"],
    radius: Float[Tensor, "f"],
    period: Annotated[float, Range(1e-06, 1.0)],
    generator: torch.Generator | None = None,
    noise: Annotated[float, Range(0.0, 100.0)] = 1.0,
) -> TactileState:
    """Return the simulated tactile state, readings and filters, one control tick later, with lag,
    noise and sampling of the sensors.

    Vectors are in the frame of the hand's root link. f counts fingertips, and `*b` stands for
    leading axes that all tensors share. The sensors are sampled at 100 Hz (`SAMPLING_RATE`). In a
    tick without a sample, only `lagged` and `age` change.

    Args:
        tactile: the state at the last tick; `no_contact` returns the first one.
        truth: true contacts in this tick.
        pads: outward unit normals (*b, f, 3) of the object's surface at the planned contacts. They
            direct the noise of tips that touch nothing.
        radius: radius (f,) [m] of the tips. 0 means that a tip is not round; then 12 mm
            (`TACTILE.radius`) is assumed.
        period: length [s] of the tick.
        generator: draws the noise; None means no noise.
        noise: factor (no unit) on the standard deviations of the noise.

    Raises `BadArgument` for true contacts on another device than the state, or of another number of
    fingertips.

    >>> normals, pressed = torch.eye(3).double(), torch.tensor([2.0, 0.0, 1.0]).double()  # [N]
    >>> truth = TipContact(pressed, -pressed[:, None] * normals, 0.03 * normals, normals)
    >>> felt = measure(no_contact(), truth, normals, torch.full((3,), 0.012).double(), period=0.01)
    >>> felt.contact, felt.reading  # behind the low-pass
    (tensor([ True, False, False]), tensor([1.4308, 0.0000, 0.7154], dtype=torch.float64))
    """
    check_device("truth", truth.forces.device, "the tactile state", tactile.lagged.device)
    fingers = tactile.reading.shape[-1]
    if truth.normal_force.shape[-1] != fingers:
        found = f"{truth.normal_force.shape[-1]} fingertips"
        raise BadArgument("truth", found, f"{fingers}, as the tactile state")
    sliding = torch.zeros_like(truth.normal_force) if truth.sliding is None else truth.sliding
    parts = [truth.normal_force[..., None], truth.forces, sliding[..., None]]
    force = torch.cat(parts, dim=-1)  # (*b, f, 5)
    lagged = smooth(tactile.lagged, force, TACTILE.cutoff, period)
    age = tactile.age + period
    interval = 1 / SAMPLING_RATE
    if age < interval - EARLY:
        return dataclasses.replace(tactile, lagged=lagged, age=age)
    reading = lagged[..., 0]
    forces = lagged[..., 1:4]
    sliding = lagged[..., 4]
    points = truth.points
    normals = truth.normals
    if generator is not None:
        along = torch.where(torch.isfinite(normals), normals, pads)
        # (2, *b, f, 3): of the force, and of place and speed
        drawn = noise * torch.randn(2, *forces.shape, generator=generator, dtype=forces.dtype)
        normal_part = (drawn * along).sum(-1, keepdim=True)
        push = normal_part[0]
        across = drawn - normal_part * along
        reading = reading + NOISE * push[..., 0]
        sliding = sliding + TACTILE.slide * normal_part[1, ..., 0]
        forces = forces - NOISE * push * along + TACTILE.tangential * across[0]
        curvature = torch.where(radius > 0, radius, TACTILE.radius)[:, None]
        normals = unit(truth.normals + TACTILE.place / curvature * across[1])
        points = truth.points + curvature * (truth.normals - normals)
    average = smooth(tactile.average, reading, FLAG_CUTOFF, max(period, interval))
    contact = flag(tactile.contact, average, 1.0 if generator is None else max(noise, 1.0))
    age = min(max(age - interval, 0.0), interval)
    return TactileState(reading, forces, contact, points, normals, lagged, average, sliding, age)


def flag(
    before: Bool[Tensor, "*b f"], average: Float[Tensor, "*b f"], factor: Float[Tensor, "f"] | float
) -> Tensor:
    """Return a mask (*b, f) of the f fingertips that touch, with hysteresis. `*b` stands for any
    leading axes.

    A fingertip that touched `before` touches while its low-passed normal force `average` [N] is
    above 0.1 N times `factor`. Another fingertip touches above 0.2 N (`TOUCH_ON`) times `factor`.
    The `factor` (no unit) is greater for noisier sensors.
    """
    return torch.where(before, average > 0.5 * TOUCH_ON * factor, average > TOUCH_ON * factor)


def low_pass(cutoff: float, period: float) -> float:
    """Return the weight w = 1 - exp(-2 pi `cutoff` `period`) of a new value in a low-pass filter.

    The filter is of first order, with a `cutoff` [Hz] and a `period` [s] between values.
    """
    return 1 - math.exp(-2 * math.pi * cutoff * period)


def smooth(old: Filtered, new: Filtered, cutoff: float, period: float) -> Filtered:
    """Return the output of a low-pass filter: its `old` value, moved towards a `new` measurement of
    the same unit.

    The filter is of first order, with a `cutoff` [Hz] and a `period` [s] between measurements.
    """
    return old + low_pass(cutoff, period) * (new - old)


class Targets(NamedTuple):
    """Commands to hand and arm until the next control tick.

    `GraspController.step` returns them.

    Attributes:
        joints: targets (j,) [rad or m] of all joints of the URDF, in the order of
            `hand.tree.joint_names`.
        palm: displacement (3,) [m] of the palm from its planned path. It is in the frame of the
            hand's root link at the planned pose. The palm does not rotate.
        left: remaining length [m] of the approach; 0 if the hand is at its pre-grasp.
    """

    joints: Float[Tensor, " j"]
    palm: Float[Tensor, "3"] = STILL
    left: float = 0.0

    def copied(self) -> "Targets":
        """Return the same targets in new tensors, which the receiver may change."""
        return Targets(self.joints.clone(), self.palm.clone(), self.left)


@checked
@dataclasses.dataclass(frozen=True)
class Observation(Value):
    """What a hand measures at a control tick, in the hand's frame (its root link).

    `observe` makes it. f counts fingertips, and j all joints of the URDF. Joints that slide have
    [m] in place of [rad].

    Args:
        joints: positions (j,) [rad or m] of all joints, in the order of `hand.tree.joint_names`.
        tips: centres (f, 3) [m] of the fingertips.
        jacobian: Jacobian (f, 3, j) [m/rad] of these centres with respect to all joints. Each
            column is for one joint alone, without the joints that are coupled to it.
        tactile: readings of the fingertips.
        up: unit vector (3,) that points up. None means the table's normal of the plan: then the
            hand must not turn while it holds.
        hand: name of the hand and its fingers, by which a controller recognises its own
            (`describe_hand`). "" is not compared.
    """

    joints: Float[Tensor, " j"]
    tips: Float[Tensor, "f 3"]
    jacobian: Float[Tensor, "f 3 j"]
    tactile: TactileState
    up: Float[Tensor, "3"] | None = None
    hand: str = ""


@checked
def observe(
    hand: Hand,
    joints: Float[Tensor, " h"],
    tactile: TactileState,
    up: Float[Tensor, "3"] | None = None,
) -> Observation:
    """Return the observation of a robot, from its measured joints and fingertip readings.

    Args:
        hand: the hand.
        joints: measured actuated joints (h,) [rad or m], in the order of `hand.joint_names`.
        tactile: readings of the f fingertips (`feel_flags`, `feel_torques` or `measure`).
        up: unit vector (3,) that points up, in the frame of the hand's root link. Give it where the
            arm turns the hand while it holds. None means the table's normal of the plan.

    Raises `BadArgument` for joints or fingertips on another device than the hand, or another number
    of either. Raises it for a joint that is far beyond its limits, too, as one in degrees.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> observe(hand, (hand.lower + hand.upper) / 2, no_contact()).jacobian.shape
    torch.Size([3, 3, 8])
    """
    check_device("tactile", tactile.lagged.device, "the hand", hand.lower.device)
    fingers = tactile.reading.shape[-1]
    if fingers != len(hand.tips):
        allowed = f"those of the fingers {', '.join(hand.finger_names)}, in this order"
        raise BadArgument("tactile", f"readings of {fingers} fingertips", allowed)
    joints = joints.double()
    _check_places(hand, joints)
    tips = hand.tip_centres(joints)
    everything = hand.expand_joints(joints)
    up = None if up is None else up.double()
    jacobian = joint_jacobian(hand, everything, tips)
    return Observation(everything, tips, jacobian, tactile, up, describe_hand(hand))


def describe_hand(hand: Hand) -> str:
    """Return the name of a hand and the names of its fingers, as one text."""
    return f"{hand.name}: {', '.join(hand.finger_names)}"


def check_observation(hand: Hand, observation: Observation) -> None:
    """Raise `BadArgument` for an observation of another hand: one with other numbers of fingertips
    or joints, or with another name.
    """
    counts = len(hand.tips), len(hand.tree.joint_names)
    fingers = observation.tactile.reading.shape[-1]
    shape = tuple(observation.jacobian.shape)
    if (fingers, len(observation.joints)) != counts or shape != (counts[0], 3, counts[1]):
        told = f"{fingers} readings, {len(observation.joints)} joints and a Jacobian {shape}"
        allowed = f"those of the hand: {counts[0]} fingertips and {counts[1]} joints"
        raise BadArgument("observation", told, allowed)
    if observation.hand and observation.hand != describe_hand(hand):
        raise BadArgument("observation", observation.hand, describe_hand(hand))


def _check_places(hand: Hand, joints: Float[Tensor, " h"]) -> None:
    """Raise `BadArgument` for a measured joint far beyond its limits."""
    if len(joints) != hand.dof:
        return  # told by the kinematics
    beyond = torch.maximum(hand.lower.double() - joints, joints - hand.upper.double())
    if float(beyond.max()) > ASTRAY:
        worst = int(beyond.argmax())
        low = float(hand.lower[worst])
        high = float(hand.upper[worst])
        found = f"{float(joints[worst]):g} of {hand.joint_names[worst]}"
        allowed = f"positions near its limits, {low:g} to {high:g}, in radians or metres"
        raise BadArgument("joints", found, allowed)


def joint_jacobian(
    hand: Hand, joints: Float[Tensor, " j"], points: Float[Tensor, "f 3"]
) -> Float[Tensor, "f 3 j"]:
    """Return the Jacobian [m/rad] of points on the fingertips with respect to all joints of the
    URDF.

    The joints count as if none were coupled. `points` [m] are one point on each of the f
    fingertips.

    `joints` [rad] are the positions of all j joints. Points and Jacobian are in the frame of the
    hand's root link.
    """
    axes, origins = hand.tree.joint_axes(hand.tree.poses(joints[None])[0])
    arms = points[:, None] - origins  # (f, j, 3)
    turning = torch.linalg.cross(axes.expand_as(arms), arms)
    columns = torch.where(hand.tree.prismatic[:, None] > 0, axes, turning)
    moves = hand.tree.moves[hand.tips.index]  # (f, j)
    return (columns * moves[:, :, None]).transpose(1, 2)
