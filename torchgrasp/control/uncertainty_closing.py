"""The default closing: a control law like the paper's. It is extended for an object that is not
where the camera placed it.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.law import (
    POSITION_FLOOR,
    POSITION_RATE,
    blend,
    joint_step,
    stay_above,
    tip_velocity,
)
from torchgrasp.control.object_pose import ContactPlanes
from torchgrasp.control.protocol import SETTLED, Settled, strongest_lead
from torchgrasp.control.reference import ClosingReference, next_target
from torchgrasp.control.sensing import WAITING_FORCE, DriveFeel
from torchgrasp.control.tactile import STILL, Observation
from torchgrasp.geometry.linalg import dot, limit_norm
from torchgrasp.values.closing import ClosingOptions

PALM_SPEED = 0.04  # largest speed [m/s] of the palm that follows the object


@dataclasses.dataclass(frozen=True)
class ClosingNumbers:
    """Parameters of `UncertaintyClosing`, the default closing."""

    patience: float = 2.5
    """Longest time [s] from the first touch until the closing ends, even if some finger has not
    touched.
    """
    touch: float = 0.45
    """Reading [N] of a tactile fingertip that counts as a touch before the contact flag turns on.
    """
    lead: float = 0.04
    """Largest difference [rad] between the joint targets and joints of a waiting finger. It bounds
    the force of a link that is blocked.
    """
    growth: float = 0.25
    """Time [s] of waiting for the other fingers in which `lead` grows by its first value."""
    follows: float = 6.0
    """Gain [1/s] with which the palm follows the object."""
    # of a finger without a sensor
    stalled: float = 0.25
    """Force [N], estimated from its drives, at which a finger without a sensor counts as touching.
    """
    deviations: float = 3.0
    """Distance beyond its contact, in standard deviations, at which a finger without a sensor
    counts as touching.
    """


@dataclasses.dataclass(frozen=True)
class RimNumbers:
    """Parameters of fingertips that slide along the table to the rim of a low object."""

    slope: float = 0.25
    """Least component of the contact's unit normal along the table's normal."""
    near: float = 0.004
    """Height [m] of a fingertip over the table below which it counts as at the table."""
    rate: float = 12.0
    """Rate [1/s] at which the distance of a fingertip from its sliding height decreases."""
    gap: float = 0.0003
    """Height [m] over the table of a sliding fingertip: the lower it is, the flatter its contact's
    normal.
    """
    fastest: float = 0.8
    """Largest speed [rad/s] of the joints: faster joints lag, and the fingertips leave the table.
    """


CLOSING = ClosingNumbers()
RIM = RimNumbers()


class UncertaintyClosing:
    """The default closing controller: Eqs. (25), (26) and (28) of the paper with
    `surface_covariance`, and extensions.

    * A finger that does not touch searches along the normal of its planned contact, even beyond it.
      It does not go below the table. A finger that touches is force-controlled, whatever its
      position error.
    * Before the first touch the fingers keep pace: all reach their contacts at the same time.
    * A finger without a working sensor rests at its estimated contact until the others touch. Then
      it searches until its drives sense a contact, or until it is three standard deviations beyond
      the contact.
    * Fingertips with contacts on the rim of a low object go down to the table. They slide along it
      to the object.
    * A palm that starts above its planned pose (`ClosingReference.rise`) goes down while the
      fingers close. It goes down as far as the closing raises the fingertips on their arcs. Where
      one fingertip keeps it up, the other fingers go down by themselves.
    * Three `ClosingOptions` act while the fingers close. With `wait`, fingers that touch wait for
      the others. With `pose_estimate`, touches locate the object; up to `palm_reach`, the palm
      follows.

    The closing ends when all fingers have touched for 0.1 s (`SETTLED`). Without `wait` they must
    also be under force control, with steady forces.
    """

    feels = True  # sensor readings change the targets

    def __init__(self, reference: ClosingReference, options: ClosingOptions) -> None:
        self.reference = reference
        self.waits = options.wait
        self.reach = options.palm_reach
        self.planes = ContactPlanes(reference) if options.pose_estimate else None
        # displacement [m] of the palm when the closing began, and now
        self.begun = reference.rise
        self.palm = reference.rise
        self.raised = bool(self.palm.any())
        self.displacement = torch.zeros(6, dtype=torch.float64)  # of the object [m, rad]
        self.touched = torch.zeros_like(reference.normals[:, 0], dtype=torch.bool)
        self.alive = reference.alive
        self.quick = reference.sensor.kind == "tactile" and reference.sensor.noise <= 1.0
        self.drives = None if self.alive.all() else DriveFeel(reference)
        self.strongest = strongest_lead(reference)
        self.target = reference.pregrasp
        self.share = torch.zeros_like(reference.normals[:, 0])
        self.waiting = 0.0
        self.settled = Settled(reference)
        self.low = rim_contacts(reference)
        self.fastest = RIM.fastest if self.low.any() else math.inf  # of a target [rad/s]

    @property
    def done(self) -> bool:
        """Whether the closing has ended: all fingers have touched for 0.1 s (`SETTLED`).

        Without the option `wait`, they must also be under force control, with steady forces. With
        it, the closing also ends 2.5 s after the first touch (`CLOSING.patience`).
        """
        late = self.waits and self.waiting >= CLOSING.patience
        return late or self.settled.time >= SETTLED

    def begin_at(
        self, displacement: Float[Tensor, "6"], palm: Float[Tensor, "3"]
    ) -> "UncertaintyClosing":
        """Return this controller, set to begin with another position of the palm and another
        expected pose of the object.

        `palm` [m] is the palm's displacement from its planned pose. `displacement` is the expected
        displacement of the object since the plan: the translation [m] of the contacts' centroid,
        then a rotation vector [rad]. Both are in the frame of the planned hand.
        """
        self.planes = ContactPlanes(self.reference, displacement)
        self.palm = palm
        self.begun = palm
        self.displacement = displacement
        return self

    def press(self) -> "UncertaintyClosing":
        """Return this controller, switched to pressing.

        All fingers, also those that waited, press with their desired forces; the palm stops.
        """
        self.waits = False
        self.reach = 0.0
        self.raised = False
        return self

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets [rad] of all joints for the next tick, `period` [s] later."""
        reference = self.reference
        gains = reference.gains
        normals = reference.normals
        reading = observation.tactile.reading
        tips = observation.tips + self.palm
        contact = self._touching(observation)
        points = reference.contact_points(tips)
        planned, drift = self._follow(points, contact)
        error = planned - points
        # how far [m] each planned contact still lies ahead of its fingertip: (f,)
        ahead = -dot(error, normals)
        touches, rests = self._without_sensor(observation, ahead, contact, period)
        contact = contact | touches
        if self.waits:
            self.touched = contact
        # a finger that has passed its contact is not pulled back
        error = error + ahead.clamp_max(0.0)[:, None] * normals
        share = torch.where(contact | rests, 1.0, blend(error, gains.covariance))
        self.share = share
        self.waiting = self.waiting + period if contact.any() else 0.0
        touching = observation.tactile.contact | (contact & ~self.alive)
        self.settled.update(observation, touching, share, period, pressing=not self.waits)
        desired = self._desired(reading, contact, rests)
        force_error = -(desired - reading)[:, None] * normals
        velocity = tip_velocity(error, force_error, share, gains.position_gain, gains.force_gain)
        if not contact.any():
            # all fingers reach their contacts at the same time
            left = ahead.clamp_min(0.0) + POSITION_FLOOR
            velocity = velocity * (left / left.max())[:, None]
        velocity = self._beside_table(velocity, tips)
        velocity, descent = self._descend(velocity - drift, observation, period)
        self.palm = self.palm + period * (drift + descent)
        lead = self.strongest
        if self.waits:
            lead = CLOSING.lead * (1 + self.waiting / CLOSING.growth)
        self.target = next_target(
            reference, self.target, velocity, observation, lead, period, self.fastest
        )
        return reference.expand(self.target)

    def _touching(self, observation: Observation) -> Bool[Tensor, "f"]:
        """Return a mask of the fingers that touch or, while the hand waits, have touched."""
        contact = observation.tactile.contact
        if not self.waits:
            return contact
        contact = self.touched | contact
        return contact | (observation.tactile.reading >= CLOSING.touch) if self.quick else contact

    def _follow(
        self, points: Float[Tensor, "f 3"], contact: Bool[Tensor, "f"]
    ) -> tuple[Tensor, Tensor]:
        """Return the planned contacts (f, 3) [m] on the displaced object, then the palm's velocity
        (3,) [m/s].
        """
        if self.planes is None:
            return self.reference.gains.target, STILL
        self.displacement = self.planes.displacement(points, contact)
        drift = STILL
        if self.reach:
            way = limit_norm(self.displacement[:3], self.reach) - self.palm
            table = self.reference.table
            if self.raised and table is not None:
                # what the palm has left of its descent is no drift
                way = way - (way @ table.normal) * table.normal
            drift = limit_norm(CLOSING.follows * way, PALM_SPEED)
        return self.planes.moved(self.displacement), drift

    def _beside_table(
        self, velocity: Float[Tensor, "f 3"], tips: Float[Tensor, "f 3"]
    ) -> Float[Tensor, "f 3"]:
        """Return the velocities [m/s] of the fingertips, limited so that none at `tips` (f, 3) [m]
        enters the table. The `low` ones slide along it.

        A fingertip farther beyond the table's edge than above its plane keeps beyond the edge.
        """
        table = self.reference.table
        if table is None:
            return velocity
        radius = self.reference.hand.tips.radius
        height = table.height(tips) - radius
        limited = stay_above(velocity, height, table.normal)
        if table.edge is not None:
            beyond = table.edge.height(tips) - radius
            aside = stay_above(velocity, beyond, table.edge.normal)
            limited = torch.where((beyond > height)[:, None], aside, limited)
        return slide_along(limited, height, table.normal, self.low)

    def _descend(
        self, velocity: Float[Tensor, "f 3"], observation: Observation, period: float
    ) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "3"]]:
        """Return the velocities [m/s] of the fingertips in the hand, then that of a palm that
        started raised.

        While the palm is raised, it moves along the table's normal, so that no tip is lower than it
        should be. Where one tip keeps it up, the others go down by their own joints.
        """
        if not self.raised or self.reference.table is None:
            return velocity, STILL
        up = self.reference.table.normal
        jacobian = observation.jacobian @ self.reference.hand.actuated.coupling  # (f, 3, h)
        # without the motion along the table's normal
        flat = jacobian - up[:, None] * (up @ jacobian)[:, None]
        along = velocity - (velocity @ up)[:, None] * up
        made = jacobian @ joint_step(flat, along, period) / period
        # the tip that lacks most height decides how the palm moves
        descent = limit_norm(((velocity - made) @ up).amax() * up, PALM_SPEED)
        # the other tips move down by their own joints what the palm leaves to them
        left = ((velocity - made - descent) @ up).clamp_max(0.0)
        return made + left[:, None] * up, descent

    def _without_sensor(
        self,
        observation: Observation,
        ahead: Float[Tensor, "f"],
        contact: Bool[Tensor, "f"],
        period: float,
    ) -> tuple[Bool[Tensor, "f"], Bool[Tensor, "f"]]:
        """Return two masks of fingers without a working sensor: those that probably touch, and
        those that wait for the others.
        """
        blind = ~self.alive
        if self.drives is None:
            return blind, blind
        normals = self.reference.normals
        covariance = self.reference.gains.covariance
        deviation = torch.einsum("fi,fij,fj->f", normals, covariance, normals).sqrt()
        pushes = self.drives(observation, self.reference.expand(self.target), period)
        beyond = ahead <= -CLOSING.deviations * deviation
        touches = blind & ((pushes >= CLOSING.stalled) | beyond)
        others = bool((contact | blind).all())
        return touches, blind & (ahead <= 0.0) & (not others)

    def _desired(
        self, reading: Float[Tensor, "f"], contact: Bool[Tensor, "f"], rests: Bool[Tensor, "f"]
    ) -> Float[Tensor, "f"]:
        """Return the desired normal force [N] of each finger; if the sensor is dead, the force
        error is zero.
        """
        desired = -dot(self.reference.gains.desired_force, self.reference.normals)
        if self.waits:
            rest = WAITING_FORCE if contact.all() else reading.clamp_max(WAITING_FORCE)
            desired = torch.where(contact, rest, desired)
        return torch.where(~self.alive & (contact | rests), reading, desired)


