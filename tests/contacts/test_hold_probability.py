"""The probability of closure under uncertain friction, placement and normals, against random draws
with an exact test of closure, scipy's distributions, quadrature and finite differences.
"""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats
from scipy.optimize import linprog

from tests.contacts.test_forces import tripods
from tests.make import contacts_on, near, real
from torchgrasp import (
    CarriedWeight,
    Contacts,
    ContactSpec,
    Distribution,
    closure_probability,
    critical_friction,
    fit_shape,
    hold_probability,
    plan_contacts,
)
from torchgrasp.contacts.critical import least_balance
from torchgrasp.contacts.form_closure import closed_exact
from torchgrasp.contacts.hold_probability import exceeding, sensitivities
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import dot, unit

WIDE = Distribution.between(0.2, 0.9)
MIXED = Distribution.parse("0.2:0.4@1|0.5@1|0.6:1.0@2")
PLACEMENT = 0.002
TILT = math.radians(3)
STEP = 1e-5
FIELDS = ("points", "normals")


def tangential(noise, normals):
    return noise - dot(noise, normals, keepdim=True) * normals


def drawn_share(contacts, law, generator, placement=PLACEMENT, tilt=TILT, frictions=20, draws=100):
    """The share of random frictions, placements and normals for which each contact set closes; each
    of equally likely ranges of the friction has one of the frictions.
    """
    size = (draws, *contacts.points.shape)
    normals = contacts.normals.expand(size)
    closed = 0.0
    for k in range(frictions):
        q = (k + torch.rand(1, generator=generator, dtype=torch.float64)) / frictions
        noise = torch.randn(2, *size, generator=generator, dtype=torch.float64)
        moved = contacts.points + placement * tangential(noise[0], normals)
        turned = unit(normals + tilt * tangential(noise[1], normals))
        found = closed_exact(moved.flatten(0, 1), turned.flatten(0, 1), float(law.quantile(q)))
        closed = closed + found.view(draws, -1).double().mean(0)
    return closed / frictions


@pytest.mark.parametrize("law", [WIDE, MIXED, Distribution.parse("0.5")], ids=str)
def test_it_is_the_share_of_random_draws_that_close(law, generator):
    contacts = Contacts(*tripods(20, 3))
    found = hold_probability(contacts, law, PLACEMENT, TILT)
    share = drawn_share(contacts, law, generator)
    assert float((found - share).abs().mean()) <= 0.02
    assert int(((share > 0.05) & (share < 0.95)).sum()) >= 8
    # friction alone is further away
    without = hold_probability(contacts, law)
    assert float((without - share).abs().mean()) > float((found - share).abs().mean())


@pytest.fixture(scope="module")
def planned():
    """Contacts that are planned on the shipped objects."""
    shapes = [fit_shape(load_object(name).view) for name in list_objects()]
    found = [plan_contacts(shape, ContactSpec(), 8).contacts for shape in shapes]
    points, normals = (torch.cat([getattr(c, x) for c in found]).double() for x in FIELDS)
    return Contacts(points, unit(normals))


@pytest.mark.parametrize(("placement", "tilt"), [(0.004, 0.0), (0.0, 0.12), (0.003, 0.07)])
def test_large_errors_of_planned_contacts_are_not_taken_for_small(
    planned, placement, tilt, generator
):
    """Planned contacts are near kinks of the critical friction."""
    law = Distribution.between(0.1, 0.6)
    found = hold_probability(planned, law, placement, tilt)
    share = drawn_share(planned, law, generator, placement, tilt)
    assert float((found - share).abs().mean()) <= 0.02
    assert float((hold_probability(planned, law) - share).abs().mean()) > 0.05


@pytest.mark.parametrize(("shift", "turn"), [(0.003, 0.0), (0.0, 0.05), (0.002, 0.05)])
def test_errors_of_the_pose_move_all_contacts_together(shift, turn, generator):
    contacts = Contacts(*tripods(20, 3))
    found = hold_probability(contacts, WIDE, shift=shift, turn=turn)
    share = torch.zeros(20, dtype=torch.float64)
    frictions = 20
    draws = 500  # 10,000 of each contact set
    arms = contacts.points - contacts.points.mean(1, keepdim=True)
    size = (draws, *contacts.points.shape)
    normals = contacts.normals.expand(size)
    for k in range(frictions):
        q = (k + torch.rand(1, generator=generator, dtype=torch.float64)) / frictions
        noise = torch.randn(2, draws, 20, 1, 3, generator=generator, dtype=torch.float64)
        motion = shift * noise[0] + torch.linalg.cross(
            turn * noise[1].expand(size), arms.expand(size)
        )
        moved = contacts.points + tangential(motion, normals)
        closed = closed_exact(moved.flatten(0, 1), normals.flatten(0, 1), float(WIDE.quantile(q)))
        share += closed.view(draws, -1).double().mean(0) / frictions
    assert float((found - share).abs().mean()) <= 0.02
    without = hold_probability(contacts, WIDE)
    assert float((without - share).abs().mean()) > float((found - share).abs().mean())


