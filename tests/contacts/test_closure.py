"""Wrenches and closure of three to five contacts: exact arithmetic, other programmes, and their own
definitions.
"""

import itertools
import math
from fractions import Fraction

import pytest
import torch

from tests.contacts.exact_closure import (
    border_contacts,
    exact_margin,
    has_low_rank,
    proves_margin_above,
    proves_margin_below,
    random_contacts,
    wrench_matrix,
)
from tests.make import near, real, spokes
from torchgrasp import Contacts, ContactSpec, certify
from torchgrasp.contacts.form_closure import (
    MIN_MARGIN,
    centre_and_radius,
    closed_exact,
    cone_edges,
    first_balance,
    most_opposing,
    rank_ratio,
    solve_closure_lp,
    tangents,
    wrenches,
)
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, degenerate, rotate
from torchgrasp.geometry.linalg import unit

SPEC = ContactSpec(friction=0.4, friction_margin=1.0)
FINGERTIPS, MORE = (
    pytest.mark.parametrize("fingertips", numbers) for numbers in ((3, 4, 5), (4, 5))
)


def contacts_of(generator: torch.Generator, fingertips: int, count: int = 300) -> Contacts:
    """Random contacts of which about half are closed."""
    return random_contacts(count, generator, 0.6 if fingertips > 3 else 0.45, fingertips)


@FINGERTIPS
@pytest.mark.parametrize("edges", [3, 8])
def test_eq13_edges_lie_on_the_friction_cone_about_the_inward_normal(generator, fingertips, edges):
    contacts = contacts_of(generator, fingertips, 50)
    normals = contacts.normals
    tangent = tangents(contacts.points, contacts.normals)
    torch.testing.assert_close(
        (tangent * normals).sum(-1), torch.zeros(50, fingertips, dtype=torch.float64)
    )
    torch.testing.assert_close(
        tangent.norm(dim=-1), torch.ones(50, fingertips, dtype=torch.float64)
    )
    edge = cone_edges(normals, tangent, 0.7, edges)
    push = -(edge * normals[:, :, None]).sum(-1)
    slide = (edge + normals[:, :, None]).norm(dim=-1)
    torch.testing.assert_close(push, torch.ones_like(push))
    torch.testing.assert_close(slide, torch.full_like(slide, 0.7))
    torch.testing.assert_close(edge.mean(2), -normals)


def test_eq13_torques_are_about_the_centre_and_in_radii_and_turn_with_a_motion(generator, motion):
    contacts = contacts_of(generator, 3, 20)
    points = contacts.points
    normals = contacts.normals
    w = wrenches(points, normals, 0.5, 8)
    (centre, radius) = centre_and_radius(points)
    torque = torch.linalg.cross(
        ((points - centre) / radius)[:, :, None].expand(20, 3, 8, 3), w[..., :3]
    )
    torch.testing.assert_close(w[..., 3:], torque)
    assert bool((radius > 0).all())
    moved = wrenches(apply(motion, points) * 1000, rotate(motion, normals), 0.5)
    torch.testing.assert_close(
        moved.unflatten(-1, (2, 3)), w.unflatten(-1, (2, 3)) @ motion[:3, :3].mT
    )


