"""Comparison of several views of one object, and their registration.

Three decisions matter. First, the distance of two views is that of a motion: the rigid one after
which they agree best. It is the root mean square, over the points, of how far the motion moves them
along their normals. So shifts to and from a camera count alike, and turns and scales count. Slides
that map a surface to itself count nothing. Cameras need not be known. Second, this motion is the
most likely one, given that poses are known to some mm. What the overlap does not show stays as
given. `align_views` moves views by the same motion. The registration packages that we know do less:
they let a bottle spin about its axis. Third, what a camera saw through is empty. Points that
another view has before a surface contradict it, with or without an overlap.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.agreement import distance_behind, noise_of
from torchgrasp.cloud.neighbours import draw_rows, find_inliers, usual_spacing
from torchgrasp.foundation.errors import BadArgument, MendedInput
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.frames import rotation_angle, rotation_from_vector, turned_about
from torchgrasp.geometry.linalg import Points, Vector, dot, norm, unit
from torchgrasp.geometry.plane import move
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class ViewDistanceNumbers:
    """Bounds on how far the views of one object may be apart."""

    drawn: int = 400
    """Greatest number of points of a view that are compared with another view."""
    surface: int = 5000
    """Greatest number of points of the other view's surface with which the points of a view are
    compared.
    """
    reach: float = 1.5
    """Greatest distance of compared points of two views along the surface, in spacings of the
    surface's points.
    """
    least: int = 20
    """Least number of compared points: fewer are a rim of flying pixels."""
    seen: float = 0.9
    """Quantile of the heights of a view's points in front of a surface that counts as the view's
    height there. Flying pixels are higher.
    """
    same: float = 0.8
    """Least cosine of two normals that count as of one surface."""
    refused: float = 2.5
    """Greatest distance of two views along their normals, in multiples of their noise. Views with a
    greater one are refused.
    """
    shifted: float = 3.0
    """Greatest shift of a view, in multiples of the noise. It also bounds how high a view stands in
    front of the surface that another camera saw.
    """
    likely: float = 1.0
    """Chi squared of a motion above which the motion adds to the standard deviations of poses."""
    shown: float = 4.0
    """Chi squared above which a motion is reported, corrected or refused. Below it, noise and bias
    of the cameras explain the motion.
    """
    vague: float = 1.5
    """Factor on the limits `refused` and `shifted` for a view without a camera. Its noise is a
    guess.
    """
    meet: float = 0.05
    """Least share of a view's points that must lie on the other view, or behind it."""
    gap: float = 0.03
    """Greatest distance [m] at which a point still counts as on the other view, or behind it."""


@dataclasses.dataclass(frozen=True)
class RegistrationNumbers:
    """Parameters of the search for the motion that brings two views together (registration)."""

    shifted: float = 0.01
    """Standard deviation [m] of the positions of given poses. What the overlap of the views does
    not show stays as given.
    """
    turned: float = 0.1
    """Standard deviation [rad] of the rotations of given poses."""
    repeated: float = 20.0
    """Number of points that share one error, because the bias of a camera is smooth."""
    first: float = 0.04
    """Greatest distance [m] of matching points in the first step."""
    shrink: float = 0.8
    """Factor by which the greatest distance of matching points shrinks from step to step."""
    last: float = 4.0
    """Greatest distance of matching points in the last steps, in multiples of the noise."""
    steps: int = 25
    """Greatest number of steps of the search."""
    still: float = 1e-4
    """Greatest change [m, rad] of the motion in a step at which the search ends."""
    hidden: float = 0.9
    """Greatest share of a motion's variance that is assumed to be hidden: the overlap does not show
    it.
    """
    gaussian: float = 1.4826
    """Ratio of the standard deviation to the median absolute value of a normal distribution."""
    shift: float = 0.05
    """Greatest shift [m] that is corrected, so that matching points can be found."""
    turn: float = 20.0
    """Greatest rotation [deg] that is corrected, so that normals match."""


