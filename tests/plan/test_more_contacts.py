"""Closure of four and five contacts: exact arithmetic, other programmes, and what doubling or motion may not change."""

import itertools
import math
from fractions import Fraction

import pytest
import torch
from benchmarks.plan.certificates import border_contacts, has_low_rank, random_contacts
from benchmarks.plan.exact_lp import proves_margin_above, proves_margin_below, wrench_matrix
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, degenerate, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure import (
    MIN_MARGIN,
    closed_exact,
    cone_edges,
    first_balance,
    most_opposing,
    solve_closure_lp,
    tangents,
    wrenches,
)
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

SPEC = ContactSpec(friction=0.4, friction_margin=1.0)
MORE = pytest.mark.parametrize("fingertips", [4, 5])


def contacts_of(generator: torch.Generator, fingertips: int, count: int = 300) -> Contacts:
    """Random contacts of which about half are closed."""
    return random_contacts(count, generator, 0.6, fingertips)


@MORE
def test_eq13_verdicts_are_those_of_rational_arithmetic(generator, fingertips):
    contacts = border_contacts(250, fingertips, SPEC, generator)
    found = certify(contacts, SPEC)
    phi, _ = solve_closure_lp(wrenches(contacts.points, contacts.normals, 0.4, 8).flatten(1, 2))
    assert 50 < int(found.closed.sum()) < 200
    bound = Fraction(MIN_MARGIN)
    for i, closed in enumerate(found.closed.tolist()):
        points, normals = contacts.points[i].numpy(), contacts.normals[i].numpy()
        if not closed and float(found.margin[i]) >= MIN_MARGIN:
            assert has_low_rank(points, normals, 0.4, 8)
            continue
        matrix = wrench_matrix(points, normals, 0.4, 8)
        assert not closed or proves_margin_above(matrix, phi[i].numpy(), bound)
        assert closed or proves_margin_below(matrix, found.witness[i].numpy(), bound)


@pytest.mark.parametrize("friction", [0.2, 0.8])
@MORE
def test_round_cones_lie_between_programmes_of_64_edges(generator, fingertips, friction):
    contacts = contacts_of(generator, fingertips)
    exact = closed_exact(contacts.points, contacts.normals, friction)
    spec = ContactSpec(friction=friction, edges=64, friction_margin=1.0)
    wider = ContactSpec(friction=friction / math.cos(math.pi / 64), edges=64, friction_margin=1.0)
    inner, outer = certify(contacts, spec).closed, certify(contacts, wider).closed
    assert bool((exact | ~inner).all()) and bool((outer | ~exact).all())
    assert int((outer != inner).sum()) <= 6
    assert 5 < int(exact.sum()) < 295


@MORE
def test_a_guess_changes_no_verdict(generator, fingertips):
    contacts = contacts_of(generator, fingertips)
    alone = closed_exact(contacts.points, contacts.normals, 0.4)
    noise = torch.randn(contacts.points.shape, generator=generator, dtype=torch.float64)
    nearby = first_balance(contacts.points, unit(contacts.normals + 0.2 * noise), 0.4)
    for guess in (nearby, -nearby, torch.zeros_like(nearby), nearby * torch.nan):
        assert torch.equal(closed_exact(contacts.points, contacts.normals, 0.4, guess), alone)


@MORE
def test_the_most_opposing_force_is_the_least_of_many_edges(generator, fingertips):
    contacts = contacts_of(generator, fingertips, 20)
    witness = torch.randn(20, 6, generator=generator, dtype=torch.float64)
    least, opposing = most_opposing(contacts.points, contacts.normals, 0.7, witness)
    many = (wrenches(contacts.points, contacts.normals, 0.7, 720) @ witness[:, None, :, None])[..., 0]
    torch.testing.assert_close(least, many.amin(-1), rtol=0, atol=1e-4)
    torch.testing.assert_close((opposing @ witness[..., None])[..., 0], least)


def test_a_doubled_contact_changes_no_closure(generator):
    three = contacts_of(generator, 3)
    for order in ([0, 1, 2, 2], [1, 0, 1, 2], [0, 1, 2, 0, 1]):
        more = Contacts(three.points[:, order], three.normals[:, order])
        assert torch.equal(certify(more, SPEC).closed, certify(three, SPEC).closed)
        closed = closed_exact(three.points, three.normals, 0.4)
        assert torch.equal(closed_exact(more.points, more.normals, 0.4), closed)
        # The first edges of all cones lie in the plane of the three.
        same = (tangents(more.points, more.normals) * tangents(three.points, three.normals)[:, order]).sum(-1)
        torch.testing.assert_close(same.abs(), torch.ones_like(same))


