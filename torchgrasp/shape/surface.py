"""The zero level of the shape, Eq. (9): a triangle mesh of it, and Newton steps onto it."""

import dataclasses
import itertools
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value, map_tensors
from torchgrasp.border import Range, checked
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import limit_norm, unit
from torchgrasp.mesh import clip_mesh
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.posterior import surface_deviation

if TYPE_CHECKING:
    import trimesh

NEWTON_STEPS = 3
"""Newton steps from marching cubes onto the zero level: enough for 1e-6 of the scale."""
LEAST_SLOPE = 1e-12
"""Least squared gradient with which a Newton step is computed: a stationary vertex stays."""
LEAST_SHARE = 0.02
"""Share of the cloud nearest to a sheet of the zero level from which on the sheet is kept: an ear, a handle."""


@checked
@dataclasses.dataclass(frozen=True)
class Surface(Value):
    """A triangle mesh of the surface [m], wound outward, open at the edge of the domain.

    Normals are unit gradients of the mean; `std_m` [m] is the surface's standard deviation.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    normals: Float[Tensor, "v 3"]
    std_m: Float[Tensor, "v"]

    def mesh(self) -> "trimesh.Trimesh":
        """Return vertices and faces as a mesh."""
        import trimesh

        return trimesh.Trimesh(self.vertices.cpu().numpy(), self.faces.cpu().numpy(), process=False)


@checked
def extract_surface(shape: ShapeGP, resolution: Annotated[int, Range(8, 256)] = 48) -> Surface:
    """Return the zero level of the mean, Eq. (9), within the domain, by marching cubes and Newton steps.

    `resolution` counts cells along the domain's diameter. Sheets near less than 2 % of the cloud are left out.

    Raises:
        BadArgument: a resolution outside [8, 256], or a mean without zero level.
    """
    walls = [_extract_wall(shape, i, resolution) for i in range(len(shape.walls))]
    before = [0, *itertools.accumulate(len(wall.vertices) for wall in walls)]
    walls = [dataclasses.replace(w, faces=w.faces + n) for w, n in zip(walls, before, strict=False)]
    return map_tensors(lambda *parts: torch.cat(parts), *walls)


def _extract_wall(whole: ShapeGP, number: int, resolution: int) -> Surface:
    """Return one wall of a shape, cut off where it leaves the material."""
    from skimage.measure import marching_cubes

    shape, others = whole.walls[number], [wall for i, wall in enumerate(whole.walls) if i != number]
    radius, device = whole.domain_radius, shape.x.device
    axis = torch.linspace(-radius, radius, resolution + 1, dtype=torch.float64, device=device)
    grid = torch.cartesian_prod(axis, axis, axis)
    inside = torch.linalg.vector_norm(grid, dim=-1) <= radius
    distance = torch.full((len(grid),), torch.nan, dtype=torch.float64, device=device)
    distance[inside] = shape.mean(grid[inside])
    volume = distance.reshape([resolution + 1] * 3).cpu().numpy()
    if not (np.nanmin(volume) < 0.0 < np.nanmax(volume)):
        raise BadArgument("shape", "a mean that is nowhere zero", "a shape with a surface inside its domain")
    step = 2.0 * radius / resolution
    # Cells that touch the outside of the ball are left out by the mask, so no wall is built along its boundary.
    corners, faces, _, _ = marching_cubes(
        np.nan_to_num(volume, nan=1.0), 0.0, mask=~np.isnan(volume), spacing=(step,) * 3, gradient_direction="ascent"
    )
    used, faces = np.unique(faces[_carry_cloud(corners - radius, faces, shape)], return_inverse=True)
    x = torch.tensor(corners[used].astype(np.float64) - radius).to(device)
    faces = torch.tensor(faces.reshape(-1, 3).astype(np.int64)).to(device)
    for _ in range(NEWTON_STEPS):
        value, gradient = shape.mean_and_gradient(x)
        x = x + limit_norm(newton_step(value, gradient, gradient, LEAST_SLOPE)[:, None] * gradient, step)
    if others:
        value = torch.stack([wall.mean(x) for wall in others]).amax(0)
        vertices, triangles, _ = clip_mesh(x.cpu().numpy(), faces.cpu().numpy(), value.cpu().numpy())
        x, faces = torch.tensor(vertices).to(x), torch.tensor(triangles).to(faces)
    jet = shape.jet(x)
    a, b, c = x[faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    outward = (across * jet.gradient[faces].sum(1)).sum() > 0
    return Surface(
        vertices=shape.metres(x),
        faces=faces if bool(outward) else faces.flip(1),
        normals=unit(jet.gradient),
        std_m=whole.std_factor * shape.scale * surface_deviation(jet.variance, jet.gradient),
    )


def newton_step(
    value: Float[Tensor, "n"],
    gradient: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    least_slope: float = 0.0,
) -> Float[Tensor, "n"]:
    """Return the Newton step onto the zero level, as a multiple of `direction`. Slopes are at least `least_slope`."""
    return -value / (gradient * direction).sum(-1).clamp_min(least_slope)


def _carry_cloud(corners: np.ndarray, faces: np.ndarray, shape: ShapeGP) -> np.ndarray:
    """Tell which faces belong to sheets that carry enough of the cloud."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(corners), len(corners)))
    _, label = connected_components(graph, directed=False)
    cloud = shape.normalise(shape.cloud.points.to(shape.x)).cpu().numpy()
    _, nearest = KDTree(corners).query(cloud)
    share = np.bincount(label[nearest], minlength=label.max() + 1) / len(cloud)
    return (share >= min(LEAST_SHARE, share.max()))[label[faces[:, 0]]]
