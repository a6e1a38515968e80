"""The closing plan: poses, contacts and controller gains of one grasp in the hand's frame.

f counts the fingertips, h the actuated joints, and j all joints of the URDF.
"""

import dataclasses
import functools
import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control import finger_forces, law
from torchgrasp.control.tactile import Observation
from torchgrasp.foundation.base import Value, kept
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import ANY, Force, Pose, Positive, Range
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.linalg import check_unit_vectors, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.drives import drive_stiffness, joint_stiffness
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.motion import opened_pose
from torchgrasp.values.closing import ClosingGains, SensorModel
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec


@checked
@dataclasses.dataclass(frozen=True)
class ClosingReference(Value):
    """The plan for closing a hand on one grasp.

    `from_grasp` makes it, and a `GraspController` follows it. f counts fingertips, h actuated
    joints, and j all joints of the URDF. Vectors and the table are in the frame of the planned
    hand: that of its root link at `obj_from_hand`. Only `surface` is in the frame of the grasp,
    that of the planned cloud. Joints that slide have [m] in place of [rad], and their drives [N/m].

    Args:
        hand: the hand, in float64.
        kp: stiffness (j,) [N m/rad] of every joint's drive, in the order of
            `hand.tree.joint_names`.
        obj_from_hand: planned pose (4, 4) [m] of the hand in the frame of the grasp.
        pregrasp: actuated joints (h,) [rad or m] of the opened hand.
        joints: actuated joints (h,) [rad or m] of the grasp.
        squeeze: targets (h,) [rad or m] of the actuated joints that press on the object without
            feedback, from `torchgrasp.control.squeeze`.
        normals: outward unit normals (f, 3) of the planned contacts.
        gains: targets, controller gains and desired forces of the closing mode "uncertainty"
            (`ClosingGains`). `as_printed` returns a plan with those of the mode "paper".
            `TrialSpec` explains the modes.
        approach: unit vector (3,) along which the opened hand moves to its pre-grasp; None means no
            approach.
        table: the table, which no fingertip enters while it searches; None if it is unknown.
        surface: estimated surface of the object (`surface_field`) in the frame of the grasp.
            Touches are compared with it to locate the object. None means that the tangent planes of
            the contacts are used.
        sensor: sensors of the fingertips.
        max_force: largest normal force [N] of a fingertip, 0.1 to 1000; None means no limit.
        distance_variance: variance (f,) [m^2] of the signed distance at each contact (f_cov in Eq.
            12 of the paper). The closing mode "paper" needs it. None if it is unknown.
        friction: coefficient of friction that the grasp was planned for, 0 to 10, or its
            `Distribution`.
        planned_table: table of the plan (`Grasps.table`) in the frame of the planned hand. A
            `GraspController` refuses a `table` that is far from it. None means no comparison.

    Raises `BadArgument` for a number outside its range, or a pose that is not rigid.
    """

    hand: Hand
    kp: Float[Tensor, " j"]
    obj_from_hand: Pose
    pregrasp: Float[Tensor, " h"]
    joints: Float[Tensor, " h"]
    squeeze: Float[Tensor, " h"]
    normals: Float[Tensor, "f 3"]
    gains: ClosingGains
    approach: Float[Tensor, "3"] | None = None
    table: Plane | None = None
    surface: SignedDistanceField | None = None
    sensor: SensorModel = dataclasses.field(default_factory=SensorModel)
    max_force: Annotated[float, Range(0.1, 1000.0)] | None = None
    distance_variance: Float[Tensor, "f"] | None = None
    friction: Annotated[float, Range(0.0, 10.0)] | Distribution = ContactSpec.friction
    planned_table: Plane | None = None

    @classmethod
    @checked
    def from_grasp(
        cls,
        hand: Hand,
        grasp: Grasps,
        force: Force = 4.0,
        kp: Positive | None = None,
        stability: finger_forces.ForcePreference | None = None,
    ) -> "ClosingReference":
        """Return the closing plan of one grasp, which a `GraspController` follows, in float64 on
        the CPU.

        Its `table` and `surface` are None, and its `sensor` is the default. Set them with
        `dataclasses.replace`.

        Args:
            hand: the hand of the grasp.
            grasp: a single grasp, such as `grasps[0]`.
            force: normal force [N] of the strongest finger.
            kp: stiffness [N m/rad] of every joint's drive; None means the hand's own.
            stability: model that chooses among balanced forces of nearly equal friction, and gives
                their covariance (`torchgrasp.control.paper.stability.load_stability`). With None,
                the standard deviation of a normal force is a tenth of the force.

        Raises `BadArgument` for:

        * not exactly one grasp, or a grasp of another hand or other fingers;
        * a grasp that failed a check: a robot would play it, too;
        * a hand whose geometry has changed since the plan;
        * joints beyond their limits, or numbers in the grasp that are not finite;
        * contacts without `std_m`;
        * a `force` outside [0.01, 100] N, or a stiffness that is not positive;
        * a friction in its metadata that is 0, or a distribution that includes 0;
        * a `stability` for other than three fingers.
        """
        check_single(grasp)
        finger_forces.check_all_executable(grasp)
        finger_forces.check_same_hand(hand, grasp)
        contacts = grasp.contacts
        check_tensor("grasp.contacts.points", contacts.points, (1, len(hand.tips), 3))
        check_tensor("grasp.contacts.normals", contacts.normals, (1, len(hand.tips), 3))
        std_m = check_tensor("grasp.contacts.std_m", contacts.std_m, (1, len(hand.tips)))
        std_m = std_m.to("cpu", torch.float64)
        if stability is not None:
            hand.require_three("stability", "a model of stability")
        hand = hand.to("cpu", torch.float64)
        grasp = grasp.to("cpu", torch.float64)
        hand.actuated.check_limits(grasp.joints, "grasp.joints")
        hand.actuated.check_limits(grasp.pregrasp, "grasp.pregrasp")
        points, normals = finger_forces.contacts_in_hand(grasp)
        preferred = None
        deviation = None
        if stability is not None:
            tips = points[0] + hand.tips.radius[:, None] * normals[0]
            preferred = stability.preferred_forces(tips, force).forces[None]
            # a given force has no deviation, so that none is given
            covariance = stability.preferred_forces(tips).covariance
            deviation = covariance.diagonal()[None].sqrt()
        desired = finger_forces.desired_forces(points, normals, force, preferred)
        # least standard deviation [N] of a force, for which the force loop is fastest
        sure = math.hypot(law.FORCE_FLOOR, 0.0 if deviation is None else float(deviation.min()))
        covariance = law.surface_covariance(normals, std_m)
        jacobian = hand.jacobian(grasp.joints, points)  # (1, f, 3, h)
        stiffness = joint_stiffness(hand, kp)
        compliance = finger_forces.tip_compliance(jacobian, normals, stiffness)
        force_covariance = law.force_covariance(desired, normals, deviation)
        force_rate = law.FORCE_BANDWIDTH * sure**2 * compliance
        gains = ClosingGains(
            target=points[0],
            covariance=covariance[0],
            position_gain=law.position_gain(covariance)[0],
            force_gain=law.force_gain(force_covariance, force_rate)[0],
            desired_force=desired[0],
            force_source="analytic" if stability is None else "stability",
        )
        pressed = finger_forces.press(grasp.joints, jacobian, desired, stiffness)
        # in the hand's frame
        direction = rotate(inverse(grasp.obj_from_hand), grasp.approach[:, None])[0, 0]
        return cls(
            hand,
            drive_stiffness(hand, kp),
            obj_from_hand=grasp.obj_from_hand[0],
            pregrasp=grasp.pregrasp[0],
            joints=grasp.joints[0],
            squeeze=pressed.joints[0],
            normals=normals[0],
            gains=gains,
            approach=unit(direction) if (direction != 0.0).any() else None,
            distance_variance=_distance_variance(grasp),
            friction=_friction(grasp),
            planned_table=grasp.table and grasp.table.moved(inverse(grasp.obj_from_hand[0])),
        )

    @checked
    def as_printed(self) -> "ClosingReference":
        """Return the same plan with the gains of the closing mode "paper" (`TrialSpec`).

        In `gains`, `covariance` and `position_gain` become those of Eqs. (26) and (27) as the paper
        prints them. Raises `BadArgument` if `distance_variance` is None.
        """
        if self.distance_variance is None:
            found = "'paper' without f_cov, the variance of the signed distance [m^2]"
            allowed = "grasps of `plan_grasps`, whose metadata hold unit_m"
            raise BadArgument("closing", found, allowed)
        covariance = law.printed_covariance(self.normals, self.distance_variance)
        gains = dataclasses.replace(
            self.gains, covariance=covariance, position_gain=law.position_gain(covariance)
        )
        return dataclasses.replace(self, gains=gains)

    @checked
    def expand(self, actuated: Annotated[Float[Tensor, " h"], ANY]) -> Float[Tensor, " j"]:
        """Return the positions (j,) [rad or m] of all joints of the URDF: actuated and coupled
        ones.

        `actuated` (h,) [rad or m] are the actuated joints, in the order of `hand.joint_names`. The
        result is in the order of `hand.tree.joint_names`. A NaN gives NaN, where
        `ActuatedJoints.expand` raises an error. Raises `BadArgument` for another number of joints.
        """
        return self.hand.actuated.coupling @ actuated + self.hand.actuated.offset

    @checked
    def pick(self, joints: Annotated[Float[Tensor, " j"], ANY]) -> Float[Tensor, " h"]:
        """Return the actuated joints (h,) [rad or m] among the positions of all joints of the URDF.

        `joints` (j,) [rad or m] are in the order of `hand.tree.joint_names`, the result in that of
        `hand.joint_names`. A NaN gives NaN. Raises `BadArgument` for another number of joints.
        """
        return joints[self._actuated]

    @kept
    def rise(self) -> Float[Tensor, "3"]:
        """The displacement (3,) [m] of the opened hand before it closes, which lifts all links out
        of the table.

        This cached property is in the frame of the planned hand. It is 0 without a table, and if no
        link is in the table. It is also 0 for a hand that would have to rise by more than 30 mm
        (`MOTION.most`).
        """
        planned = torch.eye(4, dtype=torch.float64)[None]
        return opened_pose(self.hand, self.pregrasp[None], planned, self.table)[0, :3, 3]

    @functools.cached_property
    def _actuated(self) -> list[int]:
        """The index of each actuated joint in the list of all joints of the URDF."""
        return [self.hand.tree.joint_names.index(name) for name in self.hand.joint_names]

    @property
    def alive(self) -> Bool[Tensor, "f"]:
        """The mask (f,) of the fingertips whose sensor works: those not in `sensor.dead`.

        Raises `BadArgument` if `sensor.dead` names an unknown finger.
        """
        names = self.hand.finger_names
        dead = self.sensor.dead
        if not set(dead) <= set(names):
            raise BadArgument("sensor", f"dead fingers {dead}", f"dead fingers among {names}")
        return torch.tensor([name not in dead for name in names])

    @checked
    def clamp(self, actuated: Float[Tensor, " h"]) -> Float[Tensor, " h"]:
        """Return the `actuated` joints (h,) [rad or m] clamped to their limits.

        Raises `BadArgument` for another number of joints, or numbers that are not finite.
        """
        return actuated.clamp(self.hand.lower, self.hand.upper)

    @checked
    def contact_points(self, tips: Float[Tensor, "f 3"]) -> Float[Tensor, "f 3"]:
        """Return the points (f, 3) [m] where fingertips would touch the object first.

        They are `tips` - r n, with the radius r of each fingertip and its outward normal n. This is
        the normal of its planned contact (`normals`). `tips` (f, 3) [m] are the centres of the
        fingertips. Tips and result are in the frame of the hand's root link at the planned pose.
        """
        return tips - self.hand.tips.radius[:, None] * self.normals


