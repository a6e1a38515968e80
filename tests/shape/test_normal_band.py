"""The deviation of normals: its parts against the joint posterior and a ball, and what it says of an edge."""

import math

import pytest
import torch

from tests.make import HALF_BALL_RADIUS as RADIUS
from tests.make import half_ball as ball
from torchgrasp import PointCloud, fit_shape
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.normal_band import BEND, EDGE, FOOTPRINT, LEAST, OWN, normal_parts


def _directions(n: int, generator: torch.Generator) -> torch.Tensor:
    return unit(torch.randn(n, 3, generator=generator, dtype=torch.float64))


def test_the_own_part_is_the_variance_of_slopes_over_a_fingertip(generator):
    shape = ball(-0.2, std_factor=0.4)
    x = _directions(6, generator)
    parts = normal_parts(shape, x, RADIUS, 0.4)
    for i in range(6):
        steep = float(torch.linalg.vector_norm(shape.mean_and_gradient(x[i : i + 1])[1]))
        for k in range(2):
            pair = shape.metres(x[i] + FOOTPRINT / RADIUS * torch.stack([parts.axes[i, k], -parts.axes[i, k]]))
            joint = shape.joint(pair).covariance[::4, ::4]
            slope = (joint[0, 0] + joint[1, 1] - 2 * joint[0, 1]) / (2 * FOOTPRINT / RADIUS) ** 2
            assert float(parts.own[i, k]) == pytest.approx(float(0.4**2 * slope) / steep**2, rel=1e-6)
        frame = torch.cat([parts.axes[i], unit(shape.mean_and_gradient(x[i : i + 1])[1])])
        torch.testing.assert_close(frame @ frame.T, torch.eye(3).double())


def test_on_a_ball_a_wrong_place_turns_the_normal_by_its_distance_over_the_radius(generator):
    shape = ball(-2.0, std_factor=0.5)
    x = _directions(20, generator)
    parts = normal_parts(shape, x, RADIUS, 0.5)
    error = shape.predict(shape.metres(x)).std_m / RADIUS  # radians
    torch.testing.assert_close(parts.bend.sqrt(), error[:, None].expand(20, 2), rtol=0.15, atol=0)
    # No edge: a short distance shows the bend that a long one shows.
    assert float(parts.edge.sqrt().median()) < 0.06 / RADIUS
    whole = OWN**2 * parts.own + BEND**2 * parts.bend + EDGE**2 * parts.edge + LEAST**2
    torch.testing.assert_close(shape.normal_std(shape.metres(x)), whole.mean(-1).sqrt())


@pytest.fixture(scope="module")
def box() -> PointCloud:
    """A box of 60 mm with normals, all around."""
    grid = torch.linspace(-0.03, 0.03, 13)
    u, v = (t.reshape(-1) for t in torch.meshgrid(grid, grid, indexing="ij"))
    points, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = torch.stack([u, v], 1)
            points.append(torch.cat([face[:, :axis], torch.full((len(u), 1), 0.03 * side), face[:, axis:]], 1))
            normals.append((side * torch.eye(3)[axis]).expand(len(u), 3))
    inner = torch.cat(points).abs().sort(1).values[:, 1] < 0.0299  # faces without their edges
    return PointCloud(torch.cat(points)[inner], torch.cat(normals)[inner])


def test_it_is_wide_at_an_edge_and_narrow_on_a_face(box):
    shape = fit_shape(box)
    faces = torch.tensor([[0.03, 0.0, 0.0], [0.0, -0.03, 0.005], [0.004, 0.0, 0.03]])
    edges = torch.tensor([[0.029, 0.029, 0.0], [0.0, -0.029, 0.029], [0.029, 0.0, -0.029]])
    face, edge = shape.normal_std(faces), shape.normal_std(edges)
    assert float(face.max()) < math.radians(6) < 2 * float(face.max()) < float(edge.min())
    assert face.dtype == faces.dtype and shape.normal_std(faces[None]).shape == (1, 3)
    assert shape.normal_std(faces[:0]).shape == (0,)
    with pytest.raises(BadArgument, match="domain"):
        shape.normal_std(10 * faces)


def test_it_turns_with_the_object(box):
    shape = fit_shape(box)
    angle = torch.tensor(0.7)
    turn = torch.eye(4)
    turn[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    turn[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    points = torch.tensor([[0.03, 0.002, 0.01], [0.029, 0.029, 0.004]])
    moved = shape.moved(turn).normal_std(points @ turn[:3, :3].T + turn[:3, 3])
    torch.testing.assert_close(moved, shape.normal_std(points), rtol=0.05, atol=0)
