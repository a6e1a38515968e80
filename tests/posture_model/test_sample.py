"""Sampled postures are free, within limits, and do not depend on the number of workers."""

import pytest
import torch

from torchgrasp import fit_mixture, load_hand, sample_configurations
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.posture_model.mixture import encode_fingertips
from torchgrasp.posture_model.sample import HandSamples


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Chunks of 1000 postures: several of them in little time."""
    monkeypatch.setattr("torchgrasp.posture_model.sample.CHUNK_POSTURES", 1000)
    monkeypatch.setattr("torchgrasp.posture_model.sample.BLOCK_POSTURES", 500)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_samples_are_free_within_limits_and_coded(name):
    hand = load_hand(name)
    samples = sample_configurations(hand, 2000, seed=3)
    assert len(samples) == 2000
    assert samples.joint_names == tuple(hand.joint_names)
    assert samples.joints.dtype == torch.float64
    assert bool(((samples.joints >= hand.lower) & (samples.joints <= hand.upper)).all())
    assert bool((hand.self_clearance(samples.joints) > 0).all())
    torch.testing.assert_close(samples.q, encode_fingertips(*hand.fingertips(samples.joints)))
    assert samples.rows().shape == (2000, len(hand.joint_names) + 6)


@pytest.mark.promise("N10")
def test_same_seed_same_samples_for_any_number_of_workers():
    hand = load_hand("barrett")
    n = 2500  # more than one chunk
    one = sample_configurations(hand, n, seed=5, workers=1)
    two = sample_configurations(hand, n, seed=5, workers=2)
    assert torch.equal(one.joints, two.joints)
    assert torch.equal(one.q, two.q)
    fewer = sample_configurations(hand, 100, seed=5)
    assert torch.equal(fewer.joints, one.joints[:100])
    assert not torch.equal(fewer.joints, sample_configurations(hand, 100, seed=6).joints)


def test_samples_are_uniform_among_the_free_postures():
    # The oracle rejects draws of another generator, and takes them all at once.
    hand = load_hand("barrett")
    samples = sample_configurations(hand, 4000).joints
    draws = torch.rand(6000, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    free = hand.lower + (hand.upper - hand.lower) * draws
    free = free[hand.self_clearance(free) > 0]
    for power in (1, 2):
        moments = [(x**power).mean(0) for x in (samples, free)]
        error = sum((x**power).var(0) / len(x) for x in (samples, free)) ** 0.5
        assert bool(((moments[0] - moments[1]).abs() < 4 * error).all())


def test_grasping_samples_are_free_and_repeat():
    hand = load_hand("allegro")
    samples = sample_configurations(hand, 300, seed=2, sampling="grasping")
    assert bool((hand.self_clearance(samples.joints) > 0).all())
    assert torch.equal(samples.q, sample_configurations(hand, 300, seed=2, sampling="grasping").q)
    # Rolled tips have other codes than the middles of their pads.
    middles = encode_fingertips(*hand.fingertips(samples.joints))
    assert 0.2 < float((samples.q - middles)[:, 3:].abs().mean()) < 0.6
    assert (
        float((samples.q - middles)[:, :3].abs().max()) < 0.024
    )  # a tip rolls by at most its diameter


def test_a_hand_that_can_hardly_move_is_refused(monkeypatch):
    monkeypatch.setattr(
        "torchgrasp.posture_model.sample.can_close", lambda points, _: torch.zeros(len(points)) > 0
    )
    with pytest.raises(BadArgument, match=r"hand: expected .*got 0 kept of 5000 postures"):
        sample_configurations(load_hand("barrett"), 10, sampling="grasping")


def test_each_joint_of_samples_has_a_name():
    """Found only after a whole fit, it would cost hours."""
    numbers = torch.rand(20, 2)
    samples = HandSamples(numbers, torch.rand(20, 6), ("a",))
    with pytest.raises(BadArgument, match="samples: expected one for each, got 1 names of 2"):
        fit_mixture(samples, 1)


@pytest.mark.parametrize(("name", "value"), [("n", 0), ("seed", -1), ("workers", 0)])
def test_bad_arguments(name, value):
    with pytest.raises(BadArgument, match=rf"{name}: expected .*got {value}"):
        sample_configurations(load_hand("barrett"), **{"n": 10, name: value})
