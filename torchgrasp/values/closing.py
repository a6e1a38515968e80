"""Values for the closing of a hand on an object: options, sensors and controller gains, and the
measured results.
"""

import dataclasses
from typing import Annotated, Literal, NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import ANY, Measured, Range
from torchgrasp.values.distribution import Distribution


@checked
@dataclasses.dataclass(frozen=True)
class ClosingGains(Value):
    """Targets and gains of the closing controller for f fingers (Eqs. 26-28 of the paper), in the
    hand's frame.

    `closing_gains` returns them. The hand's frame is the frame of its root link at the planned
    pose.

    Attributes:
        target: planned position (f, 3) [m] of each contact.
        covariance: uncertainty (f, 3, 3) [m^2] of each position.
        position_gain: diagonal (f, 3) [1/s] of each finger's position gain matrix.
        force_gain: diagonal (f, 3) [m/(s N)] of each finger's force gain matrix.
        desired_force: force (f, 3) [N] that each finger is to exert on the object.
        force_source: how `desired_force` was chosen among the balanced forces: "stability" by the
            hand's learned stability model, else "analytic".

    >>> from torchgrasp import closing_gains, load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> gains = closing_gains(load_shipped_grasp("jug", "allegro"), load_hand("allegro"))
    >>> gains.desired_force.norm(dim=-1).round(decimals=1)  # [N] of each finger
    tensor([2.8000, 1.2000, 4.0000], dtype=torch.float64)
    """

    target: Float[Tensor, "f 3"]
    covariance: Float[Tensor, "f 3 3"]
    position_gain: Float[Tensor, "f 3"]
    force_gain: Float[Tensor, "f 3"]
    desired_force: Float[Tensor, "f 3"]
    force_source: str = "analytic"


class ObjectMotion(NamedTuple):
    """Motion of an object between two times, relative to the hand or to the world.

    Attributes:
        distance: how far [m] the object's centre moved; NaN if it was not measured.
        angle: how far [rad] the object turned; NaN if it was not measured.

    >>> slip = ObjectMotion(distance=0.004, angle=0.1)
    >>> f"{1000 * slip.distance:g} mm, {57.3 * slip.angle:.0f} degrees"
    '4 mm, 6 degrees'
    """

    distance: float
    angle: float


@checked
@dataclasses.dataclass(frozen=True)
class Disturbance(Value):
    """Unintended contacts of the hand in a simulated trial, of three kinds.

    It is the field `disturbance` of a `ClosureResult`. Each tensor (3,) has one entry for each
    kind:

    * 0: contacts with neighbours of the object.
    * 1: contacts with the table.
    * 2: contacts of other links than fingertips with the object.

    Attributes:
        first_touch: time (3,) [s] of the first contact, from the start of the simulation as in
            `ClosureResult.time`; infinite if there is none.
        impulse: sum (3,) of the normal impulses [N s].
        force: largest normal force (3,) [N], averaged over a control tick.
        early: mask (3,) of the kinds whose first contact was before a fingertip touched the object.
        neighbour_pose: rigid transforms (t, m, 4, 4) [m] of m neighbours at t control ticks. They
            are in the frame of the planned cloud. Each moves a neighbour from its start to its
            position at the tick.
    """

    first_touch: Annotated[Float[Tensor, "3"], ANY]
    impulse: Float[Tensor, "3"]
    force: Float[Tensor, "3"]
    early: Bool[Tensor, "3"]
    neighbour_pose: Float[Tensor, "t m 4 4"]


@checked
@dataclasses.dataclass(frozen=True)
class ClosingTrace(Value):
    """True contacts of f fingertips, and estimates of the controller, at t control ticks, the
    periods of the controller.

    It is the field `trace` of a `ClosureResult`. Points and vectors are in the frame of the hand's
    root link, which moves with the hand.

    Attributes:
        forces: contact forces (t, f, 3) [N] on the object, with friction; 0 without contact.
        points: contact points (t, f, 3) [m]; NaN without contact.
        normals: outward unit normals (t, f, 3) of the object; NaN without contact.
        sliding: speed (t, f) [m/s] of each fingertip along the surface.
        blend: weight lambda (t, f) of Eq. (26) of the paper, 0 for position and 1 for force
            control. NaN if the control law was not active.
        friction: coefficient of friction (t,) that the holding mode "grip" (`TrialSpec.holding`)
            estimates; NaN before the hand holds.
        load: load (t,) [N] on the grasp that the holding mode "grip" estimates; NaN before the hand
            holds.
    """

    forces: Annotated[Float[Tensor, "t f 3"], ANY]
    points: Annotated[Float[Tensor, "t f 3"], ANY]
    normals: Annotated[Float[Tensor, "t f 3"], ANY]
    sliding: Annotated[Float[Tensor, "t f"], ANY]
    blend: Annotated[Float[Tensor, "t f"], ANY]
    friction: Annotated[Float[Tensor, "t"], ANY]
    load: Annotated[Float[Tensor, "t"], ANY]


