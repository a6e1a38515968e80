"""A report on a cloud, and advice that would make it a better one for grasping."""

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

DENSITY_NEIGHBOURS = 8
"""Neighbours whose disc gives the density: enough to average a raster's gaps."""
MANY_OUTLIERS = 0.05
"""Share of outliers above which the object was cut out badly; flying pixels at a rim are fewer."""
SPARSE = 0.1
"""Spacing over the longest side above which a shape is guessed more than measured: ten points a side."""
LARGE = 0.4
"""Longest side [m] of what a hand of some 20 cm can hold."""
NOISY = 0.003
"""Noise [m] above which normals are poor: as much as the spread of 25 neighbours at 1 mm spacing."""
FLAT = 1e-3
"""Thickness over length below which a cloud is one face: less than a camera's noise."""
FLIPPED = 0.03
"""Share of flipped normals that edges and rims of good clouds explain."""
TABLE_HEIGHT, TABLE_SHARE = 0.004, 0.2
"""The lowest 4 mm, a camera's noise either way, hold this share of the points where the table was not cut away."""


@dataclasses.dataclass(frozen=True)
class CloudReport(Value):
    """What a cloud is like.

    Args:
        points: number of points.
        size: sides of the box along the axes [m].
        spacing: median distance to the nearest point [m].
        density: median number of points per square metre.
        noise: median rms about local planes [m].
        copies: number of coincident points.
        outliers: number of points far from their neighbours.
        normals: check of the given normals; None: none are given.
        viewpoint: camera [m]; None for a whole surface.
        viewpoint_given: whether the viewpoint is given, not estimated.
        facing: share of normals that face the viewpoint.
        advice: a sentence for each thing that could be better.
    """

    points: int
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
    advice: tuple[str, ...]


def diagnose_cloud(cloud: PointCloud) -> CloudReport:
    """Measure a cloud and advise what would make it a better one for grasping; nothing is changed.

    Args:
        cloud: points [m] of one object, with or without normals and viewpoint.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))).copies
    0
    """
    distinct = remove_duplicates(cloud)
    points = distinct.points.double()
    distance, _ = nearest(points, DENSITY_NEIGHBOURS + 1)
    area = math.pi * distance[:, -1] ** 2  # of the disc that holds the neighbours
    check = None if distinct.normals is None else compare_normals(points, distinct.normals.double())
    if check is not None and not check.oriented:
        distinct = PointCloud(distinct.points, None, distinct.viewpoint)
    clean = clean_cloud(distinct)
    # Normals of the clean cloud face the viewpoint by construction; given ones can tell a whole surface.
    judged = clean if distinct.normals is None else distinct
    viewpoint = clean.viewpoint if judged.viewpoint is None else judged.viewpoint
    assert judged.normals is not None
    side = (points.amax(0) - points.amin(0)).tolist()
    report = CloudReport(
        points=len(cloud),
        size=(side[0], side[1], side[2]),
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
    lines = [
        ("points", f"{report.points}{copies}"),
        ("size", f"{sides} mm, if the numbers are metres"),
        ("spacing", f"{1e3 * report.spacing:.2g} mm, {1e-4 * report.density:.3g} points per cm2"),
        ("noise", f"{1e3 * report.noise:.2g} mm about local planes"),
        ("outliers", f"{report.outliers} ({100 * report.outliers / report.points:.1f} %)"),
        ("normals", _describe_normals(report.normals)),
        ("viewpoint", _describe_viewpoint(report)),
    ]
    return "\n".join([f"{name:12}{text}" for name, text in lines] + [f"advice      {text}" for text in report.advice])


def _describe_normals(check: NormalCheck | None) -> str:
    """Describe given normals in words."""
    if check is None:
        return "none; planes are fitted"
    if not check.oriented:
        return f"given, of random signs ({100 * check.opposed:.0f} % of neighbours are opposite); ignored"
    scaled = f", {check.scaled} not of unit length" * bool(check.scaled)
    return f"given, {int(check.flipped.sum())} look flipped{scaled}"


def _describe_viewpoint(report: CloudReport) -> str:
    """Describe the viewpoint in words."""
    if report.viewpoint is None:
        return "none; the normals tell inside from outside"
    cameras = report.viewpoint.reshape(-1, 3).unique(dim=0).tolist()
    places = " and ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in cameras)
    origin = "given" if report.viewpoint_given else "estimated"
    return f"{origin}, {places} m; {100 * report.facing:.0f} % of the normals face it"


def _advise(report: CloudReport, clean: PointCloud) -> list[str]:
    """Return a sentence for each thing that could be better."""
    advice: list[str] = []
    longest, outliers = max(report.size), report.outliers / report.points
    if longest > LARGE:
        advice.append(f"{longest:.2f} m is large for a hand: is it a whole scene? Cut the object out")
    if report.points > 2 * MAX_POINTS:
        voxel = 1.0 / math.sqrt(max(report.density * MAX_POINTS / report.points, 1e-12))
        advice.append(f"{MAX_POINTS} points are enough: voxel_downsample(cloud, {voxel:.2g}) keeps about as many")
    if outliers > MANY_OUTLIERS:
        advice.append(f"{100 * outliers:.0f} % of the points are outliers: cut the object out more closely")
    if report.spacing > SPARSE * longest:
        advice.append(f"a point every {1e3 * report.spacing:.0f} mm is sparse: the shape is mostly guessed")
    if report.noise > NOISY:
        advice.append(f"{1e3 * report.noise:.1f} mm of noise blur the normals: come closer, or average several images")
    spread = torch.linalg.svdvals((clean.points - clean.points.mean(0)).double())
    if float(spread[2]) < FLAT * float(spread[0]):
        advice.append("all points lie in one plane: the thickness is a guess; take a view that shows two sides")
    if report.normals is not None and report.normals.oriented:
        flipped = float(report.normals.flipped.double().mean())
        if flipped > FLIPPED:
            advice.append(f"{100 * flipped:.0f} % of the normals look flipped: leave them out, new ones are fitted")
        if report.viewpoint_given and report.facing < 1 - FACING:
            advice.append("the normals point away from the camera: turn them round, or leave them out")
    if report.normals is not None and not report.normals.oriented:
        advice.append("the signs of the normals are random: leave them out, or have the program orient them")
    if not report.viewpoint_given and report.viewpoint is not None:
        advice.append("the camera's position is a guess: give it (--viewpoint, or a line in the file)")
    advice += _advise_on_table(clean)
    return advice


def _advise_on_table(clean: PointCloud) -> list[str]:
    """Return advice if the lowest points look like a table: level, facing up, and many."""
    assert clean.normals is not None
    z = clean.points[:, 2]
    low = (z < float(z.min()) + TABLE_HEIGHT) & (clean.normals[:, 2] > 0.9)
    share = float(low.double().mean())
    if share < TABLE_SHARE or float(z.max() - z.min()) < 2 * TABLE_HEIGHT:
        return []
    return [f"a level plane at the bottom holds {100 * share:.0f} % of the points: if it is the table, cut it away"]
