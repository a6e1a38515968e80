"""The values that the stages of planning exchange, in the order of the stages. Options are in
`torchgrasp.values.specs`.

A value is a frozen dataclass of tensors: it never changes, and `.to()` returns a new one. Lengths
are in metres, angles in radians. Positions are in the frame of the cloud ("obj") unless stated
otherwise. `a_from_b` is a rigid transform (4, 4) [m] that maps coordinates of frame b into a.

Letters in shapes: n points, b batch rows, g grasps, f fingertips (three to five), e friction-cone
edges, h actuated joints, t time steps.
"""

import copy
import dataclasses
import importlib
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.files import save_tensors
from torchgrasp.foundation.base import Batch, Value, named_tensors, read_rows
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, FailedRows, Status, TooFewPoints
from torchgrasp.foundation.rules import ANY, Poses, Rows
from torchgrasp.geometry.plane import Plane, read_plane


@checked
@dataclasses.dataclass(frozen=True)
class PointCloud(Value):
    """The measured surface points of one object, with optional normals and camera positions.

    Args:
        points: n surface points [m], at least 4.
        normals: outward normals of any length, or None.
        viewpoint: position of the camera [m], or of each point's camera; None if it is unknown.
        frustum: inward unit normals of the four sides of the camera's view, or of each point's
            camera; None if unknown. An object that reaches a side is cut off there.
        pose_error: standard deviation [m] of the position of each point's view, which moves its
            points together; None if the poses are exact.

    Raises `BadArgument` for a wrong shape or dtype or numbers that are not finite, `TooFewPoints`
    for fewer than 4 points.

    >>> import torch
    >>> cloud = PointCloud(torch.rand(100, 3), viewpoint=torch.eye(3)[:2].repeat_interleave(50, 0))
    >>> len(cloud), len(cloud.select(torch.arange(10))), [len(view) for view in cloud.split_views()]
    (100, 10, [50, 50])
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None = None
    viewpoint: Float[Tensor, "3"] | Float[Tensor, "n 3"] | None = None
    frustum: Float[Tensor, "4 3"] | Float[Tensor, "n 4 3"] | None = None
    pose_error: Float[Tensor, "n"] | None = None

    def __post_init__(self) -> None:
        if len(self.points) < 4:
            raise TooFewPoints("points", f"{len(self.points)} points", "at least 4 points")

    def __len__(self) -> int:
        return len(self.points)

    @checked
    def select(self, rows: Int[Tensor, "m"] | Bool[Tensor, "n"]) -> "PointCloud":
        """Return a cloud of some of the points, with all that belongs to them.

        `rows` is a mask of the points, or holds m indices in the wanted order.
        """
        normals = self.normals
        eye = self.viewpoint
        frustum = self.frustum
        chosen = read_rows(rows, len(self))
        return PointCloud(
            points=self.points[chosen],
            normals=None if normals is None else normals[chosen],
            viewpoint=eye if eye is None or eye.ndim == 1 else eye[chosen],
            frustum=frustum if frustum is None or frustum.ndim == 2 else frustum[chosen],
            pose_error=None if self.pose_error is None else self.pose_error[chosen],
        )

    def view_rows(self) -> list[Int[Tensor, "m"]]:
        """Return the indices of the points of each camera, in the order of their first points."""
        if self.viewpoint is None or self.viewpoint.ndim == 1:
            return [torch.arange(len(self), device=self.points.device)]
        _, view = self.viewpoint.unique(dim=0, return_inverse=True)
        return [torch.nonzero(view == k)[:, 0] for k in dict.fromkeys(view.tolist())]

    def split_views(self) -> "list[PointCloud]":
        """Return one cloud for each camera, in the order of their first points."""
        if self.viewpoint is None or self.viewpoint.ndim == 1:
            return [self]
        views = []
        for part in map(self.select, self.view_rows()):
            assert part.viewpoint is not None
            sides = part.frustum if part.frustum is None else part.frustum.reshape(-1, 4, 3)[0]
            eye = part.viewpoint[0]
            views.append(dataclasses.replace(part, viewpoint=eye, frustum=sides))
        return views


@checked
@dataclasses.dataclass(frozen=True)
class ShapeEstimate(Value):
    """The estimated shape at query points: signed distance and normal with their uncertainty (Eqs.
    7-8 of the paper).

    `distance`, its `variance`, and the `covariance` of distance (index 0) and gradient (1 to 3) are
    in the normalised units of the paper: one unit is `shape.scale` metres. `normal` is the unit
    gradient of the mean distance. `std_m` [m] is the calibrated standard deviation of the surface:
    that of the distance, divided by the slope of the mean.
    """

    distance: Float[Tensor, "*b"]
    normal: Float[Tensor, "*b 3"]
    variance: Float[Tensor, "*b"]
    covariance: Float[Tensor, "*b 4 4"]
    std_m: Float[Tensor, "*b"]


@checked
@dataclasses.dataclass(frozen=True)
class Contacts(Batch):
    """Sets of three to five contacts, one contact for each fingertip.

    `points` [m] are the contact points on the object, and `normals` its outward unit normals there.
    `variance` (Eq. 12, normalised units) and `std_m` [m] are the uncertainty of the surface at the
    contacts, or None if it is unknown, as for contacts of another planner. All tensors have one
    dtype.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> contacts = load_shipped_grasp("jug", "allegro").contacts
    >>> contacts.fingertips, contacts.require_std() < 0.005  # [m]
    (3, tensor([[True, True, True]]))
    """

    points: Annotated[Float[Tensor, "b f 3"], ANY]
    normals: Annotated[Float[Tensor, "b f 3"], ANY]
    variance: Annotated[Float[Tensor, "b f"], ANY] | None = None
    std_m: Annotated[Float[Tensor, "b f"], ANY] | None = None

    def __post_init__(self) -> None:
        found = {
            str(x.dtype)
            for x in (self.points, self.normals, self.variance, self.std_m)
            if x is not None
        }
        if len(found) > 1:
            raise BadArgument("contacts", " beside ".join(sorted(found)), "one dtype for all")

    @property
    def fingertips(self) -> int:
        """The number f of contacts in a set."""
        return self.points.shape[-2]

    def require_std(self) -> Float[Tensor, "b f"]:
        """Return `std_m` [m]; raise `BadArgument` if it is None."""
        if self.std_m is None:
            raise BadArgument(
                "contacts.std_m",
                "None",
                "the standard deviation [m] of the surface at each contact",
            )
        return self.std_m


@checked
@dataclasses.dataclass(frozen=True)
class ContactPlan(Batch):
    """Planned contact sets, one for each initial guess, in the order of the guesses.

    `coefficients` (no unit, with sum 1) are phi of Eq. (13) of the paper: weights of the edges of
    the friction cones at which the forces balance. `quality` is Eq. (14), the distance [m] of the
    contacts' centroid from the cloud's centre; less is better. `status` holds a `Status` code for
    each contact set. `friction` is the friction coefficient of the cones of each set; None if it is
    `ContactSpec.planned_friction` for all.
    """

    contacts: Annotated[Contacts, Rows("b")]
    coefficients: Annotated[Float[Tensor, "b f e"], ANY]
    quality: Annotated[Float[Tensor, "b"], ANY]
    status: Int[Tensor, "b"]
    friction: Float[Tensor, "b"] | None = None


@checked
@dataclasses.dataclass(frozen=True)
class Certificate(Batch):
    """The proof that contact sets have frictional form closure (Eq. 13), or that they have not;
    `certify` makes it.

    The columns of W are the wrenches along the edges of the friction cones, with torques divided by
    the radius of the contacts; phi are their coefficients. W, phi and the first five fields have no
    unit. `margin` is the largest s with W phi = 0, sum phi = 1, phi >= s. `rank_ratio` is the
    smallest over the largest singular value of W. `residual` is the largest |W phi|. `closed`,
    which means force closure, needs a margin clearly above 0 and full rank, because coincident or
    collinear contacts satisfy Eq. (13) too. `witness` is a unit wrench w with w . v >= -margin for
    every column v of W. Without force closure no contact force opposes w.

    With `resist`, a task has several loads; `task_load` t (3 forces [N], 3 torques [N m]) is the
    one that the contacts resist least, about their centroid. They resist `task_margin` (no unit)
    times t. `task_forces` [N], with normal forces up to `task_strength` [N], balance this multiple
    of t. `task_twist` y [1/N, 1/(N m)] with y . t = -1 proves that no such forces balance more:
    none have a greater power along y. Without `resist` these fields are None.

    `friction` is the friction coefficient of the cones of each set; None if it is that of the spec,
    `ContactSpec.planned_friction`, for all.
    """

    margin: Annotated[Float[Tensor, "b"], ANY]
    rank_ratio: Annotated[Float[Tensor, "b"], ANY]
    residual: Annotated[Float[Tensor, "b"], ANY]
    closed: Bool[Tensor, "b"]
    witness: Annotated[Float[Tensor, "b 6"], ANY]
    task_margin: Annotated[Float[Tensor, "b"], ANY] | None = None
    task_load: Annotated[Float[Tensor, "b 6"], ANY] | None = None
    task_twist: Annotated[Float[Tensor, "b 6"], ANY] | None = None
    task_forces: Annotated[Float[Tensor, "b f 3"], ANY] | None = None
    task_strength: Annotated[Float[Tensor, "b f"], ANY] | None = None
    friction: Float[Tensor, "b"] | None = None


@checked
@dataclasses.dataclass(frozen=True)
class ContactCode(Value):
    """The code q of sets of three contacts, which is the same in every frame (Eq. 18).

    Axis 1 counts the six assignments of contacts to fingers. In assignment k finger i touches
    contact `permutation[k, i]`. `q` holds 3 distances [m] of the contacts from their centroid, then
    3 cosines between their normals. `obj_from_vf` [m] is the pose of the virtual frame that the
    contacts define. Contact sets on a line or in a point have NaN, and a `status` code other than
    OK.
    """

    q: Annotated[Float[Tensor, "b 6 6"], ANY]
    obj_from_vf: Annotated[Float[Tensor, "b 6 4 4"], ANY]
    status: Int[Tensor, "b"]
    permutation: Int[Tensor, "6 3"]


@checked
@dataclasses.dataclass(frozen=True)
class IKSeeds(Batch):
    """Initial guesses for inverse kinematics: g postures whose fingertips are placed on contacts
    (Eq. 24 of the paper).

    `joints` [rad] are in the order of `hand.joint_names`, and `obj_from_hand` [m] is the hand's
    pose. `row` is the index of the contact set. Finger i is placed on contact `permutation[k, i]`
    of the set of guess k. `energy` (no unit; less is better) is the misfit of the posture, the
    least f_i of Eq. (21) or half the squared feature distance of a library posture. `tip_error` [m]
    is the distance of each fingertip from its contact.
    """

    joints: Float[Tensor, "g h"]
    obj_from_hand: Poses
    row: Int[Tensor, "g"]
    permutation: Int[Tensor, "g f"]
    energy: Annotated[Float[Tensor, "g"], ANY]
    tip_error: Annotated[Float[Tensor, "g f"], ANY]


class Probabilities(Tensor):
    """A tensor of probabilities. If it holds a single one, format codes such as `.2f` apply to it.

    All operations return plain tensors.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    def __format__(self, code: str) -> str:
        """Return the text of the tensor, or of its only number in the format `code`."""
        return format(float(self), code) if code and self.numel() == 1 else super().__format__(code)

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        """Return a plain tensor, as all operations do."""
        return copy.deepcopy(self.as_subclass(Tensor), memo)

    def __reduce_ex__(self, proto: Any) -> Any:
        """Return what is pickled: a plain tensor."""
        return self.as_subclass(Tensor).__reduce_ex__(proto)


