"""Preparation of clouds for the fit of a shape: outliers are removed, outward normals fitted, views
merged.
"""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.cloud.neighbours import (
    NEAR,
    Neighbours,
    draw_rows,
    fit_local_planes,
    nearest,
)
from torchgrasp.cloud.pixels import find_pixel_camera
from torchgrasp.cloud.pose import Transform, check_rigid
from torchgrasp.cloud.registration import align_views, compare_views
from torchgrasp.cloud.viewpoint import guess_viewpoint
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, CloudWarning, NoEffect, TooFewPoints
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.linalg import Points, Vector, dot, norm, unit, unit_of_any
from torchgrasp.geometry.plane import move
from torchgrasp.values.planning import PointCloud

FACING = 0.9  # least share of a view's normals that face the camera; noise turns some at the rim
ACROSS = "across the surface of the points (colours?)"
INWARD = "to the middle of the points: give outward ones, or none, unless only a hollow is seen"
SAME_PLACE = 6  # decimals [m] in which two cameras of one place are alike
MAX_POINTS = 2000  # most points to which a shape is fitted: they bound the time of the selection


@dataclasses.dataclass(frozen=True)
class PrepareNumbers:
    """Bounds on the views of a cloud, and on the distance to which points are moved."""

    views: int = 16
    """Greatest number of cameras of a cloud."""
    points: int = 10
    """Least number of points of each view."""
    moved: float = 4.5
    """Greatest distance of a kept point from the quadric fitted to its neighbours, in medians of
    the fits' rms errors. Gaussian noise stays within it.
    """
    least: float = 1e-12
    """Distance [m] from the fit that counts as 0, where a fit has no error."""


@dataclasses.dataclass(frozen=True)
class NormalNumbers:
    """Parameters of the comparison of given normals with those of neighbours."""

    neighbours: int = 9
    """Number of nearest points: the point itself and eight neighbours, enough for a majority."""
    edge: float = 0.7
    """|Cosine| of two normals below which their signs are not compared: across an edge of 45
    degrees.
    """
    over: float = 0.3
    """Ratio of a neighbour's height over the tangent plane to its distance, above which signs are
    not compared. Such a neighbour is behind a thin wall.
    """
    pairs: int = 20
    """Least number of compared pairs of neighbours: of fewer any share may be chance."""
    random: float = 0.35
    """Share of opposed signs from which on the signs are not trusted; of random ones half are
    opposed.
    """
    rounded: float = 1e-3
    """Greatest error of the length of a unit normal: text files round to three digits."""
    across: float = 0.7
    """Least median |cosine| between normals and planes fitted to the points. Random directions have
    a half; normals have more, also of few and noisy points.
    """
    alike: float = 0.999
    """Least cosine of nearly all vectors with their median at which they are alike, as one colour
    is.
    """
    nearly: float = 0.9
    """Share of the vectors that counts as nearly all of them."""
    drawn: int = 2000
    """Greatest number of points at which normals are compared with planes fitted to the points."""
    inward: float = 0.05
    """Mean cosine between the normals and the directions to the middle, weighted with the distance.
    Above this, normals point inward; in a flat view it is 0.
    """


PREPARE = PrepareNumbers()
NORMALS = NormalNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class NormalCheck(Value):
    """How well the normals of a cloud agree with the normals of neighbouring points.

    `diagnose_cloud` makes it (`CloudReport.normals`) for n points: all distinct points of the
    cloud, or 5000 of them drawn at random. It does not hold which ones.

    Attributes:
        flipped: mask (n,) of the normals that oppose most of their neighbours' normals. Its mean is
            the share of flipped normals.
        opposed: share [0 to 1] of pairs of neighbours with opposite normals.
        oriented: False if the signs of the normals look random. The normals are then ignored.
        scaled: number of normals that are not of unit length.
    """

    flipped: Bool[Tensor, "n"]
    opposed: float
    oriented: bool
    scaled: int


