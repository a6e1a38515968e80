"""Views of objects with their true meshes; samples and nearest points of a mesh."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud import read_cloud_file
from torchgrasp.data import list_views, read_object_mesh, read_view
from torchgrasp.geometry.mesh import closest_on_triangles
from torchgrasp.values.planning import PointCloud

if TYPE_CHECKING:
    import trimesh

SEARCH_SAMPLES = 20_000
SEARCH_TRIANGLES = 8
"""Samples of a surface, and how many of them give the triangles among which its nearest point is
sought.
"""
HIDDEN = 0.006
"""Distance [m] from the cloud beyond which the true surface counts as hidden."""
TABLE_FACE = 0.002
DOWNWARD = -0.7
"""Height [m] over the lowest point, and upward part of the normal, below which surface is the face
on the table.
"""


def read_views(
    objects: Path, views: Sequence[str] = ()
) -> Iterator[tuple[str, str, PointCloud, "trimesh.Trimesh"]]:
    """Yield object, view, noisy cloud and true mesh of every view, or of those with a name in
    `views`.
    """
    for name, view in list_views(objects):
        if views and view not in views:
            continue
        yield name, view, read_view(objects, name, view), read_object_mesh(objects, name)


def read_cameras(folder: Path) -> dict[str, dict[str, Float[Tensor, "n 3"]]]:
    """Return the points [m] of real things by camera, of a folder of files NAME_CAMERA.ply."""
    clouds: dict[str, dict[str, Tensor]] = defaultdict(dict)
    for path in sorted(folder.glob("*_*.ply")):
        name, camera = path.stem.rsplit("_", 1)
        clouds[name][camera] = read_cloud_file(path).cloud.points.double()
    return clouds


def sample_mesh(
    mesh: "trimesh.Trimesh", n: int, generator: np.random.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return n random points of a mesh, by area, and their normals."""
    points, _, normals = _sample(mesh, n, generator)
    return torch.from_numpy(points), torch.from_numpy(normals)


def sample_hidden(
    mesh: "trimesh.Trimesh", cloud: PointCloud, n: int, generator: np.random.Generator
) -> Float[Tensor, "k 3"]:
    """Return those of n random points of a mesh [m] that a cloud does not show; the face on the table
    is left out.
    """
    from scipy.spatial import KDTree

    points, normals = sample_mesh(mesh, n, generator)
    low = float(mesh.bounds[0, 2]) + TABLE_FACE
    on_table = (points[:, 2] < low) & (normals[:, 2] < DOWNWARD)
    away = torch.from_numpy(KDTree(cloud.points.numpy()).query(points.numpy())[0])
    return points[(away > HIDDEN) & ~on_table]


def nearest_on_mesh(
    mesh: "trimesh.Trimesh", points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the nearest point of a mesh [m] to each point [m], with its normal.

    Only the triangles of the nearest samples are tried, for speed.
    """
    from scipy.spatial import KDTree

    if not len(points):
        return points, points
    samples, faces, _ = _sample(mesh, SEARCH_SAMPLES, np.random.default_rng(0))
    queries = points.numpy()
    _, index = KDTree(samples).query(queries, k=SEARCH_TRIANGLES)
    candidates = faces[index]  # (n, samples)
    corners = np.asarray(mesh.triangles)[candidates.reshape(-1)]
    feet = closest_on_triangles(np.repeat(queries, SEARCH_TRIANGLES, 0), corners)[0].reshape(
        *candidates.shape, 3
    )
    best = np.linalg.norm(feet - queries[:, None], axis=-1).argmin(1)
    rows = np.arange(len(queries))
    normals = _face_normals(mesh, candidates[rows, best])
    return torch.from_numpy(feet[rows, best]), torch.from_numpy(normals)


def _sample(
    mesh: "trimesh.Trimesh", n: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return n random points evenly by area, their faces and the faces' normals."""
    corners = np.asarray(mesh.triangles)
    area = np.cumsum(
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
        )
    )
    face = np.minimum(np.searchsorted(area, generator.random(n) * area[-1]), len(area) - 1)
    u, v = generator.random((2, n))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face, _face_normals(mesh, face)


def _face_normals(mesh: "trimesh.Trimesh", faces: np.ndarray) -> np.ndarray:
    """Return unit normals of faces by their winding, also of very thin ones."""
    a, b, c = np.asarray(mesh.triangles)[faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)
