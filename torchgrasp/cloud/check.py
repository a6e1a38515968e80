"""Refusals for a cloud that no grasp can be planned on, each with its own name."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.errors import BadArgument, SuspiciousScale, TooFewPoints
from torchgrasp.values import PointCloud

MIN_EXTENT = 0.005
"""Longest side [m] of the bounding box below which a cloud is no object for a hand."""
MAX_EXTENT = 2.0
"""Longest side [m] of the bounding box above which a cloud is no object for a hand."""
MIN_POINTS = 4
"""Least number of distinct points."""
SAME_POINT = 1e-9
"""Points closer than this share of the extent are one point, seen twice."""
LINE_RATIO = 1e-6
"""Width of a cloud over its length below which its points lie on a line, and no normal is defined."""


def check_cloud(cloud: PointCloud) -> PointCloud:
    """Return the cloud itself if grasps can be planned on it; raise the refusal that names what is wrong otherwise.

    A flat cloud (one face of a box) is accepted: its hidden side is the planner's business.

    Args:
        cloud: points [m], with or without normals and viewpoint.

    Raises:
        BadArgument: no `PointCloud`, a non-finite number, a tensor that requires a gradient (nothing here has one),
            points that all coincide or lie on a line, a normal of length zero.
        TooFewPoints: fewer than 4 distinct points.
        SuspiciousScale: the longest side of the bounding box is outside [5 mm, 2 m]; most often the unit is mm.

    >>> check_cloud(PointCloud(torch.rand(50, 3))).viewpoint is None
    True
    """
    if not isinstance(cloud, PointCloud):
        raise BadArgument("cloud", type(cloud).__name__, "a PointCloud")
    for name in ("points", "normals", "viewpoint"):
        if getattr(cloud, name) is not None and getattr(cloud, name).requires_grad:
            raise BadArgument(name, "a tensor that requires a gradient", f"a tensor without one: {name}.detach()")
    points = check_tensor("points", cloud.points, (None, 3))
    extent = float((points.amax(0) - points.amin(0)).max())
    if extent == 0.0:
        raise BadArgument("points", f"{len(points)} points that all coincide", "points of a surface")
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        raise SuspiciousScale(
            "points", f"an extent of {extent:.4g} m", f"{MIN_EXTENT:g} m to {MAX_EXTENT:g} m; {_remedy(extent)}"
        )
    remove_duplicates(cloud)
    spread = torch.linalg.svdvals((points - points.mean(0)).double())
    if float(spread[1]) < LINE_RATIO * float(spread[0]):
        raise BadArgument("points", f"{len(points)} points on one line", "points of a surface")
    if cloud.normals is not None:
        zero = torch.linalg.vector_norm(check_tensor("normals", cloud.normals, (len(points), 3)), dim=-1) == 0
        if bool(zero.any()):
            raise BadArgument("normals", f"{int(zero.sum())} normals of length zero", "normals with a direction")
    if cloud.viewpoint is not None:
        check_tensor("viewpoint", cloud.viewpoint, (3,) if cloud.viewpoint.ndim == 1 else (len(points), 3))
    return cloud


def remove_duplicates(cloud: PointCloud) -> PointCloud:
    """Return the cloud with each group of coincident points reduced to its first; the order is kept.

    Coincident copies would count as independent measurements and pull the surface towards themselves. Points are
    coincident when they are closer than 1e-9 of the cloud's extent.

    Raises:
        TooFewPoints: fewer than 4 distinct points.

    >>> len(remove_duplicates(PointCloud(torch.rand(10, 3).repeat(3, 1))))
    10
    """
    rows = _distinct_rows(cloud.points)
    if len(rows) < MIN_POINTS:
        raise TooFewPoints("points", f"{len(rows)} distinct points", f"at least {MIN_POINTS} distinct points")
    if len(rows) == len(cloud):
        return cloud
    return cloud.select(rows)


def _distinct_rows(points: Float[Tensor, "n 3"]) -> Int[Tensor, "m"]:
    """Return the ascending indices of the first point of each group of coincident points."""
    from scipy.spatial import KDTree

    points = points.detach().double()
    low = points.amin(0)
    reach = SAME_POINT * float((points.amax(0) - low).max())
    # Cells of half the reach: all points of one are coincident, and one point a cell makes few pairs however many
    # near copies there are. In a cloud without extent every point falls into cell 0.
    _, group = torch.unique(torch.floor((points - low) / max(reach / 2, 1e-300)), dim=0, return_inverse=True)
    order = torch.arange(len(group), device=group.device)
    first = torch.full_like(order, len(order)).scatter_reduce(0, group, order, "amin")
    rows = torch.sort(first[first < len(order)]).values
    pairs = KDTree(points[rows].cpu().numpy()).query_pairs(reach, output_type="ndarray")
    pairs = torch.from_numpy(pairs).to(rows.device)
    keep = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    keep[pairs[:, 1]] = False  # the first index of a pair is the smaller one
    return rows[keep]


def _remedy(extent: float) -> str:
    """Guess what went wrong with the unit, in words."""
    if extent < MIN_EXTENT:
        return "lengths are metres: is this cloud normalised, or in another unit?"
    return f"lengths are metres: is this cloud in mm (then its extent is {extent / 1000:.3g} m), or a whole scene?"