@dataclasses.dataclass(frozen=True)
class PreparedCloud(Value):
    """A checked cloud, and the points and normals to which a shape is fitted."""

    cloud: PointCloud  # distinct points [m] with outward normals, in the given dtype
    points: Points  # (n, 3) [m], at most 2000 of these points, in float64
    normals: Points  # (n, 3), outward unit normals at `points`
    # position of the camera [m] of all `points`, or of each; None if unknown
    viewpoint: Float[Tensor, "*views 3"] | None
    # inward unit normals of the four sides of the camera's view, or of each point's camera; None if
    # unknown
    frustum: Float[Tensor, "*views 4 3"] | None
    # standard deviation [m] of each of `points` because of an uncertain pose; None if it is exact
    pose_error: Float[Tensor, "n"] | None
    estimated: bool = False  # whether the viewpoint was estimated, not given

    @property
    def one_sided(self) -> bool:
        """Whether the cloud shows only what its cameras see, so that the object has a hidden side.

        It does if the viewpoint is known, and at least 90 % of the normals face it.
        """
        eye = self.viewpoint
        return eye is not None and share_facing(self.points, self.normals, eye) >= FACING


@checked
def prepare_cloud(
    cloud: PointCloud,
    generator: torch.Generator,
    clean: bool = True,
    up: Vector | None = None,
    neighbours: Neighbours | None = None,
) -> PreparedCloud:
    """Return the checked cloud, and the points and outward unit normals to which a shape is fitted.

    Missing normals are fitted. So are normals of random signs, with which a single view would look
    like a whole surface. Fitted normals face the viewpoint; a missing one is estimated for them.

    With `clean`, outliers are removed, and the other points are moved onto quadrics fitted around
    them. All normals are fitted anew. A viewpoint that too few given normals face counts as
    missing. A missing viewpoint is found from the lattice of the camera's pixels, if the points
    show one. Otherwise it is estimated.

    Args:
        cloud: points [m] of one object.
        generator: draws the at most 2000 points to which a shape is fitted.
        clean: whether the cloud is cleaned, as above.
        up: upward direction (3,); None if unknown.
        neighbours: the neighbours of the points in float64; None if they are not yet known.

    `NoEffect` warns if given normals show one side, but do not face the viewpoint. A `CloudWarning`
    is given for vectors across the surface, which are no normals, and for normals that point
    inward.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a normal of length zero, or a
    camera over 50 m away. It is also raised for more than 16 cameras, or normals that point away
    from the camera. Raises `TooFewPoints` for a view of fewer than 10 points.
    """
    distinct = remove_duplicates(cloud)
    if neighbours is None or len(distinct) < len(cloud):
        neighbours = Neighbours(distinct.points.double())
    cloud = distinct
    normals = cloud.normals
    viewpoint = cloud.viewpoint
    if viewpoint is not None and viewpoint.ndim == 2:
        _, count = viewpoint.unique(dim=0, return_counts=True)
        if len(count) > PREPARE.views:
            allowed = f"at most {PREPARE.views} cameras"
            raise BadArgument("viewpoint", f"{len(count)} different cameras", allowed)
        if int(count.min()) < PREPARE.points:
            allowed = f"at least {PREPARE.points} points of each view"
            raise TooFewPoints("points", f"{count.min()} points of one view", allowed)
    if normals is not None:
        if lie_across(cloud.points.double(), normals.double()):
            warn_user(CloudWarning, f"normals: they are {ACROSS}; give outward ones, or None")
        if not compare_normals(cloud.points.double(), normals.double()).oriented:
            normals = None
        elif viewpoint is not None:
            facing = share_facing(cloud.points, normals, viewpoint)
            if facing < 1 - FACING:
                found = f"{1 - facing:.0%} of them pointing away from the camera"
                raise BadArgument("normals", found, "outward normals, or None to fit them")
            if clean and facing < FACING:
                viewpoint = None
                _warn_of_one_side(normals, facing)
        elif point_inward(cloud.points.double(), normals.double()):
            warn_user(CloudWarning, f"normals: they point {INWARD}")
    estimated = viewpoint is None
    if clean and estimated:
        # before points are moved: the fit of normals smooths the lattice away
        viewpoint = _seen_by_pixels(cloud.points, normals, up)
    cloud = dataclasses.replace(cloud, normals=normals, viewpoint=viewpoint)
    if clean or normals is None:
        cloud = _fit_normals(cloud, neighbours, clean, up)

    precise = cloud.to(torch.float64)
    points = precise.points
    if clean and precise.viewpoint is None:
        guess = guess_viewpoint(points, fit_local_planes(points)[0], up)[0]
        precise = dataclasses.replace(precise, viewpoint=guess.to(cloud.points.dtype).double())
    if len(precise) > MAX_POINTS:
        drawn = torch.randperm(len(precise), generator=generator)[:MAX_POINTS]
        precise = precise.select(drawn.to(points.device))
    assert precise.normals is not None
    normals = unit(precise.normals)
    fields = precise.viewpoint, precise.frustum, precise.pose_error
    return PreparedCloud(cloud, precise.points, normals, *fields, estimated)