@dataclasses.dataclass(frozen=True)
class PlanNumbers:
    """Bounds [m or rad] beyond which `check_plan` refuses a closing plan: its table or its surface
    seems to be in another frame or unit.
    """

    tilt: float = 0.5
    """Largest angle [rad] between the plan's `table` and `planned_table`: no measurement errs so
    much.
    """
    off: float = 0.05
    """Largest distance [m] between these two tables at the planned contacts."""
    surface: float = 0.05
    """Largest median distance [m] of the planned contacts from the estimated surface."""
    below: float = 0.015
    """Largest depth [m] of a planned contact under the table."""
    upward: float = 0.5
    """Largest component of the approach along the table's normal: no hand comes from below."""


PLAN = PlanNumbers()


def check_plan(reference: ClosingReference) -> None:
    """Raise `BadArgument` for a closing plan whose parts do not fit together.

    It is refused in four cases:

    * There is not one positive stiffness for each joint of the URDF.
    * `normals` or `approach` are no unit vectors.
    * `table` is tilted by more than 0.5 rad, or is more than 50 mm off, relative to
      `planned_table`.
    * The median distance of the planned contacts from `surface` exceeds 50 mm.
    """
    joints = len(reference.hand.tree.joint_names)
    if len(reference.kp) != joints or not (reference.kp > 0).all():
        found = f"{len(reference.kp)} stiffnesses from {float(reference.kp.min()):g}"
        raise BadArgument("reference.kp", found, f"{joints} positive ones, of all joints")
    check_unit_vectors("reference.normals", reference.normals)
    if reference.approach is not None:
        check_unit_vectors("reference.approach", reference.approach)
    points = reference.gains.target
    if reference.table is not None and reference.planned_table is not None:
        table = reference.table
        planned = reference.planned_table
        tilt = float(table.normal.double() @ planned.normal.double())
        off = float((table.height(points) - planned.height(points)).abs().max())
        if tilt < math.cos(PLAN.tilt) or off > PLAN.off:
            degrees = math.degrees(math.acos(max(min(tilt, 1.0), -1.0)))
            found = f"one {degrees:.0f} degrees and {1000 * off:.0f} mm off that of the grasp"
            allowed = "that in the hand's frame: `grasp.table.moved(hand_from_obj)`"
            raise BadArgument("reference.table", found, allowed)
    elif reference.table is not None and reference.table.edge is None:
        _check_told_table(reference, reference.table)
    if reference.surface is not None:
        check_surface(
            "reference.surface", reference.surface, apply(reference.obj_from_hand, points)
        )


