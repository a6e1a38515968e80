"""The estimated surface, Eq. (9) of the paper, as a mesh or a distance field.

It is the zero level of the mean distance.
"""

import dataclasses
import itertools
import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, map_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, SuspiciousScale
from torchgrasp.foundation.lazy import ndimage, spatial, trimesh
from torchgrasp.foundation.rules import Range
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.linalg import Points, limit_norm, norm, number_components, unit
from torchgrasp.geometry.mesh import clip_mesh
from torchgrasp.geometry.signed_distance import (
    FIELD_SPACING,
    FIELDS,
    SignedDistanceField,
    field_from_surface,
)
from torchgrasp.shape.estimate import surface_deviation
from torchgrasp.shape.gp import ShapeGP


@dataclasses.dataclass(frozen=True)
class SurfaceNumbers:
    """Parameters of the extraction of a shape's surface as a mesh."""

    resolution: int = 48
    """Number of cells of the grid along the diameter of the shape's domain."""
    coarse: int = 4
    """Number of cells along a side of the first blocks of the grid."""
    steeper: float = 1.3
    """Greatest assumed ratio of the mean's slope within a block to the slope between its corners.
    Blocks that the zero level cannot reach are not refined.
    """
    rounding: float = 1e-12
    """Share of the domain's radius by which nodes may be outside the domain."""
    steps: int = 3
    """Greatest number of Newton steps that move a vertex onto the surface."""
    least_slope: float = 1e-12
    """Least divisor in a Newton step, which divides by the squared length of the mean's gradient
    (no unit). Smaller ones are raised to it.
    """
    settled: float = 1e-4
    """Normalised motion below which a vertex is on the surface."""
    share: float = 0.02
    """Least share of the cloud's points to which a piece of the zero level must be nearest. Other
    pieces are left out; the one with the largest share always stays.
    """


SURFACE = SurfaceNumbers()


@dataclasses.dataclass(frozen=True)
class NodeNumbers:
    """Lengths that set the grid of the distance field for collision checks."""

    thick: float = 0.04
    """Least side [m] of a thick body, which is not hollow."""
    wide: float = 0.004
    """Spacing [m] of the nodes for thick bodies."""
    close: float = 0.003
    """Spacing [m] of the nodes for other bodies."""


