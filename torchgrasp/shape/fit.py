"""From a cloud to a shape: what is observed, and where, to fix the seen and the hidden side."""

import dataclasses
import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.cloud.normals import clean_cloud, estimate_normals, estimate_viewpoint, spread_directions
from torchgrasp.cloud.orientation import drop_unoriented
from torchgrasp.linalg import unit
from torchgrasp.shape.completion.complete import LEAST_NOISE, PART, Completion, complete_cloud
from torchgrasp.shape.completion.free_space import free_space, free_space_violations
from torchgrasp.shape.completion.silhouette import seen_from_one_side
from torchgrasp.shape.condition import as_shape, check_kernel, longest_distance
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.kernel import Kernel, KernelName, kernel_by_name
from torchgrasp.shape.observations import Observations, join, off_surface, on_surface
from torchgrasp.shape.select import Criterion, select_points
from torchgrasp.shape.update import append_observations
from torchgrasp.shape.validate import (
    MOST_BUDGET,
    OUTER_POINTS,
    check_arguments,
    check_model,
    check_viewpoint,
    check_views,
)
from torchgrasp.values import PointCloud

OUTER_RADIUS = 1.2
"""Radius, normalised, of the sphere of the points outside."""
NORMAL_NOISE = 0.05
"""Standard deviation of a seen normal."""
RIM_NOISE = 0.002
"""Standard deviation [m] of a rim point's position."""
RIM_NORMAL_NOISE = 0.5
"""Standard deviation of a rim normal; a smaller one bends the seen side."""
MIRROR_NORMAL_NOISE = 0.25
"""Standard deviation of a mirrored normal."""
CAMERA_STD_FACTOR = 0.5
"""Real deviations over the raw posterior's: one number, with which 96 % of the hidden sides of 24 noisy views of eight
scanned objects lie within two std_m, and 75 % within one (mean over views), and at least 80 % of each within two. A
wedge whose slope is hidden, of which nothing but a wrong plane of symmetry can be seen, has far less (33 %)."""
FREE_NOISE = 0.003
"""Standard deviation [m] of the least distance observed where the shape reached into free space."""
FREE_ROUNDS = 3
"""Times that a shape is pushed out of free space."""
Part = tuple[Observations, Tensor | None]
"""Later observations, and the errors that their distances share; see `append_observations`."""
CANDIDATES = 2000
"""Points of a cloud among which the informative ones are sought, at most."""
BUDGETS = {"camera": 85, "paper": 70}
"""Points observed by default, rim and mirrored points apart. From 70 to 85 to 100 the error of the seen surface falls
from .68 to .61 to .56 mm and from 9.9 to 9.2 to 8.6 degrees; planning takes 1.5, 1.6 and 1.8 s."""


