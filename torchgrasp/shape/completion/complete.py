"""Completion of the hidden side of a view. Mirror images of the visible side complete it, and the
bars of a frame are completed by their width.
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
from torchgrasp.foundation.base import Batch, Value, flatnonzero, join
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.rules import Count, Pose
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.linalg import Points, reflect, reflect_directions, unit
from torchgrasp.shape.completion.axis import Revolution, find_axis, find_revolution
from torchgrasp.shape.completion.ellipsoid import find_ellipsoid
from torchgrasp.shape.completion.silhouette import OUTLINE, Outlines, pick_apart
from torchgrasp.shape.completion.symmetry import (
    SYMMETRY,
    Mirror,
    SymmetryScorer,
    find_plane_through_axis,
    find_planes,
    planes_near,
)
from torchgrasp.shape.posterior import symmetric_root
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class HiddenNumbers:
    """Parameters of the estimated points that complete a cloud on the object's hidden side."""

    new: float = 0.006
    """Least distance [m] of a hidden point from the points of the cloud."""
    spacing: float = 0.004
    """Least distance [m] between two hidden points."""
    noise: float = 0.003
    """Standard deviation [m] of a mirrored point of an object that is exactly symmetric."""
    part: float = 0.02
    """Distance [m] over which errors of hidden points, due to an asymmetry of the object, are alike
    (correlated). A part that has no mirror image is missing as a whole.
    """
    foot: float = 0.004
    """Greatest height [m] above the table of points on the face on which the object stands."""
    down: float = -0.7
    """Greatest component, along the upward direction, of the unit normals of the face on which the
    object stands.
    """
    attached: int = 20
    """Least number of points of a part attached to a body of revolution, such as a handle."""


HIDDEN = HiddenNumbers()


@dataclasses.dataclass(frozen=True)
class MirrorNumbers:
    """Parameters of the standard deviation of points that are mirrored to the hidden side."""

    symmetric: float = 0.45
    """Score of a mirror plane from which on an object counts as symmetric."""
    asymmetry: float = 0.060
    """Standard deviation [m] of mirrored points because of asymmetry, for each 1 by which the score
    is below `symmetric`.
    """
    temperature: float = 0.1
    """Temperature of the planes' probabilities, which are proportional to exp(score / temperature).
    """
    near: int = 5
    """Number of planes, along each axis of a grid, that are compared near a mirror plane."""
    angle: float = 0.15
    """Greatest rotation [rad] of the planes near a mirror plane."""
    shift: float = 0.045
    """Greatest shift of the planes near a mirror plane, over the size of the cloud."""
    twice: float = 0.05
    """Score that an image loses by being mirrored twice, so that single images come first."""


MIRROR = MirrorNumbers()


@dataclasses.dataclass(frozen=True)
class BarNumbers:
    """Parameters for an object that is a frame of thin bars round an empty middle: how it is
    recognised, and its bars completed.
    """

    thin: float = 0.012
    """Width [m] below which a part of an object is a bar: that of a fingertip."""
    empty: float = 0.5
    """Greatest depth of a frame's centre inside the outline, as a share of the centre's distance
    from the cloud.
    """
    neighbours: int = 30
    """Number of neighbouring points that show the width and direction of a bar, as for fitted
    normals.
    """
    middle: float = 0.8
    """Least width at a point in the middle of a bar, as a share of the bar's width."""
    deviation: float = 0.5
    """Standard deviation of an estimated point on the far side of a bar, as a share of the width.
    """


BAR = BarNumbers()
Kind = Literal["ball", "revolution", "mirrored", "guess", "cut off", "vessel", "whole"]
"""How the hidden side was estimated: by an ellipsoid, an axis, mirror planes, or the walls of a
vessel. "guess" means from the outline alone. It was not estimated if the image border cuts the
object off. A "whole" cloud has no hidden side.
"""
SomeHidden = TypeVar("SomeHidden", bound=Any)  # a batch with `points` [m]