NODES = NodeNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class Surface(Value):
    """A triangle mesh of the estimated surface, from `extract_surface`.

    It has v vertices and f triangles, in the cloud's frame. It is open where the surface leaves the
    shape's domain, the ball in which the shape is known.

    Attributes:
        vertices: corners (v, 3) [m] of the triangles.
        faces: indices (f, 3) of the three vertices of each triangle; the triangles' normals point
            outward.
        normals: outward unit normals (v, 3) of the estimated surface at the vertices.
        std_m: standard deviation (v,) [m] of the surface along its normal at the vertices.

    >>> from torchgrasp import fit_shape, load_object
    >>> surface = extract_surface(fit_shape(load_object("jug").view), resolution=24)
    >>> surface.mesh().is_watertight, float(surface.std_m.min()) > 0
    (True, True)
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    normals: Float[Tensor, "v 3"]
    std_m: Float[Tensor, "v"]

    def mesh(self) -> "trimesh.Trimesh":
        """Return the surface as a `trimesh.Trimesh` with the same vertices [m] and faces."""
        return trimesh.Trimesh(self.vertices.cpu().numpy(), self.faces.cpu().numpy(), process=False)


@checked
@single_threaded
def extract_surface(
    shape: ShapeGP,
    resolution: Annotated[int, Range(8, 256)] = SURFACE.resolution,
) -> Surface:
    """Return the estimated surface as a triangle mesh, Eq. (9) of the paper.

    It is where the mean signed distance is zero. Marching cubes find it, and Newton steps refine
    its vertices. A separate piece is left out if it is nearest to less than 2 % of the cloud's
    points (`SURFACE.share`). A `HollowShape` gives the vertices of both its surfaces.

    Args:
        shape: the shape, from `fit_shape`.
        resolution: number of cells along the diameter of the shape's domain, 8 to 256. The domain
            is the ball in which the shape is known.

    Raises `BadArgument` for another resolution, or if the mean signed distance is nowhere zero.

    >>> from torchgrasp import fit_shape, load_object
    >>> surface = extract_surface(fit_shape(load_object("jug").view, table=0.0), resolution=24)
    >>> len(surface.faces) > 500, f"{surface.vertices[:, 2].max():.2f} m"
    (True, '0.17 m')
    """
    walls = list[Surface]()
    for wall, (x, faces) in zip(shape.walls, _trace_walls(shape, resolution), strict=True):
        _, gradient = wall.mean_and_gradient(x)
        deviation = surface_deviation(wall.variance(x), gradient)
        std_m = shape.std_factor * shape.scale * deviation
        walls.append(Surface(shape.metres(x), faces, unit(gradient), std_m))
    return map_tensors(lambda *parts: torch.cat(parts), *walls)


@dataclasses.dataclass(frozen=True)
class Mesh(Value):
    """A triangle mesh of the estimated surface, without normals and deviations."""

    vertices: Float[Tensor, "v 3"]  # corners (v, 3) [m] of the triangles, in the frame of the cloud
    # indices (f, 3) of the vertices of each triangle; the normals point outward
    faces: Int[Tensor, "f 3"]


def extract_mesh(shape: ShapeGP) -> Mesh:
    """Return the estimated surface as a mesh [m], with 48 cells along the domain's diameter.

    The number of cells is `SURFACE.resolution`. The domain is the ball in which the shape is known.
    Raises `BadArgument` if the mean signed distance is nowhere zero.
    """
    x, faces = zip(*_trace_walls(shape, SURFACE.resolution), strict=True)
    return Mesh(shape.metres(torch.cat(x)), torch.cat(faces))


def collision_field(shape: ShapeGP, mesh: Mesh) -> SignedDistanceField:
    """Return the signed distance field of the mesh of a shape, for collision checks.

    `mesh` is the result of `extract_mesh`, and the field is in its frame, that of the cloud. The
    nodes are 4 mm apart for thick bodies, and 3 mm for others (`NODES`). A thick body is not
    hollow, and extends more than 40 mm along each axis. Raises `SuspiciousScale` for an object that
    is much larger than a hand, as its grid would exceed 20 million nodes.
    """
    size = mesh.vertices.amax(0) - mesh.vertices.amin(0)
    thick = float(size.min()) > NODES.thick and len(shape.walls) == 1
    spacing = NODES.wide if thick else NODES.close
    try:
        return field_from_surface(mesh.vertices, mesh.faces, spacing)
    except BadArgument as error:
        # the grid of an object that is much larger than a hand would not fit into memory
        found = f"a surface of {' x '.join(f'{x:.2g}' for x in size.tolist())} m"
        side = FIELDS.most_nodes ** (1 / 3) * spacing
        raise SuspiciousScale("cloud", found, f"an object of less than {side:.1g} m") from error


def _trace_walls(
    shape: ShapeGP,
    resolution: int,
) -> list[tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]]:
    """Return vertices (normalised) and faces of each wall; the indices in faces count the vertices
    of all walls.
    """
    walls = [_trace_wall(shape, i, resolution) for i in range(len(shape.walls))]
    before = [0, *itertools.accumulate(len(x) for x, _ in walls)]
    return [(x, faces + n) for (x, faces), n in zip(walls, before, strict=False)]


def _trace_wall(
    whole: ShapeGP,
    number: int,
    resolution: int,
) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
    """Return vertices (v, 3), normalised, and triangles (f, 3) of the surface
    `whole.walls[number]`.

    A hollow shape has two such surfaces, an outer and an inner one. Parts of one that lie outside
    the material between them are cut off. `resolution` is the number of cells along the domain's
    diameter. Raises `BadArgument` if the mean distance is nowhere zero.
    """
    from skimage.measure import marching_cubes

    shape = whole.walls[number]
    others = [wall for i, wall in enumerate(whole.walls) if i != number]
    radius = whole.domain_radius
    device = shape.x.device
    step = 2.0 * radius / resolution
    cells = SURFACE.coarse * math.ceil(resolution / SURFACE.coarse)
    volume = _grid(shape, radius, step, cells)
    if not (np.nanmin(volume) < 0.0 < np.nanmax(volume)):
        raise BadArgument(
            "shape", "a mean that is nowhere zero", "a shape with a surface inside its domain"
        )
    # Cells that touch the outside of the ball are left out by the mask. So no wall is built along
    # its boundary.
    corners, faces, _, _ = marching_cubes(
        np.nan_to_num(volume, nan=1.0),
        0.0,
        mask=~np.isnan(volume),
        spacing=(step,) * 3,
        gradient_direction="ascent",
    )
    kept = faces[_carry_cloud(corners - radius, faces, shape)]
    used, faces = np.unique(kept, return_inverse=True)
    x = torch.from_numpy(corners[used].astype(np.float64) - radius).to(device)
    faces = torch.from_numpy(faces.reshape(-1, 3).astype(np.int64)).to(device)
    normals = torch.zeros_like(x)
    rows = torch.arange(len(x), device=device)
    for _ in range(SURFACE.steps):
        value, gradient = shape.mean_and_gradient(x[rows])
        motion = newton_step(value, gradient, step, SURFACE.least_slope)
        x[rows] = x[rows] + motion
        normals[rows] = gradient
        rows = rows[norm(motion) > SURFACE.settled]
    if others:  # the cut turns triangles around, so they are wound after it
        value = torch.stack([wall.mean(x) for wall in others]).amax(0)
        parts = [part.cpu().numpy() for part in (x, faces, value)]
        vertices, triangles, _ = clip_mesh(*parts)
        x = torch.from_numpy(vertices).to(x)
        faces = torch.from_numpy(triangles).to(faces)
        normals = shape.mean_and_gradient(x)[1]
    a, b, c = x[faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    outward = (across * normals[faces].sum(1)).sum() > 0
    return x, faces if bool(outward) else faces.flip(1)


def _grid(
    shape: ShapeGP,
    radius: float,
    step: float,
    cells: int,
) -> np.ndarray:
    """Return the mean signed distance at the nodes of a cubic grid, which starts at -radius; NaN
    outside the ball.

    Every node of a block is evaluated if the surface may cross the block. Other nodes copy a node
    of a coarser grid.
    """
    line = -radius + step * torch.arange(cells + 1, dtype=torch.float64, device=shape.x.device)

    def mean(
        stride: int,
        nodes: tuple[np.ndarray, ...],
    ) -> np.ndarray:
        axes = [line[stride * torch.tensor(axis, device=line.device)] for axis in nodes]
        return shape.mean(torch.stack(axes, -1)).cpu().numpy()

    def finer(nodes: np.ndarray) -> np.ndarray:
        return nodes.repeat(2, 0).repeat(2, 1).repeat(2, 2)

    stride = SURFACE.coarse
    size = (cells // stride + 1,) * 3
    every = np.indices(size).reshape(3, -1)
    values = mean(stride, tuple(every)).reshape(size)
    climbs = [np.abs(np.diff(values, axis=axis)).max() for axis in range(3)]
    climb = float(max(climbs))
    steepest = SURFACE.steeper * climb / (stride * step)
    while stride > 1:
        # over the corners of each cell
        least = ndimage.minimum_filter(np.abs(values), 2, origin=-1)[:-1, :-1, :-1]
        # the surface reaches a cell from a corner within half its diagonal
        near = finer(least < steepest * (math.sqrt(3) / 2) * stride * step)
        stride //= 2
        values = finer(values)[:-1, :-1, :-1]
        # the corners of those cells
        wanted = np.nonzero(ndimage.maximum_filter(np.pad(near, ((0, 1),) * 3), 2))
        values[wanted] = mean(stride, wanted)
    squares = (line * line).cpu().numpy()
    distance = squares[:, None, None] + squares[:, None] + squares
    values[distance > (radius * (1.0 + SURFACE.rounding)) ** 2] = np.nan
    return values


def newton_step(
    value: Float[Tensor, "n"],
    gradient: Points,
    longest: float,
    least_slope: float = 0.0,
) -> Points:
    """Return Newton steps (n, 3) along the gradients to the zero level, each at most `longest`
    long.

    `value` (n,) is the mean signed distance at n points, and `gradient` (n, 3) its gradient.
    Distances, `longest` and steps are normalised. Squared lengths of gradients, by which is
    divided, are raised to at least `least_slope`.
    """
    step = -value / (gradient * gradient).sum(-1).clamp_min(least_slope)
    return limit_norm(step[:, None] * gradient, longest)


def _carry_cloud(
    corners: np.ndarray,
    faces: np.ndarray,
    shape: ShapeGP,
) -> np.ndarray:
    """Return a mask of the faces in connected pieces to which enough points of the cloud are
    nearest.
    """
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    label = number_components(edges, len(corners))
    cloud = shape.normalise(shape.cloud.points.to(shape.x)).cpu().numpy()
    _, nearest = spatial.KDTree(corners).query(cloud)
    share = np.bincount(label[nearest], minlength=label.max() + 1) / len(cloud)
    return (share >= min(SURFACE.share, share.max()))[label[faces[:, 0]]]


@checked
@single_threaded
def surface_field(
    shape: ShapeGP,
    spacing: Annotated[float, Range(0.001, 0.02)] = FIELD_SPACING,
) -> SignedDistanceField:
    """Return the signed distance field [m] of a shape's estimated surface, negative inside.

    `close_hand(surface=)` takes it, to locate the object by touch. Its nodes are in the cloud's
    frame, and reach to 0.08 m around the surface.

    Args:
        shape: the shape, from `fit_shape`.
        spacing: distance [m] between neighbouring nodes, 0.001 to 0.02.

    Raises `BadArgument` for a spacing out of range, or one that needs more than 2e7 nodes
    (`FIELDS.most_nodes`). It is also raised if the mean signed distance is nowhere zero.

    >>> from torchgrasp import fit_shape, load_object
    >>> jug = load_object("jug")
    >>> field = surface_field(fit_shape(jug.view, table=0.0), spacing=0.008)
    >>> field.query(torch.tensor(jug.mesh.center_mass))[0] < -0.02  # [m]: inside
    tensor(True)
    """
    mesh = extract_mesh(shape)
    return field_from_surface(mesh.vertices, mesh.faces, spacing)