def _check_told_table(reference: ClosingReference, table: Plane) -> None:
    """Raise `BadArgument` for the table of a grasp without one if contacts are below it, or the
    hand comes from below.
    """
    lowest = float(table.height(reference.gains.target).min())
    found = ""
    if lowest < -PLAN.below:
        found = f"one {-1000 * lowest:.0f} mm above a planned contact"
    elif reference.approach is not None and float(reference.approach @ table.normal) > PLAN.upward:
        found = "one from below which the hand approaches"
    if found:
        allowed = "that in the hand's frame: `table.moved(hand_from_obj)`"
        raise BadArgument("reference.table", found, allowed)


def check_surface(name: str, surface: SignedDistanceField, points: Float[Tensor, "*b 3"]) -> None:
    """Raise `BadArgument` for an estimated surface that is not at the planned contacts.

    `points` [m] are the contacts in the frame of the surface, `name` is that of the surface.
    """
    distance, _ = surface.query(points)
    off = float(distance.abs().median())
    if off > PLAN.surface:
        found = f"one {1000 * off:.0f} mm off the planned contacts"
        allowed = "the estimated surface of this object, in the frame of the grasp"
        raise BadArgument(name, found, allowed)


def check_single(grasp: Grasps) -> None:
    """Raise `BadArgument` unless `grasp` holds exactly one grasp."""
    if len(grasp) != 1:
        allowed = "exactly one: index the grasps, as in grasps[0]"
        raise BadArgument("grasp", f"{len(grasp)} rows", allowed)


