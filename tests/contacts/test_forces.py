"""Internal forces: balance, friction, scale, against SciPy's solution of the same problem."""

import functools
import math

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from tests.make import near, real, spokes
from torchgrasp.contacts.balance import (
    _search_steps,
    central_forces,
    grasp_map,
    internal_forces,
    least_friction_forces,
    tangential_ratio,
)
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rotation_from_vector
from torchgrasp.geometry.linalg import unit

TURN = rotation_from_vector(real([0.4, -0.9, 0.3]))
FINGERTIPS = pytest.mark.parametrize("fingertips", [3, 4, 5])


def pinch(spread=0.02, half=0.03):
    """Index and middle against the thumb on a cylinder of radius `half` about z."""
    points = real([[half, 0, spread], [half, 0, -spread], [-half, 0, 0.0]])
    return points, real([[1, 0, 0], [1, 0, 0], [-1, 0, 0]])


def tripods(count, seed, fingertips=3):
    """Random contacts on a sphere, opened so that they can balance, with tilted normals."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(2, count, fingertips, 3, generator=generator, dtype=torch.float64)
    angles = torch.arange(fingertips, dtype=torch.float64) * 2 * math.pi / fingertips
    points = 0.04 * unit(spokes(*angles.tolist()) + 0.25 * noise[0])
    return points, unit(points / 0.04 + 0.25 * noise[1])


@functools.cache
def judged(fingertips):
    """Eight tripods, and the least friction that balances each."""
    points, normals = tripods(8, 2, fingertips)
    return (
        points,
        normals,
        [least_ratio(p.numpy(), n.numpy()) for p, n in zip(points, normals, strict=True)],
    )


def least_ratio(points, normals):
    """The least friction (tangent) that balances contacts: bisection over LPs with a fine polygonal
    cone.
    """
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)

    def balances(friction):
        columns = []
        for p, n in zip(points, normals, strict=True):
            t = np.linalg.svd(n[None])[2][1:]
            rays = -n + friction * (np.cos(angles)[:, None] * t[0] + np.sin(angles)[:, None] * t[1])
            columns.append(np.concatenate([rays, np.cross(p, rays)], 1))
        matrix = np.concatenate(columns).T
        f = len(points)
        ones = np.kron(np.eye(f), np.ones(64))  # normal force of each contact
        scaled = np.concatenate([matrix / 0.04, np.ones((1, 64 * f))])
        least = -ones  # each contact presses with at least 2 % of the sum
        answer = linprog(
            np.zeros(64 * f),
            A_ub=least,
            b_ub=-0.02 * np.ones(f),
            A_eq=scaled,
            b_eq=np.eye(7)[6],
            method="highs",
        )
        return answer.status == 0

    low = 0.0
    high = 8.0
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (low, middle) if balances(middle) else (middle, high)
    return high


@FINGERTIPS
def test_internal_forces_span_the_null_space_of_the_grasp_map(fingertips):
    points, _ = tripods(50, 0, fingertips)
    forces = internal_forces(points)
    assert forces.shape == (50, fingertips * (fingertips - 1) // 2, fingertips, 3)
    assert bool((torch.linalg.matrix_rank(forces.flatten(2)) == 3 * fingertips - 6).all())
    torques = torch.linalg.cross(points[:, None].expand_as(forces), forces)
    assert forces.sum(-2).abs().max() < 1e-12
    assert torques.sum(-2).abs().max() < 1e-12
    assert (grasp_map(points)[:, None] @ forces.flatten(2)[..., None]).abs().max() < 1e-12


@FINGERTIPS
def test_least_friction_forces_balance_are_scaled_and_come_nearer_to_the_preferred_ones(fingertips):
    points, normals = tripods(64, 1, fingertips)
    forces = least_friction_forces(points, normals, 5.0)
    good = torch.isfinite(forces).all(-1).all(-1)
    assert good.float().mean() > 0.8
    points = points[good]
    normals = normals[good]
    forces = forces[good]
    assert forces.sum(-2).abs().max() < 1e-9
    assert torch.linalg.cross(points, forces).sum(-2).abs().max() < 1e-9
    push = -(forces * normals).sum(-1)
    assert torch.allclose(push.amax(-1), real(5.0))
    assert (push > 0.05).all()
    points, normals = tripods(60, 3, fingertips)
    wanted = torch.linspace(1.0, 0.4, fingertips, dtype=torch.float64)

    def off(preferred):
        forces = least_friction_forces(points, normals, 1.0, preferred)
        return (-(forces * normals).sum(-1) - wanted).abs().nanmean()

    assert off(wanted[None]) < 0.97 * off(None)
    nothing = torch.zeros(2, 0, fingertips, 3)
    assert least_friction_forces(nothing, nothing).shape == nothing.shape
    assert (
        least_friction_forces(nothing[0], nothing[0], 4.0, nothing[0, ..., 0]).shape
        == nothing.shape[1:]
    )


@FINGERTIPS
def test_least_friction_and_central_forces_agree_with_linear_programmes(fingertips):
    points, normals, oracles = judged(fingertips)
    central = central_forces(points, normals, points.new_ones(8, fingertips), 1e-3)
    found = (
        tangential_ratio(x, normals).amax(-1)
        for x in (least_friction_forces(points, normals, 1.0), central)
    )
    compared = 0
    for oracle, searched, centred in zip(oracles, *found, strict=True):
        if not torch.isfinite(searched):
            assert oracle > 2.0
        elif oracle < 2.0:
            assert oracle - 0.02 <= searched <= oracle + (0.05 if fingertips == 3 else 0.1)
        if oracle < 2.0:
            assert centred == pytest.approx(oracle, abs=0.02)
            compared += 1
    assert compared >= 5


def test_least_friction_forces_of_a_pinch_are_even_turn_with_the_frame_and_need_a_balance():
    points, normals = pinch()
    forces = least_friction_forces(points, normals, 6.0)
    near(-(forces * normals).sum(-1), real([3.0, 3.0, 6.0]), 0.05)
    assert tangential_ratio(forces, normals).max() < 1e-2
    there = least_friction_forces(points @ TURN.T, normals @ TURN.T, 6.0)
    assert (forces @ TURN.T - there).abs().max() < 0.15
    assert torch.isnan(
        least_friction_forces(points, normals[:1].expand(3, 3).contiguous(), 4.0)
    ).all()


def test_normals_of_another_length_are_refused_as_their_forces_would_be_too_small():
    points, normals = pinch()
    for factor in (0.5, 3.0):
        with pytest.raises(BadArgument, match="normals: expected unit vectors"):
            least_friction_forces(points, factor * normals, 6.0)
    unknown = torch.full_like(normals, torch.nan)
    assert torch.isnan(least_friction_forces(points, unknown, 6.0)).all()


def test_search_and_central_forces_agree():
    points, normals = tripods(40, 5)
    searched = tangential_ratio(least_friction_forces(points, normals), normals).amax(-1)
    centred = tangential_ratio(
        central_forces(points, normals, points.new_ones(40, 3), 1e-3), normals
    ).amax(-1)
    good = searched < 2.0
    assert int(good.sum()) > 25
    assert float((centred - searched)[good].max()) < 0.01  # the search also weighs evenness
    assert float((searched - centred)[good].median()) < 0.02


@pytest.mark.parametrize("uneven", [False, True])
def test_least_friction_forces_do_not_depend_on_the_batch(uneven):
    points, normals = tripods(20, 8)
    preferred = points.new_tensor([1.0, 2.0, 3.0]).expand(20, 3) if uneven else None
    together = least_friction_forces(points, normals, 4.0, preferred)
    assert int(torch.isfinite(together).flatten(1).all(1).sum()) > 15
    for k in range(20):
        alone = least_friction_forces(
            points[k], normals[k], 4.0, None if preferred is None else preferred[k]
        )
        torch.testing.assert_close(alone, together[k], rtol=0, atol=1e-9, equal_nan=True)


def test_least_friction_forces_of_five_fingers_follow_the_preferred_ones():
    points = real(
        [*([0.03, y, z] for y in (-0.02, 0.02) for z in (-0.02, 0.02)), [-0.03, 0.0, 0.0]]
    )
    normals = real([[1.0, 0, 0]] * 4 + [[-1.0, 0, 0]])
    push = -(least_friction_forces(points, normals, 8.0) * normals).sum(-1)
    near(push, real([2.0, 2, 2, 2, 8]), 0.01)
    uneven = real([0.1, 0.4, 0.4, 0.1, 1.0])
    push = -(least_friction_forces(points, normals, 8.0, uneven) * normals).sum(-1)
    assert float(push[1]) == pytest.approx(float(push[2]), abs=0.05)
    assert float(push[1]) > 2 * float(push[0])


@pytest.mark.parametrize("fingertips", [4, 5])
def test_forces_of_more_contacts_turn_with_the_frame(fingertips):
    points, normals = tripods(20, 6, fingertips)
    here = least_friction_forces(points, normals, 4.0)
    good = torch.isfinite(here).flatten(1).all(1)
    assert int(good.sum()) > 15
    there = least_friction_forces(points @ TURN.T, normals @ TURN.T, 4.0)
    near((here @ TURN.T)[good], there[good], 1e-6)
    near(least_friction_forces(points[7], normals[7], 4.0), here[7], 1e-9)


def test_forces_of_more_contacts_are_nan_without_a_balance_and_ignore_the_default_device():
    points, normals = tripods(3, 7, 4)
    alone = least_friction_forces(points, normals)
    assert bool(torch.isfinite(alone).all())
    normals[0] = normals[0, :1]
    points[2, 1] = torch.nan
    forces = least_friction_forces(points, normals)
    assert bool(torch.isnan(forces[[0, 2]]).all())
    torch.testing.assert_close(forces[1], alone[1])
    points, normals = tripods(1, 8)
    here = least_friction_forces(points, normals)
    _search_steps.cache_clear()
    with torch.device("meta"):
        there = least_friction_forces(points, normals)
    near(there, here, 0)
