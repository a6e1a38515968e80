"""Seeds: postures of the library, and of the learned model, are found again for the contacts that
they touch.
"""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from tests.make import near, real, touched_contacts
from torchgrasp import Contacts, Hand, fit_mixture, load_hand
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid, rotate, rotation_from_vector, virtual_frame
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.ik.clearance import CLEARANCE, MILLIMETRE, CollisionWorld, collision_cost
from torchgrasp.ik.seeds import SEEDS, PostureLibrary, nearest_postures, query_mixture
from torchgrasp.posture_model.mixture import (
    DEFAULT_ENERGY,
    PERMUTATIONS,
    GraspMixture,
    load_mixture,
)
from torchgrasp.posture_model.sample import HandSamples, sample_configurations

NOTHING = SignedDistanceField(
    torch.zeros(3, dtype=torch.float64), 1.0, torch.ones(2, 2, 2, dtype=torch.float64)
)
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
    assert (
        seeds.permutation.tolist() == [order.argsort().tolist()] * 12
    )  # finger i takes the contact that was its own


def test_a_table_moves_clear_postures_to_the_front(library, poses):
    contacts = touched(library, poses)
    table = float(contacts.points[..., 2].min()) - 0.02
    hand = library.hand

    def overlap(world: CollisionWorld) -> torch.Tensor:
        best = nearest_postures(library, contacts, world, n_seeds=1)
        centres = apply(best.obj_from_hand, hand.sphere_centres(best.joints))
        return collision_cost(centres, hand.collision_spheres, CollisionWorld(NOTHING, table))

    without = overlap(CollisionWorld(NOTHING))
    aware = overlap(CollisionWorld(NOTHING, table))
    assert float(aware.sum()) <= float(without.sum())


def test_collision_cost_is_the_sum_of_squared_deficits(library, poses):
    spheres = library.hand.collision_spheres
    centres = apply(poses, library.hand.sphere_centres(library.joints[:12]))
    nothing = torch.zeros(12, dtype=torch.float64)
    torch.testing.assert_close(
        collision_cost(centres, spheres, CollisionWorld(NOTHING, -10.0)), nothing
    )
    height = centres[..., 2].numpy()
    radius = spheres.radius.numpy()
    deficit = 0.1 + np.where(spheres.touching.numpy(), 0.0, CLEARANCE) - (height - radius)
    expected = (np.maximum(deficit / MILLIMETRE, 0) ** 2).sum(1)
    cost = collision_cost(centres, spheres, CollisionWorld(NOTHING, 0.1))
    torch.testing.assert_close(cost, real(expected))


def test_degenerate_triples_have_no_seeds_and_same_seed_same_bits(library, poses):
    contacts = touched(library, poses)
    line = torch.arange(contacts.fingertips)[:, None] * real([0.1, 0, 0])
    up = real([0.0, 0, 1]).expand_as(line)
    points = contacts.points.clone()
    normals = contacts.normals.clone()
    points[4] = line
    normals[4] = up
    mixed = Contacts(points, normals)
    seeds = nearest_postures(library, mixed, CollisionWorld(NOTHING), n_seeds=2)
    assert 4 not in seeds.row.tolist() and len(seeds) == 22
    same = PostureLibrary.of(library.hand, 400, seed=3)
    again = nearest_postures(same, mixed, CollisionWorld(NOTHING), n_seeds=2)
    assert torch.equal(seeds.joints, again.joints) and torch.equal(
        seeds.obj_from_hand, again.obj_from_hand
    )
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
    narrow = dataclasses.replace(
        hand, actuated=dataclasses.replace(hand.actuated, upper=0.5 * hand.upper)
    )
    changed = PostureLibrary.of(narrow, 50, seed=3)
    assert bool((changed.joints <= 0.5 * hand.upper).all()) and not bool(
        (first.joints <= 0.5 * hand.upper).all()
    )


