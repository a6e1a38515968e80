"""Solids drawn from a posterior deviate from its mean as it says."""

import numpy as np
import pytest
import torch
from benchmarks.close.drawn import GROUND, draw_solid

from tests.make import cup_view
from torchgrasp import fit_shape, load_object
from torchgrasp.errors import BadArgument
from torchgrasp.shape.surface import extract_surface

SHAPE = fit_shape(load_object("cylinder").view, table=0.0)
SURFACE = extract_surface(SHAPE)


def lengths(seed):
    """Return how far each vertex moved along its normal [m]."""
    mesh = draw_solid(SHAPE, seed)
    assert np.array_equal(mesh.faces, SURFACE.faces.numpy()) and mesh.is_watertight
    moved = torch.from_numpy(np.asarray(mesh.vertices)) - SURFACE.vertices
    along = (moved * SURFACE.normals).sum(1)
    torch.testing.assert_close(moved, along[:, None] * SURFACE.normals)
    return along


def test_draws_spread_as_the_deviations_say():
    drawn = torch.stack([lengths(seed) for seed in range(60)])
    height = SURFACE.vertices[:, 2] - SURFACE.vertices[:, 2].min()
    free = height > GROUND
    score = drawn[:, free] / SURFACE.std_m[free]
    assert float(score.pow(2).mean().sqrt()) == pytest.approx(1.0, abs=0.12)  # linear in between: a little less
    assert float(score.mean(0).abs().mean()) < 3 / 60**0.5
    foot = height < 1e-9
    assert bool((drawn[:, foot] == 0).all())


def test_a_draw_is_of_its_seed():
    assert torch.equal(lengths(3), lengths(3)) and not torch.equal(lengths(3), lengths(4))


def test_vessels_are_refused():
    vessel = fit_shape(cup_view(0.004), table=0.0)
    assert len(vessel.walls) == 2
    with pytest.raises(BadArgument, match="one closed wall"):
        draw_solid(vessel, 0)
