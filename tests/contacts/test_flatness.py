"""Normal variation against a sphere's closed form; the constraint against it and automatic
differentiation.
"""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from tests.make import CUP_RADIUS as RADIUS
from tests.make import cup_view, real
from tests.make import cylinder_points as ring
from torchgrasp import fit_shape
from torchgrasp.contacts.descent import project
from torchgrasp.contacts.feasibility import (
    GUIDING_POINTS,
    INSIDE,
    flatness_constraint,
    normal_variation,
)
from torchgrasp.contacts.form_closure import tangents
from torchgrasp.contacts.problem import triple_jet
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.hollow import HollowShape

RING_RADIUS = 0.008


def on_surface(ellipsoid, generator, count: int, fingertips: int) -> Tensor:
    return project(
        ellipsoid,
        torch.randn(count, fingertips, 3, generator=generator, dtype=torch.float64),
        steps=8,
    )


def test_variation_on_a_sphere_is_the_angle_of_the_ring_and_values_change_sign_there(
    ellipsoid, generator
):
    sphere = dataclasses.replace(ellipsoid, axes=(0.5, 0.5, 0.5))
    points = 0.5 * unit(torch.randn(5, 3, 3, generator=generator, dtype=torch.float64))
    found = normal_variation(
        sphere, points, triple_jet(sphere, points).normals, RING_RADIUS / sphere.scale
    )
    expected = math.atan(RING_RADIUS / (0.5 * sphere.scale))
    torch.testing.assert_close(found, torch.full_like(found, expected))
    angle = float(
        normal_variation(
            sphere, points, triple_jet(sphere, points).normals, RING_RADIUS / sphere.scale
        ).mean()
    )
    for limit, sign in ((0.99 * angle / INSIDE, 1), (1.01 * angle / INSIDE, -1)):
        value = flatness_constraint(sphere, points, limit, RING_RADIUS / sphere.scale).value
        assert value.shape == (5, 3 * GUIDING_POINTS)
        assert bool((sign * value > 0).all())


def test_variation_is_infinite_but_among_the_contacts_asked_for(ellipsoid, generator):
    points = on_surface(ellipsoid, generator, 20, 3)
    normals = triple_jet(ellipsoid, points).normals
    among = torch.rand(20, 3, generator=generator) < 0.3
    every, found = (
        normal_variation(ellipsoid, points, normals, RING_RADIUS / ellipsoid.scale, x)
        for x in (None, among)
    )
    torch.testing.assert_close(found[among], every[among])
    assert bool(torch.isinf(found[~among]).all() and torch.isfinite(every).all())


@pytest.mark.parametrize("fingertips", [3, 5])
def test_slope_against_automatic_differentiation(ellipsoid, generator, fingertips):
    """The ring's tangents are carried along without spin, as t - n (n . t) does to first order."""
    points = on_surface(ellipsoid, generator, 4, fingertips)
    limit = 0.3
    constraint = flatness_constraint(ellipsoid, points, limit, RING_RADIUS / ellipsoid.scale)
    normals = triple_jet(ellipsoid, points).normals
    first = tangents(points, normals)
    second = torch.linalg.cross(normals, first)
    inverse = 1 / real(ellipsoid.axes) ** 2

    def values(x: Tensor) -> Tensor:
        normal = unit(x * inverse)
        rows = []
        for k in range(GUIDING_POINTS):
            angle = real(2 * torch.pi * k / GUIDING_POINTS)
            t = angle.cos() * first + angle.sin() * second
            t = t - normal * (normal * t).sum(-1, keepdim=True)
            other = unit((x + RING_RADIUS / ellipsoid.scale * t) * inverse)
            rows.append(torch.linalg.vector_norm(other - normal, dim=-1))
        return RING_RADIUS / ellipsoid.scale * torch.cat(rows, 1)

    slope = (
        torch.autograd.functional.jacobian(lambda x: values(x).sum(0), points)
        .permute(1, 0, 2, 3)
        .flatten(2)
    )
    torch.testing.assert_close(constraint.by_points, slope)
    offset = values(points) - constraint.value
    torch.testing.assert_close(offset, offset[:1, :1].expand_as(offset))
    step = 1e-3 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    linear = constraint.value + (constraint.by_points @ step.flatten(1)[..., None])[..., 0]
    torch.testing.assert_close(constraint.values(points + step), linear)


@pytest.mark.parametrize("inside", [False, True])
def test_a_thin_wall_is_as_flat_as_its_own_side(inside: bool):
    """The ring of a contact inside a cup runs through the wall, nearer to its outside."""
    vessel = fit_shape(cup_view(0.002), table=0.0)
    assert isinstance(vessel, HollowShape)
    points, out = ring(RADIUS - (0.002 if inside else 0.0), 0.03, 0.055)
    wall = vessel.walls[int(inside)]
    triples = project(wall, vessel.normalise(points).reshape(-1, 3, 3), steps=6)
    triples = triples[vessel.wall_at(triples.flatten(0, 1))[:, int(inside)].reshape(-1, 3).all(1)]
    assert len(triples) > 15
    normals = triple_jet(vessel, triples).normals
    assert bool(((out[:1] * normals[0, :1]).sum() > 0) != inside)
    angle = normal_variation(vessel, triples, normals, RING_RADIUS / vessel.scale)
    assert angle.median() < 2 * math.atan(
        RING_RADIUS / RADIUS
    )  # that of the cylinder, and as much for the camera
    torch.testing.assert_close(
        angle, normal_variation(wall, triples, normals, RING_RADIUS / wall.scale)
    )
    limit = float(angle.max()) / INSIDE
    assert bool(
        (flatness_constraint(vessel, triples, limit, RING_RADIUS / vessel.scale).value < 1e-3).all()
    )
