"""Query of the learned model: contacts that a real posture touches give the posture again (Eqs. 21-24)."""

import dataclasses
import functools

import pytest
import torch

from tests.make import touched_contacts
from torchgrasp import load_object, plan_grasps
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.seeds import WRONG_SIDE, query_mixture
from torchgrasp.posture_model.encoding import PERMUTATIONS, encode_fingertips
from torchgrasp.posture_model.fit import fit_mixture
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, PAPER_ENERGY, GraspMixture, load_mixture
from torchgrasp.posture_model.sample import HandSamples, sample_configurations


@functools.cache
def barrett() -> tuple[Hand, HandSamples, GraspMixture]:
    hand = load_hand("barrett")
    samples = sample_configurations(hand, 12_000, seed=1)
    return hand, samples, fit_mixture(samples[:9000], components=12, iterations=60)


def test_eq24_frames_of_tips_and_contacts_coincide(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[9000:9050], motion)
    seeds = query_mixture(hand, contacts, mixture)
    tips = apply(seeds.obj_from_hand, hand.fingertips(seeds.joints)[0])
    wanted = contacts.points[seeds.row[:, None], seeds.permutation]
    torch.testing.assert_close(virtual_frame(tips), virtual_frame(wanted), rtol=0, atol=1e-9)
    torch.testing.assert_close(seeds.tip_error, (tips - wanted).norm(dim=-1))


def test_eq24_the_true_joints_give_the_true_pose(motion):
    hand, samples, _ = barrett()
    tips, _ = hand.fingertips(samples.joints[:50])
    obj_from_vf = virtual_frame(apply(motion, tips))
    torch.testing.assert_close(obj_from_vf @ inverse(virtual_frame(tips)), motion.expand(50, 4, 4))


def test_postures_are_found_again(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[9000:9300], motion)
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
    contacts = touched_contacts(hand, samples.joints[9000:9100], motion)
    seeds = query_mixture(hand, contacts, mixture, n_seeds=3)
    assert bool((seeds.row.diff() >= 0).all())
    normals = rotate(seeds.obj_from_hand, hand.fingertips(seeds.joints)[1])
    side = (normals * contacts.normals[seeds.row[:, None], seeds.permutation]).sum(-1).mean(-1)
    wrong = (side > WRONG_SIDE).long()
    same_row = seeds.row.diff() == 0
    assert bool((wrong.diff()[same_row] >= 0).all())
    # All six assignments are asked, each with three seeds or, out of reach, none.
    counts = torch.stack([(seeds.permutation == torch.tensor(p)).all(-1).sum() for p in PERMUTATIONS])
    assert int(counts.sum()) == len(seeds)
    assert bool((counts > 0).all())


def test_seeds_do_not_depend_on_the_objects_frame(motion):
    hand, samples, mixture = barrett()
    first = query_mixture(hand, touched_contacts(hand, samples.joints[9000:9020], torch.eye(4).double()), mixture)
    moved = query_mixture(hand, touched_contacts(hand, samples.joints[9000:9020], motion), mixture)
    # Equal up to rounding; the order of equal errors may differ.
    torch.testing.assert_close(moved.joints.sum(), first.joints.sum(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(moved.tip_error.sum(), first.tip_error.sum(), rtol=1e-6, atol=1e-6)


def test_degenerate_and_unreachable_rows_have_no_seeds(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[9000:9004], motion)
    points = contacts.points.clone()
    points[1] = points[1, 0]
    points[2] = 1 + 10 * (points[2] - points[2].mean(0))  # a triangle ten times as large
    seeds = query_mixture(hand, dataclasses.replace(contacts, points=points), mixture)
    assert not set(seeds.row.tolist()) & {1, 2}
    assert {0, 3} <= set(seeds.row.tolist())


def test_empty_and_float32_contacts():
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[:5], rigid(torch.eye(3).double(), torch.ones(3).double()))
    assert len(query_mixture(hand, contacts[:0], mixture)) == 0
    single = query_mixture(hand, contacts.to(torch.float32), mixture)
    assert single.joints.dtype == single.obj_from_hand.dtype == torch.float32
    torch.testing.assert_close(
        single.energy.sum(), query_mixture(hand, contacts, mixture).energy.sum().float(), rtol=1e-3, atol=0
    )


def test_paper_coverage_accepts_fewer(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[9000:9100], motion)
    few, many = (query_mixture(hand, contacts, mixture, max_energy=r) for r in (PAPER_ENERGY, DEFAULT_ENERGY))
    assert 0 < len(few) < len(many)


def test_bad_arguments():
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[:2], torch.eye(4).double())
    with pytest.raises(BadArgument, match=r"n_seeds: expected .*got 0"):
        query_mixture(hand, contacts, mixture, n_seeds=0)
    with pytest.raises(BadArgument, match=r"max_energy: expected .*got nan"):
        query_mixture(hand, contacts, mixture, max_energy=float("nan"))
    with pytest.raises(BadArgument, match=r"mixture: expected .*got joints"):
        query_mixture(load_hand("allegro"), contacts, mixture)


