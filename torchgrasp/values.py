"""All value types of the data flow, in its order: the map of the library.

Values are frozen dataclasses of tensors. They are complete when they exist, they never change, and `.to()`
returns a new one. Lengths are metres and positions are in the cloud's frame ("obj") unless said otherwise;
`a_from_b` maps coordinates of frame b into frame a.

Letters in shapes: n points, b batch rows, g grasps, e friction-cone edges, h actuated joints, t time steps.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.errors import BadArgument, FailedRows, Status, TooFewPoints

SomeValue = TypeVar("SomeValue", bound="Value")
SomeBatch = TypeVar("SomeBatch", bound="Batch")


class Value:
    """Base of all values: `.to()` maps every tensor inside, nested values included, into a new value."""

    def to(self: SomeValue, *args: Any, **kwargs: Any) -> SomeValue:
        """Return the value on another device or in another floating dtype; integers keep theirs."""

        def move(x: Any) -> Any:
            if isinstance(x, Value):
                return x.to(*args, **kwargs)
            if isinstance(x, Tensor):
                moved = x.to(*args, **kwargs)
                return moved if x.is_floating_point() else moved.to(x.dtype)
            return x

        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        return type(self)(**{f.name: move(getattr(self, f.name)) for f in fields})


class Batch(Value):
    """A value whose tensors share a leading batch axis: indexing selects rows, `len` counts them."""

    def __len__(self) -> int:
        """Count the rows."""
        return len(getattr(self, dataclasses.fields(self)[0].name))  # pyright: ignore[reportArgumentType]

    def __getitem__(self: SomeBatch, rows: Any) -> SomeBatch:
        """Select rows by a slice, a mask or an index tensor; an integer keeps the batch axis."""
        if isinstance(rows, int):
            rows = range(len(self))[rows]  # raises IndexError as a list would
            rows = slice(rows, rows + 1)

        def pick(x: Any) -> Any:
            return x[rows] if isinstance(x, (Tensor, Batch)) else x

        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        return type(self)(**{f.name: pick(getattr(self, f.name)) for f in fields})

    def __iter__(self: SomeBatch) -> Iterator[SomeBatch]:
        """Iterate over the rows, each a batch of one."""
        return (self[i] for i in range(len(self)))

    def raise_for_status(self: SomeBatch) -> SomeBatch:
        """Return the value itself when every row is `Status.OK`; raise `FailedRows` with counts otherwise."""
        counts = count_status(getattr(self, "status"))  # noqa: B009
        failed = {s: k for s, k in counts.items() if s is not Status.OK}
        if failed:
            raise FailedRows("; ".join(f"{k} of {len(self)} rows: {s.sentence}" for s, k in failed.items()))
        return self


def count_status(status: Int[Tensor, "*b"]) -> dict[Status, int]:
    """Count the rows of each status, the most frequent first.

    >>> count_status(torch.tensor([0, 13, 0]))
    {<Status.OK: 0>: 2, <Status.NOT_CLOSED: 13>: 1}
    """
    codes, counts = torch.unique(status, return_counts=True)
    pairs = sorted(zip(codes.tolist(), counts.tolist(), strict=True), key=lambda p: (-p[1], p[0]))
    return {Status(code): count for code, count in pairs}


def check_tensor(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Return `value` if it is a finite floating tensor of `shape` (None: any length); raise `BadArgument` otherwise."""
    wanted = "x".join("any" if s is None else str(s) for s in shape)
    if not isinstance(value, Tensor):
        raise BadArgument(name, type(value).__name__, f"a torch tensor of shape {wanted}")
    if value.ndim != len(shape) or any(s is not None and s != v for s, v in zip(shape, value.shape, strict=True)):
        raise BadArgument(name, f"shape {tuple(value.shape)}", f"shape {wanted}")
    if value.dtype not in (torch.float32, torch.float64):
        raise BadArgument(name, str(value.dtype), "torch.float32 or torch.float64")
    finite = torch.isfinite(value)
    if not bool(finite.all()):
        first = torch.nonzero(~finite)[0].tolist()
        raise BadArgument(name, f"{value[tuple(first)].item()} at index {first}", "finite numbers")
    return value


