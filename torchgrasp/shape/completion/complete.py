"""The hidden side by symmetry: the cloud, mirrored across the planes that its seen side and free space support."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.linalg import farthest_points
from torchgrasp.shape.completion.revolution import find_revolution
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.symmetry import (
    SymmetryScene,
    find_planes,
    find_upright_plane,
    planes_near,
    reflect,
    turn,
)
from torchgrasp.shape.joint_posterior import symmetric_root
from torchgrasp.values import PointCloud

HULL_MARGIN, SEEN_MARGIN, TABLE_MARGIN = 0.001, 0.002, 0.002
"""How far [m] a mirrored point may stand out of the hull, in front of the seen surface, below the table."""
NEW, SPACING = 0.006, 0.004
"""Least distance [m] of a mirrored point from the cloud and from another one."""
LEAST_NOISE = 0.003
"""Standard deviation [m] of a mirrored point, were the object symmetric about that very plane."""
GOOD, ASYMMETRY = 0.45, 0.060
"""Score from which on an object counts as symmetric, and by how much [m] it deviates from its mirror image for each 1
that is missing."""
ATTACHED = 20
"""Points beside a body of revolution from which on they are a part with a plane of its own."""
PART = 0.02
"""Length [m] over which such deviations are alike: a part that is missing on the other side is missing as a whole."""
TEMPERATURE = 0.1
"""Planes are as probable as exp(score / temperature): those that score nearly as well tell how well one is known."""
SPREAD_STEPS, SPREAD_TURN, SPREAD_SHIFT = 5, 0.15, 0.045
"""Planes tried about one for its spread: along each axis, to that turn [rad], and to that share of the cloud's size."""


@dataclasses.dataclass(frozen=True)
class Completion(Value):
    """Points of the hidden side [m] with normals, and how far they may be off.

    Each has an error of its own across the surface, `LEAST_NOISE`, one that it shares with the points of the same
    plane (`shared`), which is known no better than its score tells, and one that it shares with the points nearby: what
    stands out on one side may be missing on the other. `asymmetry` [m] is the deviation of the last one, a field that
    is alike over `PART`. The covariance of all the errors is LEAST_NOISE^2 I + deviations deviations^T [m^2]: points
    that share an error do not average it out.

    `planes` are rows (n, o) of the planes n.x = o that were used, the best of each part first, and `scores` what
    supports them: 1 for a mirror image that lies on the cloud wholly, below .15 for none to speak of.
    """

    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    shared: Float[Tensor, "m c"]
    asymmetry: Float[Tensor, "m"]
    planes: Float[Tensor, "p 4"]
    scores: Float[Tensor, "p"]
    outline: Outlines

    @property
    def deviations(self) -> Float[Tensor, "m k"]:
        """The errors that points have in common, a column for each independent cause: of planes, and of parts.

        The part of the asymmetry that a plane's spread hides is as local, and counts in both.
        """
        local = torch.sqrt(self.asymmetry**2 + (self.shared**2).sum(1))
        alike = torch.exp(-0.5 * (torch.cdist(self.points, self.points) / PART) ** 2)
        return torch.cat([self.shared, local[:, None] * symmetric_root(alike, 1.0, "keep mirrored points apart")], 1)