@MORE
def test_a_contact_more_opens_no_closed_contacts(generator, fingertips):
    contacts = contacts_of(generator, fingertips)
    fewer = closed_exact(contacts.points[:, 1:], contacts.normals[:, 1:], 0.4)
    whole = closed_exact(contacts.points, contacts.normals, 0.4)
    assert bool((whole | ~fewer).all())
    assert int(whole.sum()) > int(fewer.sum()) > 10


@MORE
def test_order_motion_and_scale_change_no_margin(generator, motion, fingertips):
    contacts = contacts_of(generator, fingertips, 100)
    found = certify(contacts, SPEC)
    assert 10 < int(found.closed.sum()) < 90
    order = torch.randperm(fingertips, generator=generator)
    moved = Contacts(1000 * apply(motion, contacts.points), rotate(motion, contacts.normals))
    for other in (Contacts(contacts.points[:, order], contacts.normals[:, order]), moved):
        again = certify(other, SPEC)
        torch.testing.assert_close(again.margin, found.margin, rtol=0, atol=1e-9)
        torch.testing.assert_close(again.rank_ratio, found.rank_ratio)
        assert torch.equal(again.closed, found.closed)


def test_a_tetrahedron_needs_less_friction_than_any_three_of_its_corners():
    corners = torch.tensor([[[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]], dtype=torch.float64)
    normals = unit(corners)
    assert bool(closed_exact(corners, normals, 1e-3))
    assert not bool(closed_exact(corners, normals, 0.0))  # seven contacts hold without friction, four do not
    # The force at a corner of a face leaves its normal by 19.5 degrees or more: tan = 0.354.
    assert not bool(closed_exact(corners[:, 1:], normals[:, 1:], 0.353))
    assert bool(closed_exact(corners[:, 1:], normals[:, 1:], 0.354))
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(corners)
    assert not bool(closed_exact(corners, up, 5.0))


def test_contacts_in_a_plane_with_normals_across_it_have_tangents_that_turn_with_them(generator, motion):
    square = torch.tensor([[[1.0, 0, 0], [0.2, 1, 0], [-1.1, 0, 0], [0, -1.3, 0]]], dtype=torch.float64)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(square)
    here, there = tangents(square, up), tangents(apply(motion, square), rotate(motion, up))
    torch.testing.assert_close(rotate(motion, here), there)
    assert float((here * up).sum(-1).abs().max()) < 1e-12
    edges = cone_edges(up, here, 0.5, 4)
    torch.testing.assert_close(edges.mean(2), -up)


def test_only_contacts_near_one_line_are_degenerate(generator):
    line = torch.randn(1, 1, 3, generator=generator, dtype=torch.float64)
    points = torch.tensor([-1.0, 0.2, 0.5, 1.0, 1.4], dtype=torch.float64)[:, None] * line
    off = points.clone()
    off[:, 2] += torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    for f in (3, 4, 5):
        assert degenerate(points[:, :f]).tolist() == [True] and degenerate(off[:, :f]).tolist() == [False]
        assert not bool(certify(Contacts(points[:, :f], unit(points[:, :f])), SPEC).closed)
    assert degenerate(torch.zeros(1, 4, 3)).tolist() == [True]


def test_rows_that_are_not_finite_are_open_and_harm_no_other(generator):
    contacts = contacts_of(generator, 4, 6)
    points = contacts.points.clone()
    closed = closed_exact(points, contacts.normals, 2.0)
    points[2, 1, 0] = torch.nan
    closed[2] = False
    assert torch.equal(closed_exact(points, contacts.normals, 2.0), closed)
    assert len(closed_exact(points[:0], contacts.normals[:0], 2.0)) == 0


@pytest.mark.parametrize("fingertips", [2, 6])
def test_other_numbers_of_contacts_are_refused_by_name(fingertips):
    points = torch.eye(6, 3, dtype=torch.float64)[None, :fingertips]
    with pytest.raises(BadArgument, match=rf"expected 3 to 5.*got {fingertips} contacts a row"):
        certify(Contacts(points, torch.ones_like(points)), SPEC)
    with pytest.raises(BadArgument, match=r"fingertips: expected a whole number in \[3, 5\], got .*"):
        ContactSpec(fingertips=fingertips)


def leaning_four(generator: torch.Generator, lean: float) -> tuple[Tensor, Tensor]:
    """Four contacts on a ball with normals that lean."""
    points = unit(torch.randn(200, 4, 3, generator=generator, dtype=torch.float64))
    return points, unit(points + lean * torch.randn(200, 4, 3, generator=generator, dtype=torch.float64))


def test_a_wider_cone_opens_no_closed_contacts(generator):
    points, normals = leaning_four(generator, 0.3)
    shares = [closed_exact(points, normals, friction) for friction in (0.1, 0.3, 0.6, 1.2)]
    for narrow, wide in itertools.pairwise(shares):
        assert bool((wide | ~narrow).all())
    assert int(shares[0].sum()) < int(shares[3].sum())