# ---------------------------------------------------------------------------------------------- what was seen


@dataclasses.dataclass(frozen=True)
class PointCloud(Value):
    """A point cloud of one object, as a camera saw it.

    Args:
        points: surface points [m], at least 4 of them.
        normals: outward normals, or None. Non-unit normals are normalised by the functions that use them.
        viewpoint: the camera's position [m] in the cloud's frame, or None when it is not known.

    Raises:
        BadArgument: wrong shape, dtype or non-finite numbers.
        TooFewPoints: fewer than 4 points.

    >>> len(PointCloud(torch.rand(100, 3)))
    100
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None = None
    viewpoint: Float[Tensor, "3"] | None = None

    def __post_init__(self) -> None:
        """Check shapes and numbers once, where the value is made."""
        check_tensor("points", self.points, (None, 3))
        if len(self.points) < 4:
            raise TooFewPoints("points", f"{len(self.points)} points", "at least 4 points")
        if self.normals is not None:
            check_tensor("normals", self.normals, (len(self.points), 3))
        if self.viewpoint is not None:
            check_tensor("viewpoint", self.viewpoint, (3,))

    def __len__(self) -> int:
        """Count the points."""
        return len(self.points)


@dataclasses.dataclass(frozen=True)
class ShapeEstimate(Value):
    """The posterior of the shape at query points (Eqs. 7-8).

    `distance`, `variance` and `covariance` are in the paper's normalised units (the cloud centred and divided by
    `shape.scale` metres), so that `max_variance=0.03` means what the paper means. `normal` is the unit gradient of
    the mean. `std_m` is the calibrated standard deviation of the surface position [m].
    """

    distance: Float[Tensor, "*b"]
    normal: Float[Tensor, "*b 3"]
    variance: Float[Tensor, "*b"]
    covariance: Float[Tensor, "*b 4 4"]
    std_m: Float[Tensor, "*b"]


# --------------------------------------------------------------------------------------------- where to touch


@dataclasses.dataclass(frozen=True)
class ContactSpec(Value):
    """What a set of three contacts must satisfy (Eqs. 10-14). `ContactSpec.paper()` is the paper's own.

    The margins beyond the paper each have a measured reason: a certificate on the estimated surface is lost on the
    true one unless the contacts are planned with less friction than is there, on flat surface, a fingertip apart.

    Args:
        friction: coefficient of friction between fingertip and object, as it will be executed.
        edges: edges of the linearised friction cone, at least 3.
        max_variance: S_thresh of Eq. (12), a variance in normalised units.
        friction_margin: contacts are planned and certified with `friction * friction_margin`.
        separation: least distance between two contacts [m]; fingertips are 24 mm wide.
        flatness: largest angle [rad] between the normals of the surface within 8 mm of a contact; None: not checked.
        table: height [m] of the table's plane, whose normal is the z axis of the cloud's frame; None: no table.
        contact_height: least height of a contact above the table [m].
        start_radius: radius of the sphere from which starts are drawn, in normalised units (Sec. 6.2; the paper: 0.1).

    Raises:
        BadArgument: a number outside its range.

    >>> ContactSpec(friction=0.8).planned_friction
    0.4
    """

    friction: float = 0.8
    edges: int = 8
    max_variance: float = 0.03
    friction_margin: float = 0.5
    separation: float = 0.026
    flatness: float | None = 0.44
    table: float | None = None
    contact_height: float = 0.012
    start_radius: float = 0.9

    def __post_init__(self) -> None:
        """Check every range once, where the value is made."""
        ranges: list[tuple[str, float, float, float]] = [
            ("friction", self.friction, 0.0, 10.0),
            ("edges", self.edges, 3, 1024),
            ("max_variance", self.max_variance, 1e-12, 1e6),
            ("friction_margin", self.friction_margin, 1e-3, 1.0),
            ("separation", self.separation, 0.0, 1.0),
            ("flatness", 0.1 if self.flatness is None else self.flatness, 1e-3, 3.1416),
            ("table", 0.0 if self.table is None else self.table, -1e6, 1e6),
            ("contact_height", self.contact_height, -1.0, 1.0),
            ("start_radius", self.start_radius, 1e-6, 1.2),
        ]
        for name, value, low, high in ranges:
            if not low <= value <= high:  # also refuses NaN
                raise BadArgument(name, value, f"a number in [{low:g}, {high:g}]")

    @property
    def planned_friction(self) -> float:
        """The friction with which contacts are planned and certified."""
        return self.friction * self.friction_margin

    @classmethod
    def paper(cls, friction: float = 0.8, edges: int = 8, max_variance: float = 0.03) -> "ContactSpec":
        """Return the paper's own problem: full friction, no separation, flatness or table."""
        return cls(friction, edges, max_variance, friction_margin=1.0, separation=0.0, flatness=None, start_radius=0.1)


