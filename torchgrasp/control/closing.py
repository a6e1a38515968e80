"""How the fingers reach the object: in open loop, under the law (Eq. 25), or as the paper's position baseline."""

import dataclasses
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.closing_law import POSITION_FLOOR, POSITION_RATE, blend, joint_step, stay_above, tip_velocity
from torchgrasp.control.observation import Observation
from torchgrasp.control.placement import Placement
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.sensing import DriveFeel
from torchgrasp.control.state import Part
from torchgrasp.control.tactile import NOISE
from torchgrasp.control.targets import STILL
from torchgrasp.geometry.linalg import limit_norm
from torchgrasp.specs import ClosingPart, moves_palm

Revision = Callable[[Observation, ClosingReference], ClosingReference]
"""Revises the reference by what the fingers feel (`Belief.revise`)."""

POSE_TIME = 0.4
"""Time [s] from pre-grasp to grasp in open loop, and again from grasp to squeeze."""

WAITING_FORCE, SETTLED, PATIENCE = 0.3, 0.1, 2.5
"""Largest force [N] of a finger that waits for the others, less than the table's friction on a light object. The
waiting ends once all have touched for ten samples [s], or after a time [s] in which a fingertip travels 100 mm."""

FELT = 0.45
"""Reading [N] that counts as a touch at once, 4.5 deviations of its noise: the contact flag comes 50 ms later. What is
noisier has the flag alone."""

PALM_REACH, PALM_SPEED, PALM_RATE = 0.02, 0.04, 6.0
"""Farthest displacement of the palm [m], its largest speed [m/s], and the rate [1/s] at which it follows the object."""

STALLED, OVERDUE = 0.25, 3.0
"""Force [N] of its drives at which a finger without a sensor touches: twice the noise of joint torques at 80 mm, and
less than friction bears. At 0.5 N it moved 12 things by 4.5 mm, not 1.5 mm (docs/closing.md). And how far behind its
contact it counts as touching, in standard deviations: hardly a surface is left to meet."""

LEAD, IMPATIENCE = 0.04, 0.25
"""Largest lead [rad] of a waiting finger's target over its joint: it bounds the force of a link that is stopped unfelt.
While the others wait for a finger, the lead grows by itself in each such time [s]."""

ARRIVED = 0.5
"""Blend (Eq. 26) of a fingertip that is at its desired position: the force counts as much as the position."""

STOP_FORCE, STOP_DISTANCE, AIM_DEPTH, INTEGRAL_RATE = 0.5, 1e-3, 0.02, 2.0
"""The position baseline: force [N] (Sec. 6.5) and distance to its target [m] at which a finger stops. The depth
of this target behind the planned contact [m] and the integral gain [1/s^2] are tuned (docs/closing.md)."""


class OpenLoopClosing(Part):
    """Replay pre-grasp, grasp and squeeze, whatever is felt."""

    palm = STILL

    def __init__(self, reference: ClosingReference) -> None:
        poses = (reference.pregrasp, reference.joints, reference.squeeze)
        self.reference = reference
        self.poses = torch.stack([reference.expand(pose) for pose in poses])
        self.time, self.done = 0.0, False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        progress = min(self.time / POSE_TIME, 2.0)
        self.done = self.time >= 2 * POSE_TIME - 0.5 * period
        first = min(int(progress), 1)
        return torch.lerp(self.poses[first], self.poses[first + 1], progress - first)


