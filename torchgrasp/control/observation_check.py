"""Checks of a robot's observations: readings of another hand, sign, unit or frame are refused.

f counts fingertips, and j all joints of the URDF.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import NOISE, Observation, TactileState
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import check_unit_vectors


@dataclasses.dataclass(frozen=True)
class ReadingNumbers:
    """Bounds beyond which an observation has another sign, unit or frame, or is of another hand."""

    noises: float = 10.0
    """Size of a force whose sign is sure, in standard deviations of a normal force."""
    most: float = 1000.0
    """Largest normal force [N] of a fingertip: a larger one is in millinewtons."""
    pulls: float = 0.5
    """Share of the normal force above which a force along the outward normal pulls."""
    away: float = 0.1
    """Largest distance [m] of a contact from its fingertip's centre: no fingertip is longer."""
    near: float = 1.5
    """Largest distance of a contact on a round fingertip from its centre, in radii."""
    inside: float = 0.5
    """Depth of this centre under the surface, in radii, that shows an inward normal."""
    start: float = 0.8
    """Largest distance [rad or m] of a joint from its closing, where the closing begins."""
    jump: float = 0.5
    """Largest motion [rad or m] between two ticks of a joint that does not move."""
    fastest: float = 20.0
    """Largest speed [rad/s or m/s] of a joint."""
    tilt: float = 0.5
    """Largest angle [rad] between the told upward vector and the table's normal of the plan."""
    unplaced: float = 0.5
    """Time [s] of touching without a contact point: filters keep a lost contact less long."""
    pulling: float = 0.3
    """Time [s] for which all fingertips must pull."""
    pull: float = 5.0
    """Sum of the forces [N] with which they pull: above the weight of the fingers."""


BOUNDS = ReadingNumbers()


