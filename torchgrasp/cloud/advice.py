"""Advice on a point cloud: each fault that was found, with the command that fixes it."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import check_foot
from torchgrasp.cloud.neighbours import find_inliers, nearest
from torchgrasp.cloud.parts import PARTS, find_ground, find_second_body
from torchgrasp.cloud.prepare import FACING, INWARD, point_inward, share_facing
from torchgrasp.cloud.viewpoint import GUESS, Unseen, is_along_z, share_unseen
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, Vector, norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class AdviceNumbers:
    """Bounds beyond which a cloud contradicts its camera, its vertical or its table."""

    fewest: int = 50
    """Least number of points that show whether a camera is right, or whether pixels fly off rims.
    """
    narrow: float = 0.06
    """Least width [m] of a level plane that counts as a table left in the cloud."""
    afloat: float = 0.06
    """Greatest height [m] of an object's lowest point above its table without advice. Cameras lose
    the points just above a table, and things before it hide more.
    """
    level: float = 0.97
    """Cosine between a table's normal and the vertical, below which advice mentions the normal."""
    down: float = 0.15
    """Greatest share of the visible normals that point down without advice. A camera above a table
    sees fewer.
    """
    z_up: float = 0.9
    """Cosine between the upward direction and z above which the direction counts as z, the default.
    """
    along: float = 0.8
    """Cosine between the camera's ray and an outlier's offset from the others, above which the
    outlier is a flying pixel.
    """
    flying: float = 0.02
    """Least number of flying pixels, as a share of all points, that is worth advice."""


ADVICE = AdviceNumbers()


@dataclasses.dataclass(frozen=True)
class Advice(Value):
    """A fault of a point cloud, and how to fix it; `diagnose_cloud` makes it.

    Attributes:
        found: the fault in words.
        fix: what to do, such as the option of a command.
        refused: whether the command `torchgrasp grasp` refuses such a cloud; otherwise it plans and
            only prints the advice.

    >>> print(Advice("the cloud is empty", "look again", refused=True))
    the cloud is empty: look again
    """

    found: str
    fix: str
    refused: bool

    def __str__(self) -> str:
        return f"{self.found}: {self.fix}"


def judge_view(
    cloud: PointCloud, clean: PointCloud, up: Vector, table: Plane | None, stands: bool = True
) -> list[Advice]:
    """Return advice on a view's camera, upward direction, table and flying pixels, and on other
    bodies in the cloud.

    Advice with `refused` True comes first. `clean` is the cloud without outliers, with outward
    normals and perhaps an estimated viewpoint. `up` is the unit vector that points up. A `table` of
    None means a level plane at the lowest point. All are in the frame of the cloud. `stands` is
    whether the object stands on a table.
    """
    points = clean.points.double()
    given = cloud.viewpoint is not None
    eye = None if clean.viewpoint is None else clean.viewpoint.double()
    facing = 1.0
    if cloud.viewpoint is not None and cloud.normals is not None:
        facing = share_facing(cloud.points, cloud.normals, cloud.viewpoint)
    seeing = eye if facing >= FACING else None
    # An estimate may be on the wrong side of a table. The origin of a camera's frame is not.
    trusted = seeing if seeing is None or given or not seeing.any() else None
    support = find_ground(points, trusted, up, ADVICE.narrow)
    ground = None if support is None else support.plane

    found = [_judge_facing(facing), _judge_backward(points, cloud.viewpoint, up)]
    if cloud.viewpoint is None and cloud.normals is not None:
        if point_inward(cloud.points.double(), cloud.normals.double()):
            found.append(Advice(f"normals that point {INWARD}", "--no-normals", False))
    if eye is not None and found[0] is None:
        found.append(_judge_camera(clean, given))
    if stands and table is not None:
        found.append(_judge_table(cloud, clean, table))
    if stands and seeing is not None:
        found.append(_judge_height(points, seeing, given, up, table, ground))
        if given and not any(advice and advice.refused for advice in found):
            found.append(_judge_vertical(clean, up))
    if ground is not None:
        found.append(_judge_ground(points, ground, up))
    found.append(_judge_bodies(points, up))
    if clean.viewpoint is not None and clean.viewpoint.ndim == 1:
        found.append(_judge_pixels(cloud, clean.viewpoint))
    advice = [one for one in found if one is not None]
    return sorted(advice, key=lambda one: not one.refused)


