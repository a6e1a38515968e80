"""Views of objects with their true meshes; samples and nearest points of a mesh."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

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
FACING_SAMPLES = 48
"""Samples among which those of one side of a wall are sought: they reach 6 mm around on a thing of
a hand's size.
"""


def read_views(
    objects: Path, camera: bool = True, views: Sequence[str] = ()
) -> Iterator[tuple[str, str, PointCloud, "trimesh.Trimesh"]]:
    """Yield object, view, noisy cloud and true mesh of every view, or of those with a name in
    `views`.
    """
    for name, view in list_views(objects):
        if views and view not in views:
            continue
        yield name, view, read_view(objects, name, view, camera), read_object_mesh(objects, name)


def sample_mesh(
    mesh: "trimesh.Trimesh", n: int, generator: np.random.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return n random points of a mesh, by area, and their normals."""
    points, _, normals = _sample(mesh, n, generator)
    return torch.from_numpy(points), torch.from_numpy(normals)


def nearest_on_mesh(
    mesh: "trimesh.Trimesh",
    points: Float[Tensor, "n 3"],
    facing: Float[Tensor, "n 3"] | None = None,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the nearest point of a mesh to each point, with its normal.

    Only the triangles of the nearest samples are tried, for speed.

    Args:
        mesh: the surface.
        points: [m].
        facing: outward directions. The nearest point whose normal is less than 90 degrees from it
            is returned: a finger outside of a wall does not touch its inside. NaN where no sample
            nearby is turned so.
    """
    from scipy.spatial import KDTree

    if not len(points):
        return points, points
    samples, faces, _ = _sample(mesh, SEARCH_SAMPLES, np.random.default_rng(0))
    queries = points.numpy()
    _, index = KDTree(samples).query(
        queries, k=SEARCH_TRIANGLES if facing is None else FACING_SAMPLES
    )
    candidates = faces[index]  # (n, samples)
    turned = np.ones(candidates.shape, dtype=bool)
    if facing is not None:
        towards = _face_normals(mesh, candidates.reshape(-1)).reshape(*candidates.shape, 3)
        turned = (towards * facing.numpy()[:, None]).sum(-1) > 0
        first = np.argsort(~turned, axis=1, kind="stable")[:, :SEARCH_TRIANGLES]
        candidates, turned = (np.take_along_axis(part, first, 1) for part in (candidates, turned))
    corners = np.asarray(mesh.triangles)[candidates.reshape(-1)]
    feet = closest_on_triangles(np.repeat(queries, SEARCH_TRIANGLES, 0), corners)[0].reshape(
        *candidates.shape, 3
    )
    distance = np.where(turned, np.linalg.norm(feet - queries[:, None], axis=-1), np.inf)
    rows = np.arange(len(queries))
    best = distance.argmin(1)
    missed = ~turned.any(1)[:, None]
    found = feet[rows, best]
    normals = _face_normals(mesh, candidates[rows, best])
    return tuple(torch.from_numpy(np.where(missed, np.nan, part)) for part in (found, normals))  # pyright: ignore[reportReturnType]


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
