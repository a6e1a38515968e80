"""The distance field of estimated surfaces: its error near them, and its time, with fine and with coarse nodes."""

import functools
import statistics

import numpy as np
import torch
import trimesh

from benchmarks.common import Row, least_seconds
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_mesh
from torchgrasp.values import PointCloud

FINE, COARSE = 0.003, 0.004
"""Spacings [m] of the planner's fields of thin and of thick objects."""
POINTS, NEAR = 2000, 0.006
"""Random points of each surface, and how far [m] they are from it at most: there fingers and links decide."""


def bench_field(clouds: list[PointCloud]) -> list[Row]:
    """Measure the field at random points near the surface of every cloud, beside trimesh's nearest triangles."""
    errors: dict[float, list[float]] = {FINE: [], COARSE: []}
    ratios = []
    for k, cloud in enumerate(clouds):
        surface = extract_mesh(fit_shape(cloud, table=0.0))
        points, distance = _points_near(surface.vertices.numpy(), surface.faces.numpy(), k)
        seconds = []
        for spacing, found in errors.items():
            make = functools.partial(field_from_surface, surface.vertices, surface.faces, spacing)
            off = make().query(torch.from_numpy(points))[0].abs().numpy() - distance
            found.append(1e3 * float(np.quantile(np.abs(off), 0.99)))
            seconds.append(least_seconds(make, 3))
        ratios.append(seconds[1] / seconds[0])
    numbers = {"fine_mm": errors[FINE], "coarse_mm": errors[COARSE], "time_ratio": ratios}
    words = [f"nodes {1e3 * s:g} mm apart off by {min(of):.2f} to {max(of):.2f} mm" for s, of in errors.items()]
    words.append(f"the coarse ones take {statistics.median(ratios):.2f} of the time (median)")
    return [
        Row(f"distance field, 99 % of {POINTS} points on {len(clouds)} views", "-", "; ".join(words), None, numbers)
    ]


def _points_near(vertices: np.ndarray, faces: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random points near a surface, and their distance from it [m] without its sign."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    draw = np.random.default_rng(seed)
    on, of = trimesh.sample.sample_surface(mesh, POINTS, seed=draw)
    points = on + draw.uniform(-NEAR, NEAR, (POINTS, 1)) * mesh.face_normals[of]
    return points, trimesh.proximity.closest_point(mesh, points)[1]
