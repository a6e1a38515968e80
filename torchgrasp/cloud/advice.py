"""Advice on a point cloud: each fault that was found, with the command that fixes it."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import check_foot
from torchgrasp.cloud.neighbours import find_inliers, nearest
from torchgrasp.cloud.parts import LAYER, find_second_body
from torchgrasp.cloud.prepare import FACING, share_facing
from torchgrasp.cloud.viewpoint import UNSEEN, share_unseen
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, Vector, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SUPPORTS, find_supports
from torchgrasp.values.planning import PointCloud

FEWEST = 50  # fewest points that show whether a camera is right, or whether pixels fly off rims


@dataclasses.dataclass(frozen=True)
class Advice(Value):
    """A fault of a point cloud: the fault `found`, its `fix`, and whether planning is `refused`
    because of it.

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
    """Return advice on a cloud's camera, vertical and table, and on other bodies left in; refusals
    come first.

    `clean` is the cloud cleaned, with outward normals and perhaps an estimated viewpoint. A `table`
    of None is assumed at the lowest point. `stands` tells whether the object stands on a table.
    """
    assert clean.normals is not None
    points = clean.points.double()
    normals = clean.normals.double()
    given = cloud.viewpoint is not None
    eye = None if clean.viewpoint is None else clean.viewpoint.double()
    facing = 1.0
    if cloud.viewpoint is not None and cloud.normals is not None:
        facing = share_facing(cloud.points, cloud.normals, cloud.viewpoint)
    advice = _judge_facing(facing)
    if not advice and eye is not None:
        advice = _judge_camera(clean, given)
    # An estimate may be on the wrong side of a table, but not where it is the origin of a camera's
    # frame.
    trusted = eye is not None and facing >= FACING and (given or not bool(eye.any()))
    support = _find_support(
        points, eye.reshape(-1, 3).mean(0) if trusted and eye is not None else None, up
    )
    if stands and table is not None:
        try:
            check_foot(cloud, table)
        except BadArgument as error:
            found = f"a table that contradicts the cloud, {error.found}"
            advice.append(Advice(found, f"--table, {error.allowed}", True))
    if stands and eye is not None and facing >= FACING:
        advice += _judge_height(points, eye, given, up, table, support and support[0])
        down = float((normals @ up < -0.5).double().mean())
        if (
            given and not any(a.refused for a in advice) and down > 0.15
        ):  # a camera above a table sees fewer
            found = f"a vertical {_triple(up)} that {down:.0%} of the visible normals contradict: they point down"
            advice.append(Advice(found, "the vertical of the cloud's frame: --up X Y Z", False))
    if support is not None:
        normal = support[0].normal
        found = f"a plane under the object, a table left in, with {support[1]:.0%} of the points"
        turn = f" --up {_triple(normal, ' ')}, its normal," if float(normal @ up) < 0.97 else ""
        advice.append(
            Advice(found, f"the object alone: torchgrasp cloud cut CLOUD{turn} --out FILE", True)
        )
    body = find_second_body(points, up, float(nearest(points, 2)[0][:, -1].median()))
    if body is not None:
        found = f"two bodies that stand apart, the second of {float(body.double().mean()):.0%} of the points"
        x, y, z = points[~body].mean(0).tolist()
        fix = f"one object: torchgrasp cloud cut CLOUD --point {x:.3f} {y:.3f} {z:.3f} --out FILE"
        advice.append(Advice(found, fix, True))
    return sorted(advice, key=lambda a: not a.refused)


def _find_support(points: Points, eye: Vector | None, up: Vector) -> tuple[Plane, float] | None:
    """Return the plane of a table that was left in the cloud, and its share of the points; None if
    there is none.
    """
    for sky, width in ((up, 0.06), *([(None, SUPPORTS.least_width)] if eye is not None else [])):
        try:
            plane = find_supports(points, eye, sky, least_width=width)[0].plane
        except NoSupport:
            continue
        return plane, float((plane.height(points).abs() < LAYER).double().mean())
    return None


def _judge_facing(facing: float) -> list[Advice]:
    """Return advice if too few normals face the camera: nearly all do in a single view, half on a
    whole surface.
    """
    if facing < 1 - FACING:
        fix = "outward normals, or none (--no-normals), or the true --viewpoint X Y Z"
        return [Advice(f"normals of which {1 - facing:.0%} point away from the camera", fix, True)]
    if facing < FACING:
        found = f"a viewpoint that {facing:.0%} of the normals face: it is ignored, the cloud taken for a whole surface"
        return [
            Advice(found, "the true --viewpoint X Y Z of a single view, or --no-viewpoint", False)
        ]
    return []