def next_target(
    reference: ClosingReference,
    target: Float[Tensor, " h"],
    velocity: Float[Tensor, "f 3"],
    observation: Observation,
    lead: Float[Tensor, " h"] | float,
    period: float,
    fastest: float = math.inf,
) -> Float[Tensor, " h"]:
    """Return the targets (h,) [rad] of the actuated joints after another control period, which move
    the fingertips with a `velocity`.

    They are within the joint limits. No target moves faster than `fastest`: all joints slow down
    together, so that the fingertips keep their directions.

    Args:
        reference: the closing plan.
        target: the present targets [rad] of the h actuated joints.
        velocity: commanded velocity [m/s] of each of f fingertips, in the frame of the planned
            hand's root link.
        observation: the present observation.
        lead: largest difference [rad] between a target and the measured joint: one for all joints,
            or (h,).
        period: control period [s]: time to the next targets.
        fastest: largest speed [rad/s] of a target.
    """
    jacobian = observation.jacobian @ reference.hand.actuated.coupling
    step = law.joint_step(jacobian, velocity, period, reference.joints - target)
    step = step * min(1.0, fastest * period / max(float(step.abs().max()), law.TINY))
    joints = reference.pick(observation.joints)
    near = (target + step).clamp(joints - lead, joints + lead)
    return reference.clamp(near)