@dataclasses.dataclass(frozen=True)
class Completion(Value):
    """The estimated hidden side of an object in a view: m points, with their errors along the
    normals.

    The errors have the covariance noise^2 I + D D^T [m^2]. I is the identity, and noise is 3 mm
    (`HIDDEN.noise`). D (m, k) is the property `deviations`. Its columns are `shared`, then those of
    a smooth random error. The variance of the latter at a point is the sum of squares of
    `asymmetry` and `shared` there. Points are in the frame of the cloud.
    """

    points: Float[Tensor, "m 3"]  # estimated points [m] on the hidden side
    normals: Float[Tensor, "m 3"]  # outward unit normals
    # errors [m] of the points, one column for each of c causes at one standard deviation of it; the
    # causes are errors of the mirror planes
    shared: Float[Tensor, "m c"]
    # standard deviation [m] of a smooth error of each point, because the object is not quite
    # symmetric
    asymmetry: Float[Tensor, "m"]
    # p mirror planes n.x = o [m], as (n, o); for each part of the object, its best plane is first
    planes: Float[Tensor, "p 4"]
    # score of each plane: 1 if the mirror image lies on the cloud, near 0 if nothing confirms it
    scores: Float[Tensor, "p"]
    outline: Outlines  # silhouettes of all views of the cloud
    kind: Kind  # how the hidden side was completed, which selects the calibration
    frame: bool = False  # whether the object is a frame of bars round an empty middle

    @checked
    def moved(self, b_from_a: Pose) -> "Completion":
        """Return the completion in frame b, given the rigid transform `b_from_a` (4, 4) [m] from
        its own frame a.
        """
        normals = rotate(b_from_a, self.planes[:, :3])
        offsets = self.planes[:, 3:] + normals @ b_from_a[:3, 3:]
        planes = torch.cat([normals, offsets], 1)
        points = apply(b_from_a, self.points)
        turned = rotate(b_from_a, self.normals)
        outline = self.outline.moved(b_from_a)
        return dataclasses.replace(
            self, points=points, normals=turned, planes=planes, outline=outline
        )

    @property
    def deviations(self) -> Float[Tensor, "m k"]:
        """The correlated errors D (m, k) [m] of the m points along their normals.

        There is a column for each of k independent causes, at one standard deviation of it.
        """
        return correlated_errors(self.points, self.shared, self.asymmetry)


def correlated_errors(
    points: Float[Tensor, "m 3"],
    shared: Float[Tensor, "m c"],
    local: Float[Tensor, "m"] | float,
) -> Float[Tensor, "m k"]:
    """Return correlated errors (m, k) [m] of m points (m, 3) [m]: a column for each of k
    independent causes.

    A column holds the errors at one standard deviation of its cause. The first c columns are the
    `shared` errors [m]. The others are the modes of a smooth random field, alike within about 20 mm
    (`HIDDEN.part`). The field's variance at a point is the sum of squares of the `local` and the
    `shared` errors there [m^2].
    """
    deviation = torch.sqrt(local**2 + (shared**2).sum(1))
    alike = torch.exp(-0.5 * (torch.cdist(points, points) / HIDDEN.part) ** 2)
    field = symmetric_root(alike, 1.0, "keep hidden points apart")
    return torch.cat([shared, deviation[:, None] * field], 1)


