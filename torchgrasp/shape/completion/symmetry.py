"""Mirror planes of a partial cloud. A mirror image must lie on the cloud or be hidden, not in free
space.

A plane n . x = o is given as (n, o), with a unit normal n and an offset o [m]. Its score is 1 if
the mirror image lies on the cloud, and near 0 if nothing confirms it. Violations of free space
lower it.
"""

import dataclasses
import functools
import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.box_tree import Boxes, sort_into_boxes
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import (
    Points,
    fibonacci_sphere,
    norm,
    reflect,
    reflect_directions,
    unit,
)
from torchgrasp.geometry.plane import Plane
from torchgrasp.shape.completion.silhouette import Outlines, find_middle, pick_apart, silhouettes
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class SymmetryNumbers:
    """Parameters of the score by which mirror planes of a cloud are compared."""

    match: float = 0.003
    """Length scale [m] of the distances over which a mirrored point's match with the cloud falls to
    0.
    """
    far: float = 4.0
    """Greatest distance of a match with the cloud, in multiples of `match`."""
    worst: float = 3.0
    """Depth of a mirrored point in free space, in multiples of `match`, from which on its violation
    is the greatest.
    """
    probes: int = 150
    """Greatest number of points of the cloud (probes) by which a plane is scored."""
    leaf: int = 32
    """Greatest number of points in a leaf of the k-d tree of all points."""


SYMMETRY = SymmetryNumbers()


