"""From a cloud to a shape: what is observed on its seen and its hidden side."""

import dataclasses
import math
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import join
from torchgrasp.checks import LEAST, Range, Seed, checked
from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.cloud.prepare import PreparedCloud, prepare_cloud
from torchgrasp.geometry.linalg import fibonacci_sphere, unit
from torchgrasp.geometry.plane import Plane, as_plane, round_upright, upright_frame
from torchgrasp.shape.completion.complete import LEAST_NOISE, PART, Completion, Kind, complete_cloud
from torchgrasp.shape.completion.doubt import warn_of_doubts
from torchgrasp.shape.completion.free_space import free_space, free_space_violations
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.shape.completion.vessel import Vessel, find_vessel
from torchgrasp.shape.condition import check_kernel, longest_distance
from torchgrasp.shape.gp import Normalisation, ShapeGP
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.kernel import Kernel, KernelName, kernel_by_name
from torchgrasp.shape.observations import Observations, off_surface, on_surface
from torchgrasp.shape.select import Criterion, select_points
from torchgrasp.shape.update import append_observations
from torchgrasp.shape.wall_observations import (
    OUTER_POINTS,
    OUTER_RADIUS,
    RIM_NOISE,
    Middle,
    WallObservations,
    observe_walls,
    tie_walls,
)
from torchgrasp.values import PointCloud

OUTER_NOISE = 0.3
"""Standard deviation, normalised, of a distance outside: the nearest of sparse points is too far. The hidden side of a
ball lies 3 mm inside with .01 as with .1, but not with .3 to 1."""
NORMAL_NOISE = 0.05
"""Standard deviation of a seen normal: 3 degrees."""
RIM_NORMAL_NOISE = 0.5
"""Standard deviation of a rim normal; a smaller one bends the seen side."""
MIRROR_NORMAL_NOISE = 0.25
"""Standard deviation of a mirrored normal: 14 degrees, the median error of the hidden side."""
STD_FACTORS: dict[tuple[Kind, bool], float] = {
    ("ball", True): 0.5,
    ("revolution", True): 0.56,
    ("mirrored", True): 0.59,
    ("ball", False): 0.56,
    ("revolution", False): 0.59,
    ("mirrored", False): 0.75,
    ("guess", True): 1.0,
    ("guess", False): 1.0,
    ("cut off", True): 2.0,
    ("cut off", False): 2.0,
}
"""Real deviations over the posterior's, by what the hidden side follows from and whether the table is known: fitted by
`scripts/train.py bands DIR`, tried on families left out. A guess keeps the posterior's own; half a can needs twice."""
WHOLE_STD_FACTOR, VESSEL_STD_FACTOR = 0.5, 0.58
"""The same where all sides were seen; of a vessel: families left out lie to 76, 94 and 100 % within 1, 2 and 3."""
FREE_NOISE, FREE_ROUNDS = 0.003, 3
"""Standard deviation [m] of a least distance in free space, a bound; times that a shape is pushed out of it."""
BUDGETS = {"camera": 85, "paper": 70}
"""Points observed by default: fewer lose accuracy on the seen side, more cost planning time."""
MAX_BUDGET = 1000
"""Greatest budget, and the limit of "sure": its factor has 4000 rows."""