@functools.cache
def barrett() -> tuple[Hand, HandSamples, GraspMixture]:
    hand = load_hand("barrett")
    samples = sample_configurations(hand, 6000, seed=1)
    return hand, samples, fit_mixture(samples[:5000], components=12, iterations=40)


def test_eq24_frames_of_tips_and_contacts_coincide_in_any_frame_and_hopeless_rows_have_no_seeds(
    motion,
):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[5000:5050], motion)
    seeds = query_mixture(hand, contacts, mixture)
    tips = apply(seeds.obj_from_hand, hand.fingertips(seeds.joints)[0])
    wanted = contacts.points[seeds.row[:, None], seeds.permutation]
    near(virtual_frame(tips), virtual_frame(wanted), 1e-9)
    torch.testing.assert_close(seeds.tip_error, (tips - wanted).norm(dim=-1))
    first = query_mixture(
        hand, touched_contacts(hand, samples.joints[5000:5020], torch.eye(4).double()), mixture
    )
    moved = query_mixture(hand, touched_contacts(hand, samples.joints[5000:5020], motion), mixture)
    # Equal up to rounding; the order of equal errors may differ.
    torch.testing.assert_close(moved.joints.sum(), first.joints.sum(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(moved.tip_error.sum(), first.tip_error.sum(), rtol=1e-6, atol=1e-6)
    contacts = touched_contacts(hand, samples.joints[5000:5004], motion)
    points = contacts.points.clone()
    points[1] = points[1, 0]
    points[2] = 1 + 10 * (points[2] - points[2].mean(0))  # a triangle ten times as large
    seeds = query_mixture(hand, dataclasses.replace(contacts, points=points), mixture)
    assert not set(seeds.row.tolist()) & {1, 2}
    assert {0, 3} <= set(seeds.row.tolist())


def test_postures_are_found_again(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[5000:5300], motion)
    seeds = query_mixture(hand, contacts, mixture)
    own = (seeds.permutation == torch.arange(3)).all(-1)
    assert len(seeds.row[own].unique()) >= 285  # the 99 % threshold
    least = torch.full((300,), 9.0, dtype=torch.float64)
    least = least.scatter_reduce(0, seeds.row[own], seeds.tip_error[own].amax(-1), "amin")
    assert float(least.median()) < 0.02
    assert bool(((seeds.joints >= hand.lower) & (seeds.joints <= hand.upper)).all())
    assert bool((seeds.energy < DEFAULT_ENERGY).all())


@pytest.mark.promise("N6")
def test_rows_are_in_order_and_the_wrong_side_comes_last(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[5000:5100], motion)
    seeds = query_mixture(hand, contacts, mixture, n_seeds=3)
    assert bool((seeds.row.diff() >= 0).all())
    normals = rotate(seeds.obj_from_hand, hand.fingertips(seeds.joints)[1])
    side = (normals * contacts.normals[seeds.row[:, None], seeds.permutation]).sum(-1).mean(-1)
    wrong = (side > SEEDS.wrong_side).long()
    same_row = seeds.row.diff() == 0
    assert bool((wrong.diff()[same_row] >= 0).all())
    # All six assignments are asked, each with three seeds or, out of reach, none.
    counts = torch.stack(
        [(seeds.permutation == torch.tensor(p)).all(-1).sum() for p in PERMUTATIONS]
    )
    assert int(counts.sum()) == len(seeds)
    assert bool((counts > 0).all())


def test_bad_arguments_and_a_mixture_of_other_limits_fingers_or_fingertips_are_refused():
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[:2], torch.eye(4).double())
    with pytest.raises(BadArgument, match=r"n_seeds: expected .*got 0"):
        query_mixture(hand, contacts, mixture, n_seeds=0)
    with pytest.raises(BadArgument, match=r"max_energy: expected .*got nan"):
        query_mixture(hand, contacts, mixture, max_energy=float("nan"))
    with pytest.raises(BadArgument, match=r"mixture: expected .*got joints"):
        query_mixture(load_hand("allegro"), contacts, mixture)
    others = [
        dataclasses.replace(
            hand, actuated=dataclasses.replace(hand.actuated, upper=hand.upper - 0.01)
        ),
        dataclasses.replace(
            hand, tips=dataclasses.replace(hand.tips, contact=hand.tips.contact + 1e-4)
        ),
        dataclasses.replace(
            hand, tips=dataclasses.replace(hand.tips, normal=hand.tips.normal.roll(1, 1))
        ),
        dataclasses.replace(
            hand,
            actuated=dataclasses.replace(hand.actuated, coupling=hand.actuated.coupling * 1.001),
        ),
    ]
    for other in others:
        with pytest.raises(
            BadArgument, match=r"mixture: expected .*train it anew, got a model of hand 'barrett'"
        ):
            query_mixture(other, contacts, mixture)
    spoilt = dataclasses.replace(mixture, meta=mixture.meta | {"hand_codes": "one two"})
    with pytest.raises(BadArgument, match=r"mixture: expected .*got hand_codes"):
        query_mixture(hand, contacts, spoilt)
    # What does not change the codes is no other hand, nor are single precision and samples that
    # tell no hand.
    for same in (
        dataclasses.replace(hand, source=hand.source._replace(sha256="0" * 64)),
        hand.to(torch.float32),
    ):
        assert len(query_mixture(same, contacts, mixture))
    assert len(query_mixture(hand, contacts, dataclasses.replace(mixture, meta={})))


def test_a_mixture_of_postures_in_degrees_or_millimetres_is_refused():
    """Its energies would be far too great: no contacts would seem to be within reach."""
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[:2], torch.eye(4).double())
    h = hand.dof
    for part, factor, found in (
        (slice(0, h), 180 / np.pi, "mean joints"),
        (slice(h, h + 3), 1000.0, "mean distances"),
    ):
        size = torch.ones_like(mixture.means[0])
        size[part] = factor
        other = dataclasses.replace(
            mixture,
            means=mixture.means * size,
            covariances=mixture.covariances * size * size[:, None],
        )
        with pytest.raises(BadArgument, match=f"mixture: expected .*got {found}"):
            query_mixture(hand, contacts, other)