@dataclasses.dataclass(frozen=True)
class Contacts(Batch):
    """Three contacts a row: `points` [m], outward unit `normals`, `variance` (Eq. 12) and `std_m` [m] of the shape."""

    points: Float[Tensor, "b 3 3"]
    normals: Float[Tensor, "b 3 3"]
    variance: Float[Tensor, "b 3"]
    std_m: Float[Tensor, "b 3"]


@dataclasses.dataclass(frozen=True)
class ContactPlan(Batch):
    """The planner's rows, one for each start, in the order of the starts.

    `coefficients` are the planner's own phi of Eq. (13); `quality` is Eq. (14) [m]: the distance of the contacts'
    centre from the centre of the cloud.
    """

    contacts: Contacts
    coefficients: Float[Tensor, "b 3 e"]
    quality: Float[Tensor, "b"]
    status: Int[Tensor, "b"]


@dataclasses.dataclass(frozen=True)
class Certificate(Batch):
    """Frictional form closure (Eq. 13), proven by an independent linear programme and a rank test.

    `margin` is the largest s with W phi = 0, sum phi = 1, phi >= s; `rank_ratio` the smallest over the largest
    singular value of W with torques divided by the contacts' radius; `residual` the largest |W phi|. `closed` needs
    margin > 0 and full rank: Eq. (13) alone holds for coincident and for collinear contacts.
    """

    margin: Float[Tensor, "b"]
    rank_ratio: Float[Tensor, "b"]
    residual: Float[Tensor, "b"]
    closed: Bool[Tensor, "b"]


# ------------------------------------------------------------------------------------- how this hand can touch


@dataclasses.dataclass(frozen=True)
class ContactCode(Batch):
    """The frame-invariant code q = (L, N) of Eq. (18) for each of the six assignments of contacts to fingers.

    Finger i touches contact `permutation[k, i]` in assignment k. Degenerate rows hold NaN and say so in `status`.
    """

    q: Float[Tensor, "b 6 6"]
    obj_from_vf: Float[Tensor, "b 6 4 4"]
    status: Int[Tensor, "b"]
    permutation: tuple[tuple[int, int, int], ...]


@dataclasses.dataclass(frozen=True)
class GraspGuess(Batch):
    """Postures from the learned model, aligned with the contacts by their virtual frames (Eqs. 23-24).

    `row` names the row of the contact plan and `permutation` the contact of each finger; `reach` is the least f_i of
    Eq. (21); `tip_error` [m] is the distance of each fingertip from its contact before refinement.
    """

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]
    row: Int[Tensor, "g"]
    permutation: Int[Tensor, "g 3"]
    reach: Float[Tensor, "g"]
    tip_error: Float[Tensor, "g 3"]


