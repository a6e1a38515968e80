"""Stacked shapes: each row has the values of its own cloud's shape."""

import pytest
import torch

from tests.make import cup_view
from torchgrasp import fit_shape, load_object
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.shape.batch import ShapeBatch
from torchgrasp.shape.hollow import HollowShape


@pytest.fixture(scope="module")
def shapes():
    """Two bodies and a vessel."""
    views = load_object("cylinder").view, cup_view(0.004), load_object("jug").view
    found = [fit_shape(view, table=0.0) for view in views]
    assert isinstance(found[1], HollowShape) and len({shape.n_oriented for shape in found}) > 1
    return found


@pytest.fixture
def rows(shapes, generator):
    """Rows of three points each in and around the objects, their clouds, and the stack of their
    shapes.
    """
    owner = torch.randint(len(shapes), (60,), generator=generator)
    points = 0.6 * torch.randn(60, 3, 3, generator=generator, dtype=torch.float64)
    return points, owner, ShapeBatch.of(shapes).rows(owner)


METHODS = {
    "mean and gradient": lambda shape, x: shape.mean_and_gradient(x),
    "mean jet": lambda shape, x: vars(shape.mean_jet(x)).values(),
    "jet": lambda shape, x: vars(shape.jet(x)).values(),
    "estimate": lambda shape, x: shape.estimate(x),
    "variance": lambda shape, x: [shape.variance(x)],
    "wall": lambda shape, x: [shape.wall_at(x)[:, 0]],
}


@pytest.mark.parametrize("name", METHODS)
def test_every_row_has_the_values_of_its_own_shape(shapes, rows, name):
    points, owner, stack = rows
    found = [x.unflatten(0, points.shape[:2]) for x in METHODS[name](stack, points.flatten(0, 1))]
    for k, shape in enumerate(shapes):
        own = owner == k
        for value, expected in zip(
            found, METHODS[name](shape, points[own].flatten(0, 1)), strict=True
        ):
            torch.testing.assert_close(value[own].flatten(0, 1), expected, rtol=1e-9, atol=1e-9)


def test_numbers_and_frames_of_rows_are_those_of_their_clouds(shapes, rows):
    points, owner, stack = rows
    for k, shape in enumerate(shapes):
        own = owner == k
        assert torch.equal(stack.normalise(points)[own], shape.normalise(points[own]))
        assert torch.equal(stack.metres(points)[own], shape.metres(points[own]))
        for name in ("scale", "domain_radius", "std_factor"):
            assert set(getattr(stack, name)[own].tolist()) == {float(getattr(shape, name))}


def test_some_rows_and_single_walls_can_be_asked_for(shapes, rows):
    points, owner, stack = rows
    every = stack.jet(points.flatten(0, 1))
    some = torch.tensor([7, 3, 40])
    found = stack.rows(some).jet(points[some].flatten(0, 1))
    torch.testing.assert_close(
        found.variance, every.variance.view(60, 3)[some].flatten(), rtol=1e-9, atol=1e-9
    )
    for side, wall in enumerate(stack.walls):
        own = shapes[1].walls[side].mean_and_gradient(points[owner == 1].flatten(0, 1))[0]
        distance = wall.mean_and_gradient(points.flatten(0, 1))[0].view(60, 3)
        torch.testing.assert_close(distance[owner == 1].flatten(), own)
        body = shapes[0].mean_and_gradient(points[owner == 0].flatten(0, 1))[
            0
        ]  # it has one wall, which stands for both
        torch.testing.assert_close(distance[owner == 0].flatten(), body)


def test_a_shape_with_another_kernel_is_refused(shapes):
    other = fit_shape(load_object("cylinder").view, kernel="matern52")
    with pytest.raises(BadArgument, match="thin-plate"):
        ShapeBatch.of([shapes[0], other])
