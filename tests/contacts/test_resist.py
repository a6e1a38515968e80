"""How much of a load contacts resist: against HiGHS, and by both proofs, checked in the frame of
the caller.
"""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from tests.make import directions, real
from torchgrasp import ContactSpec
from torchgrasp.contacts.form_closure import cone_edges, tangents
from torchgrasp.contacts.resist import Resisted, resist_loads
from torchgrasp.geometry.linalg import unit

SPEC = ContactSpec()
PLACE = real([1.0, 2.0, 0.5])


def wrench_matrix(points, normals, friction=SPEC.planned_friction):
    """Wrenches (6, f e) about the origin of the forces along the cones' edges, with normal parts of
    1 N.
    """
    edges = cone_edges(normals[None], tangents(points[None], normals[None]), friction, SPEC.edges)[
        0
    ]
    return np.concatenate([edges, np.cross(points[:, None], edges)], -1).reshape(-1, 6).T


def by_highs(points, normals, strength, load, friction=SPEC.planned_friction) -> float:
    matrix = wrench_matrix(points, normals, friction)
    f = len(points)
    most = np.zeros((f, matrix.shape[1] + 1))
    for contact in range(f):
        most[contact, contact * SPEC.edges : (contact + 1) * SPEC.edges] = 1
    found = linprog(
        np.r_[np.zeros(matrix.shape[1]), -1],
        most,
        strength,
        np.c_[matrix, load],
        np.zeros(6),
        method="highs",
    )
    return -found.fun


@pytest.fixture(params=[3, 4, 5])
def case(request, generator) -> tuple[Resisted, tuple]:
    """Random contacts and loads on an object far from the origin, and what they resist."""
    b = 40
    f = request.param
    arms, noise = (torch.randn(b, f, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    normals = unit(unit(arms - arms.mean(1, keepdim=True)) + 0.3 * noise)
    points = 0.05 * arms + PLACE
    strength = 5 + 10 * torch.rand(b, f, generator=generator, dtype=torch.float64)
    force = 3 * directions(3 * b, seed=1).view(b, 3, 3)
    torque = 0.1 * directions(3 * b, seed=2).view(b, 3, 3)
    torque = torque + torch.linalg.cross(points.mean(1, keepdim=True).expand_as(force), force)
    loads = torch.cat([force, torque], -1)
    return resist_loads(points, normals, strength, loads, SPEC), (points, normals, strength, loads)


def test_the_margin_is_the_least_of_highs_over_the_loads(case):
    found, (points, normals, strength, loads) = case
    for k, margin in enumerate(found.margin.tolist()):
        margins = [
            by_highs(points[k], normals[k], strength[k].numpy(), load) for load in loads[k].numpy()
        ]
        assert margin == pytest.approx(min(margins), abs=1e-9)
    assert 5 < int((found.margin > 0.01).sum()) and bool((found.margin < 0.01).any())


def test_forces_prove_that_it_is_no_less_and_the_twist_that_it_is_no_more(case):
    found, (points, normals, strength, _) = case
    arms = points - points.mean(1, keepdim=True)
    push = -(found.forces * normals).sum(-1)
    slide = torch.linalg.vector_norm(found.forces + push[..., None] * normals, dim=-1)
    assert bool(
        (slide <= SPEC.planned_friction * push + 1e-9).all()
    )  # the cone with edges lies in the round one
    assert bool((push <= strength + 1e-9).all())
    total = torch.cat([found.forces.sum(1), torch.linalg.cross(arms, found.forces).sum(1)], -1)
    torch.testing.assert_close(total, -found.margin[:, None] * found.load, atol=1e-8, rtol=0)
    work = (found.twist * found.load).sum(-1)
    assert bool((work < 0).all())
    for k in range(len(points)):
        gain = (
            (found.twist[k].numpy() @ wrench_matrix(arms[k], normals[k]))
            .reshape(len(points[k]), -1)
            .max(1)
        )
        bound = float((strength[k].numpy() * np.maximum(gain, 0)).sum() / -work[k])
        assert bound == pytest.approx(float(found.margin[k]), abs=1e-8)