@dataclasses.dataclass(frozen=True)
class Grasps(Batch):
    """Hand configurations that realise planned contacts, best first.

    Contact i is touched by finger i of the hand. `clearance` [m] is the least distance of the hand's links from the
    estimated surface (fingertips apart), from each other and from the table; `normal_angle` [rad] the angle between
    the contact direction and the pad's axis; `pregrasp` the joints of the opened hand at the same pose. `score`
    ranks. `meta` holds names, units, hashes and the seed, as they are written to the file.
    """

    joints: Float[Tensor, "g h"]
    pregrasp: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]
    contacts: Contacts
    permutation: Int[Tensor, "g 3"]
    tip_error: Float[Tensor, "g 3"]
    clearance: Float[Tensor, "g"]
    normal_angle: Float[Tensor, "g 3"]
    certificate: Certificate
    score: Float[Tensor, "g"]
    status: Int[Tensor, "g"]
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])

    def save(self, path: Any) -> None:
        """Write the grasps as safetensors, atomically; `load_grasps` reads them back.

        Raises:
            OutputError: the file cannot be written; nothing half-written stays.
        """
        from torchgrasp.files import save_grasps

        save_grasps(self, path)


# -------------------------------------------------------------------------------------------------- closing on it


@dataclasses.dataclass(frozen=True)
class ClosingGains(Value):
    """Gains of the closing controller for each finger, in the hand's frame (Eqs. 26-28)."""

    target: Float[Tensor, "3 3"]
    covariance: Float[Tensor, "3 3 3"]
    position_gain: Float[Tensor, "3 3"]
    force_gain: Float[Tensor, "3 3"]
    desired_force: Float[Tensor, "3 3"]


@dataclasses.dataclass(frozen=True)
class TrialSpec(Value):
    """One simulated trial: close on the true mesh, lift it off the table, hold it.

    Args:
        controller: "uncertainty" (Eqs. 25-28) or "position" (isotropic PI that stops at 0.5 N, the paper's baseline).
        mass: of the object [kg].
        friction: of every contact.
        gravity: [m/s^2].
        lift_height: [m].
        hold_time: [s] after the lift.
        force: desired normal force of the strongest finger [N].
        noise: whether the tactile sensor has the paper's noise (0.1 N normal, 0.3 N tangential).
        timestep: of the simulator [s].
        control_rate: of the controller [Hz].

    Raises:
        BadArgument: a number outside its range or an unknown controller.
    """

    controller: Literal["uncertainty", "position"] = "uncertainty"
    mass: float = 0.1
    friction: float = 0.8
    gravity: float = 9.81
    lift_height: float = 0.1
    hold_time: float = 2.0
    force: float = 4.0
    noise: bool = True
    timestep: float = 1 / 500
    control_rate: float = 100.0

    def __post_init__(self) -> None:
        """Check every range once, where the value is made."""
        if self.controller not in ("uncertainty", "position"):
            raise BadArgument("controller", repr(self.controller), "'uncertainty' or 'position'")
        ranges = {
            "mass": (1e-3, 10.0),
            "friction": (0.0, 10.0),
            "gravity": (0.0, 100.0),
            "lift_height": (0.0, 1.0),
            "hold_time": (0.0, 60.0),
            "force": (0.01, 100.0),
            "timestep": (1e-4, 1 / 60),
            "control_rate": (10.0, 1000.0),
        }
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise BadArgument(name, getattr(self, name), f"a number in [{low:g}, {high:g}]")


@dataclasses.dataclass(frozen=True)
class ClosureResult(Value):
    """What happened when the hand closed on the true object.

    `time` [s] is the control ticks; `forces` [N] the normal force of each fingertip; `object_pose` and `hand_pose`
    the object's and the hand's frames in the world at each tick; `joints` every joint of the URDF in the order of
    `joint_names`. `contact_order` lists the fingers in the order of their first touch, those that never touched left
    out. `object_motion` is how far the object moved [m] and turned [rad] against the hand between the start and the
    end. `held` is true when the object is still up with the hand at the end; `seconds` is the wall time.
    """

    held: bool
    status: Status
    time: Float[Tensor, "t"]
    forces: Float[Tensor, "t 3"]
    object_pose: Float[Tensor, "t 4 4"]
    hand_pose: Float[Tensor, "t 4 4"]
    joints: Float[Tensor, "t j"]
    joint_names: tuple[str, ...]
    contact_order: tuple[int, ...]
    object_motion: tuple[float, float]
    seconds: float
