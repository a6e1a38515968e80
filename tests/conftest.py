"""Shared tolerances, generators and analytic shapes of the tests."""

import math

import pytest
import torch
from torch import Tensor

from torchgrasp.frames import rigid, rotation_from_vector
from torchgrasp.values import PointCloud


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def motion(generator: torch.Generator) -> Tensor:
    """A rigid motion far from the identity."""
    turn = rotation_from_vector(torch.randn(3, generator=generator, dtype=torch.float64))
    return rigid(turn, torch.randn(3, generator=generator, dtype=torch.float64))


@pytest.fixture
def seen_cylinder() -> PointCloud:
    """One side of a standing cylinder, r 30 mm and h 120 mm, seen from a camera 0.5 m away, with exact normals."""
    rng = torch.Generator().manual_seed(1)
    camera = torch.tensor([0.45, 0.0, 0.3], dtype=torch.float64)
    angle = (torch.rand(1200, generator=rng, dtype=torch.float64) - 0.5) * math.pi * 0.94
    height = torch.rand(1200, generator=rng, dtype=torch.float64) * 0.12
    side_normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    side = 0.03 * side_normals + torch.tensor([0.0, 0, 1], dtype=torch.float64) * height[:, None]
    radius = 0.03 * torch.rand(200, generator=rng, dtype=torch.float64).sqrt()
    turn = torch.rand(200, generator=rng, dtype=torch.float64) * 2 * math.pi
    top = torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full_like(turn, 0.12)], -1)
    top_normals = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(200, 3)
    points, normals = torch.cat([side, top]), torch.cat([side_normals, top_normals])
    seen = ((camera - points) * normals).sum(-1) > 0
    return PointCloud(points[seen], normals[seen], camera)
