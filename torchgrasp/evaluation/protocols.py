"""Settings of the trials that test grasps: lifts, and published pulls at the object.

Pulls are without table and gravity.
"""

import dataclasses
import hashlib
import json
import math
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Count, Displacement, Pose, Range, Seed
from torchgrasp.geometry.frames import inverse, real, rigid, rotation_from_vector, turned_about
from torchgrasp.geometry.linalg import unit
from torchgrasp.success.task import GraspTask
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec

LEAST_MASS = 1e-3  # least mass [kg] of a task, so that no load is zero


TURNS = Range(0.0, math.pi / 4, "an angle in [0, pi / 4] rad, not in degrees")
"""The greatest errors [rad] of a rotation that are taken. One degree, given as 1, is refused."""
PULL_INTERVAL = 0.2  # interval [s] at which the motion of a pulled object is checked
MOST_PULL = 60.0  # longest pull [s]


@checked
@dataclasses.dataclass(frozen=True)
class PoseNoise(Value):
    """The bounds of random pose errors in the trials of a `Protocol`, drawn uniformly.

    In pulls, the true pose of the hand differs from the planned one. The error is in the frame of
    the hand's root link at the planned pose. In lifts, the object is moved along the table and
    turned about the vertical.

    Args:
        translation: greatest error [m] along each axis, 0 to 0.5.
        rotation: greatest error [rad] about each axis, 0 to pi / 4; in lifts about the vertical
            only. A greater one is most often in degrees.
        draws: number of trials that `evaluate` runs for each grasp, each with its own error, at
            least 1.

    Raises `BadArgument` for a number outside its range.
    """

    translation: Displacement = 0.0
    rotation: Annotated[float, TURNS] = 0.0
    draws: Count = 1


@checked
@dataclasses.dataclass(frozen=True)
class PullSpec(Value):
    """The settings of pulls at a grasped object, and the motion at which a pull fails.

    Args:
        acceleration: force of each pull, divided by the object's mass [m/s^2], 0 to 1000.
        seconds: duration [s] of each pull, a multiple of 0.2 s from 0.2 to 60. The motion is
            checked every 0.2 s.
        distance: motion [m] of the object's centre of mass at which a pull fails, 0 to 0.5. It
            counts from the start of the trial, so it includes the closing.
        angle: rotation [rad] of the object, counted likewise, at which a pull fails: 0 to pi, or
            infinity for any rotation.

    Raises `BadArgument` for a number outside its range, or another duration.
    """

    acceleration: Annotated[float, Range(0.0, 1000.0)]
    seconds: Annotated[float, Range(PULL_INTERVAL, MOST_PULL)]
    distance: Displacement
    angle: Annotated[float, Range(0.0, math.inf)]

    def __post_init__(self) -> None:
        """Raise `BadArgument` for an angle that no rotation reaches, as one in degrees. Raise it
        also for a duration that is no multiple of the interval of the checks.
        """
        if math.pi < self.angle < math.inf:
            raise BadArgument("angle", self.angle, "radians in [0, pi], or infinity for no bound")
        if not math.isclose(self.seconds, self.checks * PULL_INTERVAL):
            raise BadArgument("seconds", self.seconds, f"a multiple of {PULL_INTERVAL:g} s")

    @property
    def checks(self) -> int:
        """The number of times that the object's motion is checked in a pull."""
        return round(self.seconds / PULL_INTERVAL)


