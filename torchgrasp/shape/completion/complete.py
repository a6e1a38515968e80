"""Completion of the hidden side by mirror images of the visible side, and of the bars of a frame by
their width.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.neighbours import nearest
from torchgrasp.foundation.base import Batch, Value, join
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.rules import Count, Pose
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.linalg import farthest_points, reflect, reflect_directions, unit
from torchgrasp.shape.completion.axis import Revolution, find_axis, find_revolution
from torchgrasp.shape.completion.ellipsoid import find_ellipsoid
from torchgrasp.shape.completion.silhouette import FRONT_MARGIN, TIE, Outlines
from torchgrasp.shape.completion.symmetry import (
    PROBES,
    Mirror,
    SymmetryScorer,
    find_plane_through_axis,
    find_planes,
    planes_near,
)
from torchgrasp.shape.posterior import symmetric_root
from torchgrasp.values.planning import PointCloud

# least distance [m] of a hidden point from the cloud and from another hidden point
NEW = 0.006
SPACING = 0.004
# standard deviation [m] of a mirrored point of an object that is symmetric about that very plane
LEAST_NOISE = 0.003
# score of a symmetric object, and asymmetry [m] for each 1 of score below
SYMMETRIC = 0.45
ASYMMETRY = 0.060
PART = (
    0.02  # length scale [m] of the asymmetry: a part without a mirror image is missing as a whole
)
THIN = 0.012  # width [m] below which a part is a bar: that of a fingertip
TEMPERATURE = 0.1  # a plane's probability is proportional to exp(score / temperature)
# planes near a plane: steps of an axis, angle [rad], shift / size
NEARBY = 5
NEARBY_ANGLE = 0.15
NEARBY_SHIFT = 0.045
Kind = Literal["ball", "revolution", "mirrored", "guess", "cut off", "vessel", "whole"]
"""What the hidden side was estimated from: an ellipsoid, an axis, mirror planes, or only the
outline (a guess).
"""
SomeHidden = TypeVar("SomeHidden", bound=Any)  # a batch with `points` [m]


@dataclasses.dataclass(frozen=True)
class Completion(Value):
    """Estimated points of the hidden side, with their errors along the normals.

    The errors have the covariance LEAST_NOISE^2 I + D D^T [m^2], where I is the identity and D is
    `deviations`.
    """

    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    shared: Float[
        Tensor, "m c"
    ]  # standard deviations [m] of the errors that each mirror plane causes
    asymmetry: Float[
        Tensor, "m"
    ]  # standard deviation [m] of a smooth error, because the object is not quite symmetric
    planes: Float[
        Tensor, "p 4"
    ]  # planes n.x = o, as (n, o); for each part of the object, its best plane is first
    scores: Float[
        Tensor, "p"
    ]  # of the planes: 1 if the mirror image lies on the cloud, near 0 if nothing confirms it
    outline: Outlines
    kind: Kind  # how the hidden side was completed, which selects the calibration
    frame: bool = False  # whether the object is a frame of bars round an empty middle

    @checked
    def moved(self, b_from_a: Pose) -> "Completion":
        """Return the completion transformed from frame a to frame b."""
        normals = rotate(b_from_a, self.planes[:, :3])
        planes = torch.cat([normals, self.planes[:, 3:] + normals @ b_from_a[:3, 3:]], 1)
        points = apply(b_from_a, self.points)
        turned = rotate(b_from_a, self.normals)
        outline = self.outline.moved(b_from_a)
        return dataclasses.replace(
            self, points=points, normals=turned, planes=planes, outline=outline
        )

    @property
    def deviations(self) -> Float[Tensor, "m k"]:
        """The correlated errors D [m] of the points along their normals, one column for each
        independent cause.
        """
        return correlated_errors(self.points, self.shared, self.asymmetry)


def correlated_errors(
    points: Float[Tensor, "m 3"], shared: Float[Tensor, "m c"], local: Float[Tensor, "m"] | float
) -> Float[Tensor, "m k"]:
    """Return errors [m] of points, one column per independent cause: the shared errors, then a
    smooth random field.

    At each point, the field has the standard deviation of the `local` and the `shared` errors
    together.
    """
    deviation = torch.sqrt(local**2 + (shared**2).sum(1))
    alike = torch.exp(-0.5 * (torch.cdist(points, points) / PART) ** 2)
    return torch.cat(
        [shared, deviation[:, None] * symmetric_root(alike, 1.0, "keep hidden points apart")], 1
    )


@checked
def complete_cloud(cloud: PointCloud, table: float | None = None, budget: Count = 50) -> Completion:
    """Return at most `budget` points of the hidden side, from the cloud's symmetry, with their
    uncertainty.

    The cloud is mirrored across its best planes and across pairs of them; images in better planes
    come first. A body of revolution and a part attached to it, such as a handle, are mirrored
    separately, in the frame of the axis.

    The cloud must be clean, with outward normals and viewpoints, or `BadArgument` is raised.
    `table` is the height [m] of a table with normal z.
    """
    if cloud.normals is None or cloud.viewpoint is None:
        raise BadArgument(
            "cloud",
            "no normals or no viewpoint",
            "outward normals and viewpoints: see prepare_cloud",
        )
    scorer = SymmetryScorer.of(cloud.to("cpu", torch.float64), table)
    outline = scorer.outline
    none = scorer.points[:0]
    no_plane = scorer.points.new_zeros(0, 4)
    if outline.cut:  # an image's border is no outline, and half an object is not symmetric
        return Completion(
            none, none, none[:, :0], none[:, 0], no_plane, none[:, 0], outline, "cut off"
        )
    ball = find_ellipsoid(scorer.points, scorer.normals, outline, table)
    if ball is not None:
        rows = torch.nonzero(_hidden(scorer, ball.points))[:, 0]
        rows = rows[farthest_points(ball.points[rows], budget, tie=TIE)]
        points = ball.points[rows]
        misfit = torch.full_like(ball.points[rows, 0], ball.misfit)
        shared = ball.deviations[rows]
        return Completion(
            points, ball.normals[rows], shared, misfit, no_plane, none[:, 0], outline, "ball"
        )
    round_body = None if table is None else find_revolution(scorer.points, scorer.normals)
    axis = find_axis(scorer) if round_body is None else None
    if axis is not None:
        scorer = scorer.about_axis(axis[0])
        round_body = axis[1]
    parts = _split(scorer, round_body)
    planes = torch.cat([part.planes for part in parts])
    scores = torch.cat([part.scores for part in parts])
    images = sorted(_mirror(parts), key=lambda image: -image.score)

    def allowed(image: _Image, apart: float = NEW) -> Bool[Tensor, "n"]:
        hidden = _hidden(scorer, image.points, apart)
        if scorer.table is None:
            return hidden
        # Free space already bounds the shape at the face on the table.
        return hidden & ~(
            (scorer.table.height(image.points) < 0.004)
            & (image.normals @ scorer.table.normal < -0.7)
        )

    merged = merge_hidden(_Image.of(scorer, none, none, len(planes)), images, allowed, _thin)
    frame = _is_frame(scorer)
    if frame:
        merged = merge_hidden(
            merged, [_back_of_bars(scorer, len(planes))], lambda image: allowed(image, 0.0), _thin
        )
    chosen = merged[farthest_points(merged.points, budget, tie=TIE)]
    shared = chosen.shared.flatten(1)
    asymmetry = chosen.variance.sqrt()
    kind: Kind = "guess" if not len(planes) else "mirrored" if round_body is None else "revolution"
    found = Completion(
        chosen.points,
        chosen.normals,
        shared,
        asymmetry,
        planes,
        scores,
        scorer.outline,
        kind,
        frame,
    )
    return found if axis is None else found.moved(inverse(axis[0]))


class _Part(NamedTuple):
    """A part of the cloud, the points with the indices `rows`, with its own mirror planes and their
    scores.
    """

    scorer: SymmetryScorer
    rows: Tensor
    planes: Float[Tensor, "p 4"]
    scores: Float[Tensor, "p"]


@dataclasses.dataclass(frozen=True)
class _Image(Batch):
    """The mirrored points [m] of a part, with score and errors."""

    points: Tensor
    normals: Tensor
    score: float  # infinite if the part is not mirrored
    variance: Float[Tensor, "n"]  # [m^2], due to asymmetry
    shared: Float[
        Tensor, "n planes near"
    ]  # shift [m] for each nearby plane, weighted by the root of its probability

    @classmethod
    def of(cls, scorer: SymmetryScorer, points: Tensor, normals: Tensor, n_planes: int) -> "_Image":
        """Return unmirrored points as an image of infinite score, without errors."""
        shared = points.new_zeros(len(points), n_planes, NEARBY ** (2 if scorer.upright else 3))
        return cls(points, normals, math.inf, torch.zeros_like(points[:, 0]), shared)


def _split(scorer: SymmetryScorer, revolution: Revolution | None) -> list[_Part]:
    """Split the cloud into a body of revolution and an attached part, such as a handle, or return
    the whole cloud.
    """
    every = torch.arange(len(scorer.points), device="cpu")
    if revolution is None:
        return [_Part(scorer, every, *find_planes(scorer))]
    rows = every[revolution.body]
    rest = every[~revolution.body]
    body = scorer.for_part(rows)
    attached = scorer.for_part(rest)
    parts = [_Part(body, rows, *find_planes(body, turned=True))]
    if len(rest) >= 20:
        plane = find_plane_through_axis(attached, revolution.center, scorer.points[rest])
        parts.append(_Part(attached, rest, *plane))
    return parts


def _mirror(parts: list[_Part]) -> list[_Image]:
    """Return the mirror images of each part of the cloud in its symmetry planes, singly and in
    pairs.
    """
    total = sum(len(part.planes) for part in parts)
    images = []
    before = 0
    for part in parts:
        scorer = part.scorer
        points = part.scorer.points[part.rows]
        normals = part.scorer.normals[part.rows]
        if len(points) == len(
            scorer.points
        ):  # the outline is of the whole cloud; its images are edges of the far side
            points = torch.cat([points, scorer.outline.rim])
            normals = torch.cat([normals, scorer.outline.rim_normals])
        original = _Image.of(scorer, points, normals, total)
        planes = enumerate(zip(part.planes, part.scores.tolist(), strict=True), start=before)
        mirrors = [_mirror_in(scorer, number, plane, score) for number, (plane, score) in planes]
        once = [mirror(original) for mirror in mirrors]
        twice = [
            mirror(image)
            for i, image in enumerate(once[:2])
            for j, mirror in enumerate(mirrors)
            if i != j
        ]
        images += once + twice
        before += len(mirrors)
    return images


def _mirror_in(
    scorer: SymmetryScorer, number: int, plane: Mirror, score: float
) -> Callable[[_Image], _Image]:
    """Return a function that mirrors points in a plane; how images in nearby planes differ gives
    the points' errors.
    """
    steps = torch.linspace(-1.0, 1.0, NEARBY, dtype=plane.dtype, device="cpu")
    near = planes_near(scorer, plane, NEARBY_ANGLE * steps, NEARBY_SHIFT * scorer.size * steps)
    weight = torch.softmax(scorer.score(near)[0] / TEMPERATURE, 0)

    def mirror(of: _Image) -> _Image:
        points = reflect(of.points, plane)
        normals = reflect_directions(of.normals, plane)
        shift = ((reflect(of.points, near[:, None]) - points) * normals).sum(-1)
        shared = of.shared.clone()  # a mirror leaves errors across the surface as they are
        shared[:, number] += (weight.sqrt()[:, None] * shift).T
        variance = of.variance + (ASYMMETRY * max(SYMMETRIC - score, 0.0)) ** 2
        return _Image(
            points,
            normals,
            score if math.isinf(of.score) else min(of.score, score) - 0.05,
            variance,
            shared,
        )

    return mirror


def _is_frame(scorer: SymmetryScorer) -> bool:
    """Tell whether the middle of the cloud is empty: outside the outline or close to it, and over
    `THIN` from it.
    """
    middle = (scorer.points.amin(0) + scorer.points.amax(0)) / 2
    away = float(torch.cdist(middle[None], scorer.points).amin())
    return away > THIN and float(scorer.outline.hull_distance(middle)) > -0.5 * away


def _back_of_bars(scorer: SymmetryScorer, n_planes: int) -> _Image:
    """Return points on the far side of parts narrower than `THIN`: a thin bar is about as deep as
    it is wide.

    The points lie behind the middle of a bar, across its direction. Their standard deviation is
    half of the width.
    """
    # the neighbours with which normals are fitted
    points = scorer.points
    near = nearest(scorer.points, 30)[1]
    half = -scorer.outline.hull_distance(points)
    width = 2 * half[near].amax(1)
    rows = torch.nonzero((2 * half > 0.8 * width) & (width < THIN))[:, 0]
    rows = rows[farthest_points(points[rows], 2 * PROBES, tie=TIE)]
    around = points[near[rows]]
    width = width[rows]
    bar = torch.linalg.svd(around - around.mean(1, keepdim=True), full_matrices=False).Vh[:, 0]
    rays = points[rows, None] - torch.stack([view.viewpoint for view in scorer.outline.views])
    facing = (rays * scorer.normals[rows, None]).sum(-1).argmin(1)
    ray = unit(rays[torch.arange(len(rows), device="cpu"), facing])
    back = unit(ray - (ray * bar).sum(1, keepdim=True) * bar)
    image = _Image.of(scorer, points[rows] + width[:, None] * back, back, n_planes)
    return dataclasses.replace(image, variance=(0.5 * width) ** 2)


def merge_hidden(
    merged: SomeHidden,
    parts: Iterable[SomeHidden],
    allowed: Callable[[SomeHidden], Bool[Tensor, "n"]],
    thin: Callable[[Float[Tensor, "n 3"]], Int[Tensor, "k"]],
) -> SomeHidden:
    """Add to `merged` the points of each part that are `allowed` and farther than `SPACING` [m]
    from earlier points.

    `thin` selects the points of a part to keep: it returns their indices.
    """
    for part in parts:
        new = part[allowed(part)]
        if len(merged) and len(new):
            distance, _ = spatial.KDTree(merged.points.numpy()).query(new.points.numpy())
            new = new[torch.from_numpy(distance) > SPACING]
        merged = join([merged, new[thin(new.points)]])
    return merged


def _hidden(
    scorer: SymmetryScorer, points: Float[Tensor, "n 3"], apart: float = NEW
) -> Bool[Tensor, "n"]:
    """Tell which points are hidden in every view, not below the table, and farther than `apart` [m]
    from the cloud.
    """
    hidden = (scorer.nearest(points)[0] > apart) & scorer.outline.hides(points)
    return (
        hidden if scorer.table is None else hidden & (scorer.table.height(points) > -FRONT_MARGIN)
    )


def _thin(points: Float[Tensor, "n 3"]) -> Int[Tensor, "k"]:
    """Return the indices of points that are at least `SPACING` apart, earlier points first."""
    apart = (
        torch.cdist(points, points) >= SPACING
    ).numpy()  # NumPy's calls cost a quarter of torch's
    keep = np.ones(len(points), dtype=bool)
    for i in range(len(points)):
        if keep[i]:
            keep[i + 1 :] &= apart[i, i + 1 :]
    return torch.nonzero(torch.from_numpy(keep))[:, 0]
