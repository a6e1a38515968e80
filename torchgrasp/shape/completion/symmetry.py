"""Mirror planes of a partial cloud: the mirror image must lie on the cloud or be hidden, not in
free space.
"""

import dataclasses
import functools
import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import (
    farthest_points,
    fibonacci_sphere,
    reflect,
    reflect_directions,
    unit,
)
from torchgrasp.geometry.plane import Plane
from torchgrasp.shape.completion.silhouette import TIE, Outlines, silhouettes
from torchgrasp.values.planning import PointCloud

MATCH_DISTANCE = 0.003  # distance [m] over which a mirrored point stops matching the cloud
PROBES = 150  # points of the cloud that score a plane
# offsets tried for each direction of a plane, and for a known direction
OFFSETS = 17
FINE_OFFSETS = 65
# cosines of a plane's normal with the view: hides points above, is frontal above
MIN_FACING = 0.35
FACING = 0.7
RIM_PRIOR = (
    0.15  # loss of score at a quarter of the size from the rim: a view ends near the mirror plane
)
WITHIN = 0.12  # greatest loss of score against the best plane
APART = math.cos(math.radians(25.0))  # closer planes mirror to the same points
# greatest mean violation of free space, in [0, 1], of a plane added for the points that it hides
MAX_VIOLATION = 0.15
# a plane near the best one is dropped if its score is less by this: it matches only because it is
# near
SLOPE = 0.15
AXIS = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64, device="cpu")
END_SCORE = 0.4
"""The axis of a body of revolution in its frame, and the least score of the plane that mirrors its
ends.
"""
Mirror = Float[Tensor, "4"]
Mirrors = Float[Tensor, "_ 4"]
"""Mirror planes n.x = o, given as (n, o)."""
Directions = Float[Tensor, "d 3"]
View = Float[Tensor, "3"] | None
"""The direction of the view. It is None for views from above or from several sides, where no single
side is hidden.
"""