@checked
@dataclasses.dataclass(frozen=True)
class Protocol(Value):
    """The settings of the simulated trials that test a grasp: pulls at a floating object, or a lift
    off a table.

    `PROTOCOLS` holds ready protocols by name, such as "tabletop" and "dexgraspbench".

    Args:
        name: the protocol's name.
        trial: parameters of the simulated trials.
        pull: the pulls; None means a lift.
        noise: bounds of random errors: of the hand's pose in pulls, of the object's pose in lifts.
        criterion: when a lift passes. "held": as `close_hand` defines it. "risen": at the end, the
            object's centre is higher by at least half of the lift's height.
        displaced: when `noise` displaces the object of a lift: "before" the approach, or halfway
            through the "approach".
        push: size [N] of a force in a random direction at the lifted object; 0 means no push.
        relook: whether the camera looks at the object of a lift once more, from the same place,
            before the approach.
        tries: largest number of grasps of a view to try, one after the other, in one lift
            (`lift_grasps`).
        real_mass: whether `evaluate` gives an object its `mass_kg` of the manifest. An object
            without one has the mass of `trial`. The planner is told the mass of `trial` alone.

    Raises `BadArgument` for:

    * a `noise.rotation` with an object displaced during the approach;
    * `pull` with a setting of lifts: `criterion`, `displaced`, `push`, `relook` or `tries`.
    """

    name: str
    trial: TrialSpec
    pull: PullSpec | None = None
    noise: PoseNoise = dataclasses.field(default_factory=PoseNoise)
    criterion: Literal["held", "risen"] = "held"
    displaced: Literal["before", "approach"] = "before"
    push: Annotated[float, Range(0.0, 1000.0)] = 0.0
    relook: bool = False
    tries: Count = 1
    real_mass: bool = False

    def __post_init__(self) -> None:
        """Raise `BadArgument` if fields contradict each other."""
        if self.displaced == "approach" and self.noise.rotation:
            allowed = "0 for an object displaced during the approach"
            raise BadArgument("noise.rotation", self.noise.rotation, allowed)
        lifts = self.criterion, self.displaced, self.push, self.relook, self.tries
        if self.pull is not None and lifts != ("held", "before", 0.0, False, 1):
            found = "a pull with a criterion, displacement, push, second look or tries of a lift"
            raise BadArgument("pull", found, "None")

    @property
    def task(self) -> GraspTask:
        """What a grasp must do in the protocol's trials: a lift, or pulls.

        It is the argument `task` of `plan_grasps`, which predicts the success in this task.

        >>> find_protocol("dexgraspbench").task.describe()
        'pulls of 0.1 kg with 7 N'
        """
        trial = self.trial
        lift = self.pull is None
        mass = trial.mass
        if self.pull is not None:
            pull = self.pull.acceleration
            mass = mass.times(pull / 10.0) if isinstance(mass, Distribution) else mass * pull / 10.0
        mass = Distribution.of(mass).clamped(LEAST_MASS, math.inf)
        closing = "open_loop" if trial.closing == "open_loop" and not lift else "uncertainty"
        displaced = self.noise.translation + self.noise.rotation > 0
        return GraspTask(mass.simplest, trial.force, lift, closing, displaced)

    @checked
    def with_trial(self, **changes: Any) -> "Protocol":
        """Return the protocol with some fields of its `trial` changed.

        `changes` are new values of fields of `TrialSpec`, by name. A `mass` replaces the `density`
        of the trial, and the masses of the manifest. Raises `BadArgument` for a wrong
        value, and `TypeError` for an unknown field.

        >>> find_protocol("tabletop").with_trial(closing="fixed").trial.closing
        'fixed'
        """
        real = self.real_mass and "mass" not in changes
        if "mass" in changes:
            changes = {"density": None, **changes}
        trial = dataclasses.replace(self.trial, **changes)
        return dataclasses.replace(self, trial=trial, real_mass=real)


