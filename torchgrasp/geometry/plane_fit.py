"""Planes that hold many points of a view: triples of points propose them, and robust least squares
refines them.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, Vector, dot, norm, number_cells, unit


@dataclasses.dataclass(frozen=True)
class PlaneNumbers:
    """Parameters of the random search for planes in a cloud."""

    noise: float = 0.001
    """Assumed standard deviation [m] of the noise of a depth camera that is near."""
    noise_growth: float = 0.0035
    """Assumed growth of this noise with the squared distance [1/m]."""
    distance: float = 0.7
    """Assumed distance [m] of a camera whose position is unknown."""
    planes: int = 8
    """Greatest number of planes that are found in a view."""
    scored: int = 2000
    """Greatest number of points by which a proposed plane is scored."""
    triples: int = 4000
    """Number of triples of random points, which may be far apart, that propose a plane."""
    neighbours: int = 60
    """Number of nearest points from which a triple of neighbours is drawn."""
    least_height: float = 10.0
    """Least height of a triangle, in multiples of the noise: the normal of a lower one is mostly
    noise.
    """
    least_side: float = 1e-12
    """Least side [m] by which a triangle's area is divided."""
    at_once: int = 500
    """Number of proposed planes that are scored at once, which bounds the memory."""
    least_share: float = 0.05
    """Least share of a view's points on two parallel levels. The search for planes ends at half
    this share.
    """
    most_tilt: float = 30.0
    """Greatest angle [deg] between the normal of a plane and the upward direction, if that is
    known.
    """
    tilt_slack: float = 5.0
    """Angle [deg] by which a proposed plane may tilt more, because the fit may tilt it back."""
    reach: float = 0.30
    """Greatest height [m] above a plane of points that count as of objects on it."""
    rough: float = 2.5
    """Ratio of measured to assumed noise (the scale of a plane) from which on a surface is not
    flat.
    """
    smooth: float = 0.2
    """Least value of this scale: the points may be more exact than the assumed noise."""
    core: float = 3.0
    """Greatest distance of a point that counts as on a plane, in multiples of assumed noise times
    scale.
    """
    quantile: float = 0.25
    """Quantile of the distances from a plane by which the scale is measured: few points of objects
    count in it.
    """
    per_quantile: float = 3.14
    """Ratio of the standard deviation to this quantile, for normally distributed residuals."""
    tukey: float = 4.685
    """Residual, in multiples of the noise times the scale, from which on a point has no weight.
    With it, Tukey's fit of normally distributed residuals has 95 % of the efficiency of least
    squares.
    """
    steps: int = 30
    """Greatest number of steps of a plane's fit."""
    patch: float = 0.05
    """Width [m] of the patches of points that show the normal which parallel levels share. Few
    patches hold a step between levels.
    """
    flattest: float = 1.5
    """Greatest scatter of a patch without a step, over the median scatter of the patches."""
    rounds: int = 3
    """Number of rounds in which patches with a step are left out."""
    offsets: int = 100
    """Number of heights at which each of two parallel levels is sought."""
    aslant: float = 10.0
    """Greatest angle [deg] between two parallel levels and one plane through both."""
    mixed: float = 0.7
    """Least scale of a plane that may be a fit aslant through two levels."""
    again: float = 0.001
    """Difference of two planes (of the normals, plus that of the offsets [m]) below which they are
    the same.
    """
    both: float = 0.7
    """Least number of points on two levels, as a share of those on one plane through both."""
    still: float = 1e-12
    """Change of a plane in a step (of its normal, and of its offset [m]) below which its fit ends.
    """


PLANES = PlaneNumbers()


def assume_noise(
    points: Float[Tensor, "n 3"], eye: Float[Tensor, "3"] | None
) -> Float[Tensor, "n"]:
    """Return the assumed depth noise (n,) [m], a standard deviation, of points (n, 3) [m] of a
    view.

    The noise grows with the squared distance from the camera. `eye` (3,) [m] is its position in the
    frame of the points. None means an unknown camera, which is taken to be 0.7 m
    (`PLANES.distance`) from each point.
    """
    if eye is None:
        squared = torch.full((len(points),), PLANES.distance**2, dtype=points.dtype, device="cpu")
    else:
        squared = (points - eye).square().sum(-1)
    return PLANES.noise + PLANES.noise_growth * squared