def fit_shape(
    cloud: PointCloud,
    noise: float = 0.01,
    budget: int | Literal["sure"] | None = None,
    psi_scale: float = 1.5,
    support: Literal["camera", "paper"] = "camera",
    seed: int = 0,
    *,
    table: float | None = None,
    kernel: KernelName | Kernel = "thin_plate",
    criterion: Criterion = "variance",
) -> ShapeGP:
    """Return the posterior of an object's shape given a partial cloud, Eqs. (2)-(9).

    `support="camera"` cleans the cloud, adds the outline seen by the camera and the mirrored cloud as noisier
    observations, and takes every signed distance in metres over the scale, so that gradients agree with unit normals.
    Where the shape then reaches into space that the camera saw empty, or under the table, it is pushed out.
    The hidden side is then off by 2.5 mm (median), not 7. `support="paper"` observes what the paper does: the
    centre of the cloud at d = -1 and 20 random points on a sphere of 1.2 at d = +1. Its `std_m` is the paper's own,
    std_factor 1, and wide: one and two of them hold 83 % and 96 % of the hidden surface, not 68 % and 95 %.

    Args:
        cloud: points [m] of one object, of one view or of several (`merge_clouds`). A missing viewpoint is estimated.
            "camera" fits normals anew; given ones tell a whole surface from a single view, and "paper" observes them;
            their signs must agree with each other (`check_normals`), else they are left aside. Walls thinner than the
            cloud's spacing merge.
        noise: standard deviation of an observed signed distance, normalised; of normals too for "paper".
        budget: points of the observed set: the one inside, 20 outside, and the rest the most informative ones of
            the cloud; None: 85 for "camera", whose rim and mirrored points come on top, and 70 for "paper".
            "sure": points of the cloud are taken until the variance at none of them exceeds `noise`, the paper's
            rule, and 1000 at most in all.
        psi_scale: psi over the longest distance of the observations; below 1.34 the covariance may be indefinite.
        support: "camera" or "paper".
        seed: of the random draws.
        table: height [m] of a table that the object stands on, with normal z; only "camera" uses it.
        kernel: "thin_plate", "matern52" or "rbf" of the length that psi tells (see `kernel_by_name`), or a `Kernel` of
            normalised distances.
        criterion: which point of the cloud is the most informative: that of the greatest "variance", of the greatest
            "error", its mean signed distance, or of the greatest |error| + 2 sqrt(variance), "both".

    Raises:
        BadArgument: an argument out of range, a cloud that `check_cloud` refuses, a viewpoint that has not the
            whole of its view in front of it, or more than 16 of them; for "camera" a whole surface without normals.
        TooFewPoints: fewer than 10 points of one of several views.
        IndefiniteCovariance: `psi_scale` is too small, or the kernel too long for the noise.

    >>> ball = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    >>> fit_shape(PointCloud(0.04 * ball, ball)).predict(torch.tensor([0.0, 0.0, 0.04])).distance.abs() < 0.02
    tensor(True)
    """
    check_arguments(noise, budget, psi_scale, support, seed, table)
    check_model(kernel, criterion)
    model = _Model(noise, BUDGETS[support] if budget is None else budget, psi_scale, kernel, criterion)
    cloud = drop_unoriented(cloud)
    check_views(cloud)
    generator = torch.Generator().manual_seed(seed)
    if support == "paper":
        return _fit_paper(cloud, model, generator)
    return _fit_camera(cloud, model, generator, table)


@dataclasses.dataclass(frozen=True)
class _Model:
    """The arguments of `fit_shape` that say how the posterior follows from what is observed."""

    noise: float
    budget: int | Literal["sure"]
    psi_scale: float
    kernel: KernelName | Kernel
    criterion: Criterion


def _fit_paper(cloud: PointCloud, model: _Model, generator: torch.Generator) -> ShapeGP:
    """Return the shape from the paper's own observations (Sec. 3.1)."""
    cloud = estimate_normals(cloud) if cloud.normals is None else remove_duplicates(cloud)
    points, normals = _known(_candidates(cloud, generator))
    center = points.mean(0)
    scale = float(torch.linalg.vector_norm(points - center, dim=-1).max())
    sphere = unit(torch.randn(OUTER_POINTS, 3, dtype=torch.float64, generator=generator)).to(points)
    support = off_surface(
        torch.cat([torch.zeros_like(center)[None], OUTER_RADIUS * sphere]),
        torch.cat([-torch.ones_like(center[:1]), torch.ones_like(sphere[:, 0])]),
        model.noise,
    )
    return _condition(points, normals, support, [], model, model.noise, center, scale, cloud)