def _warn_of_one_side(normals: Points, facing: float) -> None:
    """Warn of a viewpoint that counts as missing, if the `normals` (n, 3) are those of one view.

    Those of a whole surface point in all directions, so that no warning is due. `facing` is the
    share of normals that face the viewpoint.
    """
    directions = unit_of_any(normals.double())
    if float((directions @ directions.sum(0) > 0).double().mean()) >= FACING:
        found = f"{facing:.0%} of the normals face it, so that the view counts as a whole surface"
        fix = "expected the true camera of the view, or None"
        warn_user(NoEffect, f"viewpoint changes nothing: {found}; {fix}")


def _seen_by_pixels(points: Points, normals: Points | None, up: Vector | None) -> Vector | None:
    """Return the camera [m] that the pixels of a view show, if given normals face it."""
    eye = find_pixel_camera(points, up)
    if eye is None or (normals is not None and share_facing(points, normals, eye) < FACING):
        return None
    return eye.to(points)


@checked
def estimate_normals(cloud: PointCloud) -> PointCloud:
    """Return the cloud without duplicate points, and with fitted outward unit normals.

    Each normal is that of a quadric surface fitted around the point, and replaces a given normal.
    It points towards the viewpoint. Without a viewpoint, it points to the side of the given normal.
    Without both, the viewpoint is estimated, and the result has this viewpoint.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a normal of length zero, or a
    camera over 50 m away.

    >>> cloud = PointCloud(torch.rand(90, 3), viewpoint=torch.tensor([0.5, 0.5, 9.0]))
    >>> estimate_normals(cloud).normals.shape
    torch.Size([90, 3])
    """
    cloud = remove_duplicates(cloud)
    return _fit_normals(cloud, Neighbours(cloud.points.double()), clean=False)


@checked
def clean_cloud(cloud: PointCloud) -> PointCloud:
    """Return a cloud without duplicates and outliers, moved onto quadrics around the points.

    A quadric surface is fitted around each point. The normals are the outward unit normals of the
    quadrics.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a normal of length zero, or a
    camera over 50 m away.
    """
    cloud = remove_duplicates(cloud)
    return _fit_normals(cloud, Neighbours(cloud.points.double()), clean=True)