VIEWS = ViewDistanceNumbers()
MOTION = RegistrationNumbers()


@dataclasses.dataclass(frozen=True)
class Motion:
    """The rigid motion of a view after which it agrees best with another view.

    It also says how far the views were apart before. It is the result of the registration of the
    two views. Root mean squares (rms) are over the points of the moved view.
    """

    pose: Float[Tensor, "4 4"]  # the motion new_from_old (4, 4) [m], in the frame of the two views
    shift: float  # distance [m] by which the mean of the view's points moves
    distance: float  # rms distance [m] by which the points move along their normals
    # rms distance [m] of a motion that the overlap does not show, estimated from the shown one
    unsure: float
    left: float  # robust standard deviation [m] of the points from the other view after the motion
    # chi squared of the motion (no unit): small if noise and bias of the cameras explain it
    chi_squared: float

    @property
    def error(self) -> float:
        """The rms distance [m] by which the motion moves the points along their normals; 0 if noise
        explains the motion.

        It is sqrt(`distance`^2 + `unsure`^2): what the overlap of the views shows, and an estimate
        of what it does not show. Noise explains a motion whose `chi_squared` is at most 1
        (`VIEWS.likely`).
        """
        return math.hypot(self.distance, self.unsure) if self.chi_squared > VIEWS.likely else 0.0

    @property
    def shown(self) -> bool:
        """Whether noise and bias of the cameras do not explain the motion: its `chi_squared` is
        above 4 (`VIEWS.shown`).
        """
        return self.chi_squared > VIEWS.shown


def compare_views(views: Sequence[PointCloud]) -> list[float]:
    """Return the standard deviation [m] of each view's pose, estimated from the other views.

    It is 0 for a view whose distance from the others is explained by noise, or is unknown.

    The views [m], with normals, are in one frame, each with at most one camera. Raises
    `BadArgument` if two views are farther apart than 2.5 to 3 times their noise, or nowhere meet.
    It is also raised if points of a view stand before a surface that the camera of another view
    saw. The error names the two views that are farthest apart relative to their noise. A motion
    that noise does not explain raises the warning `MendedInput`.
    """
    surfaces = [_ViewSurface(view) for view in views]
    apart = list[tuple[float, float, float, tuple[int, int]]]()  # ratio, distance, limit, views
    shown = (0.0, (0, 0))  # the greatest error [m] that noise does not explain, and its views
    errors = [list[float]() for _ in views]  # those that the pairs of each view show
    for pair in itertools.combinations(range(len(views)), 2):
        one, other = (surfaces[row] for row in pair)
        limit = max(one.limit, other.limit)
        before = max(one.height_before(other), other.height_before(one))
        motion = _find_motion(one, other)
        far = before
        if motion is not None:
            far = max(before, motion.left, motion.shown * motion.shift)
            apart.append((*_judge(motion.shown * motion.error, VIEWS.refused * limit), pair))
            shown = max(shown, (motion.shown * motion.error, pair))
            for row in pair:
                errors[row].append(motion.error)
        apart.append((*_judge(far, VIEWS.shifted * limit), pair))
    ratio, distance, limit, pair = max(apart)
    if ratio > 1:
        _refuse_views(pair, distance, limit)
    _check_meeting(views)
    if shown[0] > 0:
        first, second = shown[1]
        said = f"views {first} and {second} are about {1e3 * shown[0]:.1f} mm apart"
        more = "standard deviations grow by it; align=True moves views together"
        warn_user(MendedInput, f"{said}: {more}")
    # Of three views one may be wrong: the lower median of its errors is that of the right ones.
    return [float(torch.tensor(each or [0.0], dtype=torch.float64).median()) for each in errors]


