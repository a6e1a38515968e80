"""The cloud doctor: what a cloud is like, and what would make it a better one."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.cloud.neighbours import find_inliers, fit_planes, nearest
from torchgrasp.cloud.orientation import NormalCheck, check_normals
from torchgrasp.cloud.prepare import clean_cloud
from torchgrasp.values import PointCloud

NEIGHBOURS = 8
"""Neighbours that tell the density."""
ENOUGH_POINTS = 2000
"""Points of a cloud that a shape makes use of."""
MANY_OUTLIERS = 0.05
"""Share of stray points from which on the object was cut out badly."""
SPARSE = 0.1
"""Spacing over the longest side from which on a shape is guessed more than measured."""
LARGE = 0.4
"""Longest side [m] from which on a cloud is hardly one object for a hand."""
NOISY = 0.003
"""Noise [m] from which on normals are poor."""
FLAT = 1e-3
"""Thickness of a cloud over its length below which it is one face."""
FACING = 0.9
"""Share of normals that face the camera of a single view."""
TABLE_HEIGHT, TABLE_SHARE = 0.004, 0.2
"""A level plane within so many metres of the lowest point, that holds this share of the points, may be the table."""


@dataclasses.dataclass(frozen=True)
class CloudReport(Value):
    """What a cloud is like.

    `size` are the sides of its box along the axes [m], `spacing` is the median distance to the nearest point [m],
    `density` the median number of points per square metre, `noise` the median spread about local planes [m]. `copies`
    and `outliers` count points that say nothing. `normals` is None where the cloud has none. `viewpoint` is the camera
    [m], estimated unless `viewpoint_given`, and None for a whole surface; `facing` is the share of normals that face
    it. `advice` has a sentence for each thing that could be better.
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
    """Measure a cloud, and say what would make it a better one for grasping; nothing is changed.

    Args:
        cloud: points [m] of one object, with or without normals and viewpoint.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`: no grasp can be planned on such a cloud.

    >>> diagnose_cloud(PointCloud(0.1 * torch.rand(500, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))).copies
    0
    """
    cloud = check_cloud(cloud)
    distinct = remove_duplicates(cloud)
    points = distinct.points.double()
    distance, _ = nearest(points, NEIGHBOURS + 1)
    area = math.pi * distance[:, -1] ** 2  # of the disc that holds the neighbours
    given = None if cloud.normals is None else check_normals(cloud)
    if given is not None and not given.oriented:
        distinct = PointCloud(distinct.points, None, distinct.viewpoint)
    clean = clean_cloud(distinct)
    assert clean.normals is not None
    # Given normals tell a whole surface; those of the clean cloud were turned towards the viewpoint.
    told = clean if distinct.normals is None else distinct
    eye = clean.viewpoint if told.viewpoint is None else told.viewpoint
    facing = 0.0
    if eye is not None and told.normals is not None:
        facing = float((((eye - told.points) * told.normals).sum(-1) > 0).double().mean())
    side = (points.amax(0) - points.amin(0)).tolist()
    report = CloudReport(
        points=len(cloud),
        size=(side[0], side[1], side[2]),
        spacing=float(distance[:, 1].median()),
        density=float(((distance.shape[1] - 1) / area).median()),
        noise=float(fit_planes(points)[1].median()),
        copies=len(cloud) - len(distinct),
        outliers=int((~find_inliers(points)).sum()),
        normals=given,
        viewpoint=clean.viewpoint,
        viewpoint_given=cloud.viewpoint is not None,
        facing=facing,
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
        ("strays", f"{report.outliers} ({100 * report.outliers / report.points:.1f} %)"),
        ("normals", _describe_normals(report.normals)),
        ("viewpoint", _describe_viewpoint(report)),
    ]
    return "\n".join([f"{name:12}{text}" for name, text in lines] + [f"advice      {text}" for text in report.advice])


def _describe_normals(found: NormalCheck | None) -> str:
    """Describe given normals in words."""
    if found is None:
        return "none; planes are fitted"
    if not found.oriented:
        return f"given, of random signs ({100 * found.opposed:.0f} % of neighbours are opposite); left aside"
    scaled = f", {found.scaled} not of unit length" * bool(found.scaled)
    return f"given, {int(found.flipped.sum())} look flipped{scaled}"


def _describe_viewpoint(report: CloudReport) -> str:
    """Describe the viewpoint in words."""
    if report.viewpoint is None:
        return "none; the normals tell inside from outside"
    eyes = report.viewpoint.reshape(-1, 3).unique(dim=0).tolist()
    places = " and ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in eyes)
    origin = "given" if report.viewpoint_given else "estimated"
    return f"{origin}, {places} m; {100 * report.facing:.0f} % of the normals face it"


def _advise(report: CloudReport, clean: PointCloud) -> list[str]:
    """Return a sentence for each thing that could be better."""
    advice: list[str] = []
    longest, outliers = max(report.size), report.outliers / report.points
    if longest > LARGE:
        advice.append(f"{longest:.2f} m is large for a hand: is it a whole scene? Cut the object out")
    if report.points > 2 * ENOUGH_POINTS:
        voxel = 1.0 / math.sqrt(max(report.density * ENOUGH_POINTS / report.points, 1e-12))
        advice.append(f"{ENOUGH_POINTS} points are enough: thin_cloud(cloud, {voxel:.2g}) keeps about so many")
    if outliers > MANY_OUTLIERS:
        advice.append(f"{100 * outliers:.0f} % of the points stray: cut the object out more closely")
    if report.spacing > SPARSE * longest:
        advice.append(f"a point every {1e3 * report.spacing:.0f} mm is sparse: the shape is mostly guessed")
    if report.noise > NOISY:
        advice.append(f"{1e3 * report.noise:.1f} mm of noise blur the normals: come closer, or average several images")
    spread = torch.linalg.svdvals((clean.points - clean.points.mean(0)).double())
    if float(spread[2]) < FLAT * float(spread[0]):
        advice.append("all points lie in one plane: the thickness is a guess; take a view that shows two sides")
    if report.normals is not None and report.normals.oriented:
        flipped = float(report.normals.flipped.double().mean())
        if flipped > 0.03:
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
    """Tell if the lowest points look like a table top: level, seen from above, and many."""
    assert clean.normals is not None
    z = clean.points[:, 2]
    low = (z < float(z.min()) + TABLE_HEIGHT) & (clean.normals[:, 2] > 0.9)
    share = float(low.double().mean())
    if share < TABLE_SHARE or float(z.max() - z.min()) < 2 * TABLE_HEIGHT:
        return []
    return [f"a level plane at the bottom holds {100 * share:.0f} % of the points: if it is the table, cut it away"]