_FLOATING = TrialSpec(
    closing="open_loop",
    force=7.0,
    mass=0.1,
    friction=0.6,
    patch=0.02 / 0.6,
    kp=5.0,
    overlap=0.01,
    gravity=0.0,
    table=False,
    approach=0.0,
    lift_height=0.0,
)
"""DexGraspBench's trial. PhysX resists torsion by friction x force x patch: torsional over sliding
friction [m].
"""
_PULL = PullSpec(10.0, 2.0, 0.05, math.radians(15))  # DexGraspBench's
POSE_NOISE = PoseNoise(0.005, math.radians(5))  # as large as in Get a Grip (CoRL 2024)
PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            "multidex",
            dataclasses.replace(_FLOATING, density=500.0, friction=3.0, patch=0.0, kp=None),
            PullSpec(0.5, 1.0, 0.02, math.inf),
        ),
        Protocol("dexgraspbench", _FLOATING, _PULL),
        Protocol(
            "dexgraspbench-hard",
            dataclasses.replace(_FLOATING, friction=0.3, patch=0.002 / 0.3),
            _PULL,
        ),
        Protocol("pose-noise", _FLOATING, _PULL, dataclasses.replace(POSE_NOISE, draws=20)),
        Protocol("paper", TrialSpec(), noise=POSE_NOISE),
        Protocol("tabletop", TrialSpec(friction=0.6, shake=0.003)),
        Protocol("household", TrialSpec(shake=0.003), real_mass=True),
        Protocol(
            "table-lift",
            TrialSpec(mass=0.249, table_friction=0.2, lift_height=0.2, approach=0.16),
            criterion="risen",
            tries=3,
        ),
    )
}
"""The protocols by name.

* multidex: six pulls at a floating object, as in the test of MultiDex that D(R,O) runs (arXiv
  2410.01702).
* dexgraspbench: six pulls at a floating object, as in DexGraspBench (BODex, arXiv 2412.16490).
* dexgraspbench-hard: dexgraspbench with halved friction, as in Dexonomy (arXiv 2504.18829).
* pose-noise: dexgraspbench with 20 random errors of the hand's pose for each grasp.
* paper: the paper's lift (Sec. 6.5) at friction 0.8; the object's pose errs at random, as on a real
  robot.
* tabletop: a lift by 0.1 m at friction 0.6, held for 2 s while the hand shakes.
* household: the same at friction 0.8, with the masses of the manifest (`mass_kg`).
* table-lift: a lift by 0.2 m of 0.249 kg, as published for single-view policies. The friction is
  0.8 at the fingertips and 0.2 at the table. One of three grasps must have raised the object by 0.1
  m at the end. To displace or push the object, set `noise` or `push` by `dataclasses.replace`.
"""


