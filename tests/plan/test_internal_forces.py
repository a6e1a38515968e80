"""Internal forces: balance, friction, scale, against SciPy's solution of the same problem."""

import math

import numpy as np
import torch
from scipy.optimize import linprog

from torchgrasp.frames import rotation_from_vector
from torchgrasp.plan.internal_forces import internal_forces, least_friction_forces, tangential_ratio


def pinch(spread=0.02, half=0.03):
    """Index and middle against the thumb on a cylinder of radius `half` about z."""
    points = torch.tensor([[half, 0, spread], [half, 0, -spread], [-half, 0, 0.0]], dtype=torch.float64)
    normals = torch.tensor([[1, 0, 0], [1, 0, 0], [-1, 0, 0]], dtype=torch.float64)
    return points, normals


def tripods(count, seed):
    """Random contacts on a sphere, opened so that they can balance, with tilted normals."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(2, count, 3, 3, generator=generator, dtype=torch.float64)
    angles = torch.tensor([0.0, 2 * math.pi / 3, 4 * math.pi / 3], dtype=torch.float64)
    ring = torch.stack([angles.cos(), angles.sin(), torch.zeros(3, dtype=torch.float64)], -1)
    points = ring + 0.25 * noise[0]
    points = 0.04 * points / points.norm(dim=-1, keepdim=True)
    outward = points / 0.04 + 0.25 * noise[1]
    return points, outward / outward.norm(dim=-1, keepdim=True)


def least_ratio(points, normals):
    """The least friction (tangent) that balances three contacts: bisection over LPs with a fine polygonal cone."""
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)

    def balances(friction):
        columns = []
        for p, n in zip(points, normals, strict=True):
            t = np.linalg.svd(n[None])[2][1:]
            rays = -n + friction * (np.cos(angles)[:, None] * t[0] + np.sin(angles)[:, None] * t[1])
            columns += [np.concatenate([r, np.cross(p, r)]) for r in rays]
        matrix = np.stack(columns, 1)
        ones = np.kron(np.eye(3), np.ones(64))  # normal force of each contact
        unit = np.concatenate([matrix / 0.04, np.ones((1, 192))])
        least = -ones  # each contact presses with at least 2 % of the sum
        answer = linprog(
            np.zeros(192), A_ub=least, b_ub=-0.02 * np.ones(3), A_eq=unit, b_eq=np.eye(7)[6], method="highs"
        )
        return answer.status == 0

    low, high = 0.0, 8.0
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (low, middle) if balances(middle) else (middle, high)
    return high


def test_internal_forces_balance():
    points, _ = tripods(50, 0)
    forces = internal_forces(points)
    torques = torch.linalg.cross(points[:, None].expand_as(forces), forces)
    assert forces.sum(-2).abs().max() < 1e-12
    assert torques.sum(-2).abs().max() < 1e-12


def test_balanced_forces_are_in_equilibrium_and_scaled():
    points, normals = tripods(64, 1)
    forces = least_friction_forces(points, normals, 5.0)
    good = torch.isfinite(forces).all(-1).all(-1)
    assert good.float().mean() > 0.8
    points, normals, forces = points[good], normals[good], forces[good]
    assert forces.sum(-2).abs().max() < 1e-9
    assert torch.linalg.cross(points, forces).sum(-2).abs().max() < 1e-9
    push = -(forces * normals).sum(-1)
    assert torch.allclose(push.amax(-1), torch.tensor(5.0, dtype=torch.float64))
    assert (push > 0).all()


def test_least_friction_against_linear_programmes():
    points, normals = tripods(12, 2)
    forces = least_friction_forces(points, normals, 1.0)
    ratios = tangential_ratio(forces, normals).amax(-1)
    for k in range(len(points)):
        oracle = least_ratio(points[k].numpy(), normals[k].numpy())
        if not torch.isfinite(ratios[k]):
            assert oracle > 2.0
        elif oracle < 2.0:
            assert ratios[k] <= oracle + 0.05


def test_thumb_is_the_sum_of_the_others_and_they_are_even():
    points, normals = pinch()
    forces = least_friction_forces(points, normals, 6.0)
    push = -(forces * normals).sum(-1)
    assert torch.allclose(push, torch.tensor([3.0, 3.0, 6.0], dtype=torch.float64), atol=0.05)
    assert tangential_ratio(forces, normals).max() < 1e-2


def test_forces_turn_with_the_frame():
    points, normals = pinch()
    rotation = rotation_from_vector(torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64))
    here = least_friction_forces(points, normals, 4.0) @ rotation.T
    there = least_friction_forces(points @ rotation.T, normals @ rotation.T, 4.0)
    assert (here - there).abs().max() < 0.1


def test_contacts_that_cannot_balance_are_nan():
    points, normals = pinch()
    assert torch.isnan(least_friction_forces(points, normals[:1].expand(3, 3).contiguous(), 4.0)).all()
