"""The zero level of a sphere's posterior against the sphere."""

import dataclasses
import math
from typing import Literal

import numpy as np
import pytest
import torch
import trimesh

from tests.make import cup_view, near, real
from torchgrasp import PointCloud, ShapeGP, fit_shape
from torchgrasp.foundation.errors import BadArgument, SuspiciousScale
from torchgrasp.shape.surface import _grid, collision_field, extract_mesh, extract_surface

RADIUS = 0.04
CENTER = real([0.2, -0.1, 0.3])


@pytest.fixture(scope="module")
def ball() -> ShapeGP:
    n = torch.randn(800, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    return fit_shape(PointCloud(RADIUS * n + CENTER, n))


def test_eq9_surface_is_the_zero_level_closed_and_wound_outward(ball: ShapeGP):
    surface = extract_surface(ball, resolution=24)
    found = ball.predict(surface.vertices)
    assert found.distance.abs().max() < 1e-6
    near(surface.normals, found.normal, 1e-6)
    torch.testing.assert_close(surface.std_m, found.std_m, rtol=1e-4, atol=1e-7)
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.body_count == 1
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.1)
    assert np.abs(np.linalg.norm(mesh.vertices - CENTER.numpy(), axis=1) - RADIUS).max() < 0.002
    mesh = extract_mesh(ball)
    surface = extract_surface(ball)
    assert torch.equal(mesh.vertices, surface.vertices) and torch.equal(mesh.faces, surface.faces)


def test_a_finer_grid_gives_more_triangles_and_the_surface_carries_the_cloud(
    ball: ShapeGP, seen_cylinder: PointCloud
):
    coarse = extract_surface(ball, 16)
    fine = extract_surface(ball, 32)
    assert len(fine.faces) > 3 * len(coarse.faces)
    assert torch.cdist(coarse.vertices, fine.vertices).amin(1).max() < 0.006
    surface = extract_surface(fit_shape(seen_cylinder, table=0.0), resolution=32)
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    _, distance, _ = trimesh.proximity.closest_point(mesh, seen_cylinder.points[::10].numpy())
    assert np.median(distance) < 0.001
    assert mesh.volume == pytest.approx(math.pi * 0.03**2 * 0.12, rel=0.2)


@pytest.mark.parametrize("support", ["camera", "paper"])
def test_the_grid_is_the_mean_wherever_the_surface_passes(
    support: Literal["camera", "paper"], seen_cylinder: PointCloud
):
    shape = fit_shape(seen_cylinder, support=support, table=0.0 if support == "camera" else None)
    radius = shape.domain_radius
    step = 2 * shape.domain_radius / 32
    found = _grid(shape, radius, step, 32)
    line = torch.linspace(-radius, radius, 33, dtype=torch.float64)
    nodes = torch.cartesian_prod(line, line, line)
    mean = shape.mean(nodes).reshape(33, 33, 33).numpy()
    inside = ~np.isnan(found)
    assert (
        inside
        == (torch.linalg.vector_norm(nodes, dim=1) <= radius * (1 + 1e-9))
        .reshape(33, 33, 33)
        .numpy()
    ).all()
    assert (np.sign(found) == np.sign(mean))[inside].all()
    exact = np.isclose(found, mean, rtol=0, atol=1e-9)
    for axis in range(3):  # both ends of an edge across the surface are exact
        sign = np.moveaxis(mean > 0, axis, 0)
        sure = np.moveaxis(exact | ~inside, axis, 0)
        across = sign[1:] != sign[:-1]
        assert sure[1:][across].all() and sure[:-1][across].all()
    assert exact.mean() < 0.6


def test_both_walls_of_a_vessel_are_wound_outward():
    surface = extract_surface(fit_shape(cup_view(0.004), table=0.0))
    a, b, c = surface.vertices[surface.faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    facing = (across * surface.normals[surface.faces].sum(1)).sum(1)
    assert (facing > 0)[torch.linalg.vector_norm(across, dim=1) > 1e-7].double().mean() > 0.99


@pytest.mark.parametrize("resolution", [0, 7, 257])
def test_a_resolution_out_of_range_is_refused(ball: ShapeGP, resolution: int):
    with pytest.raises(BadArgument, match="resolution"):
        extract_surface(ball, resolution)


def test_an_object_far_larger_than_a_hand_is_refused_by_its_size(ball: ShapeGP):
    mesh = extract_mesh(ball)
    large = dataclasses.replace(mesh, vertices=1.2 / 0.08 * mesh.vertices)
    with pytest.raises(SuspiciousScale, match=r"cloud: expected an object of less than .* m, got"):
        collision_field(ball, large)
