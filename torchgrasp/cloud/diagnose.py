"""A report on the quality of a point cloud, with advice on how to improve it."""

import dataclasses
import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.advice import Advice, judge_view
from torchgrasp.cloud.check import (
    FEW_POINTS,
    coordinate_step,
    describe_step,
    remove_duplicates,
)
from torchgrasp.cloud.neighbours import (
    Neighbours,
    draw_rows,
    find_inliers,
    fit_local_planes,
    nearest,
)
from torchgrasp.cloud.pixels import PIXELS, find_pixel_camera
from torchgrasp.cloud.prepare import (
    ACROSS,
    FACING,
    MAX_POINTS,
    NormalCheck,
    clean_cloud,
    compare_normals,
    lie_across,
    share_facing,
)
from torchgrasp.cloud.viewpoint import guess_viewpoint
from torchgrasp.files import render
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import Vector, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class DiagnosisNumbers:
    """Numbers of points that are measured in a cloud, and bounds beyond which there is advice."""

    measured: int = 50_000
    """Greatest number of points at which spacing, noise and outliers are measured."""
    viewed: int = 5000
    """Greatest number of the measured points that serve the advice on camera, vertical, table and
    bodies.
    """
    neighbours: int = 9
    """Number of nearest points for the density: the point and a raster's eight neighbours."""
    least: float = 1e-12
    """Least density [1/m2] by which the size of a voxel is found, so that it is finite."""
    long: float = 0.4
    """Greatest length [m] of an object without advice: a longer one is not for a hand."""
    outliers: float = 0.05
    """Greatest share of outliers without advice."""
    sparse: float = 0.1
    """Greatest spacing of the points, as a share of the cloud's length, without advice."""
    noise: float = 0.003
    """Greatest noise [m] without advice."""
    flipped: float = 0.03
    """Greatest share of flipped normals without advice."""


DIAGNOSIS = DiagnosisNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class CloudReport(Value):
    """The measured properties of a point cloud, with advice on how to improve it; `diagnose_cloud`
    makes it.

    Attributes:
        points: number of all points.
        measured: number of the points at which spacing, density, noise and outliers are measured.
        size: sides (x, y, z) [m] of the cloud's bounding box along the axes.
        spacing: median distance [m] from a point to its nearest neighbour.
        density: median number of points on a square metre of surface [1/m2].
        noise: median rms distance [m] of neighbouring points from the plane that is fitted to them.
        copies: number of points that coincide with an earlier point.
        outliers: estimated number of points far from their neighbours.
        normals: agreement of the given normals among neighbours (`NormalCheck`); None without
            normals.
        viewpoint: position (3,) [m] of the camera. For a cloud of several cameras it is (v, 3), the
            camera of each of v measured points. None for a surface that is seen from all sides.
        viewpoint_given: True if the viewpoint was given; False if it is estimated.
        facing: share [0 to 1] of the normals that face the viewpoint; 0 without one.
        advice: faults and their fixes; refusals come first.

    >>> from torchgrasp import load_object
    >>> report = diagnose_cloud(load_object("jug").view)
    >>> report.points, f"{1000 * report.noise:.1f} mm", report.advice
    (1000, '0.7 mm', ())
    """

    points: int
    measured: int
    size: tuple[float, float, float]
    spacing: float
    density: float
    noise: float
    copies: int
    outliers: int
    normals: NormalCheck | None
    viewpoint: Float[Tensor, "*points 3"] | None
    viewpoint_given: bool
    facing: float
    advice: tuple[Advice, ...]


@checked
def diagnose_cloud(
    cloud: PointCloud,
    up: Vector | None = None,
    table: Plane | None = None,
    stands: bool = True,
) -> CloudReport:
    """Return the measured properties of a cloud, with advice on what would improve it.

    At most 50,000 points (`DIAGNOSIS.measured`) are measured. With at most 5000 of them
    (`DIAGNOSIS.viewed`), camera, vertical and table are checked, and a second body is sought.

    Args:
        cloud: the points [m].
        up: vector (3,) of any length that points up. None means z. If z then points forward, as
            in a camera's frame, the advice asks for another `up`.
        table: the plane under the object; None means a level plane at the lowest point.
        stands: whether the object stands on a table. False means an object in the air, whose camera
            may be below it.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a vector of length zero, or a
    camera over 50 m away.

    >>> cloud = PointCloud(0.1 * torch.rand(500, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))
    >>> diagnose_cloud(cloud).copies
    0
    """
    vertical = torch.tensor([0.0, 0.0, 1.0]) if up is None else check_tensor("up", up, (3,)).cpu()
    cloud = cloud.to("cpu")
    table = None if table is None else table.to("cpu")
    if not vertical.any():
        raise BadArgument("up", "a vector of length zero", "the direction that points up")
    vertical = unit(vertical.double())
    whole = remove_duplicates(cloud)
    points = whole.points.double()
    rows = draw_rows(len(whole), DIAGNOSIS.measured)
    some = whole.select(rows)

    view = some.select(draw_rows(len(some), DIAGNOSIS.viewed))
    check = None
    across = False
    if view.normals is not None:
        across = lie_across(view.points.double(), view.normals.double())
        check = compare_normals(view.points.double(), view.normals.double())
        if not check.oriented:
            view = PointCloud(view.points, None, view.viewpoint)
    guessed, angle = _guess_camera(whole, view, vertical, assumed=up is None)
    clean = clean_cloud(guessed)
    # Clean normals face the viewpoint by construction; given normals may be those of a whole
    # surface.
    judged = clean if view.normals is None else view
    viewpoint = clean.viewpoint if judged.viewpoint is None else judged.viewpoint
    assert judged.normals is not None

    distance, _ = nearest(points, DIAGNOSIS.neighbours, rows)  # (m, 9)
    area = math.pi * distance[:, -1] ** 2  # of the disc that holds the neighbours
    x, y, z = (points.amax(0) - points.amin(0)).tolist()
    report = CloudReport(
        points=len(cloud),
        measured=len(rows),
        size=(x, y, z),
        spacing=float(distance[:, 1].median()),
        density=float(((distance.shape[1] - 1) / area).median()),
        noise=float(fit_local_planes(points, rows)[1].median()),
        copies=len(cloud) - len(whole),
        outliers=round(len(points) * float((~find_inliers(points, rows)).double().mean())),
        normals=check,
        viewpoint=clean.viewpoint,
        viewpoint_given=cloud.viewpoint is not None,
        facing=0.0 if viewpoint is None else share_facing(judged.points, judged.normals, viewpoint),
        advice=(),
    )
    advice = judge_view(view, clean, vertical, table, stands)
    flat = Neighbours(points).flat
    return dataclasses.replace(
        report,
        advice=(*advice, *_advise(report, flat, angle, across, coordinate_step(points))),
    )


