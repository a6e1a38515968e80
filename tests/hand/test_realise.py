"""Choosing, assigning and ranking of guesses."""

import math

import torch

from torchgrasp.hand.check import Findings
from torchgrasp.hand.rank import score, tangential_ratio
from torchgrasp.hand.realise import assign, best_rows
from torchgrasp.values import Contacts, GraspGuess


def test_best_rows_keeps_few_of_each_group(generator):
    badness = torch.rand(200, generator=generator)
    group = torch.randint(0, 30, (200,), generator=generator)
    kept = best_rows(badness, group, most=40, each=2)
    assert len(kept) == 40
    assert torch.equal(badness[kept], badness[kept].sort().values)
    assert int(torch.bincount(group[kept]).max()) <= 2
    # brute force: walk in order and take while the group has room
    taken, room = [], {}
    for i in badness.argsort().tolist():
        g = int(group[i])
        if room.get(g, 0) < 2 and len(taken) < 40:
            taken.append(i)
            room[g] = room.get(g, 0) + 1
    assert kept.tolist() == taken


def test_best_rows_of_nothing():
    assert len(best_rows(torch.zeros(0), torch.zeros(0, dtype=torch.int64), 5, 2)) == 0


def test_assign_gives_finger_i_its_contact(generator):
    points = torch.rand(4, 3, 3, generator=generator, dtype=torch.float64)
    flat = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    permutation = torch.tensor([[2, 0, 1], [0, 1, 2]])
    guess = GraspGuess(
        torch.zeros(2, 4),
        torch.eye(4).expand(2, 4, 4),
        torch.tensor([3, 1]),
        permutation,
        torch.zeros(2),
        torch.zeros(2, 3),
    )
    taken = assign(Contacts(points, -points, flat, flat), guess)
    torch.testing.assert_close(taken.points[0, 0], points[3, 2])
    torch.testing.assert_close(taken.normals[0, 2], -points[3, 1])
    torch.testing.assert_close(taken.std_m[1], flat[1])


def triple(height: float = 0.0, tilt: float = 0.0, std: float = 0.001) -> Contacts:
    """Three contacts on a vertical cylinder at 120 degrees, normals tilted upward."""
    angle = torch.arange(3, dtype=torch.float64) * 2 * math.pi / 3
    radial = torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    normals = torch.cos(torch.tensor(tilt)) * radial + torch.sin(torch.tensor(tilt)) * up
    spread = torch.full((1, 3), std, dtype=torch.float64)
    return Contacts((0.03 * radial + height * up)[None], normals[None], spread, spread)


def test_tangential_ratio_is_the_tangent_of_the_tilt():
    torch.testing.assert_close(
        tangential_ratio(triple(tilt=0.0)), torch.zeros(1, dtype=torch.float64), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        tangential_ratio(triple(tilt=0.3)), torch.tensor([0.3], dtype=torch.float64).tan(), atol=1e-6, rtol=0
    )


def test_certain_central_untilted_grasps_rank_first():
    zeros = torch.zeros(1, 3, dtype=torch.float64)
    found = Findings(zeros, zeros, torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.int64))
    center = torch.zeros(3, dtype=torch.float64)
    best = score(triple(), found, center)
    for worse in (triple(height=0.03), triple(tilt=0.5), triple(std=0.008)):
        assert float(score(worse, found, center)) < float(best)
