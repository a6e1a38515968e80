"""Silhouettes: the object lies within its outline and behind its visible surface."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.foundation.rules import Pose
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import across, farthest_points, unit
from torchgrasp.values.planning import PointCloud

# the outline is a union of discs about the pixels, then shrunk [pixel spacings]
GROW = 2.0
SHRINK = 1.65
FRONT_MARGIN = (
    0.002  # a point may be this far [m] in front of the visible surface: noise of the camera
)
MAX_BEHIND = 0.2  # greatest share of points behind others in a single view
TIE = 2e-9  # relative difference of squared distances by rounding: the frame must not decide


@dataclasses.dataclass(frozen=True)
class Silhouette(Value):
    """The outline and visible depth of one view, as rasters on the image plane at depth 1."""

    viewpoint: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]  # right, down and forward axis of the camera, as rows
    corner: Float[Tensor, "2"]  # first node of the raster, at depth 1
    cell: float  # spacing of the nodes, at depth 1
    outside: Float[Tensor, "h w"]  # signed distance to the outline at depth 1, positive outside
    depth: Float[
        Tensor, "h w"
    ]  # at each node, the depth [m] of the visible pixel nearest to the node
    rim: Float[Tensor, "k 3"]  # points of the outline [m] at the visible depth
    rim_normals: Float[Tensor, "k 3"]  # at the rim points, perpendicular to the camera rays
    # whether the object reaches the border of the image; points beyond do not count as outside
    cut: bool
    # width [m] of the widest area within the outline without measurements, perhaps a hole, or 0
    gap: float

    @checked(gradients=True)
    def hull_distance(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the signed distance [m] of points to the visual hull, positive outside."""
        outside, _, depth = self._look_up(points)
        return outside * depth

    @checked(gradients=True)
    def violation(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return how far [m] points are outside the outline or in front of the visible surface; 0
        if hidden.
        """
        outside, visible, depth = self._look_up(points)
        in_front = (visible - depth - FRONT_MARGIN).clamp_min(0)
        return torch.where(outside > 0, outside * depth, in_front)

    @checked
    def moved(self, b_from_a: Pose) -> "Silhouette":
        """Return the silhouette transformed from frame a to frame b."""
        viewpoint = apply(b_from_a, self.viewpoint[None])[0]
        rim = apply(b_from_a, self.rim)
        axes = rotate(b_from_a, self.axes)
        rim_normals = rotate(b_from_a, self.rim_normals)
        return dataclasses.replace(
            self, viewpoint=viewpoint, axes=axes, rim=rim, rim_normals=rim_normals
        )

    def _look_up(self, points: Float[Tensor, "*b 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return each point's distance to the outline at depth 1, the depth [m] seen there, and its
        own depth [m].
        """
        local = (points - self.viewpoint) @ self.axes.T
        depth = local[..., 2].clamp_min(1e-9)  # behind the camera is far outside
        position = (local[..., :2] / depth[..., None] - self.corner) / self.cell
        limit = (
            torch.tensor(self.outside.shape, dtype=position.dtype, device=position.device).flip(0)
            - 1
        )
        clamped = torch.minimum(position.clamp_min(0), limit)
        column, row = torch.round(clamped).long().unbind(-1)
        beyond = torch.linalg.vector_norm(position - clamped, dim=-1) * self.cell
        return self.outside[row, column] + beyond, self.depth[row, column], depth


@dataclasses.dataclass(frozen=True)
class Outlines(Value):
    """The silhouettes of all views of one object; the object lies within the outline of every view."""

    views: tuple[Silhouette, ...]

    @property
    def rim(self) -> Float[Tensor, "k 3"]:
        """Points [m] on the outlines of all views, at the depth of nearby pixels."""
        return torch.cat([view.rim for view in self.views])

    @property
    def rim_normals(self) -> Float[Tensor, "k 3"]:
        """Surface normals at the points of `rim`."""
        return torch.cat([view.rim_normals for view in self.views])

    @property
    def cut(self) -> bool:
        """Whether the border of an image cuts the object off in every view."""
        return all(view.cut for view in self.views)

    @property
    def gap(self) -> float:
        """The greatest width [m] of any area without measurements within the object's outline."""
        return max(view.gap for view in self.views)

    @checked
    def moved(self, b_from_a: Pose) -> "Outlines":
        """Return the outlines transformed from frame a to frame b."""
        return Outlines(tuple(view.moved(b_from_a) for view in self.views))

    @checked(gradients=True)
    def hull_distance(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the signed distance [m] of points to the visual hull of all views, positive
        outside.
        """
        return torch.stack([view.hull_distance(points) for view in self.views]).amax(0)

    @checked(gradients=True)
    def violation(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the worst violation [m] of any view: how far points lie outside the outline or
        before the surface.
        """
        return torch.stack([view.violation(points) for view in self.views]).amax(0)

    def hides(self, points: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
        """Return a mask of the points that may be on the hidden side: no view excludes them, within
        a tolerance.
        """
        return (self.hull_distance(points) < 0.001) & (self.violation(points) < FRONT_MARGIN)


@checked
def silhouettes(cloud: PointCloud) -> Outlines:
    """Return the silhouette of every view of a cloud; refuse a view without camera, or of both
    sides of the object.
    """
    views = cloud.split_views()
    for view in views:
        if view.viewpoint is None:
            raise BadArgument("cloud", "no viewpoint", "a cloud with viewpoints")
        _check_view(view.points, view.viewpoint)
    return Outlines(tuple(silhouette(view) for view in views))


def silhouette(view: PointCloud) -> Silhouette:
    """Return the silhouette of one view, whose points must all lie in front of the camera.

    A gap within the outline is a hole if it is far wider than the surface around it, as in a frame
    of bars. Other gaps do not count as free space, because a mirror-like patch is not measured
    either.
    """
    assert view.viewpoint is not None
    axes, pixels, depths = (t.numpy() for t in _project(view.points, view.viewpoint))
    distance, _ = spatial.KDTree(pixels).query(pixels, k=min(5, len(pixels)))
    spacing = float(np.median(distance[:, -1]))
    low = pixels.min(0)
    high = pixels.max(0)
    extent = float((high - low).max())
    cell = max(spacing / 4.0, extent / 320)
    margin = int(np.ceil(GROW * spacing / cell)) + int(0.25 * extent / cell) + 2
    shape = tuple(np.ceil((high - low) / cell).astype(int)[::-1] + 2 * margin + 1)
    corner = low - margin * cell
    column, row = np.round((pixels - corner) / cell).astype(int).T
    order = np.argsort(
        -depths
    )  # of pixels that share a cell the nearest to the camera is written last
    raster = np.zeros(shape)
    raster[row[order], column[order]] = depths[order]
    nearest = np.asarray(
        ndimage.distance_transform_edt(raster == 0, return_distances=False, return_indices=True)
    )
    measured = _distance(raster == 0) * cell <= GROW * spacing
    grown = np.asarray(ndimage.binary_fill_holes(measured))
    gaps = grown & ~measured
    gap = 2 * (float(_distance(gaps).max()) * cell + GROW * spacing) * bool(gaps.any())
    grown &= ~_find_holes(gaps, measured, GROW * spacing / cell)
    inside = _distance(grown) * cell > SHRINK * spacing
    unseen = _beyond_image(view.frustum, axes, corner, cell, grown, GROW * spacing)
    inside |= unseen
    outside = (_distance(~inside) - _distance(inside)) * cell
    outside += np.where(inside, 0.5, -0.5) * cell  # the outline runs between two cells
    seen = ~unseen if not unseen.any() else _distance(~unseen) * cell > GROW * spacing
    rim, rim_normals = _rim(outside, seen, corner, cell, pixels, depths)
    depth = np.where(unseen, 0.0, raster[tuple(nearest)])  # nothing is in front of what is not seen
    images = (torch.from_numpy(outside), torch.from_numpy(depth))
    gap = gap * float(np.median(depths))
    origin = view.viewpoint.double().cpu()
    axes = torch.from_numpy(axes)
    edge = torch.from_numpy(rim) @ axes + origin, torch.from_numpy(rim_normals) @ axes
    return Silhouette(
        origin, axes, torch.from_numpy(corner), cell, *images, *edge, bool(unseen.any()), gap
    )


def _find_holes(gaps: np.ndarray, measured: np.ndarray, grown: float) -> np.ndarray:
    """Return the cells of gaps that are over twice as wide as all surface around them.

    The surface is the mask `measured`, which was grown by so many cells.
    """
    number, count = ndimage.label(gaps)  # pyright: ignore[reportGeneralTypeIssues]
    wide = _distance(measured)
    holes = np.zeros_like(gaps)
    for k, radius in enumerate(
        ndimage.maximum(_distance(gaps), number, range(1, count + 1)) + grown, start=1
    ):
        if radius > 2 * grown:  # a narrower gap lies between sparse points
            around = measured & (_distance(number != k) < 2 * radius)
            holes |= (number == k) & (2 * (wide[around].max() - grown) < radius)
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
    rays = np.stack([corner[0] + cell * column, corner[1] + cell * row, np.ones(mask.shape)], -1)
    for side in frustum.double().cpu().numpy() @ axes.T:
        past = rays @ side < margin * np.linalg.norm(side[:2])
        if (past & mask).sum() * cell**2 > margin**2:  # more than a stray pixel
            beyond |= past
    return beyond


def _check_view(points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"]) -> None:
    """Raise `BadArgument` for points that no camera at the viewpoint can see at once."""
    forward = (points.amax(0) + points.amin(0)) / 2 - viewpoint
    behind = int(((points - viewpoint) @ forward <= 0).sum())
    if behind:
        found = f"{viewpoint.tolist()} m, with {behind} of {len(points)} points beside or behind it"
        raise BadArgument(
            "viewpoint", found, "the position of a camera that has the whole cloud in front of it"
        )
    _, pixels, depth = _project(points, viewpoint)
    apart, index = spatial.KDTree(pixels.numpy()).query(pixels.numpy(), k=min(6, len(pixels)))
    deeper = (
        depth[:, None] - depth[torch.from_numpy(index)] - torch.from_numpy(apart) * depth[:, None]
    )
    points = points.double().cpu()
    radius = torch.linalg.vector_norm(points - (points.amax(0) + points.amin(0)) / 2, dim=-1).max()
    share = float((deeper.amax(1) > 0.3 * radius).double().mean())
    if share > MAX_BEHIND:
        found = f"{share:.0%} of the points behind others, which no camera sees at once"
        raise BadArgument(
            "cloud", found, "a single view, the viewpoint of each point, or outward normals"
        )


def _project(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "n 2"], Float[Tensor, "n"]]:
    """Return the axes of a camera that faces the points, and the points' image positions at depth 1
    and depths [m].
    """
    points = points.double().cpu()
    viewpoint = viewpoint.double().cpu()
    forward = unit((points.amax(0) + points.amin(0)) / 2 - viewpoint)
    axes = torch.stack([*across(forward), forward])  # right, down, forward
    local = (points - viewpoint) @ axes.T
    return axes, local[:, :2] / local[:, 2:], local[:, 2]


def _distance(mask: np.ndarray) -> np.ndarray:
    """Return the distance [cells] of each cell to the nearest cell outside the mask."""
    return np.asarray(ndimage.distance_transform_edt(mask))


def _rim(
    outside: np.ndarray,
    seen: np.ndarray,
    corner: np.ndarray,
    cell: float,
    pixels: np.ndarray,
    depths: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return 16 evenly spread points of the outline at the depth of nearby pixels, and their
    surface normals.
    """
    row, column = np.nonzero(seen & (np.abs(outside) <= 0.75 * cell))
    smooth = ndimage.gaussian_filter(outside, 3.0)
    slope = np.stack([np.gradient(smooth, axis=axis)[row, column] for axis in (1, 0)], -1)
    slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)
    position = corner + cell * np.stack([column, row], -1)
    if len(position) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    picks = farthest_points(torch.from_numpy(position), 16, tie=TIE).numpy()
    position = position[picks]
    slope = slope[picks]
    _, index = spatial.KDTree(pixels).query(position, k=min(4, len(pixels)))
    depth = np.median(depths[index].reshape(len(position), -1), axis=-1)
    ray = np.concatenate([position, np.ones((len(position), 1))], -1)
    # The cone's normal is perpendicular to the ray and to the outline's tangent, and leans with the
    # slope.
    across = np.concatenate([slope, -(slope * position).sum(-1, keepdims=True)], -1)
    return ray * depth[:, None], across / np.linalg.norm(across, axis=-1, keepdims=True)