@checked
def fit_shape(
    cloud: PointCloud,
    noise: Annotated[float, Range(LEAST, 1.0)] = 0.01,
    budget: Annotated[int, Range(OUTER_POINTS + 5, MAX_BUDGET)] | Literal["sure"] | None = None,
    psi_scale: Annotated[float, Range(1.0, 100.0)] = 1.5,
    support: Literal["camera", "paper"] = "camera",
    seed: Seed = 0,
    *,
    table: Plane | float | None = None,
    kernel: KernelName | Kernel = "thin_plate",
    criterion: Criterion = "variance",
) -> ShapeGP:
    """Return the posterior of an object's shape given a partial cloud, Eqs. (2)-(9).

    "camera" cleans the cloud and observes metric distances. It adds the outline and the mirrored cloud as noisier
    observations. It pushes the shape out of free space and out of the table.

    "paper" observes the cloud's centre at d = -1 and 20 random points around it at d = +1. Its `std_m` is wide: it
    holds 81 % of the hidden surface.

    Args:
        cloud: points [m] of one object, of one view or of several (`merge_clouds`), prepared by `prepare_cloud`. Given
            normals tell a whole surface from a view. Walls thinner than the cloud's spacing merge,
            but an open vessel seen from above on a `table` has two walls (`HollowShape`).
        noise: standard deviation of an observed signed distance, normalised; for "paper" of normals too.
        budget: number of observed points: 1 inside, 20 outside, the rest the most informative of the cloud. None:
            85 for "camera", besides rim and mirrored points, and 70 for "paper". "sure": until no point's variance
            exceeds `noise`, the paper's rule, 1000 at most.
        psi_scale: psi over the longest distance of the observations; below 1.34 the covariance may be indefinite.
        support: "camera" or "paper".
        seed: of the random draws.
        table: the table's plane, or its height [m] along z; only "camera" uses it.
        kernel: "thin_plate", "matern52" or "rbf" with the length of psi (`kernel_by_name`); or a `Kernel` of
            normalised distances.
        criterion: what the most informative point has most of: "variance"; "error", the mean's distance from 0;
            "both", |error| + 2 sqrt(variance).

    Raises:
        BadArgument: an argument out of range; a cloud that `prepare_cloud` refuses; a view that is not wholly in
            front of its camera; for "camera" a whole surface without normals.
        TooFewPoints: see `prepare_cloud`.
        IndefiniteCovariance: `psi_scale` is too small, or the kernel too long for the noise.

    >>> ball = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    >>> fit_shape(PointCloud(0.04 * ball, ball)).predict(torch.tensor([0.0, 0.0, 0.04])).distance.abs() < 0.02
    tensor(True)
    """
    plane, cloud = as_plane(table), remove_duplicates(cloud)
    frame = upright_frame(cloud.points, cloud.viewpoint, plane)
    options = FitOptions(noise, budget, psi_scale, support, kernel, criterion)
    return fit_upright(round_upright(cloud, frame), seed, None if plane is None else 0.0, options).moved(frame)


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """How a surface is fitted: see `fit_shape`."""

    noise: float = 0.01
    budget: int | Literal["sure"] | None = None
    psi_scale: float = 1.5
    support: Literal["camera", "paper"] = "camera"
    kernel: KernelName | Kernel = "thin_plate"
    criterion: Criterion = "variance"

    @property
    def most(self) -> int:
        """The greatest number of observed points."""
        return MAX_BUDGET if self.budget == "sure" else self.budget or BUDGETS[self.support]

    @property
    def stop(self) -> float:
        """The score that no point has where selection ends."""
        return self.noise if self.budget == "sure" else -math.inf


def fit_upright(cloud: PointCloud, seed: int, table: float | None, options: FitOptions) -> ShapeGP:
    """Return `fit_shape` of a cloud without duplicates in its `upright_frame`, with the height of the table there."""
    generator, as_paper = torch.Generator().manual_seed(seed), options.support == "paper"
    seen, noise = prepare_cloud(cloud, generator, clean=not as_paper), options.noise
    supports = (_paper_support(seen, noise, generator),) if as_paper else _camera_supports(seen, noise, table)
    walls = [_fit_surface(seen, beside, options) for beside in supports]
    shape, middle = walls[0], supports[0].middle
    return shape if middle is None else tie_walls(HollowShape.join(shape, walls[1], seen.cloud), middle)


def _fit_surface(seen: PreparedCloud, beside: "_Support", options: FitOptions) -> ShapeGP:
    """Return the posterior of one surface, in the upright frame."""
    cloud, points, normals = seen.cloud, seen.points, seen.normals
    if beside.rows is not None:
        points, normals = points[beside.rows], normals[beside.rows]
        cloud = PointCloud(points.to(cloud.points), normals.to(cloud.points))
    x = beside.frame.normalise(points)
    candidates = on_surface(x, normals, torch.full_like(x[:, 0], options.noise), beside.normal_noise)

    # The kernel's length is that of all candidates, so that one factor grows from the first to the last.
    every = join([beside.anchors, candidates, *(part for part, _ in beside.parts)])
    psi = options.psi_scale * longest_distance(every.x)
    kernel = kernel_by_name(options.kernel, psi) if isinstance(options.kernel, str) else options.kernel
    most = max(options.most - len(beside.anchors.x), 1)
    posterior = select_points(
        candidates, beside.anchors, kernel, most, criterion=options.criterion, stop=options.stop
    ).posterior
    for part, shared in beside.parts:
        posterior = append_observations(posterior, part, shared)
    check_kernel(posterior, every.least_noise)
    shape = ShapeGP.of(posterior, beside.frame, cloud, psi, beside.std_factor)
    shape = dataclasses.replace(shape, kind=beside.kind)
    if beside.free is None:
        return shape
    free, least = beside.free
    for _ in range(FREE_ROUNDS):
        rows = free_space_violations(shape, free, least)
        if not len(rows):
            break
        shape = shape.append(off_surface(free[rows], least[rows], FREE_NOISE / shape.scale))
    return shape


@dataclasses.dataclass(frozen=True)
class _Support:
    """The normalised frame, and what is observed beside the cloud.

    `anchors` are points inside and outside; `normal_noise` is the cloud's. `parts` are rim and mirrored
    points, with the errors that their distances share. `free` holds points of free space and least distances there.
    `rows` are the points of the cloud that lie on this surface; None: all. `kind` is the shape's, `middle` a wall.
    """

    frame: Normalisation
    anchors: Observations
    normal_noise: float
    std_factor: float = 1.0
    parts: tuple[tuple[Observations, Tensor | None], ...] = ()
    free: tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]] | None = None
    rows: Bool[Tensor, "rows"] | None = None
    kind: str = "guess"
    middle: Middle | None = None