CENTER = torch.tensor([0.01, 0.0, 0.01])
PRESS = 4.0
CARRYING = Contacts(*tripods(12, 3))
"""Contact sets that carry a weight with its centre [m] there, pressed with the force [N]."""


@functools.cache
def carried_masses(row, friction, edges=64):
    """The least and the greatest mass [kg] that forces in friction pyramids carry with a row of
    `CARRYING`, by a linear programme; None if there is none. Its pyramids lie inside the cones, and
    are hardly less.
    """
    points, normals = CARRYING.points[row].numpy(), CARRYING.normals[row].numpy()
    angle = 2 * math.pi * np.arange(edges) / edges
    columns = []
    for point, normal in zip(points, normals, strict=True):
        one, other = np.linalg.svd(normal[None])[2][1:]
        around = np.outer(np.cos(angle), one) + np.outer(np.sin(angle), other)
        force = friction * around - normal
        moment = np.cross(point - CENTER.numpy(), force) / 0.04
        columns.append(np.concatenate([force, moment], 1))
    balance = np.concatenate([np.concatenate(columns).T, [[0], [0], [-9.81], [0], [0], [0]]], 1)
    pressed = np.append(np.ones(edges * len(points)), 0.0)[None]
    found = [
        linprog(
            np.append(np.zeros(edges * len(points)), sign),
            A_eq=np.concatenate([balance, pressed]),
            b_eq=np.append(np.zeros(6), len(points) * PRESS),
        )
        for sign in (1, -1)
    ]
    return None if found[0].x is None else (found[0].x[-1], found[1].x[-1])


MEASURED = "|".join(f"{0.05 * k:.2f}" for k in range(1, 13))
"""Twelve masses [kg], more than there are nodes."""


@pytest.mark.parametrize("law", ["0.05:0.6", "0.1|0.2:0.8", MEASURED])
def test_a_mass_counts_by_the_friction_that_it_needs(law, generator):
    mass = Distribution.parse(law)
    weight = CarriedWeight(mass, CENTER, press=PRESS)
    found = hold_probability(CARRYING, WIDE, weight=weight)
    masses = mass.sample(10_000, seed=1).numpy()
    frictions = 16
    share = torch.zeros(12, dtype=torch.float64)
    for k in range(frictions):
        q = (k + torch.rand(1, generator=generator, dtype=torch.float64)) / frictions
        friction = float(WIDE.quantile(q))
        for row in range(12):
            carried = carried_masses(row, friction)
            if carried is not None:
                held = (carried[0] <= masses) & (masses <= carried[1])
                share[row] += float(held.mean()) / frictions
    assert float((found - share).abs().mean()) <= 0.02
    without = hold_probability(CARRYING, WIDE)
    assert float((without - share).abs().mean()) > 0.1


def test_an_uncertain_centre_of_mass_is_the_mean_over_centres(generator):
    contacts = Contacts(*tripods(20, 3))
    up = unit(torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64))
    weight = CarriedWeight(0.2, torch.zeros(3), 4.0, up, center_std=0.005)
    found = hold_probability(contacts, WIDE, weight=weight)
    drawn = 100
    center = 0.005 * torch.randn(20 * drawn, 3, generator=generator, dtype=torch.float64)
    one = dataclasses.replace(weight, center=center, center_std=0.0)
    many = Contacts(*(x.repeat(drawn, 1, 1) for x in (contacts.points, contacts.normals)))
    share = hold_probability(many, WIDE, weight=one).view(drawn, 20).mean(0)
    assert float((found - share).abs().mean()) <= 0.02


@pytest.mark.parametrize(("fingertips", "friction"), [(3, 0.6), (4, 0.3)])
def test_drawn_surfaces_close_as_often_as_an_exact_test_says(
    doubtful, generator, fingertips, friction
):
    contacts = contacts_on(doubtful, generator, 6, fingertips)
    found = hold_probability(contacts, friction, shape=doubtful, draws=400, seed=3)
    spec = ContactSpec(friction=friction)
    exact = closure_probability(doubtful, contacts, spec, n=400, seed=3)
    near(found, exact.probability, 2 / 400)
    law = Distribution.between(friction / 2, friction)
    found = hold_probability(contacts, law, shape=doubtful, draws=200)
    spec = ContactSpec(friction=law)
    share = closure_probability(doubtful, contacts, spec, n=1000, seed=1).probability
    assert float((found - share).abs().mean()) <= 0.02
    with pytest.raises(BadArgument, match="domain"):
        hold_probability(Contacts(9 * contacts.points, contacts.normals), law, shape=doubtful)


