"""Posture library: it finds its own postures again, in any order and place, and prefers clear ones."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.make import touched_contacts
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.clearance import CLEARANCE, MILLIMETRE, CollisionWorld, collision_cost
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures
from torchgrasp.values import Contacts

NOTHING = SignedDistanceField(torch.zeros(3, dtype=torch.float64), 1.0, torch.ones(2, 2, 2, dtype=torch.float64))
"""The field of an object a metre away."""


@pytest.fixture(scope="module", params=[("allegro", 3), ("barrett", 3), ("allegro", 4)], ids=str)
def library(request):
    return PostureLibrary.of(load_hand(*request.param), 400, seed=3)


@pytest.fixture
def poses(generator):
    turn = rotation_from_vector(torch.randn(12, 3, generator=generator, dtype=torch.float64))
    return rigid(turn, torch.randn(12, 3, generator=generator, dtype=torch.float64))


def touched(library: PostureLibrary, poses: torch.Tensor) -> Contacts:
    """Contacts that the library's first postures touch at these poses."""
    return touched_contacts(library.hand, library.joints[: len(poses)], poses)


def test_eq24_postures_of_the_library_are_found_and_placed(library, poses):
    seeds = nearest_postures(library, touched(library, poses), CollisionWorld(NOTHING), n_seeds=3)
    assert seeds.row.tolist() == [i for i in range(12) for _ in range(3)]
    best = seeds[torch.arange(0, 36, 3)]
    torch.testing.assert_close(best.joints, library.joints[:12])
    torch.testing.assert_close(best.obj_from_hand, poses)
    assert best.permutation.tolist() == [list(range(len(library.hand.tips)))] * 12
    assert float(best.tip_error.max()) < 1e-9
    assert float(best.energy.max()) < 1e-3  # rounding of single precision
    assert bool((best.energy <= seeds.energy.view(12, 3).T).all())


@pytest.mark.promise("N7")
def test_the_order_of_the_contacts_does_not_matter(library, poses):
    contacts = touched(library, poses)
    order = torch.arange(contacts.fingertips).roll(1)
    turned = Contacts(contacts.points[:, order], contacts.normals[:, order])
    seeds = nearest_postures(library, turned, CollisionWorld(NOTHING), n_seeds=1)
    torch.testing.assert_close(seeds.joints, library.joints[:12])
    assert seeds.permutation.tolist() == [order.argsort().tolist()] * 12  # finger i takes the contact that was its own


def test_a_table_moves_clear_postures_to_the_front(library, poses):
    contacts = touched(library, poses)
    table, hand = float(contacts.points[..., 2].min()) - 0.02, library.hand

    def overlap(world: CollisionWorld) -> torch.Tensor:
        best = nearest_postures(library, contacts, world, n_seeds=1)
        centres = apply(best.obj_from_hand, hand.sphere_centres(best.joints))
        return collision_cost(centres, hand.collision_spheres, CollisionWorld(NOTHING, table))

    without, aware = overlap(CollisionWorld(NOTHING)), overlap(CollisionWorld(NOTHING, table))
    assert float(aware.sum()) <= float(without.sum())


def test_collision_cost_is_the_sum_of_squared_deficits(library, poses):
    spheres = library.hand.collision_spheres
    centres = apply(poses, library.hand.sphere_centres(library.joints[:12]))
    nothing = torch.zeros(12, dtype=torch.float64)
    torch.testing.assert_close(collision_cost(centres, spheres, CollisionWorld(NOTHING, -10.0)), nothing)
    height, radius = centres[..., 2].numpy(), spheres.radius.numpy()
    deficit = 0.1 + np.where(spheres.touching.numpy(), 0.0, CLEARANCE) - (height - radius)
    expected = (np.maximum(deficit / MILLIMETRE, 0) ** 2).sum(1)
    cost = collision_cost(centres, spheres, CollisionWorld(NOTHING, 0.1))
    torch.testing.assert_close(cost, torch.tensor(expected, dtype=torch.float64))


def test_degenerate_triples_have_no_seeds_and_same_seed_same_bits(library, poses):
    contacts = touched(library, poses)
    line = torch.arange(contacts.fingertips)[:, None] * torch.tensor([0.1, 0, 0], dtype=torch.float64)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(line)
    points, normals = contacts.points.clone(), contacts.normals.clone()
    points[4], normals[4] = line, up
    mixed = Contacts(points, normals)
    seeds = nearest_postures(library, mixed, CollisionWorld(NOTHING), n_seeds=2)
    assert 4 not in seeds.row.tolist() and len(seeds) == 22
    same = PostureLibrary.of(library.hand, 400, seed=3)
    again = nearest_postures(same, mixed, CollisionWorld(NOTHING), n_seeds=2)
    assert torch.equal(seeds.joints, again.joints) and torch.equal(seeds.obj_from_hand, again.obj_from_hand)
    assert len(nearest_postures(library, mixed[:0], CollisionWorld(NOTHING))) == 0
    with pytest.raises(BadArgument, match="n_seeds"):
        nearest_postures(library, mixed, CollisionWorld(NOTHING), n_seeds=0)
    more = Contacts(*(torch.cat([x, x[:, :1]], 1) for x in (points, normals)))
    with pytest.raises(BadArgument, match="one for each fingertip"):
        nearest_postures(library, more, CollisionWorld(NOTHING))


def test_a_small_library_gives_no_more_seeds_than_it_has(poses):
    library = PostureLibrary.of(load_hand("barrett"), 2, seed=3)
    contacts = touched(library, poses[:2])
    assert len(nearest_postures(library, contacts, CollisionWorld(NOTHING), n_seeds=12)) == 24
    with pytest.raises(BadArgument, match=r"n_seeds: expected a whole number in \[1, 12\], got 13"):
        nearest_postures(library, contacts, CollisionWorld(NOTHING), n_seeds=13)


def test_library_is_drawn_once_for_a_hand():
    hand = load_hand("barrett")
    first = PostureLibrary.of(hand, 50, seed=3)
    assert PostureLibrary.of(hand, 50, seed=3) is first
    assert PostureLibrary.of(hand, 50, seed=4) is not first
    narrow = dataclasses.replace(hand, actuated=dataclasses.replace(hand.actuated, upper=0.5 * hand.upper))
    changed = PostureLibrary.of(narrow, 50, seed=3)
    assert bool((changed.joints <= 0.5 * hand.upper).all()) and not bool((first.joints <= 0.5 * hand.upper).all())