def _paper_support(seen: PreparedCloud, noise: float, generator: torch.Generator) -> _Support:
    """Return the paper's support: the centre, and random points outside (Sec. 3.1)."""
    center = seen.points.mean(0)
    scale = float(torch.linalg.vector_norm(seen.points - center, dim=-1).max())
    sphere = unit(torch.randn(OUTER_POINTS, 3, dtype=torch.float64, generator=generator)).to(center)
    anchors = off_surface(
        torch.cat([torch.zeros_like(center)[None], OUTER_RADIUS * sphere]),
        torch.cat([-torch.ones_like(center[:1]), torch.ones_like(sphere[:, 0])]),
        noise,
    )
    return _Support(Normalisation(center, scale), anchors, noise)


def _camera_supports(seen: PreparedCloud, noise: float, table: float | None) -> tuple[_Support, ...]:
    """Return metric distances; of a view also outline, mirrored points and free space. A vessel has two surfaces."""
    completion, surface = None, seen.points
    if seen.one_sided:
        cloud = PointCloud(seen.points, seen.normals, seen.viewpoint, seen.frustum)
        vessel = None if table is None else find_vessel(seen.points.cpu(), seen.normals.cpu())
        if vessel is not None and table is not None:
            return _vessel_supports(cloud, vessel, table, noise)
        completion = complete_cloud(cloud, table)
        warn_of_doubts(cloud, completion.outline, table is not None)
        surface = torch.cat([surface, completion.points.to(surface)])
    # The domain holds the whole of a ball. Of others the hidden side is not sure enough to set the scale.
    extent = surface if completion is not None and completion.kind == "ball" else seen.points
    center = (extent.amin(0) + extent.amax(0)) / 2
    frame = Normalisation(center, float(torch.linalg.vector_norm(extent - center, dim=-1).max()))
    inside, parts, free, factor, kind = True, (), None, WHOLE_STD_FACTOR, "whole"
    if completion is not None:
        parts, kind = _observe_completion(completion, frame), completion.kind
        factor = STD_FACTORS[completion.kind, table is not None]
        free = free_space(completion.outline, frame, table)
        inside = float(completion.outline.violation(center.cpu())) == 0.0  # not so for an arch or a bowl
    sphere = OUTER_RADIUS * fibonacci_sphere(OUTER_POINTS).to(center)
    x = torch.cat([torch.zeros_like(center)[None], sphere]) if inside else sphere
    distance = torch.cdist(x, frame.normalise(surface)).amin(1)
    distance = torch.cat([-distance[:1], distance[1:]]) if inside else distance
    outer = int(inside)
    anchors = join(
        [off_surface(x[:outer], distance[:outer], noise), off_surface(x[outer:], distance[outer:], OUTER_NOISE)]
    )
    return (_Support(frame, anchors, NORMAL_NOISE, factor, parts, free, kind=kind),)


def _vessel_supports(cloud: PointCloud, vessel: Vessel, table: float, noise: float) -> tuple[_Support, ...]:
    """Return the supports of an open vessel's outer body and of its inner wall."""
    center = (cloud.points.amin(0) + cloud.points.amax(0)) / 2
    frame = Normalisation(center, float(torch.linalg.vector_norm(cloud.points - center, dim=-1).max()))
    cloud, device = cloud.to("cpu"), frame.center.device
    outline = silhouettes(cloud)
    warn_of_doubts(cloud, outline, on_table=True)
    outer, inner, middle = observe_walls(cloud, vessel, outline, frame.to("cpu"), table, noise)

    def support(wall: WallObservations, free: tuple[Tensor, Tensor] | None) -> _Support:
        parts = tuple((part.to(device), None if shared is None else shared.to(device)) for part, shared in wall.parts)
        anchors, rows, amid = wall.anchors.to(device), wall.rows.to(device), middle.to(device)
        return _Support(frame, anchors, NORMAL_NOISE, VESSEL_STD_FACTOR, parts, free, rows, "vessel", amid)

    return support(outer, free_space(outline, frame, table)), support(inner, None)


def _observe_completion(completion: Completion, frame: Normalisation) -> tuple[tuple[Observations, Tensor | None], ...]:
    """Return rim and mirrored points as observations of the surface."""

    def observe(points: Tensor, normals: Tensor, noise: float, normal_noise: float) -> Observations:
        x = frame.normalise(points.to(frame.center))
        return on_surface(x, normals.to(x), torch.full_like(x[:, 0], noise / frame.scale), normal_noise)

    outline = completion.outline
    mirrored = observe(completion.points, completion.normals, LEAST_NOISE, MIRROR_NORMAL_NOISE)
    tilt = (completion.asymmetry / PART).to(frame.center)  # slope of a field with that deviation and length
    mirrored = dataclasses.replace(mirrored, normal_noise=torch.hypot(mirrored.normal_noise, tilt))
    rim = observe(outline.rim, outline.rim_normals, RIM_NOISE, RIM_NORMAL_NOISE)
    return (rim, None), (mirrored, completion.deviations.to(frame.center) / frame.scale)
