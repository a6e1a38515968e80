"""Signed distance fields on grids, for collision checks."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, kept
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.linalg import norm, number_rows
from torchgrasp.geometry.mesh import closest_on_triangles

FIELD_SPACING = 0.004  # spacing [m] of nodes with an error below that of an estimated surface
# A cubic in the middle of four equidistant values has this times the weights -1, 9, 9, -1.
SIXTEENTH = 1 / 16


@dataclasses.dataclass(frozen=True)
class FieldNumbers:
    """Parameters of the computation of a signed distance field from a mesh."""

    band: float = 0.026
    """Distance [m] within which every second node is exact: the reach of a palm's spheres."""
    near: float = 3.0
    """Distance outside the surface, in spacings, within which every node is exact."""
    inward: float = 5.0
    """Distance inside the surface, in spacings, within which every node is exact."""
    most_nodes: float = 2e7
    """Most nodes of a grid: 160 MB."""
    least_area: float = 1e-14
    """Least area [m2] of a triangle that counts."""
    sample: float = 0.002
    """Side [m] of the square for which the surface has one sample on average."""
    least_samples: int = 2000
    """Least samples of a surface."""
    most_samples: int = 40_000
    """Most samples of a surface, which bounds the time."""
    few: int = 8
    """For nodes beyond the band, one in this number of samples is used."""
    tried: int = 3
    """Number of triangles that are tried for a point within the band."""
    leaf: int = 32
    """Samples in a leaf of the search tree."""
    at_once: int = 8192
    """Points whose distances are sought at once, which bounds memory."""
    digits: int = 9
    """Decimals [m] in which the corners of neighbouring triangles agree."""


FIELDS = FieldNumbers()


class Grid(NamedTuple):
    """The grid in which points are looked up.

    There is one for all points, or one for each entry of a batch.
    """

    origin: Float[Tensor, "*b 3"]  # position [m] of node (0, 0, 0)
    spacing: float | Float[Tensor, "*b 1"]  # distance [m] of neighbouring nodes
    last: Int[Tensor, "*b 3"]  # index of the last node on each axis
    stride: Any  # two numbers of values, between neighbours on the x and on the y axis
    first: Any  # index of the grid's first value in `DistanceField.nodes`
    # index steps in `DistanceField.nodes` from the first corner of a cell to its 8 corners
    corners: Int[Tensor, "8 *b"]