class SeenPoints:
    """The n points of one view, in which planes are sought. All vectors are in one frame, whose
    origin is near the mean of the points.

    Args:
        points: the points (n, 3) [m].
        eye: position (3,) [m] of the camera; None if it is unknown.
        sky: unit vector (3,) against gravity; None if it is unknown.
        image_up: unit vector (3,) that points up in the camera's image; None if it is unknown.

    The attribute `noise` (n,) [m] is the assumed standard deviation of each point's noise.
    """

    def __init__(
        self,
        points: Points,
        eye: Vector | None,
        sky: Vector | None,
        image_up: Vector | None = None,
    ) -> None:
        self.points = points
        self.eye = eye
        self.sky = sky
        self.image_up = image_up
        self.noise = assume_noise(points, eye)

    def part(self, of: Bool[Tensor, "n"]) -> "SeenPoints":
        """Return a view of only those points that are in the mask `of` (n,), in the same frame."""
        return SeenPoints(self.points[of], self.eye, self.sky, self.image_up)


@dataclasses.dataclass(frozen=True)
class PlaneFit:
    """A plane normal . p = offset, fitted to many points p [m] of a view.

    It is in the frame of the view. `scale` is the ratio of the measured to the assumed noise of the
    `count` points on it. Noise is the standard deviation [m] of their distances from the plane.
    """

    normal: Float[Tensor, "3"]  # unit normal (3,)
    offset: float  # distance [m] of the plane from the origin along the normal
    scale: float  # ratio of the measured to the assumed noise of the points on the plane
    count: int  # number of points on the plane

    def turned_up(self, view: "SeenPoints") -> "PlaneFit":
        """Return the same plane, with its normal turned to the side that is up.

        `view` holds all points of the view, and what is known of its directions. The normal is
        turned to the upward direction `view.sky`. If that is unknown, it is turned to the camera.
        If the camera is unknown, too, it is turned to the side on which most points are. Then each
        point counts by its distance from the plane, at most by 0.3 m (`PLANES.reach`).
        """
        if view.sky is not None:
            side = float(self.normal @ view.sky)
        elif view.eye is not None:
            side = float(self.normal @ view.eye) - self.offset
        else:
            heights = view.points @ self.normal - self.offset
            side = float(heights.clamp(-PLANES.reach, PLANES.reach).sum())
        if side >= 0:
            return self
        return dataclasses.replace(self, normal=-self.normal, offset=-self.offset)


def fit_planes(view: SeenPoints, generator: torch.Generator) -> Iterator[PlaneFit]:
    """Yield planes in a view, each the one with most of the points that no earlier plane holds.

    At most 8 planes (`PLANES.planes`) are sought. One that goes aslant through two parallel levels
    is replaced by both. The search ends when every further plane holds less than 2.5 % of all
    points (half of `PLANES.least_share`). Points on earlier planes do not count. There may be no
    plane. `generator` draws the triples of points that propose planes.
    """
    points = view.points[: PLANES.scored]
    noise = view.noise[: PLANES.scored]
    normals, offsets = _propose(view, generator)
    held = _held(points, noise, normals, offsets)  # (m, n)
    left = torch.ones(len(points), dtype=torch.float32, device="cpu")
    rest = torch.ones(len(view.points), dtype=torch.bool, device="cpu")
    found = list[PlaneFit]()
    for _ in range(PLANES.planes if len(held) else 0):
        counts = held @ left
        i = int(counts.argmax())
        if int(counts[i]) < 0.5 * PLANES.least_share * len(points):
            break
        fit = refine_plane(view, normals[i], float(offsets[i]))
        if any(_is_same(fit, other) for other in found):
            # the larger plane has drawn the fit away
            fit = refine_plane(view.part(rest), normals[i], float(offsets[i]))
        left = left * (1 - held[i])
        for plane in _levels(view, fit) or [fit]:
            rough = plane.scale >= PLANES.rough
            as_proposed = dataclasses.replace(fit, normal=normals[i], offset=float(offsets[i]))
            found.append(as_proposed if rough else plane)
            yield found[-1]
            height = (view.points @ plane.normal - plane.offset).abs()
            rest &= height > PLANES.core * view.noise
            left = left * (height > PLANES.core * view.noise)[: len(left)]


