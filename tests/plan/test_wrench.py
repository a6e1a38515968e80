"""Wrenches and the exact closure test, each against its own definition or another method."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure import (
    centre_and_radius,
    closed_exact,
    cone_edges,
    rank_ratio,
    tangents,
    wrenches,
)
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts


def triples(generator: torch.Generator, count: int) -> tuple[Tensor, Tensor]:
    """Random points with outward normals that lean away from the centre, so that about half the triples are closed."""
    points = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return points, unit(unit(points - points.mean(1, keepdim=True)) + 0.45 * noise)


@pytest.mark.parametrize("edges", [3, 8])
def test_eq13_edges_lie_on_the_friction_cone_about_the_inward_normal(generator, edges):
    points, normals = triples(generator, 50)
    tangent = tangents(points, normals)
    torch.testing.assert_close((tangent * normals).sum(-1), torch.zeros(50, 3, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.vector_norm(tangent, dim=-1), torch.ones(50, 3, dtype=torch.float64))
    edge = cone_edges(normals, tangent, 0.7, edges)
    push = -(edge * normals[:, :, None]).sum(-1)
    torch.testing.assert_close(push, torch.ones_like(push))
    slide = torch.linalg.vector_norm(edge + normals[:, :, None], dim=-1)
    torch.testing.assert_close(slide, torch.full_like(slide, 0.7))
    torch.testing.assert_close(edge.mean(2), -normals)


def test_eq13_torques_are_about_the_centre_and_in_radii(generator):
    points, normals = triples(generator, 20)
    w = wrenches(points, normals, 0.5, 8)
    centre, radius = centre_and_radius(points)
    torque = torch.linalg.cross(((points - centre) / radius)[:, :, None].expand(20, 3, 8, 3), w[..., :3])
    torch.testing.assert_close(w[..., 3:], torque)
    assert bool((radius > 0).all())


def test_wrenches_turn_with_a_rigid_motion_and_ignore_scale(generator, motion):
    points, normals = triples(generator, 20)
    w = wrenches(points, normals, 0.5)
    moved = wrenches(apply(motion, points) * 1000, rotate(motion, normals), 0.5)
    torch.testing.assert_close(moved.unflatten(-1, (2, 3)), w.unflatten(-1, (2, 3)) @ motion[:3, :3].mT)


def test_tangents_are_finite_on_their_seam_and_for_degenerate_contacts():
    z = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(1, 3, 3)
    flat = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    for points in (flat, torch.zeros_like(flat), flat * torch.tensor([1.0, 0, 0], dtype=torch.float64)):
        tangent = tangents(points, z)
        torch.testing.assert_close(torch.linalg.vector_norm(tangent, dim=-1), torch.ones(1, 3, dtype=torch.float64))
        torch.testing.assert_close((tangent * z).sum(-1), torch.zeros(1, 3, dtype=torch.float64))
        assert torch.isfinite(wrenches(points, z, 0.5)).all()


def test_exact_closure_agrees_with_a_programme_of_64_edges(generator):
    points, normals = triples(generator, 250)
    for friction in (0.3, 0.8):
        exact = closed_exact(points, normals, friction)
        spec = ContactSpec(friction=friction, edges=64, friction_margin=1.0)
        # 64 edges lie inside the round cone and hold the round cone of friction cos(pi/64).
        outer = certify(Contacts(points, normals), spec).closed
        inner = closed_exact(points, normals, friction * math.cos(math.pi / 64))
        assert 10 < int(exact.sum()) < 240
        assert bool((exact | ~outer).all())
        assert bool((outer | ~inner).all())
        assert int((exact != inner).sum()) <= 5


def test_exact_closure_of_an_equilateral_triangle_and_its_limits():
    angle = torch.tensor([0.0, 2, 4], dtype=torch.float64) * math.pi / 3
    points = torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)[None]
    assert bool(closed_exact(points, points, 0.1))  # normals meet in the centre
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(1, 3, 3)
    assert not bool(closed_exact(points, up, 5.0))  # no force in the plane of the contacts
    # Normals tilted out of the plane by 40 degrees: closed only with more friction than tan 40 = 0.839.
    tilted = unit(math.cos(math.radians(40)) * points + math.sin(math.radians(40)) * up)
    assert not bool(closed_exact(points, tilted, 0.82))
    assert bool(closed_exact(points, tilted, 0.86))
    assert not bool(closed_exact(torch.zeros_like(points), points, 0.8))
    assert not bool(closed_exact(points * torch.nan, points, 0.8))


def test_rank_is_low_for_coincident_and_collinear_contacts(generator):
    points, normals = triples(generator, 4)
    assert bool((rank_ratio(wrenches(points, normals, 0.5)) > 1e-3).all())
    line = points[:, :1] + torch.arange(3, dtype=torch.float64)[:, None] * points[:, 1:2]
    assert bool((rank_ratio(wrenches(line, normals, 0.5)) < 1e-9).all())
    assert bool((rank_ratio(wrenches(points[:, :1].expand(-1, 3, -1), normals, 0.5)) < 1e-9).all())


def test_a_triple_is_closed_if_and_only_if_internal_forces_lie_inside_its_cones(generator):
    points = torch.randn(200, 3, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(200, 3, 3, generator=generator, dtype=torch.float64)
    normals = unit(unit(points - points.mean(1, keepdim=True)) + 0.3 * noise)
    grid = torch.tensor(list(itertools.product(range(-8, 9), repeat=3)), dtype=torch.float64)
    forces = grid[grid.abs().sum(1) > 0, :, None] * unit(points.roll(-1, 1) - points)[:, None]  # along the sides
    force = unit(forces - forces.roll(1, 2))
    cosine = -(force * normals[:, None]).sum(-1)
    exists = (cosine > torch.tensor(0.6, dtype=torch.float64).atan().cos()).all(-1).any(-1)
    closed = closed_exact(points, normals, 0.6)
    assert bool((closed | ~exists).all())
    assert int((closed & ~exists).sum()) < 0.05 * int(closed.sum())  # the grid is coarse
    assert 50 < int(closed.sum()) < 180
