"""The probability of closure against surfaces drawn anew."""

import pytest
import torch

from tests.contacts.closure_reference import redrawn_closure
from tests.make import HALF_BALL_RADIUS as RADIUS
from tests.make import contacts_on, near, spokes
from tests.make import half_ball as ball
from torchgrasp import Contacts, ContactSpec, closure_probability, hold_probability
from torchgrasp.foundation.errors import BadArgument


def test_a_sure_shape_is_sure_to_be_closed():
    shape = ball(-2.0, std_factor=0.1)
    contacts = Contacts(RADIUS * spokes(), spokes())
    found = closure_probability(shape, contacts)
    assert float(found.probability) > 0.999
    assert 0.0 < float(found.standard_error) < 1e-3
    for friction in (0.0, 1e-3):
        none = closure_probability(shape, contacts, ContactSpec(friction=friction))
        assert float(none.probability) < 0.02


def test_the_probability_is_a_share_with_a_bounded_error_and_bad_arguments_are_named(
    doubtful, generator
):
    contacts = contacts_on(doubtful, generator, 100)
    for friction in (0.5, 1.0):
        found = closure_probability(doubtful, contacts, ContactSpec(friction=friction), n=1000)
        assert float(found.standard_error.max()) <= 0.5 / 1000**0.5
        assert bool(((found.probability >= 0) & (found.probability <= 1)).all())
    assert 0.5 < float(found.probability.mean()) < 0.99
    contacts = contacts_on(doubtful, generator, 2)
    far = Contacts(contacts.points * 100, contacts.normals)
    two = Contacts(contacts.points[:, :2], contacts.normals[:, :2])
    long = Contacts(contacts.points, 1.1 * contacts.normals)
    for wrong, options, match in (
        (contacts, {"n": 0}, "n: expected .*got 0"),
        (contacts, {"seed": -1}, "seed: expected .*got -1"),
        (far, {}, "domain"),
        (long, {}, "unit vectors"),
        (two, {}, "expected 3 to 5.*got 2 contacts a row"),
    ):
        with pytest.raises(BadArgument, match=match):
            closure_probability(doubtful, wrong, **options)


def test_normals_that_point_inward_are_refused_and_single_poor_ones_are_not(doubtful, generator):
    """Fingers would come from within the object, and meet no surface: the result was 0."""
    contacts = contacts_on(doubtful, generator, 6)
    inward = Contacts(contacts.points, -contacts.normals)
    for rows in (slice(None), [2]):
        with pytest.raises(BadArgument, match=r"contacts.normals: expected outward.*point into"):
            closure_probability(doubtful, inward[rows], n=100)
        with pytest.raises(BadArgument, match=r"contacts.normals: expected outward.*point into"):
            hold_probability(inward[rows], 0.5, shape=doubtful, draws=10)
    # every set has one poor normal
    normals = contacts.normals.clone()
    normals[:, 0] *= -1
    found = closure_probability(doubtful, Contacts(contacts.points, normals), n=100)
    assert float(found.probability.max()) < 0.1


@pytest.mark.parametrize(("fingertips", "friction"), [(3, 0.6), (4, 0.3)])
def test_surfaces_drawn_anew_are_closed_as_often(doubtful, generator, fingertips, friction):
    contacts = contacts_on(doubtful, generator, 6, fingertips)
    found = closure_probability(doubtful, contacts, ContactSpec(friction=friction), n=600)
    again = redrawn_closure(doubtful, contacts, friction, 600, seed=1)
    assert bool(((again - found.probability).abs() <= 3 * 2**0.5 * found.standard_error).all())
    assert float(found.probability.min()) < 0.95


@pytest.mark.parametrize("fingertips", [3, 5])
def test_rows_do_not_depend_on_each_other_and_a_seed_fixes_every_bit(
    doubtful, generator, fingertips
):
    contacts = contacts_on(doubtful, generator, 20, fingertips)
    every, again, other = (
        closure_probability(doubtful, contacts, n=300, seed=seed) for seed in (3, 3, 4)
    )
    assert torch.equal(every.probability, again.probability)
    assert not torch.equal(every.probability, other.probability)
    some = closure_probability(doubtful, contacts[[4, 11]], n=300, seed=3)
    near(some.probability, every.probability[[4, 11]], 1 / 300)
    assert len(closure_probability(doubtful, contacts[:0])) == 0