def _judge_camera(clean: PointCloud, given: bool) -> list[Advice]:
    """Return advice if a camera, `given` by the user or else estimated, cannot have seen the points
    of its view.
    """
    worst = (0.0, 0.0)
    for view in clean.split_views():
        if view.viewpoint is not None and view.normals is not None and len(view) >= FEWEST:
            shares = share_unseen(
                view.points.double(), view.normals.double(), view.viewpoint.double()
            )
            worst = max(worst, shares, key=lambda s: max(UNSEEN.excess(s)))
    edge_on, behind = worst
    if max(UNSEEN.excess(worst)) <= 1:
        return []
    what = f"has {behind:.0%} of them behind others"
    if UNSEEN.excess(worst)[0] > UNSEEN.excess(worst)[1]:
        what = f"sees {edge_on:.0%} of them edge-on"
    if given:
        found = f"a viewpoint that the points contradict: a camera there {what}"
        return [
            Advice(
                found, "the true camera, --viewpoint X Y Z, or an estimate, --no-viewpoint", True
            )
        ]
    found = f"an estimated camera that the points contradict: it {what}"
    return [Advice(found, "a single view with its --viewpoint X Y Z, or outward normals", False)]


def _judge_height(
    points: Points,
    eye: Float[Tensor, "*views 3"],
    given: bool,
    up: Vector,
    table: Plane | None,
    ground: Plane | None,
) -> list[Advice]:
    """Return advice if the camera is below the table, or below the lowest point if the table is
    unknown.
    """
    lowest = float((points @ up).min()) if table is None else table.offset
    normal = up if table is None else table.normal.double()
    below = lowest - float((eye @ normal).min())
    if below < 0:
        return []
    level = "the lowest point" if table is None else "the table"
    place = f"{below:.2f} m below {level} along the vertical {_triple(normal)}"
    centre = points.mean(0)
    forward = (
        float(centre[2]) > 0.6 * float(torch.linalg.vector_norm(centre)) and float(up[2]) > 0.9
    )
    if forward and not bool(eye.any()):
        axis = torch.tensor([0.0, -1.0, 0.0])
        why = "for a level camera"
        if ground is not None:
            axis = ground.normal
            why = "the normal of the plane in it"
        found = f"a cloud in its camera's frame, whose z axis points forward: the camera is {place}"
        options = f"{'' if given else '--viewpoint 0 0 0 '}--up {_triple(axis, ' ')}"
        fix = f"a vertical that points up: {options} ({why}), or --camera-pose FILE"
        fix += "" if given else "; or, if z points up, --up 0 0 1"
        return [Advice(found, fix, True)]
    if not given:
        return [Advice(f"an estimated camera {place}", "the true camera: --viewpoint X Y Z", False)]
    fix = f"a camera above it: --viewpoint X Y Z; or, if {_triple(up)} points down, --up {_triple(-up, ' ')}"
    return [Advice(f"a camera {place}", fix, True)]


def judge_pixels(cloud: PointCloud, viewpoint: Vector) -> list[Advice]:
    """Return advice if many outliers are flying pixels: they lie before or behind other points on
    camera rays.
    """
    points = cloud.points.double()
    inlier = find_inliers(points)
    if bool(inlier.all()) or int(inlier.sum()) < FEWEST:
        return []
    stray = points[~inlier]
    _, index = spatial.KDTree(points[inlier].numpy()).query(stray.numpy())
    away = stray - points[inlier][torch.from_numpy(index)]
    along = (unit(away) * unit(stray - viewpoint.double())).sum(-1).abs()
    flying = float((along > 0.8).double().sum()) / len(points)
    if flying < 0.02:
        return []
    found = f"flying pixels at rims, {flying:.0%} of the points"
    return [
        Advice(
            found,
            "none, for a sharper outline: torchgrasp cloud thin CLOUD --voxel 0.001 --out FILE",
            False,
        )
    ]


def _triple(vector: Tensor, between: str = ", ") -> str:
    """Return three numbers as text: in brackets with commas, or separated by spaces for a command
    line.
    """
    numbers = between.join(f"{0.0 + round(x, 3):g}" for x in vector.tolist())
    return numbers if between == " " else f"({numbers})"
