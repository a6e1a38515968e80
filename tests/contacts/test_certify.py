"""Certificates against a programme written from Eq. (13) alone, and the cases in which Eq. (13) is
not enough.
"""

import math
import sys
from fractions import Fraction

import pytest
import torch
from torch import Tensor

from tests.contacts.exact_closure import random_contacts
from tests.make import closure_margin, near, real, spokes
from torchgrasp import Contacts, ContactSpec
from torchgrasp.contacts import form_closure as closure
from torchgrasp.contacts.certify import bound_margin, certify
from torchgrasp.contacts.form_closure import solve_closure_lp, wrenches
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rotate

SPEC = ContactSpec(friction=0.6, friction_margin=1.0)
UP = real([0.0, 0, 1]).expand(1, 3, 3)


def leaning(generator: torch.Generator, count: int) -> tuple[Tensor, Tensor]:
    """Triples of which about half are closed."""
    contacts = random_contacts(count, generator, 0.4)
    return contacts.points, contacts.normals


def test_eq13_margins_agree_with_a_programme_written_from_the_equation_alone(generator):
    points, normals = leaning(generator, 60)
    found = certify(
        Contacts(points, normals), ContactSpec(friction=0.6, friction_margin=1.0, edges=64)
    )
    oracle = real([closure_margin(p, n, 0.6, 64)[0] for p, n in zip(points, normals, strict=True)])
    # With 64 edges the margin hardly depends on the tangent from which they are counted.
    torch.testing.assert_close(found.margin, oracle, atol=2e-4, rtol=0.05)
    clear = oracle.abs() > 2e-4
    assert torch.equal(found.closed[clear], (oracle > 0)[clear])
    assert 10 < int(found.closed.sum()) < 50
    assert float(found.residual.max()) < 1e-6


def exact_products(wrench: Tensor, witness: Tensor) -> list[Fraction]:
    """The products of a wrench with the edges in rational arithmetic: no rounding."""
    rows = wrench.tolist()
    w = [Fraction(x) for x in witness.tolist()]
    return [
        sum((Fraction(x) * y for x, y in zip(row, w, strict=True)), Fraction(0)) for row in rows
    ]


@pytest.mark.promise("N2")
def test_open_rows_carry_a_wrench_that_no_contact_opposes(generator):
    points, normals = leaning(generator, 100)
    found = certify(Contacts(points, normals), SPEC)
    edges = wrenches(points, normals, 0.6, 8).flatten(1, 2)
    torch.testing.assert_close(
        torch.linalg.vector_norm(found.witness, dim=-1), torch.ones(100, dtype=torch.float64)
    )
    open_rows = torch.nonzero(~found.closed)[:, 0].tolist()
    assert len(open_rows) > 20
    for row in open_rows:
        products = exact_products(edges[row], found.witness[row])
        # A margin of 0 is no rarity: two contacts balance by themselves, and the third has nothing
        # to push against.
        assert min(products) > (0 if float(found.margin[row]) < -1e-12 else -1e-15)
        assert max(products) > 1e-3
    closed = exact_products(edges[found.closed][0], found.witness[found.closed][0])
    assert min(closed) < 0 < max(closed)


def test_margin_and_witness_bound_each_other_so_that_neither_can_be_improved(generator):
    points, normals = leaning(generator, 500)
    found = certify(Contacts(points, normals), SPEC)
    edges = wrenches(points, normals, 0.6, 8).flatten(1, 2)
    near(bound_margin(edges, found.witness), found.margin, 1e-12)
    other = torch.randn(500, 6, generator=generator, dtype=torch.float64)
    assert bool((bound_margin(edges, other) >= found.margin - 1e-12).all())


@pytest.mark.parametrize("edges", [3, 8, 32])
def test_highs_gives_the_same_certificates_where_the_batch_gives_none(
    generator, monkeypatch, edges
):
    points, normals = leaning(generator, 40)
    spec = ContactSpec(friction=0.6, friction_margin=1.0, edges=edges)
    batch = certify(Contacts(points, normals), spec)
    monkeypatch.setattr(closure, "PIVOTS", 0)
    alone = certify(Contacts(points, normals), spec)
    assert torch.equal(batch.closed, alone.closed)
    near(batch.margin, alone.margin, 1e-9)
    w = wrenches(points, normals, 0.6, edges).flatten(1, 2)
    near(bound_margin(w, alone.witness), alone.margin, 1e-9)


@pytest.mark.promise("N9")
def test_a_certificate_does_not_depend_on_the_rows_beside_it(generator):
    points, normals = leaning(generator, 30)
    every = certify(Contacts(points, normals), SPEC)
    some = certify(Contacts(points[7:9], normals[7:9]), SPEC)
    for name in ("margin", "rank_ratio", "witness"):
        near(getattr(some, name), getattr(every, name)[7:9], 1e-12)