@checked
@dataclasses.dataclass(frozen=True)
class ClosureResult(Value):
    """The result of closing a hand on the true object in simulation, recorded at t control ticks.

    `close_hand` returns it. A control tick is a period of the controller. f counts fingertips, and
    j all joints of the URDF. The frame of the grasp is that of the planned cloud. Numbers that were
    not measured before the trial ended are NaN. Poses are rigid transforms [m]. Joints that slide
    have [m] in place of [rad].

    Attributes:
        held: whether the object was lifted with the hand and slipped little. Its centre then rose
            by at least half the lift, and two or more fingers touch it at the end. It slipped by
            less than 20 mm and 30 degrees.
        status: `OK`, or the reason why the object was not held.
        time: times (t,) [s] at which the control ticks ended, from the start of the simulation.
        forces: normal force (t, f) [N] of each fingertip; 0 without contact.
        object_pose: transform (t, 4, 4) in the frame of the grasp. It moves the mesh, the argument
            of `close_hand`, to the object's pose at the tick.
        hand_pose: pose (t, 4, 4) of the hand's root link in the frame of the grasp.
        joints: positions (t, j) [rad or m] of all joints, in the order of `joint_names`.
        targets: positions (t, j) [rad or m] that were the targets of the drives in the tick.
        joint_names: names of all joints of the URDF.
        contact_order: indices of the fingers that touched, in the order of their first contacts.
        object_motion: motion of the object relative to the hand, from the end of the approach to
            the end of the trial.
        pushed: motion of the object in the world, from the end of the approach to that of the
            closing (`phases`).
        before_lift: motion of the object in the world, from the start of the trial to the end of
            the pressing.
        rise: height [m] by which the object's centre is higher at the end of the trial than at its
            start.
        unbalanced: norm of the sum of the fingertip forces before the lift, divided by the sum of
            their norms (no unit).
        slip: motion of the object relative to the hand, from the end of the pressing to the end of
            the trial.
        start_overlap: depth [m] by which the opened hand penetrates the object or the table at the
            start.
        disturbance: unintended contacts of the hand.
        trace: contacts and estimates at every tick.
        phases: times (3,) [s] at which approach, closing and pressing ended. The closing ends when
            all fingers touch, or are given up. A trial may end earlier. Then an approach that did
            not end has the time 0, and other phases NaN.
        stops: how often the approaching hand stopped at a contact.
        attempts: number of closings of the hand.
        seconds: wall time [s] of the trial.
        friction: `Distribution` of the coefficient of friction. It is the planned distribution,
            limited to the interval that sticking and sliding fingertips allow. If the plan excludes
            this interval, the distribution follows from the touches alone. None if the hand did not
            hold in the mode "grip" (`TrialSpec.holding`).
        mass: `Distribution` of the object's mass [kg], from the load that the hand measured while
            nothing pushed at the object. None if the holding mode "grip" measured no steady load.
        finger_names: names of the f fingers, in the order of all tensors of fingers. It is empty
            for a record that does not name them.
    """

    held: bool
    status: Status
    time: Float[Tensor, "t"]
    forces: Annotated[Float[Tensor, "t f"], ANY]
    object_pose: Annotated[Float[Tensor, "t 4 4"], ANY]
    hand_pose: Annotated[Float[Tensor, "t 4 4"], ANY]
    joints: Annotated[Float[Tensor, "t j"], ANY]
    targets: Annotated[Float[Tensor, "t j"], ANY]
    joint_names: tuple[str, ...]
    contact_order: tuple[int, ...]
    object_motion: ObjectMotion
    pushed: ObjectMotion
    before_lift: ObjectMotion
    rise: Measured
    unbalanced: Measured
    slip: ObjectMotion
    start_overlap: Measured
    disturbance: Disturbance
    trace: ClosingTrace
    phases: Annotated[Float[Tensor, "3"], ANY]
    stops: int
    attempts: int
    seconds: float
    friction: Distribution | None = None
    mass: Distribution | None = None
    finger_names: tuple[str, ...] = ()