@checked
def complete_cloud(
    cloud: PointCloud,
    table: float | None = None,
    budget: Count = 50,
) -> Completion:
    """Return the estimated hidden side of a cloud [m]: at most `budget` points, with their
    uncertainty.

    A body like a ball is completed by a fitted ellipsoid. Another cloud is mirrored across its best
    mirror planes and pairs of them; images in better planes come first. A body of revolution and a
    part attached to it, such as a handle, are mirrored separately. This is done in the frame of the
    axis. `table` is the height [m] of a table with normal z; None means no table. No point is
    returned if the image border cuts the object off. Raises `BadArgument` for a cloud without
    outward normals or viewpoints.
    """
    if cloud.normals is None or cloud.viewpoint is None:
        needed = "outward normals and viewpoints: see prepare_cloud"
        raise BadArgument("cloud", "no normals or no viewpoint", needed)
    scorer = SymmetryScorer.of(cloud.to("cpu", torch.float64), table)
    outline = scorer.outline
    none = scorer.points[:0]  # (0, 3)
    number = none[:, 0]
    no_plane = none.new_zeros(0, 4)
    nothing = Completion(none, none, none[:, :0], number, no_plane, number, outline, "cut off")
    # an image's border is no outline, and half an object is not symmetric
    if outline.cut:
        return nothing

    ball = find_ellipsoid(scorer.points, scorer.normals, outline, table)
    if ball is not None:
        rows = flatnonzero(_hidden(scorer, ball.points))
        rows = rows[pick_apart(ball.points[rows], budget)]
        points = ball.points[rows]
        return dataclasses.replace(
            nothing,
            points=points,
            normals=ball.normals[rows],
            shared=ball.deviations[rows],
            asymmetry=torch.full_like(points[:, 0], ball.misfit),
            kind="ball",
        )

    round_body = None if table is None else find_revolution(scorer.points, scorer.normals)
    axis = find_axis(scorer) if round_body is None else None
    if axis is not None:
        scorer = scorer.about_axis(axis[0])
        round_body = axis[1]
    parts = _split(scorer, round_body)
    planes = torch.cat([part.planes for part in parts])
    images = sorted(_mirror(parts), key=lambda image: -image.score)

    def allowed(
        image: _Image,
        apart: float = HIDDEN.new,
    ) -> Bool[Tensor, "n"]:
        hidden = _hidden(scorer, image.points, apart)
        if scorer.table is None:
            return hidden
        # Free space already bounds the shape at the face on the table.
        low = scorer.table.height(image.points) < HIDDEN.foot
        return hidden & ~(low & (image.normals @ scorer.table.normal < HIDDEN.down))

    merged = merge_hidden(_Image.of(scorer, none, none, len(planes)), images, allowed, _thin)
    frame = _is_frame(scorer)
    if frame:
        backs = [_back_of_bars(scorer, len(planes))]
        merged = merge_hidden(merged, backs, lambda image: allowed(image, 0.0), _thin)
    chosen = merged[pick_apart(merged.points, budget)]
    kind: Kind = "mirrored" if round_body is None else "revolution"
    found = Completion(
        chosen.points,
        chosen.normals,
        chosen.shared.flatten(1),
        chosen.variance.sqrt(),
        planes,
        torch.cat([part.scores for part in parts]),
        scorer.outline,
        kind if len(planes) else "guess",
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
    # shift [m] for each nearby plane, weighted by the root of its probability
    shared: Float[Tensor, "n planes near"]

    @classmethod
    def of(
        cls,
        scorer: SymmetryScorer,
        points: Tensor,
        normals: Tensor,
        n_planes: int,
    ) -> "_Image":
        """Return unmirrored points as an image of infinite score, without errors."""
        axes = 2 if scorer.upright else 3  # of the planes near a plane
        shared = points.new_zeros(len(points), n_planes, MIRROR.near**axes)
        return cls(points, normals, math.inf, torch.zeros_like(points[:, 0]), shared)


def _split(scorer: SymmetryScorer, revolution: Revolution | None) -> list[_Part]:
    """Split the cloud into a body of revolution and an attached part, such as a handle. Otherwise
    return the whole cloud.
    """
    if revolution is None:
        every = torch.arange(len(scorer.points), device="cpu")
        return [_Part(scorer, every, *find_planes(scorer))]
    rows = flatnonzero(revolution.body)
    rest = flatnonzero(~revolution.body)
    body = scorer.for_part(rows)
    parts = [_Part(body, rows, *find_planes(body, turned=True))]
    if len(rest) >= HIDDEN.attached:
        attached = scorer.for_part(rest)
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
        points = scorer.points[part.rows]
        normals = scorer.normals[part.rows]
        # the outline is of the whole cloud; its images are edges of the far side
        if len(points) == len(scorer.points):
            points = torch.cat([points, scorer.outline.rim])
            normals = torch.cat([normals, scorer.outline.rim_normals])
        original = _Image.of(scorer, points, normals, total)
        mirrors = [
            _mirror_in(scorer, before + i, plane, float(part.scores[i]))
            for i, plane in enumerate(part.planes)
        ]
        once = [mirror(original) for mirror in mirrors]
        images += once
        for i, image in enumerate(once[:2]):
            images += [mirror(image) for j, mirror in enumerate(mirrors) if j != i]
        before += len(mirrors)
    return images


def _mirror_in(
    scorer: SymmetryScorer,
    number: int,
    plane: Mirror,
    score: float,
) -> Callable[[_Image], _Image]:
    """Return a function that mirrors points in a plane; how images in nearby planes differ gives
    the points' errors.
    """
    steps = torch.linspace(-1.0, 1.0, MIRROR.near, dtype=plane.dtype, device="cpu")
    near = planes_near(scorer, plane, MIRROR.angle * steps, MIRROR.shift * scorer.size * steps)
    weight = torch.softmax(scorer.score(near)[0] / MIRROR.temperature, 0)
    asymmetry = MIRROR.asymmetry * max(MIRROR.symmetric - score, 0.0)

    def mirror(of: _Image) -> _Image:
        points = reflect(of.points, plane)
        normals = reflect_directions(of.normals, plane)
        shift = ((reflect(of.points, near[:, None]) - points) * normals).sum(-1)  # (near, n)
        shared = of.shared.clone()  # a mirror leaves errors across the surface as they are
        shared[:, number] += (weight.sqrt()[:, None] * shift).T
        worse = score if math.isinf(of.score) else min(of.score, score) - MIRROR.twice
        return _Image(points, normals, worse, of.variance + asymmetry**2, shared)

    return mirror


def _is_frame(scorer: SymmetryScorer) -> bool:
    """Return whether the middle of the cloud is empty. Then it is outside the outline or close to
    it, and farther from the cloud than a bar is wide.
    """
    middle = scorer.center
    away = float(torch.cdist(middle[None], scorer.points).amin())
    inside = -float(scorer.outline.hull_distance(middle))
    return away > BAR.thin and inside < BAR.empty * away


def _back_of_bars(scorer: SymmetryScorer, n_planes: int) -> _Image:
    """Return points on the far side of thin bars: such a bar is about as deep as it is wide.

    The points lie behind the middle of a bar, across its direction. Their standard deviation is
    half of the width.
    """
    points = scorer.points
    near = nearest(points, BAR.neighbours)[1]
    across = -2 * scorer.outline.hull_distance(points)
    width = across[near].amax(1)
    rows = flatnonzero((across > BAR.middle * width) & (width < BAR.thin))
    rows = rows[pick_apart(points[rows], 2 * SYMMETRY.probes)]
    at = points[rows]
    width = width[rows]
    around = points[near[rows]]
    around = around - around.mean(1, keepdim=True)  # (k, neighbours, 3)
    bar = torch.linalg.svd(around, full_matrices=False).Vh[:, 0]
    # of several views, the one that faces the bar most
    rays = at[:, None] - torch.stack([view.viewpoint for view in scorer.outline.views])
    facing = (rays * scorer.normals[rows, None]).sum(-1).argmin(1)
    ray = unit(rays[torch.arange(len(rows), device="cpu"), facing])
    back = unit(ray - (ray * bar).sum(1, keepdim=True) * bar)
    image = _Image.of(scorer, at + width[:, None] * back, back, n_planes)
    return dataclasses.replace(image, variance=(BAR.deviation * width) ** 2)


def merge_hidden(
    merged: SomeHidden,
    parts: Iterable[SomeHidden],
    allowed: Callable[[SomeHidden], Bool[Tensor, "n"]],
    thin: Callable[[Points], Int[Tensor, "k"]],
) -> SomeHidden:
    """Return the points `merged`, joined with those of the `parts` that are `allowed` and not near
    earlier points.

    Near means at most 4 mm away (`HIDDEN.spacing`). A part is a batch of hidden points, such as a
    `HiddenWall`. `allowed(part)` is a mask of the part's points. `thin(points)` returns the indices
    of the points to keep, given points (n, 3) [m].
    """
    for part in parts:
        new = part[allowed(part)]
        if len(merged) and len(new):
            distance, _ = spatial.KDTree(merged.points.numpy()).query(new.points.numpy())
            new = new[torch.from_numpy(distance) > HIDDEN.spacing]
        merged = join([merged, new[thin(new.points)]])
    return merged


def _hidden(
    scorer: SymmetryScorer,
    points: Points,
    apart: float = HIDDEN.new,
) -> Bool[Tensor, "n"]:
    """Return a mask of the points that are hidden in every view and not below the table. They are
    farther than `apart` [m] from the cloud.
    """
    hidden = (scorer.nearest(points)[0] > apart) & scorer.outline.hides(points)
    if scorer.table is None:
        return hidden
    return hidden & (scorer.table.height(points) > -OUTLINE.front)


def _thin(points: Points) -> Int[Tensor, "k"]:
    """Return the indices of the points that are not near earlier ones."""
    # NumPy's calls cost a quarter of torch's
    apart = (torch.cdist(points, points) >= HIDDEN.spacing).numpy()
    keep = np.ones(len(points), dtype=bool)
    for i in range(len(points)):
        if keep[i]:
            keep[i + 1 :] &= apart[i, i + 1 :]
    return flatnonzero(torch.from_numpy(keep))