def rim_contacts(reference: ClosingReference) -> Bool[Tensor, "f"]:
    """Return a mask (f,) of the planned contacts on the upper rim of a low object.

    Their unit normals have a component above 0.25 along the table's normal (`RIM.slope`). The
    fingertips that touch them are lower than 4 mm over the table (`RIM.near`). A fingertip does not
    count if it is farther beyond the table's edge than above the table's plane. Without a table the
    mask is false.
    """
    table = reference.table
    if table is None:
        return torch.zeros_like(reference.alive)
    normals = reference.normals
    radius = reference.hand.tips.radius
    centres = reference.gains.target + radius[:, None] * normals
    height = table.height(centres) - radius
    low = (normals @ table.normal > RIM.slope) & (height < RIM.near)
    return low if table.edge is None else low & (table.clearance(centres) - radius <= height)


def slide_along(
    velocity: Float[Tensor, "f 3"],
    height: Float[Tensor, "f"],
    up: Float[Tensor, "3"],
    low: Bool[Tensor, "f"],
) -> Float[Tensor, "f 3"]:
    """Return the fingertips' `velocity` [m/s], changed so that the `low` ones stay at the table.

    Their velocity along the table's unit normal `up` becomes r (g - h). Here r is 12 / s
    (`RIM.rate`), and g is 0.3 mm (`RIM.gap`). This brings them to the height g and keeps them
    there. h is `height` [m], that of each fingertip's lowest point over the table. `low` is a mask
    of the fingertips that slide. Velocities and `up` are in one frame. f counts fingertips.
    """
    down = RIM.rate * (RIM.gap - height) - velocity @ up
    return velocity + (down * low)[:, None] * up


def with_equal_gains(reference: ClosingReference) -> ClosingReference:
    """Return the plan `reference` with gains that ignore the uncertainty: those of the closing mode
    "fixed".

    All contacts have the covariance (5 mm)^2 I (`POSITION_FLOOR`) and the position gain 4 / s
    (`POSITION_RATE`). Each finger has its largest force gain on all axes.
    """
    gains = reference.gains
    eye = torch.eye(3, dtype=gains.covariance.dtype).expand_as(gains.covariance)
    isotropic = dataclasses.replace(
        gains,
        covariance=POSITION_FLOOR**2 * eye,
        position_gain=torch.full_like(gains.position_gain, POSITION_RATE),
        force_gain=gains.force_gain.amax(-1, keepdim=True).expand_as(gains.force_gain),
    )
    return dataclasses.replace(reference, gains=isotropic)
