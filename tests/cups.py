"""Cups of known wall, and noisy views of them."""

import functools

import numpy as np
import torch
import trimesh

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.values import PointCloud

RADIUS, HEIGHT = 0.037, 0.075


@functools.cache
def cup(wall: float, radius: float = RADIUS, floor: float = 0.003) -> trimesh.Trimesh:
    """A straight cup that stands at z = 0, open at the top."""
    inside = radius - wall
    profile = [[0, 0], [radius, 0], [radius, HEIGHT], [inside, HEIGHT], [inside, floor], [0, floor]]
    return trimesh.creation.revolve(np.array(profile), sections=96)


@functools.cache
def cup_view(wall: float, elevation: float = 35.0, seed: int = 0, noise: bool = True) -> PointCloud:
    """What a camera 0.5 m away sees of the cup."""
    mesh = cup(wall)
    return partial_view(mesh, look_at(20.0, elevation, target=mesh), n=1000, noise=noise, seed=seed)


def ring(radius: float, low: float, high: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a vertical cylinder all around, and its normals away from the axis."""
    angle = torch.arange(24, dtype=torch.float64) * (2 * torch.pi / 24)
    out = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    heights = torch.linspace(low, high, 6, dtype=torch.float64)
    points = radius * out + heights[:, None, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return points.flatten(0, 1), out.expand(6, -1, -1).flatten(0, 1)