def test_tangents_are_finite_on_their_seam_and_for_degenerate_contacts_and_turn_with_the_points(
    motion,
):
    z = real([[[0.0, 0, 1]]])
    flat = real([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    for points in (flat, torch.zeros_like(flat), flat * real([1.0, 0, 0])):
        tangent = tangents(points, z.expand_as(points))
        torch.testing.assert_close(tangent.norm(dim=-1), torch.ones(1, 3, dtype=torch.float64))
        torch.testing.assert_close((tangent * z).sum(-1), torch.zeros(1, 3, dtype=torch.float64))
        assert torch.isfinite(wrenches(points, z.expand_as(points), 0.5)).all()
    square = real([[[1.0, 0, 0], [0.2, 1, 0], [-1.1, 0, 0], [0, -1.3, 0]]])
    up = z.expand_as(square)
    here = tangents(square, up)
    there = tangents(apply(motion, square), rotate(motion, up))
    torch.testing.assert_close(rotate(motion, here), there)
    assert float((here * up).sum(-1).abs().max()) < 1e-12
    torch.testing.assert_close(cone_edges(up, here, 0.5, 4).mean(2), -up)


@MORE
def test_eq13_verdicts_are_those_of_rational_arithmetic(generator, fingertips):
    contacts = border_contacts(120, fingertips, SPEC, generator)
    found = certify(contacts, SPEC)
    phi, _ = solve_closure_lp(wrenches(contacts.points, contacts.normals, 0.4, 8).flatten(1, 2))
    assert 20 < int(found.closed.sum()) < 100
    bound = Fraction(MIN_MARGIN)
    for i, closed in enumerate(found.closed.tolist()):
        points = contacts.points[i].numpy()
        normals = contacts.normals[i].numpy()
        if not closed and float(found.margin[i]) >= MIN_MARGIN:
            assert has_low_rank(points, normals, 0.4, 8)
            continue
        matrix = wrench_matrix(points, normals, 0.4, 8)
        assert not closed or proves_margin_above(matrix, phi[i].numpy(), bound)
        assert closed or proves_margin_below(matrix, found.witness[i].numpy(), bound)


def test_eq13_margins_are_those_of_rational_arithmetic(generator):
    contacts = random_contacts(10, generator, 0.4)
    points = contacts.points
    normals = contacts.normals
    found = certify(contacts, ContactSpec(friction=0.6, friction_margin=1.0))
    phi, _ = solve_closure_lp(wrenches(points, normals, 0.6, 8).flatten(1, 2))
    for i in range(10):
        matrix = wrench_matrix(points[i].numpy(), normals[i].numpy(), 0.6, 8)
        exact = exact_margin(matrix)
        little = Fraction(1, 10**9)
        witness = found.witness[i].numpy()
        assert float(exact) == pytest.approx(float(found.margin[i]), abs=1e-10)
        assert [
            proves_margin_above(matrix, phi[i].numpy(), exact + k * little) for k in (-1, 1)
        ] == [True, False]
        assert [proves_margin_below(matrix, witness, exact + k * little) for k in (-1, 1)] == [
            False,
            True,
        ]


@pytest.mark.parametrize("friction", [0.3, 0.8])
@FINGERTIPS
def test_round_cones_lie_between_programmes_of_64_edges(generator, fingertips, friction):
    contacts = contacts_of(generator, fingertips)
    exact = closed_exact(contacts.points, contacts.normals, friction)
    spec = ContactSpec(friction=friction, edges=64, friction_margin=1.0)
    wider = ContactSpec(friction=friction / math.cos(math.pi / 64), edges=64, friction_margin=1.0)
    inner = certify(contacts, spec).closed
    outer = certify(contacts, wider).closed
    assert bool((exact | ~inner).all()) and bool((outer | ~exact).all())
    assert int((outer != inner).sum()) <= 6
    assert 5 < int(exact.sum()) < 295


def test_a_triple_is_closed_if_and_only_if_internal_forces_lie_inside_its_cones(generator):
    contacts = random_contacts(100, generator, 0.3)
    points = contacts.points
    normals = contacts.normals
    grid = real(list(itertools.product(range(-8, 9), repeat=3)))
    forces = (
        grid[grid.abs().sum(1) > 0, :, None] * unit(points.roll(-1, 1) - points)[:, None]
    )  # along the sides
    force = unit(forces - forces.roll(1, 2))
    cosine = -(force * normals[:, None]).sum(-1)
    exists = (cosine > math.cos(math.atan(0.6))).all(-1).any(-1)
    closed = closed_exact(points, normals, 0.6)
    assert bool((closed | ~exists).all())
    assert int((closed & ~exists).sum()) < 0.05 * int(closed.sum())  # the grid is coarse
    assert 25 < int(closed.sum()) < 90


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
    many = (wrenches(contacts.points, contacts.normals, 0.7, 720) @ witness[:, None, :, None])[
        ..., 0
    ]
    near(least, many.amin(-1), 1e-4)
    torch.testing.assert_close((opposing @ witness[..., None])[..., 0], least)


def test_a_doubled_contact_changes_no_closure(generator):
    three = contacts_of(generator, 3)
    for order in ([0, 1, 2, 2], [1, 0, 1, 2], [0, 1, 2, 0, 1]):
        more = Contacts(three.points[:, order], three.normals[:, order])
        assert torch.equal(certify(more, SPEC).closed, certify(three, SPEC).closed)
        closed = closed_exact(three.points, three.normals, 0.4)
        assert torch.equal(closed_exact(more.points, more.normals, 0.4), closed)
        # The first edges of all cones lie in the plane of the three.
        same = (
            tangents(more.points, more.normals) * tangents(three.points, three.normals)[:, order]
        ).sum(-1)
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
        near(again.margin, found.margin, 1e-9)
        torch.testing.assert_close(again.rank_ratio, found.rank_ratio)
        assert torch.equal(again.closed, found.closed)


def test_exact_closure_of_an_equilateral_triangle_and_its_limits():
    points = spokes(0.0, 2 * math.pi / 3, 4 * math.pi / 3)
    assert bool(closed_exact(points, points, 0.1))  # normals meet in the centre
    up = real([[[0.0, 0, 1]]]).expand_as(points)
    assert not bool(closed_exact(points, up, 5.0))  # no force in the plane of the contacts
    # Normals tilted out of the plane by 40 degrees: closed only with more friction than tan 40 =
    # 0.839.
    tilted = unit(math.cos(math.radians(40)) * points + math.sin(math.radians(40)) * up)
    assert not bool(closed_exact(points, tilted, 0.82)) and bool(closed_exact(points, tilted, 0.86))
    assert not bool(closed_exact(torch.zeros_like(points), points, 0.8))
    assert not bool(closed_exact(points * torch.nan, points, 0.8))


def test_a_tetrahedron_needs_less_friction_than_any_three_of_its_corners():
    corners = real([[[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]])
    normals = unit(corners)
    assert bool(closed_exact(corners, normals, 1e-3))
    assert not bool(
        closed_exact(corners, normals, 0.0)
    )  # seven contacts hold without friction, four do not
    # The force at a corner of a face leaves its normal by 19.5 degrees or more: tan = 0.354.
    assert not bool(closed_exact(corners[:, 1:], normals[:, 1:], 0.353))
    assert bool(closed_exact(corners[:, 1:], normals[:, 1:], 0.354))
    up = real([0.0, 0, 1]).expand_as(corners)
    assert not bool(closed_exact(corners, up, 5.0))


def test_contacts_near_one_point_or_line_have_a_low_rank(generator):
    contacts = contacts_of(generator, 3, 4)
    points = contacts.points
    normals = contacts.normals
    assert bool((rank_ratio(wrenches(points, normals, 0.5)) > 1e-3).all())
    line = points[:, :1] + torch.arange(3, dtype=torch.float64)[:, None] * points[:, 1:2]
    for some in (line, points[:, :1].expand(-1, 3, -1)):
        assert bool((rank_ratio(wrenches(some, normals, 0.5)) < 1e-9).all())


def test_only_contacts_near_one_line_are_degenerate(generator):
    line = torch.randn(1, 1, 3, generator=generator, dtype=torch.float64)
    points = real([-1.0, 0.2, 0.5, 1.0, 1.4])[:, None] * line
    off = points.clone()
    off[:, 2] += real([0.0, 0.0, 0.1])
    for f in (3, 4, 5):
        assert degenerate(points[:, :f]).tolist() == [True] and degenerate(off[:, :f]).tolist() == [
            False
        ]
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
    with pytest.raises(
        BadArgument, match=r"fingertips: expected a whole number in \[3, 5\], got .*"
    ):
        ContactSpec(fingertips=fingertips)


def test_a_wider_cone_opens_no_closed_contacts(generator):
    points = unit(torch.randn(200, 4, 3, generator=generator, dtype=torch.float64))  # on a ball
    normals = unit(points + 0.3 * torch.randn(200, 4, 3, generator=generator, dtype=torch.float64))
    shares = [closed_exact(points, normals, friction) for friction in (0.1, 0.3, 0.6, 1.2)]
    for narrow, wide in itertools.pairwise(shares):
        assert bool((wide | ~narrow).all())
    assert int(shares[0].sum()) < int(shares[3].sum())
