"""A vessel's two walls: the field against a known cup, and its laws against those of each wall."""

import pytest
import torch
from torch import Tensor

from tests.make import CUP_HEIGHT as HEIGHT
from tests.make import CUP_RADIUS as RADIUS
from tests.make import cup, cup_view, near, real
from tests.make import cylinder_points as ring
from torchgrasp import Contacts, fit_shape
from torchgrasp.contacts.closure_probability import line_posterior
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.mesh import closest_on_triangles
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.hollow import HollowShape, Middle, tie_walls
from torchgrasp.shape.surface import extract_surface

WALL = 0.003


@pytest.fixture(scope="module")
def vessel() -> HollowShape:
    shape = fit_shape(cup_view(WALL), table=0.0)
    assert isinstance(shape, HollowShape)
    return shape


def _both_walls() -> tuple[Tensor, Tensor]:
    """Points of the cup's walls all around, off the rim and the floor, with outward normals."""
    (outer, out), (inner, into) = (
        ring(RADIUS, 0.012, HEIGHT - 0.01),
        ring(RADIUS - WALL, 0.012, HEIGHT - 0.01),
    )
    return torch.cat([outer, inner]), torch.cat([out, -into])


def test_both_walls_are_surfaces_the_inside_is_empty_and_all_moves_with_the_vessel(
    vessel: HollowShape, motion: Tensor
):
    points, normals = _both_walls()
    found = vessel.predict(points)
    off = found.distance.abs() * vessel.scale
    assert off.median() < 0.0015 and off.quantile(0.9) < 0.003
    assert torch.rad2deg(torch.arccos((found.normal * normals).sum(-1))).median() < 8
    assert (off < 2 * found.std_m).double().mean() > 0.8
    middle, _ = ring(RADIUS - WALL / 2, 0.012, HEIGHT - 0.012)
    assert (vessel.predict(middle).distance < 0).double().mean() > 0.8
    empty = torch.cat([ring(r, 0.02, HEIGHT + 0.01)[0] for r in (0.001, 0.012, 0.024)])
    assert (vessel.predict(empty).distance > 0).all()
    around, _ = ring(RADIUS + 0.008, 0.012, HEIGHT)
    assert (vessel.predict(around).distance > 0).all()
    points, _ = _both_walls()
    there = points @ motion[:3, :3].T + motion[:3, 3]
    found = vessel.predict(points)
    moved = vessel.moved(motion).predict(there)
    near(moved.distance, found.distance, 1e-9)
    near(moved.normal, found.normal @ motion[:3, :3].T, 1e-8)


def test_an_estimate_without_covariance_is_the_same_else(vessel: HollowShape):
    """On both walls, and outside the domain, with its slope there."""
    points, _ = _both_walls()
    out = vessel.center + real([[0.0, 0.0, 1.5]]) * vessel.domain_radius * vessel.scale
    points = torch.cat([points, out])
    for shape in (vessel, vessel.outer):
        whole = shape.predict(points)
        short = shape.predict(points, covariance=False)
        assert short.covariance is None
        for name in ("distance", "normal", "variance", "std_m"):
            near(getattr(short, name), getattr(whole, name), 1e-10)

        def total(x: Tensor, covariance: bool, shape: ShapeGP = shape) -> Tensor:
            found = shape.predict(x, covariance=covariance)
            return found.std_m.sum() + found.normal.sum()

        near(torch.func.grad(total)(points, False), torch.func.grad(total)(points, True), 1e-6)


def test_a_touch_moves_the_wall_that_it_meets_and_closed_bodies_have_one_surface(
    seen_cylinder, vessel: HollowShape
):
    assert not isinstance(fit_shape(cup_view(WALL)), HollowShape)
    solid = fit_shape(seen_cylinder, table=0.0)
    assert not isinstance(solid, HollowShape) and solid.walls == (solid,)
    point = torch.tensor([[-RADIUS - 0.002, 0.0, 0.04]]).double()
    normal = torch.tensor([[-1.0, 0.0, 0.0]]).double()
    touched = vessel.update(point, normal)
    assert isinstance(touched, HollowShape)
    assert touched.predict(point).distance.abs() * vessel.scale < 0.001
    inside = vessel.normalise(ring(RADIUS - WALL, 0.03, 0.05)[0])
    torch.testing.assert_close(touched.inner.mean(inside), vessel.inner.mean(inside))


def test_the_greater_distance_counts_with_its_own_normal_and_covariance(
    vessel: HollowShape, generator
):
    x = 0.8 * unit(torch.randn(60, 3, generator=generator, dtype=torch.float64))
    outer, inner = vessel.walls
    a = outer.estimate(x)
    b = inner.estimate(x)
    inner = b[0][:, 0] > a[0][:, 0]
    assert 5 < int(inner.sum()) < 55
    mean, covariance = vessel.estimate(x)
    torch.testing.assert_close(mean, torch.where(inner[:, None], b[0], a[0]))
    torch.testing.assert_close(covariance, torch.where(inner[:, None, None], b[1], a[1]))
    torch.testing.assert_close(vessel.mean(x), mean[:, 0])
    torch.testing.assert_close(vessel.mean_and_gradient(x)[1], mean[:, 1:])
    jet = vessel.jet(x)
    torch.testing.assert_close(jet.gradient, mean[:, 1:])
    torch.testing.assert_close(jet.variance, covariance[:, 0, 0])
    torch.testing.assert_close(vessel.variance(x), covariance[:, 0, 0])
    torch.testing.assert_close(vessel.mean_jet(x).hessian, jet.hessian)
    assert vessel.jet(x[:0]).hessian.shape == (0, 3, 3)


