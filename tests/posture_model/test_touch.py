"""Rolled contacts stay on their tips and in their cones; closing triples are those of a linear
program.
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from scipy.stats import kstest, rayleigh

from torchgrasp import ContactSpec, load_hand
from torchgrasp.posture_model.sample import ROLL, can_close, roll_contacts, sample_configurations


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_rolled_contact_lies_on_the_sphere_along_its_normal(name):
    hand = load_hand(name)
    joints = sample_configurations(hand, 2000, seed=4).joints
    points, normals = roll_contacts(hand, joints, np.random.default_rng(0))
    torch.testing.assert_close(
        points, hand.tip_centres(joints) + hand.tip_radius[:, None] * normals
    )
    axes = hand.fingertips(joints)[1]
    angle = torch.acos((normals * axes).sum(-1))
    assert float(angle.max()) <= math.radians(60) + 1e-9
    # The tilt follows Rayleigh's law, cut off at the cone, in every direction about the axis.
    law = rayleigh(scale=ROLL)
    most = rayleigh(scale=ROLL).cdf(math.radians(60))
    assert kstest(angle.flatten().numpy(), lambda x: law.cdf(x) / most).pvalue > 1e-3
    side = (normals - (normals * axes).sum(-1, keepdim=True) * axes).mean(0)
    assert float(side.norm(dim=-1).max()) < 0.05


def test_a_flat_tip_tilts_and_keeps_its_contact_point():
    hand = load_hand("barrett")
    hand = dataclasses.replace(
        hand, tips=dataclasses.replace(hand.tips, radius=torch.zeros(3, dtype=torch.float64))
    )
    joints = sample_configurations(hand, 200, seed=4).joints
    points, normals = roll_contacts(hand, joints, np.random.default_rng(0))
    middles, axes = hand.fingertips(joints)
    assert torch.equal(points, middles)
    assert (
        math.radians(39)
        < float(torch.acos((normals * axes).sum(-1)).max())
        <= math.radians(40) + 1e-9
    )


def closes(points: np.ndarray, inward: np.ndarray, friction: float, edges: int = 64) -> float:
    """The largest s with balanced forces inside the friction cones and normal forces of at least s,
    which sum to 1.
    """
    columns = []
    for point, n in zip(points - points.mean(0), inward, strict=True):
        first = np.cross(n, np.eye(3)[np.abs(n).argmin()])
        first /= np.linalg.norm(first)
        second = np.cross(n, first)
        turns = 2 * np.pi * np.arange(edges)[:, None] / edges
        forces = n + friction * (np.cos(turns) * first + np.sin(turns) * second)
        columns.append(np.concatenate([forces, np.cross(point, forces) / 0.05], 1))
    a = np.concatenate(columns).T
    sums = np.zeros((3, a.shape[1]))
    for k in range(3):
        sums[k, k * edges : (k + 1) * edges] = 1
    result = linprog(
        np.r_[np.zeros(a.shape[1]), -1],
        A_ub=np.c_[-sums, np.ones(3)],
        b_ub=np.zeros(3),
        A_eq=np.r_[np.c_[a, np.zeros(6)], np.r_[np.ones(a.shape[1]), 0][None]],
        b_eq=np.r_[np.zeros(6), 1],
        bounds=[(0, None)] * (a.shape[1] + 1),
    )
    return result.x[-1] if result.status == 0 else 0.0


def test_eq13_closing_triples_are_those_of_a_linear_program_and_more_contacts_close_by_three(
    generator,
):
    hand = load_hand("barrett")
    friction = ContactSpec().friction
    points, normals = roll_contacts(
        hand, sample_configurations(hand, 3000, seed=6).joints, np.random.default_rng(1)
    )
    closed = can_close(points, normals)
    assert 0.02 < float(closed.double().mean()) < 0.2
    rows = torch.cat([torch.nonzero(closed)[:40, 0], torch.nonzero(~closed)[:200, 0]])
    margin = np.array(
        [closes(points[k].numpy(), normals[k].numpy(), friction) for k in rows.tolist()]
    )
    assert (margin[:40] > 0).all()  # what balances does close
    assert (margin[40:] > 0.02).mean() < 0.02  # and of the others only narrow ones do
    points, normals = torch.randn(2, 300, 5, 3, generator=generator, dtype=torch.float64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    by_three = [
        can_close(points[:, k], normals[:, k])
        for k in map(list, itertools.combinations(range(5), 3))
    ]
    assert torch.equal(can_close(points, normals), torch.stack(by_three).any(0))
    assert (
        0
        < int(can_close(points[:, :4], normals[:, :4]).sum())
        < int(can_close(points, normals).sum())
        < 300
    )
