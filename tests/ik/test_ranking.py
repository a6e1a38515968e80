"""The order of candidates: ranks within groups, and the friction that centred forces need."""

import math

import torch

from tests.make import near, real, spokes
from torchgrasp.foundation.base import rank_in_group
from torchgrasp.ik.candidates import centred_friction
from torchgrasp.values.planning import Contacts


def test_rank_in_group_against_brute_force(generator):
    cost = torch.randint(0, 40, (200,), generator=generator).double()  # with ties
    group = torch.randint(0, 30, (200,), generator=generator)
    place = torch.zeros(200, dtype=torch.int64)
    counts = {}
    for i in sorted(range(200), key=lambda i: (float(cost[i]), i)):
        place[i] = counts.get(int(group[i]), 0)
        counts[int(group[i])] = int(place[i]) + 1
    assert torch.equal(rank_in_group(group, cost), place)
    assert len(rank_in_group(group[:0], cost[:0])) == 0


def test_centred_friction_is_the_tangent_of_the_tilt():
    radial = spokes(0.0, 2 * math.pi / 3, 4 * math.pi / 3)
    for tilt in (0.0, 0.3):
        normals = math.cos(tilt) * radial + math.sin(tilt) * real([0.0, 0.0, 1.0])
        near(centred_friction(Contacts(0.03 * radial, normals)), real([math.tan(tilt)]), 1e-6)