def test_derivatives_over_drawn_surfaces_are_those_of_differences(doubtful):
    """The step is long: roots of nearly singular covariances round. No kink is near these sets."""
    generator = torch.Generator().manual_seed(4)
    contacts = contacts_on(doubtful, generator, 4, 3)
    step = 1e-4

    def risk(points, normals):
        held = Contacts(points, unit(normals))
        return hold_probability(held, WIDE, PLACEMENT, TILT, shape=doubtful, draws=20, seed=3)

    inputs = contacts.points.double(), contacts.normals.double()
    way = tuple(torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in inputs)
    way = 0.05 * way[0], way[1]
    after, before = (
        tuple(x + sign * step * w for x, w in zip(inputs, way, strict=True)) for sign in (1, -1)
    )
    _, change = torch.func.jvp(risk, inputs, way)
    near((risk(*after) - risk(*before)) / (2 * step), change, 1e-3 * float(change.abs().max()))
    slope = torch.func.grad(lambda *x: risk(*x).sum(), argnums=(0, 1))
    gradient = slope(*inputs)
    near(sum(dot(g, w).sum() for g, w in zip(gradient, way, strict=True)), change.sum(), 1e-6)
    # forward over reverse and reverse over reverse: nodes that coincide add no NaN
    _, forward = torch.func.jvp(slope, inputs, way)
    leaves = tuple(x.clone().requires_grad_() for x in inputs)
    first = torch.autograd.grad(risk(*leaves).sum(), leaves, create_graph=True)
    along = sum(dot(g, w).sum() for g, w in zip(first, way, strict=True))
    reverse = torch.autograd.grad(along, leaves)
    for one, other in zip(forward, reverse, strict=True):
        near(one, other, 1e-6 * float(one.abs().max()))


def test_friction_alone_is_scipys_survival_of_the_critical_friction():
    points, normals = tripods(20, 3)
    normals[0] = normals[0, :1]
    contacts = Contacts(points, normals)
    critical = critical_friction(points, normals).numpy()
    assert critical[0] == math.inf
    low, point, high = stats.uniform(0.2, 0.2), stats.uniform(0.5, 1e-12), stats.uniform(0.6, 0.4)
    wanted = (low.sf(critical) + point.sf(critical) + 2 * high.sf(critical)) / 4
    np.testing.assert_allclose(hold_probability(contacts, MIXED), wanted, atol=1e-12)
    wanted = stats.uniform(0.2, 0.7).sf(critical)
    np.testing.assert_allclose(hold_probability(contacts, WIDE), wanted, atol=1e-12)
    assert hold_probability(contacts, 0.4).tolist() == (critical < 0.4).astype(float).tolist()


@pytest.mark.parametrize("deviation", [1e-9, 1e-3, 0.05, 3.0])
def test_a_gaussian_threshold_is_exceeded_as_often_as_quadrature_says(deviation):
    parts = ((0.2, 0.9), (0.5, 0.5), (0.4, 0.4 + 1e-14), (0.3, 0.31))
    mean = torch.linspace(0.1, 1.0, 11, dtype=torch.float64)
    found = exceeding(Distribution(parts), mean, torch.full_like(mean, deviation))

    def exceeded(low, high, at):
        gaussian = stats.norm(at, deviation)
        if high - low < 1e-9:
            return gaussian.cdf(low)
        return integrate.quad(gaussian.cdf, low, high, points=[at])[0] / (high - low)

    wanted = [sum(exceeded(*part, at) for part in parts) / len(parts) for at in mean.tolist()]
    np.testing.assert_allclose(found, wanted, atol=1e-7)


@pytest.mark.parametrize("fingertips", [3, 4, 5])
def test_the_sensitivities_are_finite_differences_of_the_critical_friction(fingertips, generator):
    points, normals = tripods(10, 3, fingertips)
    rows, balance = least_balance(points, normals)
    points = points[rows]
    normals = normals[rows]
    moved, turned = sensitivities(points, normals, balance)
    noise = torch.randn(2, *points.shape, generator=generator, dtype=torch.float64)
    move, turn = tangential(noise, normals)
    move = 0.04 * move  # the size of the grasp [m]

    def friction(step, other):
        return critical_friction(points + step * move, unit(normals + other * turn))

    for found, change in (
        ((moved * move).sum((1, 2)), friction(STEP, 0) - friction(-STEP, 0)),
        ((turned * turn).sum((1, 2)), friction(0, STEP) - friction(0, -STEP)),
    ):
        torch.testing.assert_close(found, change / (2 * STEP), rtol=1e-2, atol=1e-3)
        assert float(found.abs().amin()) > 0
    for x in (moved, turned):
        assert float(dot(x, normals).abs().amax()) < 1e-9