def test_a_mixture_of_other_limits_fingers_or_fingertips_is_refused():
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[:2], torch.eye(4).double())
    others = [
        dataclasses.replace(hand, actuated=dataclasses.replace(hand.actuated, upper=hand.upper - 0.01)),
        dataclasses.replace(hand, tips=dataclasses.replace(hand.tips, contact=hand.tips.contact + 1e-4)),
        dataclasses.replace(hand, tips=dataclasses.replace(hand.tips, normal=hand.tips.normal.roll(1, 1))),
        dataclasses.replace(hand, actuated=dataclasses.replace(hand.actuated, coupling=hand.actuated.coupling * 1.001)),
    ]
    for other in others:
        with pytest.raises(BadArgument, match=r"mixture: expected .*train it anew, got a model of hand 'barrett'"):
            query_mixture(other, contacts, mixture)
    spoilt = dataclasses.replace(mixture, meta=mixture.meta | {"hand_codes": "one two"})
    with pytest.raises(BadArgument, match=r"mixture: expected .*got hand_codes"):
        query_mixture(hand, contacts, spoilt)
    # What does not change the codes is no other hand, nor are single precision and samples that tell no hand.
    for same in (dataclasses.replace(hand, source=hand.source._replace(sha256="0" * 64)), hand.to(torch.float32)):
        assert len(query_mixture(same, contacts, mixture))
    assert len(query_mixture(hand, contacts, dataclasses.replace(mixture, meta={})))


def test_many_triples_are_answered_as_each_alone(motion):
    hand, samples, mixture = barrett()
    contacts = touched_contacts(hand, samples.joints[9000:9600], motion)  # more than one pass
    seeds = query_mixture(hand, contacts, mixture, n_seeds=2)
    assert bool((seeds.row.diff() >= 0).all())
    for k in (0, 255, 256, 599):
        one, rows = query_mixture(hand, contacts[k], mixture, n_seeds=2), seeds[seeds.row == k]
        assert torch.equal(one.permutation, rows.permutation)
        torch.testing.assert_close(one.joints, rows.joints, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_shipped_mixtures_accept_what_the_hand_reaches_and_refuse_what_nothing_reaches(name):
    hand, mixture = load_hand(name), load_mixture(name)
    assert mixture.joint_names == tuple(hand.joint_names)
    held_out = sample_configurations(hand, 1500, seed=99, sampling="grasping")
    accepted = float((mixture.energy(held_out.q) < DEFAULT_ENERGY).double().mean())
    assert accepted > 0.97
    assert abs(accepted - float(mixture.meta["acceptance_default_coverage"])) < 0.02
    opposite, large = held_out.q.clone(), held_out.q.clone()
    opposite[:, 3:] = -1.0  # no three unit vectors have these cosines
    large[:, :3] *= 4  # fingertips further apart than two fingers are long
    for impossible, most in ((opposite, 0.0), (large, 0.02)):
        assert float((mixture.energy(impossible) < DEFAULT_ENERGY).double().mean()) <= most
    error = float((mixture.joints(held_out.q) - held_out.joints).abs().mean())
    assert abs(error - float(mixture.meta["mean_absolute_error"])) < 0.02


def test_executable_grasps_are_within_reach():
    hand, mixture = load_hand("barrett"), load_mixture("barrett")
    grasps = plan_grasps(load_object("cylinder").view, hand, starts=150)
    contacts = grasps.contacts[grasps.status == Status.OK]
    assert len(contacts) > 20
    codes = encode_fingertips(contacts.points, contacts.normals)
    assert float((mixture.energy(codes) < DEFAULT_ENERGY).double().mean()) > 0.9
    assert len(query_mixture(hand, contacts, mixture, n_seeds=1).row.unique()) > 0.95 * len(contacts)
