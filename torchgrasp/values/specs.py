"""Options of contact planning and of simulated trials, with units, ranges and defaults."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

from torchgrasp.foundation.base import FINGERTIPS, Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Force, Length, Range
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.values.closing import ClosingOptions, ClosureResult, SensorModel, choose_options
from torchgrasp.values.distribution import Distribution, check_within

Simulator = Literal["sapien", "mujoco"]
"""The simulators."""
GRAVITY = 9.81
"""Acceleration [m/s^2] by gravity."""
RIM = 0.001  # radius [m] that is flat on a rim
PAPER_RADIUS = 0.1  # the paper's radius of starts, normalised
ROUNDING = 1e-9  # relative error of a period
UNEVEN = 1e-3  # largest relative error of a period that is no whole number of timesteps
FRICTIONS = Range(0.0, 10.0)
"""The coefficients of friction that are possible."""
MASSES = Range(0.001, 10.0)
"""The masses [kg] of objects that are possible."""
TIP_RADIUS = 0.012
SEPARATION = 0.026
"""Default least distance [m] between the centres of two fingertips. `TIP_RADIUS` is the default
radius [m] of a fingertip. Wider links lie behind smaller fingertips.
"""
FLAT_RADII = (0.008, 0.006, 0.004, 0.003)
"""Radii [m] within which the surface at a contact must be flat; the largest that the object allows
is used.
"""


@checked
@dataclasses.dataclass(frozen=True)
class ContactSpec(Value):
    """The constraints on sets of three to five contacts (Eqs. 10-14). `ContactSpec.paper()` returns
    those of the paper.

    The estimated surface differs from the true one. So the defaults keep larger margins than the
    paper: a lower friction, a flat surface, and a distance between fingertips. Normalised lengths
    are the paper's: one unit is `ShapeGP.scale` metres.

    Args:
        friction: coefficient of friction between fingertip and object at execution, 0 to 10, or its
            `Distribution`.
        edges: number of edges of the linearised friction cone, at least 3.
        max_variance: largest variance of the signed distance at a contact, S_thresh of Eq. (12), in
            squared normalised units.
        friction_margin: factor, 0.001 to 1, on the mean friction in planning. Contacts are planned,
            and checked for force closure, with `planned_friction`. This is mean friction times
            `friction_margin`.
        separation: least distance [m] between the centres of two fingertips. None means
            26 mm (`SEPARATION`), or more for wide fingertips (`least_separation`). Contacts on
            opposite sides of a thin object may be closer.
        flatness: largest angle [rad] between the normals at a contact and on a ring around it. None
            means that flatness is not checked.
        flat_radius: radius [m] of the ring. None means the largest of 8, 6, 4 and 3 mm
            (`FLAT_RADII`) that the object allows. If `plan_grasps` finds no grasp on a table, it
            then goes down to 1 mm (`RIM`).
        table: the table's `Plane` in the cloud's frame, or its height [m] along z; None means no
            table.
        tip_radius: radius [m] of the fingertips, balls that must stay above the table; 0 means
            points. None means the radius of the hand's fingertips, but at least 12 mm
            (`TIP_RADIUS`).
        start_radius: radius, normalised, of the sphere on which initial guesses are drawn. Its
            centre is that of the shape's frame (Sec. 6.2 of the paper).
        fingertips: number of contacts, one for each fingertip: 3, 4 or 5.
        contact_allowed: whether links may touch and push the target's neighbours. Such collisions
            then lower the predicted success, but do not make a grasp fail.
        region: where contacts may be: a `Region`, or a function of points (n, 3) [m] that returns
            their signed distances (n,) [m], negative inside. None means anywhere.

    Raises `BadArgument` for a number outside its range, or an argument of another type.

    >>> ContactSpec(friction=0.8).planned_friction
    0.4
    """

    friction: Annotated[float, FRICTIONS] | Distribution = 0.8
    edges: Annotated[int, Range(3, 1024)] = 8
    max_variance: Annotated[float, Range(1e-12, 1000000.0)] = 0.03
    friction_margin: Annotated[float, Range(0.001, 1.0)] = 0.5
    separation: Annotated[float, Range(0.0, 1.0)] | None = None
    flatness: Annotated[float, Range(0.001, 3.1416)] | None = 0.44
    flat_radius: Annotated[float, Range(0.0001, 0.1)] | None = None
    table: Plane | float | None = None
    tip_radius: Annotated[float, Range(0.0, 1.0)] | None = None
    start_radius: Annotated[float, Range(1e-06, 1.2)] = 0.9
    fingertips: Annotated[int, Range(*FINGERTIPS)] = 3
    contact_allowed: bool = False
    region: Callable[..., Any] | None = None

    def __post_init__(self) -> None:
        check_within("friction", self.friction, FRICTIONS)

    @property
    def mean_friction(self) -> float:
        """The coefficient of friction at execution; for a distribution its mean."""
        return Distribution.of(self.friction).mean

    @property
    def plane(self) -> Plane | None:
        """The table as a `Plane` in the cloud's frame; None without a table.

        A `table` that is a height [m] is the level plane z = height.
        """
        return as_plane(self.table)

    @checked
    def updated(self, result: ClosureResult) -> "ContactSpec":
        """Return this spec with the friction coefficient that a closing has measured
        (`ClosureResult.friction`), to plan the next grasp.

        `result` is what `close_hand` returned. If its `friction` is None, the spec is returned as
        it is.
        """
        if result.friction is None:
            return self
        return dataclasses.replace(self, friction=result.friction.simplest)

    @property
    def planned_friction(self) -> float:
        """The friction coefficient (no unit) with which contacts are planned, and checked for force
        closure (`certify`).

        It is the mean friction at execution times `friction_margin`.
        """
        return self.mean_friction * self.friction_margin

    @property
    def fingertip_radius(self) -> float:
        """The radius [m] of the fingertips: the field `tip_radius`, or 12 mm (`TIP_RADIUS`) if that
        is None.
        """
        return TIP_RADIUS if self.tip_radius is None else self.tip_radius

    @property
    def ring_radius(self) -> float:
        """The radius [m] around a contact within which the surface must be flat.

        This is the field `flat_radius`. If that is None, it is 8 mm, the largest of `FLAT_RADII`.
        """
        return FLAT_RADII[0] if self.flat_radius is None else self.flat_radius

    @property
    def least_separation(self) -> float:
        """The least distance [m] between the centres of two fingertips.

        This is the field `separation`. If that is None, it is 26 mm (`SEPARATION`) for fingertips
        of radius 12 mm (`TIP_RADIUS`) or less. For wider ones it grows by the difference of the
        diameters.

        >>> f"{1e3 * ContactSpec(tip_radius=0.015).least_separation:.0f} mm"
        '32 mm'
        """
        wider = 2 * max(self.fingertip_radius - TIP_RADIUS, 0.0)
        return SEPARATION + wider if self.separation is None else self.separation

    @property
    def least_height(self) -> float:
        """The least height [m] of an object on the table that fingertips can grasp while they rest
        on the table.

        Fingertips are balls of radius r, the `fingertip_radius`. With a `flat_radius` they must
        touch a flat side, and the least height is r + `flat_radius`. With None they may touch the
        object's rounded upper rim, and the least height is (r + q)(1 - s). Here q is the rim's
        radius, 3 mm, the least of `FLAT_RADII`. The number s is the largest vertical component of
        the contact's unit normal that `mean_friction` allows.
        """
        if self.flat_radius is not None:
            return self.fingertip_radius + self.flat_radius
        slope = math.sin(math.atan(self.mean_friction * math.cos(math.pi / self.edges)))
        return (self.fingertip_radius + FLAT_RADII[-1]) * (1 - slope)

    @checked
    def for_fingertips(self, radius: Length) -> "ContactSpec":
        """Return the spec for a hand whose fingertips have the given `radius` [m].

        A `tip_radius` of None becomes `radius`, but at least 12 mm (`TIP_RADIUS`). Otherwise the
        spec is returned as it is. Raises `BadArgument` for a negative radius, and for a
        `tip_radius` above 1 m.

        >>> wide = ContactSpec().for_fingertips(0.015)
        >>> points = ContactSpec(tip_radius=0.0).for_fingertips(0.015)
        >>> wide.tip_radius, points.tip_radius
        (0.015, 0.0)
        """
        return (
            self
            if self.tip_radius is not None
            else dataclasses.replace(self, tip_radius=max(radius, TIP_RADIUS))
        )

    @checked
    def relaxed(self, below: Length, radius: Length) -> "Iterator[ContactSpec]":
        """Yield specs with weaker constraints, for an object for which no grasp was found. The
        strictest spec comes first.

        First come specs with a smaller `flat_radius`: those of 8, 6, 4 and 3 mm (`FLAT_RADII`) that
        are less than `below`.

        With a table, three specs with a `flat_radius` of 1 mm (`RIM`) follow. They are for a low
        object, whose inclined upper rim is touched by fingertips that rest on the table. The
        estimated rim is too round, so its normals are too steep. Therefore the second spec reduces
        two margins by half, and the third spec drops them. The first margin is that of the
        friction: `planned_friction` rises to `mean_friction`. The second is that of a `tip_radius`
        of None: it falls from at least 12 mm (`TIP_RADIUS`) to `radius`.

        There are no specs if `flatness` is None, or if `flat_radius` is not None.

        Args:
            below: radius [m] of the flat areas that were tried before.
            radius: radius [m] of the hand's fingertips; 0 keeps `tip_radius` as it is.

        Raises `BadArgument` for a `below` or `radius` that is negative or above 10 m.

        >>> relaxed = ContactSpec(table=0.0).relaxed(0.003, 0.0096)
        >>> [round(spec.planned_friction, 1) for spec in relaxed]
        [0.4, 0.6, 0.8]
        """
        if self.flatness is None or self.flat_radius is not None:
            return
        for flat in FLAT_RADII:
            if flat < below:
                yield dataclasses.replace(self, flat_radius=flat)
        widest = self.for_fingertips(radius).fingertip_radius
        if self.table is None:
            return
        for spent in (0.0, 0.5, 1.0):
            margin = self.friction_margin + spent * (1 - self.friction_margin)
            tips = self.tip_radius
            if tips is None and radius > 0:
                tips = widest + spent * (radius - widest)
            yield dataclasses.replace(
                self, flat_radius=RIM, tip_radius=tips, friction_margin=margin
            )

    @classmethod
    @checked
    def paper(
        cls,
        friction: float | Distribution = 0.8,
        edges: int = 8,
        max_variance: float = 0.03,
        table: Plane | float | None = None,
    ) -> "ContactSpec":
        """Return the constraints of the paper.

        Contacts are planned with the whole friction (`friction_margin` 1). Fingertips are points
        (`tip_radius` 0). They may be at any distance (`separation` 0), and the surface need not be
        flat (`flatness` None). Initial guesses are drawn on the paper's sphere (`start_radius`
        0.1).

        Args:
            friction: coefficient of friction between fingertip and object, or its `Distribution`.
            edges: number of edges of the linearised friction cone, at least 3.
            max_variance: largest variance of the signed distance at a contact, in squared
                normalised units; one unit is `ShapeGP.scale` metres.
            table: the table's `Plane` in the cloud's frame, or its height [m] along z; None means
                no table.

        Raises `BadArgument` for a number outside its range, or an argument of another type.

        >>> ContactSpec.paper(friction=0.8).planned_friction, ContactSpec.paper().flatness
        (0.8, None)
        """
        spec = cls(
            friction,
            edges,
            max_variance,
            friction_margin=1.0,
            flatness=None,
            table=table,
            start_radius=PAPER_RADIUS,
        )
        return dataclasses.replace(spec, separation=0.0, tip_radius=0.0)


Mode = Literal["joint", "contact_first", "paper"]
"""How planned contacts become grasps.