def compare_with(seen: PointCloud, view: PointCloud) -> float:
    """Return the standard deviation [m] of the pose of a `view`, estimated from earlier views.

    The cloud `seen` holds these. The result is 0 if noise explains the distance of the two clouds,
    or if they overlap too little. Both clouds have normals and are in one frame [m]. Raises
    `BadArgument` for a view that is too far off for its noise. Too far is a distance of 2.5 times
    the noise (`VIEWS.refused`), or a shift of 3 times (`VIEWS.shifted`). A lesser distance that
    noise does not explain raises the warning `MendedInput`.
    """
    one = _ViewSurface(seen)
    motion = _find_motion(one, _ViewSurface(view, one.noise))
    if motion is None:
        return 0.0
    far = motion.shown * motion.shift
    _, distance, limit = max(
        _judge(motion.shown * motion.error, VIEWS.refused * one.limit),
        _judge(max(far, motion.left), VIEWS.shifted * one.limit),
    )
    said = f"points about {1e3 * distance:.1f} mm off the cloud of the shape"
    if distance > limit:
        allowed = f"a view within {1e3 * limit:.1f} mm of it: check its pose"
        raise BadArgument("points", said, allowed)
    if not motion.shown:
        return 0.0
    warn_user(MendedInput, f"{said}: standard deviations grow by it; check their pose")
    return motion.error


def _judge(distance: float, limit: float) -> tuple[float, float, float]:
    """Return a distance [m] over its limit [m], and both."""
    return distance / limit, distance, limit


def align_views(views: Sequence[PointCloud]) -> list[tuple[Float[Tensor, "4 4"], float]]:
    """Return for each view (motion, error): the motion new_from_old (4, 4) [m] after which the
    views agree best, and its standard deviation [m].

    The standard deviation is that of the points along their normals. It estimates the motion that
    the overlap of the views does not show. A view that stays has the identity, and 0.

    The views [m] have normals and are in one frame. The first stays. Each other one is moved onto
    the views that are already placed. A motion that noise does not explain raises the warning
    `MendedInput`; for other motions the view stays. Raises `BadArgument` for a motion beyond 50 mm
    or 20 degrees.
    """
    placed = [views[0]]
    motions = [(torch.eye(4, dtype=torch.float64, device="cpu"), 0.0)] * len(views)
    left = list(range(1, len(views)))
    while left:
        points = torch.cat([view.points for view in placed])
        normals = [view.normals for view in placed if view.normals is not None]
        whole = _ViewSurface(PointCloud(points, torch.cat(normals)), noise_of(placed[0]))
        surfaces = {k: _ViewSurface(views[k]) for k in left}
        # the view with the greatest overlap comes first
        k = max(left, key=lambda row: whole.count_matches(surfaces[row]))
        left.remove(k)
        view = views[k]
        motion = _find_motion(whole, surfaces[k])
        if motion is not None and motion.shown:
            motions[k] = (motion.pose, motion.unsure)
            _tell_motion(k, motion)
            view = move(view, motion.pose)
        placed.append(view)
    return motions


def _tell_motion(number: int, motion: Motion) -> None:
    """Warn (`MendedInput`) that a view was moved; raise `BadArgument` if it was moved too far."""
    turn = math.degrees(float(rotation_angle(motion.pose[:3, :3])))
    found = f"view {number} moved by {1e3 * motion.shift:.1f} mm and turned by {turn:.1f} degrees"
    if motion.shift > MOTION.shift or turn > MOTION.turn:
        allowed = f"at most {1e3 * MOTION.shift:.0f} mm and {MOTION.turn:.0f} degrees"
        raise BadArgument("poses", found, f"poses that align=True changes by {allowed}")
    warn_user(MendedInput, f"align: {found}, onto the views before it")


def _refuse_views(views: tuple[int, int], distance: float, limit: float) -> None:
    """Raise `BadArgument` for two views with a `distance` [m] above the `limit` [m]."""
    first, second = sorted(views)
    found = f"views {first} and {second} about {1e3 * distance:.1f} mm apart: check their poses"
    allowed = f"views of one object that agree within {1e3 * limit:.1f} mm"
    raise BadArgument("clouds", found, f"{allowed}, or align=True")


