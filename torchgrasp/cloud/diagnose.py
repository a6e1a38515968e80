"""A report on the quality of a point cloud, with advice on how to improve it."""

import dataclasses
import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.advice import Advice, judge_pixels, judge_view
from torchgrasp.cloud.check import FEW_POINTS, remove_duplicates
from torchgrasp.cloud.neighbours import draw_rows, find_inliers, fit_local_planes, is_flat, nearest
from torchgrasp.cloud.prepare import (
    FACING,
    MAX_POINTS,
    NormalCheck,
    clean_cloud,
    compare_normals,
    share_facing,
)
from torchgrasp.cloud.viewpoint import guess_viewpoint
from torchgrasp.files import render
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud


@checked
@dataclasses.dataclass(frozen=True)
class CloudReport(Value):
    """The measured properties of a point cloud, with advice on how to improve it.

    >>> from torchgrasp import load_object
    >>> report = diagnose_cloud(load_object("jug").view)
    >>> report.points, f"{1000 * report.noise:.1f} mm", report.advice
    (1000, '0.7 mm', ())
    """

    points: int
    measured: int  # how many of them are measured
    size: tuple[float, float, float]  # sides of the box along the axes [m]
    spacing: float  # median distance to the nearest point [m]
    density: float  # median number of points per square metre
    noise: float  # median rms about local planes [m]
    copies: int  # coincident points
    outliers: int  # points far from their neighbours
    normals: NormalCheck | None  # of the given normals
    viewpoint: Float[Tensor, "*points 3"] | None  # [m]; None: a whole surface
    viewpoint_given: bool  # else it is estimated
    facing: float  # share of normals that face the viewpoint
    advice: tuple[Advice, ...]  # what forbids a grasp comes first


@checked
def diagnose_cloud(
    cloud: PointCloud,
    up: Float[Tensor, "3"] | None = None,
    table: Plane | None = None,
    stands: bool = True,
) -> CloudReport:
    """Measure a cloud, and advise what would improve it.

    In a large cloud, 50 000 points are measured; 5000 of them serve the advice on camera, vertical,
    table and bodies.

    `up` is a vector of any length that points up; None means z, unless the cloud seems to be in its
    camera's frame. Without a `table` it is assumed at the lowest point. If the object stands on
    none (`stands`), the camera may be below it. Raises the errors of `check_cloud`, and
    `BadArgument` for a vertical of length zero.

    >>> diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))).copies
    0
    """
    most = 50_000  # most points at which spacing, noise and outliers are measured
    vertical = torch.tensor([0.0, 0.0, 1.0]) if up is None else check_tensor("up", up, (3,)).cpu()
    cloud = cloud.to("cpu")
    table = None if table is None else table.to("cpu")
    if not bool(vertical.any()):
        raise BadArgument("up", "a vector of length zero", "the direction that points up")
    whole = remove_duplicates(cloud)
    points = whole.points.double()
    rows = draw_rows(len(whole), most)
    distance, _ = nearest(points, 9, rows)  # the point itself and a raster's eight neighbours
    area = math.pi * distance[:, -1] ** 2  # of the disc that holds the neighbours
    some = whole.select(rows)
    view = some.select(draw_rows(len(some), 5000))
    check = (
        None
        if view.normals is None
        else compare_normals(view.points.double(), view.normals.double())
    )
    if check is not None and not check.oriented:
        view = PointCloud(view.points, None, view.viewpoint)
    vertical = unit(vertical.double())
    guessed = view
    angle = 0.0
    if view.viewpoint is None:
        seen = view.points.double()[find_inliers(view.points.double())]
        eye, likely = guess_viewpoint(seen, fit_local_planes(seen)[0], vertical, assumed=up is None)
        if (
            view.normals is None
            or share_facing(view.points, view.normals, eye.to(view.points)) >= FACING
        ):
            guessed = dataclasses.replace(view, viewpoint=eye.to(view.points))
            angle = likely
    clean = clean_cloud(guessed)
    # Clean normals face the viewpoint by construction; given normals may be those of a whole
    # surface.
    judged = clean if view.normals is None else view
    viewpoint = clean.viewpoint if judged.viewpoint is None else judged.viewpoint
    assert judged.normals is not None
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
    if clean.viewpoint is not None and clean.viewpoint.ndim == 1:
        advice += judge_pixels(view, clean.viewpoint)
    return dataclasses.replace(report, advice=(*advice, *_advise(report, is_flat(points), angle)))


@checked
def format_report(report: CloudReport) -> str:
    """Return a report as lines for a terminal.

    >>> print(format_report(diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3)))).splitlines()[0])
    points      500
    """
    return render(Path(__file__).parent / "templates" / "report.txt.jinja", report=report)


def _advise(report: CloudReport, flat: bool, angle: float) -> list[Advice]:
    """Return advice on size, density, noise, outliers, flatness, normals, and a camera uncertain by
    `angle` [deg].
    """
    longest = max(report.size)
    outliers = report.outliers / report.points
    given = report.viewpoint_given
    voxel = 1.0 / math.sqrt(max(report.density * MAX_POINTS / report.points, 1e-12))
    check = report.normals
    flipped = 0.0 if check is None else float(check.flipped.double().mean())
    cut = "torchgrasp cloud cut CLOUD --out FILE"
    thin = f"torchgrasp cloud thin CLOUD --voxel {voxel:.2g} --out FILE"
    many = f"{report.points} points, of which {MAX_POINTS} are used"
    few = f"fewer than {FEW_POINTS} points, too few for a shape"
    sparse = f"{1e3 * report.spacing:.0f} mm between points, so that the shape is mostly guessed"
    guess = f"a camera whose position is a guess, {f'to {angle:.0f} degrees' if angle < 180 else 'on weak evidence'}"
    rules = [
        (
            longest > 0.4,
            f"a length of {longest:.2f} m, large for a hand, as of a whole scene",
            f"one object: {cut}",
        ),
        (report.points > 2 * MAX_POINTS, many, f"as many: {thin}"),
        (outliers > 0.05, f"{outliers:.0%} of the points far from the others", f"none: {thin}"),
        (report.points - report.copies < FEW_POINTS, few, "a denser cloud"),
        (report.spacing > 0.1 * longest, sparse, "a denser cloud"),
        (
            report.noise > 0.003,
            f"{1e3 * report.noise:.1f} mm of noise, which blur the normals",
            "a nearer camera",
        ),
        (flat, "points all in one plane, so that the thickness is a guess", "a view of two sides"),
        (
            bool(check and check.oriented) and flipped > 0.03,
            f"{flipped:.0%} flipped normals",
            "none: --no-normals",
        ),
        (
            bool(check and not check.oriented),
            "normals of random signs, which are ignored",
            "none: --no-normals",
        ),
        (report.viewpoint is not None and not given, guess, "--viewpoint X Y Z"),
    ]
    return [Advice(found, fix, False) for applies, found, fix in rules if applies]
