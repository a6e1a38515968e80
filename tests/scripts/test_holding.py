"""Least forces by statics, beside closed forms."""

import math

import pytest
import torch
from benchmarks.close.holding import EDGES, least_grip

PINCH = torch.tensor([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, -0.03, 0.0]]).double()
UP = torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]).double()


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_least_grip_of_opposing_fingers_is_the_weight_over_the_friction(friction):
    normals = PINCH / 0.03
    forces = least_grip(PINCH, normals, UP, friction)
    assert forces is not None and torch.allclose(forces.sum(0), UP[:3], atol=1e-8)
    total = float(-(forces * normals).sum())
    assert 2.0 / friction <= total * 1.0000001 <= 2.0 / friction / math.cos(math.pi / EDGES) * 1.0000001


def test_least_grip_is_none_for_fingers_on_one_side_and_for_weak_drives():
    normals = torch.tensor([1.0, 0.0, 0.0]).double().expand(4, 3)
    assert least_grip(PINCH, normals, UP, 0.8) is None
    outward = PINCH / 0.03
    for effort, held in ((0.7, True), (0.6, False)):  # each finger has to push with 0.625 N
        torques = outward[:, None] / effort * torch.eye(4).double()[:, :, None]
        assert (least_grip(PINCH, outward, UP, 0.8, torques) is not None) is held