def _check_meeting(views: Sequence[PointCloud]) -> None:
    """Raise `BadArgument` for two views that nowhere meet."""
    for first, second in itertools.permutations(range(len(views)), 2):
        other = views[second].points
        points = other[draw_rows(len(other), VIEWS.drawn)].double().cpu()
        gap = float(distance_behind(points, views[first]).quantile(VIEWS.meet))
        if gap > VIEWS.gap:
            _refuse_views((first, second), gap, VIEWS.gap)


class _ViewSurface:
    """The surface that one view shows, with what is needed to compare other views with it.

    `points` (n, 3) [m] have the outward unit `normals` (n, 3). `noise` [m] is that of the camera,
    by which `limit` [m] is set. `spacing` [m] is the usual distance of neighbours. `drawn` are the
    rows that are compared.
    """

    def __init__(self, view: PointCloud, noise: float | None = None) -> None:
        assert view.normals is not None
        points = view.points.double().cpu()
        rows = draw_rows(len(points), VIEWS.surface)
        kept = rows[find_inliers(points, rows)]
        self.noise = noise_of(view) if noise is None else noise
        self.limit = self.noise * (VIEWS.vague if view.viewpoint is None else 1.0)
        self.points = points[kept]
        self.normals = view.normals.double().cpu()[kept]
        self.drawn = draw_rows(len(kept), VIEWS.drawn)
        self.spacing = usual_spacing(self.points)
        self._tree = spatial.KDTree(self.points.numpy())
        self._eye = None if view.viewpoint is None or view.viewpoint.ndim == 2 else view.viewpoint

    def match(
        self, points: Points, normals: Points, most: float
    ) -> tuple[Bool[Tensor, "n"], Float[Tensor, "n"], Points]:
        """Return (matched, heights [m], normals) of points by their nearest points of the surface.

        Matched points face the same way, and have a surface point under or over them. They are at
        most `most` [m] high.
        """
        distance, row = map(torch.from_numpy, self._tree.query(points.numpy()))
        own = self.normals[row]
        height = ((points - self.points[row]) * own).sum(-1)
        beside = (distance.square() - height.square()).clamp_min(0).sqrt()
        matched = dot(normals, own) > VIEWS.same
        matched = matched & (beside < VIEWS.reach * self.spacing) & (height.abs() < most)
        return matched, height, own

    def count_matches(self, other: "_ViewSurface") -> int:
        """Return how many compared points of another view match."""
        rows = other.drawn
        return int(self.match(other.points[rows], other.normals[rows], MOTION.first)[0].sum())

    def height_before(self, other: "_ViewSurface") -> float:
        """Return how high [m] another view stands before this surface, as its camera saw it. Return
        0 without a camera, or if too few points can be compared.
        """
        if self._eye is None:
            return 0.0
        eye = self._eye.double().cpu()
        # the camera saw only what faces it
        facing = ((eye - self.points) * self.normals).sum(-1) > 0
        seen = self.points[facing]
        if len(seen) < VIEWS.least:
            return 0.0
        rays: Any = unit(seen - eye)
        points = other.points[other.drawn]
        asked = unit(points - eye).numpy()
        aside, row = map(torch.from_numpy, spatial.KDTree(rays.numpy()).query(asked))
        height = ((points - seen[row]) * self.normals[facing][row]).sum(-1)
        before = norm(points - eye) < norm(seen[row] - eye)
        compared = aside < VIEWS.reach * usual_spacing(rays)
        if int(compared.sum()) < VIEWS.least:
            return 0.0
        # all that is not before the surface is hidden
        height = torch.where(before, height.clamp_min(0), 0.0)
        return float(height[compared].quantile(VIEWS.seen))