@dataclasses.dataclass(frozen=True)
class PlaneSearchNumbers:
    """Parameters of the search for a cloud's mirror planes.

    Unless a field says otherwise, a cosine is that of the angle between the normals of two planes.
    """

    sphere: int = 160
    """Number of directions over a whole sphere, of which half are tried: n and -n are one plane."""
    level: int = 24
    """Number of directions of upright planes that are tried."""
    level_through_axis: int = 96
    """Number of directions of planes that are tried for a part attached to a body of revolution."""
    offsets: int = 17
    """Number of offsets that are tried for each direction of a plane."""
    fine_offsets: int = 65
    """Number of offsets that are tried for a known direction."""
    least_extent: float = 0.15
    """Least half range of the offsets, as a share of the cloud's size."""
    one_side: float = 0.05
    """Least length of the mean viewing direction of views from one side. It is shorter for views
    from above, or from several sides.
    """
    hides: float = 0.35
    """|Cosine| between a plane's normal and the viewing direction from which on mirror images are
    on the hidden side.
    """
    facing: float = 0.7
    """|Cosine| between the normal of a plane and the viewing direction above which the plane faces
    the camera.
    """
    rim_prior: float = 0.15
    """Score that a plane loses at the distance `rim_distance` from the rim of the view. A view ends
    near the mirror plane.
    """
    rim_distance: float = 0.25
    """Distance from the rim at which a plane loses `rim_prior`, over the size of the cloud."""
    square: float = 0.1
    """Greatest |cosine| of planes that count as perpendicular to the best one."""
    square_prior: float = 0.1
    """Score that planes perpendicular to the best one gain."""
    most: int = 4
    """Greatest number of planes that are chosen from all directions."""
    within: float = 0.12
    """Greatest difference of the score of a chosen plane from that of the best one."""
    apart: float = math.cos(math.radians(25.0))
    """|Cosine| above which two planes mirror to the same points."""
    square_apart: float = 0.42
    """|Cosine| above which a plane replaces one that is perpendicular to the best plane."""
    violation: float = 0.15
    """Greatest mean violation of free space, in [0, 1], of a plane that no point confirms."""
    slope: float = 0.15
    """Difference of the score from the best one above which a plane is dropped. This holds for
    planes with nearly the best plane's normal. They match the cloud only because they are near that
    plane.
    """
    end_score: float = 0.4
    """Least score of the plane that mirrors the ends of a body of revolution."""
    widths: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Widths of the grids that refine a plane, each half as wide as the last."""
    angle: float = 0.06
    """Step of the widest grid in the rotation of a plane [rad]."""
    shift: float = 0.04
    """Step of the widest grid in the shift of a plane, over the size of the cloud."""


SEARCH = PlaneSearchNumbers()
# the axis of a body of revolution in its frame
AXIS = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64, device="cpu")
Mirror = Float[Tensor, "4"]
Mirrors = Float[Tensor, "_ 4"]
"""Mirror planes (p, 4) with n.x = o, given as (n, o): unit normals, and offsets [m]."""
Directions = Float[Tensor, "d 3"]
View = Float[Tensor, "3"] | None
"""The viewing direction, a unit vector (3,). It is None for views from above or from several sides,
where no single side is hidden.
"""


@dataclasses.dataclass(frozen=True)
class SymmetryScorer:
    """The scorer of mirror planes of a cloud: it mirrors some points, the probes, and judges their
    images.

    The images are compared with the cloud, with the outlines of the views, and with the table. All
    is in one frame: that of the cloud, until `about_axis`. The z axis of an `upright` scorer is the
    vertical direction, or the axis of a body of revolution.
    """

    points: Points  # points (n, 3) [m] of the cloud
    normals: Points  # outward unit normals (n, 3) at these points
    outline: Outlines  # silhouettes of the views
    table: Plane | None  # the table; None means no table
    upright: bool  # whether all planes are parallel to z
    rows: Int[Tensor, "k"]  # indices in `points` of the k points from which probes are chosen

    @classmethod
    def of(cls, cloud: PointCloud, table: float | None) -> "SymmetryScorer":
        """Return the scorer of a cloud [m] with normals and viewpoints. Its probes are up to 150
        points (`SYMMETRY.probes`) that lie far apart.

        `table` is the table's height [m]; None means no table.
        """
        assert cloud.normals is not None
        plane = None if table is None else Plane.horizontal(table)
        every = torch.arange(len(cloud), device="cpu")
        outline = silhouettes(cloud)
        whole = cls(cloud.points, cloud.normals, outline, plane, table is not None, every)
        return whole.for_part(every)

    def about_axis(self, axis_from_cloud: Float[Tensor, "4 4"]) -> "SymmetryScorer":
        """Return the scorer moved to a frame whose z axis is the axis of a body of revolution.

        `axis_from_cloud` (4, 4) is the rigid transform [m] to this frame. The result is `upright`.
        """
        points = apply(axis_from_cloud, self.points)
        normals = rotate(axis_from_cloud, self.normals)
        table = None if self.table is None else self.table.moved(axis_from_cloud)
        outline = self.outline.moved(axis_from_cloud)
        return SymmetryScorer(points, normals, outline, table, True, self.rows)

    def for_part(self, rows: Int[Tensor, "k"]) -> "SymmetryScorer":
        """Return the scorer with probes chosen only from one part of the cloud: its points with the
        indices `rows` (k,).
        """
        chosen = pick_apart(self.points[rows], SYMMETRY.probes)
        return dataclasses.replace(self, rows=rows[chosen])

    @functools.cached_property
    def probes(self) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
        """The k points (k, 3) [m] of the cloud that are mirrored to test a plane, and their unit
        normals.
        """
        return self.points[self.rows], self.normals[self.rows]

    @functools.cached_property
    def tree(self) -> "spatial.KDTree":
        """The k-d tree over all points of the cloud, for finding nearest neighbours."""
        return spatial.KDTree(self.points.numpy(), leafsize=SYMMETRY.leaf)

    @functools.cached_property
    def boxes(self) -> Boxes:
        """All points of the cloud in a tree of boxes, in which compiled loops find nearest
        neighbours.
        """
        return sort_into_boxes(self.points.numpy())

    @property
    def center(self) -> Tensor:
        """Centre (3,) [m] of the cloud's bounding box."""
        return find_middle(self.points)

    @property
    def size(self) -> float:
        """Longest side of the cloud's bounding box [m]."""
        return float((self.points.amax(0) - self.points.amin(0)).max())

    def nearest(
        self,
        points: Tensor,
        limit: float = math.inf,
    ) -> tuple[Tensor, Tensor]:
        """Return (distance, index) of the cloud point nearest to each of the points (..., 3) [m].

        The distance is in metres, and the index is that in `points` of the scorer. If no point is
        within the `limit` [m], distance and index are infinity and 0.
        """
        rows = points.reshape(-1, 3).numpy()
        if is_fused(points):
            from torchgrasp.geometry import fused_points  # it imports numba

            distance, index = fused_points.nearest(rows, self.boxes, limit)
        else:
            distance, index = self.tree.query(rows, distance_upper_bound=limit)
            index = np.where(np.isinf(distance), 0, index)
        shape = points.shape[:-1]
        return torch.from_numpy(distance).reshape(shape), torch.from_numpy(index).reshape(shape)

    def score(
        self,
        planes: Float[Tensor, "p 4"],
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """Return (scores, violations), both (p,), of p mirror planes n.x = o, given as (n, o [m]).

        The score is the match of the mirror image with the cloud, in [0, 1], minus twice the
        violation. The violation, in [0, 1], says how deep mirrored points are in free space or
        below the table. Both are means over the probes.
        """
        points, normals = self.probes
        far = SYMMETRY.far * SYMMETRY.match
        if is_fused(planes, points):
            from torchgrasp.shape.completion import fused_symmetry  # it imports numba

            mirrored, distance, cosine = fused_symmetry.match_images(
                self.probes, self.normals, self.boxes, planes, far
            )
        else:
            mirrored = reflect(points, planes[:, None])  # (p, k, 3)
            turned = reflect_directions(normals, planes[:, None])
            distance, index = self.nearest(mirrored, far)
            cosine = (turned * self.normals[index]).sum(-1)
        agreement = cosine.clamp_min(0)
        near = torch.exp(-0.5 * (distance / SYMMETRY.match) ** 2)
        match = (near * agreement).mean(-1)
        depth = self.outline.violation(mirrored)
        if self.table is not None:
            depth = depth + (-self.table.height(mirrored)).clamp_min(0)
        worst = SYMMETRY.worst
        violation = ((depth / SYMMETRY.match).clamp_max(worst) ** 2 / worst**2).mean(-1)
        return match - 2.0 * violation, violation


def find_planes(
    scorer: SymmetryScorer,
    turned: bool = False,
) -> tuple[Mirrors, Float[Tensor, "p"]]:
    """Return (planes, scores): the p mirror planes (n, o [m]) of a cloud, best first, and their
    scores (p,).

    On a table, the search tries only vertical planes. A plane perpendicular to the best one is
    added if none was found near it. Its mirror images are hidden, so that the cloud cannot confirm
    it. A horizontal plane at half the height is added to give the underside. A body of revolution
    (`turned`) gets neither, because every plane through its axis matches. Without a table, a plane
    that mirrors the ends of such a body may be added. For such a body, and without a table, a plane
    that faces the cameras may be added, too. If no plane is found, p is 0.
    """
    views = [unit(scorer.center - seen.viewpoint) for seen in scorer.outline.views]
    view = torch.stack(views).mean(0)
    if scorer.upright:
        directions = _level_directions(SEARCH.level)
        view = view * (1.0 - AXIS[0])
    else:
        directions = fibonacci_sphere(SEARCH.sphere)[: SEARCH.sphere // 2]
    # From above, or from sides that are far apart, no side alone is hidden, and every plane may add
    # points.
    across = unit(view) if float(norm(view)) > SEARCH.one_side else None
    grid = _plane_grid(scorer, directions)  # (d, k, 4)
    scores, _ = scorer.score(grid.reshape(-1, 4))
    scores = scores.reshape(grid.shape[:2])
    if not scorer.upright:
        rim = (scorer.outline.rim @ directions.T).median(0).values
        away = (grid[..., 3] - rim[:, None]) / (SEARCH.rim_distance * scorer.size)
        scores = scores - SEARCH.rim_prior * away**2
    strongest = int(scores.max(1).values.argmax())
    square = (directions @ directions[strongest]).abs() < SEARCH.square
    scores = scores + SEARCH.square_prior * square[:, None]

    planes = [_refine(scorer, grid[i, k]) for i, k in _pick_planes(scores, directions, across)]
    if scorer.table is None or turned:
        planes += _across_plane(scorer, planes, grid, across)
        if turned and scorer.table is None:
            ends = _plane_grid(scorer, AXIS, SEARCH.fine_offsets)[0]
            planes += _best_plane(scorer, ends, SEARCH.end_score)
    else:
        best = _refine(scorer, grid[strongest, int(scores[strongest].argmax())])
        # Some planes score well only because they are near the best plane.
        least = float(scorer.score(best[None])[0]) - SEARCH.slope
        planes = [
            plane
            for plane in planes
            if abs(float(plane[:3] @ best[:3])) < SEARCH.apart
            or float(scorer.score(plane[None])[0]) > least
        ]
        planes += _square_plane(scorer, planes, best, across)
        half = (scorer.points[:, 2].max() + scorer.table.offset) / 2
        planes += _best_plane(scorer, torch.cat([AXIS, half[None, None]], 1), 0.0)
    if not planes:
        return scorer.points.new_zeros(0, 4), scorer.points.new_zeros(0)
    found = torch.stack(planes)
    final, _ = scorer.score(found)
    order = torch.argsort(final, descending=True, stable=True)
    return found[order], final[order]


def find_plane_through_axis(
    scorer: SymmetryScorer,
    center: Float[Tensor, "2"],
    part: Points,
) -> tuple[Float[Tensor, "1 4"], Float[Tensor, "1"]]:
    """Return (plane, score): the mirror plane (n, o [m]) of a part attached to a body of
    revolution.

    The part may be a handle, with the points `part` (n, 3) [m]. The plane contains the body's axis,
    which is along z at `center` (x, y) [m]. `scorer` judges the planes. A plane across which the
    part extends less is preferred, even if half of the part is hidden.
    """
    normals = _level_directions(SEARCH.level_through_axis)
    level = normals[:, :2]
    planes = torch.cat([normals, (level @ center)[:, None]], -1)
    arm = part[:, :2] - center
    extent = (arm @ level.T).square().mean(0)
    extent = extent / arm.square().sum(1).mean()
    scores, _ = scorer.score(planes)
    best = (scores - extent).argmax()
    return planes[best][None], scores[best][None]


def planes_near(
    scorer: SymmetryScorer,
    plane: Mirror,
    angles: Float[Tensor, "t"],
    shifts: Float[Tensor, "s"],
) -> Mirrors:
    """Return the mirror planes (p, 4) near a given `plane`, for all combinations of t angles and s
    shifts.

    A plane is (n, o): unit normal and offset [m]. It is rotated by `angles` [rad], about z if the
    scorer is upright, else about two axes in it. So p is t s, or t t s. The cloud's centre stays at
    the same distance from it. Then it is shifted by `shifts` [m] along its normal.
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
    offsets = (offsets[:, None] + shifts).reshape(-1, 1)  # (t s, 1)
    return torch.cat([normals.repeat_interleave(len(shifts), 0), offsets], 1)


def _level_directions(n: int) -> Points:
    """Return n horizontal unit vectors, evenly spaced over half a circle."""
    angle = torch.arange(n, dtype=torch.float64, device="cpu") * math.pi / n
    return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)


def _plane_grid(
    scorer: SymmetryScorer,
    directions: Directions,
    count: int = SEARCH.offsets,
) -> Float[Tensor, "d k 4"]:
    """Return planes with the given normals, each at `count` offsets over the cloud's extent."""
    along = scorer.points @ directions.T
    low = along.amin(0)
    high = along.amax(0)
    middle = (low + high) / 2
    half = ((high - low) / 2).clamp_min(SEARCH.least_extent * scorer.size)
    steps = torch.linspace(-1, 1, count, dtype=torch.float64, device="cpu")
    offsets = middle[:, None] + half[:, None] * steps  # (d, count)
    normals = directions[:, None].expand(-1, count, -1)
    return torch.cat([normals, offsets[..., None]], -1)


def _pick_planes(
    scores: Float[Tensor, "d k"],
    directions: Directions,
    across: View,
) -> list[tuple[int, int]]:
    """Return (direction, offset) indices of the best planes, unlike in direction, that map seen
    points to hidden.
    """
    best, offset = scores.max(1)
    hides = _hides(directions, across)
    order = torch.argsort(best, descending=True, stable=True)
    order = order[hides[order]].tolist()
    chosen: list[int] = []
    for i in order:
        if len(chosen) == SEARCH.most or best[i] <= best[order[0]] - SEARCH.within:
            break
        if all(abs(float(directions[i] @ directions[j])) < SEARCH.apart for j in chosen):
            chosen.append(i)
    return [(i, int(offset[i])) for i in chosen]


def _hides(directions: Directions, across: View) -> Bool[Tensor, "d"]:
    """Return which mirror planes, given by normals, can map seen points to hidden ones; all if
    `across` is None.
    """
    if across is None:
        return torch.ones(len(directions), dtype=torch.bool, device="cpu")
    return (directions @ across).abs() > SEARCH.hides


def _across_plane(
    scorer: SymmetryScorer,
    planes: list[Mirror],
    grid: Float[Tensor, "d k 4"],
    across: View,
) -> list[Mirror]:
    """Return the best plane that faces the view; none if `planes` has one or all violate free
    space.
    """
    if across is None or any(abs(float(plane[:3] @ across)) > SEARCH.facing for plane in planes):
        return []
    facing = (grid[:, 0, :3] @ across).abs() > SEARCH.facing
    found = _best_plane(scorer, grid[facing].reshape(-1, 4), -math.inf)
    return [_refine(scorer, plane) for plane in found]


def _square_plane(
    scorer: SymmetryScorer,
    planes: list[Mirror],
    best: Mirror,
    across: View,
) -> list[Mirror]:
    """Return the best vertical plane at right angles to `best`.

    There is none if it is known already or if mirrored points would be visible.
    """
    direction = torch.stack([-best[1], best[0], torch.zeros_like(best[0])])[None]
    near = any(abs(float(plane[:3] @ direction[0])) > SEARCH.square_apart for plane in planes)
    if near or not bool(_hides(direction, across)):
        return []
    return _best_plane(scorer, _plane_grid(scorer, direction, SEARCH.fine_offsets)[0], -math.inf)


def _best_plane(
    scorer: SymmetryScorer,
    planes: Mirrors,
    least: float,
) -> list[Mirror]:
    """Return the plane of the greatest score above `least` that does not violate free space, or
    none.
    """
    if not len(planes):
        return []
    scores, violation = scorer.score(planes)
    scores = torch.where(violation < SEARCH.violation, scores, -torch.inf)
    best = scores.argmax()
    return [planes[best]] if float(scores[best]) > least else []


def _refine(scorer: SymmetryScorer, plane: Mirror) -> Mirror:
    """Return the plane of the best score nearby, after ever narrower grid searches."""
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=plane.dtype, device="cpu")
    for width in SEARCH.widths:
        angles = SEARCH.angle * width * steps
        near = planes_near(scorer, plane, angles, SEARCH.shift * scorer.size * width * steps)
        plane = near[scorer.score(near)[0].argmax()]
    return plane