class LawClosing(Part):
    """The closing law (Eqs. 25-28), and parts that the paper does not have. `without` leaves some of them out.

    * `switch`: touch decides. A finger in the air searches along its contact's normal, even beyond the contact. One
      that touches is force-controlled whatever its position error: where the shape is wrong, Eq. (26) would press on.
      No finger searches below the table, if the reference knows one: it slides along.
    * `wait`: a finger that touches stands still until all have, and gives way to more than `WAITING_FORCE`. Then all
      press with it. The holding raises the full forces: separate loops would push the object (docs/closing.md).
    * `pace`: before the first touch all fingers keep pace. Without it they share one limit of speed, so that
      Eq. (27) decides which is the first.
    * `place`: touches that come early or late tell where the object is (`Placement`); all contacts move with it.
    * A finger without a sensor rests where its contact is believed to be until the others touch. Then it searches as
      they do, until its drives feel it or it is `OVERDUE`.
    * `palm`: the palm follows the object, so that the joints come to those of the grasp. It needs `place`.
    * `guard` is the controller's: on its way to the pre-grasp the hand stops where it touches something, and goes
      round it. It needs `palm`.
    * `retry` is the controller's: where the closed hand feels that a lift would fail, it closes once more. It needs
      `place`: the next closing begins with a displaced palm and expects the object there (`begin_at`).

    Without all of them it is the paper's law. That needs four mends: `joint_step` for its J^-1, `POSITION_FLOOR`,
    `MAX_SPEED`, and a target that leads its joint by no more than the drive can exert. It ends when all
    fingers touch, each blend is at least `ARRIVED`, and the forces have been steady for a time `SETTLED`.
    """

    def __init__(
        self, reference: ClosingReference, revise: Revision | None = None, without: tuple[ClosingPart, ...] = ()
    ) -> None:
        self.reference, self.revise = reference, revise
        self.switch, self.waits, self.paces = (part not in without for part in ("switch", "wait", "pace"))
        self.placement = None if "place" in without else Placement(reference)
        self.follows, self.palm = moves_palm("uncertainty", without), STILL
        self.believed = torch.zeros(6, dtype=torch.float64)  # displacement of the object [m, rad]
        self.felt = torch.zeros_like(reference.normals[:, 0], dtype=torch.bool)
        self.alive, self.quick = reference.alive, reference.sensor.kind == "tactile" and reference.sensor.noise <= 1.0
        self.drives = None if bool(self.alive.all()) else DriveFeel(reference)
        self.strongest = _strongest_lead(reference)
        self.target = reference.pregrasp
        self.waiting = self.settled = 0.0
        self.steady = torch.zeros_like(reference.normals[:, 0])
        self.share = torch.zeros_like(self.steady)
        self.done = False

    def begin_at(self, displacement: Float[Tensor, "6"], palm: Float[Tensor, "3"]) -> "LawClosing":
        """Begin with a displaced palm [m], and expect the object by a displacement [m, rad] from where it was seen."""
        self.placement, self.palm, self.believed = Placement(self.reference, displacement), palm, displacement
        return self

    def press(self) -> "LawClosing":
        """Let fingers that waited press with their desired forces; the palm stays where it is."""
        self.waits = self.follows = False
        return self

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self._revise(observation)
        reference, gains, coupling = self.reference, self.reference.gains, self.reference.hand.actuated.coupling
        normals, contact, tips = reference.normals, observation.tactile.contact, observation.tips + self.palm
        if self.waits:
            quick = observation.tactile.reading >= FELT if self.quick else contact
            contact = self.felt | contact | quick
        points, planned, drift = reference.contact_points(tips), gains.target, STILL
        if self.placement is not None:
            self.believed = self.placement.displacement(points, contact)
            planned = self.placement.moved(self.believed)
            if self.follows:
                goal = limit_norm(self.believed[:3], PALM_REACH)
                drift = limit_norm(PALM_RATE * (goal - self.palm), PALM_SPEED)
        error = planned - points
        ahead = -(error * normals).sum(-1)  # how far the planned contact still lies ahead of each fingertip
        touches, rests = self._blind(observation, ahead, contact, period)
        contact = self.felt = self.felt | contact | touches if self.waits else contact | touches
        if self.switch:
            error = error + ahead.clamp_max(0.0)[:, None] * normals
        share = blend(error, gains.covariance)
        if self.switch:
            share = torch.where(contact | rests, 1.0, share)
        desired = -(gains.desired_force * normals).sum(-1)
        if self.waits:
            rest = WAITING_FORCE if bool(contact.all()) else observation.tactile.reading.clamp_max(WAITING_FORCE)
            desired = torch.where(contact, rest, desired)
        self.share = share
        self._judge(observation, contact, share, period)
        desired = torch.where(~self.alive & (contact | rests), observation.tactile.reading, desired)
        force_error = -(desired - observation.tactile.reading)[:, None] * normals
        velocity = tip_velocity(error, force_error, share, gains.position_gain, gains.force_gain, not self.paces)
        if self.paces and not bool(contact.any()):
            left = ahead.clamp_min(0.0) + POSITION_FLOOR
            velocity = velocity * (left / left.max())[:, None]
        if self.switch and reference.table is not None:
            height = reference.table.height(tips) - reference.hand.tips.radius
            velocity = stay_above(velocity, height, reference.table.normal)
        self.palm = self.palm + period * drift
        step = joint_step(observation.jacobian @ coupling, velocity - drift, period, reference.joints - self.target)
        actuated = reference.pick(observation.joints)
        lead = LEAD * (1 + self.waiting / IMPATIENCE) if self.waits else self.strongest
        target = torch.minimum(torch.maximum(self.target + step, actuated - lead), actuated + lead)
        self.target = reference.clamp(target)
        return reference.expand(self.target)

    def _blind(
        self, observation: Observation, ahead: Float[Tensor, "f"], contact: Bool[Tensor, "f"], period: float
    ) -> tuple[Bool[Tensor, "f"], Bool[Tensor, "f"]]:
        """Return which fingers without a sensor touch, as far as anyone knows, and which rest until the others do.

        `ahead` [m] is how far their contacts still lie ahead.
        """
        blind = ~self.alive
        if self.drives is None:
            return blind, blind
        normals, covariance = self.reference.normals, self.reference.gains.covariance
        deviation = torch.einsum("fi,fij,fj->f", normals, covariance, normals).sqrt()
        pushes = self.drives(observation, self.reference.expand(self.target), period)
        touches = blind & ((pushes >= STALLED) | (ahead <= -OVERDUE * deviation))
        others = bool((contact | blind).all())
        return touches, blind & (ahead <= 0.0) & (not others)

    def _revise(self, observation: Observation) -> None:
        """Revise the reference by what is felt, where the palm was before it moved."""
        if self.revise is None:
            return
        if bool(self.palm.any()):
            tactile = dataclasses.replace(observation.tactile, points=observation.tactile.points + self.palm)
            observation = dataclasses.replace(observation, tips=observation.tips + self.palm, tactile=tactile)
        revised = self.revise(observation, self.reference)
        if self.placement is not None and revised is not self.reference:
            self.placement = Placement(revised)
        self.reference = revised

    def _judge(
        self, observation: Observation, touched: Bool[Tensor, "f"], share: Float[Tensor, "f"], period: float
    ) -> None:
        """Count the time since the first touch, and the time for which the fingers have settled."""
        contact, average = observation.tactile.contact, observation.tactile.average
        self.waiting = self.waiting + period if bool(touched.any()) else 0.0
        settled = bool((contact | (touched & ~self.alive)).all())
        if not self.waits:
            settled = settled and bool((share >= ARRIVED).all() & ((average - self.steady).abs() < NOISE).all())
        self.settled = self.settled + period if settled else 0.0
        if not settled:
            self.steady = average
        self.done = self.settled >= SETTLED or (self.waits and self.waiting >= PATIENCE)


