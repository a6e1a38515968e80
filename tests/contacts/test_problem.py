"""The rows of Eqs. (10)-(14) against their definitions, and their Jacobian against automatic
differentiation.
"""

import dataclasses
import itertools
import math

import pytest
import torch
from torch import Tensor

from torchgrasp import ContactSpec
from torchgrasp.contacts.form_closure import closed_exact
from torchgrasp.contacts.problem import (
    CONE_MARGIN,
    INSIDE,
    LEAST_SIDE,
    Constraints,
    ContactProblem,
    contact_pairs,
    forces_from_tensions,
    split_unknowns,
    triple_jet,
)
from torchgrasp.geometry.linalg import unit

CPU = torch.device("cpu")
SPEC = ContactSpec(table=0.47, tip_radius=0.03, separation=0.03)


FINGERTIPS = pytest.mark.parametrize("fingertips", [3, 4, 5])


def with_fingertips(fingertips: int, spec: ContactSpec = SPEC) -> ContactSpec:
    return dataclasses.replace(spec, fingertips=fingertips)


def problem_and_state(
    ellipsoid, generator: torch.Generator, spec: ContactSpec = SPEC, count: int = 6
):
    problem = ContactProblem.of(ellipsoid, spec)
    f = spec.fingertips
    points = 0.8 * torch.randn(count, f, 3, generator=generator, dtype=torch.float64)
    tension = 1 + 0.5 * torch.randn(
        count, f * (f - 1) // 2, generator=generator, dtype=torch.float64
    )
    return problem, points, tension, triple_jet(ellipsoid, points)


def test_eq10_to_eq12_and_eq14_rows_are_distance_gradient_variance_and_mean(ellipsoid, generator):
    problem, points, tension, jet = problem_and_state(ellipsoid, generator)
    rows = problem.constraints(points, tension, jet)
    torch.testing.assert_close(rows.surface, ellipsoid.value(points))
    x = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(ellipsoid.value(x).sum(), x)
    torch.testing.assert_close(jet.normals, unit(gradient))
    assert torch.equal(
        rows.bounds[:, 3:6] > 0, ellipsoid.doubt_at(points) > INSIDE * SPEC.max_variance
    )
    torch.testing.assert_close(rows.centre, points.mean(1))


@FINGERTIPS
def test_eq13_forces_balance_and_cone_rows_are_their_cosines_and_imply_closure(
    ellipsoid, generator, fingertips
):
    _, points, tension, _ = problem_and_state(ellipsoid, generator, with_fingertips(fingertips))
    force, _ = forces_from_tensions(points, tension)
    zero = torch.zeros(6, 3, dtype=torch.float64)
    torch.testing.assert_close(force.sum(1), zero)
    torch.testing.assert_close(torch.linalg.cross(points, force).sum(1), zero)
    pairs = tension.shape[1]
    alone = forces_from_tensions(
        points[:1].expand(pairs, -1, -1), torch.eye(pairs, dtype=torch.float64)
    )[0].flatten(1)
    assert (
        int(torch.linalg.matrix_rank(alone)) == 3 * fingertips - 6
    )  # as many as forces that balance have dimensions
    spec = with_fingertips(fingertips, ContactSpec.paper())
    problem, points, tension, jet = problem_and_state(ellipsoid, generator, spec, count=4000)
    rows = problem.constraints(points, tension, jet).bounds[:, :fingertips]
    force, _ = forces_from_tensions(points, tension)
    cosine = -(unit(force) * jet.normals).sum(-1)
    cone = math.cos(math.atan(0.8 * math.cos(math.pi / 8)))
    torch.testing.assert_close(rows, cone + CONE_MARGIN - cosine)
    held = (rows <= 0).all(-1)
    assert int(held.sum()) > 10
    assert bool(closed_exact(points[held], jet.normals[held], problem.friction).all())


@FINGERTIPS
def test_bounds_name_ball_separation_and_table(ellipsoid, generator, fingertips):
    problem, points, tension, jet = problem_and_state(
        ellipsoid, generator, with_fingertips(fingertips)
    )
    rows = problem.constraints(points, tension, jet).bounds
    f = fingertips
    pairs = tension.shape[1]
    _, _, inside, distances, heights = rows.split([f, f, f, pairs, f], 1)
    assert torch.equal(inside > 0, torch.linalg.vector_norm(points, dim=-1) > INSIDE * 1.35)
    centres = ellipsoid.metres(points) + 0.03 * jet.normals
    apart = torch.stack(
        [(centres[:, i] - centres[:, j]).norm(dim=-1) for i, j in contact_pairs(f, CPU).T], 1
    )
    assert torch.equal(distances > 0, apart < SPEC.least_separation / INSIDE)
    assert {frozenset(pair) for pair in contact_pairs(f, CPU).T.tolist()} == set(
        map(frozenset, itertools.combinations(range(f), 2))
    )
    height = ellipsoid.metres(points)[..., 2]
    above = heights <= 0
    lowest = height + 0.03 * (jet.normals[..., 2] - 1)  # of a fingertip there
    assert bool((lowest[above] >= 0.47).all())
    assert bool(above[lowest > 0.47 + 1e-4].all()) and bool(
        ((lowest < 0.47) & (height > 0.47)).any()
    )
    paper = ContactProblem.of(ellipsoid, ContactSpec.paper())
    assert not paper.table
    assert paper.separation == LEAST_SIDE


@FINGERTIPS
def test_jacobian_of_every_row_against_automatic_differentiation(ellipsoid, generator, fingertips):
    problem, points, tension, jet = problem_and_state(
        ellipsoid, generator, with_fingertips(fingertips)
    )
    rows = problem.constraints(points, tension, jet)

    def values(x: Tensor) -> tuple[Tensor, ...]:
        points, tension = split_unknowns(x)
        r: Constraints = problem.constraints(points, tension, triple_jet(ellipsoid, points))
        return r.surface.sum(0), r.centre.sum(0), r.bounds.sum(0)

    wanted = torch.autograd.functional.jacobian(values, torch.cat([points.flatten(1), tension], 1))
    for by_x, found in zip(
        wanted, (rows.surface_by_x, rows.centre_by_x, rows.bounds_by_x), strict=True
    ):
        torch.testing.assert_close(found, by_x.permute(1, 0, 2))