@dataclasses.dataclass(frozen=True)
class SymmetryScorer:
    """Scores mirror planes: mirrors some points of the cloud, the probes, and compares them with
    what is known.

    The probes are the points `rows`. Their images are compared with the cloud, its outlines and the
    table. `upright` means that all planes are parallel to z: the vertical direction, or the axis of
    a body of revolution.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    outline: Outlines
    table: Plane | None
    upright: bool
    rows: Int[Tensor, "k"]

    @classmethod
    def of(cls, cloud: PointCloud, table: float | None) -> "SymmetryScorer":
        """Return the scorer of a cloud with normals; `table` is its height [m]. Any point may
        become a probe.
        """
        assert cloud.normals is not None
        plane = None if table is None else Plane.horizontal(table)
        every = torch.arange(len(cloud), device="cpu")
        return cls(
            cloud.points, cloud.normals, silhouettes(cloud), plane, table is not None, every
        ).for_part(every)

    def about_axis(self, axis_from_cloud: Float[Tensor, "4 4"]) -> "SymmetryScorer":
        """Return the scorer in a frame whose z axis is the axis of revolution."""
        points = apply(axis_from_cloud, self.points)
        normals = rotate(axis_from_cloud, self.normals)
        table = None if self.table is None else self.table.moved(axis_from_cloud)
        return SymmetryScorer(
            points, normals, self.outline.moved(axis_from_cloud), table, True, self.rows
        )

    def for_part(self, rows: Int[Tensor, "k"]) -> "SymmetryScorer":
        """Return the scorer whose probes are chosen only from the points of the cloud with the
        indices `rows`.
        """
        return dataclasses.replace(
            self, rows=rows[farthest_points(self.points[rows], PROBES, tie=TIE)]
        )

    @functools.cached_property
    def probes(self) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
        """The points [m] of the cloud that a symmetry is tested on, and their normals."""
        return self.points[self.rows], self.normals[self.rows]

    @functools.cached_property
    def tree(self) -> "spatial.KDTree":
        """The k-d tree over all points of the cloud, for finding nearest neighbours."""
        return spatial.KDTree(self.points.numpy(), leafsize=32)

    @property
    def center(self) -> Tensor:
        """Centre of the cloud's bounding box [m]."""
        return (self.points.amax(0) + self.points.amin(0)) / 2

    @property
    def size(self) -> float:
        """Longest side of the cloud's bounding box [m]."""
        return float((self.points.amax(0) - self.points.amin(0)).max())

    def nearest(self, points: Tensor, limit: float = math.inf) -> tuple[Tensor, Tensor]:
        """Return distance [m] and index of the nearest cloud point; infinity and 0 if none is
        within the limit.
        """
        distance, index = self.tree.query(points.reshape(-1, 3).numpy(), distance_upper_bound=limit)
        shape = points.shape[:-1]
        index = torch.from_numpy(np.where(np.isinf(distance), 0, index)).reshape(shape)
        return torch.from_numpy(distance).reshape(shape), index

    def score(self, planes: Float[Tensor, "p 4"]) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Return the scores of planes n.x = o, given as (n, o), and their violations of free space
        in [0, 1].

        The score is the match of the mirror image with the cloud, minus twice the violation.
        """
        mirrored = reflect(self.probes[0], planes[:, None])
        normals = reflect_directions(self.probes[1], planes[:, None])
        distance, index = self.nearest(mirrored, 4 * MATCH_DISTANCE)
        agreement = (normals * self.normals[index]).sum(-1).clamp_min(0)
        match = (torch.exp(-0.5 * (distance / MATCH_DISTANCE) ** 2) * agreement).mean(-1)
        depth = self.outline.violation(mirrored)
        if self.table is not None:
            depth = depth + (-self.table.height(mirrored)).clamp_min(0)
        violation = ((depth / MATCH_DISTANCE).clamp_max(3.0) ** 2 / 9.0).mean(-1)
        return match - 2.0 * violation, violation


def find_planes(scorer: SymmetryScorer, turned: bool = False) -> tuple[Mirrors, Float[Tensor, "p"]]:
    """Return the mirror planes of a cloud, best first, and their scores.

    On a table, the search tries only vertical planes. A plane perpendicular to the best one is
    added if none was found near it: its mirror images are hidden, so that the cloud cannot confirm
    it. A horizontal plane at half the height is added to give the underside. A body of revolution
    (`turned`) needs neither, because every plane through its axis matches.
    """
    view = torch.stack(
        [unit(scorer.center - seen.viewpoint) for seen in scorer.outline.views]
    ).mean(0)
    if not scorer.upright:
        directions = fibonacci_sphere(160)[:80]  # half a sphere: n and -n are one
    else:
        directions = _level_directions(24)
        view = view * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64, device="cpu")
    # From above, or from sides that are far apart, no side alone is hidden, and every plane may add
    # points.
    across = unit(view) if float(torch.linalg.vector_norm(view)) > 0.05 else None
    grid = _plane_grid(scorer, directions)
    scores = scorer.score(grid.reshape(-1, 4))[0].reshape(grid.shape[:2])
    if not scorer.upright:
        rim = (scorer.outline.rim @ directions.T).median(0).values
        scores = scores - RIM_PRIOR * ((grid[..., 3] - rim[:, None]) / (0.25 * scorer.size)) ** 2
    strongest = int(scores.max(1).values.argmax())
    scores = scores + 0.1 * ((directions @ directions[strongest]).abs() < 0.1)[:, None]

    planes = [_refine(scorer, grid[i, k]) for i, k in _pick_planes(scores, directions, across)]
    if scorer.table is None or turned:
        planes += list(_across_plane(scorer, planes, grid, across))
        if turned and scorer.table is None:
            planes += list(
                _best_plane(scorer, _plane_grid(scorer, AXIS, FINE_OFFSETS)[0], END_SCORE)
            )
    else:
        best = _refine(scorer, grid[strongest, int(scores[strongest].argmax())])
        # Some planes score well only because they are near the best plane.
        least = float(scorer.score(best[None])[0]) - SLOPE
        apart = [abs(float(plane[:3] @ best[:3])) < APART for plane in planes]
        planes = [
            p
            for p, far in zip(planes, apart, strict=True)
            if far or float(scorer.score(p[None])[0]) > least
        ]
        planes += list(_square_plane(scorer, planes, best, across))
        half = ((scorer.points[:, 2].max() + scorer.table.offset) / 2)[None, None]
        planes += list(_best_plane(scorer, torch.cat([AXIS, half], 1), 0.0))
    if not planes:
        return scorer.points.new_zeros(0, 4), scorer.points.new_zeros(0)
    found = torch.stack(planes)
    final, _ = scorer.score(found)
    order = torch.argsort(final, descending=True, stable=True)
    return found[order], final[order]


def find_plane_through_axis(
    scorer: SymmetryScorer, center: Float[Tensor, "2"], part: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "1 4"], Float[Tensor, "1"]]:
    """Return the mirror plane of an attached part, such as a handle, through the axis at `center`,
    and its score.

    A plane across which the part extends less is preferred, even if half of the part is hidden.
    """
    normals = _level_directions(96)
    planes = torch.cat([normals, (normals[:, :2] @ center)[:, None]], -1)
    arm = part[:, :2] - center
    extent = (arm @ normals[:, :2].T).square().mean(0) / arm.square().sum(1).mean()
    scores, _ = scorer.score(planes)
    best = (scores - extent).argmax()
    return planes[best][None], scores[best][None]


def planes_near(
    scorer: SymmetryScorer, plane: Mirror, angles: Float[Tensor, "t"], shifts: Float[Tensor, "s"]
) -> Mirrors:
    """Return planes near a plane: rotated by `angles` [rad], if upright about z only, and shifted
    by `shifts` [m].
    """
    normal = plane[:3]
    if scorer.upright:
        sideways = torch.stack([-normal[1], normal[0], torch.zeros_like(normal[0])])[None]
    else:
        sideways = torch.linalg.svd(normal[None], full_matrices=True).Vh[1:]
    tilts = torch.cartesian_prod(*[angles] * len(sideways)).reshape(-1, len(sideways))
    normals = unit(normal + tilts @ sideways)
    # Rotate about the cloud's centre: a frame's origin may be far away.
    offsets = plane[3] + (normals - normal) @ scorer.center
    return torch.cat(
        [normals.repeat_interleave(len(shifts), 0), (offsets[:, None] + shifts).reshape(-1, 1)], 1
    )


def _level_directions(n: int) -> Float[Tensor, "n 3"]:
    """Return n horizontal unit vectors, evenly spaced over half a circle."""
    angle = torch.arange(n, dtype=torch.float64, device="cpu") * math.pi / n
    return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)


def _plane_grid(
    scorer: SymmetryScorer, directions: Directions, count: int = OFFSETS
) -> Float[Tensor, "d k 4"]:
    """Return planes with the given normals, each at `count` offsets over the cloud's extent."""
    along = scorer.points @ directions.T
    low = along.amin(0)
    high = along.amax(0)
    middle = (low + high) / 2
    half = ((high - low) / 2).clamp_min(0.15 * scorer.size)
    offsets = middle[:, None] + half[:, None] * torch.linspace(
        -1, 1, count, dtype=torch.float64, device="cpu"
    )
    return torch.cat([directions[:, None].expand(-1, count, -1), offsets[..., None]], -1)


