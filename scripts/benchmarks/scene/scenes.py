"""Random places of objects that stand apart on a table."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rigid, rotation_from_vector


def scatter(
    meshes: Sequence[trimesh.Trimesh], generator: torch.Generator, radius: float, gap: float
) -> Float[Tensor, "n 4 4"]:
    """Return random poses (n, 4, 4) [m] of n meshes that stand upright on the table z = 0.

    The footprints, convex hulls seen from above, lie within `radius` [m] of the origin and at least
    `gap` [m] apart. Meshes that do not fit raise `BadArgument`.
    """
    outlines = [footprint(mesh) for mesh in meshes]
    sizes = [float(torch.linalg.vector_norm(outline, dim=-1).max()) for outline in outlines]
    largest_first = sorted(range(len(meshes)), key=lambda i: -sizes[i])
    for _ in range(50):
        placed: dict[int, tuple[Float[Tensor, "4 4"], Float[Tensor, "k 2"]]] = {}
        for i in largest_first:
            taken = [outline for _, outline in placed.values()]
            for _ in range(200):
                pose = _random_pose(-float(meshes[i].bounds[0, 2]), generator, radius)
                outline = outlines[i] @ pose[:2, :2].T + pose[:2, 3]
                inside = float(torch.linalg.vector_norm(outline, dim=-1).max()) <= radius
                if inside and all(separation(outline, other) >= gap for other in taken):
                    placed[i] = pose, outline
                    break
            else:
                break
        if len(placed) == len(meshes):
            return torch.stack([placed[i][0] for i in range(len(meshes))])
    given = f"{radius:g} m for {len(meshes)} meshes"
    raise BadArgument("radius", given, "a circle that holds them, with their gaps")


def _random_pose(height: float, generator: torch.Generator, radius: float) -> Float[Tensor, "4 4"]:
    """Return an upright pose at a random place in the circle, at a height [m]."""
    turn, share, angle = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    distance = radius * math.sqrt(share)
    angle = 2 * math.pi * angle
    position = [distance * math.cos(angle), distance * math.sin(angle), height]
    about_z = torch.tensor([0.0, 0.0, 2 * math.pi * turn], dtype=torch.float64)
    rotation = rotation_from_vector(about_z)
    return rigid(rotation, torch.tensor(position, dtype=torch.float64))


def footprint(mesh: trimesh.Trimesh) -> Float[Tensor, "n 2"]:
    """Return the corners (n, 2) [m] of the convex hull of a mesh seen from above.

    They run counter-clockwise.
    """
    from scipy.spatial import ConvexHull

    flat = np.array(mesh.vertices, dtype=np.float64)[:, :2]
    return torch.from_numpy(flat[ConvexHull(flat).vertices])


def separation(a: Float[Tensor, "n 2"], b: Float[Tensor, "m 2"]) -> float:
    """Return a lower bound of the distance [m] of two convex polygons; negative if they overlap.

    The corners of both run counter-clockwise. The bound is the width of the widest strip between
    them that runs along an edge of one of them.
    """
    return max(_widest_strip(a, b), _widest_strip(b, a))


def _widest_strip(a: Float[Tensor, "n 2"], b: Float[Tensor, "m 2"]) -> float:
    """Return the greatest distance of b from an edge of a, outward; a's corners run
    counter-clockwise.
    """
    edge = a.roll(-1, 0) - a
    outward = torch.stack([edge[:, 1], -edge[:, 0]], -1) / torch.linalg.vector_norm(
        edge, dim=-1, keepdim=True
    )
    return float(((b @ outward.T).amin(0) - (a * outward).sum(-1)).max())
