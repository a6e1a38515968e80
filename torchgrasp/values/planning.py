"""The values that the stages of planning exchange, in the order of the stages. Options are in
`torchgrasp.values.specs`.

A value is a frozen dataclass of tensors: it never changes, and `.to()` returns a new one. Lengths
are in metres, angles in radians. Positions are in the frame of the cloud ("obj") unless stated
otherwise. `a_from_b` is a rigid transform (4, 4) [m] that maps coordinates of frame b into a.

Letters in shapes: n points, b batch rows, g grasps, f fingertips (three to five). Also e
friction-cone edges, h actuated joints, and t time steps.
"""

import copy
import dataclasses
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.files import save_tensors
from torchgrasp.foundation.base import Batch, Value, flatnonzero, named_tensors, read_rows
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, FailedRows, Status, TooFewPoints
from torchgrasp.foundation.rules import ANY, Poses, Rows
from torchgrasp.geometry.plane import Plane, read_plane


@checked
@dataclasses.dataclass(frozen=True)
class PointCloud(Value):
    """The measured surface points of one object, with optional normals and camera positions.

    All fields are in one frame, the frame of the cloud ("obj"). n counts points.

    Args:
        points: surface points (n, 3) [m], at least 4.
        normals: outward normals (n, 3) of any length; None if they are unknown.
        viewpoint: position of the camera (3,) [m], or of each point's camera (n, 3) [m]; None if it
            is unknown.
        frustum: inward unit normals (4, 3) of the left, right, top and bottom side of the camera's
            view. With several views, those (n, 4, 3) of each point's camera. An object that reaches
            a side is cut off there. None if they are unknown.
        pose_error: standard deviation (n,) [m] of an error of the camera's pose, which moves all
            points of a view together. None if the poses are exact.

    Raises:
        BadArgument: a wrong shape or dtype, or numbers that are not finite.
        TooFewPoints: fewer than 4 points.

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
        """Return a cloud of some of the points, with their normals, cameras and pose errors.

        `rows` is a mask (n,) of the points, or holds indices (m,) of points in the wanted order.
        Raises `BadArgument` for another shape or dtype, and `TooFewPoints` if fewer than 4 points
        are left. Raises `IndexError` for an index beyond the last point.
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
        """Return the indices (m,) of the points of each camera, one tensor for each camera.

        The cameras are in the order of their first points. Without `viewpoint`, or with a single
        one, all points are of one camera.
        """
        if self.viewpoint is None or self.viewpoint.ndim == 1:
            return [torch.arange(len(self), device=self.points.device)]
        _, view = self.viewpoint.unique(dim=0, return_inverse=True)
        return [flatnonzero(view == k) for k in dict.fromkeys(view.tolist())]

    def split_views(self) -> "list[PointCloud]":
        """Return one cloud for each camera, in the order of their first points.

        Each cloud has a single `viewpoint` (3,) [m]. Without `viewpoint`, or with a single one, the
        list holds this cloud alone.
        """
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

    `ShapeGP.predict` returns it. All fields share the leading axes `*b` of these points. One
    normalised unit is `ShapeGP.scale` metres.

    Attributes:
        distance: mean signed distance (*b,), normalised; negative inside the object.
        normal: outward unit normal (*b, 3) in the frame of the cloud, the unit gradient of the mean
            distance.
        variance: variance (*b,) of the distance, in squared normalised units.
        covariance: covariance (*b, 4, 4) of distance (index 0) and gradient (1 to 3), normalised.
            None if `predict` was called with `covariance=False`.
        std_m: calibrated standard deviation (*b,) [m] of the surface along its normal. It is
            `ShapeGP.std_factor` sqrt(variance) / |gradient| times `ShapeGP.scale`; the gradient is
            that of the mean distance.
    """

    distance: Float[Tensor, "*b"]
    normal: Float[Tensor, "*b 3"]
    variance: Float[Tensor, "*b"]
    covariance: Float[Tensor, "*b 4 4"] | None
    std_m: Float[Tensor, "*b"]


@checked
@dataclasses.dataclass(frozen=True)
class Contacts(Batch):
    """Sets of three to five contacts, one contact for each fingertip.

    b counts contact sets, and f the fingertips of a set. Vectors are in the frame of the cloud, and
    all tensors have one dtype. `plan_contacts` returns contacts. For contacts of another planner,
    `points` and `normals` are enough.

    Args:
        points: contact points (b, f, 3) [m] on the object.
        normals: outward unit normals (b, f, 3) of the object at these points.
        variance: variance (b, f) of the signed distance at each contact (Eq. 12 of the paper), in
            squared normalised units; one unit is `ShapeGP.scale` [m]. None if it is unknown.
        std_m: standard deviation (b, f) [m] of the surface at each contact; None if it is unknown.

    Raises `BadArgument` for tensors of different dtypes, or of shapes that do not fit together.

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
        """Return the field `std_m` (b, f) [m], the standard deviation of the surface at each
        contact.

        Raises `BadArgument` if it is None.
        """
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

    `plan_contacts` makes it. Here b counts contact sets, f the fingertips of a set, and e the edges
    of a friction cone (`ContactSpec.edges`).

    Attributes:
        contacts: the contact sets, also those that violate a constraint.
        coefficients: weights phi (b, f, e) of forces along the edges of the friction cones, without
            unit (Eq. 13 of the paper). The weights of a set have the sum 1, over all its fingertips
            and edges. If the set has force closure, these forces balance.
        quality: distance (b,) [m] of the contacts' centroid from the origin of the normalised
            frame, `ShapeGP.center` (Eq. 14); less is better.
        status: `Status` code (b,) of each set: `OK`, or the first constraint that the set violates.
    """

    contacts: Annotated[Contacts, Rows("b")]
    coefficients: Annotated[Float[Tensor, "b f e"], ANY]
    quality: Annotated[Float[Tensor, "b"], ANY]
    status: Int[Tensor, "b"]


@checked
@dataclasses.dataclass(frozen=True)
class Certificate(Batch):
    """Whether each of b contact sets has frictional form closure (Eq. 13 of the paper), with a
    proof.

    `certify` returns it, and `closed` is the answer. Frictional form closure is also called force
    closure. The contacts then resist any load if the fingers press hard enough. f counts the
    fingertips of a set. The wrenches w of a set are the columns of W. They are forces along the
    edges of its friction cones, then their torques. Torques are about the contacts' centroid. They
    are divided by the contacts' root-mean-square distance from it, so wrenches have no unit.

    Attributes:
        closed: mask (b,) of the sets that have force closure. Their margin is at least 1e-6 and
            their `rank_ratio` at least 1e-3. Their contacts do not lie almost on a line:
            coincident or collinear contacts satisfy Eq. (13), too.
        margin: the largest s (b,) for which coefficients phi >= s have W phi = 0 and sum phi = 1.
            It is -inf if no coefficients balance, and NaN for contacts that are not finite.
        rank_ratio: the smallest singular value of W over its largest one (b,).
        residual: the largest component |W phi| (b,) of the balance found; infinite if there is
            none.
        witness: a unit wrench v (b, 6), like w without unit, in the frame of the contacts. If the
            margin is at most 0, v . w >= 0 for every edge wrench w, up to rounding. So no contact
            force opposes v. For a set with force closure, v proves that no greater margin is
            possible. The margin is -min(v . w) / sum(v . w - min(v . w)) over the edge wrenches. If
            the margin suffices, but the set is not closed, the wrenches are smallest along v.
        task_load: the load t (b, 6) that the contacts resist least, of the loads in the argument
            `resist` of `plan_grasps`. It is a force [N], then a torque [N m] about the contacts'
            centroid, in the frame of the cloud.
        task_margin: the greatest multiple (b,) of t that the contacts resist, without unit. All
            loads are resisted if it is at least 1.
        task_forces: contact forces (b, f, 3) [N] that balance this multiple of t, in the frame of
            the cloud.
        task_strength: greatest normal force (b, f) [N] of each finger that `task_margin` and
            `task_twist` assume. The torques of the finger's drives bound it.
        task_twist: proof (b, 6) [1/N, 1/(N m)] that no greater multiple is resisted. It is a twist
            y with y . t = -1. Along it, no admissible contact forces have a power greater than
            `task_margin`.

    The `task_` fields are None without the argument `resist` of `plan_grasps`.
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


