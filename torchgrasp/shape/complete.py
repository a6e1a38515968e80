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
APART = math.cos(math.radians(25.0))
"""Cosine of the least angle between two planes."""
HULL_MARGIN, SEEN_MARGIN, TABLE_MARGIN = 0.001, 0.002, 0.002
"""How far [m] a mirrored point may stand out of the hull, in front of the seen surface, below the table."""
NEW, SPACING = 0.006, 0.004
"""Least distance [m] of a mirrored point from the cloud and from another one."""


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
    mirrored = [(_reflect(points, p), _turn(normals, p), s) for p, s in zip(planes, scores, strict=True)]
    for i in range(min(2, len(planes))):
        for j in range(len(planes)):
            if i != j:
                once, turned, _ = mirrored[i]
                pair = torch.minimum(scores[i], scores[j]) - 0.05
                mirrored.append((_reflect(once, planes[j]), _turn(turned, planes[j]), pair))
    mirrored.sort(key=lambda m: -float(m[2]))
    kept = _keep(scene, mirrored)
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


def _find_planes(scene: _Scene) -> tuple[Float[Tensor, "p 4"], Float[Tensor, "p"]]:
    """Return the mirror planes of a scene, best first, and their scores."""
    center = (scene.points.amax(0) + scene.points.amin(0)) / 2
    size = float((scene.points.amax(0) - scene.points.amin(0)).max())
    view = torch.stack([unit(center - seen.viewpoint) for seen in scene.outline.views]).mean(0)
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
    refined = torch.stack([_refine(scene, grid[i, k], size) for i, k in picks])
    final, _ = scene.score(refined)
    order = torch.argsort(final, descending=True, stable=True)
    return refined[order], final[order]


def _refine(scene: _Scene, plane: Float[Tensor, "4"], size: float) -> Float[Tensor, "4"]:
    """Return the plane after three searches on a grid of turns and offsets, each half as wide as the last."""
    turn, shift = 0.06, 0.04 * size
    center = (scene.points.amax(0) + scene.points.amin(0)) / 2
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=plane.dtype)
    for _ in range(3):
        normal = plane[:3]
        if scene.table is not None:
            sideways = torch.stack([-normal[1], normal[0], torch.zeros_like(normal[0])])[None]
        else:
            sideways = torch.linalg.svd(normal[None], full_matrices=True).Vh[1:]
        turns = torch.cartesian_prod(*[steps] * len(sideways)).reshape(-1, len(sideways)) * turn
        normals = unit(normal + turns @ sideways)
        # Turn about the cloud's centre, not about a frame's origin that may be far away.
        offsets = plane[3] + (normals - normal) @ center
        candidates = torch.cat(
            [
                normals.repeat_interleave(3, 0),
                (offsets[:, None] + shift * steps).reshape(-1, 1),
            ],
            1,
        )
        scores, _ = scene.score(candidates)
        plane = candidates[scores.argmax()]
        turn, shift = turn / 2, shift / 2
    return plane


def _keep(scene: _Scene, mirrored: list[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Return points, normals and noise [m] of the mirrored points that nothing speaks against, best planes first."""
    from scipy.spatial import KDTree

    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    for points, normals, score in mirrored:
        distance, _ = scene.nearest(points)
        fine = (distance > NEW) & _allowed(scene, points)
        points, normals, distance = points[fine], normals[fine], distance[fine]
        if kept and len(points):
            before, _ = KDTree(torch.cat([k[0] for k in kept]).numpy()).query(points.numpy())
            new = torch.from_numpy(before) > SPACING
            points, normals, distance = points[new], normals[new], distance[new]
        thin = _thin(points)
        noise = 0.003 + 0.08 * distance[thin] + 0.006 * (0.4 - score).clamp_min(0)
        kept.append((points[thin], normals[thin], noise))
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