def complete_cloud(cloud: PointCloud, table: float | None = None, budget: int = 50) -> Completion:
    """Return the hidden side that the cloud's symmetry suggests, with honest noise.

    A plane scores by how many mirrored points fall onto the cloud with the right normal, less twice how far they
    stand out of the outline, in front of the seen surface or below the table (each saturates). The planes come from a
    grid, vertical ones when the table is known, those at right angles to the best being likelier; the up to four
    best, and one across the view if none of those is, are refined. The cloud is mirrored across each, and across
    pairs; a point is kept where nothing was seen, the hull allows it and no better one is near. What misses in a
    plane's score is the asymmetry of its points; they share how far the planes that score nearly as well would move
    them across the surface.

    Any plane through the axis of a body of revolution explains it, so the body says nothing of the plane that its
    handle has. On a table, where the axis is upright, the body and what is attached to it are parts with planes of
    their own; what is attached is mirrored across one plane through the axis.

    Args:
        cloud: clean points [m] of one view or of several, with outward unit normals and the viewpoint.
        table: height [m] of the table, whose normal is z; None: not known.
        budget: greatest number of points.

    >>> from torchgrasp.linalg import unit
    >>> eye = torch.tensor([0.0, 0.0, 1.0]).double()
    >>> cap = unit(torch.rand(300, 3).double() - torch.tensor([0.5, 0.5, 0.0]).double())
    >>> bool(complete_cloud(PointCloud(0.05 * cap, cap, eye)).points[:, 2].min() < -0.02)
    True
    """
    cloud = cloud.to("cpu", torch.float64)
    scene = SymmetryScene.of(cloud, table)
    parts = _split(scene)
    planes, scores = torch.cat([part.planes for part in parts]), torch.cat([part.scores for part in parts])
    images = _mirror_parts(parts)
    images.sort(key=lambda image: -image.score)
    kept = _keep(scene, _Image.of(scene, torch.arange(0), len(planes)), images)
    kept = kept.select(farthest_points(kept.points, budget, tie=TIE))
    return Completion(
        points=kept.points,
        normals=kept.normals,
        shared=kept.shared.flatten(1),
        asymmetry=kept.variance.sqrt(),
        planes=planes,
        scores=scores,
        outline=scene.outline,
    )


@dataclasses.dataclass(frozen=True)
class _Part:
    """Points of the cloud that are symmetric about the same planes: the scene scored by them, and these planes."""

    scene: SymmetryScene
    rows: Tensor
    planes: Float[Tensor, "p 4"]
    scores: Float[Tensor, "p"]


def _split(scene: SymmetryScene) -> list[_Part]:
    """Return the cloud as one part; a body of revolution and what is attached to it as two."""
    every = torch.arange(len(scene.points))
    revolution = None if scene.table is None else find_revolution(scene.points, scene.normals)
    if revolution is None:
        return [_Part(scene, every, *find_planes(scene))]
    rows, rest = every[revolution.body], every[~revolution.body]
    body, attached = scene.scored_by(rows), scene.scored_by(rest)
    parts = [_Part(body, rows, *find_planes(body))]
    if len(rest) >= ATTACHED:
        parts.append(_Part(attached, rest, *find_upright_plane(attached, revolution.center, scene.points[rest])))
    return parts


def _mirror_parts(parts: list[_Part]) -> list["_Image"]:
    """Return the mirror images of each part across its planes, and across the best two and another one."""
    total, images, before = sum(len(part.planes) for part in parts), [], 0
    for part in parts:
        seen = _Image.of(part.scene, part.rows, total)
        mirrors = [
            _Mirror.of(part.scene, before + i, plane, score)
            for i, (plane, score) in enumerate(zip(part.planes, part.scores, strict=True))
        ]
        once = [mirror.image(seen) for mirror in mirrors]
        twice = [m.image(image) for i, image in enumerate(once[:2]) for j, m in enumerate(mirrors) if i != j]
        images += once + twice
        before += len(mirrors)
    return images