def _guess_camera(
    whole: PointCloud, view: PointCloud, up: Vector, assumed: bool
) -> tuple[PointCloud, float]:
    """Return a view with its viewpoint, estimated if it is unknown, and the angle [deg] of its
    uncertainty.

    The pixels of the `whole` cloud show it, of which `view` has only some, or it is guessed. One
    that too few of the given normals face is dropped.
    """
    if view.viewpoint is not None:
        return view, 0.0
    eye = find_pixel_camera(whole.points, up)
    angle = PIXELS.error
    if eye is None:
        points = view.points.double()
        seen = points[find_inliers(points)]
        eye, angle = guess_viewpoint(seen, fit_local_planes(seen)[0], up, assumed)
    eye = eye.to(view.points)
    if view.normals is not None and share_facing(view.points, view.normals, eye) < FACING:
        return view, 0.0
    return dataclasses.replace(view, viewpoint=eye), angle


@checked
def format_report(report: CloudReport) -> str:
    """Return the report of `diagnose_cloud` as a text of several lines, for a terminal.

    >>> print(format_report(diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3)))).splitlines()[0])
    points      500
    """
    return render(Path(__file__).parent / "templates" / "report.txt.jinja", report=report)


def _advise(
    report: CloudReport, flat: bool, angle: float, across: bool, step: float
) -> list[Advice]:
    """Return advice on size, density, noise, outliers, flatness, normals, and a camera uncertain by
    `angle` [deg].

    `across` is whether the normals lie across the surface. `step` [m] is that to which all
    coordinates are rounded, or 0.
    """
    longest = max(report.size)
    outliers = report.outliers / report.points
    density = report.density * MAX_POINTS / report.points
    voxel = 1.0 / math.sqrt(max(density, DIAGNOSIS.least))
    check = report.normals
    oriented = check is None or check.oriented
    flipped = 0.0 if check is None else float(check.flipped.double().mean())
    cut = "torchgrasp cloud cut CLOUD --out FILE"
    thin = f"torchgrasp cloud thin CLOUD --voxel {voxel:.2g} --out FILE"
    scene = f"a length of {longest:.2f} m, large for a hand, as of a whole scene"
    many = f"{report.points} points, of which {MAX_POINTS} are used"
    far = f"{outliers:.0%} of the points far from the others"
    few = f"fewer than {FEW_POINTS} points, too few for a shape"
    sparse = f"{1e3 * report.spacing:.0f} mm between points, so that the shape is mostly guessed"
    blurred = f"{1e3 * report.noise:.1f} mm of noise, which blur the normals"
    plane = "points all in one plane, so that the thickness is a guess"
    turned = f"{flipped:.0%} flipped normals"
    sure = f"to {angle:.0f} degrees" if angle < 180.0 else "on weak evidence"
    guess = f"a camera whose position is a guess, {sure}"
    guessed = report.viewpoint is not None and not report.viewpoint_given
    guessed &= angle > PIXELS.error
    rules = [
        (longest > DIAGNOSIS.long, scene, f"one object: {cut}"),
        (report.points > 2 * MAX_POINTS, many, f"as many: {thin}"),
        (outliers > DIAGNOSIS.outliers, far, f"none: {thin}"),
        (report.points - report.copies < FEW_POINTS, few, "a denser cloud"),
        (report.spacing > DIAGNOSIS.sparse * longest, sparse, "a denser cloud"),
        (report.noise > DIAGNOSIS.noise, blurred, "a nearer camera"),
        (step > 0, describe_step(step), "more digits, or less an offset"),
        (flat, plane, "a view of two sides"),
        (across, f"normals {ACROSS}", "outward ones, or none: --no-normals"),
        (oriented and flipped > DIAGNOSIS.flipped, turned, "none: --no-normals"),
        (not oriented, "normals of random signs, which are ignored", "none: --no-normals"),
        (guessed, guess, "--viewpoint X Y Z"),
    ]
    return [Advice(found, fix, False) for applies, found, fix in rules if applies]
