"""The wall of an open vessel: its estimated thickness along lines across the true wall, and its
holes.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.ground_truth import sample_mesh
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values.planning import PointCloud

if TYPE_CHECKING:
    import trimesh

LINES = 600
"""Lines across the wall that are drawn; those that meet no wall are left out."""
MOST = 0.012
"""Thickness [m] up to which two opposite surfaces are a wall."""
LEVEL = 0.7
"""Upward part of a normal below which a wall is a side, not a floor or a rim."""
OPPOSITE = -0.7
"""Cosine of the angle between the normals of a wall's two sides, at most."""
REACH = 0.015
STEP = 0.00025
"""How far [m] from the middle of the true wall the estimated one is sought, and in which steps."""
ASIDE = 0.004
"""Distance [m] from the middle of the true wall beyond which estimated material is not this wall.
"""
NEAR_RIM = 0.005
"""A rim is seen where the cloud has a point so near [m] to it."""
SECTORS = 36
"""Parts of the rim, each of which was seen or not."""

Row = dict[str, Any]


def measure_walls(shape: ShapeGP, mesh: "trimesh.Trimesh", cloud: PointCloud, seed: int = 0) -> Row:
    """Return how thick the estimated wall is across the true one; NaN of a body without walls.

    * "wall_mm", "wall_off_mm": medians of the true thickness and of the estimate's error.
    * "wall_within_2": share of the lines on which a wall stands that is off by 2 mm at most.
    * "wall_holes": share without any material within 4 mm of the wall's middle.
    * "wall_rim_seen": share of the lines below a part of the rim that was seen; "wall_rim_within_2"
      is of those.

    Args:
        shape: the posterior [m].
        mesh: the true surface in the frame of the cloud [m].
        cloud: what the camera saw.
        seed: of the lines.
    """
    points, normals, thickness = true_wall(mesh, LINES, seed)
    names = (
        "wall_mm",
        "wall_off_mm",
        "wall_within_2",
        "wall_holes",
        "wall_rim_seen",
        "wall_rim_within_2",
    )
    if not len(points):
        return dict.fromkeys(names, float("nan"))
    found = estimated_thickness(shape, points - 0.5 * thickness[:, None] * normals, normals)
    off = (found - thickness).abs()
    hole = found == 0.0
    good = ((off < 0.002) & ~hole).double()
    seen = _rim_seen(mesh, cloud, points)
    values = (
        1e3 * thickness.median(),
        1e3 * off.median(),
        good.mean(),
        hole.double().mean(),
        seen.double().mean(),
        good[seen].mean(),
    )
    return dict(zip(names, map(float, values), strict=True))


def true_wall(
    mesh: "trimesh.Trimesh", n: int, seed: int
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"], Float[Tensor, "k"]]:
    """Return points of a mesh's walls, with outward normals and the thickness [m] behind them."""
    points, normals = sample_mesh(mesh, n, np.random.default_rng(seed))
    side = normals[:, 2].abs() < LEVEL
    points = points[side]
    normals = normals[side]
    corners = torch.from_numpy(np.array(mesh.triangles, dtype=np.float64))
    a = corners[:, 0]
    ab = corners[:, 1] - corners[:, 0]
    ac = corners[:, 2] - corners[:, 0]
    across = torch.linalg.cross(ab, ac)
    depth = torch.full_like(points[:, 0], torch.inf)
    for k, (point, ray) in enumerate(
        zip(points, -normals, strict=True)
    ):  # Moeller and Trumbore 1997
        q = torch.linalg.cross(ray.expand_as(ac), ac)
        to = point - a
        scale = (ab * q).sum(1)
        u = (to * q).sum(1) / scale
        r = torch.linalg.cross(to, ab)
        v = (ray * r).sum(1) / scale
        t = (ac * r).sum(1) / scale
        out = (across @ ray) / torch.linalg.vector_norm(
            across, dim=1
        )  # the far side is left along its normal
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6) & (t < MOST)
        if bool(hit.any()):
            first = torch.where(hit, t, torch.inf).argmin()
            depth[k] = t[first] if float(out[first]) > -OPPOSITE else torch.inf
    wall = depth.isfinite()
    return points[wall], normals[wall], depth[wall]


def estimated_thickness(
    shape: ShapeGP, middle: Float[Tensor, "k 3"], normals: Float[Tensor, "k 3"]
) -> Float[Tensor, "k"]:
    """Return the length [m] of the stretch of material nearest to each point, along its normal; 0:
    none is near.
    """
    steps = torch.arange(-REACH, REACH + STEP / 2, STEP, dtype=torch.float64)
    places = middle[:, None] + steps[:, None] * normals[:, None]
    mean = shape.mean(shape.normalise(places).reshape(-1, 3)).reshape(len(middle), -1)
    value = torch.where(shape.contains(places), mean, torch.ones_like(mean)).numpy()
    length = np.zeros(len(middle))
    for k, row in enumerate(value < 0):
        edge = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
        starts = edge[::2]
        ends = edge[1::2]
        if len(starts):
            apart = (
                np.maximum(np.maximum(starts - len(row) // 2, len(row) // 2 - ends + 1), 0) * STEP
            )
            best = int(apart.argmin())
            length[k] = (ends[best] - starts[best]) * STEP if apart[best] < ASIDE else 0.0
    return torch.from_numpy(length)


def _rim_seen(mesh: "trimesh.Trimesh", cloud: PointCloud, points: Float[Tensor, "k 3"]) -> Tensor:
    """Tell over which points the cloud holds the rim: the highest part of the mesh in their sector."""
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    middle = (vertices.amin(0) + vertices.amax(0)) / 2

    def sector(p: Tensor) -> Tensor:
        angle = torch.atan2(p[:, 1] - middle[1], p[:, 0] - middle[0])
        return ((angle / (2 * torch.pi) + 0.5) * SECTORS).long().clamp(0, SECTORS - 1)

    seen = torch.zeros(SECTORS, dtype=torch.bool)
    mine = sector(vertices)
    for k in range(SECTORS):
        here = vertices[mine == k]
        if len(here):
            seen[k] = (
                torch.cdist(here[here[:, 2].argmax()][None], cloud.points.double()).min() < NEAR_RIM
            )
    return seen[sector(points)]