@dataclasses.dataclass(frozen=True)
class _Image:
    """A mirrored cloud [m], its score, infinite if it is no mirror image, and the errors of its points.

    `variance` [m^2] is that of their asymmetry; `shared` [m] tells, for each plane and each one near it, how far a
    point moves across the surface with it, times the root of its probability.
    """

    points: Tensor
    normals: Tensor
    score: float
    variance: Float[Tensor, "n"]
    shared: Float[Tensor, "n planes near"]

    @classmethod
    def of(cls, scene: SymmetryScene, rows: Tensor, planes: int) -> "_Image":
        """Return some points of a cloud as seen, without error, of which images across `planes` will be made."""
        points = scene.points[rows]
        near = SPREAD_STEPS ** (2 if scene.table is not None else 3)
        shared = points.new_zeros(len(rows), planes, near)
        return cls(points, scene.normals[rows], math.inf, torch.zeros_like(points[:, 0]), shared)

    def select(self, rows: Tensor) -> "_Image":
        """Return some of the points."""
        return _Image(self.points[rows], self.normals[rows], self.score, self.variance[rows], self.shared[rows])

    def join(self, other: "_Image") -> "_Image":
        """Return the points of this one and of another, with this one's score."""
        return _Image(
            torch.cat([self.points, other.points]),
            torch.cat([self.normals, other.normals]),
            self.score,
            torch.cat([self.variance, other.variance]),
            torch.cat([self.shared, other.shared]),
        )


@dataclasses.dataclass(frozen=True)
class _Mirror:
    """A plane, its number and score, and the planes near it with the probability of each, given the scores."""

    number: int
    plane: Tensor
    score: float
    near: Tensor
    weight: Tensor

    @classmethod
    def of(cls, scene: SymmetryScene, number: int, plane: Float[Tensor, "4"], score: Float[Tensor, ""]) -> "_Mirror":
        """Return the mirror of a plane in a scene."""
        steps = torch.linspace(-1.0, 1.0, SPREAD_STEPS, dtype=plane.dtype)
        near = planes_near(scene, plane, SPREAD_TURN * steps, SPREAD_SHIFT * scene.size * steps)
        return cls(number, plane, float(score), near, torch.softmax(scene.score(near)[0] / TEMPERATURE, 0))

    def image(self, of: _Image) -> _Image:
        """Return the mirror image of a cloud; that of an image is a little less sure than the less sure of both."""
        points, normals = reflect(of.points, self.plane), turn(of.normals, self.plane)
        shift = ((reflect(of.points, self.near[:, None]) - points) * normals).sum(-1)
        shared = of.shared.clone()  # a mirror leaves errors across the surface as they are
        shared[:, self.number] += (self.weight.sqrt()[:, None] * shift).T
        variance = of.variance + (ASYMMETRY * max(GOOD - self.score, 0.0)) ** 2
        score = self.score if math.isinf(of.score) else min(of.score, self.score) - 0.05
        return _Image(points, normals, score, variance, shared)


def _keep(scene: SymmetryScene, kept: _Image, images: list[_Image]) -> _Image:
    """Return what is kept already and the mirrored points that nothing speaks against, of the best images first."""
    from scipy.spatial import KDTree

    for image in images:
        distance, _ = scene.nearest(image.points)
        fine = image.select((distance > NEW) & _allowed(scene, image.points))
        if len(kept.points) and len(fine.points):
            before, _ = KDTree(kept.points.numpy()).query(fine.points.numpy())
            fine = fine.select(torch.from_numpy(before) > SPACING)
        kept = kept.join(fine.select(_thin(fine.points)))
    return kept


def _allowed(scene: SymmetryScene, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Tell which points neither the outline, nor the seen surface, nor the table rules out."""
    fine = (scene.outline.hull_distance(points) < HULL_MARGIN) & (scene.outline.violation(points) < SEEN_MARGIN)
    if scene.table is not None:
        fine = fine & (points[:, 2] > scene.table - TABLE_MARGIN)
    return fine


def _thin(points: Float[Tensor, "n 3"]) -> Tensor:
    """Return the indices of points at least `SPACING` apart, in their order."""
    close = torch.cdist(points, points) < SPACING
    keep = torch.ones(len(points), dtype=torch.bool)
    for i in range(len(points)):
        if keep[i]:
            keep[i + 1 :] &= ~close[i, i + 1 :]
    return torch.nonzero(keep)[:, 0]