def _is_same(fit: PlaneFit, other: PlaneFit) -> bool:
    """Return whether two fits are of one plane."""
    turn = float((fit.normal * torch.sign(fit.normal @ other.normal) - other.normal).abs().max())
    shift = abs(fit.offset * float(torch.sign(fit.normal @ other.normal)) - other.offset)
    return turn + shift < PLANES.again


def _levels(view: SeenPoints, fit: PlaneFit) -> list[PlaneFit]:
    """Return the two parallel levels through which a fit goes aslant, as through two floors. Return
    an empty list if it is one plane.
    """
    if fit.scale < PLANES.mixed:
        return []
    height = (view.points @ fit.normal - fit.offset).abs()
    left = view.part(height < PLANES.core * fit.scale * view.noise)
    if len(left.points) < PLANES.least_share * len(view.points):
        return []
    normal = _common_normal(left.points, fit.normal)
    if float(normal @ fit.normal) < math.cos(math.radians(PLANES.aslant)):
        return []
    levels = list[PlaneFit]()
    while len(levels) < 2 and len(left.points):
        heights = left.points @ normal
        some = heights[: PLANES.scored]
        offsets = some.quantile(torch.linspace(0, 1, PLANES.offsets).to(some))
        held = (some - offsets[:, None]).abs() < 2 * left.noise[: PLANES.scored]
        offset = float(offsets[held.sum(1).argmax()])
        # the other level would pull at the plane
        near = (view.points @ normal - offset).abs() < PLANES.core * view.noise
        level = refine_plane(view.part(near), normal, offset)
        if levels:
            # the smaller level is parallel: things on it would tilt it
            moved = float((view.points[near] @ normal).median())
            level = dataclasses.replace(level, normal=normal, offset=moved)
        normal = level.normal
        beside = (left.points @ normal - level.offset).abs() > PLANES.core * left.noise
        left = left.part(beside)
        levels.append(level)
    # each is as flat as the noise: tops of things are not
    if len(levels) < 2 or max(level.scale for level in levels) > 1:
        return []
    if sum(level.count for level in levels) < PLANES.both * fit.count:
        return []
    gap = abs(levels[0].offset - levels[1].offset)
    apart = PLANES.core * float(view.noise.median()) * (levels[0].scale + levels[1].scale)
    return levels if gap > apart else []


def _common_normal(points: Points, normal: Vector) -> Vector:
    """Return the unit normal that parallel levels of points [m] near a plane share, whatever their
    offsets: it is fitted to patches of them, without those in which a step lies.
    """
    patch = number_cells(points @ plane_axes(normal, points), PLANES.patch)
    count = torch.bincount(patch).to(points)
    middle = points.new_zeros(len(count), 3).index_add_(0, patch, points) / count[:, None]
    rest = points - middle[patch]
    kept = torch.ones_like(patch, dtype=torch.bool)
    turned = normal
    for _ in range(PLANES.rounds):
        turned = torch.linalg.eigh(rest[kept].T @ rest[kept]).eigenvectors[:, 0]
        scatter = (torch.bincount(patch, (rest @ turned).square()) / count)[patch]
        kept = scatter <= PLANES.flattest * scatter.median()
    return turned if float(turned @ normal) > 0 else -turned


