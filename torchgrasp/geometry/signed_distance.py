"""Signed distance fields on grids, for collision checks."""

import abc
import dataclasses
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, kept
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.fused import array, is_fused
from torchgrasp.foundation.rules import Positive, Range
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.mesh_distance import MeshSurface

FIELD_SPACING = 0.004  # spacing [m] of nodes with an error below that of an estimated surface
# A cubic in the middle of four equidistant values has this times the weights -1, 9, 9, -1.
SIXTEENTH = 1 / 16


@dataclasses.dataclass(frozen=True)
class FieldNumbers:
    """Parameters of the computation of a signed distance field from a mesh."""

    band: float = 0.026
    """Distance [m] from the surface within which every second node is exact: the reach of a palm's
    spheres.
    """
    near: float = 3.0
    """Distance outside the surface, in spacings of the grid, within which every node is exact."""
    inward: float = 5.0
    """Distance inside the surface, in spacings of the grid, within which every node is exact."""
    most_nodes: float = 2e7
    """Greatest number of nodes of a grid, which needs 160 MB."""


FIELDS = FieldNumbers()


class Grid(NamedTuple):
    """The grid of a `DistanceField` in which points are looked up.

    It is one grid for all points, or a grid for each entry of a batch. The axes `*b` broadcast with
    the axes (*b, 3) of the points.
    """

    origin: Float[Tensor, "*b 3"]  # position [m] of node (0, 0, 0)
    spacing: float | Float[Tensor, "*b 1"]  # distance [m] of neighbouring nodes
    last: Int[Tensor, "*b 3"]  # index of the last node on each axis
    stride: Any  # steps in `DistanceField.nodes` to the next node on x and on y; on z it is 1
    first: Any  # index of node (0, 0, 0) in `DistanceField.nodes`
    # steps in `DistanceField.nodes` from the first corner of a cell to its 8 corners
    corners: Int[Tensor, "8 *b"]


