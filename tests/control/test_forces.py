"""Desired forces and their covariance."""

import pytest
import torch

from torchgrasp.control.forces import desired_forces
from torchgrasp.control.law import force_covariance

POINTS = torch.tensor([[0.03, 0, 0.02], [0.03, 0, -0.02], [-0.03, 0, 0]], dtype=torch.float64)
NORMALS = torch.tensor([[1.0, 0, 0], [1, 0, 0], [-1, 0, 0]], dtype=torch.float64)


def test_forces_are_balanced_where_they_can_be_and_press_along_the_normals_elsewhere():
    torch.testing.assert_close(desired_forces(POINTS, NORMALS, 6.0).sum(0), torch.zeros(3, dtype=torch.float64))
    alike = NORMALS[:1].expand(3, 3).contiguous()
    torch.testing.assert_close(desired_forces(POINTS, alike, 6.0), -6.0 * alike)


def test_eq28_force_covariance_grows_with_the_force():
    forces = torch.tensor([3.0, 3.0, 6.0], dtype=torch.float64)[:, None] * -NORMALS
    covariance = force_covariance(forces, NORMALS)
    assert covariance[:, 0, 0].tolist() == pytest.approx([0.09 + 0.09, 0.09 + 0.09, 0.09 + 0.36])
    assert covariance[:, 1, 1].tolist() == pytest.approx([0.09] * 3)
    assert torch.linalg.eigvalsh(covariance).min() > 0