class DistanceField(Value, abc.ABC):
    """Signed distances [m] at the `nodes` of a grid, negative inside.

    It holds the grid of one object for all points, or an own grid for each of r entries.
    """

    nodes: Any  # Float[Tensor, "n"] [m], the values of all nodes, those of the z axis contiguous
    spacing: Any  # distance [m] of neighbouring nodes: a number, or (r,) for each entry

    @abc.abstractmethod
    def rows(self, index: Int[Tensor, "k"]) -> "DistanceField":
        """Return the field of the k entries with the indices `index` (k,), in this order.

        The field of one object is the same for every entry, and is returned unchanged.
        """

    @checked
    def nearest_node(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the signed distance (*b,) [m] at the grid node nearest to each point (*b, 3) [m].

        For a point outside the grid this is a node at the border of the grid. b stands for any
        batch axes. `query` is slower, and interpolates.
        """
        grid = self._grid(points)
        spacing = grid.spacing[..., 0] if isinstance(grid.spacing, Tensor) else grid.spacing
        # operations on many points are faster where x, y and z are apart
        node = points.movedim(-1, 0).contiguous() - grid.origin.movedim(-1, 0)
        node = node.div_(spacing).round_().clamp_min_(0)
        x, y, z = torch.minimum(node, grid.last.movedim(-1, 0).to(points)).int()
        dx, dy = grid.stride
        flat = x * dx + y * dy + z + grid.first
        return self.nodes.index_select(0, flat.flatten()).view(flat.shape).to(points)

    @abc.abstractmethod
    def _grid(self, points: Float[Tensor, "*b 3"]) -> Grid:
        """Return the grid in which the points are looked up."""

    @checked(gradients=True)
    def query(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Return (distance, gradient) at points (*b, 3) [m], interpolated between the nodes.

        `distance` (*b,) is the signed distance [m], and `gradient` (*b, 3) its derivative by the
        point (no unit). b stands for any batch axes. Outside the grid, the distance [m] from the
        grid is added to the value at the border.
        """
        origin, spacing, last, (dx, dy), first, corners = self._grid(points)
        position = (points - origin) / spacing
        inside = torch.minimum(position.clamp_min(0), last.to(points))
        cell = torch.minimum(inside.detach().long(), last - 1)
        fx, fy, fz = (inside - cell).unbind(-1)
        flat = cell[..., 0] * dx + cell[..., 1] * dy + cell[..., 2] + first
        # (2, 2, 2, *b): the corners on x, y and z
        corner = self.nodes[flat + corners].to(points).unflatten(0, (2, 2, 2))
        low, high = corner.unbind(2)
        left, right = torch.lerp(low, high, fz).unbind(1)
        back, front = torch.lerp(left, right, fy).unbind(0)
        slope_x = front - back
        across_back, across_front = (right - left).unbind(0)
        slope_y = torch.lerp(across_back, across_front, fx)
        slope_left, slope_right = (high - low).unbind(1)
        up_back, up_front = torch.lerp(slope_left, slope_right, fy).unbind(0)
        slope_z = torch.lerp(up_back, up_front, fx)
        slope = torch.stack([slope_x, slope_y, slope_z], -1) / spacing
        beyond = (position - inside) * spacing
        # The norm of a zero vector has no second derivative.
        outside = (beyond != 0).any(-1, keepdim=True)
        length = norm(torch.where(outside, beyond, 1.0), keepdim=True)
        away = torch.where(outside, length, 0.0)[..., 0]
        gradient = torch.where(beyond != 0, 0.0, slope) + beyond / length
        return torch.lerp(back, front, fx) + away, gradient


@checked
@dataclasses.dataclass(frozen=True)
class SignedDistanceField(DistanceField):
    """Signed distances [m] of one object at the nodes of a regular grid, negative inside the
    object.

    `surface_field` makes it of an estimated shape. The grid is along the axes of the object's
    frame. `query` returns distance and gradient at any points, interpolated between the nodes.

    Args:
        origin: position (3,) [m] of node (0, 0, 0).
        spacing: distance [m] of neighbouring nodes.
        values: signed distances (x, y, z) [m]; `values[i, j, k]` is at the point `origin` + (i, j,
            k) * `spacing`.

    >>> nodes = torch.cartesian_prod(*[torch.linspace(-0.1, 0.1, 41)] * 3)
    >>> ball = nodes.norm(dim=1).reshape(41, 41, 41) - 0.05
    >>> field = SignedDistanceField(torch.full((3,), -0.1), 0.005, ball)
    >>> distance, gradient = field.query(torch.tensor([0, 0, 0.08]))
    >>> f"{distance:.3f}", gradient.round()
    ('0.030', tensor([0., 0., 1.]))
    """

    origin: Float[Tensor, "3"]
    spacing: float
    values: Float[Tensor, "x y z"]

    @property
    def nodes(self) -> Float[Tensor, "n"]:
        """The signed distances (n,) [m] at all n nodes: `values`, flattened. Neighbours along z are
        adjacent.
        """
        return self.values.reshape(-1)

    @checked
    def rows(self, index: Int[Tensor, "k"]) -> "SignedDistanceField":
        """Return this field unchanged, whatever the `index` (k,).

        Other distance fields hold one object for each entry of a batch, and return some of them.
        """
        return self

    @kept
    def _cells(self) -> tuple[Int[Tensor, "3"], Int[Tensor, "8"]]:
        """The last node along each axis, and the steps from the first corner of a cell to all
        corners in `values`.
        """
        shape = torch.tensor(self.values.shape, device=self.values.device)
        return shape - 1, corner_steps(shape[1] * shape[2], shape[2])

    def _grid(self, points: Float[Tensor, "*b 3"]) -> Grid:
        last, corners = self._cells
        _, ny, nz = self.values.shape
        ones = [1] * (points.ndim - 1)
        origin = self.origin.to(points).view(*ones, 3)
        last = last.view(*ones, 3)
        corners = corners.view(-1, *ones)
        return Grid(origin, self.spacing, last, (ny * nz, nz), 0, corners)


def corner_steps(dx: Int[Tensor, "*b"], dy: Int[Tensor, "*b"]) -> Int[Tensor, "8 *b"]:
    """Return the index steps from the first corner of a grid cell to its eight corners.

    `dx` and `dy` are the strides: the numbers of values between neighbours on the x and on the y
    axis. The stride on the z axis is 1.
    """
    corner = torch.arange(8, device=dx.device).view(-1, *[1] * dx.ndim)
    return corner // 4 * dx + corner // 2 % 2 * dy + corner % 2


@checked
def field_from_surface(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    spacing: Annotated[float, Range(0.0001, 0.1)] = 0.003,
    margin: Annotated[float, Range(0.0, 1.0)] = 0.08,
) -> SignedDistanceField:
    """Return the signed distance field of a triangle mesh with outward faces, which may be open.

    `vertices` (v, 3) are in metres; `faces` (f, 3) holds the indices of three vertices each. The
    nodes are `spacing` [m] apart and reach to `margin` [m] around the mesh. Raises `BadArgument`
    for more than `FIELDS.most_nodes` nodes.
    """
    check_tensor("vertices", vertices, (None, 3))
    surface = _Surface(vertices, faces)
    low = vertices.amin(0).double() - margin
    high = vertices.amax(0).double() + margin
    # the first nodes are every fourth of the finest
    counts = [4 * max(1, int(c)) + 1 for c in torch.ceil((high - low) / (4 * spacing)).tolist()]
    if np.prod(np.array(counts, dtype=float)) > FIELDS.most_nodes:
        raise BadArgument("spacing", spacing, f"a coarser grid than {counts} nodes")
    origin = low.cpu().numpy()
    lines = [origin[k] + spacing * np.arange(counts[k]) for k in range(3)]
    nodes = np.stack(np.meshgrid(*(line[::4] for line in lines), indexing="ij"), -1)
    values = surface.distance(nodes.reshape(-1, 3), far=True).reshape(nodes.shape[:3])
    known = np.zeros(values.shape, dtype=bool)
    finest = (1, FIELDS.inward * spacing, FIELDS.near * spacing)
    for step, inward, outward in ((2, np.inf, FIELDS.band), finest):
        before = known
        values = _refine(values)
        known = np.zeros(values.shape, dtype=bool)
        known[::2, ::2, ::2] = before
        near = np.nonzero((-inward < values) & (values < outward) & ~known)
        nodes = np.stack([lines[k][::step][near[k]] for k in range(3)], -1)
        values[near] = surface.distance(nodes)
        known[near] = True
    to = {"device": vertices.device, "dtype": torch.float64}
    return SignedDistanceField(low.to(**to), float(spacing), torch.tensor(values, **to))


def surface_distance(vertices: Tensor, faces: Tensor) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that maps points (n, 3) [m] to their signed distances (n,) [m] from a mesh.

    The mesh has outward faces: `vertices` (v, 3) [m], and `faces` (f, 3), the indices of three
    vertices each.
    """
    return _Surface(vertices, faces).distance


def _refine(values: np.ndarray) -> np.ndarray:
    """Return signed distances on a grid twice as fine; new nodes have cubic distances and the
    previous node's sign.
    """
    # Far from an open mesh the sign jumps, where a cubic of signed distances would be wrong.
    sign = values < 0
    distance = np.abs(values)
    for axis in range(3):
        sign = _upsample(sign, axis)
        distance = _upsample(distance, axis)
    return np.where(sign, -distance, distance)


def _upsample(values: np.ndarray, axis: int) -> np.ndarray:
    """Return values with a new one between any two neighbours on an axis: cubic, or for signs the
    previous value.
    """
    known = np.moveaxis(values, axis, 0)
    fine = np.empty((2 * len(known) - 1, *known.shape[1:]), dtype=known.dtype)
    fine[::2] = known
    if known.dtype == bool:
        fine[1::2] = known[:-1]
    else:
        before = 2 * known[:1] - known[1:2]
        after = 2 * known[-1:] - known[-2:-1]
        padded = np.concatenate([before, known, after])
        inner = 9 * (known[:-1] + known[1:])
        fine[1::2] = (inner - padded[:-3] - padded[3:]) * SIXTEENTH
    # queries would copy another layout each time
    return np.ascontiguousarray(np.moveaxis(fine, 0, axis))


class _Surface:
    """The triangles of a mesh [m], with a search tree over samples of the surface, to find
    distances to it.
    """

    def __init__(self, vertices: Tensor, faces: Tensor):
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.is_floating_point():
            found = f"{faces.dtype} of shape {tuple(faces.shape)}"
            raise BadArgument("faces", found, "integers (f, 3) with f >= 1")
        if faces.min() < 0 or faces.max() >= len(vertices):
            found = f"faces {int(faces.min())}..{int(faces.max())}"
            raise BadArgument("faces", found, f"0..{len(vertices) - 1}")
        corners = vertices.detach().cpu().double().numpy()[faces.cpu().numpy()]  # (f, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_area = np.linalg.norm(normals, axis=1)
        kept = double_area / 2 > FIELDS.least_area
        if not kept.any():
            raise BadArgument("faces", "faces without area", "a surface")
        corners = corners[kept]
        area = double_area[kept] / 2
        self.triangles = corners
        self.normals = _pseudonormals(corners, normals[kept] / double_area[kept, None])
        rng = np.random.default_rng(0)
        wanted = area.sum() / FIELDS.sample**2
        count = int(np.clip(wanted, FIELDS.least_samples, FIELDS.most_samples))
        owner = np.repeat(np.arange(len(area)), rng.multinomial(count, area / area.sum()))
        u, v = np.sort(rng.random((2, len(owner))), axis=0)
        weights = np.stack([u, v - u, 1 - v], 1)
        samples = (corners[owner] * weights[:, :, None]).sum(1)
        samples = np.concatenate([corners.mean(1), samples])
        self.owner = np.concatenate([np.arange(len(area)), owner])
        self.tree = spatial.KDTree(samples, leafsize=FIELDS.leaf)
        self.few = spatial.KDTree(samples[:: FIELDS.few], leafsize=FIELDS.leaf)

    def distance(self, points: np.ndarray, far: bool = False) -> np.ndarray:
        """Return the signed distances [m] of points (n, 3); `far` uses fewer samples, for distant
        points.
        """
        parts = []
        tree = self.few if far else self.tree
        owners = self.owner[:: FIELDS.few] if far else self.owner
        tried = 1 if far else min(FIELDS.tried, len(owners))
        for begin in range(0, max(1, len(points)), FIELDS.at_once):
            part = points[begin : begin + FIELDS.at_once]
            _, index = tree.query(part, k=tried)
            owner = owners[index.reshape(len(part), tried)]  # (p, t)
            triangles = self.triangles[owner.reshape(-1)]
            feet, feature = closest_on_triangles(np.repeat(part, tried, 0), triangles)
            gap = part[:, None] - feet.reshape(*owner.shape, 3)  # (p, t, 3)
            squared = (gap * gap).sum(-1)
            rows = np.arange(len(part))
            best = squared.argmin(1)
            normal = self.normals[owner[rows, best], feature.reshape(owner.shape)[rows, best]]
            sign = (gap[rows, best] * normal).sum(1)
            parts.append(np.copysign(np.sqrt(squared[rows, best]), sign))
        return np.concatenate(parts)


def _pseudonormals(corners: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Return pseudonormals (Baerentzen and Aanaes, 2005) of each triangle's face, 3 sides and 3
    corners, (f, 7, 3), given the unit normals of the faces (f, 3).
    """
    # corners at the same place, to some digits, are one vertex
    places = np.round(corners.reshape(-1, 3) * 10.0**FIELDS.digits)
    ids = number_rows(torch.from_numpy(places)).numpy().reshape(-1, 3)
    ahead = np.roll(corners, -1, 1) - corners
    back = np.roll(corners, 1, 1) - corners
    lengths = np.linalg.norm(ahead, axis=-1) * np.linalg.norm(back, axis=-1)
    cosine = (ahead * back).sum(-1) / lengths
    weighted = face[:, None] * np.arccos(np.clip(cosine, -1, 1))[..., None]
    at_corner = _sum_by(ids.reshape(-1), weighted.reshape(-1, 3))
    ends = np.sort(np.stack([ids, np.roll(ids, -1, 1)], -1), -1)  # (f, 3, 2)
    number = ends[..., 0] * (ids.max() + 1) + ends[..., 1]
    side = np.unique(number, return_inverse=True)[1].reshape(-1, 3)
    at_side = _sum_by(side.reshape(-1), np.repeat(face, 3, 0))
    return np.concatenate([face[:, None], at_side[side], at_corner[ids]], 1)


def _sum_by(number: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return one row per number: the sum of the vectors (n, 3) that have this number."""
    return np.stack([np.bincount(number, weights=column) for column in vectors.T], 1)