def _pick_planes(
    scores: Float[Tensor, "d k"], directions: Directions, across: View
) -> list[tuple[int, int]]:
    """Return (direction, offset) indices of the best planes, unlike in direction, that map seen
    points to hidden.
    """
    best, offset = scores.max(1)
    hides = _hides(directions, across)
    order = [i for i in torch.argsort(best, descending=True, stable=True).tolist() if hides[i]]
    chosen: list[int] = []
    for i in order:
        if len(chosen) == 4 or best[i] <= best[order[0]] - WITHIN:
            break
        if all(abs(float(directions[i] @ directions[j])) < APART for j in chosen):
            chosen.append(i)
    return [(i, int(offset[i])) for i in chosen]


def _hides(directions: Directions, across: View) -> Bool[Tensor, "d"]:
    """Return which mirror planes, given by normals, can map seen points to hidden ones; all if
    `across` is None.
    """
    if across is None:
        return torch.ones(len(directions), dtype=torch.bool, device="cpu")
    return (directions @ across).abs() > MIN_FACING


def _across_plane(
    scorer: SymmetryScorer, planes: list[Mirror], grid: Float[Tensor, "d k 4"], across: View
) -> Mirrors:
    """Return, as a row, the best plane that faces the view; no row if `planes` has one or all
    violate free space.
    """
    if across is None or any(abs(float(plane[:3] @ across)) > FACING for plane in planes):
        return grid.new_zeros(0, 4)
    found = _best_plane(
        scorer, grid[(grid[:, 0, :3] @ across).abs() > FACING].reshape(-1, 4), -math.inf
    )
    return torch.stack([_refine(scorer, plane) for plane in found]) if len(found) else found


def _square_plane(
    scorer: SymmetryScorer, planes: list[Mirror], best: Mirror, across: View
) -> Mirrors:
    """Return the best vertical plane at right angles to `best`, as a row.

    There is no row if it is known already or if mirrored points would be visible.
    """
    direction = torch.stack([-best[1], best[0], torch.zeros_like(best[0])])[None]
    near = any(abs(float(plane[:3] @ direction[0])) > 0.42 for plane in planes)
    if near or not bool(_hides(direction, across)):
        return best.new_zeros(0, 4)
    return _best_plane(scorer, _plane_grid(scorer, direction, FINE_OFFSETS)[0], -math.inf)


def _best_plane(scorer: SymmetryScorer, planes: Mirrors, least: float) -> Mirrors:
    """Return, as a row, the plane of the greatest score above `least` that does not violate free
    space, or no row.
    """
    if not len(planes):
        return planes
    scores, violation = scorer.score(planes)
    scores = torch.where(violation < MAX_VIOLATION, scores, -torch.inf)
    return planes[scores.argmax()][None][scores.max()[None] > least]


def _refine(scorer: SymmetryScorer, plane: Mirror) -> Mirror:
    """Return the plane of the best score nearby, after three grid searches, each half as wide as
    the last.
    """
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=plane.dtype, device="cpu")
    for width in (1.0, 0.5, 0.25):
        near = planes_near(scorer, plane, 0.06 * width * steps, 0.04 * scorer.size * width * steps)
        plane = near[scorer.score(near)[0].argmax()]
    return plane