@checked
@dataclasses.dataclass(frozen=True)
class ContactCode(Value):
    """The code q of sets of three contacts (Eq. 18 of the paper), which does not change with the
    frame.

    `encode` returns it. b counts contact sets. The second axis of `q` and `obj_from_vf`, of length
    6, counts the assignments of the three contacts to three fingers.

    Attributes:
        q: code (b, 6, 6) of each set in each assignment. First are the distances [m] of the first,
            second and third finger's contact from their centroid. Then come the cosines between the
            normals of the first and second, first and third, second and third.
        obj_from_vf: pose (b, 6, 4, 4) [m] of the virtual frame (Eqs. 15-17) in the frame of the
            contacts. Its origin is their centroid. The axis x points from the contact of the first
            finger to that of the third. The axis z is normal to the plane of the contacts. Seen
            from the tip of z, the contacts of the first, second and third finger run
            counterclockwise.
        status: `Status` code (b,) of each set. If the contacts of a set lie on a line or in a
            point, it is not `OK`. Then `q` and `obj_from_vf` are NaN.
        permutation: indices (6, 3): in assignment k finger i touches contact `permutation[k, i]`.
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

    `nearest_postures` returns them. f counts fingertips, and h actuated joints.

    Attributes:
        joints: actuated joints (g, h) [rad or m], in the order of `hand.joint_names`.
        obj_from_hand: pose (g, 4, 4) [m] of the hand's root link in the frame of the contacts.
        row: index (g,), in the batch of contact sets, of the set of each guess.
        permutation: indices (g, f) of contacts: in guess k finger i is placed on contact
            `permutation[k, i]` of the guess's set.
        energy: misfit (g,) of the posture, without unit; less is better. For `nearest_postures` it
            is half the squared distance between the features of posture and contacts
            (`PostureLibrary.feature`). For a learned model it is the least f_i of Eq. (21).
        tip_error: distance (g, f) [m] of each fingertip from its contact.
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


class NotebookPages(Protocol):
    """Interface of the module that draws grasps for notebooks, `torchgrasp.app.report.notebook`."""

    def make_sheet(self, grasps: "Grasps", cloud: Any, hand: Any) -> Any:
        """Return what `Grasps.show` returns for these grasps, cloud and hand."""
        ...

    def show_in_notebook(self, grasps: "Grasps") -> str:
        """Return the HTML that a notebook shows of the grasps."""
        ...


@checked
@dataclasses.dataclass(frozen=True)
class Grasps(Batch):
    """Grasps: hand configurations with their contacts, certificates and checks, the best grasp
    first.

    `plan_grasps` returns them, and `load_grasps` reads them from a file. Here g counts grasps, f
    fingertips, h actuated joints of the hand, and n joints of the arm. Positions and directions are
    in the frame of the cloud. Joints that slide have [m] in place of [rad].

    Attributes:
        joints: actuated joints (g, h) [rad or m], in the order of `hand.joint_names`.
        pregrasp: joints (g, h) [rad or m] of the opened hand. The opened hand is at
            `obj_from_hand`, or above it if its links would be in the table there
            (`ik.opened_pose`).
        approach: unit direction (g, 3) in which the opened hand moves straight to its pre-grasp.
        obj_from_hand: pose (g, 4, 4) [m] of the hand's root link.
        contacts: contact sets (g rows); finger i touches contact i.
        permutation: indices (g, f): contact i was contact `permutation[k, i]` of the planned
            contact set of grasp k.
        tip_error: distance (g, f) [m] of each fingertip from its contact.
        clearance: least distance (g,) [m] of the links from the estimated surface, from each other
            and from the table. In a scene it is also from obstacles that links must not touch. It
            is negative where they overlap. Fingertips may touch the surface.
        normal_angle: angle (g, f) [rad] between the axis of a fingertip's pad and the inward normal
            of the object at its contact. The pad is the part that touches objects.
        certificate: proof of force closure (g rows): whether the contacts resist any load.
        score: log-odds (g,) of the predicted success p, log(p / (1 - p)) without unit. Executable
            grasps of `plan_grasps` with a `known` success come first, then the other executable
            ones. Both are in falling order of their scores. With an arm, grasps of equal success in
            whole per cent are in falling order of the product of `ease`. With the argument
            `ranking` "variance", scores do not count. The score of a failed grasp is no log-odds
            and says nothing about success.
        status: `Status` code (g,): `OK` for an executable grasp, which passed all checks. Else it
            is the reason why the grasp failed.
        meta: names, units, hashes and the seed of the plan, as text.
        known: mask (g,) of the grasps that are like those of the trials to which the success model
            was fitted. The success of other grasps is unknown. None means that all are known.
        interval: 95 % confidence interval (g, 2), lower and upper end, of the success rate of
            grasps with this predicted success. It comes from trials, by resampling families of
            objects. [0, 1] if the success is unknown, [0, 0] for failed grasps. None if there are
            no bounds.
        arm: joints (g, n) [rad or m] of the arm at the grasp, 0 for failed grasps; None without an
            arm.
        ease: two numbers (g, 2) for the arm's straight path to the grasp. Column 0 is the least
            distance of a joint from its limits, divided by half its range (no unit). Column 1 is
            the least manipulability, sqrt(det(J J^T)) [m^3]. 0 for failed grasps; None without an
            arm.

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
    # the package gives it, as the stage that draws is a later one
    pages: ClassVar[NotebookPages]

    @property
    def success(self) -> Float[Tensor, "g"]:
        """The predicted probability (g,) that each planned grasp holds the object in its task, the
        argument `task` of `plan_grasps`.

        It is 0 for a grasp that failed a check, and NaN for an executable one that is not `known`.
        The success of a single grasp formats as a number: `f"{grasps.best.success:.0%}"`.
        """
        likely = torch.sigmoid(self.score)
        likely = likely if self.known is None else torch.where(self.known, likely, torch.nan)
        return torch.where(self.status == Status.OK, likely, 0.0).as_subclass(Probabilities)

    @property
    def executable(self) -> "Grasps":
        """The grasps that passed all checks (`Status.OK`), in their order; there may be none."""
        return self[self.status == Status.OK]

    @property
    def best(self) -> "Grasps":
        """The first executable grasp as a batch of one grasp. Executable grasps passed all checks.

        `best.joints[0]` are its joints [rad or m], without the axis of the batch.
        `float(best.success)` is a number. Raises `FailedRows` with the reasons if there is no
        executable grasp.
        """
        if not len(self):
            raise FailedRows(self.meta.get("refused", "there is no grasp: explain_empty tells why"))
        good = self.executable
        return good[:1] if len(good) else self.raise_for_status()

    def _about(self) -> list[str]:
        good = self.executable
        best = [f"best predicted success {format_success(good)}"] if len(good) else []
        return [
            f"{len(good)} of {len(self)} executable",
            *best,
            f"hand {self.meta.get('hand', 'unknown')}",
        ]

    @property
    def table(self) -> Plane | None:
        """The table that the planner was given, in the frame of the planned cloud.

        None if the grasps were planned without a table, or if `meta` has no entry "table".
        """
        return None if (text := self.meta.get("table", "none")) == "none" else read_plane(text)

    def show(self, cloud: Any = None, hand: Any = None) -> Any:
        """Return a sheet for notebooks: a table of up to five executable grasps, and a picture of
        the first.

        Executable grasps passed all checks. A notebook shows table and picture, and `print` shows
        the table. The attribute `picture` of the sheet holds the picture as PNG; it is None if no
        grasp is executable.

        Args:
            cloud: the cloud of the object, in any form that `plan_grasps` takes. With it the
                picture has the surface estimated from it; None leaves the surface out.
            hand: the hand of the grasps. It is needed only for a hand that is not shipped.

        Raises `BadArgument` for another hand, or for a cloud that the grasps do not touch.
        """
        return self.pages.make_sheet(self, cloud, hand)

    def _repr_html_(self) -> str:
        """Return what a notebook shows of the grasps."""
        return self.pages.show_in_notebook(self)

    @checked
    def save(self, path: Path | str) -> None:
        """Write the grasps as a safetensors file, atomically; `load_grasps` reads it.

        Raises `OutputError` if the file cannot be written.
        """
        save_tensors(path, "grasps", named_tensors(self), self.meta)


def format_success(success: "Grasps | float") -> str:
    """Return a predicted success as a percentage, or "unknown" for NaN.

    `success` is a probability in [0, 1], or `Grasps`, whose first grasp counts.
    """
    number = float(success.success[0]) if isinstance(success, Grasps) else success
    return "unknown" if number != number else f"{number:.0%}"
