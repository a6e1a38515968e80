"""From where to look next: the camera from which a second view tells most about the surface."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.camera import look_at
from torchgrasp.foundation.base import Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Length, Measured, Pose
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import Points, Vector, norm, unit
from torchgrasp.geometry.plane import Plane, as_plane, upright_frame
from torchgrasp.geometry.signed_distance import SignedDistanceField, field_from_surface
from torchgrasp.shape.completion.silhouette import find_middle, pick_apart
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.planning import Grasps


@dataclasses.dataclass(frozen=True)
class SecondViewNumbers:
    """Parameters of the search for a second view: the cameras that are compared, and what each
    sees.
    """

    azimuths: int = 24
    """Number of directions around the object in which cameras are compared."""
    elevations: tuple[float, ...] = (15.0, 30.0, 45.0, 60.0, 75.0)
    """Elevations [deg] of these cameras above the horizontal; without a table, also below."""
    far: float = 0.5
    """Distance [m] of a camera from the object, if that of the first view is unknown."""
    near: float = 1.5
    """Least distance of a camera from the object, in radii of the shape's domain."""
    resolution: int = 32
    """Number of cells along the domain's diameter when the surface is extracted."""
    points: int = 250
    """Number of points of the surface that a camera may see."""
    grasps: int = 20
    """Number of best grasps whose contacts count: as many as judge a set of fingers."""
    least_cosine: float = 0.3
    """Least cosine between ray and normal: real cameras lose surface at grazing angles."""
    spacing: float = 0.004
    """Spacing [m] of the distance field that hides surface from a camera."""
    margin: float = 0.01
    """Distance [m] to which the field reaches around the surface."""
    blocked: float = 0.25
    """Distance of a ray from the surface, over the spacing of the field, below which the ray is
    blocked.
    """
    steps: int = 24
    """Greatest number of steps along a ray, each as long as the distance from the surface."""
    noise: float = 0.01
    """Standard deviation of a seen point, normalised: the noise that `fit_shape` assumes."""
    unseen: float = 1e3
    """Standard deviation, normalised, that stands for a point that was not seen."""
    tie: float = 1e-6
    """Relative difference of the expected deviations up to which two views are equal: far above
    rounding.
    """


VIEW = SecondViewNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class NextView(Value):
    """A camera for a second view, and what it is expected to tell, from `next_view`.

    `before` and `after` are means over the contacts of the best grasps, weighted by their predicted
    success. Without grasps they are means over the surface.

    Attributes:
        camera_pose: pose `obj_from_camera` (4, 4) [m] in the cloud's frame, as `look_at` returns it
            (x right, y down, z forward).
        turn: angle [deg], seen from the object, between this camera and the nearest earlier one;
            NaN if no earlier camera is known.
        before: mean standard deviation [m] of the surface now.
        after: mean standard deviation [m] of the surface that is expected after the second view.
    """

    camera_pose: Pose
    turn: Measured
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """The camera's position [m] in the frame of the cloud, and the expected gain, in words.

        For example "(0.31, 0.02, 0.40) m, 95 degrees from where the camera was: std_m falls from
        5.2 to 1.8 mm".
        """
        x, y, z = self.camera_pose[:3, 3].tolist()
        turn = ""
        if not math.isnan(self.turn):
            turn = f", {self.turn:.0f} degrees from where the camera was"
        place = f"({x:.2f}, {y:.2f}, {z:.2f}) m{turn}"
        return f"{place}: std_m falls from {1e3 * self.before:.1f} to {1e3 * self.after:.1f} mm"


