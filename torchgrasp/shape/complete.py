"""The hidden side by symmetry: the cloud, mirrored across the planes that its seen side and free space support."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.shape.planes import PROBES, Scene, find_planes, planes_near, reflect, turn
from torchgrasp.shape.silhouette import Outlines, farthest_points, silhouettes
from torchgrasp.values import PointCloud

HULL_MARGIN, SEEN_MARGIN, TABLE_MARGIN = 0.001, 0.002, 0.002
"""How far [m] a mirrored point may stand out of the hull, in front of the seen surface, below the table."""
NEW, SPACING = 0.006, 0.004
"""Least distance [m] of a mirrored point from the cloud and from another one."""
LEAST_NOISE = 0.003
"""Standard deviation [m] of a mirrored point, were the object symmetric about that very plane."""
GOOD, ASYMMETRY = 0.4, 0.024
"""Score from which on an object counts as symmetric, and how much further [m] mirrored points are off for each 1 that
is missing."""
TEMPERATURE = 0.05
"""Planes are as probable as exp(score / temperature): those that score nearly as well tell how well one is known."""
SHARED = 1.5
"""Factor on the deviations between such planes: points of one image share them, and do not average them out."""
SPREAD_STEPS, SPREAD_TURN, SPREAD_SHIFT = 5, 0.15, 0.045
"""Planes tried about one for its spread: along each axis, to that turn [rad], and to that share of the cloud's size."""


@dataclasses.dataclass(frozen=True)
class Completion(Value):
    """Points of the hidden side [m] with normals, and how far each may be off (`noise`, a standard deviation [m]).

    `planes` are rows (n, o) of the planes n.x = o that were used, best first, and `scores` what supports them: 1 for
    a mirror image that lies on the cloud wholly, below .15 for none to speak of.
    """

    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    noise: Float[Tensor, "m"]
    planes: Float[Tensor, "p 4"]
    scores: Float[Tensor, "p"]
    outline: Outlines


def complete_cloud(cloud: PointCloud, table: float | None = None, budget: int = 50) -> Completion:
    """Return the hidden side that the cloud's symmetry suggests, with honest noise.

    A plane scores by how many mirrored points fall onto the cloud with the right normal, less twice how far they
    stand out of the outline, in front of the seen surface or below the table (each saturates). The planes come from a
    grid, vertical ones when the table is known, those at right angles to the best being likelier; the up to four
    best, and one across the view if none of those is, are refined. The cloud is mirrored across each, and across
    pairs; a point is kept where nothing was seen, the hull allows it and no better one is near. Its noise is that of
    its plane: how far the planes that score nearly as well would move it across the surface, and how asymmetric the
    object looks.

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
    probes = farthest_points(points, PROBES)
    scene = Scene(points, normals, tree, outline, table, points[probes], normals[probes])
    planes, scores = find_planes(scene)
    mirrors = [_Mirror.of(scene, p, s) for p, s in zip(planes, scores, strict=True)]
    seen = _Image(points, normals, math.inf, torch.zeros_like(points[:, 0]))
    images = [mirror.image(seen) for mirror in mirrors]
    images += [mirrors[j].image(images[i]) for i in range(min(2, len(planes))) for j in range(len(planes)) if i != j]
    images.sort(key=lambda image: -image.score)
    kept = _keep(scene, images)
    chosen = farthest_points(kept[0], budget)
    return Completion(
        points=kept[0][chosen],
        normals=kept[1][chosen],
        noise=kept[2][chosen],
        planes=planes,
        scores=scores,
        outline=outline,
    )


@dataclasses.dataclass(frozen=True)
class _Image:
    """A mirrored cloud [m], its score, infinite if it is no mirror image, and its points' variance [m^2]."""

    points: Tensor
    normals: Tensor
    score: float
    variance: Tensor


@dataclasses.dataclass(frozen=True)
class _Mirror:
    """A plane, its score, and the planes near it with the probability of each, given the scores."""

    plane: Tensor
    score: float
    near: Tensor
    weight: Tensor

    @classmethod
    def of(cls, scene: Scene, plane: Float[Tensor, "4"], score: Float[Tensor, ""]) -> "_Mirror":
        """Return the mirror of a plane in a scene."""
        steps = torch.linspace(-1.0, 1.0, SPREAD_STEPS, dtype=plane.dtype)
        near = planes_near(scene, plane, SPREAD_TURN * steps, SPREAD_SHIFT * scene.size * steps)
        return cls(plane, float(score), near, torch.softmax(scene.score(near)[0] / TEMPERATURE, 0))

    def image(self, of: _Image) -> _Image:
        """Return the mirror image of a cloud; that of an image is a little less sure than the less sure of both."""
        points, normals = reflect(of.points, self.plane), turn(of.normals, self.plane)
        shift = ((reflect(of.points, self.near[:, None]) - points) * normals).sum(-1)
        asymmetry = ASYMMETRY * max(GOOD - self.score, 0.0)
        variance = of.variance + SHARED**2 * (self.weight @ shift**2) + asymmetry**2
        score = self.score if math.isinf(of.score) else min(of.score, self.score) - 0.05
        return _Image(points, normals, score, variance)


def _keep(scene: Scene, images: list[_Image]) -> tuple[Tensor, Tensor, Tensor]:
    """Return points, normals and noise [m] of the mirrored points that nothing speaks against, best images first."""
    from scipy.spatial import KDTree

    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    for image in images:
        distance, _ = scene.nearest(image.points)
        fine = (distance > NEW) & _allowed(scene, image.points)
        points, normals, variance = image.points[fine], image.normals[fine], image.variance[fine]
        if kept and len(points):
            before, _ = KDTree(torch.cat([k[0] for k in kept]).numpy()).query(points.numpy())
            new = torch.from_numpy(before) > SPACING
            points, normals, variance = points[new], normals[new], variance[new]
        thin = _thin(points)
        kept.append((points[thin], normals[thin], torch.sqrt(LEAST_NOISE**2 + variance[thin])))
    if not kept:
        empty = scene.points.new_zeros(0, 3)
        return empty, empty, empty[:, 0]
    points, normals, noise = (torch.cat(c) for c in zip(*kept, strict=True))
    return points, normals, noise


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