class DistanceField(Value, abc.ABC):
    """Base class of fields of signed distances [m], at the nodes of a grid, negative inside an
    object.

    Grid and points are in the frame of the object. A field holds the grid of one object for all
    points. Or it holds r grids, and in a batch of r entries each entry has its own.
    """

    # Float[Tensor, "n"]: distances [m] at all nodes of all grids, those along z adjacent
    nodes: Any
    spacing: Any  # distance [m] of neighbouring nodes: a number, or (r,) for each entry

    @abc.abstractmethod
    def rows(self, index: Int[Tensor, "k"]) -> "DistanceField":
        """Return the field of k entries of the batch only, those with the indices `index` (k,), in
        this order.

        The field of one object is the same for every entry, and is returned unchanged.
        """

    @checked
    def nearest_node(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the signed distance (*b,) [m] at the grid node nearest to each point (*b, 3) [m].

        For a point outside the grid this is a node at the border of the grid. Here b stands for any
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

        `distance` (*b,) is the signed distance [m], and `gradient` (*b, 3) its derivative with
        respect to the point (no unit). Here b stands for any batch axes. Outside the grid, the
        distance [m] from the grid is added to the value at the border.
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

    `surface_field` makes it from an estimated shape, and `field_from_surface` from a mesh. The grid
    is along the axes of the object's frame. `query` returns distance and gradient at any points,
    interpolated between the nodes.

    Args:
        origin: position (3,) [m] of node (0, 0, 0).
        spacing: distance [m] between neighbouring nodes.
        values: signed distances (x, y, z) [m]; `values[i, j, k]` is at the point `origin` + (i, j,
            k) * `spacing`. There are at least two along each axis.

    Raises `BadArgument` for a `spacing` that is not positive, or an axis with less than two nodes.

    >>> nodes = torch.cartesian_prod(*[torch.linspace(-0.1, 0.1, 41)] * 3)
    >>> ball = nodes.norm(dim=1).reshape(41, 41, 41) - 0.05
    >>> field = SignedDistanceField(torch.full((3,), -0.1), 0.005, ball)
    >>> distance, gradient = field.query(torch.tensor([0, 0, 0.08]))
    >>> f"{distance:.3f}", gradient.round()
    ('0.030', tensor([0., 0., 1.]))
    """

    origin: Float[Tensor, "3"]
    spacing: Positive
    values: Float[Tensor, "x y z"]

    def __post_init__(self) -> None:
        """Check that there are nodes between which `query` interpolates."""
        if min(self.values.shape) < 2:
            found = f"shape {tuple(self.values.shape)}"
            raise BadArgument("values", found, "at least two nodes along each axis")

    @property
    def nodes(self) -> Float[Tensor, "n"]:
        """The signed distances (n,) [m] at all n nodes: `values`, flattened. Neighbours along z are
        adjacent.
        """
        return self.values.reshape(-1)

    @checked
    def rows(self, index: Int[Tensor, "k"]) -> "SignedDistanceField":
        """Return this field unchanged, whatever the `index` (k,).

        It holds one object for the whole batch. Other distance fields hold one object for each
        entry, and return those of the entries `index`.
        """
        return self

    @checked(gradients=True)
    def query(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Return (distance, gradient) at points (*b, 3) [m], interpolated between the nodes.

        `distance` (*b,) is the signed distance [m], negative inside the object. `gradient` (*b, 3)
        is its derivative with respect to the point (no unit). b stands for any batch axes. Outside
        the grid, the distance [m] from the grid is added to the value at the border.
        """
        if not is_fused(points, self.values, self.origin):
            return super().query(points)
        from torchgrasp.geometry import fused_grid  # it imports numba

        nodes, origin = map(array, (self.nodes, self.origin))
        shape = np.array(self.values.shape)
        return fused_grid.query(fused_grid.LookedUp(nodes, origin, shape, self.spacing), points)

    @kept
    def _cells(self) -> tuple[Int[Tensor, "3"], Int[Tensor, "8"]]:
        """The last node along each axis. Also the steps from the first corner of a cell to all
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
    """Return the steps (8, *b) in a grid's flattened values from a cell's first corner to its eight
    corners.

    `dx` and `dy` (*b,) are the strides of the grids on x and y: the numbers of values between
    neighbours. The stride on the z axis is 1.
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
    nodes are `spacing` [m] apart and reach to `margin` [m] around the mesh. The field is in the
    frame of the mesh. Raises `BadArgument` for more than 20 million nodes (`FIELDS.most_nodes`), or
    for faces without area.
    """
    check_tensor("vertices", vertices, (None, 3))
    surface = MeshSurface(vertices, faces)
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
    return np.negative(distance, out=distance, where=sign)


def _upsample(values: np.ndarray, axis: int) -> np.ndarray:
    """Return values with a new one between any two neighbours on an axis: cubic, or for signs the
    previous value.
    """

    def at(*ends: int | None) -> tuple[slice, ...]:
        return (*[slice(None)] * axis, slice(*ends))

    shape = list(values.shape)
    shape[axis] = 2 * shape[axis] - 1
    fine = np.empty(shape, dtype=values.dtype)
    fine[at(None, None, 2)] = values
    if values.dtype == bool:
        fine[at(1, None, 2)] = values[at(None, -1)]
        return fine
    # a straight line beyond the ends
    before = 2 * values[at(0, 1)] - values[at(1, 2)]
    after = 2 * values[at(-1, None)] - values[at(-2, -1)]
    middle = 9 * (values[at(None, -1)] + values[at(1, None)])
    middle[at(0, 1)] -= before
    middle[at(1, None)] -= values[at(None, -2)]
    middle[at(None, -1)] -= values[at(2, None)]
    middle[at(-1, None)] -= after
    fine[at(1, None, 2)] = middle * SIXTEENTH
    return fine
