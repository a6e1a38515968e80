"""The hidden side by symmetry: the cloud, mirrored across the planes that its seen side and free space support."""

import dataclasses
import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.cloud.normals import spread_directions
from torchgrasp.linalg import unit
from torchgrasp.shape.silhouette import Outlines, farthest_points, silhouettes
from torchgrasp.values import PointCloud

TAU = 0.003
"""Distance [m] over which a mirrored point stops matching the cloud."""
PROBES = 150
"""Points of the cloud with which a plane is scored."""
OFFSETS = 17
"""Offsets tried for each direction of a plane."""
ANGLES = 24
"""Vertical planes tried when gravity is known."""
DIRECTIONS = 80
"""Directions of planes tried when it is not."""
FACING = 0.35
"""A plane whose normal has less than this cosine with the view contains the view, and adds no hidden points."""
ONE_SIDED = 0.05
"""Length of the mean of the directions of view (level ones when gravity is known) from which one side was not seen."""
MAX_PLANES = 4
"""Mirror planes used, at most, besides the one across the view that is added when none of them is."""
WITHIN = 0.12
"""Planes are used whose score is within this of the best one's."""
SQUARE, SQUARE_PRIOR = 0.1, 0.1
"""Greatest cosine between planes at right angles, and what a plane's score gains by one with the best of all: most
things with two planes of symmetry have them so, and the view may well show only one."""
APART = math.cos(math.radians(25.0))
"""Cosine of the least angle between two planes."""
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
    grid, vertical ones when the table is known; the up to four best, and one across the view if none of those is,
    are refined. The cloud is mirrored across each, and across pairs; a point is kept where nothing was seen, the hull
    allows it and no better one is near.

    Args:
        cloud: clean points [m] of one view or of several, with outward unit normals and the viewpoint.
        table: height [m] of the table, whose normal is z; None: not known.
        budget: greatest number of points.

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
    scene = _Scene(points, normals, tree, outline, table, points[probes], normals[probes])
    planes, scores = _find_planes(scene)
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
class _Scene:
    """What planes are scored against."""

    points: Tensor
    normals: Tensor
    tree: object
    outline: Outlines
    table: float | None
    probes: Tensor
    probe_normals: Tensor

    @property
    def center(self) -> Tensor:
        """The centre of the cloud's box."""
        return (self.points.amax(0) + self.points.amin(0)) / 2

    @property
    def size(self) -> float:
        """The longest side of the cloud's box [m]."""
        return float((self.points.amax(0) - self.points.amin(0)).max())

    def nearest(self, points: Tensor, limit: float = math.inf) -> tuple[Tensor, Tensor]:
        """Return distance [m] and index of the nearest point of the cloud; infinity and 0 beyond the limit."""
        distance, index = self.tree.query(points.reshape(-1, 3).numpy(), distance_upper_bound=limit)  # pyright: ignore
        shape = points.shape[:-1]
        index = torch.from_numpy(np.where(np.isinf(distance), 0, index)).reshape(shape)
        return torch.from_numpy(distance).reshape(shape), index

    def score(self, planes: Float[Tensor, "p 4"]) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Return the score of planes, and the mean violation of free space that it contains, in [0, 1]."""
        mirrored = _reflect(self.probes, planes[:, None])
        turned = _turn(self.probe_normals, planes[:, None])
        distance, index = self.nearest(mirrored, 4 * TAU)
        agreement = (turned * self.normals[index]).sum(-1).clamp_min(0)
        match = (torch.exp(-0.5 * (distance / TAU) ** 2) * agreement).mean(-1)
        violation = self.outline.violation(mirrored)
        if self.table is not None:
            violation = violation + (self.table - mirrored[..., 2]).clamp_min(0)
        bad = ((violation / TAU).clamp_max(3.0) ** 2 / 9.0).mean(-1)
        return match - 2.0 * bad, bad


@dataclasses.dataclass(frozen=True)
class _Image:
    """A mirrored cloud [m], the score that supports it (infinite: seen itself), and the variance [m^2] of its points across the surface."""

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
    def of(cls, scene: _Scene, plane: Float[Tensor, "4"], score: Float[Tensor, ""]) -> "_Mirror":
        """Return the mirror of a plane in a scene."""
        steps = torch.linspace(-1.0, 1.0, SPREAD_STEPS, dtype=plane.dtype)
        near = _planes_near(scene, plane, SPREAD_TURN * steps, SPREAD_SHIFT * scene.size * steps)
        return cls(plane, float(score), near, torch.softmax(scene.score(near)[0] / TEMPERATURE, 0))

    def image(self, of: _Image) -> _Image:
        """Return the mirror image of a cloud; that of an image is a little less sure than the less sure of both."""
        points, normals = _reflect(of.points, self.plane), _turn(of.normals, self.plane)
        shift = ((_reflect(of.points, self.near[:, None]) - points) * normals).sum(-1)
        asymmetry = ASYMMETRY * max(GOOD - self.score, 0.0)
        variance = of.variance + SHARED**2 * (self.weight @ shift**2) + asymmetry**2
        score = self.score if math.isinf(of.score) else min(of.score, self.score) - 0.05
        return _Image(points, normals, score, variance)


def _find_planes(scene: _Scene) -> tuple[Float[Tensor, "p 4"], Float[Tensor, "p"]]:
    """Return the mirror planes of a scene, best first, and their scores."""
    size = scene.size
    view = torch.stack([unit(scene.center - seen.viewpoint) for seen in scene.outline.views]).mean(0)
    if scene.table is None:
        directions = spread_directions(2 * DIRECTIONS, scene.points)[:DIRECTIONS]  # a half sphere: n and -n are one
        rim_prior = 0.15
    else:
        angle = torch.arange(ANGLES, dtype=torch.float64) * math.pi / ANGLES
        directions = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
        view = view * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        rim_prior = 0.0
    # Seen from above, or from sides that are far apart, no direction is hidden alone, and every plane may add points.
    told = float(torch.linalg.vector_norm(view)) > ONE_SIDED
    facing = (directions @ unit(view)).abs() if told else torch.ones(len(directions), dtype=torch.float64)
    along = scene.points @ directions.T
    low, high = along.amin(0), along.amax(0)
    middle, half = (low + high) / 2, ((high - low) / 2).clamp_min(0.15 * size)
    steps = torch.linspace(-1, 1, OFFSETS, dtype=torch.float64)
    offsets = middle[:, None] + half[:, None] * steps
    grid = torch.cat([directions[:, None].expand(-1, OFFSETS, -1), offsets[..., None]], -1)
    scores, bad = (s.reshape(offsets.shape) for s in scene.score(grid.reshape(-1, 4)))
    if rim_prior:
        rim = (scene.outline.rim @ directions.T).median(0).values
        scores = scores - rim_prior * ((offsets - rim[:, None]) / (0.25 * size)) ** 2

    strongest = directions[scores.max(1).values.argmax()]
    scores = scores + SQUARE_PRIOR * ((directions @ strongest).abs() < SQUARE)[:, None]
    best, where = scores.max(1)
    order = [i for i in torch.argsort(best, descending=True, stable=True).tolist() if facing[i] > FACING]
    chosen: list[int] = []
    for i in order:
        if len(chosen) == MAX_PLANES or best[i] <= best[order[0]] - WITHIN:
            break
        if all(abs(float(directions[i] @ directions[j])) < APART for j in chosen):
            chosen.append(i)
    picks = [(i, int(where[i])) for i in chosen]
    if not any(facing[i] > 0.7 for i in chosen):
        # A box seen on an edge: its end faces match well, but only a plane across the view shows the hidden side.
        allowed = torch.where((bad < 0.15) & (facing > 0.7)[:, None], scores, -torch.inf)
        across = int(allowed.argmax())
        if bool(torch.isfinite(allowed.reshape(-1)[across])):
            picks.append((across // OFFSETS, across % OFFSETS))
    if not picks:
        return scene.points.new_zeros(0, 4), scene.points.new_zeros(0)
    refined = torch.stack([_refine(scene, grid[i, k]) for i, k in picks])
    final, _ = scene.score(refined)
    order = torch.argsort(final, descending=True, stable=True)
    return refined[order], final[order]


def _refine(scene: _Scene, plane: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
    """Return the plane after three searches on a grid of turns and offsets, each half as wide as the last."""
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=plane.dtype)
    for width in (1.0, 0.5, 0.25):
        near = _planes_near(scene, plane, 0.06 * width * steps, 0.04 * scene.size * width * steps)
        plane = near[scene.score(near)[0].argmax()]
    return plane


def _planes_near(
    scene: _Scene, plane: Float[Tensor, "4"], turns: Float[Tensor, "t"], shifts: Float[Tensor, "s"]
) -> Float[Tensor, "p 4"]:
    """Return a plane turned about each of its free axes [rad] and shifted [m]; a table leaves the vertical axis."""
    normal = plane[:3]
    if scene.table is not None:
        sideways = torch.stack([-normal[1], normal[0], torch.zeros_like(normal[0])])[None]
    else:
        sideways = torch.linalg.svd(normal[None], full_matrices=True).Vh[1:]
    turned = torch.cartesian_prod(*[turns] * len(sideways)).reshape(-1, len(sideways))
    normals = unit(normal + turned @ sideways)
    # Turn about the cloud's centre, not about a frame's origin that may be far away.
    offsets = plane[3] + (normals - normal) @ scene.center
    return torch.cat([normals.repeat_interleave(len(shifts), 0), (offsets[:, None] + shifts).reshape(-1, 1)], 1)


def _keep(scene: _Scene, images: list[_Image]) -> tuple[Tensor, Tensor, Tensor]:
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


def _allowed(scene: _Scene, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
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


def _reflect(points: Float[Tensor, "*b 3"], plane: Float[Tensor, "*c 4"]) -> Float[Tensor, "*d 3"]:
    """Mirror points across the plane n.x = o."""
    height = (points * plane[..., :3]).sum(-1, keepdim=True) - plane[..., 3:]
    return points - 2.0 * height * plane[..., :3]


def _turn(normals: Float[Tensor, "*b 3"], plane: Float[Tensor, "*c 4"]) -> Float[Tensor, "*d 3"]:
    """Mirror directions across a plane."""
    return normals - 2.0 * (normals * plane[..., :3]).sum(-1, keepdim=True) * plane[..., :3]