def test_many_triples_are_answered_as_each_alone(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[5000:5600], motion)  # more than one pass
    seeds = query_mixture(hand, contacts, mixture, n_seeds=2)
    assert bool((seeds.row.diff() >= 0).all())
    for k in (0, 255, 256, 599):
        one = query_mixture(hand, contacts[k], mixture, n_seeds=2)
        rows = seeds[seeds.row == k]
        assert torch.equal(one.permutation, rows.permutation)
        near(one.joints, rows.joints, 1e-9)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_shipped_mixtures_accept_what_the_hand_reaches_and_refuse_what_nothing_reaches(name):
    hand = load_hand(name)
    mixture = load_mixture(name)
    assert mixture.joint_names == tuple(hand.joint_names)
    held_out = sample_configurations(hand, 1500, seed=99, sampling="grasping")
    accepted = float((mixture.energy(held_out.q) < DEFAULT_ENERGY).double().mean())
    assert accepted > 0.97
    assert abs(accepted - float(mixture.meta["acceptance_default_coverage"])) < 0.02
    opposite = held_out.q.clone()
    large = held_out.q.clone()
    opposite[:, 3:] = -1.0  # no three unit vectors have these cosines
    large[:, :3] *= 4  # fingertips further apart than two fingers are long
    for impossible, most in ((opposite, 0.0), (large, 0.02)):
        assert float((mixture.energy(impossible) < DEFAULT_ENERGY).double().mean()) <= most
    error = float((mixture.joints(held_out.q) - held_out.joints).abs().mean())
    assert abs(error - float(mixture.meta["mean_absolute_error"])) < 0.02