def _fit_normals(
    cloud: PointCloud, neighbours: Neighbours, clean: bool, up: Vector | None = None
) -> PointCloud:
    """Return distinct points with fitted outward normals; if `clean`, without outliers and moved
    onto the fit. The `neighbours` are those of the points in float64.
    """
    if clean:
        cloud = cloud.select(neighbours.inliers)
        neighbours = neighbours.clean
    points = cloud.points
    feet, normals, rms = neighbours.quadrics
    if clean:
        offset = norm(points.double() - feet)
        keep = offset <= PREPARE.moved * rms.median() + PREPARE.least
        cloud = cloud.select(keep)
        points = feet.to(points.dtype)[keep]
        normals = normals[keep]
    viewpoint = cloud.viewpoint
    if viewpoint is None and cloud.normals is not None:
        outward = cloud.normals.double()
    else:
        if viewpoint is None:
            viewpoint = guess_viewpoint(points.double(), normals, up)[0].to(points.dtype)
        outward = viewpoint.double() - points.double()
    sign = torch.where((outward * normals).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(normals)
    normals = unit(sign * normals).to(points.dtype)
    return dataclasses.replace(cloud, points=points, normals=normals, viewpoint=viewpoint)


def compare_normals(points: Points, normals: Points) -> NormalCheck:
    """Return how well normals agree with the normals of neighbouring points.

    `points` (n, 3) are in metres; `normals` (n, 3) may have any length.
    """
    distance, index = nearest(points, NORMALS.neighbours)
    others = index[:, 1:]  # (n, 8)
    directions = unit(normals)
    cosine = dot(directions[:, None], directions[others])
    height = ((points[others] - points[:, None]) * directions[:, None]).sum(-1).abs()
    compared = (cosine.abs() > NORMALS.edge) & (height <= NORMALS.over * distance[:, 1:])
    against = compared & (cosine < 0)
    pairs = int(compared.sum())
    opposed = int(against.sum()) / pairs if pairs >= NORMALS.pairs else 0.0
    error = (norm(normals) - 1).abs()
    return NormalCheck(
        flipped=2 * against.sum(-1) > compared.sum(-1),
        opposed=opposed,
        oriented=opposed < NORMALS.random,
        scaled=int((error > NORMALS.rounded).sum()),
    )


def lie_across(points: Points, normals: Points) -> bool:
    """Return whether vectors (n, 3) lie across the surface of their `points` (n, 3) [m].

    Such vectors are no normals, but colours, or one direction for all points. Their median |cosine|
    with normals of fitted planes is below 0.7 (`NORMALS.across`).
    """
    if len(points) < NEAR.plane:
        return False  # too few for planes
    rows = draw_rows(len(points), NORMALS.drawn).to(points.device)
    planes, _ = fit_local_planes(points, rows)
    given = unit_of_any(normals[rows])
    cosine = dot(planes, given).abs()
    usual = unit_of_any(given.median(0).values)
    alike = float(((given @ usual) > NORMALS.alike).double().mean()) >= NORMALS.nearly
    # most points of one colour may lie on the one face of which it is the normal
    least = cosine.quantile(1 - NORMALS.nearly) if alike else cosine.median()
    return float(least) < NORMALS.across


def point_inward(points: Points, normals: Points) -> bool:
    """Return whether normals (n, 3) point to the middle of their `points` (n, 3) [m].

    Then the surface is inside out, or hollow. They do if the sum of (p - c) . n, divided by that of
    |p - c|, is below -0.05 (`NORMALS.inward`). Here p are the points, c is their mean, and n are
    the normals as unit vectors. By the divergence theorem, outward normals of a closed surface give
    a positive sum. So do those of a view of a surface that bulges.
    """
    away = points - points.mean(0)
    outward = float((away * unit_of_any(normals)).sum())
    return outward < -NORMALS.inward * float(norm(away).sum())


def share_facing(points: Points, normals: Points, viewpoint: Float[Tensor, "*views 3"]) -> float:
    """Return the share of normals that face the camera: nearly 1 in a view, half on a whole
    surface.

    `points` (n, 3) [m] have the outward `normals` (n, 3); the viewpoint [m] is that of all points,
    or of each.
    """
    return float((((viewpoint - points) * normals).sum(-1) > 0).double().mean())


@checked
def merge_clouds(
    clouds: Sequence[PointCloud],
    poses: Sequence[Transform] | Float[Tensor, "k 4 4"],
    *,
    align: bool = False,
) -> PointCloud:
    """Return one cloud of several views in a common frame, with each point's normal and camera.

    Views without normals get those of `estimate_normals`. The result has a `viewpoint`, unless a
    view has normals but no viewpoint. Points are denser where views overlap; `voxel_downsample`
    makes the density even.

    Two different views from one place raise a `CloudWarning`: perhaps one pose was given twice.
    Another `CloudWarning` names the views that have neither normals nor camera. Their camera is
    estimated from their points, and counts as given in the result.

    Overlapping views are compared. If they are farther apart than noise explains, `MendedInput`
    warns. Their distance becomes the result's `pose_error` [m], which widens the standard
    deviations of a shape.

    Args:
        clouds: k views of one object [m], each in a frame of its own.
        poses: rigid pose `obj_from_cloud` (4, 4) [m] of each view's frame in the common frame.
        align: whether views are moved onto the first, by at most 50 mm and 20 degrees.
            `MendedInput` then warns.

    Raises:
        BadArgument: no cloud, another number of poses, or a pose that is not rigid.
        BadArgument: clouds of several dtypes or devices.
        BadArgument: views that contradict each other by more than about three times their noise. A
            pose is wrong, or the object moved.

    Views and result must be valid clouds (`check_cloud`). For an extent outside [5 mm, 2 m], for
    example, `SuspiciousScale` is raised.

    >>> view = PointCloud(0.1 * torch.rand(90, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))
    >>> len(merge_clouds([view, view], [torch.eye(4), torch.eye(4)]))
    180
    """
    if not len(clouds):
        raise BadArgument("clouds", "none", "at least one PointCloud")
    if len(poses) != len(clouds):
        found = f"{len(poses)} for {len(clouds)} clouds"
        raise BadArgument("poses", found, "one pose for each cloud")
    rigid = list[Transform]()
    for i, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
        check_cloud(cloud)
        rigid.append(check_rigid(f"poses[{i}]", pose))
    types = {(str(c.points.dtype), str(c.points.device)) for c in clouds}
    if len(types) > 1:
        raise BadArgument("clouds", f"points of {sorted(types)}", "one dtype on one device")
    views = [_view_in_frame(cloud, pose) for cloud, pose in zip(clouds, rigid, strict=True)]
    if len(views) == 1:
        _tell_guesses(clouds)
        return views[0]
    if align:
        views = [_move(view, *moved) for view, moved in zip(views, align_views(views), strict=True)]
    _tell_same_place(clouds, views)
    errors = _compare_views(clouds, views)
    _tell_guesses(clouds)
    normals = [v.normals for v in views if v.normals is not None]
    # Each point has its camera: a view's viewpoint and frustum are repeated for its points.
    viewpoints = [v.viewpoint.expand(len(v), 3) for v in views if v.viewpoint is not None]
    viewpoint = torch.cat(viewpoints) if len(viewpoints) == len(views) else None
    frustums = [v.frustum.expand(len(v), 4, 3) for v in views if v.frustum is not None]
    frustum = torch.cat(frustums) if len(frustums) == len(views) else None
    points = torch.cat([v.points for v in views])
    pose_error = errors if errors.any() else None
    return check_cloud(PointCloud(points, torch.cat(normals), viewpoint, frustum, pose_error))


def _move(view: PointCloud, pose: Transform, error: float) -> PointCloud:
    """Return a view moved by a pose [m] with a standard deviation `error` [m]."""
    view = _view_in_frame(view, pose)
    known = view.points.new_zeros(len(view)) if view.pose_error is None else view.pose_error
    return dataclasses.replace(view, pose_error=known.clamp_min(error))


def _tell_guesses(clouds: Sequence[PointCloud]) -> None:
    """Warn (`CloudWarning`) of views whose camera is unknown, and estimated for their normals."""
    guessed = [k for k, x in enumerate(clouds) if x.viewpoint is None and x.normals is None]
    if guessed:
        found = f"the cameras of {guessed} are guessed from the points, and count as given"
        warn_user(CloudWarning, f"clouds: {found}; give each cloud its viewpoint")


def _tell_same_place(clouds: Sequence[PointCloud], views: Sequence[PointCloud]) -> None:
    """Warn (`CloudWarning`) of two views from one place: perhaps one pose was given twice.

    `views` are the `clouds` in one frame. Copies of one view change nothing.
    """
    eyes = dict[tuple[float, ...], int]()
    for k, (cloud, view) in enumerate(zip(clouds, views, strict=True)):
        # a guessed camera tells nothing, and neither do those of several views
        if cloud.viewpoint is None or view.viewpoint is None or view.viewpoint.ndim != 1:
            continue
        eye = tuple(round(x, SAME_PLACE) for x in view.viewpoint.tolist())
        if eye in eyes and not torch.equal(views[eyes[eye]].points, view.points):
            found = f"clouds {eyes[eye]} and {k} were seen from one place"
            fix = "give each view the pose of its own camera; of one camera, take median_depth"
            warn_user(CloudWarning, f"poses: {found}: {fix}")
        eyes[eye] = k


def _compare_views(clouds: Sequence[PointCloud], views: Sequence[PointCloud]) -> Float[Tensor, "n"]:
    """Return the standard deviation [m] of each point's view; raise `BadArgument` if views
    disagree.

    `views` are the `clouds` in one frame, with normals.
    """
    parts = []
    places = []  # the rows of each part among all points
    start = 0
    for cloud, view in zip(clouds, views, strict=True):
        # an estimated camera tells nothing about what it saw
        if cloud.viewpoint is None:
            view = dataclasses.replace(view, viewpoint=None, frustum=None)
        parts += view.split_views()
        places += [start + rows for rows in view.view_rows()]
        start += len(view)
    given = [v.points.new_zeros(len(v)) if v.pose_error is None else v.pose_error for v in views]
    errors = torch.cat(given)
    for rows, error in zip(places, compare_views(parts), strict=True):
        errors[rows] = errors[rows].clamp_min(error)
    return errors


def _view_in_frame(cloud: PointCloud, obj_from_cloud: Transform) -> PointCloud:
    """Return a view, with unit normals, transformed into the frame of the merged cloud."""
    cloud = estimate_normals(cloud) if cloud.normals is None else cloud
    assert cloud.normals is not None
    exact = cloud.to(torch.float64)
    exact = dataclasses.replace(exact, normals=unit_of_any(cloud.normals.double()))
    return move(exact, obj_from_cloud.to(cloud.points)).to(cloud.points.dtype)