def check_camera(clean: PointCloud) -> None:
    """Raise `BadArgument` if a camera at a cloud's `viewpoint` cannot have seen the cloud's points.

    It cannot if over 15 % of the points would be edge-on (`UNSEEN.edge_on`), unless no other
    direction would show half as many. It cannot either if over 20 % would lie behind others
    (`UNSEEN.behind`). `clean` is a cloud without outliers, with
    normals of either sign. A cloud without viewpoint raises nothing, nor does a view of fewer than
    50 points.
    """
    found = _contradict(clean)
    if found is not None:
        found = f"one that the points contradict: a camera there {found}"
        raise BadArgument("viewpoint", found, "the camera's true position, or None to estimate it")


def _judge_facing(facing: float) -> Advice | None:
    """Return advice if too few normals face the camera. Nearly all do in a single view, half on a
    whole surface.
    """
    if facing < 1 - FACING:
        found = f"normals of which {1 - facing:.0%} point away from the camera"
        fix = "outward normals, or none (--no-normals), or the true --viewpoint X Y Z"
        return Advice(found, fix, True)
    if facing < FACING:
        ignored = "it is ignored, the cloud taken for a whole surface"
        found = f"a viewpoint that {facing:.0%} of the normals face: {ignored}"
        fix = "the true --viewpoint X Y Z of a single view, or --no-viewpoint"
        return Advice(found, fix, False)
    return None


def _judge_backward(
    points: Points, viewpoint: Float[Tensor, "*views 3"] | None, up: Vector
) -> Advice | None:
    """Return advice if points lie before a camera in the origin that looks along -z, as OpenGL's.

    `points` are (n, 3) [m]. The `viewpoint` (3,) or (n, 3) [m] is None if it is unknown. `up` (3,)
    is the unit vector that points up.
    """
    elsewhere = viewpoint is not None and bool(viewpoint.any())
    if elsewhere or float(up[2]) <= ADVICE.z_up:
        return None
    away = norm(points)
    radius = norm(points - points.mean(0)).max()
    far = bool(norm(points.mean(0)) > GUESS.far * radius)
    least = math.cos(math.radians(GUESS.half_view))
    if not far or not (-points[:, 2] > least * away).all():
        return None
    found = "points around the negative z axis, as in a camera's frame with y up and z backward"
    fix = "if it is OpenGL's, multiply them by diag(1, -1, -1) and give --up or --camera-pose"
    return Advice(found, fix, False)


def _judge_camera(clean: PointCloud, given: bool) -> Advice | None:
    """Return advice if a camera, `given` by the user or else estimated, cannot have seen the points
    of its view.
    """
    what = _contradict(clean)
    if what is None:
        return None
    found = f"an estimated camera that the points contradict: it {what}"
    fix = "a single view with its --viewpoint X Y Z, or outward normals"
    if given:
        found = f"a viewpoint that the points contradict: a camera there {what}"
        fix = "the true camera, --viewpoint X Y Z, or an estimate, --no-viewpoint"
    return Advice(found, fix, given)


def _contradict(clean: PointCloud) -> str | None:
    """Return what a camera would see of the view that contradicts it most; None if nothing does.

    Views of fewer than 50 points (`ADVICE.fewest`) contradict nothing. `clean` has normals.
    """
    worst = Unseen()
    for view in clean.split_views():
        eye = view.viewpoint
        if eye is not None and view.normals is not None and len(view) >= ADVICE.fewest:
            shares = share_unseen(view.points.double(), view.normals.double(), eye.double())
            worst = max(worst, shares, key=lambda shares: max(shares.excess))
    edge_on, behind = worst.excess
    if max(edge_on, behind) <= 1:
        return None
    if edge_on > behind:
        return f"sees {worst.edge_on:.0%} of them edge-on"
    return f"has {worst.behind:.0%} of them behind others"


def _judge_table(cloud: PointCloud, clean: PointCloud, table: Plane) -> Advice | None:
    """Return advice if a table lies above the object's foot, or far below all points.

    `clean` is the cloud without outliers.
    """
    try:
        check_foot(cloud, table)
    except BadArgument as error:
        found = f"a table that contradicts the cloud, {error.found}"
        return Advice(found, f"--table, {error.allowed}", True)
    foot = float(table.height(clean.points.double()).min())
    if foot <= ADVICE.afloat:
        return None
    found = f"an object that begins {1e3 * foot:.0f} mm above its table"
    fix = "the table's height in metres (--table), or --no-table for an object in the air"
    return Advice(found, fix, False)


