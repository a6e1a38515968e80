"""Objectives by name and a user's own: their values against definitions, their gradients, and that they get lower."""

import dataclasses

import pytest
import torch
from torch import Tensor

from torchgrasp.data.shipped import load_object
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure_probability import closure_probability
from torchgrasp.plan.objectives import differentiate_cost, epsilon_cost, min_weight_cost, raise_probability
from torchgrasp.plan.problem import triple_jet
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.plan.solver import start_state
from torchgrasp.plan.wrench import wrenches
from torchgrasp.shape.fit import fit_shape
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

SPEC = ContactSpec.paper()


def closed_contacts(generator: torch.Generator, count: int = 12, fingertips: int = 3) -> tuple[Tensor, Tensor]:
    points, noise = torch.randn(2, 400, fingertips, 3, generator=generator, dtype=torch.float64)
    normals = unit(unit(points - points.mean(1, keepdim=True)) + 0.3 * noise)
    closed = certify(Contacts(points, normals), SPEC).closed
    return points[closed][:count], normals[closed][:count]


def test_min_weight_is_the_margin_of_the_certificate(generator):
    points, normals = closed_contacts(generator)
    margin = certify(Contacts(points, normals), SPEC).margin
    torch.testing.assert_close(-min_weight_cost(SPEC, points, normals), margin, atol=1e-9, rtol=0)


def nearest_plane(wrench: Tensor) -> float:
    """Return how near the hull's boundary is to the origin, from all planes through six wrenches."""
    sixes = wrench[torch.combinations(torch.arange(len(wrench)), 6)]
    edges = sixes[:, 1:] - sixes[:, :1]
    _, size, axes = torch.linalg.svd(edges)
    spans = size[:, -1] > 1e-9
    normal = axes[spans, -1]
    offset = (normal * sixes[spans, 0]).sum(-1)
    height = wrench @ normal.T - offset
    outer = (height.amax(0) < 1e-9) | (height.amin(0) > -1e-9)
    return float(offset[outer].abs().min())


def test_epsilon_is_the_distance_of_the_nearest_plane_that_bounds_the_hull(generator):
    points, normals = closed_contacts(generator, 6)
    spec = dataclasses.replace(SPEC, edges=4)
    w = wrenches(points, normals, spec.planned_friction, spec.edges).flatten(1, 2)
    inside = certify(Contacts(points, normals), spec).closed
    assert int(inside.sum()) >= 3
    epsilon = -epsilon_cost(spec, points, normals)
    assert torch.equal(epsilon > 0, inside)
    wanted = torch.tensor([nearest_plane(each) for each in w[inside]], dtype=torch.float64)
    torch.testing.assert_close(epsilon[inside], wanted, atol=1e-9, rtol=0)


def test_contacts_that_span_nothing_have_no_epsilon():
    points = torch.zeros(1, 3, 3, dtype=torch.float64)
    normals = torch.eye(3, dtype=torch.float64)[None]
    assert float(epsilon_cost(SPEC, points, normals)) == 0.0


@pytest.mark.parametrize("fingertips", [3, 4])
@pytest.mark.parametrize("cost", [min_weight_cost, epsilon_cost])
def test_gradients_of_named_objectives_match_finite_differences(generator, cost, fingertips):
    points, normals = closed_contacts(generator, 12, fingertips)
    move = torch.randn(points.shape, generator=generator, dtype=torch.float64)
    x = points.clone().requires_grad_()
    (slope,) = torch.autograd.grad(cost(SPEC, x, normals).sum(), x)
    h = 1e-6
    up, down = (cost(SPEC, points + s * h * move, normals) for s in (1, -1))
    torch.testing.assert_close((slope * move).sum((1, 2)), (up - down) / (2 * h), atol=1e-5, rtol=1e-4)


def test_the_gradient_of_a_cost_follows_the_normals_along_the_surface(ellipsoid, generator):
    weight = torch.randn(3, 3, generator=generator, dtype=torch.float64)

    def cost(points: Tensor, normals: Tensor) -> Tensor:
        return (points.square() * weight).sum((1, 2)) + (normals * weight.T).sum((1, 2))

    def value(x: Tensor) -> Tensor:
        return cost(ellipsoid.metres(x), triple_jet(ellipsoid, x).normals)

    points = 0.8 * torch.randn(4, 3, 3, generator=generator, dtype=torch.float64)
    wanted = torch.autograd.functional.jacobian(lambda x: value(x).sum(), points)
    found, gradient = differentiate_cost(cost, ellipsoid, start_state(ellipsoid, points))
    torch.testing.assert_close(found, value(points))
    torch.testing.assert_close(gradient[:, :9], wanted.flatten(1))
    assert not bool(gradient[:, 9:].any())


