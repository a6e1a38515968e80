"""Silhouettes of views: the object lies within its outline and behind its visible surface.

Lengths on the image plane at depth 1 have no unit. A point's position there is that in the image
over the depth.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.foundation.rules import Pose
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import Points, across, farthest_points, norm, unit
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class OutlineNumbers:
    """Parameters of the outline (silhouette) of a cloud in its camera's image.

    A spacing is the distance of neighbouring pixels at depth 1 (no unit).
    """

    grow: float = 2.0
    """Radius, in spacings, of the discs about the pixels whose union is the outline at first."""
    shrink: float = 1.65
    """Distance, in spacings, by which the union of the discs (`grow`) is then shrunk."""
    neighbours: int = 5
    """Number of nearest pixels, with the pixel itself, of which the farthest gives the spacing."""
    fine: float = 4.0
    """Number of cells of the raster in one spacing."""
    cells: int = 320
    """Greatest number of cells of the raster along the object."""
    margin: float = 0.25
    """Margin of the raster about the object, as a share of the object's extent: points beside it
    are looked up.
    """
    front: float = 0.002
    """Distance [m] in front of the visible surface up to which a point may be there by noise alone.
    """
    beside: float = 0.001
    """Greatest distance [m] outside the outline of a point that counts as hidden."""
    least_depth: float = 1e-9
    """Least depth [m] of a point: points behind the camera count as far outside."""
    edge: float = 0.75
    """Greatest distance [cells] from the outline of a node that lies on it."""
    smooth: float = 3.0
    """Standard deviation [cells] of the blur of the distance from the outline, before its slope is
    taken.
    """
    least_slope: float = 1e-12
    """Least length (no unit) of the slope of the distance from the outline that is a divisor."""
    rim: int = 16
    """Greatest number of points that are taken on the outline."""
    rim_neighbours: int = 4
    """Number of pixels beside a point on the outline whose median depth the point gets."""


OUTLINE = OutlineNumbers()


@dataclasses.dataclass(frozen=True)
class BehindNumbers:
    """Bounds beyond which a cloud shows both sides of an object, and so is not a single view."""

    share: float = 0.2
    """Greatest share of points of a view that are behind others."""
    radius: float = 0.3
    """Depth behind a neighbour, as a share of the cloud's radius, from which on a point is behind
    it.
    """
    neighbours: int = 6
    """Number of nearest pixels, with the pixel itself, with which a point is compared."""


BEHIND = BehindNumbers()
# relative difference of squared distances that is rounding, so that no frame decides on the order
TIE = 2e-9


def find_middle(points: Points) -> Float[Tensor, "3"]:
    """Return the centre (3,) of the bounding box of points (n, 3), in their unit."""
    return (points.amax(0) + points.amin(0)) / 2


def pick_apart(
    points: Float[Tensor, "n d"],
    count: int,
) -> Int[Tensor, "picks"]:
    """Return the indices of `count` points, or of all if fewer, each the farthest from those before
    it.

    The choice begins with the first point. Distances that differ by rounding count as equal. So a
    rigid motion of all points does not change the choice.
    """
    return farthest_points(points, count, tie=TIE)


@dataclasses.dataclass(frozen=True)
class Silhouette(Value):
    """The outline of an object and its visible depth in one view, as rasters.

    The rasters have h x w nodes on the image plane at depth 1. Lengths on this plane have no unit.
    """

    viewpoint: Float[Tensor, "3"]  # position of the camera, in the frame of the cloud [m]
    axes: Float[Tensor, "3 3"]  # unit vectors right, down and forward of the camera, one a line
    # position (x, y) of the first node of the rasters, on the image plane
    corner: Float[Tensor, "2"]
    cell: float  # distance of neighbouring nodes, on the image plane
    # signed distance of each node from the outline, on the image plane; positive outside
    outside: Float[Tensor, "h w"]
    # at each node, the depth [m] of the visible pixel nearest to the node
    depth: Float[Tensor, "h w"]
    # k points [m] of the outline at the visible depth, in the frame of the cloud
    rim: Float[Tensor, "k 3"]
    # outward unit normals at the points of `rim`, perpendicular to the camera rays
    rim_normals: Float[Tensor, "k 3"]
    # whether the object reaches the border of the image; points beyond do not count as outside
    cut: bool
    # width [m] of the widest area within the outline without measurements, perhaps a hole, or 0
    gap: float

    @checked(gradients=True)
    def hull_distance(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b"]:
        """Return the signed distance (*b,) [m] of points (*b, 3) [m] from the visual hull, positive
        outside.

        The visual hull is the cone of all camera rays within the outline. The distance is that in
        the image plane at the depth of the point. Points are in the frame of the cloud, and b
        stands for any batch axes.
        """
        outside, _, depth = self._look_up(points)
        return outside * depth

    @checked(gradients=True)
    def violation(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b"]:
        """Return how far [m] points (*b, 3) [m] are outside the outline or in front of the visible
        surface.

        The result is (*b,), and 0 for points that may be hidden. Points are in the frame of the
        cloud, and b stands for any batch axes. Space in front counts from 2 mm (`OUTLINE.front`)
        before the surface on, because of noise.
        """
        outside, visible, depth = self._look_up(points)
        in_front = (visible - depth - OUTLINE.front).clamp_min(0)
        return torch.where(outside > 0, outside * depth, in_front)

    @checked
    def moved(self, b_from_a: Pose) -> "Silhouette":
        """Return the silhouette in frame b, given the rigid transform `b_from_a` (4, 4) [m] from
        its own frame a.
        """
        viewpoint = apply(b_from_a, self.viewpoint[None])[0]
        rim = apply(b_from_a, self.rim)
        axes = rotate(b_from_a, self.axes)
        rim_normals = rotate(b_from_a, self.rim_normals)
        return dataclasses.replace(
            self, viewpoint=viewpoint, axes=axes, rim=rim, rim_normals=rim_normals
        )

    def _look_up(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return each point's distance to the outline at depth 1, the depth [m] seen there, and its
        own depth [m].
        """
        if is_fused(points, self.outside):
            from torchgrasp.shape.completion import fused_symmetry  # it imports numba

            camera = self.viewpoint, self.axes, self.corner
            rasters = self.outside, self.depth
            least = OUTLINE.least_depth
            return fused_symmetry.look_up(points, camera, self.cell, rasters, least)
        local = (points - self.viewpoint) @ self.axes.T
        depth = local[..., 2].clamp_min(OUTLINE.least_depth)
        position = (local[..., :2] / depth[..., None] - self.corner) / self.cell
        limit = position.new_tensor(self.outside.shape).flip(0) - 1
        clamped = torch.minimum(position.clamp_min(0), limit)
        column, row = torch.round(clamped).long().unbind(-1)
        beyond = norm(position - clamped) * self.cell
        return self.outside[row, column] + beyond, self.depth[row, column], depth


