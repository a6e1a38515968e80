"""Certificates against a programme written from Eq. (13) alone, and the cases in which Eq. (13) is not enough."""

import math
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan import closure
from torchgrasp.plan.certify import bound_margin, certify
from torchgrasp.plan.closure import solve_closure_lp, wrenches
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

SPEC = ContactSpec(friction=0.6, friction_margin=1.0)


def triangle() -> Tensor:
    angle = torch.tensor([0.1, 2.2, 4.3], dtype=torch.float64)
    return torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)[None]


def margin_of_eq13(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> float:
    """The largest s of W phi = 0, sum phi = 1, phi >= s, for edges that start at any tangent."""
    columns = []
    for p, n in zip(points - points.mean(0), -normals, strict=True):
        t1 = np.linalg.svd(n[None])[2][1]
        t2 = np.cross(n, t1)
        for k in range(edges):
            turn = 2 * math.pi * k / edges
            force = n + friction * (math.cos(turn) * t1 + math.sin(turn) * t2)
            columns.append(np.r_[force, np.cross(p, force)])
    w = np.array(columns).T
    m = w.shape[1]
    found = linprog(
        np.r_[np.zeros(m), -1],
        A_ub=np.c_[-np.eye(m), np.ones(m)],
        b_ub=np.zeros(m),
        A_eq=np.r_[np.c_[w, np.zeros(6)], [np.r_[np.ones(m), 0]]],
        b_eq=np.r_[np.zeros(6), 1],
        bounds=(None, None),
    )
    return float(found.x[-1])


def test_eq13_margins_agree_with_a_programme_written_from_the_equation_alone(generator):
    points = torch.randn(60, 3, 3, generator=generator, dtype=torch.float64)
    lean = torch.randn(60, 3, 3, generator=generator, dtype=torch.float64)
    normals = unit(unit(points - points.mean(1, keepdim=True)) + 0.4 * lean)
    found = certify(Contacts(points, normals), ContactSpec(friction=0.6, friction_margin=1.0, edges=64))
    oracle = [margin_of_eq13(p.numpy(), n.numpy(), 0.6, 64) for p, n in zip(points, normals, strict=True)]
    # With 64 edges the margin hardly depends on the tangent from which they are counted.
    torch.testing.assert_close(found.margin, torch.tensor(oracle, dtype=torch.float64), atol=2e-4, rtol=0.05)
    clear = torch.tensor(oracle).abs() > 2e-4
    assert torch.equal(found.closed[clear], (torch.tensor(oracle) > 0)[clear])
    assert 10 < int(found.closed.sum()) < 50
    assert float(found.residual.max()) < 1e-6


def leaning(generator: torch.Generator, count: int) -> tuple[Tensor, Tensor]:
    """Triples of which about half are closed."""
    points = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    lean = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return points, unit(unit(points - points.mean(1, keepdim=True)) + 0.4 * lean)


def exact_products(wrench: Tensor, witness: Tensor) -> list[Fraction]:
    """The products of a wrench with the edges in rational arithmetic: no rounding."""
    rows, w = wrench.tolist(), [Fraction(x) for x in witness.tolist()]
    return [sum((Fraction(x) * y for x, y in zip(row, w, strict=True)), Fraction(0)) for row in rows]


@pytest.mark.promise("N2")
def test_open_rows_carry_a_wrench_that_no_contact_opposes(generator):
    points, normals = leaning(generator, 200)
    found = certify(Contacts(points, normals), SPEC)
    edges = wrenches(points, normals, 0.6, 8).flatten(1, 2)
    torch.testing.assert_close(torch.linalg.vector_norm(found.witness, dim=-1), torch.ones(200, dtype=torch.float64))
    open_rows = torch.nonzero(~found.closed)[:, 0].tolist()
    assert len(open_rows) > 50
    for row in open_rows:
        products = exact_products(edges[row], found.witness[row])
        # A margin of 0 is no rarity: two contacts balance by themselves, and the third has nothing to push against.
        assert min(products) > (0 if float(found.margin[row]) < -1e-12 else -1e-15)
        assert max(products) > 1e-3
    closed = exact_products(edges[found.closed][0], found.witness[found.closed][0])
    assert min(closed) < 0 < max(closed)


def test_margin_and_witness_bound_each_other_so_that_neither_can_be_improved(generator):
    points, normals = leaning(generator, 500)
    found = certify(Contacts(points, normals), SPEC)
    edges = wrenches(points, normals, 0.6, 8).flatten(1, 2)
    torch.testing.assert_close(bound_margin(edges, found.witness), found.margin, rtol=0, atol=1e-12)
    other = torch.randn(500, 6, generator=generator, dtype=torch.float64)
    assert bool((bound_margin(edges, other) >= found.margin - 1e-12).all())


@pytest.mark.parametrize("edges", [3, 8, 32])
def test_highs_gives_the_same_certificates_where_the_batch_gives_none(generator, monkeypatch, edges):
    points, normals = leaning(generator, 40)
    spec = ContactSpec(friction=0.6, friction_margin=1.0, edges=edges)
    batch = certify(Contacts(points, normals), spec)
    monkeypatch.setattr(closure, "PIVOTS", 0)
    alone = certify(Contacts(points, normals), spec)
    assert torch.equal(batch.closed, alone.closed)
    torch.testing.assert_close(batch.margin, alone.margin, rtol=0, atol=1e-9)
    w = wrenches(points, normals, 0.6, edges).flatten(1, 2)
    torch.testing.assert_close(bound_margin(w, alone.witness), alone.margin, rtol=0, atol=1e-9)


@pytest.mark.promise("N9")
def test_a_certificate_does_not_depend_on_the_rows_beside_it(generator):
    points, normals = leaning(generator, 30)
    every = certify(Contacts(points, normals), SPEC)
    some = certify(Contacts(points[7:9], normals[7:9]), SPEC)
    for name in ("margin", "rank_ratio", "witness"):
        torch.testing.assert_close(getattr(some, name), getattr(every, name)[7:9], rtol=0, atol=1e-12)


@pytest.mark.promise("I10")
def test_parallel_normals_and_no_friction_leave_no_balance_at_all(generator):
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(1, 3, 3)
    for found in (
        certify(Contacts(triangle(), up), SPEC),
        certify(Contacts(triangle(), up), ContactSpec(friction=0.0)),
    ):
        assert float(found.margin) == -math.inf and not bool(found.closed)
        # Every force has the same part along -z: it pushes down, whatever is asked of it.
        torch.testing.assert_close(found.witness[0, 2], torch.tensor(-1.0, dtype=torch.float64))


def test_margin_is_at_most_uniform_and_free_of_units_and_frames(motion):
    points = triangle()
    found = certify(Contacts(points, points), SPEC)
    assert bool(found.closed)
    assert 0 < float(found.margin) <= 1 / 24
    moved = certify(Contacts(apply(motion, 0.001 * points), rotate(motion, points)), SPEC)
    torch.testing.assert_close(moved.margin, found.margin)
    torch.testing.assert_close(moved.rank_ratio, found.rank_ratio)
    single = certify(Contacts(points.float(), points.float()), SPEC)
    torch.testing.assert_close(single.margin, found.margin, atol=1e-6, rtol=1e-4)


def test_planned_friction_decides():
    tilt = math.radians(35)  # needs more than tan 35 = 0.70
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    normals = math.cos(tilt) * triangle() + math.sin(tilt) * up
    assert not bool(certify(Contacts(triangle(), normals), ContactSpec(friction=1.0, friction_margin=0.6)).closed)
    assert bool(certify(Contacts(triangle(), normals), ContactSpec(friction=1.0, friction_margin=0.9)).closed)


@pytest.mark.promise("I9")
def test_coincident_contacts_are_refused_though_eq13_holds_for_them():
    points = torch.ones(1, 3, 3, dtype=torch.float64)
    found = certify(Contacts(points, triangle()), SPEC)
    assert float(found.margin) > 0
    assert float(found.rank_ratio) < 1e-9
    assert not bool(found.closed)
    assert float((wrenches(points, triangle(), 0.6) @ found.witness[0]).abs().max()) < 1e-9


@pytest.mark.promise("I9")
def test_collinear_contacts_are_refused_though_eq13_holds_for_them():
    points = torch.tensor([[[-1.0, 0, 0], [1, 0, 0], [0.4, 0, 0]]], dtype=torch.float64)
    normals = torch.tensor([[[-1.0, 0, 0], [1, 0, 0], [1, 0, 0]]], dtype=torch.float64)
    found = certify(Contacts(points, normals), SPEC)
    assert float(found.margin) > 0
    assert not bool(found.closed)
    # No contact on the x axis can turn the object about it.
    torch.testing.assert_close(found.witness.abs(), torch.eye(6, dtype=torch.float64)[3:4])


def test_rows_that_are_not_finite_are_not_closed_and_harm_no_other():
    points = triangle().repeat(3, 1, 1)
    points[1, 0, 0] = torch.nan
    normals = triangle().repeat(3, 1, 1)
    normals[2, 1, 2] = torch.inf
    normals[2, 1] = torch.nan
    found = certify(Contacts(points, normals), SPEC)
    assert found.closed.tolist() == [True, False, False]
    assert found.witness.isnan().all(-1).tolist() == [False, True, True]


@pytest.mark.promise("I7")
def test_no_rows_give_no_certificates():
    empty = torch.zeros(0, 3, 3, dtype=torch.float64)
    assert len(certify(Contacts(empty, empty), SPEC)) == 0


def test_bad_arguments_name_what_was_found():
    with pytest.raises(BadArgument, match="unit vectors"):
        certify(Contacts(triangle(), 1.01 * triangle()), SPEC)


@pytest.mark.parametrize(("residual", "closed"), [(1e-7, True), (1e-5, False), (1e-3, False)])
def test_certify_accepts_no_balance_with_a_residual(monkeypatch, residual, closed):
    points = triangle()
    module = sys.modules["torchgrasp.plan.certify"]  # the package has a function of this name
    monkeypatch.setattr(module, "EXACT", -1.0)  # every row is given to HiGHS
    monkeypatch.setattr(module, "solve_by_highs", lambda wrench: (0.01, residual, None))
    assert bool(certify(Contacts(points, points), SPEC).closed) is closed


def test_the_programme_of_no_grasps_is_empty():
    phi, witness = solve_closure_lp(torch.zeros(0, 24, 6, dtype=torch.float64))
    assert phi.shape == (0, 24) and witness.shape == (0, 6)
