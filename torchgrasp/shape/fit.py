"""Fit of the shape to a point cloud: choice of the observations on the seen and the hidden side."""

import dataclasses
import math
from typing import Annotated, Literal

import torch

from torchgrasp.cloud.advice import check_camera
from torchgrasp.cloud.agreement import check_foot, warn_of_low_table
from torchgrasp.cloud.check import FEW_POINTS, remove_duplicates, warn_of_step
from torchgrasp.cloud.neighbours import Neighbours, nearest
from torchgrasp.cloud.parts import find_second_body
from torchgrasp.cloud.prepare import PreparedCloud, clean_cloud, prepare_cloud
from torchgrasp.cloud.surroundings import find_surroundings
from torchgrasp.data.accept import CloudLike, as_cloud
from torchgrasp.foundation.base import join
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import (
    BadArgument,
    CutOff,
    FewPoints,
    Flat,
    Gap,
    TableLeft,
    TwoBodies,
)
from torchgrasp.foundation.rules import LEAST, Positive, Range, Seed, is_known
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.plane import Plane, as_plane, round_upright, upright_frame
from torchgrasp.shape.completion.complete import complete_cloud
from torchgrasp.shape.completion.silhouette import Outlines, silhouettes
from torchgrasp.shape.completion.vessel import find_vessel
from torchgrasp.shape.conditioning import (
    Criterion,
    append_observations,
    check_kernel,
    check_reach,
    longest_distance,
    posterior_given,
    select_points,
)
from torchgrasp.shape.estimate import (
    Normalisation,
    Observations,
    check_observations,
    off_surface,
    on_surface,
)
from torchgrasp.shape.extra_observations import (
    NOISE,
    OUTSIDE,
    ExtraObservations,
    camera_support,
    free_space_violations,
    paper_support,
    vessel_supports,
)
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.hollow import HollowShape, tie_walls
from torchgrasp.shape.kernel import Kernel, KernelName, is_plain, kernel_of
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class ShapeNumbers:
    """Parameters of the fit of a shape, a Gaussian process, to a cloud."""

    budget: int = 1000
    """Greatest number of observed points. The Cholesky factor of their covariance then has 4000
    rows.
    """
    camera: int = 85
    """Number of observed points by default, with the support "camera"."""
    paper: int = 70
    """Number of observed points by default, with the support "paper"."""
    rounds: int = 3
    """Greatest number of rounds in which free space that the shape violates is observed."""
    gap: float = 0.025
    """Least width [m] of a gap of the outline that misleads a fingertip; that of a handle is
    narrower.
    """


SHAPE = ShapeNumbers()


