"""Samples and nearest points of true meshes, against trimesh."""

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.ground_truth import nearest_on_mesh, sample_mesh


def test_the_nearest_point_of_a_mesh_is_exact():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    points = 0.05 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found, normals = nearest_on_mesh(mesh, points)
    _, distance, faces = trimesh.proximity.closest_point_naive(mesh, points.numpy())
    error = torch.linalg.vector_norm(found - points, dim=-1).numpy() - distance
    assert np.abs(error).max() < 1e-5 and np.median(np.abs(error)) < 1e-12
    assert (normals.numpy() * mesh.face_normals[faces]).sum(-1).min() > 0.99
    assert nearest_on_mesh(mesh, points[:0])[0].shape == (0, 3)


def test_samples_of_a_mesh_lie_on_it_evenly():
    box = trimesh.creation.box([0.1, 0.2, 0.3])
    points, normals = sample_mesh(box, 20000, np.random.default_rng(0))
    half = torch.tensor([0.05, 0.1, 0.15], dtype=torch.float64)
    assert ((points.abs() - half).amax(-1)).abs().max() < 1e-12
    torch.testing.assert_close((points * normals).sum(-1), (half * normals.abs()).sum(-1))
    assert (normals[:, 0].abs() > 0.5).double().mean().item() == pytest.approx(0.06 * 2 / 0.22, abs=0.02)


def test_a_finger_outside_of_a_wall_does_not_touch_its_inside():
    plate = trimesh.creation.box([0.1, 0.1, 0.002])
    plate = plate.subdivide_to_size(0.01)
    below = torch.tensor([[0.01, 0.02, -0.0008]], dtype=torch.float64)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    assert nearest_on_mesh(plate, below)[1][0, 2] == -1
    found, normal = nearest_on_mesh(plate, below, up)
    torch.testing.assert_close(found, torch.tensor([[0.01, 0.02, 0.001]]).double())
    assert float(normal[0, 2]) == 1
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    outside = torch.tensor([[0.0, 0.0, 0.21]], dtype=torch.float64)
    assert bool(nearest_on_mesh(ball, outside, -up)[0].isnan().all())  # nothing near is turned downwards