def _fit_camera(cloud: PointCloud, model: _Model, generator: torch.Generator, table: float | None) -> ShapeGP:
    """Return the shape from metric distances, the outline and the mirrored cloud."""
    if cloud.normals is not None and cloud.viewpoint is not None and not seen_from_one_side(cloud, cloud.viewpoint):
        # A whole surface: turned towards a viewpoint its far side would be inside out.
        cloud = PointCloud(cloud.points, cloud.normals)
    cloud = clean_cloud(cloud)
    seen = _candidates(cloud, generator)
    points, normals = _known(seen)
    low, high = points.amin(0), points.amax(0)
    center = (low + high) / 2
    scale = float(torch.linalg.vector_norm(points - center, dim=-1).max())
    if seen.viewpoint is None:
        seen = PointCloud(points, normals, estimate_viewpoint(cloud).to(points))
    assert seen.viewpoint is not None
    parts: list[Part] = []
    free: list[tuple[Tensor, Tensor]] = []
    inside, surface = True, points
    if seen_from_one_side(seen, seen.viewpoint):  # else it is a whole surface, and nothing is hidden
        for view in seen.split_views():
            check_viewpoint(view)
        found = complete_cloud(seen, table)
        parts = _observe_completion(found, center, scale)
        surface = torch.cat([points, found.points.to(points)])
        free = [free_space(found.outline, center, scale, table)]
        inside = float(found.outline.violation(center.cpu())) == 0.0  # not so for an arch or a bowl

    sphere = OUTER_RADIUS * spread_directions(OUTER_POINTS, points)
    anchors = torch.cat([torch.zeros_like(center)[None], sphere]) if inside else sphere
    away = torch.cdist(anchors, (surface - center) / scale).amin(1)
    away = torch.cat([-away[:1], away[1:]]) if inside else away
    support = off_surface(anchors, away, model.noise)
    shape = _condition(points, normals, support, parts, model, NORMAL_NOISE, center, scale, cloud, CAMERA_STD_FACTOR)
    for x, least in FREE_ROUNDS * free:
        rows = free_space_violations(shape, x, least)
        if not len(rows):
            break
        longer = append_observations(shape, off_surface(x[rows], least[rows], FREE_NOISE / scale))
        shape = as_shape(longer, center, scale, cloud, shape.psi, CAMERA_STD_FACTOR)
    return shape


def _observe_completion(found: Completion, center: Float[Tensor, "3"], scale: float) -> list[Part]:
    """Return rim and mirrored points as observations of the surface."""

    def observe(points: Tensor, normals: Tensor, noise: float, normal_noise: float) -> Observations:
        x = (points.to(center) - center) / scale
        return on_surface(x, normals.to(center), torch.full_like(x[:, 0], noise / scale), normal_noise)

    mirrored = observe(found.points, found.normals, LEAST_NOISE, MIRROR_NORMAL_NOISE)
    slope = (found.asymmetry / PART).to(center)  # of a field of that deviation, alike over that length
    mirrored = dataclasses.replace(mirrored, normal_noise=torch.hypot(mirrored.normal_noise, slope))

    rim, rim_normals = found.outline.rim, found.outline.rim_normals
    return [
        (observe(rim, rim_normals, RIM_NOISE, RIM_NORMAL_NOISE), None),
        (mirrored, found.deviations.to(center) / scale),
    ]


def _condition(
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    support: Observations,
    parts: list[Part],
    model: _Model,
    normal_noise: float,
    center: Float[Tensor, "3"],
    scale: float,
    cloud: PointCloud,
    std_factor: float = 1.0,
) -> ShapeGP:
    """Return the shape given `support`, the most informative points of the cloud and then other `parts`.

    The kernel's length is that of all candidates from the start, so that one factor grows from the first to the last.
    """
    x = (points - center) / scale
    every = join(support, on_surface(x, normals, torch.full_like(x[:, 0], model.noise), normal_noise))
    every = join(every, *(part for part, _ in parts))
    psi = model.psi_scale * longest_distance(every.x)
    kernel = kernel_by_name(model.kernel, psi) if isinstance(model.kernel, str) else model.kernel
    budget, stop = (MOST_BUDGET, model.noise) if model.budget == "sure" else (model.budget, -math.inf)
    budget = max(budget - len(support.x), 1)
    found = select_points(
        x, normals, support, kernel, budget, model.noise, normal_noise, criterion=model.criterion, stop=stop
    ).posterior
    for part, shared in parts:
        found = append_observations(found, part, shared)
    check_kernel(found, every.least_noise)
    return as_shape(found, center, scale, cloud, psi, std_factor)


def _candidates(cloud: PointCloud, generator: torch.Generator) -> PointCloud:
    """Return the cloud in float64, with unit normals; a random part of it if it is very dense."""
    cloud = cloud.to(torch.float64)
    if len(cloud) > CANDIDATES:
        cloud = cloud.select(torch.randperm(len(cloud), generator=generator)[:CANDIDATES].to(cloud.points.device))
    assert cloud.normals is not None
    return PointCloud(cloud.points, unit(cloud.normals), cloud.viewpoint)


def _known(cloud: PointCloud) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return points and normals of a cloud that has both."""
    assert cloud.normals is not None
    return cloud.points, cloud.normals