@checked
def find_protocol(protocol: Protocol | str) -> Protocol:
    """Return the protocol of `PROTOCOLS` with a given name; a `Protocol` is returned as it is.

    Raises `BadArgument` for an unknown name.

    >>> find_protocol("tabletop").trial.friction
    0.6
    """
    if isinstance(protocol, Protocol):
        return protocol
    if protocol not in PROTOCOLS:
        raise BadArgument("protocol", repr(protocol), f"one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[protocol]


@checked
def apply_error(obj_from_hand: Pose, error: Pose | None) -> Float[Tensor, "4 4"]:
    """Return the true pose (4, 4) [m] of a hand in simulation, given its planned pose and its pose
    error. It is on the CPU in float64.

    The planned pose `obj_from_hand` [m] and the result are in the same frame. The `error` is the
    pose of the true hand in the frame of the planned hand; None means no error.
    """
    planned = obj_from_hand.to("cpu", torch.float64)
    if error is None:
        return planned
    return planned @ check_tensor("error", error, (4, 4)).to("cpu", torch.float64)


@checked
def seed_of(seed: Seed, *names: str | int) -> int:
    """Return the random seed for one purpose: a hash of an evaluation's `seed` and the purpose's
    `names`.

    The names are, for example, those of object and view, and the grasp's rank. Draws with different
    names are independent of each other, and of the order of the draws.
    """
    digest = hashlib.sha256(json.dumps([seed, *names]).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


@checked
def draw_trial(trial: TrialSpec, seed: Seed) -> TrialSpec:
    """Return the parameters of a trial, in which friction and mass are single numbers. A
    `Distribution` of one of them is replaced by a random draw.

    The two draws are independent, and depend only on `seed`, that of the trial.
    """
    friction = Distribution.of(trial.friction).sample(1, seed_of(seed, "friction"))
    mass = Distribution.of(trial.mass).sample(1, seed_of(seed, "mass"))
    return dataclasses.replace(trial, friction=float(friction), mass=float(mass))


@checked
def draw_hand_errors(noise: PoseNoise, count: Count, seed: Seed) -> Float[Tensor, "n 4 4"]:
    """Return n = `count` random pose errors (n, 4, 4) [m] of the hand. Each is the pose of the true
    hand in the frame of the planned hand.

    `noise` bounds the translation along each axis and the rotation about it. Both are drawn
    uniformly.
    """
    generator = torch.Generator().manual_seed(seed)
    largest = torch.tensor([noise.rotation] * 3 + [noise.translation] * 3, dtype=torch.float64)
    drawn = 2 * torch.rand(count, 6, generator=generator, dtype=torch.float64) - 1
    rotations, translations = (largest * drawn).split(3, -1)
    return rigid(rotation_from_vector(rotations), translations)


@checked
def draw_object_poses(
    noise: PoseNoise, pivot: Float[Tensor, "3"], count: Count, seed: Seed
) -> Float[Tensor, "n 4 4"]:
    """Return n = `count` random displacements (n, 4, 4) [m] of an object on its table, as rigid
    transforms.

    The z axis of their frame is the table's normal. Each displacement shifts the object along x and
    y, and turns it about the vertical through the point `pivot` (3,) [m]. `noise` bounds the shift
    along each axis and the angle.
    """
    pivot = pivot.to("cpu", torch.float64)
    generator = torch.Generator().manual_seed(seed)
    drawn = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    up = real([0.0, 0.0, 1.0])
    rotation = rotation_from_vector(noise.rotation * drawn[:, :1] * up)
    shift = noise.translation * drawn[:, [1, 2, 2]] * (1 - up)
    return turned_about(rotation, pivot, shift)


def error_from_object_pose(obj_from_hand: Pose, object_pose: Pose) -> Float[Tensor, "4 4"]:
    """Return the pose error (4, 4) [m] of the hand that is equivalent to a displacement of the
    object: hand and object are then in the same relative pose.

    `object_pose` is the displacement and `obj_from_hand` the planned pose, both rigid transforms
    [m] in the frame of the grasp. The error is in the frame of the planned hand.
    """
    return inverse(obj_from_hand) @ inverse(object_pose) @ obj_from_hand


@checked
def draw_error(
    protocol: Protocol, grasp: Grasps, mesh: "trimesh.Trimesh", seed: Seed
) -> Float[Tensor, "4 4"]:
    """Return the random pose error (4, 4) [m] of the hand for one trial of a grasp.

    The frame is that of the hand's root link at the planned pose. In a protocol that lifts, the
    error is equivalent to a displacement of the object with the true `mesh` [m]. `seed` is that of
    the trial (`seed_of`).
    """
    if protocol.pull is not None:
        return draw_hand_errors(protocol.noise, 1, seed)[0]
    pivot = real(mesh.center_mass.tolist())
    pose = draw_object_poses(protocol.noise, pivot, 1, seed)[0]
    return error_from_object_pose(grasp.obj_from_hand[0].to(pose), pose)


@checked
def draw_slide(noise: PoseNoise, seed: Seed) -> Float[Tensor, "3"]:
    """Return a random displacement (x, y, 0) [m] of an object along its table.

    The table's normal is z. The displacement is at most `noise.translation` along x and y.
    """
    level = dataclasses.replace(noise, rotation=0.0)
    return draw_object_poses(level, torch.zeros(3, dtype=torch.float32), 1, seed)[0, :3, 3]


@checked
def draw_push(
    force: Annotated[float, Range(0.0, 1000.0)], seed: Seed
) -> tuple[float, float, float]:
    """Return a force vector (x, y, z) [N] of the norm `force` [N] in a random direction.

    All directions are equally likely, so the vector may be taken in any frame.
    """
    generator = torch.Generator().manual_seed(seed)
    x, y, z = (force * unit(torch.randn(3, generator=generator, dtype=torch.float64))).tolist()
    return x, y, z
