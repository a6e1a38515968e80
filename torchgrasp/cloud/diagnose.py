"""A report on a cloud, with advice for a better one."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.cloud.neighbours import find_inliers, fit_planes, nearest
from torchgrasp.cloud.orientation import NormalCheck, compare_normals, share_facing
from torchgrasp.cloud.prepare import FACING, MAX_POINTS, clean_cloud
from torchgrasp.values import PointCloud


@dataclasses.dataclass(frozen=True)
class CloudReport(Value):
    """What a cloud is like, and what could be better."""

    points: int
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
    advice: tuple[str, ...]


def diagnose_cloud(cloud: PointCloud) -> CloudReport:
    """Measure a cloud, and advise what would improve it.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))).copies
    0
    """
    distinct = remove_duplicates(cloud)
    points = distinct.points.double()
    distance, _ = nearest(points, 9)  # the point itself and a raster's eight neighbours
    area = math.pi * distance[:, -1] ** 2  # of the disc that holds the neighbours
    check = None if distinct.normals is None else compare_normals(points, distinct.normals.double())
    if check is not None and not check.oriented:
        distinct = PointCloud(distinct.points, None, distinct.viewpoint)
    clean = clean_cloud(distinct)
    # Clean normals face the viewpoint by construction; given ones tell a whole surface.
    judged = clean if distinct.normals is None else distinct
    viewpoint = clean.viewpoint if judged.viewpoint is None else judged.viewpoint
    assert judged.normals is not None
    x, y, z = (points.amax(0) - points.amin(0)).tolist()
    report = CloudReport(
        points=len(cloud),
        size=(x, y, z),
        spacing=float(distance[:, 1].median()),
        density=float(((distance.shape[1] - 1) / area).median()),
        noise=float(fit_planes(points)[1].median()),
        copies=len(cloud) - len(distinct),
        outliers=int((~find_inliers(points)).sum()),
        normals=check,
        viewpoint=clean.viewpoint,
        viewpoint_given=cloud.viewpoint is not None,
        facing=0.0 if viewpoint is None else share_facing(judged.points, judged.normals, viewpoint),
        advice=(),
    )
    return dataclasses.replace(report, advice=tuple(_advise(report, clean)))


def format_report(report: CloudReport) -> str:
    """Return a report as lines for a terminal.

    >>> print(format_report(diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3)))).splitlines()[0])
    points      500
    """
    copies = f" ({report.copies} of them copies)" * bool(report.copies)
    sides = " x ".join(f"{1e3 * s:.0f}" for s in report.size)
    check, normals = report.normals, "none; planes are fitted"
    if check is not None and check.oriented:
        scaled = f", {check.scaled} not of unit length" * bool(check.scaled)
        normals = f"given, {int(check.flipped.sum())} look flipped{scaled}"
    elif check is not None:
        normals = f"given, of random signs ({check.opposed:.0%} of neighbours are opposite); ignored"
    viewpoint = "none; the normals tell inside from outside"
    if report.viewpoint is not None:
        cameras = report.viewpoint.reshape(-1, 3).unique(dim=0).tolist()
        places = " and ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in cameras)
        origin = "given" if report.viewpoint_given else "estimated"
        viewpoint = f"{origin}, {places} m; {report.facing:.0%} of the normals face it"
    lines = [
        ("points", f"{report.points}{copies}"),
        ("size", f"{sides} mm, if the numbers are metres"),
        ("spacing", f"{1e3 * report.spacing:.2g} mm, {1e-4 * report.density:.3g} points per cm2"),
        ("noise", f"{1e3 * report.noise:.2g} mm about local planes"),
        ("outliers", f"{report.outliers} ({100 * report.outliers / report.points:.1f} %)"),
        ("normals", normals),
        ("viewpoint", viewpoint),
    ]
    return "\n".join(f"{name:12}{text}" for name, text in [*lines, *(("advice", text) for text in report.advice)])


def _advise(report: CloudReport, clean: PointCloud) -> list[str]:
    """Return a sentence for each thing that could be better."""
    longest, outliers, given = max(report.size), report.outliers / report.points, report.viewpoint_given
    voxel = 1.0 / math.sqrt(max(report.density * MAX_POINTS / report.points, 1e-12))
    thickness, _, length = torch.linalg.svdvals((clean.points - clean.points.mean(0)).double()).sort().values.tolist()
    oriented = report.normals is not None and report.normals.oriented
    flipped = 0.0 if report.normals is None else float(report.normals.flipped.double().mean())
    away = oriented and given and report.facing < 1 - FACING
    assert clean.normals is not None
    z = clean.points[:, 2]
    layer = float(((z < float(z.min()) + 0.004) & (clean.normals[:, 2] > 0.9)).double().mean())  # a camera's noise
    table = layer >= 0.2 and float(z.max() - z.min()) >= 0.008
    thin = f"{MAX_POINTS} points are enough: voxel_downsample(cloud, {voxel:.2g}) keeps about as many"
    sparse = f"{1e3 * report.spacing:.0f} mm between points: the shape is mostly guessed"
    noisy = f"{1e3 * report.noise:.1f} mm of noise blur the normals: come closer, or average images"
    rules = [
        (longest > 0.4, f"{longest:.2f} m is large for a hand: is it a whole scene? Cut the object out"),
        (report.points > 2 * MAX_POINTS, thin),
        (outliers > 0.05, f"{outliers:.0%} of the points are outliers: cut the object out more closely"),
        (report.spacing > 0.1 * longest, sparse),
        (report.noise > 0.003, noisy),  # [m], the radius of 25 neighbours at 1 mm spacing
        (thickness < 1e-3 * length, "all points lie in one plane: the thickness is a guess; show two sides"),
        (oriented and flipped > 0.03, f"{flipped:.0%} of the normals look flipped: leave them out to fit new ones"),
        (away, "the normals point away from the camera: turn them round, or leave them out"),
        (report.normals is not None and not oriented, "the signs of the normals are random: leave them out"),
        (report.viewpoint is not None and not given, "the camera's position is a guess: give it with --viewpoint"),
        (table, f"a level plane holds the lowest {layer:.0%} of the points: if it is a table, cut it away"),
    ]
    return [sentence for applies, sentence in rules if applies]