@checked
@single_threaded
def fit_shape(
    cloud: CloudLike,
    noise: Annotated[float, Range(LEAST, 1.0)] = 0.01,
    budget: Annotated[int, Range(OUTSIDE.points + 5, SHAPE.budget)] | Literal["sure"] | None = None,
    psi_scale: Annotated[float, Range(1.0, 100.0)] = 1.5,
    support: Literal["camera", "paper"] = "camera",
    seed: Seed = 0,
    *,
    table: Plane | float | None = None,
    kernel: KernelName | Kernel = "thin_plate",
    criterion: Criterion = "variance",
) -> ShapeGP:
    """Return the shape of an object as a Gaussian process, given a partial cloud, Eqs. (2)-(9) of
    the paper.

    The shape is in the frame of the cloud, in float64. An open vessel seen from above on a `table`
    becomes a `HollowShape` with two surfaces. Walls thinner than the cloud's spacing merge.

    The points of the cloud are observed at signed distance 0. `support` says what is observed in
    addition. With "camera" the cloud is cleaned, and distances are true to scale. The object's
    outline and its estimated hidden side are observed with more noise. The shape is kept out of
    free space and of the table.

    With "paper", as in Sec. 3.1 of the paper, the cloud's centre is observed at distance -1,
    normalised. 20 random points on a sphere around it are observed at distance +1.

    Args:
        cloud: points [m] of one object from one view or several (`merge_clouds`), or another value
            that `plan_grasps` takes. Points from all sides need outward `normals`, or the
            `viewpoint` of each point.
        noise: standard deviation of an observed signed distance, at most 1. It is normalised: one
            unit is the shape's `scale` [m], about the object's radius. If `support` is "paper",
            also that of a component of a normal.
        budget: number of observed points, 25 to 1000 (`SHAPE.budget`). Up to 20 of them lie on a
            sphere around the object. One lies at its centre, if the centre is inside. The others
            are the most informative points of the cloud. The outline and the hidden side come in
            addition. None means 85 for "camera" (`SHAPE.camera`) and 70 for "paper"
            (`SHAPE.paper`). "sure", the paper's rule, adds points until no point's variance
            (squared normalised units) exceeds `noise`, but at most 1000.
        psi_scale: ratio of the kernel's length psi to the longest distance between observed points,
            1 to 100. Below 1.34 the covariance may be indefinite.
        support: "camera" or "paper", as above.
        seed: seed of the random draws.
        table: the table's plane, or its height [m] along z; None means no table. Only "camera"
            keeps the shape out of it. A table farther below the points than they extend has no
            effect, and `NoEffect` warns.
        kernel: "thin_plate", "matern52" or "rbf", whose length follows from psi; or your own
            `Kernel` of normalised distances.
        criterion: the most informative point has the greatest "variance" of its distance, or the
            greatest "error" |mean distance|. With "both" it has the greatest |error| + 2
            sqrt(variance).

    Raises:
        BadArgument: an argument out of range; a table above the object's foot or a camera. Also a
            table more than 2 m below the object's top.
        BadArgument: a cloud that `check_cloud` refuses; more than 16 cameras; for "camera" a whole
            surface without normals. Also a camera that cannot have seen its points, or that the
            normals point away from.
        BadArgument: a kernel whose profile requires a gradient (use `condition`).
        TooFewPoints: fewer than 4 distinct points, or fewer than 10 of one of several views.
        SuspiciousScale: an extent outside [5 mm, 2 m].
        IndefiniteCovariance: `psi_scale` is too small, or the kernel too long for the noise.

    A `CloudWarning` is given for a doubtful cloud. It is `FewPoints` for fewer than 100 points, and
    `Flat` for points in one plane.

    >>> from torchgrasp.geometry.linalg import unit
    >>> ball = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    >>> shape = fit_shape(PointCloud(0.04 * ball, ball))
    >>> shape.predict(torch.tensor([0.0, 0.0, 0.04])).distance.abs() < 0.02
    tensor(True)
    """
    cloud = as_cloud(cloud, "cloud")
    if isinstance(kernel, Kernel) and not is_plain(kernel.profile(cloud.points.new_zeros(()))):
        raise BadArgument(
            "kernel", "a profile with tensors that require a gradient", "numbers: use `condition`"
        )
    plane = as_plane(table)
    cloud = remove_duplicates(cloud)
    warn_of_step(cloud.points)
    frame = upright_frame(cloud.points, cloud.viewpoint, plane)
    options = FitOptions(noise, budget, psi_scale, support, kernel, criterion)
    return fit_upright(
        round_upright(cloud, frame), seed, None if plane is None else 0.0, options
    ).moved(frame)


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """Options of a shape fit, with the meaning that they have as arguments of `fit_shape`.

    A `budget` of None means the default number of the `support`. "sure" means as many points as
    bring the variance down to `noise`, at most 1000 (`SHAPE.budget`).
    """

    noise: float = 0.01  # standard deviation of an observed distance, in radii of the object
    budget: int | Literal["sure"] | None = None  # number of observed points
    psi_scale: float = 1.5  # the kernel's length over the longest distance of observed points
    support: Literal["camera", "paper"] = "camera"  # observations besides the cloud's points
    kernel: KernelName | Kernel = "thin_plate"  # covariance of the signed distance at two points
    criterion: Criterion = "variance"  # the next point has the greatest variance, error, or both

    def selected(self) -> tuple[int, float]:
        """Return the greatest number of observed points, and the variance at which their selection
        ends, in squared normalised units.

        The variance is -inf if the number alone ends it.
        """
        if self.budget == "sure":
            return SHAPE.budget, self.noise
        usual = SHAPE.camera if self.support == "camera" else SHAPE.paper
        return self.budget or usual, -math.inf