@checked
@dataclasses.dataclass(frozen=True)
class Grasps(Batch):
    """Grasps: hand configurations with their contacts, certificates and checks, best first.

    `joints` [rad] are in the order of `hand.joint_names`, and `obj_from_hand` [m] is the hand's
    pose. Finger i touches contact i of `contacts`, which was contact `permutation[k, i]` of the
    contact set that the planner found for grasp k. `pregrasp` [rad] are the joints of the opened
    hand, which is at the same pose or, where its links would be in the table, above it
    (`ik.opened_pose`). `approach` is the unit direction, in the frame of the cloud, in which the
    opened hand moves straight there.

    `tip_error` [m] is the distance of each fingertip from its contact. `clearance` [m] is the least
    distance of the links from the estimated surface, from each other and from the table; fingertips
    may touch the surface. `normal_angle` [rad] is the angle between pad axis and contact direction.
    `certificate` proves force closure, and `status` holds a `Status` code. `score` is the log-odds
    of the predicted success, which ranks the grasps. `interval` bounds the share of such grasps
    that held in trials (95 % over families). `known` tells for which grasps trials support the
    prediction; None means for all. `meta` holds names, units, hashes and the seed as text.

    With an arm, `arm` are its joints [rad]. `ease` holds the least joint margin (share of half a
    joint's range) and the least manipulability, sqrt(det(J J^T)) [m^3], on the way
    (`torchgrasp.arm`).

    Each index keeps the batch axis: `grasps[0]` is a batch of one, and `grasps[0].joints[0]` are
    its joints. For all joints of the hand see `Hand.expand`, for a 3D page
    `torchgrasp.app.report.show_grasps`.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> grasp.joints.shape, f"{float(grasp.success):.2f}", grasp.tip_error < 0.001  # [m]
    (torch.Size([1, 4]), '0.94', tensor([[True, True, True]]))
    """

    joints: Float[Tensor, "g h"]
    pregrasp: Float[Tensor, "g h"]
    approach: Float[Tensor, "g 3"]
    obj_from_hand: Poses
    contacts: Annotated[Contacts, Rows("g")]
    permutation: Int[Tensor, "g f"]
    tip_error: Annotated[Float[Tensor, "g f"], ANY]
    clearance: Annotated[Float[Tensor, "g"], ANY]
    normal_angle: Annotated[Float[Tensor, "g f"], ANY]
    certificate: Annotated[Certificate, Rows("g")]
    score: Annotated[Float[Tensor, "g"], ANY]
    status: Int[Tensor, "g"]
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    known: Bool[Tensor, "g"] | None = None
    interval: Annotated[Float[Tensor, "g 2"], ANY] | None = None
    arm: Float[Tensor, "g n"] | None = None
    ease: Float[Tensor, "g 2"] | None = None

    @property
    def success(self) -> Float[Tensor, "g"]:
        """The predicted probability that each planned grasp holds; 0 if it cannot be executed, NaN
        if it is unknown.

        That of a single grasp formats as a number: `f"{grasps.best.success:.0%}"`.
        """
        likely = torch.sigmoid(self.score)
        likely = likely if self.known is None else torch.where(self.known, likely, torch.nan)
        return torch.where(self.status == Status.OK, likely, 0.0).as_subclass(Probabilities)

    @property
    def best(self) -> "Grasps":
        """The first executable grasp, as a batch of one, which all functions take.

        `best.joints[0]` are its joints, without the axis of the batch, and `float(best.success)` is
        a number. Raises `FailedRows` with the reasons if there is none.
        """
        good = self.status == Status.OK
        if not len(self):
            raise FailedRows(self.meta.get("refused", "there is no grasp: explain_empty tells why"))
        return self[good][:1] if bool(good.any()) else self.raise_for_status()

    def _about(self) -> list[str]:
        good = self[self.status == Status.OK]
        best = [f"best predicted success {format_success(good)}"] if len(good) else []
        return [
            f"{len(good)} of {len(self)} executable",
            *best,
            f"hand {self.meta.get('hand', 'unknown')}",
        ]

    @property
    def table(self) -> Plane | None:
        """The table that the planner was given, in the frame of the grasps; None without a table,
        or if it is unknown.
        """
        return None if (text := self.meta.get("table", "none")) == "none" else read_plane(text)

    def show(self, cloud: Any = None, hand: Any = None) -> Any:
        """Return a table and a picture of the best grasps: a notebook shows both, `print` the
        table.

        With `cloud`, in any form that `plan_grasps` takes, the picture has the surface estimated
        from it. `hand` is needed for grasps of a hand that is not shipped. The result has the PNG
        as `picture`. Raises `BadArgument` for another hand, or for a cloud that the grasps do not
        touch.
        """
        return _pages().make_sheet(self, cloud, hand)

    def _repr_html_(self) -> str:
        """Return what a notebook shows of the grasps."""
        return _pages().show_in_notebook(self)

    @checked
    def save(self, path: Path | str) -> None:
        """Write the grasps as a safetensors file, atomically; `load_grasps` reads it.

        Raises `OutputError` if the file cannot be written.
        """
        save_tensors(path, "grasps", named_tensors(self), self.meta)


def _pages() -> Any:
    """Return the module that draws grasps. It is of a later stage, so it is found when asked for."""
    return importlib.import_module("torchgrasp.app.report.notebook")


def format_success(success: "Grasps | float") -> str:
    """Return a predicted success as a percentage, or "unknown" for NaN.

    `success` is a probability, or grasps, of which the first counts.
    """
    number = float(success.success[0]) if isinstance(success, Grasps) else success
    return "unknown" if number != number else f"{number:.0%}"
