"""All value types of the data flow, in its order: the map of the library. What a user asks for is in `specs`.

Values are frozen dataclasses of tensors. They are complete when they exist, they never change, and `.to()`
returns a new one. Lengths are metres and positions are in the cloud's frame ("obj") unless said otherwise;
`a_from_b` maps coordinates of frame b into frame a.

Letters in shapes: n points, b batch rows, g grasps, e friction-cone edges, h actuated joints, t time steps.
"""

import dataclasses
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch, Value, check_tensor
from torchgrasp.errors import ModelFileError, Status, TooFewPoints
from torchgrasp.files import load_tensors, save_tensors

# ---------------------------------------------------------------------------------------------- what was seen


@dataclasses.dataclass(frozen=True)
class PointCloud(Value):
    """A point cloud of one object, as a camera saw it.

    Args:
        points: surface points [m], at least 4 of them.
        normals: outward normals, or None. Non-unit normals are normalised by the functions that use them.
        viewpoint: the camera's position [m] in the cloud's frame, of shape (3,), or of shape (n, 3) that of the camera
            which saw each point, for several views in one cloud; None when it is not known.

    Raises:
        BadArgument: wrong shape, dtype or non-finite numbers.
        TooFewPoints: fewer than 4 points.

    >>> import torch
    >>> len(PointCloud(torch.rand(100, 3)))
    100
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None = None
    viewpoint: Float[Tensor, "3"] | Float[Tensor, "n 3"] | None = None

    def __post_init__(self) -> None:
        """Check shapes and numbers once, where the value is made."""
        check_tensor("points", self.points, (None, 3))
        if len(self.points) < 4:
            raise TooFewPoints("points", f"{len(self.points)} points", "at least 4 points")
        if self.normals is not None:
            check_tensor("normals", self.normals, (len(self.points), 3))
        if self.viewpoint is not None:
            each = isinstance(self.viewpoint, Tensor) and self.viewpoint.ndim == 2
            check_tensor("viewpoint", self.viewpoint, (len(self.points), 3) if each else (3,))

    def __len__(self) -> int:
        """Count the points."""
        return len(self.points)

    def select(self, rows: Int[Tensor, "m"] | Bool[Tensor, "n"]) -> "PointCloud":
        """Return some of the points, with what is known of them.

        Args:
            rows: a mask, or indices in the order wanted.
        """
        normals, eye = self.normals, self.viewpoint
        return PointCloud(
            points=self.points[rows],
            normals=None if normals is None else normals[rows],
            viewpoint=eye if eye is None or eye.ndim == 1 else eye[rows],
        )

    def split_views(self) -> "list[PointCloud]":
        """Return the part that each camera saw, with its viewpoint (3,), in the order of their first points."""
        if self.viewpoint is None or self.viewpoint.ndim == 1:
            return [self]
        _, view = self.viewpoint.unique(dim=0, return_inverse=True)
        parts = [self.select(view == k) for k in dict.fromkeys(view.tolist())]
        return [PointCloud(p.points, p.normals, p.viewpoint[0]) for p in parts if p.viewpoint is not None]


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
    centre from the centre of the cloud, or the cost that was asked for; less is better.
    """

    contacts: Contacts
    coefficients: Float[Tensor, "b 3 e"]
    quality: Float[Tensor, "b"]
    status: Int[Tensor, "b"]


@dataclasses.dataclass(frozen=True)
class Certificate(Batch):
    """Frictional form closure (Eq. 13) or its absence, with what proves either; see `certify`.

    `margin` is the largest s with W phi = 0, sum phi = 1, phi >= s; `rank_ratio` the smallest over the largest
    singular value of W with torques divided by the contacts' radius; `residual` the largest |W phi|. `closed` needs
    margin > 0 and full rank: Eq. (13) alone holds for coincident and for collinear contacts. `witness` is a unit
    wrench (force, torque about the contacts' centre over their radius) whose product with every edge wrench is at
    least -margin: a row that is not closed has none against it, and cannot resist it.
    """

    margin: Float[Tensor, "b"]
    rank_ratio: Float[Tensor, "b"]
    residual: Float[Tensor, "b"]
    closed: Bool[Tensor, "b"]
    witness: Float[Tensor, "b 6"]


# ------------------------------------------------------------------------------------- how this hand can touch


@dataclasses.dataclass(frozen=True)
class ContactCode(Value):
    """The frame-invariant code q = (L, N) of Eq. (18) for each of the six assignments of contacts to fingers.

    Finger i touches contact `permutation[k, i]` in assignment k. Degenerate rows hold NaN and say so in `status`.
    """

    q: Float[Tensor, "b 6 6"]
    obj_from_vf: Float[Tensor, "b 6 4 4"]
    status: Int[Tensor, "b"]
    permutation: Int[Tensor, "6 3"]


