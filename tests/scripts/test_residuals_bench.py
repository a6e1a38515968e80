"""scripts/bench.py shape --only residuals: its statistics, where they are known in closed form."""

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.shape.residuals import compare_two, correlate, fit_patches, share_of_holes

from torchgrasp import PointCloud
from torchgrasp.cloud import look_at
from torchgrasp.cloud.camera import partial_view
from torchgrasp.geometry.linalg import fibonacci_sphere

RADIUS = 0.03
NOISE = 0.0002


def sphere(noise: float = 0.0) -> torch.Tensor:
    """Return points of a ball with independent errors [m] along its normals."""
    normals = fibonacci_sphere(6000)
    draw = torch.randn(6000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (RADIUS + noise * draw) * normals


def test_patches_of_a_ball_show_its_noise_and_its_curvature() -> None:
    rows = torch.arange(0, 6000, 30)
    fits = fit_patches(sphere(NOISE), rows, 0.006)
    assert np.median(fits.rms) == pytest.approx(NOISE, rel=0.1)
    exact = fit_patches(sphere(), rows, 0.004)
    assert np.median(exact.curvature) == pytest.approx(1 / RADIUS, rel=0.05)
    cosine = (exact.normal * fibonacci_sphere(6000)[rows].numpy()).sum(1)
    assert np.abs(cosine).min() > 0.999
    sparse = fit_patches(sphere()[::100], torch.arange(5), 0.003)
    assert np.isnan(sparse.rms).all()


def test_independent_residuals_have_no_correlation_and_alike_ones_have() -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform(0.0, 0.03, (400, 3)) * [1.0, 1.0, 0.0]
    own = correlate(points, generator.normal(size=400))
    assert max(map(abs, own.values())) < 0.2
    alike = correlate(points, np.sin(points[:, 0] / 0.01))
    assert min(alike.values()) > 0.7


def test_a_hole_has_its_share_of_the_area() -> None:
    step = torch.arange(-30, 31, dtype=torch.float64) * 1e-3
    grid = torch.cartesian_prod(step, step)
    side = 0.0105
    points = grid[(grid.abs() > side).any(1)]
    points = torch.cat([points[:, :1], torch.zeros_like(points[:, :1]), points[:, 1:]], 1)
    eye = torch.tensor([0.0, -0.6, 0.0], dtype=torch.float64)
    assert share_of_holes(points, eye) == pytest.approx((side / 0.0305) ** 2, abs=0.05)


def test_two_views_of_one_surface_differ_by_a_shift_and_by_nothing_after_it() -> None:
    ball = trimesh.creation.icosphere(5, radius=RADIUS).apply_translation([0.1, 0.0, RADIUS])
    front = partial_view(ball, look_at(30.0, 40.0, target=ball), 100000, noise=False).points
    shift = torch.tensor([0.002, 0.0, 0.0]).to(front)
    found = compare_two(PointCloud(front), PointCloud(front + shift))
    assert 0.5 < found["where both cameras see, median [mm]"] < 1.5
    assert found["the same, after a shift, median [mm]"] < 0.15
    assert found["beyond the outline by 5 mm, after a shift [%]"] < 1.0
