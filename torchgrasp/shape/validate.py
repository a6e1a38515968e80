"""What a shape can be fitted to: arguments, cameras and views that are refused before any work."""

import math
from typing import get_args

from torchgrasp.errors import BadArgument, TooFewPoints
from torchgrasp.shape.completion.silhouette import share_behind
from torchgrasp.shape.kernel import Kernel, KernelName, kernel_by_name
from torchgrasp.shape.select import Criterion
from torchgrasp.values import PointCloud

OUTER_POINTS = 20
"""Number of points outside, of the paper."""
MOST_VIEWS, LEAST_SEEN = 16, 10
"""Cameras of a merged cloud, at most, and points that each must have seen."""
MOST_BEHIND = 0.2
"""Share of points behind others from which a cloud is no single view."""
MOST_BUDGET = 1000
"""Greatest budget, and the limit of "sure"."""


def check_viewpoint(view: PointCloud) -> None:
    """Refuse a viewpoint from which part of its view lies beside or behind the camera, or behind other parts."""
    points, viewpoint = view.points, view.viewpoint
    assert viewpoint is not None
    forward = (points.amax(0) + points.amin(0)) / 2 - viewpoint
    behind = int(((points - viewpoint) @ forward <= 0).sum())
    if behind:
        found = f"{viewpoint.tolist()} m, with {behind} of {len(points)} points beside or behind it"
        raise BadArgument("viewpoint", found, "the position of a camera that has the whole cloud in front of it")
    share = share_behind(view, viewpoint)
    if share > MOST_BEHIND:
        found = f"{share:.0%} of the points behind others, which no camera sees at once"
        raise BadArgument("cloud", found, "a single view, the viewpoint of each point, or outward normals")


def check_views(cloud: PointCloud) -> None:
    """Refuse more cameras than an object has sides, and views that are too small to have an outline."""
    if cloud.viewpoint is None or cloud.viewpoint.ndim == 1:
        return
    _, count = cloud.viewpoint.unique(dim=0, return_counts=True)
    if len(count) > MOST_VIEWS:
        raise BadArgument("viewpoint", f"{len(count)} different cameras", f"at most {MOST_VIEWS}")
    if int(count.min()) < LEAST_SEEN:
        raise TooFewPoints("points", f"{int(count.min())} points of one view", f"at least {LEAST_SEEN} of each")


def check_arguments(
    noise: float, budget: int | str | None, psi_scale: float, support: str, seed: int, table: float | None
) -> None:
    """Refuse arguments out of range, before any work."""
    if not 0.0 < noise <= 1.0:  # also refuses NaN
        raise BadArgument("noise", noise, "a number in (0, 1], normalised")
    least = OUTER_POINTS + 1 + 4
    if budget not in (None, "sure") and not (isinstance(budget, int) and least <= budget <= MOST_BUDGET):
        raise BadArgument("budget", budget, f"{least} to {MOST_BUDGET} points, 'sure' or None")
    if not 1.0 <= psi_scale <= 100.0:
        raise BadArgument("psi_scale", psi_scale, "a number in [1, 100]; 1.34 and more are safe")
    if support not in ("camera", "paper"):
        raise BadArgument("support", repr(support), "'camera' or 'paper'")
    if not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise BadArgument("seed", seed, "an integer from 0")
    if table is not None and not math.isfinite(table):
        raise BadArgument("table", table, "a height in metres, or None")


def check_model(kernel: KernelName | Kernel, criterion: Criterion) -> None:
    """Refuse a kernel or a criterion that is unknown, before any work."""
    if not isinstance(kernel, Kernel):
        kernel_by_name(kernel, 1.0)
    if criterion not in get_args(Criterion):
        raise BadArgument("criterion", repr(criterion), "'variance', 'error' or 'both'")