@checked
@single_threaded
def next_view(
    shape: ShapeGP,
    grasps: Grasps | None = None,
    *,
    table: Plane | float | None = None,
    distance: Length | None = None,
) -> NextView:
    """Return the camera for a second view that would reduce the shape's standard deviation most.

    Candidates are cameras on a sphere around the object, placed relative to the camera that took
    the cloud. If cloud and table are turned, the answer turns with them. A camera would see the
    points of the estimated surface that face it. No other part of the surface may hide them. The
    deviation after a view is that of the posterior given these points.

    The search knows neither neighbours that hide the object nor an arm that carries the camera. A
    fit to both views may be better still: it also uses the object's second outline.

    Args:
        shape: the shape, from `fit_shape`.
        grasps: grasps of this shape, in its frame. The deviation is then the mean over the contacts
            of the first 20 grasps that passed all checks (`VIEW.grasps`). It is weighted by their
            predicted success. None, or no such grasp, means the mean over the surface.
        table: the table's plane, or its height [m] along z; cameras are above it. None means the
            table of the grasps, if they have one. Without a table, cameras may be below the object.
        distance: distance [m] of the camera from the middle of the surface. It is at least 1.5
            radii (`VIEW.near`) of the shape's domain, the ball in which the shape is known. None
            means the mean distance of earlier cameras, or 0.5 m (`VIEW.far`) if none is known. If
            that is less than 1.5 radii, it means 1.5 radii.

    Raises `BadArgument` for a `distance` below 1.5 radii, and for grasps whose contacts all lie
    outside the shape's domain.

    >>> from torchgrasp import fit_shape, load_object
    >>> from torchgrasp.shape import next_view
    >>> shape = fit_shape(load_object("jug").view, table=0.0)
    >>> view = next_view(shape, table=0.0)
    >>> view.turn > 90, view.after < view.before
    (True, True)
    """
    plane = as_plane(table)
    if plane is None and grasps is not None:
        plane = grasps.table
    # the surface is sampled in the object's own frame: the view turns with it
    frame = upright_frame(shape.cloud.points, shape.cloud.viewpoint, plane)
    shape = shape.moved(inverse(frame))
    targets, weights = _contacts(shape, grasps, frame)
    surface = extract_surface(shape, VIEW.resolution)
    # the surface may end a little outside the domain, where the posterior is unknown
    inside = flatnonzero(shape.contains(surface.vertices))
    rows = inside[pick_apart(surface.vertices[inside], VIEW.points)]
    points = surface.vertices[rows]
    if len(targets) == 0:
        targets = points
        weights = torch.ones_like(points[:, 0])
    middle = find_middle(surface.vertices)
    away = _distance(shape, middle, distance)
    poses = _poses(middle, away, below=plane is None)
    field = field_from_surface(surface.vertices, surface.faces, VIEW.spacing, VIEW.margin)
    eyes = poses[:, :3, 3].to(points)
    seen = find_seen(points, surface.normals[rows], eyes, field)
    before, after = expect_deviation(shape, targets, points, seen)
    share = weights / weights.sum()
    expected = after @ share
    # of views that tell the same, as to both sides of a round body, the first
    best = int((expected <= (1 + VIEW.tie) * expected.min()).int().argmax())
    turn = _turn(shape, middle, eyes[best])
    return NextView(frame @ poses[best], turn, float(before @ share), float(expected[best]))


def find_seen(
    points: Points, normals: Points, eyes: Float[Tensor, "v 3"], field: SignedDistanceField
) -> Bool[Tensor, "v n"]:
    """Return a mask (v, n) of which of n surface points each of v cameras sees.

    `points` (n, 3) [m], their outward unit `normals` and the cameras' positions `eyes` [m] are in
    one frame. It is that of the `field`, the signed distances from the surface. A ray from a point
    to a camera must not meet the surface again. The cosine between ray and normal must exceed 0.3
    (`VIEW.least_cosine`).
    """
    offset = eyes[:, None] - points
    towards = unit(offset)
    length = norm(offset)
    seen = (towards * normals).sum(-1) > VIEW.least_cosine
    # only rays of surface that faces the camera are followed: (r,)
    ray = torch.nonzero(seen, as_tuple=True)
    way = towards[ray]
    # a ray begins off the surface, which it would meet at once
    start = (points + VIEW.spacing * normals)[ray[1]]
    along = torch.zeros_like(way[:, 0])
    free = torch.ones_like(along, dtype=torch.bool)
    least = VIEW.blocked * VIEW.spacing
    for _ in range(VIEW.steps):
        height = field.query(start + along[:, None] * way)[0]
        free &= (height > least) | (along >= length[ray])
        along = along + height.clamp_min(least)
    seen[ray] = free
    return seen