def _distance_variance(grasp: Grasps) -> Float[Tensor, "f"] | None:
    """Return f_cov [m^2] at the contacts of one grasp, or None without the unit of its variance.

    It is `std_m`^2 if the grasp has no normalised variance.
    """
    contacts = grasp.contacts
    unit_m = _unit_length(grasp)
    if contacts.variance is None:
        return contacts.require_std()[0] ** 2
    return None if unit_m is None else contacts.variance[0] * unit_m**2


def _friction(grasp: Grasps) -> float | Distribution:
    """Return the friction in the metadata of a grasp, by default that of `ContactSpec`."""
    text = grasp.meta.get("friction")
    if text is None:
        return ContactSpec.friction
    try:
        friction = Distribution.parse(text)
    except BadArgument:
        friction = None
    if friction is None or friction.least <= 0.0:
        allowed = "a positive number, or a distribution"
        raise BadArgument("grasp.meta['friction']", repr(text), allowed)
    return friction.simplest


def _unit_length(grasp: Grasps) -> float | None:
    """Return the length [m] of the normalised unit, from the metadata of a grasp; None if they lack
    it.
    """
    text = grasp.meta.get("unit_m")
    if text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not number > 0.0:
        raise BadArgument("grasp.meta['unit_m']", repr(text), "a positive number")
    return number


@checked
def closing_gains(
    grasp: Grasps,
    hand: Hand,
    force: Force = 4.0,
    stability: finger_forces.ForcePreference | None = None,
) -> ClosingGains:
    """Return the target, gains and desired force of each finger for one grasp.

    They are in the frame of the hand's root link at the planned pose. The gains are those of the
    closing mode "uncertainty" (`TrialSpec`). `ClosingReference.as_printed` has those that the paper
    prints.

    Args:
        grasp: a single grasp, such as `grasps[0]`.
        hand: the hand of the grasp.
        force: normal force [N] of the strongest finger.
        stability: model of which forces of three fingers hold an object stably
            (`torchgrasp.control.paper.stability.load_stability`). Of balanced forces that need
            almost the least friction, those nearest to its preference are taken. None means that
            equal normal forces are preferred.

    Raises `BadArgument` for more than one grasp, a grasp of another hand, or contacts without
    `std_m`. Raises it for a `force` outside [0.01, 100] N, and in the other cases of
    `ClosingReference.from_grasp`.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> gains = closing_gains(load_shipped_grasp("jug", "barrett"), load_hand("barrett"), force=2.0)
    >>> f"{gains.desired_force.norm(dim=-1).max():.1f} N"
    '2.0 N'
    """
    return ClosingReference.from_grasp(hand, grasp, force, stability=stability).gains