def highest(points: Tensor, normals: Tensor) -> Tensor:
    return -1000 * points[..., 2].sum(-1)


@pytest.mark.parametrize(
    ("objective", "gain", "fingertips"),
    [("min_weight", 1.15, 3), ("epsilon", 1.1, 3), (highest, None, 3), ("min_weight", 1.05, 5), (highest, None, 4)],
)
def test_an_objective_gets_lower_than_from_the_centre_alone(ellipsoid, objective, gain, fingertips):
    count, spec = 8 if objective == "epsilon" else 40, dataclasses.replace(SPEC, fingertips=fingertips)
    plain = plan_contacts(ellipsoid, spec, starts=count)
    plan = plan_contacts(ellipsoid, spec, starts=count, objective=objective)
    assert torch.equal(plan.status == Status.OK, plain.status == Status.OK)
    good = plan.status == Status.OK
    contacts, before = plan.contacts[good], plain.contacts[good]
    assert bool(certify(contacts, spec).closed.all())
    named = {"min_weight": min_weight_cost, "epsilon": epsilon_cost}
    if gain is None:
        new, old = (highest(c.points, c.normals) for c in (contacts, before))
        assert float((old - new).mean()) > 5.0  # 5 mm in the sum of three heights
    else:
        new, old = (named[objective](spec, c.points, c.normals) for c in (contacts, before))
        assert float(new.mean() / old.mean()) > gain
    assert bool((new <= old + 1e-12).all())
    torch.testing.assert_close(plan.quality[good], new)


def test_what_is_no_objective_is_refused_before_any_work(ellipsoid):
    class Idle(type(ellipsoid)):
        def jet(self, x: Tensor) -> None:
            raise AssertionError("work was begun")

    idle = Idle()
    with pytest.raises((BadArgument, TypeError), match="objective"):
        plan_contacts(idle, SPEC, starts=3, objective="best")  # pyright: ignore[reportArgumentType]
    with pytest.raises(BadArgument, match=r"objective: expected .*got 'probability' with a Idle"):
        plan_contacts(idle, SPEC, starts=3, objective="probability")
    with pytest.raises(BadArgument, match=r"objective: expected .*got a cost that returns"):
        plan_contacts(idle, SPEC, starts=3, objective=lambda points, normals: points.sum())
    with pytest.raises(BadArgument, match=r"objective: expected .*got a cost without a gradient"):
        plan_contacts(idle, SPEC, starts=3, objective=lambda points, normals: points.detach()[:, 0, 0])


def test_rows_without_a_gradient_stay_as_they_were(ellipsoid):
    plain = plan_contacts(ellipsoid, SPEC, starts=12)
    plan = plan_contacts(ellipsoid, SPEC, starts=12, objective=lambda points, normals: points.sum((1, 2)) * torch.nan)
    torch.testing.assert_close(plan.contacts.points, plain.contacts.points)
    assert torch.equal(plan.status, plain.status)


def test_probability_gets_greater_also_on_other_draws():
    shape = fit_shape(load_object("jug").view, table=0.0)
    spec = ContactSpec(table=0.0)
    plain, plan = (plan_contacts(shape, spec, 8, objective=o) for o in ("center", "probability"))
    good = plan.status == Status.OK
    assert torch.equal(good, plain.status == Status.OK)
    assert int(good.sum()) >= 7
    assert bool(certify(plan.contacts[good], spec).closed.all())
    before, after = (closure_probability(shape, p.contacts[good], spec, n=800, seed=7) for p in (plain, plan))
    assert float((1 - after.probability).mean()) < 0.8 * float((1 - before.probability).mean())
    assert float((after.probability + plan.quality[good]).abs().max()) < 6 * 0.028  # of both counts
    tension = torch.ones(8, 3, dtype=torch.float64)
    together, alone = (raise_probability(shape, spec, 0, plain[rows], tension[rows]) for rows in (good, [2]))
    torch.testing.assert_close(alone.contacts.points[0], together.contacts.points[int(good[:2].sum())])