def expect_deviation(
    shape: ShapeGP, targets: Float[Tensor, "t 3"], points: Points, seen: Bool[Tensor, "v n"]
) -> tuple[Float[Tensor, "t"], Float[Tensor, "v t"]]:
    """Return (before, after): the surface's standard deviation [m] at t targets, before and after a
    second view.

    `before` is (t,), and `after` (v, t) has a line for each of v views. The t `targets` and n
    `points` [m] are in the cloud's frame. View i measures the points in the mask `seen[i]`. The
    posterior's covariance does not depend on the measured values, so it is known before.
    """
    count = len(points)
    joint = shape.joint(torch.cat([points, targets]).double())
    total = len(joint.mean)
    covariance = joint.covariance.reshape(total, 4, total, 4)[:, 0, :, 0]
    slope = norm(joint.mean[count:, 1:])
    unseen = covariance.new_full(seen.shape, VIEW.unseen**2)
    variance = unseen.masked_fill(seen, VIEW.noise**2)
    measured = covariance[:count, :count] + torch.diag_embed(variance)  # (v, n, n)
    across = covariance[:count, count:]
    root = torch.linalg.cholesky(measured)
    told = torch.linalg.solve_triangular(root, across.expand(len(seen), -1, -1), upper=False)
    prior = covariance.diagonal()[count:]
    left = (prior - told.square().sum(1)).clamp_min(0.0)
    metres = shape.std_factor * shape.scale / slope
    return metres * prior.sqrt(), metres * left.sqrt()


def _contacts(
    shape: ShapeGP, grasps: Grasps | None, frame: Pose
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t"]]:
    """Return the contacts [m] of the best executable grasps, and the weight of each.

    The contacts are in the frame of the shape, which has the pose `frame` (4, 4) [m] in that of the
    grasps.
    """
    if grasps is None:
        return shape.x.new_zeros(0, 3), shape.x.new_zeros(0)
    good = grasps.executable[: VIEW.grasps]
    points = good.contacts.points.to(shape.x)
    contacts = apply(inverse(frame).to(points), points.flatten(0, 1))
    inside = shape.contains(contacts)
    if len(inside) and not bool(inside.any()):
        found = f"{len(inside)} contacts outside the shape's domain"
        raise BadArgument("grasps", found, "grasps of this shape, in its frame")
    # where the success is unknown, the score is still the best guess
    weights = torch.sigmoid(good.score).to(shape.x)
    return contacts[inside], weights.repeat_interleave(points.shape[1])[inside]


def _poses(middle: Vector, distance: float, below: bool) -> Float[Tensor, "v 4 4"]:
    """Return the poses [m] of the cameras that are compared, in the upright frame, on the CPU.

    They look at the `middle` [m], and with `below` also from below.
    """
    heights = VIEW.elevations
    if below:
        heights = (*heights, 0.0, *(-height for height in heights))
    step = 360 / VIEW.azimuths
    around = [step * k for k in range(VIEW.azimuths)]
    target = middle.cpu()
    return torch.stack([look_at(a, height, distance, target) for height in heights for a in around])


def _eyes(shape: ShapeGP) -> Float[Tensor, "c 3"]:
    """Return the positions [m] of the cameras that have seen the object, none if unknown."""
    eyes = shape.cloud.viewpoint
    if eyes is None:
        return shape.x.new_zeros(0, 3)
    return eyes.reshape(-1, 3).unique(dim=0).to(shape.x)


def _turn(shape: ShapeGP, middle: Vector, eye: Vector) -> float:
    """Return the angle [deg] at the middle between a camera and the nearest earlier one."""
    before = _eyes(shape)
    if not len(before):
        return math.nan
    cosine = (unit(before - middle) @ unit(eye - middle)).max()
    return math.degrees(math.acos(min(1.0, float(cosine))))


def _distance(shape: ShapeGP, middle: Vector, distance: float | None) -> float:
    """Return the distance [m] of the cameras; raise `BadArgument` for one that is too near."""
    least = VIEW.near * shape.domain_radius * shape.scale
    if distance is not None:
        if not distance >= least:
            allowed = f"at least {least:.3g} m, off the object"
            raise BadArgument("distance", f"{distance:g} m", allowed)
        return distance
    before = _eyes(shape)
    if not len(before):
        return max(least, VIEW.far)
    return max(least, float(norm(before - middle).mean()))
