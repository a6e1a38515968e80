"""The hidden side by symmetry: the cloud, mirrored across the planes that its seen side and free space support."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.shape.joint import symmetric_root
from torchgrasp.shape.planes import PROBES, Scene, find_plane_through, find_planes, planes_near, reflect, turn
from torchgrasp.shape.revolve import find_revolution
from torchgrasp.shape.silhouette import Outlines, farthest_points, silhouettes
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
FEW = 20
"""Points beside a body of revolution from which on they count as a part of its own."""
PART = 0.02
"""Length [m] over which such deviations are alike: a part that is missing on the other side is missing as a whole."""
TEMPERATURE = 0.1
"""Planes are as probable as exp(score / temperature): those that score nearly as well tell how well one is known."""
SPREAD_STEPS, SPREAD_TURN, SPREAD_SHIFT = 5, 0.15, 0.045
"""Planes tried about one for its spread: along each axis, to that turn [rad], and to that share of the cloud's size."""


@dataclasses.dataclass(frozen=True)
class Completion(Value):
    """Points of the hidden side [m] with normals, and how far they may be off.

    Each has an error of its own across the surface (`noise`, a standard deviation [m]), one that it shares with the
    points of the same plane (`shared`), which is known no better than its score tells, and one that it shares with the
    points nearby: what stands out on one side may be missing on the other. `asymmetry` [m] is the deviation of the last
    one, a field that is alike over `PART`. The covariance of all the errors is diag(noise^2) + deviations deviations^T
    [m^2]. Points that share an error do not average it out: with an asymmetry of each point's own, twice as much of the
    hidden surface was 10 mm off where less than 7 mm were claimed (5.5 % against 2.6 % of it, 24 views).

    `planes` are rows (n, o) of the planes n.x = o that were used, best first, and `scores` what supports them: 1 for
    a mirror image that lies on the cloud wholly, below .15 for none to speak of.
    """

    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    noise: Float[Tensor, "m"]
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
    pairs; a point is kept where nothing was seen, the hull allows it and no better one is near. Its noise is how
    asymmetric the object looks; the points of a plane share how far the planes that score nearly as well would move
    them across the surface.

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
    from scipy.spatial import KDTree

    assert cloud.normals is not None
    cloud = cloud.to("cpu", torch.float64)
    points, normals, outline = cloud.points, cloud.normals, silhouettes(cloud)
    assert normals is not None
    tree = KDTree(points.numpy())

    def scene_of(rows: Tensor) -> Scene:
        probes = rows[farthest_points(points[rows], PROBES)]
        return Scene(points, normals, tree, outline, table, points[probes], normals[probes])

    every = torch.arange(len(points))
    turned = None if table is None else find_revolution(points, normals)
    if turned is None:
        groups = [(every, *find_planes(scene_of(every)))]
    else:
        groups = [(every[turned.body], *find_planes(scene_of(every[turned.body])))]
        rest = every[~turned.body]
        if len(rest) >= FEW:
            groups.append((rest, *find_plane_through(scene_of(rest), turned.center, points[rest])))
    scene = scene_of(every)
    planes, scores = torch.cat([g[1] for g in groups]), torch.cat([g[2] for g in groups])
    near = SPREAD_STEPS**2 if table is not None else SPREAD_STEPS**3
    images, number = [], 0
    for rows, own, marks in groups:
        part = scene_of(rows)
        mirrors = [_Mirror.of(part, number + i, own[i], marks[i]) for i in range(len(own))]
        number += len(own)
        none = torch.zeros_like(points[rows, 0])
        seen = _Image(points[rows], normals[rows], math.inf, none, none.new_zeros(len(rows), len(planes), near))
        found = [mirror.image(seen) for mirror in mirrors]
        found += [mirrors[j].image(found[i]) for i in range(min(2, len(own))) for j in range(len(own)) if i != j]
        images += found
    seen = _Image(points[:0], normals[:0], math.inf, points[:0, 0], points.new_zeros(0, len(planes), near))
    images.sort(key=lambda image: -image.score)
    kept = _keep(scene, seen, images)
    kept = kept.select(farthest_points(kept.points, budget))
    return Completion(
        points=kept.points,
        normals=kept.normals,
        noise=torch.full_like(kept.variance, LEAST_NOISE),
        shared=kept.shared.flatten(1),
        asymmetry=kept.variance.sqrt(),
        planes=planes,
        scores=scores,
        outline=outline,
    )


@dataclasses.dataclass(frozen=True)
class _Image:
    """A mirrored cloud [m], its score, infinite if it is no mirror image, and the errors of its points.

    `variance` [m^2] is that of their own errors; `shared` [m] tells, for each plane and each one near it, how far a
    point moves across the surface with it, times the root of its probability.
    """

    points: Tensor
    normals: Tensor
    score: float
    variance: Float[Tensor, "n"]
    shared: Float[Tensor, "n planes near"]

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
    def of(cls, scene: Scene, number: int, plane: Float[Tensor, "4"], score: Float[Tensor, ""]) -> "_Mirror":
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


def _keep(scene: Scene, kept: _Image, images: list[_Image]) -> _Image:
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


def _allowed(scene: Scene, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
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
