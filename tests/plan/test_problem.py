"""The rows of Eqs. (10)-(14) against their definitions, and their Jacobian against automatic differentiation."""

import dataclasses

import pytest
import torch
from torch import Tensor

from torchgrasp.linalg import unit
from torchgrasp.plan.problem import INSIDE, UNIFORM_SHARE, ContactProblem, Rows, triple_jet
from torchgrasp.plan.wrench import tangents, wrenches
from torchgrasp.specs import ContactSpec

SPEC = ContactSpec(table=0.47, contact_height=0.012, separation=0.03)


def problem_and_state(ellipsoid, generator: torch.Generator, spec: ContactSpec = SPEC):
    problem = ContactProblem.of(ellipsoid, spec)
    points = 0.8 * torch.randn(6, 3, 3, generator=generator, dtype=torch.float64)
    z = torch.randn(6, 3, spec.edges, generator=generator, dtype=torch.float64)
    jet = triple_jet(ellipsoid, points)
    return problem, points, z, tangents(points, jet.normals), jet


def test_eq10_surface_rows_are_the_distance_at_the_points(ellipsoid, generator):
    problem, points, z, tangent, jet = problem_and_state(ellipsoid, generator)
    torch.testing.assert_close(problem.rows(points, z, tangent, jet).surface, ellipsoid.value(points))


def test_eq11_normals_are_the_unit_outward_gradient(ellipsoid, generator):
    *_, points, _, _, jet = problem_and_state(ellipsoid, generator)
    x = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(ellipsoid.value(x).sum(), x)
    torch.testing.assert_close(jet.normals, unit(gradient))


def test_eq12_variance_row_is_positive_exactly_where_the_variance_exceeds_the_threshold(ellipsoid, generator):
    problem, points, z, tangent, jet = problem_and_state(ellipsoid, generator)
    rows = problem.rows(points, z, tangent, jet)
    assert torch.equal(rows.bounds[:, :3] > 0, ellipsoid.doubt_at(points) > INSIDE * SPEC.max_variance)


def test_eq13_closure_rows_are_the_weighted_sum_of_the_wrenches(ellipsoid, generator):
    problem, points, z, tangent, jet = problem_and_state(ellipsoid, generator)
    rows = problem.rows(points, z, tangent, jet)
    phi = problem.coefficients(z)
    torch.testing.assert_close(phi.sum((1, 2)), torch.ones(6, dtype=torch.float64))
    assert phi.min() >= UNIFORM_SHARE / 24
    expected = (phi[..., None] * wrenches(points, jet.normals, SPEC.planned_friction, SPEC.edges)).sum((1, 2))
    centre = points.mean(1)
    radius = ((points - centre[:, None]) ** 2).sum((1, 2)).div(3).sqrt()
    torch.testing.assert_close(rows.closure[:, :3], expected[:, :3])
    about_centre = rows.closure[:, 3:] - torch.linalg.cross(centre, rows.closure[:, :3])
    torch.testing.assert_close(about_centre, expected[:, 3:] * radius[:, None])


def test_eq14_centre_rows_are_the_mean_of_the_contacts(ellipsoid, generator):
    problem, points, z, tangent, jet = problem_and_state(ellipsoid, generator)
    torch.testing.assert_close(problem.rows(points, z, tangent, jet).centre, points.mean(1))


def test_bounds_name_ball_separation_and_table(ellipsoid, generator):
    problem, points, z, tangent, jet = problem_and_state(ellipsoid, generator)
    bounds = problem.rows(points, z, tangent, jet).bounds
    assert bounds.shape == (6, 12)
    assert torch.equal(bounds[:, 3:6] > 0, torch.linalg.vector_norm(points, dim=-1) > INSIDE * 1.35)
    apart = torch.linalg.vector_norm(points - points.roll(-1, 1), dim=-1) * ellipsoid.scale
    assert torch.equal(bounds[:, 6:9] > 0, apart < SPEC.separation / INSIDE)
    height = ellipsoid.metres(points)[..., 2]
    assert bool((height[bounds[:, 9:] <= 0] >= 0.47 + 0.012).all())
    assert problem_and_state(ellipsoid, generator, ContactSpec.paper())[0].lowest is None


@pytest.mark.parametrize("edges", [3, 8])
def test_jacobian_of_every_row_against_automatic_differentiation(ellipsoid, generator, edges):
    spec = dataclasses.replace(SPEC, edges=edges)
    problem, points, z, tangent, jet = problem_and_state(ellipsoid, generator, spec)
    rows = problem.rows(points, z, tangent, jet)

    def values(points: Tensor, z: Tensor) -> tuple[Tensor, ...]:
        # The tangent is carried along the surface inside `rows`, so it is held here.
        r: Rows = problem.rows(points, z, tangent, triple_jet(ellipsoid, points))
        return r.surface.sum(0), r.closure.sum(0), r.centre.sum(0), r.bounds.sum(0)

    by_points, by_z = zip(*torch.autograd.functional.jacobian(values, (points, z)), strict=True)
    analytic = (rows.surface_by_points, rows.closure_by_points, rows.centre_by_points, rows.bounds_by_points)
    for wanted, found in zip(by_points, analytic, strict=True):
        torch.testing.assert_close(found, wanted.permute(1, 0, 2, 3).flatten(2))
    torch.testing.assert_close(rows.closure_by_z, by_z[1].permute(1, 0, 2, 3).flatten(2))