def _judge_height(
    points: Points,
    eye: Float[Tensor, "*views 3"],
    given: bool,
    up: Vector,
    table: Plane | None,
    ground: Plane | None,
) -> Advice | None:
    """Return advice if the camera is below the table, or None if it is not.

    Without a `table`, the camera is compared with the lowest of the `points` (n, 3) [m]. `eye` [m]
    is the camera's position, one for all points or one for each. `given` is whether the user gave
    it; otherwise it is estimated. `up` is the unit vertical. `ground` is a plane found in the
    cloud, or None. Its normal is suggested as the vertical of a cloud in its camera's frame.
    """
    lowest = float((points @ up).min()) if table is None else table.offset
    normal = up if table is None else table.normal.double()
    below = lowest - float((eye @ normal).min())
    if below < 0:
        return None
    level = "the lowest point" if table is None else "the table"
    place = f"{below:.2f} m below {level} along the vertical {_triple(normal)}"

    if is_along_z(points) and float(up[2]) > ADVICE.z_up and not eye.any():
        axis = torch.tensor([0.0, -1.0, 0.0])
        why = "for a level camera"
        if ground is not None:
            axis = ground.normal
            why = "the normal of the plane in it"
        found = f"a cloud in its camera's frame, whose z axis points forward: the camera is {place}"
        options = f"{'' if given else '--viewpoint 0 0 0 '}--up {_triple(axis, ' ')}"
        fix = f"a vertical that points up: {options} ({why}), or --camera-pose FILE"
        fix += "" if given else "; or, if z points up, --up 0 0 1"
        return Advice(found, fix, True)
    if not given:
        return Advice(f"an estimated camera {place}", "the true camera: --viewpoint X Y Z", False)
    other = f"if {_triple(up)} points down, --up {_triple(-up, ' ')}"
    fix = f"a camera above it: --viewpoint X Y Z; or, {other}"
    return Advice(f"a camera {place}", fix, True)


def _judge_vertical(clean: PointCloud, up: Vector) -> Advice | None:
    """Return advice if many of the normals that the camera sees point down, by over 30 degrees."""
    assert clean.normals is not None
    down = float((clean.normals.double() @ up < -0.5).double().mean())
    if down <= ADVICE.down:
        return None
    found = f"a vertical {_triple(up)} that {down:.0%} of the visible normals contradict"
    fix = "the vertical of the cloud's frame: --up X Y Z"
    return Advice(f"{found}: they point down", fix, False)


def _judge_ground(points: Points, ground: Plane, up: Vector) -> Advice:
    """Return advice on a table that was left in the cloud."""
    share = float((ground.height(points).abs() < PARTS.layer).double().mean())
    found = f"a plane under the object, a table left in, with {share:.0%} of the points"
    turn = ""
    if float(ground.normal @ up) < ADVICE.level:
        turn = f" --up {_triple(ground.normal, ' ')}, its normal,"
    return Advice(found, f"the object alone: torchgrasp cloud cut CLOUD{turn} --out FILE", True)


def _judge_bodies(points: Points, up: Vector) -> Advice | None:
    """Return advice on a second body that was left in the cloud."""
    body = find_second_body(points, up, float(nearest(points, 2)[0][:, -1].median()))
    if body is None:
        return None
    share = float(body.double().mean())
    found = f"two bodies that stand apart, the second of {share:.0%} of the points"
    x, y, z = points[~body].mean(0).tolist()
    cut = f"torchgrasp cloud cut CLOUD --point {x:.3f} {y:.3f} {z:.3f} --out FILE"
    return Advice(found, f"one object: {cut}", True)


def _judge_pixels(cloud: PointCloud, viewpoint: Vector) -> Advice | None:
    """Return advice if many outliers are flying pixels: they lie before or behind other points on
    camera rays.
    """
    points = cloud.points.double()
    inlier = find_inliers(points)
    if inlier.all() or int(inlier.sum()) < ADVICE.fewest:
        return None
    stray = points[~inlier]
    _, index = spatial.KDTree(points[inlier].numpy()).query(stray.numpy())
    away = stray - points[inlier][torch.from_numpy(index)]
    along = (unit(away) * unit(stray - viewpoint.double())).sum(-1).abs()
    flying = float((along > ADVICE.along).double().sum()) / len(points)
    if flying < ADVICE.flying:
        return None
    found = f"flying pixels at rims, {flying:.0%} of the points"
    thin = "torchgrasp cloud thin CLOUD --voxel 0.001 --out FILE"
    return Advice(found, f"none, for a sharper outline: {thin}", False)


def _triple(vector: Tensor, between: str = ", ") -> str:
    """Return three numbers as text: in brackets with commas, or separated by spaces for a command
    line.
    """
    numbers = between.join(f"{0.0 + round(x, 3):g}" for x in vector.tolist())
    return numbers if between == " " else f"({numbers})"