def _find_motion(fixed: _ViewSurface, view: _ViewSurface) -> Motion | None:
    """Return the most likely motion of a view onto a fixed one; None if they overlap too little.

    It starts at the given pose, and minimises Tukey's loss with the priors of `MOTION`. The loss is
    that of the heights of matching points over the other surface, both ways.
    """
    centre = view.points.mean(0)
    arms = view.points - centre
    noise = math.hypot(fixed.noise, view.noise)
    usual = torch.tensor([MOTION.shifted] * 3 + [MOTION.turned] * 3, dtype=torch.float64)
    prior = usual**-2
    step = torch.zeros(6, dtype=torch.float64)  # shift [m], turn [rad]
    most = MOTION.first
    last = MOTION.last * noise
    height = torch.empty(0)
    moments = torch.diag(prior)
    for _ in range(MOTION.steps):
        jacobian, height = _linearise(fixed, view, centre, step, most)
        if len(height) < VIEWS.least:
            return None
        weight = (1 - (height / most).square()).square() / (noise**2 * MOTION.repeated)
        weighted = jacobian * weight[:, None]
        moments = weighted.T @ jacobian + torch.diag(prior)
        change = -torch.linalg.solve(moments, weighted.T @ height + prior * step)
        step = step + change
        if most == last and float(change.abs().max()) < MOTION.still:
            break
        most = max(MOTION.shrink * most, last)
    along = (_displacement(step, arms) * view.normals).sum(-1)
    distance = float(along.square().mean().sqrt())
    # the part of a motion that the overlap does not show, by its variance along the normals
    by_step = _by_step(view.normals, arms)
    spread = float((by_step * torch.linalg.solve(moments, by_step.T).T).sum())
    hidden = min(spread / float((by_step.square() / prior).sum()), MOTION.hidden)
    unsure = distance * math.sqrt(hidden / (1 - hidden))
    rotation = rotation_from_vector(step[3:])
    pose = turned_about(rotation, centre, step[:3])
    left = MOTION.gaussian * float(height.abs().median())
    chi_squared = float(step @ (moments - torch.diag(prior)) @ step)
    return Motion(pose, float(step[:3].norm()), distance, unsure, left, chi_squared)


def _displacement(step: Float[Tensor, "6"], arms: Points) -> Points:
    """Return how far points at the `arms` [m] move: a shift [m], and a turn [rad] about their
    middle.
    """
    return arms @ rotation_from_vector(step[3:]).T + step[:3] - arms


def _by_step(normals: Points, arms: Points) -> Float[Tensor, "n 6"]:
    """Return the derivatives of the motions of points along their `normals` by a step of the view.

    `arms` [m] are the places of the points from the middle about which the step turns.
    """
    return torch.cat([normals, torch.linalg.cross(arms, normals)], -1)


def _linearise(
    fixed: _ViewSurface, view: _ViewSurface, centre: Vector, step: Float[Tensor, "6"], most: float
) -> tuple[Float[Tensor, "m 6"], Float[Tensor, "m"]]:
    """Return (jacobian, heights [m]) of the matching points of two views, of both over the other.

    The view is moved by a `step`: a shift [m], and a turn [rad] about the `centre` [m]. Columns of
    the jacobian are the derivatives by both.
    """
    turn = rotation_from_vector(step[3:])
    arms = (view.points[view.drawn] - centre) @ turn.T
    normals = view.normals[view.drawn] @ turn.T
    over, height, own = fixed.match(arms + centre + step[:3], normals, most)
    rows = [_by_step(own, arms)[over]]
    heights = [height[over]]
    # the fixed points in the frame of the view
    arms = fixed.points[fixed.drawn] - centre - step[:3]
    normals = fixed.normals[fixed.drawn] @ turn
    over, height, own = view.match(arms @ turn + centre, normals, most)
    own = own @ turn.T
    rows.append(-_by_step(own, arms)[over])
    heights.append(height[over])
    return torch.cat(rows), torch.cat(heights)
