"""Planes of symmetry of a partial cloud: found by matching its mirror image against the cloud and free space."""

import dataclasses
import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.linalg import farthest_points, fibonacci_sphere, unit
from torchgrasp.shape.completion.silhouette import TIE, Outlines, silhouettes
from torchgrasp.values import PointCloud

TAU = 0.003
"""Distance [m] over which a mirrored point stops matching the cloud."""
PROBES = 150
"""Points of the cloud with which a plane is scored."""
OFFSETS = 17
"""Offsets tried for each direction of a plane."""
ANGLES, FINE_ANGLES = 24, 96
"""Directions of vertical planes tried when gravity is known, and when an axis is, too."""
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


@dataclasses.dataclass(frozen=True)
class SymmetryScene:
    """What planes are scored against: the cloud, its outline and the table; and the points that they are scored by."""

    points: Tensor
    normals: Tensor
    tree: object
    outline: Outlines
    table: float | None
    probes: Tensor
    probe_normals: Tensor

    @classmethod
    def of(cls, cloud: PointCloud, table: float | None) -> "SymmetryScene":
        """Return the scene of a cloud with normals, scored by all of it."""
        from scipy.spatial import KDTree

        assert cloud.normals is not None
        tree = KDTree(cloud.points.numpy())
        whole = cls(cloud.points, cloud.normals, tree, silhouettes(cloud), table, cloud.points[:0], cloud.normals[:0])
        return whole.scored_by(torch.arange(len(cloud)))

    def scored_by(self, rows: Int[Tensor, "k"]) -> "SymmetryScene":
        """Return the same scene, scored by some points of the cloud."""
        rows = rows[farthest_points(self.points[rows], PROBES, tie=TIE)]
        return dataclasses.replace(self, probes=self.points[rows], probe_normals=self.normals[rows])

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
        mirrored = reflect(self.probes, planes[:, None])
        turned = turn(self.probe_normals, planes[:, None])
        distance, index = self.nearest(mirrored, 4 * TAU)
        agreement = (turned * self.normals[index]).sum(-1).clamp_min(0)
        match = (torch.exp(-0.5 * (distance / TAU) ** 2) * agreement).mean(-1)
        violation = self.outline.violation(mirrored)
        if self.table is not None:
            violation = violation + (self.table - mirrored[..., 2]).clamp_min(0)
        bad = ((violation / TAU).clamp_max(3.0) ** 2 / 9.0).mean(-1)
        return match - 2.0 * bad, bad


def find_planes(scene: SymmetryScene) -> tuple[Float[Tensor, "p 4"], Float[Tensor, "p"]]:
    """Return the mirror planes of a scene, best first, and their scores."""
    size = scene.size
    view = torch.stack([unit(scene.center - seen.viewpoint) for seen in scene.outline.views]).mean(0)
    if scene.table is None:
        directions = fibonacci_sphere(2 * DIRECTIONS)[:DIRECTIONS]  # a half sphere: n and -n are one
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


def find_upright_plane(
    scene: SymmetryScene, center: Float[Tensor, "2"], part: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "1 4"], Float[Tensor, "1"]]:
    """Return the plane through an upright axis about which a part that stands out is symmetric, and its score.

    Handles and spouts lie on such a plane: what is less aside of it is favoured, even where their other half is hidden.
    """
    angle = torch.arange(FINE_ANGLES, dtype=torch.float64) * math.pi / FINE_ANGLES
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    planes = torch.cat([normals, (normals[:, :2] @ center)[:, None]], -1)
    arm = part[:, :2] - center
    aside = (arm @ normals[:, :2].T).square().mean(0) / arm.square().sum(1).mean()
    scores, _ = scene.score(planes)
    best = (scores - aside).argmax()
    return planes[best][None], scores[best][None]


def _refine(scene: SymmetryScene, plane: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
    """Return the plane after three searches on a grid of turns and offsets, each half as wide as the last."""
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=plane.dtype)
    for width in (1.0, 0.5, 0.25):
        near = planes_near(scene, plane, 0.06 * width * steps, 0.04 * scene.size * width * steps)
        plane = near[scene.score(near)[0].argmax()]
    return plane


def planes_near(
    scene: SymmetryScene, plane: Float[Tensor, "4"], turns: Float[Tensor, "t"], shifts: Float[Tensor, "s"]
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


def reflect(points: Float[Tensor, "*b 3"], plane: Float[Tensor, "*c 4"]) -> Float[Tensor, "*d 3"]:
    """Mirror points across the plane n.x = o."""
    height = (points * plane[..., :3]).sum(-1, keepdim=True) - plane[..., 3:]
    return points - 2.0 * height * plane[..., :3]


def turn(normals: Float[Tensor, "*b 3"], plane: Float[Tensor, "*c 4"]) -> Float[Tensor, "*d 3"]:
    """Mirror directions across a plane."""
    return normals - 2.0 * (normals * plane[..., :3]).sum(-1, keepdim=True) * plane[..., :3]
