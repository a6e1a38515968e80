"""Nearest postures: a set finds its own members again, in any order and place, and prefers those that are clear."""

import pytest
import torch

from torchgrasp.errors import BadArgument
from torchgrasp.frames import apply, rigid, rotate, rotation_from_vector
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.clearance import CLEARANCE, MILLIMETRE, CollisionWorld, collision_cost
from torchgrasp.ik.posture_library import PostureLibrary, nearest_postures
from torchgrasp.ik.sdf import SignedDistanceField
from torchgrasp.values import Contacts

NOTHING = SignedDistanceField(torch.zeros(3, dtype=torch.float64), 1.0, torch.ones(2, 2, 2, dtype=torch.float64))
"""The field of an object a metre away."""


@pytest.fixture(scope="module", params=["allegro", "barrett"])
def postures(request):
    return PostureLibrary.of(load_hand(request.param), 400, seed=3)


@pytest.fixture
def poses(generator):
    turn = rotation_from_vector(torch.randn(12, 3, generator=generator, dtype=torch.float64))
    return rigid(turn, torch.randn(12, 3, generator=generator, dtype=torch.float64))


def touched(postures: PostureLibrary, poses: torch.Tensor) -> Contacts:
    """Contacts that the first postures touch with the middle of their pads at these poses."""
    hand, joints = postures.hand, postures.joints[: len(poses)]
    outward = -rotate(poses, hand.fingertips(joints)[1])
    points = apply(poses, hand.tip_centres(joints)) - hand.tip_radius[:, None] * outward
    return Contacts(points, outward)


def test_eq24_members_of_the_set_are_found_and_placed(postures, poses):
    found = nearest_postures(touched(postures, poses), postures, CollisionWorld(NOTHING, None), n_seeds=3)
    assert found.row.tolist() == [i for i in range(12) for _ in range(3)]
    best = found[torch.arange(0, 36, 3)]
    torch.testing.assert_close(best.joints, postures.joints[:12])
    torch.testing.assert_close(best.obj_from_hand, poses)
    assert best.permutation.tolist() == [[0, 1, 2]] * 12
    assert float(best.tip_error.max()) < 1e-9
    assert float(best.energy.max()) < 1e-3  # rounding of single precision
    assert bool((best.energy <= found.energy.view(12, 3).T).all())


def test_the_order_of_the_contacts_does_not_matter(postures, poses):
    contacts, order = touched(postures, poses), [2, 0, 1]
    turned = Contacts(contacts.points[:, order], contacts.normals[:, order])
    found = nearest_postures(turned, postures, CollisionWorld(NOTHING, None), n_seeds=1)
    torch.testing.assert_close(found.joints, postures.joints[:12])
    assert found.permutation.tolist() == [[1, 2, 0]] * 12  # finger i takes the contact that was its own


def test_a_table_moves_clear_postures_to_the_front(postures, poses):
    contacts = touched(postures, poses)
    table = float(contacts.points[..., 2].min()) - 0.02
    hand, cover = postures.hand, postures.hand.collision_spheres

    def overlap(world: CollisionWorld) -> torch.Tensor:
        best = nearest_postures(contacts, postures, world, n_seeds=1)
        spheres = apply(best.obj_from_hand, hand.sphere_centres(best.joints))
        return collision_cost(spheres, cover, CollisionWorld(NOTHING, table))

    without, aware = overlap(CollisionWorld(NOTHING, None)), overlap(CollisionWorld(NOTHING, table))
    assert float(aware.sum()) <= float(without.sum())


def test_crowding_is_the_sum_of_squared_lacks(postures, poses):
    hand, cover = postures.hand, postures.hand.collision_spheres
    spheres = apply(poses, hand.sphere_centres(postures.joints[:12]))
    nothing = torch.zeros(12, dtype=torch.float64)
    torch.testing.assert_close(collision_cost(spheres, cover, CollisionWorld(NOTHING, -10.0)), nothing)
    wanted = []
    for centres in spheres.tolist():
        total = 0.0
        for (_, _, z), radius, touches in zip(centres, cover.radius.tolist(), cover.touching.tolist(), strict=True):
            lack = 0.1 + (0 if touches else CLEARANCE) - (z - radius)
            total += max(0.0, lack / MILLIMETRE) ** 2
        wanted.append(total)
    torch.testing.assert_close(
        collision_cost(spheres, cover, CollisionWorld(NOTHING, 0.1)), torch.tensor(wanted, dtype=torch.float64)
    )


def test_degenerate_triples_have_no_guess_and_same_seed_same_bits(postures, poses):
    contacts = touched(postures, poses)
    line = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], dtype=torch.float64)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(3, 3)
    points, normals = contacts.points.clone(), contacts.normals.clone()
    points[4], normals[4] = line, up
    mixed = Contacts(points, normals)
    found = nearest_postures(mixed, postures, CollisionWorld(NOTHING, None), n_seeds=2)
    assert 4 not in found.row.tolist() and len(found) == 22
    again = nearest_postures(
        mixed, PostureLibrary.of(postures.hand, 400, seed=3), CollisionWorld(NOTHING, None), n_seeds=2
    )
    assert torch.equal(found.joints, again.joints) and torch.equal(found.obj_from_hand, again.obj_from_hand)
    assert len(nearest_postures(mixed[:0], postures, CollisionWorld(NOTHING, None))) == 0
    with pytest.raises(BadArgument, match="n_seeds"):
        nearest_postures(mixed, postures, CollisionWorld(NOTHING, None), n_seeds=0)