def fit_upright(
    cloud: PointCloud,
    seed: int,
    table: float | None,
    options: FitOptions,
    in_image: bool = False,
    neighbours: Neighbours | None = None,
) -> ShapeGP:
    """Return the shape fitted to a cloud [m] whose frame has z up, in the same frame.

    `fit_shape` calls it with its cloud in an upright frame. The cloud must have no duplicate
    points.

    Args:
        cloud: points of one object from one view or several, or from all sides.
        seed: seed of the random draws.
        table: the table's height [m]; None means no table.
        options: the options of `fit_shape`.
        in_image: whether the points were cut out of a depth image. Checks of the camera, and for
            points of the table in the cloud, are then left out.
        neighbours: nearest neighbours of the points in float64; None means that they are sought.

    A `CloudWarning` is given for a doubtful cloud, such as one in a plane.
    """
    if table is not None:
        check_foot(cloud, Plane.horizontal(table))
        if not in_image:  # in a scene, others may hide the foot
            warn_of_low_table(cloud, Plane.horizontal(table))
    neighbours = neighbours or Neighbours(cloud.points.double())
    if len(cloud) < FEW_POINTS:
        few = f"{len(cloud)} points, where a shape needs {FEW_POINTS}"
        warn_user(FewPoints, f"{few}: the shape is a guess; give more points")
    elif neighbours.flat:
        warn_user(
            Flat,
            "the points lie in one plane, to their noise: the thickness is a guess; "
            "give a view of two sides",
        )
    generator = torch.Generator("cpu").manual_seed(seed)
    noise = options.noise
    up = None if table is None else torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32, device="cpu")
    seen = prepare_cloud(cloud, generator, options.support == "camera", up, neighbours)
    if not in_image:  # a scene has cut its objects out
        _warn_of_table(seen, None if table is None else Plane.horizontal(table))
    # The camera of a depth image is known, an estimated one is a guess, a whole surface has none.
    # It is judged after the outline, which refuses a camera within the points by that name.
    judged = seen.one_sided and not in_image and not seen.estimated
    view = PointCloud(seen.points, seen.normals, seen.viewpoint, seen.frustum)
    if options.support == "paper":
        if judged:
            check_camera(clean_cloud(view))
        return _fit_surface(seen, paper_support(seen, noise, generator), options)
    if not seen.one_sided:
        return _fit_surface(seen, camera_support(seen, None, noise, table), options)
    vessel = None if table is None else find_vessel(seen.points.cpu(), seen.normals.cpu())
    if vessel is None or table is None:
        completion = complete_cloud(view, table)
        if judged:
            check_camera(view)
        _warn_of_ambiguity(view, completion.outline, table is not None)
        return _fit_surface(seen, camera_support(seen, completion, noise, table), options)
    outline = silhouettes(view.to("cpu"))
    if judged:
        check_camera(view)
    _warn_of_ambiguity(view, outline, on_table=True)
    *supports, middle = vessel_supports(view, vessel, outline, table, noise)
    outer, inner = (_fit_surface(seen, support, options) for support in supports)
    return tie_walls(HollowShape.join(outer, inner, seen.cloud), middle)


def _fit_surface(seen: PreparedCloud, support: ExtraObservations, options: FitOptions) -> ShapeGP:
    """Return the posterior of one surface, in the upright frame, given the cloud and the additional
    observations.
    """
    cloud = seen.cloud
    points = seen.points
    normals = seen.normals
    if support.rows is not None:
        points = points[support.rows]
        normals = normals[support.rows]
        cloud = PointCloud(points.to(cloud.points), normals.to(cloud.points))
    # an uncertain pose of a view adds to the noise of its points
    x = support.frame.normalise(points)
    noise = torch.full_like(x[:, 0], options.noise)
    error = seen.pose_error
    if error is not None:
        error = error if support.rows is None else error[support.rows]
        noise = torch.hypot(noise, error / support.frame.scale)
    candidates = on_surface(x, normals, noise, support.normal_noise)

    # The kernel's length is that of all candidates, so that one factor grows from the first to the
    # last.
    every = join([support.anchors, candidates, *(part for part, _ in support.parts)])
    psi = options.psi_scale * longest_distance(every.x)
    kernel = kernel_of(options.kernel, psi)
    most, stop = options.selected()
    budget = max(most - len(support.anchors), 1)
    posterior = select_points(
        candidates, support.anchors, kernel, budget, options.criterion, stop
    ).posterior
    for part, shared in support.parts:
        posterior = append_observations(posterior, part, shared)
    check_kernel(posterior, every.least_noise)
    if isinstance(options.kernel, Kernel):
        check_reach(posterior)
    shape = ShapeGP.of(posterior, support.frame, cloud, psi, support.std_factor)
    shape = dataclasses.replace(shape, kind=support.kind)
    free, least = support.free or (x[:0], x[:0, 0])
    for _ in range(SHAPE.rounds):
        rows = free_space_violations(shape, free, least)
        if not len(rows):
            break
        shape = shape.append(off_surface(free[rows], least[rows], NOISE.free / shape.scale))
    return shape if error is None else shape.widened(points, error)


