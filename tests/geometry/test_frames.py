"""Rigid transforms and the virtual frame, against their definitions."""

import pytest
import torch

from tests.make import near, real
from torchgrasp.foundation.errors import DegenerateContacts
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


def test_eq15_to_eq17_virtual_frame_is_rigid_at_the_mean_along_the_contacts_and_equivariant(
    generator, motion
):
    frame = virtual_frame(triangles(200, generator))
    rotation = frame[:, :3, :3]
    eye = torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), eye)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(200, dtype=torch.float64))
    torch.testing.assert_close(frame[:, 3], real([0.0, 0, 0, 1]).expand(200, 4))
    points = triangles(50, generator)
    torch.testing.assert_close(
        virtual_frame(points)[:, :3, 3], (points[:, 0] + points[:, 1] + points[:, 2]) / 3
    )
    local = apply(inverse(virtual_frame(points)), points)
    near(local[..., 2], torch.zeros_like(local[..., 2]), 1e-12)  # z: the plane
    side = local[:, 2] - local[:, 0]
    assert bool((side[:, 0] > 0).all())  # x: from the first to the third
    near(side[:, 1], torch.zeros(50, dtype=torch.float64), 1e-12)
    # r_z = (p2 - p1) x r_x, so the second contact lies at negative y of the frame
    assert bool((local[:, 1, 1] < local[:, 0, 1]).all())
    torch.testing.assert_close(virtual_frame(apply(motion, points)), motion @ virtual_frame(points))


@pytest.mark.parametrize("height", [0.0, 1e-6, 9e-4])
def test_flat_triangles_and_coincident_contacts_are_degenerate(height):
    points = real([[[0.0, 0, 0], [0.5, height, 0], [1, 0, 0]]])
    assert bool(degenerate(points).all())
    with pytest.raises(DegenerateContacts):
        virtual_frame(points)
    assert bool(degenerate(torch.ones(1, 3, 3)).all())


def test_rigid_motions_and_rotations(generator, motion):
    points = triangles(4, generator)
    torch.testing.assert_close(apply(inverse(motion), apply(motion, points)), points)
    torch.testing.assert_close(rotate(motion, points), apply(motion, points) - motion[:3, 3])
    v = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    v = v * (
        torch.rand(100, 1, generator=generator, dtype=torch.float64)
        * 3.1
        / v.norm(dim=1, keepdim=True)
    )
    torch.testing.assert_close(rotation_angle(rotation_from_vector(v)), v.norm(dim=1))
    w = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((skew(v) @ w[..., None])[..., 0], torch.linalg.cross(v, w))
    moved = apply(rigid(rotation_from_vector(v), w), v[:, None])[:, 0]
    torch.testing.assert_close(moved, v + w)  # the axis of a rotation stays