@pytest.mark.promise("I10")
def test_parallel_normals_and_no_friction_leave_no_balance_at_all():
    for spec in (SPEC, ContactSpec(friction=0.0)):
        found = certify(Contacts(spokes(), UP), spec)
        assert float(found.margin) == -math.inf and not bool(found.closed)
        # Every force has the same part along -z: it pushes down, whatever is asked of it.
        torch.testing.assert_close(found.witness[0, 2], real(-1.0))


def test_margin_is_at_most_uniform_and_free_of_units_and_frames(motion):
    points = spokes()
    found = certify(Contacts(points, points), SPEC)
    assert bool(found.closed) and 0 < float(found.margin) <= 1 / 24
    moved = certify(Contacts(apply(motion, 0.001 * points), rotate(motion, points)), SPEC)
    torch.testing.assert_close(moved.margin, found.margin)
    torch.testing.assert_close(moved.rank_ratio, found.rank_ratio)
    single = certify(Contacts(points.float(), points.float()), SPEC)
    torch.testing.assert_close(single.margin, found.margin, atol=1e-6, rtol=1e-4)


def test_planned_friction_decides():
    tilt = math.radians(35)  # needs more than tan 35 = 0.70
    contacts = Contacts(spokes(), math.cos(tilt) * spokes() + math.sin(tilt) * UP)
    for friction_margin in (0.6, 0.9):
        spec = ContactSpec(friction=1.0, friction_margin=friction_margin)
        assert bool(certify(contacts, spec).closed) is (friction_margin > 0.7)


@pytest.mark.promise("I9")
def test_coincident_and_collinear_contacts_are_refused_though_eq13_holds_for_them():
    points = torch.ones(1, 3, 3, dtype=torch.float64)
    found = certify(Contacts(points, spokes()), SPEC)
    assert float(found.margin) > 0 and float(found.rank_ratio) < 1e-9 and not bool(found.closed)
    assert float((wrenches(points, spokes(), 0.6) @ found.witness[0]).abs().max()) < 1e-9
    line = real([[[-1.0, 0, 0], [1, 0, 0], [0.4, 0, 0]]])
    normals = real([[[-1.0, 0, 0], [1, 0, 0], [1, 0, 0]]])
    found = certify(Contacts(line, normals), SPEC)
    assert float(found.margin) > 0 and not bool(found.closed)
    # No contact on the x axis can turn the object about it.
    torch.testing.assert_close(found.witness.abs(), torch.eye(6, dtype=torch.float64)[3:4])


@pytest.mark.promise("I7")
def test_rows_that_are_not_finite_are_not_closed_and_harm_no_other_and_no_rows_give_none():
    points = spokes().repeat(3, 1, 1)
    normals = spokes().repeat(3, 1, 1)
    points[1, 0, 0] = torch.nan
    normals[2, 1] = torch.nan
    found = certify(Contacts(points, normals), SPEC)
    assert found.closed.tolist() == [True, False, False]
    assert found.witness.isnan().all(-1).tolist() == [False, True, True]
    assert len(certify(Contacts(points[:0], normals[:0]), SPEC)) == 0
    phi, witness = solve_closure_lp(torch.zeros(0, 24, 6, dtype=torch.float64))
    assert phi.shape == (0, 24) and witness.shape == (0, 6)
    with pytest.raises(BadArgument, match="unit vectors"):
        certify(Contacts(spokes(), 1.01 * spokes()), SPEC)


@pytest.mark.parametrize(("residual", "closed"), [(1e-7, True), (1e-5, False), (1e-3, False)])
def test_certify_accepts_no_balance_with_a_residual(monkeypatch, residual, closed):
    module = sys.modules["torchgrasp.contacts.certify"]  # the package has a function of this name
    monkeypatch.setattr(module, "EXACT", -1.0)  # every row is given to HiGHS
    monkeypatch.setattr(
        module, "solve_by_highs", lambda wrench: (0.01, residual, None, torch.zeros(len(wrench)))
    )
    assert bool(certify(Contacts(spokes(), spokes()), SPEC).closed) is closed


def test_highs_decides_the_verdict_where_the_margin_is_the_least_one_allowed(monkeypatch):
    module = sys.modules["torchgrasp.contacts.certify"]
    margin = float(certify(Contacts(spokes(), spokes()), SPEC).margin)
    asked = []

    def highs(wrench):
        asked.append(len(wrench))
        return margin, 0.0, None, torch.zeros(len(wrench))

    monkeypatch.setattr(module, "solve_by_highs", highs)
    for allowed, rows in ((0.5 * margin, 0), (margin, 1), (-margin, 0)):
        asked.clear()
        monkeypatch.setattr(module, "MIN_MARGIN", allowed)
        certify(Contacts(spokes(), spokes()), SPEC)
        assert len(asked) == rows