@checked(gradients=True)
def condition(
    observations: Observations,
    normalisation: Normalisation,
    cloud: PointCloud,
    psi_scale: Positive = 1.5,
    std_factor: Positive = 1.0,
    kernel: KernelName | Kernel = "thin_plate",
) -> ShapeGP:
    """Return the shape as a Gaussian process posterior, given normalised observations, Eqs. (7)-(9)
    of the paper.

    `fit_shape` does this for a cloud. Use `condition` for observations of your own, and for
    gradients with respect to them. The result is differentiable, to any order, in the observations,
    the frame's centre and tensors of the kernel's profile. Constants are the length psi of a named
    kernel, and the domain's radius. The domain is the ball in which the posterior is valid.

    Args:
        observations: signed distances and normals at n points, with their noise, all normalised.
            torch.vmap may map over distances, normals and noise.
        normalisation: centre and scale [m] of the normalised frame.
        cloud: the points [m] that the camera saw, in the frame of `normalisation.center`. The
            result holds them; the posterior does not depend on them.
        psi_scale: ratio of the kernel's length psi to the longest distance between observed points.
            The paper's value 1 makes the covariance of the thin plate kernel indefinite.
        std_factor: factor of `std_m` in results of `ShapeGP.predict`: the ratio of the surface's
            true deviations to the posterior's standard deviations.
        kernel: "thin_plate", "matern52" or "rbf", whose length follows from psi; or your own
            `Kernel` of normalised distances.

    Raises:
        BadArgument: an unknown kernel; torch.vmap that maps over points or `has_normal`.
        BadArgument: an observed normal that is no unit vector, or a negative noise.
        BadArgument: a `Kernel` so short that neighbouring points are almost independent.
        IndefiniteCovariance: `psi_scale` is too small, or the kernel too long for the noise. Inside
            torch.vmap it is not raised, and the estimate is NaN.

    >>> x = torch.cat([torch.eye(3), -torch.eye(3)]).double() / 2
    >>> noise = torch.full((6,), 0.01).double()
    >>> seen = Observations(x, 0 * noise, 2 * x, noise > 0, noise, noise)
    >>> shape = condition(seen, Normalisation(torch.zeros(3).double(), 0.05), PointCloud(0.05 * x))
    >>> shape.predict(0.05 * x[:2]).distance.abs() < 0.01
    tensor([True, True])
    """
    for name in ("x", "has_normal"):
        if not is_known(getattr(observations, name)):
            allowed = "the same for all that vmap maps over"
            raise BadArgument(f"observations.{name}", "a tensor inside torch.vmap", allowed)
    check_observations(observations)
    observations = observations.to(normalisation.center.device, torch.float64)
    psi = psi_scale * longest_distance(observations.x)
    posterior = posterior_given(observations, kernel_of(kernel, psi))
    if is_known(posterior.factor):
        check_kernel(posterior, observations.least_noise)
    if isinstance(kernel, Kernel):
        check_reach(posterior)
    return ShapeGP.of(posterior, normalisation, cloud, psi, std_factor)


def _warn_of_table(seen: PreparedCloud, table: Plane | None) -> None:
    """Warn if points of the table, which may be unknown, surround the object."""
    share = find_surroundings(seen.points, seen.normals, table)
    if share > 0:
        warn_user(
            TableLeft,
            f"{share:.0%} of the points are a table around the object, and count as the object: "
            "give the object alone (cut_object), or plan on Scene.from_cloud",
        )


def _warn_of_ambiguity(cloud: PointCloud, outline: Outlines, on_table: bool) -> None:
    """Warn if the image border cuts the object off, or the view has a gap. Warn also if two bodies
    stand on the table.
    """
    if outline.cut:
        warn_user(
            CutOff,
            "the border of the image cuts the object off: the part beyond it is a guess; "
            "turn the camera",
        )
    if outline.gap > SHAPE.gap:
        width = f"a gap of {1e3 * outline.gap:.0f} mm in the view"
        warn_user(
            Gap, f"{width}: a hole, or a patch that was not measured; the surface there is a guess"
        )
    if on_table:
        points = cloud.points.double().cpu()
        spacing = float(nearest(points, 2)[0][:, -1].median())
        body = find_second_body(points, torch.tensor([0.0, 0.0, 1.0]).to(points), spacing)
        if body is not None:
            share = float(body.double().mean())
            warn_user(
                TwoBodies,
                f"two bodies that stand apart, the second of {share:.0%} of the points: "
                "give one of them",
            )