SensorKind = Literal["tactile", "torque", "binary"]
"""Kinds of fingertip sensors; `SensorModel` explains them."""


@checked
@dataclasses.dataclass(frozen=True)
class ClosingOptions(Value):
    """Options of the closing modes "uncertainty" and "fixed" (`TrialSpec`), which extend the
    paper's control law.

    Args:
        wait: whether a finger that touches waits for the others, so that all press together.
        pose_estimate: whether early and late touches update the estimated object pose, which moves
            all contact targets.
        palm_reach: largest displacement [m] of the palm, by which it follows the estimated object
            pose. 0 means that the palm does not move.
        stops: how often the approaching hand may stop at an unexpected contact and move sideways; 0
            means never.
        attempts: largest number of closings. On a known table the hand closes again if the grasp
            seems too weak to lift.

    Raises `BadArgument` for a number outside its range, and for options that exclude each other:

    * a `palm_reach` above 0, or more than 1 of `attempts`, without `pose_estimate`;
    * `stops` above 0 with a `palm_reach` of 0.

    >>> ClosingOptions(palm_reach=0.0, stops=0).attempts  # an arm that cannot yield
    5
    """

    wait: bool = True
    pose_estimate: bool = True
    palm_reach: Annotated[float, Range(0.0, 0.1)] = 0.07
    stops: Annotated[int, Range(0, 100)] = 3
    attempts: Annotated[int, Range(1, 100)] = 5

    def __post_init__(self) -> None:
        if not self.pose_estimate and (self.palm_reach or self.attempts > 1):
            found = f"a reach of {self.palm_reach:g} m and {self.attempts} attempts without pose_estimate"
            raise BadArgument("palm_reach", found, "0 m and 1 attempt")
        if self.stops and not self.palm_reach:
            raise BadArgument("stops", f"{self.stops} with a reach of 0 m", "0")


NO_OPTIONS = ClosingOptions(wait=False, pose_estimate=False, palm_reach=0.0, stops=0, attempts=1)
"""The paper's own control law: all options are off."""


def choose_options(closing: str, options: ClosingOptions | None) -> ClosingOptions:
    """Return the options with which a hand closes in the mode `closing` (`TrialSpec.closing`).

    In the modes "uncertainty" and "fixed" they are the argument `options`, or `ClosingOptions()`
    for None. In other modes all options are off (`NO_OPTIONS`). In these modes `options` other than
    None raise `BadArgument`.
    """
    if closing in ("uncertainty", "fixed"):
        return ClosingOptions() if options is None else options
    if options is not None:
        raise BadArgument(
            "options", f"options for {closing!r}", "None, or closing 'uncertainty' or 'fixed'"
        )
    return NO_OPTIONS


@checked
@dataclasses.dataclass(frozen=True)
class SensorModel(Value):
    """The sensors of a hand's fingertips: kind, delay, noise and dead sensors.

    `FingertipSensor` simulates them.

    Args:
        kind: what the sensors measure.
            "tactile": force, position and sliding of each contact, like a BioTac.
            "torque": only the force, from the torques of the finger's joints.
            "binary": only whether the tip touches.
        delay: age [s] of the readings, rounded to whole samples. The sensor samples at 100 Hz, or
            once a control tick if ticks are longer.
        noise: factor (no unit) on the usual noise. The usual standard deviation is 0.1 N of a
            tactile normal force, and 0.01 N m of a joint torque.
        dead: names of the fingers whose sensor is known to be broken.

    Raises `BadArgument` for a number outside its range, or an unknown kind. Names in `dead` are
    only checked where the model meets a hand, as in `close_hand`.

    >>> SensorModel("binary").full
    False
    """

    kind: SensorKind = "tactile"
    delay: Annotated[float, Range(0.0, 0.2)] = 0.0
    noise: Annotated[float, Range(0.0, 100.0)] = 1.0
    dead: tuple[str, ...] = ()

    @property
    def full(self) -> bool:
        """Whether the sensors of all fingers measure force, position and sliding.

        This is so if `kind` is "tactile" and no finger is in `dead`.
        """
        return self.kind == "tactile" and not self.dead
