"""Survival of closure on balls: a shape that is true loses nothing, a turned surface loses everything."""

import math

import pytest
import torch
import trimesh
from benchmarks.plan.closure_survival import closure_survival

from torchgrasp.shape.fit import condition
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.values import Normalisation, Observations
from torchgrasp.values import PointCloud

RADIUS = 0.04


@pytest.fixture(scope="module")
def shape() -> ShapeGP:
    """A ball on the ground, observed everywhere."""
    n = torch.randn(150, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    center = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)
    x = torch.cat([n, torch.zeros(1, 3, dtype=torch.float64), 1.2 * n[:40]])
    distance = torch.cat([torch.zeros(150), torch.tensor([-1.0]), torch.full((40,), 0.2)]).double()
    oriented = torch.arange(len(x)) < 150
    noise = torch.full_like(distance, 0.01)
    observations = Observations(x, distance, torch.cat([n, torch.zeros_like(x[150:])]), oriented, noise, noise)
    return condition(observations, Normalisation(center, RADIUS), PointCloud(RADIUS * n + center, n))


def _ball(stretch: float = 1.0) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    mesh.apply_scale([1.0, 1.0, stretch])
    mesh.apply_translation([0.0, 0.0, RADIUS * stretch])
    return mesh


def test_what_is_closed_on_a_true_shape_stays_closed(shape: ShapeGP):
    found = closure_survival(shape, _ball())
    assert found["sure_0.6"] > 0.97 and found["sure_0.8"] == 1.0
    assert found["sure_yield"] > 0.05
    # A ball of 40 mm turns by 11.5 degrees over 8 mm: all of it is flat.
    assert found["flat_0.6"] == found["flat_0.8"] == 1.0
    assert 0.0 < found["flat_yield"] < found["sure_yield"]


def test_a_true_surface_of_another_form_loses_closures_and_more_friction_saves_some(shape: ShapeGP):
    found = closure_survival(shape, _ball(0.3))
    assert found["sure_0.6"] < 0.9 and found["sure_0.6"] < found["sure_0.8"]


def test_a_shape_that_is_nowhere_sure_says_nothing(shape: ShapeGP):
    mesh = _ball()
    mesh.apply_translation([0.0, 0.0, 1.0])  # every contact is below the least height
    found = closure_survival(shape, mesh)
    assert math.isnan(found["sure_0.6"]) and found["sure_yield"] == 0.0