class ObservationCheck:
    """Check at each control tick that a robot's observation is plausible for the planned hand.

    A call raises `BadArgument` for joints that jump or are far off at the start of the closing. It
    also does so for forces, contacts or an upward vector of a wrong sign, unit or frame. It
    remembers earlier ticks, so each `GraspController` has its own check.

    Args:
        reference: the closing plan, with the hand and its sensor.
    """

    def __init__(self, reference: ClosingReference) -> None:
        self.reference = reference
        self.alive = reference.alive.numpy()
        self.radius = reference.hand.tips.radius.numpy()
        self.normals = reference.normals.numpy()
        self.sure = BOUNDS.noises * NOISE * max(1.0, reference.sensor.noise)
        self.joints: np.ndarray | None = None  # at the last tick
        self.closes = False  # whether the closing has begun
        self.unplaced = 0.0  # time [s] of touching without a contact point
        self.pulling = 0.0  # time [s] in which all fingertips have pulled

    def __call__(self, observation: Observation, period: float, closes: bool, holds: bool) -> None:
        """Raise `BadArgument` for an observation that cannot be that of the hand.

        Args:
            observation: what the hand measures now.
            period: time [s] between two ticks.
            closes: whether the fingers close or hold now, so that they do not open.
            holds: whether the hand holds, so that an arm may turn it.
        """
        self._check_joints(observation, period, closes)
        if not holds:
            self._check_up(observation.up)
        tactile = observation.tactile
        pushes = tactile.reading.numpy()
        self._check_pushes(pushes)
        touching = tactile.contact.numpy() & self.alive
        self._count(tactile, touching, period, closes)
        if touching.any() and self.reference.sensor.kind == "tactile":
            self._check_contacts(observation, pushes, touching)

    def _check_joints(self, observation: Observation, period: float, closes: bool) -> None:
        """Raise `BadArgument` for joints that jump, or that are far off where a closing begins."""
        joints = observation.joints.numpy()
        before = self.joints
        if before is not None:
            moved = np.abs(joints - before)
            if float(moved.max()) > BOUNDS.jump + BOUNDS.fastest * period:
                name = self.reference.hand.tree.joint_names[int(moved.argmax())]
                found = f"a jump of {name} by {float(moved.max()):.2g} in {period:g} s"
                allowed = "joints near those of the last tick, or a new controller"
                raise BadArgument("observation.joints", found, allowed)
        if closes and not self.closes:
            self._check_start(observation.joints)
            self.closes = True
        self.joints = joints

    def _check_start(self, joints: Float[Tensor, " j"]) -> None:
        """Raise `BadArgument` for joints far from the way from the pre-grasp to the grasp."""
        reference = self.reference
        found = reference.pick(joints).numpy()
        ends = np.stack([reference.pregrasp.numpy(), reference.joints.numpy()])
        off = np.maximum(ends.min(0) - found, found - ends.max(0))
        worst = int(off.argmax())
        if float(off[worst]) > BOUNDS.start:
            told = f"{reference.hand.joint_names[worst]} at {float(found[worst]):.3g}"
            opened = f"{float(ends[0, worst]):.3g}"
            allowed = f"the pre-grasp, {opened}: send `controller.targets.joints` first"
            raise BadArgument("observation.joints", told, allowed)

    def _check_up(self, up: Float[Tensor, "3"] | None) -> None:
        """Raise `BadArgument` for an upward vector that is not the table's normal of the plan."""
        table = self.reference.table or self.reference.planned_table
        if up is None or table is None:
            return
        cosine = float(up.double() @ table.normal.double())
        if cosine < math.cos(BOUNDS.tilt):
            degrees = math.degrees(math.acos(max(cosine, -1.0)))
            found = f"a vector {degrees:.0f} degrees off the table's normal"
            allowed = "one in the frame of the hand's root link: `obj_from_hand[:3, :3].T @ up`"
            raise BadArgument("observation.up", found, allowed)

    def _check_pushes(self, pushes: np.ndarray) -> None:
        """Raise `BadArgument` for normal forces of the wrong sign or unit."""
        low = float(pushes.min())
        high = float(pushes.max())
        if low < -self.sure:
            allowed = "forces that press on the object, which are positive: turn the sign or tare"
            raise BadArgument("observation.tactile.reading", f"{low:.3g} N", allowed)
        if high > BOUNDS.most:
            allowed = f"at most {BOUNDS.most:g} N, in newtons"
            raise BadArgument("observation.tactile.reading", f"{high:.3g} N", allowed)

    def _count(
        self, tactile: TactileState, touching: Bool[np.ndarray, "f"], period: float, closes: bool
    ) -> None:
        """Raise `BadArgument` for fingertips that touch for long without a contact point, though
        they should sense it, or that all pull for long, though they close.
        """
        kind = self.reference.sensor.kind
        if kind == "tactile":
            nowhere = np.isnan(tactile.points.numpy()).any(-1)
            lacks = bool(touching.any()) and not bool((touching & ~nowhere).any())
            self.unplaced = self.unplaced + period if lacks else 0.0
            if self.unplaced > BOUNDS.unplaced:
                found = "'tactile', with fingertips that touch and sense no contact points"
                allowed = "SensorModel('binary') with feel_flags, 'torque' with feel_torques"
                raise BadArgument("reference.sensor", found, allowed)
        if kind == "torque" and closes:
            pulls = (tactile.forces.numpy() * self.normals).sum(-1)[self.alive]
            all_pull = bool((pulls > 0.0).all()) and float(pulls.sum()) > BOUNDS.pull
            self.pulling = self.pulling + period if all_pull else 0.0
            if self.pulling > BOUNDS.pulling:
                found = "forces of closing fingers that all pull at the object"
                allowed = "torques that are positive in the direction of their joints"
                raise BadArgument("observation.tactile.forces", found, allowed)

    def _check_contacts(
        self, observation: Observation, pushes: np.ndarray, touching: Bool[np.ndarray, "f"]
    ) -> None:
        """Raise `BadArgument` for contacts in another frame or unit, and for forces or normals of
        the wrong sign.
        """
        # comparisons with NaN are false: nothing is known of such a contact
        tactile = observation.tactile
        normals = tactile.normals.numpy()
        offsets = observation.tips.numpy() - tactile.points.numpy()
        away = np.linalg.norm(offsets, axis=-1)
        far = touching & (away > BOUNDS.away)
        if far.any():
            found = f"a contact {float(away[far].max()):.3g} m from its fingertip's centre"
            allowed = "points in metres, in the frame of the hand's root link"
            raise BadArgument("observation.tactile.points", found, allowed)
        check_unit_vectors("observation.tactile.normals", tactile.normals[tactile.contact])
        on_sphere = touching & (away < BOUNDS.near * self.radius)
        if (on_sphere & ((offsets * normals).sum(-1) < -BOUNDS.inside * self.radius)).any():
            found = "a normal that points from its fingertip into the object"
            allowed = "outward normals of the object, in the frame of the hand's root link"
            raise BadArgument("observation.tactile.normals", found, allowed)
        pulls = (tactile.forces.numpy() * normals).sum(-1)
        if (touching & (pushes > self.sure) & (pulls > BOUNDS.pulls * pushes)).any():
            found = "a force that pulls at the object"
            allowed = "forces of the fingertips on the object, against its outward normals"
            raise BadArgument("observation.tactile.forces", found, allowed)