* "joint": the hand starts from random postures near each contact set. If none succeeds, the
  contacts move along the surface with the hand.
* "contact_first": initial postures of the learned model are refined onto fixed contacts.
* "paper": the paper's method (docs/paper.md). Initial postures are those of the model by Eqs.
  21-24, refined by COBYLA. Shape, contacts and ranking are the paper's.
"""
Ranking = Literal["success", "variance"]
"""Which grasp is the best: the one with the highest predicted success, or the least sum of
variances (the paper's).
"""
ClosingMode = Literal["open_loop", "position", "paper_position", "fixed", "paper", "uncertainty"]
"""How a hand closes; `TrialSpec` explains the modes."""
HoldingMode = Literal["force", "grip", "impedance", "position", "law"]
"""How a closed hand presses; `TrialSpec` explains the modes."""


@checked
@dataclasses.dataclass(frozen=True)
class TrialSpec(Value):
    """Parameters of a simulated trial: close the hand on the true object, lift it off the table,
    hold it.

    `close_hand` runs such a trial, and says when the object counts as held. The controller does not
    know `mass`, `density`, `friction`, `gravity`, `patch`, `table_friction`, `push`, `simulator`
    and `timestep`.

    The closing law is that of the paper (Eqs. 25-28). A fingertip's position is controlled while it
    is far from its contact, and its force near the contact.

    Args:
        closing: how the hand closes.
            "uncertainty": the closing law, with lower gains where the surface is more uncertain.
              Its calibrated standard deviations are used. `options` apply.
            "fixed": the same with equal gains for all contacts.
            "paper": the closing law as the paper prints it. A learned stability model gives the
              desired forces. If the hand's folder has no stability.safetensors, a formula does.
            "paper_position": PI position control to the contacts until 0.5 N, the paper's baseline.
            "position": PI control to goals behind the contacts.
            "open_loop": joint motion from pre-grasp to grasp to squeeze, the targets with which the
              fingers press.
        holding: how the closed hand presses; after "open_loop" the squeeze is kept.
            "grip": as strong as the measured load plus a push of 2.5 N requires.
            "force": balanced forces, of which `force` sets the strength.
            "impedance": virtual springs keep the fingertips together and in place.
            "position": joint targets are kept.
            "law": the closing law continues.
            None means "grip". It means "force" in three cases: `force` is given, the closing is
              neither "uncertainty" nor "fixed", or a fingertip has no working tactile sensor.
        mass: mass [kg] of the object, 0.001 to 10. From a `Distribution` each trial draws it by its
            seed.
        friction: coefficient of friction of every contact, 0 to 10. From a `Distribution` each
            trial draws it by its seed.
        gravity: acceleration by gravity [m/s^2].
        approach: length [m] of the straight path to the pre-grasp; 0 means that the hand starts
            there.
        lift_height: height [m] of the lift.
        hold_time: time [s] after the lift.
        shake: amplitude [m] of a vertical sinusoid of 5 Hz during the hold.
        force: normal force [N] of the strongest finger in the closing and in the holding "force".
            None means 4 N, but at most `max_force`.
        noise: whether the sensors are noisy (`SensorModel.noise` scales the noise).
        timestep: timestep [s] of the simulator.
        control_rate: rate [Hz] of the controller.
        simulator: "sapien" or "mujoco".
        density: density [kg/m^3] of the object, in place of `mass`; None means that `mass` counts.
        patch: radius [m] of the contact patch of a fingertip. The torque of torsional friction is
            friction x force x patch. With 0 the contacts are hard points, as in the paper.
        kp: stiffness [N m/rad] of all joint drives; None means the hand's own.
        overlap: depth [m] by which the hand may penetrate the object or the table at the start. It
            is above 0 because the object's convex parts bulge a little. A deeper overlap ends the
            trial.
        table: whether the object stands on a table; without one it falls, unless `gravity` is 0.
        self_collision: whether links of the hand collide with each other, in the pairs that the
            hand names.
        options: options of the closing "uncertainty" or "fixed"; None means `ClosingOptions()`.
        sensor: sensors of the fingertips; the controller knows their kind.
        max_force: largest normal force [N] of a fingertip; None means no limit.
        table_friction: coefficient of friction between object and table; None means `friction`.
        push: force [N] (x, y, z) at the object's centre of mass during the hold. It is along the
            world's axes, whose z axis points up.

    Raises `BadArgument` for:

    * a number outside its range, or an unknown closing, holding or simulator;
    * `options` of a closing that has none;
    * a closing or holding that needs more than the `sensor` measures;
    * the holding "law" after a closing other than "uncertainty", "fixed" and "paper";
    * the holding "grip" or "impedance" after the closing "open_loop";
    * a `max_force` with a holding that cannot keep it (`check_limit`);
    * a `force` above `max_force`, or a `table_friction` above the least `friction`;
    * a control period that is no whole number of timesteps.

    >>> TrialSpec(mass=0.3).pressing, TrialSpec(force=6.0).pressing
    ('grip', 'force')
    """

    closing: ClosingMode = "uncertainty"
    holding: HoldingMode | None = None
    mass: Annotated[float, MASSES] | Distribution = 0.1
    friction: Annotated[float, FRICTIONS] | Distribution = 0.8
    gravity: Annotated[float, Range(0.0, 100.0)] = GRAVITY
    approach: Annotated[float, Range(0.0, 1.0)] = 0.1
    lift_height: Annotated[float, Range(0.0, 1.0)] = 0.1
    hold_time: Annotated[float, Range(0.0, 60.0)] = 2.0
    shake: Annotated[float, Range(0.0, 0.02)] = 0.0
    force: Force | None = None
    noise: bool = True
    timestep: Annotated[float, Range(0.0001, 1 / 60)] = 1 / 500
    control_rate: Annotated[float, Range(10.0, 1000.0)] = 100.0
    simulator: Simulator = "sapien"
    density: Annotated[float, Range(1.0, 100000.0)] | None = None
    patch: Annotated[float, Range(0.0, 1.0)] = 0.0
    kp: Annotated[float, Range(0.001, 1000000.0)] | None = None
    overlap: Annotated[float, Range(0.0, 1.0)] = 1e-3
    table: bool = True
    self_collision: bool = True
    options: ClosingOptions | None = None
    sensor: SensorModel = dataclasses.field(default_factory=SensorModel)
    max_force: Annotated[float, Range(0.1, 1000.0)] | None = None
    table_friction: Annotated[float, Range(0.0, 10.0)] | None = None
    push: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        choose_options(self.closing, self.options)
        check_modes(self.sensor, self.closing, self.pressing)
        check_limit(self.max_force, self.closing, self.pressing)
        if self.max_force is not None and self.force is not None and self.force > self.max_force:
            raise BadArgument("force", self.force, f"at most max_force, {self.max_force:g}")
        check_within("mass", self.mass, MASSES)
        check_within("friction", self.friction, FRICTIONS)
        least = Distribution.of(self.friction).least
        if self.table_friction is not None and self.table_friction > least:
            raise BadArgument("table_friction", self.table_friction, f"at most friction, {least:g}")
        if not all(abs(x) <= 1000.0 for x in self.push):
            raise BadArgument("push", self.push, "at most 1000 N along each axis")
        if not self.control_rate * self.timestep < 1 + ROUNDING:
            found = f"{self.control_rate:g} Hz with a timestep of {self.timestep:g} s"
            raise BadArgument("control_rate", found, "a period of at least one timestep")
        steps = 1 / (self.control_rate * self.timestep)
        whole = max(1, round(steps))
        if abs(steps / whole - 1) > UNEVEN:
            found = f"{self.control_rate:g} Hz with a timestep of {self.timestep:g} s"
            slower = 1 / ((whole + 1) * self.timestep)
            near = f"{1 / (whole * self.timestep):g} or {slower:g} Hz"
            raise BadArgument(
                "control_rate", found, f"a period of whole timesteps, such as at {near}"
            )

    @property
    def pressing(self) -> HoldingMode:
        """The holding mode of the trial, such as "grip": how the closed hand presses.

        This is the field `holding`, if that is not None. Otherwise it is "grip", or "force" in
        three cases: `force` is given, `closing` is neither "uncertainty" nor "fixed", or a
        fingertip has no working tactile sensor. After the closing "open_loop" the mode is not used:
        the squeeze is kept.
        """
        default = default_holding(self.sensor, self.closing) if self.force is None else "force"
        return self.holding or default

    @property
    def strongest(self) -> float:
        """The normal force [N] of the strongest finger in the closing, and in the holding mode
        "force".

        This is the field `force`. If that is None, it is 4 N, but at most `max_force`.
        """
        return min(4.0, self.max_force or 4.0) if self.force is None else self.force

    @property
    def components(self) -> ClosingOptions:
        """The `ClosingOptions` with which the hand closes, such as the number of attempts.

        For the closing "uncertainty" or "fixed" they are the field `options`, or `ClosingOptions()`
        if that is None. Other closings have no options: for them all options are off.

        >>> TrialSpec(closing="paper").components.wait
        False
        """
        return choose_options(self.closing, self.options)


def default_holding(sensor: SensorModel, closing: ClosingMode) -> HoldingMode:
    """Return the default holding mode, "grip" or "force", for the sensors and a closing mode.

    It is "grip" if the `sensor` is tactile at all fingers and none is dead. The closing must also
    be "uncertainty" or "fixed". In all other cases it is "force".
    """
    return "grip" if sensor.full and closing in ("fixed", "uncertainty") else "force"


def check_modes(sensor: SensorModel, closing: str, holding: str) -> None:
    """Raise `BadArgument` if a closing and a holding mode do not combine, or need more than the
    sensor measures.

    The modes are those of `TrialSpec`. The holding "law" needs the closing "uncertainty", "fixed"
    or "paper". After the closing "open_loop" neither "grip" nor "impedance" is possible.

    Some modes need a tactile sensor at all fingers, with none dead. They are the closings
    "position", "paper_position" and "paper", and the holdings "grip", "impedance" and "law".
    """
    if holding == "law" and closing not in ("fixed", "uncertainty", "paper"):
        raise BadArgument(
            "holding", f"'law' after {closing!r}", "another holding, or a closing under Eq. (25)"
        )
    if closing == "open_loop" and holding in ("grip", "impedance"):
        found = f"{holding!r} after 'open_loop', which keeps its squeeze"
        raise BadArgument("holding", found, "None, or another closing")
    poor = f"one of kind {sensor.kind!r}" + (
        f" with {', '.join(sensor.dead)} dead" if sensor.dead else ""
    )
    allowed = "kind 'tactile' with no finger dead for {}"
    if not sensor.full and closing in ("position", "paper_position", "paper"):
        raise BadArgument("sensor", poor, allowed.format(f"closing {closing!r}"))
    if not sensor.full and closing != "open_loop" and holding not in ("force", "position"):
        raise BadArgument("sensor", poor, allowed.format(f"holding {holding!r}"))


def check_limit(max_force: float | None, closing: str, holding: str) -> None:
    """Raise `BadArgument` if `max_force` [N] is given, but the modes `closing` and `holding` do not
    keep the fingertip forces below it.

    The holding "impedance" does not, because its springs add to the forces. Nor does the holding
    "position" after the closing "position" or "paper_position": it commands positions alone. A
    `max_force` of None is always accepted, and so is any after the closing "open_loop".
    """
    if max_force is None or closing == "open_loop":
        return
    blind = holding == "position" and closing in ("position", "paper_position")
    if blind or holding == "impedance":
        found = f"{max_force:g} N with closing {closing!r} and holding {holding!r}"
        raise BadArgument("max_force", found, "None, or holding 'grip' or 'force'")