@dataclasses.dataclass(frozen=True)
class Outlines(Value):
    """The silhouettes of all views of one object, which lies within the outline of every view.

    All views, points and normals are in one frame: that of the cloud, until `moved`.
    """

    views: tuple[Silhouette, ...]  # the silhouette of each view

    @property
    def rim(self) -> Float[Tensor, "k 3"]:
        """Points (k, 3) [m] on the outlines of all views, at the depth of nearby pixels."""
        return torch.cat([view.rim for view in self.views])

    @property
    def rim_normals(self) -> Float[Tensor, "k 3"]:
        """The outward unit normals (k, 3) of the object's surface at the points of `rim`."""
        return torch.cat([view.rim_normals for view in self.views])

    @property
    def cut(self) -> bool:
        """Whether the border of an image cuts the object off in every view."""
        return all(view.cut for view in self.views)

    @property
    def gap(self) -> float:
        """The greatest width [m], over all views, of an area without measurements within the
        outline, or 0.
        """
        return max(view.gap for view in self.views)

    @checked
    def moved(self, b_from_a: Pose) -> "Outlines":
        """Return the outlines in frame b, given the rigid transform `b_from_a` (4, 4) [m] from
        their own frame a.
        """
        return Outlines(tuple(view.moved(b_from_a) for view in self.views))

    @checked(gradients=True)
    def hull_distance(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b"]:
        """Return the signed distance (*b,) [m] of points (*b, 3) [m] from the visual hull of all
        views. It is positive outside; b stands for any batch axes.
        """
        return torch.stack([view.hull_distance(points) for view in self.views]).amax(0)

    @checked(gradients=True)
    def violation(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b"]:
        """Return how far [m] points (*b, 3) [m] are outside the outline or in front of the visible
        surface.

        The result (*b,) is that of the worst view, and 0 for points that may be hidden. b stands
        for any batch axes. Space in front counts from 2 mm (`OUTLINE.front`) before the surface on,
        because of noise.
        """
        return torch.stack([view.violation(points) for view in self.views]).amax(0)

    def hides(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Bool[Tensor, "*b"]:
        """Return a mask (*b,) of the points (*b, 3) [m] that may be on the object's hidden side.

        They are less than 1 mm (`OUTLINE.beside`) outside the visual hull. They are also less than
        4 mm in front of the visible surface of every view.
        """
        return (self.hull_distance(points) < OUTLINE.beside) & (
            self.violation(points) < OUTLINE.front
        )


@checked
def silhouettes(cloud: PointCloud) -> Outlines:
    """Return the silhouettes of a cloud [m]: for each view, the object's outline in the camera's
    image and its visible depth.

    They are in the frame of the cloud, and a view is the points of one camera. Raises `BadArgument`
    for a view without viewpoint, or one that shows both sides of the object.
    """
    views = cloud.split_views()
    if any(view.viewpoint is None for view in views):
        raise BadArgument("cloud", "no viewpoint", "a cloud with viewpoints")
    return Outlines(tuple(map(silhouette, views)))


def silhouette(view: PointCloud) -> Silhouette:
    """Return the silhouette of one view: the object's outline in the camera's image and its visible
    depth.

    `view` holds points [m] of one camera; the silhouette is in their frame. Raises `BadArgument` if
    the view shows both sides of the object.

    The outline is made from discs around the pixels of the view's points. Within the outline there
    may be gaps, where nothing was measured. A gap counts as a hole (free space) only if it is wide.
    It must be far wider than the surface around it, as in a frame of bars. Other gaps do not count
    as free space: a mirror-like patch is not measured, and leaves a gap, too.
    """
    assert view.viewpoint is not None
    image = _check_view(view.points, view.viewpoint)
    axes = image.axes.numpy()
    pixels = image.pixels.numpy()
    depths = image.depths.numpy()
    spacing = float(np.median(image.apart[:, : OUTLINE.neighbours][:, -1]))
    disc = OUTLINE.grow * spacing
    low = pixels.min(0)
    size = pixels.max(0) - low
    extent = float(size.max())
    cell = max(spacing / OUTLINE.fine, extent / OUTLINE.cells)
    margin = int(np.ceil(disc / cell)) + int(OUTLINE.margin * extent / cell) + 2
    nodes = np.ceil(size / cell).astype(int)[::-1]
    shape = tuple(nodes + 2 * margin + 1)
    corner = low - margin * cell
    column, row = np.round((pixels - corner) / cell).astype(int).T
    # of pixels that share a cell the nearest to the camera is written last
    order = np.argsort(-depths)
    raster = np.zeros(shape)
    raster[row[order], column[order]] = depths[order]
    away, nearest = ndimage.distance_transform_edt(raster == 0, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]

    measured = away * cell <= disc
    grown = np.asarray(ndimage.binary_fill_holes(measured))
    gaps = grown & ~measured
    gap = 0.0
    if gaps.any():
        within = _distance(gaps)
        gap = 2 * (float(within.max()) * cell + disc)
        grown &= ~_find_holes(gaps, within, measured, disc / cell)
    inside = _distance(grown) * cell > OUTLINE.shrink * spacing
    unseen = _beyond_image(view.frustum, axes, corner, cell, grown, disc)
    inside |= unseen
    outside = (_distance(~inside) - _distance(inside)) * cell
    outside += np.where(inside, 0.5, -0.5) * cell  # the outline runs between two cells
    cut = bool(unseen.any())
    # the border of the image is no rim
    seen = _distance(~unseen) * cell > disc if cut else ~unseen
    rim, rim_normals = _rim(outside, seen, corner, cell, image)

    origin = view.viewpoint.double().cpu()
    axes = torch.from_numpy(axes)
    depth = np.where(unseen, 0.0, raster[tuple(nearest)])  # nothing is in front of what is not seen
    return Silhouette(
        viewpoint=origin,
        axes=axes,
        corner=torch.from_numpy(corner),
        cell=cell,
        outside=torch.from_numpy(outside),
        depth=torch.from_numpy(depth),
        rim=torch.from_numpy(rim) @ axes + origin,
        rim_normals=torch.from_numpy(rim_normals) @ axes,
        cut=cut,
        gap=gap * float(np.median(depths)),
    )


def _find_holes(
    gaps: np.ndarray,
    within: np.ndarray,
    measured: np.ndarray,
    grown: float,
) -> np.ndarray:
    """Return the cells of gaps that are over twice as wide as all surface around them.

    The surface is the mask `measured`, which was grown by so many cells. `within` is the distance
    [cells] of each cell of a gap to the gap's border.
    """
    number, count = ndimage.label(gaps)  # pyright: ignore[reportGeneralTypeIssues]
    holes = np.zeros_like(gaps)
    radii = np.asarray(ndimage.maximum(within, number, range(1, count + 1))) + grown
    suspects = np.flatnonzero(radii > 2 * grown)  # a narrower gap lies between sparse points
    if not len(suspects):
        return holes
    wide = _distance(measured)
    for k in suspects:
        own = number == k + 1
        around = measured & (_distance(~own) < 2 * radii[k])
        holes |= own & (2 * (wide[around].max() - grown) < radii[k])
    return holes


def _beyond_image(
    frustum: Tensor | None,
    axes: np.ndarray,
    corner: np.ndarray,
    cell: float,
    mask: np.ndarray,
    margin: float,
) -> np.ndarray:
    """Return which cells lie beyond an image border that the mask of the object reaches, or within
    `margin` of it.
    """
    beyond = np.zeros(mask.shape, dtype=bool)
    if frustum is None:
        return beyond
    row, column = np.indices(mask.shape)
    x = corner[0] + cell * column
    y = corner[1] + cell * row
    rays = np.stack([x, y, np.ones(mask.shape)], -1)  # (h, w, 3)
    for side in frustum.double().cpu().numpy() @ axes.T:
        past = rays @ side < margin * np.linalg.norm(side[:2])
        if (past & mask).sum() * cell**2 > margin**2:  # more than a stray pixel
            beyond |= past
    return beyond


class _Projection(NamedTuple):
    """The pixels of n points in the image of a camera that faces them, each with its k nearest.

    The pixel itself comes first.
    """

    axes: Float[Tensor, "3 3"]  # unit vectors right, down and forward of the camera, one a line
    pixels: Float[Tensor, "n 2"]  # positions at depth 1
    depths: Float[Tensor, "n"]  # [m]
    tree: "spatial.KDTree"  # of the pixels
    apart: Float[Tensor, "n k"]  # distances of the nearest pixels at depth 1, ascending
    nearest: Int[Tensor, "n k"]  # their indices

    @classmethod
    def of(cls, points: Points, viewpoint: Float[Tensor, "3"]) -> "_Projection":
        """Return the image of points [m] that a camera at the viewpoint [m] has in front of it."""
        points = points.double().cpu()
        viewpoint = viewpoint.double().cpu()
        forward = unit(find_middle(points) - viewpoint)
        axes = torch.stack([*across(forward), forward])  # right, down, forward
        local = (points - viewpoint) @ axes.T
        pixels = local[:, :2] / local[:, 2:]
        tree = spatial.KDTree(pixels.numpy())
        count = min(max(BEHIND.neighbours, OUTLINE.neighbours), len(pixels))
        near = tree.query(pixels.numpy(), k=count)
        return cls(axes, pixels, local[:, 2], tree, *map(torch.from_numpy, near))


def _check_view(points: Points, viewpoint: Float[Tensor, "3"]) -> _Projection:
    """Return the image of points [m] at the viewpoint [m]; raise `BadArgument` if no camera there
    can see them at once.
    """
    forward = find_middle(points) - viewpoint
    behind = int(((points - viewpoint) @ forward <= 0).sum())
    if behind:
        found = f"{viewpoint.tolist()} m, with {behind} of {len(points)} points beside or behind it"
        needed = "the position of a camera that has the whole cloud in front of it"
        raise BadArgument("viewpoint", found, needed)
    image = _Projection.of(points, viewpoint)
    # a surface as steep as 45 degrees is no second one
    depth = image.depths[:, None]
    apart = image.apart[:, : BEHIND.neighbours]
    seen = image.depths[image.nearest[:, : BEHIND.neighbours]]
    deeper = depth - seen - apart * depth  # (n, k)
    points = points.double().cpu()
    radius = norm(points - find_middle(points)).max()
    share = float((deeper.amax(1) > BEHIND.radius * radius).double().mean())
    if share > BEHIND.share:
        found = f"{share:.0%} of the points behind others, which no camera sees at once"
        needed = "a single view, the viewpoint of each point, or outward normals"
        raise BadArgument("cloud", found, needed)
    return image


def _distance(mask: np.ndarray) -> np.ndarray:
    """Return the distance [cells] of each cell to the nearest cell outside the mask."""
    found = np.zeros(mask.shape)
    # the mask's bounding box and the cells around it, one of which is nearer than any beyond
    sides = [np.flatnonzero(mask.any(axis)) for axis in (1, 0)]
    if len(sides[0]):
        box = tuple(slice(max(side[0] - 1, 0), side[-1] + 2) for side in sides)
        found[box] = ndimage.distance_transform_edt(mask[box])
    return found


def _rim(
    outside: np.ndarray,
    seen: np.ndarray,
    corner: np.ndarray,
    cell: float,
    image: _Projection,
) -> tuple[np.ndarray, np.ndarray]:
    """Return 16 evenly spread points of the outline at the depth of nearby pixels, and their
    surface normals.
    """
    row, column = np.nonzero(seen & (np.abs(outside) <= OUTLINE.edge * cell))
    if not len(row):
        return np.zeros((0, 3)), np.zeros((0, 3))
    smooth = ndimage.gaussian_filter(outside, OUTLINE.smooth)
    slope = np.stack([np.gradient(smooth, axis=axis)[row, column] for axis in (1, 0)], -1)
    slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), OUTLINE.least_slope)
    position = corner + cell * np.stack([column, row], -1)
    picks = pick_apart(torch.from_numpy(position), OUTLINE.rim).numpy()
    position = position[picks]
    slope = slope[picks]
    count = min(OUTLINE.rim_neighbours, len(image.pixels))
    _, index = image.tree.query(position, k=count)
    depth = np.median(image.depths.numpy()[index].reshape(len(position), -1), axis=-1)
    ray = np.concatenate([position, np.ones((len(position), 1))], -1)
    # The cone's normal is perpendicular to the ray and to the outline's tangent, and leans with the
    # slope.
    lean = -(slope * position).sum(-1, keepdims=True)
    across = np.concatenate([slope, lean], -1)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return ray * depth[:, None], across