def test_samples_of_a_wall_vary_together_and_of_two_walls_alone(vessel: HollowShape):
    outside = ring(RADIUS, 0.03, 0.05)[0][:6]
    inside = ring(RADIUS - WALL, 0.03, 0.05)[0][:6]
    points = torch.cat([outside, inside])
    joint = vessel.joint(points)
    blocks = joint.covariance.reshape(12, 4, 12, 4)
    assert (blocks[:6, :, 6:] == 0).all() and (blocks[0, 0, 1, 0] != 0).all()
    torch.testing.assert_close(joint.covariance, joint.covariance.mT)
    drawn = vessel.sample(points, 4000, seed=1)[..., 0]
    expected = torch.diagonal(joint.covariance)[::4]
    torch.testing.assert_close(drawn.var(0), expected, rtol=0.15, atol=1e-9)


def test_the_mesh_has_both_walls_and_the_volume_of_the_material(vessel: HollowShape):
    import trimesh

    surface = extract_surface(vessel, 48)
    true = cup(WALL)
    inner = (surface.normals[:, :2] * surface.vertices[:, :2]).sum(1) < 0
    assert 0.2 < float(inner.double().mean()) < 0.6
    mesh = surface.mesh()
    assert isinstance(mesh, trimesh.Trimesh)
    assert (
        abs(mesh.volume / true.volume - 1) < 0.5
    )  # 1 mm of 3 mm; filled it would be six times as much
    corners = torch.from_numpy(true.triangles.copy())
    points = surface.vertices[surface.vertices[:, 2] > 0.01][::7].numpy()
    gaps = []
    for point in points:
        feet, _ = closest_on_triangles(point[None].repeat(len(corners), 0), corners.numpy())
        gaps.append(((feet - point) ** 2).sum(1).min() ** 0.5)
    assert torch.tensor(gaps).quantile(0.9) < 0.0035


def test_a_fingers_line_meets_the_wall_of_its_contact(vessel: HollowShape):
    angle = torch.arange(3, dtype=torch.float64) * (2 * torch.pi / 3)
    out = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    points = torch.stack(
        [RADIUS * out[0], (RADIUS - WALL) * out[1], RADIUS * out[2]]
    ) + torch.tensor([0, 0, 0.05])
    normals = torch.stack([out[0], -out[1], out[2]])
    lines = line_posterior(vessel, Contacts(points[None], normals[None]))
    covariance = (lines.root @ lines.root).reshape(3, 20, 3, 20)
    assert covariance[0, :, 1].abs().max() < 1e-9 and covariance[2, :, 1].abs().max() < 1e-9
    outer, inner = vessel.walls
    alone = [line_posterior(wall, Contacts(points[None], normals[None])) for wall in (outer, inner)]
    for k, whole in ((0, alone[0]), (1, alone[1]), (2, alone[0])):
        torch.testing.assert_close(lines.distance[0, k], whole.distance[0, k])
        torch.testing.assert_close(lines.slope[0, k], whole.slope[0, k])


def test_walls_are_tied_at_their_thickness_and_floors_only_where_they_are_thinner(
    vessel: HollowShape,
):
    places = vessel.normalise(ring(RADIUS - WALL / 2, 0.02, HEIGHT - 0.02)[0])
    every = torch.ones(len(places), dtype=torch.bool)
    thickness = 0.005 / vessel.scale

    def sum_of(shape: HollowShape) -> Tensor:
        return shape.outer.mean(places) + shape.inner.mean(places)

    tied = tie_walls(vessel, Middle(places, every, thickness))
    assert (sum_of(vessel) + thickness).abs().median() * vessel.scale > 0.001
    assert (sum_of(tied) + thickness).abs().median() * vessel.scale < 0.0006
    thin = tie_walls(vessel, Middle(places, ~every, 0.0005 / vessel.scale))
    assert len(thin.inner.x) == len(vessel.inner.x) and len(thin.x) == len(vessel.x)


@pytest.mark.parametrize("seed", range(4))
def test_a_thin_wall_has_no_holes(seed: int):
    shape = fit_shape(cup_view(0.002, seed=seed), table=0.0)
    middle, _ = ring(RADIUS - 0.001, 0.015, HEIGHT - 0.012)
    out = (
        middle
        * torch.tensor([1.0, 1.0, 0.0])
        / torch.linalg.vector_norm(middle[:, :2], dim=1)[:, None]
    )
    across = torch.stack(
        [middle + s * out for s in torch.linspace(-0.004, 0.004, 17, dtype=torch.float64)], 1
    )
    material = (shape.predict(across).distance < 0).any(1)
    assert material.double().mean() > 0.96