@pytest.mark.parametrize(("placement", "tilt"), [(0.0, 0.0), (PLACEMENT, TILT)])
def test_more_friction_never_lowers_it(placement, tilt):
    contacts = Contacts(*tripods(20, 3, 4))
    last = torch.zeros(20, dtype=torch.float64)
    for low in torch.linspace(0.0, 1.2, 13).tolist():
        law = Distribution.between(low, low + 0.3)
        found = hold_probability(contacts, law, placement, tilt)
        assert bool((found >= last - 1e-12).all())
        last = found
    assert bool((last > 0.9).any())


def test_each_normal_may_have_its_own_tilt_and_sets_are_independent():
    contacts = Contacts(*tripods(6, 3))
    tilt = torch.full((6, 3), TILT, dtype=torch.float64)
    both = hold_probability(contacts, WIDE, PLACEMENT, TILT)
    assert torch.equal(hold_probability(contacts, WIDE, PLACEMENT, tilt), both)
    tilt[2] = 0.0
    other = hold_probability(contacts, WIDE, PLACEMENT, tilt)
    assert (other != both).tolist() == [False, False, True, False, False, False]
    torch.testing.assert_close(hold_probability(contacts[[4]], WIDE, PLACEMENT, TILT), both[[4]])
    single = Contacts(contacts.points.float(), contacts.normals.float())
    assert hold_probability(single, WIDE, PLACEMENT, TILT).dtype == torch.float32
    assert hold_probability(contacts[:0], WIDE, PLACEMENT, TILT).shape == (0,)


def test_wrong_arguments_are_refused():
    points, normals = tripods(4, 3)
    contacts = Contacts(points, normals)
    weight = CarriedWeight(0.1, torch.zeros(3, 3), 5.0)
    wrong = [
        ("contacts.points", (Contacts(points[:, :2], normals[:, :2]), 0.5)),
        ("contacts.normals", (Contacts(points, 2 * normals), 0.5)),
        ("friction", (contacts, Distribution.between(0.5, 11.0))),
        ("friction", (contacts, -0.1)),
        ("placement", (contacts, 0.5, -0.001)),
        ("shift", (contacts, 0.5, 0.0, 0.0, -0.001)),
        ("turn", (contacts, 0.5, 0.0, 0.0, 0.0, 4.0)),
        ("contacts.points: .*metres", (Contacts(1000 * points, normals), 0.5, 0.002)),
        # two millimetres, and one degree
        ("placement", (contacts, 0.5, 2.0)),
        ("shift", (contacts, 0.5, 0.0, 0.0, 2.0)),
        ("tilt", (contacts, 0.5, 0.0, 1.0)),
        ("turn", (contacts, 0.5, 0.0, 0.0, 0.0, 1.0)),
        ("tilt", (contacts, 0.5, 0.0, -0.1)),
        ("tilt", (contacts, 0.5, 0.0, torch.full((4, 3), 4.0))),
        ("tilt", (contacts, 0.5, 0.0, torch.zeros(4, 2))),
        ("weight.center", (contacts, 0.5, 0.0, 0.0, 0.0, 0.0, weight)),
        ("tilt", (contacts, 0.5, 0.0, real([[math.nan] * 3] * 4))),
    ]
    for argument, arguments in wrong:
        with pytest.raises(BadArgument, match=argument):
            hold_probability(*arguments)
    in_mm = CarriedWeight(0.1, 1000.0 * contacts.points[0].mean(0) + 50.0, press=5.0)
    with pytest.raises(BadArgument, match=r"weight\.center: .*metres"):
        hold_probability(contacts, 0.5, weight=in_mm)
    for argument, arguments in (
        ("mass", (Distribution.between(0.0, 0.1), torch.zeros(3), 5.0)),
        ("press", (0.1, torch.zeros(3), 0.0)),
        ("up", (0.1, torch.zeros(3), 5.0, torch.ones(3))),
        ("center_std", (0.1, torch.zeros(3), 5.0, None, 2.0)),  # two millimetres
    ):
        with pytest.raises(BadArgument, match=argument):
            CarriedWeight(*arguments)
