"""Signed distances to a triangle mesh, which may be open. Samples of the surface propose a few
triangles near a point. The distance is exactly that from the nearest of these triangles.
"""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.fused import are_on
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.box_tree import Boxes, sort_into_boxes
from torchgrasp.geometry.linalg import number_rows
from torchgrasp.geometry.mesh import closest_on_triangles


@dataclasses.dataclass(frozen=True)
class MeshDistanceNumbers:
    """Parameters of the search of the triangle that is nearest to a point."""

    least_area: float = 1e-14
    """Least area [m2] of a triangle that counts."""
    sample: float = 0.002
    """Side [m] of the square for which the surface has one sample on average."""
    least_samples: int = 2000
    """Least number of samples of a surface."""
    most_samples: int = 40_000
    """Greatest number of samples of a surface, which bounds the time."""
    few: int = 8
    """Reciprocal of the share of the samples that is used for points far from the surface."""
    tried: int = 3
    """Number of nearest triangles that are tried for a point near the surface."""
    leaf: int = 32
    """Greatest number of samples in a leaf of the search tree."""
    at_once: int = 8192
    """Number of points whose distances are sought at once, which bounds the memory."""
    digits: int = 9
    """Number of decimals [m] in which the corners of neighbouring triangles agree."""


MESH_DISTANCE = MeshDistanceNumbers()


def surface_distance(vertices: Tensor, faces: Tensor) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that maps points (n, 3) [m] to signed distances (n,) [m], positive outside
    a mesh.

    The mesh has outward faces: `vertices` (v, 3) [m], and `faces` (f, 3), the indices of three
    vertices each. The points are in the frame of the mesh. Raises `BadArgument` for an index out of
    range, or if no face has an area.
    """
    return MeshSurface(vertices, faces).distance


class MeshSurface:
    """The triangles of a mesh [m], with samples of its surface, to find the distances of points
    from it.

    It is made of the `vertices` (v, 3) and `faces` (f, 3), the indices of three vertices each.
    Raises `BadArgument` for an index out of range, or if no face has an area.
    """

    def __init__(self, vertices: Tensor, faces: Tensor):
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.is_floating_point():
            found = f"{faces.dtype} of shape {tuple(faces.shape)}"
            raise BadArgument("faces", found, "integers (f, 3) with f >= 1")
        index = faces.cpu().numpy()  # (f, 3)
        if index.min() < 0 or index.max() >= len(vertices):
            found = f"faces {index.min()}..{index.max()}"
            raise BadArgument("faces", found, f"0..{len(vertices) - 1}")
        corners = vertices.detach().cpu().double().numpy()  # (v, 3)
        triangles = corners[index]  # (f, 3, 3)
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        double_area = np.linalg.norm(normals, axis=1)
        kept = double_area / 2 > MESH_DISTANCE.least_area
        if not kept.any():
            raise BadArgument("faces", "faces without area", "a surface")
        triangles = triangles[kept]
        area = double_area[kept] / 2
        unit_normals = normals[kept] / double_area[kept, None]
        self.triangles = triangles
        self.normals = _pseudonormals(triangles, _places(corners)[index[kept]], unit_normals)
        rng = np.random.default_rng(0)
        wanted = area.sum() / MESH_DISTANCE.sample**2
        count = int(np.clip(wanted, MESH_DISTANCE.least_samples, MESH_DISTANCE.most_samples))
        owner = np.repeat(np.arange(len(area)), rng.multinomial(count, area / area.sum()))
        u, v = np.sort(rng.random((2, len(owner))), axis=0)
        weights = np.stack([u, v - u, 1 - v], 1)
        samples = (triangles[owner] * weights[:, :, None]).sum(1)
        self.samples = np.concatenate([triangles.mean(1), samples])
        self.owner = np.concatenate([np.arange(len(area)), owner])

    @cached_property
    def every(self) -> "Samples":
        """All samples of the surface, in which the nearest to a point are sought."""
        return Samples(self.samples, self.owner)

    @cached_property
    def few(self) -> "Samples":
        """One in 8 samples of the surface (`MESH_DISTANCE.few`), for distant points."""
        return Samples(self.samples[:: MESH_DISTANCE.few], self.owner[:: MESH_DISTANCE.few])

    def distance(self, points: np.ndarray, far: bool = False) -> np.ndarray:
        """Return the signed distances (n,) [m] of points (n, 3) [m] from the mesh, positive
        outside.

        The points are in the frame of the mesh. `far` is for distant points: one in 8 samples of
        the surface is used, which is faster and less exact.
        """
        samples = self.few if far else self.every
        tried = 1 if far else min(MESH_DISTANCE.tried, len(self.owner))
        if are_on():
            from torchgrasp.geometry import fused_distance  # it imports numba

            surface = samples.owner, self.triangles, self.normals
            return fused_distance.distance(points, samples.boxes, *surface, tried)
        parts = []
        for begin in range(0, max(1, len(points)), MESH_DISTANCE.at_once):
            part = points[begin : begin + MESH_DISTANCE.at_once]
            _, index = samples.tree.query(part, k=tried)
            owner = samples.owner[index.reshape(len(part), tried)]  # (p, t)
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


class Samples:
    """Sample points of a mesh's surface: the samples nearest to a point tell the triangles nearest
    to it.

    Args:
        points: s points (s, 3) [m] on the surface.
        owner: index (s,) of the triangle of each point in the faces of the mesh.
    """

    def __init__(self, points: np.ndarray, owner: np.ndarray):
        self.points = points
        self.owner = owner

    @cached_property
    def tree(self) -> Any:
        """The k-d tree (`scipy.spatial.KDTree`) of the sample points."""
        return spatial.KDTree(self.points, leafsize=MESH_DISTANCE.leaf)

    @cached_property
    def boxes(self) -> Boxes:
        """The sample points in a balanced tree of boxes, which compiled loops search."""
        return sort_into_boxes(self.points)


def _places(corners: np.ndarray) -> np.ndarray:
    """Return a number (v,) for each corner (v, 3) [m]; corners at the same place have the same."""
    places = np.round(corners * 10.0**MESH_DISTANCE.digits)
    return number_rows(torch.from_numpy(places)).numpy()


def _pseudonormals(corners: np.ndarray, ids: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Return pseudonormals (Baerentzen and Aanaes, 2005) of each triangle's face, 3 sides and 3
    corners, (f, 7, 3).

    `corners` (f, 3, 3) are those of the triangles, and `ids` (f, 3) tell which of them are one
    vertex. `face` (f, 3) are the unit normals of the triangles.
    """
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