def plane_axes(normal: Vector, points: Points) -> Float[Tensor, "3 2"]:
    """Return two perpendicular unit vectors, the columns of (3, 2), in the plane of a unit normal.

    The points (n, 3) define the vectors. The first one points from their mean to their first point,
    along the plane. If points and normal are rotated, the vectors rotate alike.
    """
    side = points[0] - points.mean(0)
    x = unit(side - (side @ normal) * normal)
    return torch.stack([x, torch.linalg.cross(normal, x)], -1)


def _propose(
    view: SeenPoints, generator: torch.Generator
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m"]]:
    """Return unit normals and offsets [m] of planes through random triples of points, distant or
    neighbouring.
    """
    points = view.points
    some = points[: PLANES.scored]
    tree = spatial.KDTree(some.numpy())
    near = torch.from_numpy(tree.query(some.numpy(), min(PLANES.neighbours, len(some)))[1])
    pick = torch.randint(near.shape[1], (2, len(some), 1), generator=generator, device="cpu")
    drawn = torch.randint(len(points), (3, PLANES.triples), generator=generator, device="cpu")
    beside = [some[near.gather(1, k)[:, 0]] for k in pick]
    a, b, c = torch.cat([points[drawn], torch.stack([some, *beside])], 1)
    normal = torch.linalg.cross(b - a, c - a)
    double_area = norm(normal)
    longest = norm(torch.stack([b - a, c - a, c - b])).amax(0)
    height = double_area / longest.clamp_min(PLANES.least_side)
    wide = height > PLANES.least_height * view.noise.median()
    normal = normal[wide] / double_area[wide, None]
    offset = dot(normal, a[wide])
    if view.sky is not None:
        tilt = math.radians(PLANES.most_tilt + PLANES.tilt_slack)
        upright = (normal @ view.sky).abs() > math.cos(tilt)
        normal = normal[upright]
        offset = offset[upright]
    return normal, offset


def _held(
    points: Float[Tensor, "n 3"],
    noise: Float[Tensor, "n"],
    normals: Float[Tensor, "m 3"],
    offsets: Float[Tensor, "m"],
) -> Float[Tensor, "m n"]:
    """Return a matrix of planes by points. It is 1 if the point is within twice its noise of the
    plane, else 0.
    """
    held = torch.empty(len(normals), len(points), dtype=torch.float32, device="cpu")
    parts = (x.split(PLANES.at_once) for x in (held, normals, offsets[:, None]))
    for part, normal, offset in zip(*parts, strict=True):
        height = (normal @ points.T).sub_(offset)
        torch.lt(height.abs_(), 2 * noise, out=part)
    return held


def refine_plane(view: SeenPoints, normal: Float[Tensor, "3"], offset: float) -> PlaneFit:
    """Return the plane near a given one that best fits the points of a view.

    The given plane has the unit vector `normal` and the `offset` [m] along it, in the frame of the
    view. The normal of the result points to the same side. Least squares are iterated with Tukey's
    weights, which change smoothly with the points.
    """
    points = view.points
    noise = view.noise
    variance = noise.square()
    scale = 1.0
    for _ in range(PLANES.steps):
        ratio = (points @ normal - offset) / noise
        size = ratio.abs()
        core = size[size < PLANES.core * scale]
        if len(core):
            # torch.quantile sorts all numbers, which takes several times as long
            measured = PLANES.per_quantile * float(np.quantile(core.numpy(), PLANES.quantile))
            scale = min(max(measured, PLANES.smooth), PLANES.rough)
        share = (ratio / (PLANES.tukey * scale)).square()
        weight = (1 - share).clamp_min(0).square() / variance
        weight = weight / weight.sum()
        mean = weight @ points
        offset_points = points - mean
        spread = offset_points.T @ (weight[:, None] * offset_points)
        turned = torch.linalg.eigh(spread).eigenvectors[:, 0]
        turned = turned if float(turned @ normal) > 0 else -turned
        moved = float(mean @ turned)
        change = float((turned - normal).abs().max()) + abs(moved - offset)
        normal = turned
        offset = moved
        if change < PLANES.still:
            break
    on = ((points @ normal - offset).abs() / noise) < PLANES.core * scale
    return PlaneFit(normal, offset, scale, int(on.sum()))