def _strongest_lead(reference: ClosingReference) -> Float[Tensor, " h"]:
    """Return the lead [rad] of each actuated joint's target at which a drive is at its largest torque."""
    hand = reference.hand
    effort = torch.tensor([hand.actuators[name].effort for name in hand.tree.joint_names], dtype=torch.float64)
    leads = (effort / reference.kp)[:, None] / hand.actuated.coupling.abs()  # infinite where nothing is driven
    return leads.amin(0)


class FixedGainClosing(LawClosing):
    """`LawClosing` with equal gains for every contact and direction."""

    def __init__(
        self, reference: ClosingReference, revise: Revision | None = None, without: tuple[ClosingPart, ...] = ()
    ) -> None:
        gains = reference.gains
        isotropic = dataclasses.replace(
            gains,
            covariance=POSITION_FLOOR**2 * torch.eye(3, dtype=gains.covariance.dtype).expand_as(gains.covariance),
            position_gain=torch.full_like(gains.position_gain, POSITION_RATE),
            force_gain=gains.force_gain.amax(-1, keepdim=True).expand_as(gains.force_gain),
        )
        super().__init__(dataclasses.replace(reference, gains=isotropic), revise, without)


class PositionClosing(Part):
    """The paper's baseline (Table 7): an isotropic PI position controller per fingertip that stops at `STOP_FORCE`.

    It aims at a `depth` [m] behind the contacts. The paper's is 0, with which a finger may stop before it touches.
    """

    palm = STILL

    def __init__(self, reference: ClosingReference, depth: float = AIM_DEPTH) -> None:
        self.reference = reference
        self.aim = reference.gains.target - depth * reference.normals
        self.target = reference.pregrasp
        self.integral = torch.zeros_like(self.aim)
        self.stopped = torch.zeros_like(self.aim[:, 0], dtype=torch.bool)
        self.done = False

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        reference = self.reference
        error = self.aim - reference.contact_points(observation.tips)
        arrived = torch.linalg.vector_norm(error, dim=-1) < STOP_DISTANCE
        self.stopped = self.stopped | arrived | (observation.tactile.reading >= STOP_FORCE)
        self.done = bool(self.stopped.all())
        self.integral = self.integral + period * error
        demand = POSITION_RATE * error + INTEGRAL_RATE * self.integral
        gain, position_only = torch.ones_like(demand), torch.zeros_like(demand[:, 0])
        velocity = tip_velocity(demand, torch.zeros_like(demand), position_only, gain, gain)
        velocity = torch.where(self.stopped[:, None], 0.0, velocity)
        step = joint_step(observation.jacobian @ reference.hand.actuated.coupling, velocity, period)
        self.target = reference.clamp(self.target + step)
        return reference.expand(self.target)
