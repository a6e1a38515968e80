"""Rigid transforms and the virtual frame, against their definitions."""

import pytest
import torch

from torchgrasp.errors import DegenerateContacts
from torchgrasp.geometry.frames import (
    apply,
    degenerate,
    inverse,
    rigid,
    rotate,
    rotation_angle,
    rotation_from_vector,
    skew,
    virtual_frame,
)


def triangles(n: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)


def test_eq15_virtual_frame_is_rigid(generator):
    frame = virtual_frame(triangles(200, generator))
    rotation = frame[:, :3, :3]
    eye = torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), eye)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(200, dtype=torch.float64))
    torch.testing.assert_close(frame[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(200, 4))


def test_eq16_origin_is_the_mean_of_the_contacts(generator):
    points = triangles(50, generator)
    torch.testing.assert_close(virtual_frame(points)[:, :3, 3], (points[:, 0] + points[:, 1] + points[:, 2]) / 3)


def test_eq17_axes_follow_the_contacts(generator):
    points = triangles(50, generator)
    local = apply(inverse(virtual_frame(points)), points)
    torch.testing.assert_close(local[..., 2], torch.zeros_like(local[..., 2]), atol=1e-12, rtol=0)  # z: the plane
    side = local[:, 2] - local[:, 0]
    assert bool((side[:, 0] > 0).all())  # x: from the first to the third
    torch.testing.assert_close(side[:, 1], torch.zeros(50, dtype=torch.float64), atol=1e-12, rtol=0)
    # r_z = (p2 - p1) x r_x, so the second contact lies at negative y of the frame
    assert bool((local[:, 1, 1] < local[:, 0, 1]).all())


def test_virtual_frame_is_equivariant(generator, motion):
    points = triangles(50, generator)
    torch.testing.assert_close(virtual_frame(apply(motion, points)), motion @ virtual_frame(points))


@pytest.mark.parametrize("height", [0.0, 1e-6, 9e-4])
def test_flat_triangles_are_refused(height):
    points = torch.tensor([[[0.0, 0, 0], [0.5, height, 0], [1, 0, 0]]], dtype=torch.float64)
    assert bool(degenerate(points).all())
    with pytest.raises(DegenerateContacts):
        virtual_frame(points)


def test_coincident_contacts_are_degenerate():
    assert bool(degenerate(torch.ones(1, 3, 3)).all())


def test_inverse_and_apply(generator, motion):
    points = triangles(4, generator)
    torch.testing.assert_close(apply(inverse(motion), apply(motion, points)), points)
    torch.testing.assert_close(rotate(motion, points), apply(motion, points) - motion[:3, 3])


def test_rotations(generator):
    v = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    v = v * (torch.rand(100, 1, generator=generator, dtype=torch.float64) * 3.1 / v.norm(dim=1, keepdim=True))
    torch.testing.assert_close(rotation_angle(rotation_from_vector(v)), v.norm(dim=1))
    w = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((skew(v) @ w[..., None])[..., 0], torch.linalg.cross(v, w))
    moved = apply(rigid(rotation_from_vector(v), w), v[:, None])[:, 0]
    torch.testing.assert_close(moved, v + w)  # the axis of a rotation stays
