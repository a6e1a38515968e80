"""From what the camera saw to what a shape is fitted to."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import checked
from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.cloud.neighbours import find_inliers, fit_planes, fit_quadrics
from torchgrasp.cloud.orientation import compare_normals, guess_viewpoint, orient_normals, share_facing
from torchgrasp.errors import BadArgument, TooFewPoints
from torchgrasp.geometry.linalg import unit
from torchgrasp.values import PointCloud

FACING = 0.9
"""Least share of a view's normals that face the camera: noise turns some at the rim."""
MAX_POINTS = 2000
"""Most points that a shape is fitted to: they bound the time of its selection."""
MAX_VIEWS, MIN_VIEW_POINTS = 16, 10
"""Most cameras of a merged cloud, each of which costs an outline, and fewest points that give one."""


@dataclasses.dataclass(frozen=True)
class PreparedCloud(Value):
    """A cloud that `prepare_cloud` has checked: later stages check nothing.

    >>> from torchgrasp import load_object
    >>> prepare_cloud(load_object("jug").view, torch.Generator().manual_seed(0)).one_sided
    True
    """

    cloud: PointCloud  # distinct points [m] with outward normals, in the given dtype
    points: Float[Tensor, "n 3"]  # at most 2000 of them, in float64
    normals: Float[Tensor, "n 3"]  # theirs, of unit length
    viewpoint: Float[Tensor, "*views 3"] | None  # the camera [m] of all `points`, or of each; None: unknown
    frustum: Float[Tensor, "*views 4 3"] | None  # normals of the sides of its view; None: unknown

    @property
    def one_sided(self) -> bool:
        """Whether the cloud is a view and has a hidden side."""
        return self.viewpoint is not None and share_facing(self.points, self.normals, self.viewpoint) >= FACING


@checked
def prepare_cloud(cloud: PointCloud, generator: torch.Generator, clean: bool = True) -> PreparedCloud:
    """Check a cloud, and return what a shape is fitted to.

    Normals of random signs are ignored: they make a view look whole. The viewpoint is ignored if `clean` and the
    given normals do not face it: the surface is whole.

    Args:
        cloud: points [m] of one or several views of one object.
        generator: draws 2000 of the points if there are more.
        clean: remove outliers, fit all normals anew and estimate a missing viewpoint; else fit missing normals only.

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`; more than 16 cameras.
        TooFewPoints: see `check_cloud`; fewer than 10 points of one camera of several.

    >>> from torchgrasp import load_object
    >>> prepared = prepare_cloud(load_object("jug").view, torch.Generator().manual_seed(0))
    >>> prepared.normals.dtype, prepared.viewpoint is not None
    (torch.float64, True)
    """
    cloud = remove_duplicates(cloud)
    points, normals, viewpoint = cloud.points, cloud.normals, cloud.viewpoint
    if viewpoint is not None and viewpoint.ndim == 2:
        _, count = viewpoint.unique(dim=0, return_counts=True)
        if len(count) > MAX_VIEWS:
            raise BadArgument("viewpoint", f"{len(count)} different cameras", f"at most {MAX_VIEWS}")
        if int(count.min()) < MIN_VIEW_POINTS:
            raise TooFewPoints("points", f"{count.min()} points of one view", f"at least {MIN_VIEW_POINTS} of each")
    if normals is not None and not compare_normals(points.double(), normals.double()).oriented:
        normals = None
    if clean and normals is not None and viewpoint is not None and share_facing(points, normals, viewpoint) < FACING:
        viewpoint = None
    cloud = dataclasses.replace(cloud, normals=normals, viewpoint=viewpoint)
    if clean or normals is None:
        cloud = _fit_normals(cloud, clean)
    precise = cloud.to(torch.float64)
    if clean and precise.viewpoint is None:
        guess = guess_viewpoint(precise.points, fit_planes(precise.points)[0]).to(points.dtype)
        precise = dataclasses.replace(precise, viewpoint=guess.double())
    if len(precise) > MAX_POINTS:
        precise = precise.select(torch.randperm(len(precise), generator=generator)[:MAX_POINTS].to(points.device))
    assert precise.normals is not None
    return PreparedCloud(cloud, precise.points, unit(precise.normals), precise.viewpoint, precise.frustum)


@checked
def estimate_normals(cloud: PointCloud) -> PointCloud:
    """Return a cloud without copies, with outward normals of local quadrics.

    Outward is towards the viewpoint (by default that of `estimate_viewpoint`), or else the side of given normals.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> estimate_normals(PointCloud(torch.rand(90, 3), viewpoint=torch.tensor([0.5, 0.5, 9.0]))).normals.shape
    torch.Size([90, 3])
    """
    return _fit_normals(remove_duplicates(cloud), clean=False)


@checked
def clean_cloud(cloud: PointCloud) -> PointCloud:
    """Return the points without outliers, on their local quadrics, with outward normals.

    Outliers are those of `remove_outliers`, and points over 4.5 median rms from their quadric.

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`.
        TooFewPoints: fewer than 4 points, before or after cleaning.

    >>> len(clean_cloud(PointCloud(torch.rand(500, 3), viewpoint=torch.tensor([0.5, 0.5, 9.0])))) <= 500
    True
    """
    return _fit_normals(remove_duplicates(cloud), clean=True)


def _fit_normals(cloud: PointCloud, clean: bool) -> PointCloud:
    """Fit outward normals to distinct points, and clean them if asked."""
    if clean:
        cloud = cloud.select(find_inliers(cloud.points.double()))
    points = cloud.points
    feet, normals, rms = fit_quadrics(points.double())
    if clean:
        offset = torch.linalg.vector_norm(points.double() - feet, dim=-1)
        keep = offset <= 4.5 * rms.median() + 1e-12  # beyond Gaussian noise
        cloud, points, normals = cloud.select(keep), feet.to(points.dtype)[keep], normals[keep]
    viewpoint = cloud.viewpoint
    if viewpoint is None and cloud.normals is not None:
        outward = cloud.normals.double()
    else:
        if viewpoint is None:
            viewpoint = guess_viewpoint(points.double(), normals).to(points.dtype)
        outward = viewpoint.double() - points.double()
    normals = orient_normals(normals, outward).to(points.dtype)
    return dataclasses.replace(cloud, points=points, normals=normals, viewpoint=viewpoint)
