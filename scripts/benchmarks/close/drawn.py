"""Solids drawn from what a view leaves open: the estimated surface, moved by a sample of its own posterior."""

import torch
import trimesh
from scipy.interpolate import RBFInterpolator

from torchgrasp.errors import BadArgument
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.posterior import distance_covariance, symmetric_root
from torchgrasp.shape.surface import extract_surface

ANCHORS = 600
"""Vertices whose displacements are drawn jointly; about 8 mm lie between them on a thing of 15 cm."""
NEIGHBOURS = 12
"""Anchors from which the displacement of a vertex is interpolated."""
GROUND = 0.01
"""Height [m] above its lowest point up to which a thing keeps its foot: it has to stand."""


def draw_solid(shape: ShapeGP, seed: int) -> trimesh.Trimesh:
    """Return a closed mesh whose surface deviates from the mean as the posterior says, with its correlations.

    Vertices move along their normals by a joint sample with deviations `std_m`.

    Raises:
        BadArgument: a shape of several walls, or whose surface is open.
    """
    surface = extract_surface(shape)
    mesh = surface.mesh()
    if len(shape.walls) > 1 or not mesh.is_watertight:
        raise BadArgument("shape", "several walls, or an open surface", "one closed wall")
    anchors = farthest_points(surface.vertices, min(ANCHORS, len(surface.vertices)))
    covariance = distance_covariance(shape, shape.normalise(surface.vertices[anchors])[None])[0]
    prior = float(shape.prior_block()[0, 0])
    root = symmetric_root(covariance, prior, "anchors within the domain")
    draw = root @ torch.randn(len(anchors), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    moved = surface.std_m[anchors] * draw / covariance.diagonal().sqrt()
    field = RBFInterpolator(surface.vertices[anchors].numpy(), moved.numpy(), NEIGHBOURS, kernel="linear")
    height = surface.vertices[:, 2] - surface.vertices[:, 2].min()
    length = torch.from_numpy(field(surface.vertices.numpy())) * (height / GROUND).clamp(max=1.0)
    mesh.vertices = (surface.vertices + length[:, None] * surface.normals).numpy()
    return mesh