@dataclasses.dataclass(frozen=True)
class IKSeeds(Batch):
    """Postures of the learned model or of the hand's own, aligned with the contacts by their virtual frames (Eq. 24).

    `row` names the row of the contact plan and `permutation` the contact of each finger; `energy` is the least f_i of
    Eq. (21), of a posture of the hand's own half its squared distance; `tip_error` [m] is the distance of each
    fingertip from its contact before refinement.
    """

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]
    row: Int[Tensor, "g"]
    permutation: Int[Tensor, "g 3"]
    energy: Float[Tensor, "g"]
    tip_error: Float[Tensor, "g 3"]


@dataclasses.dataclass(frozen=True)
class Grasps(Batch):
    """Hand configurations that realise planned contacts, best first.

    Contact i is touched by finger i of the hand. `clearance` [m] is the least distance of the hand's links from the
    estimated surface (fingertips apart), from each other and from the table; `normal_angle` [rad] the angle between
    the contact direction and the pad's axis; `pregrasp` the joints of the opened hand at the same pose, and `approach`
    the unit direction in which it comes there, straight. `score` ranks; after `plan_grasps` it is the log-odds of
    `success` of those with `Status.OK`. `meta` holds names, units, hashes and the seed, as they are written to files.
    """

    joints: Float[Tensor, "g h"]
    pregrasp: Float[Tensor, "g h"]
    approach: Float[Tensor, "g 3"]
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

    @property
    def success(self) -> Float[Tensor, "g"]:
        """The predicted probability (`hand.success`) that each planned grasp holds; 0 where it cannot be executed."""
        return torch.where(self.status == Status.OK, torch.sigmoid(self.score), 0.0)

    def save(self, path: Path | str) -> None:
        """Write the grasps with their metadata as safetensors, atomically; `load_grasps` reads them back.

        Raises:
            OutputError: the file cannot be written; nothing half-written stays.
        """
        save_tensors(path, "grasps", _flatten(self), self.meta)


def load_grasps(path: Path | str) -> Grasps:
    """Read grasps that `Grasps.save` wrote.

    Raises:
        ModelFileError: the file is missing or malformed.
    """
    nested = {"contacts": Contacts, "certificate": Certificate}
    plain = [f.name for f in dataclasses.fields(Grasps) if f.name not in (*nested, "meta")]
    names = set(plain) | {f"{k}.{f.name}" for k, t in nested.items() for f in dataclasses.fields(t)}
    tensors, meta = load_tensors(path, "grasps", names)
    rows = {name: len(t) for name, t in tensors.items()}
    if len(set(rows.values())) != 1:
        raise ModelFileError("path", f"{path}: rows {rows}", "as many rows in every tensor")
    values: dict[str, Any] = {name: tensors[name] for name in plain}
    for name, kind in nested.items():
        values[name] = kind(**{f.name: tensors[f"{name}.{f.name}"] for f in dataclasses.fields(kind)})
    return Grasps(**values, meta={k: v for k, v in meta.items() if k not in ("kind", "version")})


def _flatten(value: Any, prefix: str = "") -> dict[str, Tensor]:
    """Name every tensor inside a value by its path of field names."""
    tensors: dict[str, Tensor] = {}
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        if isinstance(inner, Tensor):
            tensors[prefix + field.name] = inner
        elif dataclasses.is_dataclass(inner):
            tensors |= _flatten(inner, f"{prefix}{field.name}.")
    return tensors


# -------------------------------------------------------------------------------------------------- closing on it


@dataclasses.dataclass(frozen=True)
class ClosingGains(Value):
    """Gains of the closing controller for each finger, in the hand's frame (Eqs. 26-28).

    `force_source` tells where the desired forces come from: "analytic", or "learned" from stable grasps.
    """

    target: Float[Tensor, "3 3"]
    covariance: Float[Tensor, "3 3 3"]
    position_gain: Float[Tensor, "3 3"]
    force_gain: Float[Tensor, "3 3"]
    desired_force: Float[Tensor, "3 3"]
    force_source: str = "analytic"


@dataclasses.dataclass(frozen=True)
class ClosureResult(Value):
    """What happened when the hand closed on the true object.

    `time` [s] is the control ticks; `forces` [N] the normal force of each fingertip; `object_pose` and `hand_pose`
    the object's and the hand's frames in the world at each tick; `joints` every joint of the URDF in the order of
    `joint_names`. `contact_order` lists the fingers in the order of their first touch, those that never touched left
    out. `object_motion` is how far the object moved [m] and turned [rad] against the hand from when the hand has come
    to its pre-grasp to the end; `start_overlap` [m] how deep the opened hand was in object or table before it came.
    `held` is true when the object is still up with the hand at the end; `seconds` is the wall time.
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
    start_overlap: float
    seconds: float
