"""Steps of a batch: onto the surface and along it, never uphill, each triple by itself; and what
they reach.
"""

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.make import largest_share
from torchgrasp import ContactSpec, fit_shape, load_object, plan_contacts
from torchgrasp.contacts.descent import (
    LONGEST_STEP,
    Descent,
    Stage,
    State,
    project,
    promised_decrease,
    start_state,
)
from torchgrasp.contacts.form_closure import rank_ratio, wrenches
from torchgrasp.contacts.problem import ContactProblem, forces_from_tensions
from torchgrasp.contacts.solver import descend
from torchgrasp.geometry.linalg import unit

SPEC = ContactSpec.paper()
STAGE = Stage(centre=1.0, cones=1.0, steps=6)


def triples(ellipsoid, generator: torch.Generator, count: int = 40) -> Tensor:
    return project(
        ellipsoid, 0.7 * unit(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)), 8
    )


def cost(ellipsoid, state: State) -> Tensor:
    problem = ContactProblem.of(ellipsoid, SPEC)
    return Descent(ellipsoid, problem, STAGE).linearise(state, torch.arange(len(state))).cost


def test_points_go_to_the_nearest_place_and_a_stage_leaves_no_triple_worse(ellipsoid, generator):
    sphere = dataclasses.replace(ellipsoid, axes=(0.8, 0.8, 0.8))
    points = unit(torch.randn(20, 3, 3, generator=generator, dtype=torch.float64))
    points = points * (0.4 + 0.8 * torch.rand(20, 3, 1, generator=generator, dtype=torch.float64))
    found = project(sphere, points, 8)
    torch.testing.assert_close(found, 0.8 * unit(points))
    torch.testing.assert_close(project(sphere, found, 3), found)
    problem = ContactProblem.of(ellipsoid, SPEC)
    first = start_state(ellipsoid, triples(ellipsoid, generator))
    last = descend(ellipsoid, problem, first, STAGE)
    before = cost(ellipsoid, first)
    after = cost(ellipsoid, last)
    assert bool((after <= before).all())
    assert float((after / before).median()) < 0.2
    assert float(ellipsoid.value(last.points).abs().max()) < 0.05
    size = torch.linalg.vector_norm(
        forces_from_tensions(last.points, last.tension)[0], dim=-1
    ).mean(-1)
    torch.testing.assert_close(size, torch.ones(40, dtype=torch.float64))


def test_steps_are_bounded_and_promise_what_the_linear_model_keeps(ellipsoid, generator):
    state = start_state(ellipsoid, triples(ellipsoid, generator))
    descent = Descent(ellipsoid, ContactProblem.of(ellipsoid, SPEC), STAGE)
    model = descent.linearise(state, torch.arange(40))
    x, taken = descent.step(model, torch.full((40,), descent.first_damping, dtype=torch.float64))
    moved = torch.linalg.vector_norm(x[:, :9].unflatten(1, (3, 3)), dim=-1).amax(-1)
    assert float(moved.max()) <= LONGEST_STEP + 1e-12
    assert torch.equal(taken, moved > STAGE.settled)
    assert bool((promised_decrease(model, x) > 0).all())
    # A hundredth of the step lowers the cost by what the linear model promises of it, to first
    # order.
    x = 0.01 * x
    points = state.points + x[:, :9].unflatten(1, (3, 3))
    small = State(points, state.tension + x[:, 9:], start_state(ellipsoid, points).jet)
    promised = promised_decrease(model, x)
    assert bool(
        ((cost(ellipsoid, state) - cost(ellipsoid, small) - promised).abs() < 0.1 * promised).all()
    )


def test_each_triple_goes_its_own_way_and_settled_or_lost_ones_are_left_alone(ellipsoid, generator):
    problem = ContactProblem.of(ellipsoid, SPEC)
    points = triples(ellipsoid, generator, 12)
    together = descend(ellipsoid, problem, start_state(ellipsoid, points), STAGE)
    for i in (0, 5, 11):
        alone = descend(ellipsoid, problem, start_state(ellipsoid, points[i : i + 1]), STAGE)
        torch.testing.assert_close(alone.points[0], together.points[i])
    problem = ContactProblem.of(ellipsoid, SPEC)
    points = triples(ellipsoid, generator, 6)
    points[2, 1] = torch.nan
    state = start_state(ellipsoid, points)
    still = descend(
        ellipsoid, problem, state, dataclasses.replace(STAGE, settled=1.0)
    )  # no step is that long
    torch.testing.assert_close(still.points, points, equal_nan=True, rtol=0, atol=0)
    moved = descend(ellipsoid, problem, state, STAGE)
    assert bool(torch.isnan(moved.points[2, 1]).all())
    assert bool(torch.isfinite(moved.points[[0, 1, 3, 4, 5]]).all())


@pytest.mark.parametrize("name", ["jug", "spray"])
def test_nearly_every_single_try_solves_the_papers_problem(name, generator):
    shape = fit_shape(load_object(name).view, support="paper", budget=65)
    for radius in (0.1, 1.0):
        starts = radius * unit(torch.randn(40, 3, 3, generator=generator, dtype=torch.float64))
        plan = plan_contacts(shape, SPEC, shape.metres(starts))
        found = shape.predict(plan.contacts.points)
        x = shape.normalise(plan.contacts.points)
        good = (found.distance.abs() <= 1e-5).all(-1) & (found.variance <= SPEC.max_variance).all(
            -1
        )
        w = wrenches(x, found.normal, SPEC.friction, SPEC.edges)
        good &= rank_ratio(w) > 1e-3
        closed = torch.tensor([largest_share(each.T.numpy()) > 1e-8 for each in w.flatten(1, 2)])
        assert int((good & closed).sum()) >= 38
        assert float(x.mean(1).square().sum(-1)[good].mean()) < 1e-3  # Eq. (14), squared
