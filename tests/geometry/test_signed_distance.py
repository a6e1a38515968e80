"""Distance fields against analytic surfaces."""

import pytest
import torch
import trimesh

from tests.make import field_of_mesh, real
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.field_batch import FieldBatch
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.mesh_distance import surface_distance
from torchgrasp.geometry.signed_distance import SignedDistanceField, field_from_surface
from torchgrasp.hand.self_collision import box_distance


def test_distance_field_of_a_sphere(generator):
    ball = trimesh.creation.icosphere(5, 0.04)
    field = field_of_mesh(ball, margin=0.05)
    points = 0.08 * (2 * torch.rand(4000, 3, generator=generator, dtype=torch.float64) - 1)
    distance, gradient = field.query(points)
    radius = torch.linalg.vector_norm(points, dim=1)
    assert (
        float((distance - (radius - 0.04)).abs().max()) < 3e-3
    )  # interpolated far from the surface
    near = (radius - 0.04).abs() < 0.018
    assert float((distance - (radius - 0.04)).abs()[near].max()) < 4e-4
    cosine = (gradient[near] * points[near]).sum(1) / radius[near]
    assert float((cosine - 1).abs().max()) < 0.15
    assert bool(((distance < 0) == (radius < 0.04))[(radius - 0.04).abs() > 1e-3].all())


def test_distance_field_of_a_box_has_the_right_sides(generator):
    box = trimesh.creation.box(extents=[0.03, 0.06, 0.12])  # twelve large triangles
    field = field_of_mesh(box, margin=0.03)
    points = 0.06 * torch.randn(3000, 3, generator=generator, dtype=torch.float64)
    points = points.clamp(-0.04, 0.04)
    half = real([0.015, 0.03, 0.06])
    truth = box_distance(points, half.expand_as(points))
    error = (field.query(points)[0] - truth).abs()
    assert float(error.max()) < 2e-3
    assert float(error.median()) < 2e-4


def test_distance_field_gradient_is_the_derivative_and_follows_dtype_and_shape_of_the_points(
    generator,
):
    field = field_of_mesh(trimesh.creation.icosphere(3, 0.03), margin=0.02)
    points = (0.06 * torch.randn(300, 3, generator=generator, dtype=torch.float64)).requires_grad_()
    distance, gradient = field.query(points)
    (derivative,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(gradient, derivative, atol=1e-9, rtol=0)
    far = real([[1.0, 0, 0]])
    reach = field.origin[0] + field.spacing * (field.values.shape[0] - 1)
    at_border, _ = field.query(torch.stack([reach, far[0, 1], far[0, 2]])[None])
    torch.testing.assert_close(field.query(far)[0], at_border + 1.0 - reach)
    field = field_of_mesh(trimesh.creation.icosphere(2, 0.03), margin=0.02)
    distance, gradient = field.query(torch.zeros(2, 3, 4, 3))
    assert (distance.shape, gradient.shape, distance.dtype) == (
        (2, 3, 4),
        (2, 3, 4, 3),
        torch.float32,
    )
    torch.testing.assert_close(field.to(torch.float32).query(torch.zeros(2, 3, 4, 3))[0], distance)


def test_distances_of_open_meshes_do_not_vanish_where_their_sign_jumps():
    side = 0.02
    vertices = torch.tensor(
        [[-side, -side, 0], [side, -side, 0], [side, side, 0], [-side, side, 0]]
    ).double()
    field = field_from_surface(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), margin=0.05)
    assert field.values.is_contiguous()  # else each query copies the whole grid
    axes = (
        low + field.spacing * torch.arange(n)
        for low, n in zip(field.origin, field.values.shape, strict=True)
    )
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    beyond = torch.stack(
        [(nodes[..., k].abs() - side).clamp_min(0) for k in range(2)] + [nodes[..., 2]], -1
    )
    error = (field.values.abs() - torch.linalg.vector_norm(beyond, dim=-1)).abs()
    assert float(error.max()) < 2e-3
    assert float(error.median()) < 1e-4
    vertices = real([[0.0, 0, 0], [0.03, 0, 0], [0, 0.03, 0]])
    field = field_from_surface(vertices, torch.tensor([[0, 1, 2]]), margin=0.0)
    distance, _ = field.query(real([[0.008, 0.008, 0.004]]))
    assert float(distance) == pytest.approx(0.004, abs=1e-6)


def test_distances_from_a_mesh_are_those_from_its_triangles(generator):
    ball = trimesh.creation.icosphere(4, 0.04)
    points = 0.048 * unit(torch.randn(100, 3, generator=generator, dtype=torch.float64))
    found = surface_distance(real(ball.vertices), torch.tensor(ball.faces))(points.numpy())
    naive = trimesh.proximity.closest_point_naive(ball, points.numpy())[1]
    assert float(abs(found - naive).max()) < 1e-4


def test_bad_surfaces_are_named():
    vertices = torch.eye(3, dtype=torch.float64)
    with pytest.raises(BadArgument, match="faces"):
        field_from_surface(vertices, torch.tensor([[0, 1, 3]]))
    with pytest.raises((BadArgument, TypeError), match="faces"):
        field_from_surface(vertices, torch.ones(2, 3))
    with pytest.raises(BadArgument, match="without area"):
        field_from_surface(vertices, torch.tensor([[0, 1, 1]]))
    with pytest.raises(BadArgument, match="spacing"):
        field_from_surface(vertices, torch.tensor([[0, 1, 2]]), spacing=0.0)
    with pytest.raises(BadArgument, match="nodes"):
        field_from_surface(vertices, torch.tensor([[0, 1, 2]]), spacing=0.001)


def test_a_field_without_cells_is_refused():
    """Between mirrored nodes, or along an axis of one node, there is nothing to interpolate."""
    origin = real([0.0, 0.0, 0.0])
    for spacing, shape, named in (
        (-0.1, (2, 2, 2), "spacing"),
        (0.0, (2, 2, 2), "spacing"),
        (0.1, (2, 1, 2), "values"),
        (0.1, (0, 2, 2), "values"),
    ):
        with pytest.raises(BadArgument, match=f"{named}: expected"):
            SignedDistanceField(origin, spacing, torch.ones(shape).double())


def test_every_row_of_joined_fields_has_the_distances_of_its_own_field(generator):
    shapes = ((9, 7, 8), (5, 12, 6), (8, 8, 8))
    fields = list[SignedDistanceField]()
    for k, shape in enumerate(shapes):
        low = torch.rand(3, generator=generator).double() - 0.6
        values = torch.randn(shape, generator=generator).double()
        fields.append(SignedDistanceField(low, 0.05 + 0.01 * k, values))
    owner = torch.randint(3, (50,), generator=generator)
    points = torch.randn(
        50, 4, 3, generator=generator, dtype=torch.float64
    )  # some outside the grids
    joined = FieldBatch.of(fields).rows(owner)
    for ask in (lambda field, x: field.query(x), lambda field, x: [field.nearest_node(x)]):
        found = ask(joined, points)
        for k, field in enumerate(fields):
            for value, expected in zip(found, ask(field, points[owner == k]), strict=True):
                torch.testing.assert_close(value[owner == k], expected)
    assert set(joined.spacing[owner == 2].tolist()) == {fields[2].spacing}
